// Slices of the scan beside its surface: what clrecon/exchange/page_slices.py wrote.  Returns where they meet, LPS mm,
// and how to move there; `moved` is called when they have moved.
async function openSlices(facts, unpack, inSpace, moved) {
  const { shape, affine, step_hu: step, low_hu: low, windows } = facts.slices, [ni, nj, nk] = shape;
  const planes = await unpack("slices"), count = ni * nj * nk, hu = new Int16Array(count);
  for (let row = 0; row < count; row += ni) {
    for (let i = row, value = 0; i < row + ni; i++) {
      const folded = planes[i] | (planes[count + i] << 8);
      value += (folded >> 1) ^ -(folded & 1);
      hu[i] = low + step * value;
    }
  }
  const column = (axis) => affine.slice(0, 3).map((row) => row[axis]), strides = [1, ni, ni * nj];
  const columns = [0, 1, 2].map(column), origin = column(3);
  const add = (a, b, by) => a.map((value, n) => value + by * b[n]);
  const toPatient = (ijk) => ijk.reduce((point, index, axis) => add(point, columns[axis], index), origin);
  const toGrid = (point) => {  // Cramer's rule
    const away = minus(point, origin), whole = dot(columns[0], cross(columns[1], columns[2]));
    return [0, 1, 2].map((n) => dot(away, cross(columns[(n + 1) % 3], columns[(n + 2) % 3])) / whole);
  };
  // Axes of the grid that lie nearest to those of the patient.
  const across = [];
  for (const axis of [2, 1, 0]) {
    const free = [0, 1, 2].filter((own) => !across.includes(own));
    across[axis] = free.sort((a, b) => Math.abs(unit(columns[b])[axis]) - Math.abs(unit(columns[a])[axis]))[0];
  }
  // Right and down on each slice, as radiologists see it, LPS.
  const VIEWS = { axial: [[1, 0, 0], [0, 1, 0], 2], coronal: [[1, 0, 0], [0, 0, -1], 1], sagittal: [[0, 1, 0], [0, 0, -1], 0] };
  const state = { index: shape.map((size) => Math.floor(size / 2)), window: Object.values(windows)[0] };
  const place = () => toPatient(state.index);
  const panes = Object.entries(VIEWS).map(([name, [right, down, axis]]) => {
    const box = find(name), canvas = box.querySelector("canvas"), slider = box.querySelector("input"), words = box.querySelector("p");
    const own = across[axis], [a, b] = [right, down].map((way) => across[way.findIndex(Boolean)]);
    const flips = [[a, right], [b, down]].map(([each, way]) => dot(columns[each], way) < 0);
    const ways = [a, b].map((each, n) => columns[each].map((value) => (flips[n] ? -value : value)));
    const along = unit(ways[0]), lift = add(ways[1], along, -dot(ways[1], along)), below = unit(lift);
    const sheet = document.createElement("canvas");
    [sheet.width, sheet.height] = [shape[a], shape[b]];
    slider.max = shape[own] - 1;
    return { name, box, canvas, slider, words, own, a, b, flips, ways, along, below, sheet };
  });

  // From pixels of the sheet to those of the pane, as numbers of a canvas.
  function fit({ canvas, sheet, ways, along, below }) {
    const [x, shear, y] = [dot(ways[0], along), dot(ways[1], along), dot(ways[1], below)];
    const wide = sheet.width * x + sheet.height * Math.abs(shear), high = sheet.height * y;
    const scale = Math.min(canvas.width / wide, canvas.height / high);
    const left = (canvas.width - scale * (sheet.width * x + sheet.height * shear)) / 2;
    return [scale * x, 0, scale * shear, scale * y, left, (canvas.height - scale * high) / 2];
  }

  function draw(pane) {
    const { canvas, sheet, own, a, b, flips, name, ways, slider, words } = pane, [na, nb] = [shape[a], shape[b]];
    const ratio = devicePixelRatio || 1, [black, white] = state.window, gain = 255 / (white - black);
    [canvas.width, canvas.height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.max(1, Math.round(size * ratio)));
    const grey = new ImageData(na, nb), first = state.index[own] * strides[own];
    for (let y = 0, at = 0; y < nb; y++) {
      const row = first + (flips[1] ? nb - 1 - y : y) * strides[b];
      for (let x = 0; x < na; x++, at += 4) {
        grey.data[at] = grey.data[at + 1] = grey.data[at + 2] = gain * (hu[row + (flips[0] ? na - 1 - x : x) * strides[a]] - black);
        grey.data[at + 3] = 255;
      }
    }
    sheet.getContext("2d").putImageData(grey, 0, 0);
    const pen = canvas.getContext("2d"), numbers = fit(pane);
    pen.fillRect(0, 0, canvas.width, canvas.height);
    pen.setTransform(...numbers);
    pen.imageSmoothingQuality = "high";
    pen.drawImage(sheet, 0, 0);
    const [x, y] = [a, b].map((each, n) => (flips[n] ? shape[each] - 1 - state.index[each] : state.index[each]) + 0.5);
    pen.setTransform(1, 0, 0, 1, 0, 0);
    const px = numbers[0] * x + numbers[2] * y + numbers[4], py = numbers[3] * y + numbers[5];
    pen.strokeStyle = "#ffb77d";
    pen.lineWidth = ratio;
    pen.beginPath();
    for (const [from, to] of [[[px, 0], [px, canvas.height]], [[0, py], [canvas.width, py]]]) { pen.moveTo(...from); pen.lineTo(...to); }
    pen.stroke();
    pen.fillStyle = "#f1f3f5";
    pen.font = `600 ${13 * ratio}px system-ui, sans-serif`;
    pen.textBaseline = "middle";
    pen.textAlign = "center";
    const less = (way) => way.map((value) => -value), [wide, high, inset] = [canvas.width, canvas.height, 12 * ratio];
    for (const [way, left, top] of [[ways[0], wide - inset, high / 2], [less(ways[0]), inset, high / 2],
      [less(ways[1]), wide / 2, inset], [ways[1], wide / 2, high - inset]]) pen.fillText(sideOf(way), left, top);
    pen.fillStyle = "#000";
    slider.value = state.index[own];
    const said = sayPlace(inSpace(place()));
    words.textContent = `${name} ${state.index[own] + 1} / ${shape[own]} · ${valueAt(state.index)} HU · ${facts.space} (${said}) mm`;
  }

  const valueAt = (ijk) => hu[ijk.reduce((sum, index, axis) => sum + index * strides[axis], 0)];
  const drawAll = () => panes.forEach(draw);

  function moveTo(point) {
    const ijk = toGrid(point).map(Math.round);
    if (ijk.some((index, axis) => index < 0 || index >= shape[axis])) return;
    state.index = ijk;
    drawAll();
    moved();
  }

  function scroll(pane, index) {
    state.index[pane.own] = Math.min(Math.max(index, 0), shape[pane.own] - 1);
    drawAll();
    moved();
  }

  for (const pane of panes) {
    const { canvas, slider, own, a, b, flips } = pane;
    const point = (event) => {
      const [x, , shear, y, left, top] = fit(pane), ratio = canvas.width / canvas.clientWidth;
      const v = (event.offsetY * ratio - top) / y, u = (event.offsetX * ratio - left - shear * v) / x;
      const ijk = [...state.index];
      [[a, u], [b, v]].forEach(([each, value], n) => {
        const index = Math.min(Math.max(Math.floor(value), 0), shape[each] - 1);
        ijk[each] = flips[n] ? shape[each] - 1 - index : index;
      });
      return ijk;
    };
    const drag = (event) => { if (event.buttons & 1) { state.index = point(event); drawAll(); moved(); } };
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); drag(event); });
    canvas.addEventListener("pointermove", drag);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      scroll(pane, state.index[own] + Math.sign(event.deltaY));
    }, { passive: false });
    slider.oninput = () => scroll(pane, Number(slider.value));
  }
  find("window").replaceChildren(...Object.keys(windows).map((name) => element("option", name, { value: name })));
  find("window").onchange = () => { state.window = windows[find("window").value]; drawAll(); };
  find("planes").hidden = false;
  new ResizeObserver(drawAll).observe(find("planes"));
  drawAll();
  return { place, moveTo };
}
