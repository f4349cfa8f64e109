  // What lies over the pictures, and the gestures on them; in one scope with page.js.

  // Where a point of the patient (LPS mm) appears, in CSS pixels; null behind the eye.
  function project(view, point) {
    const camera = view.camera;
    if (!camera) return null;
    const away = minus(point, camera.position), deep = dot(away, camera.forward);
    if (!camera.parallel && deep <= 0) return null;
    const mm = ((2 * camera.half_height) / view.box.clientHeight) * (camera.parallel ? 1 : deep);
    return [view.box.clientWidth / 2 + dot(away, camera.right) / mm,
      view.box.clientHeight / 2 - dot(away, camera.up) / mm];
  }

  // Pixels of a slice that has room for its number beside the letter of the upper side, for all words, most, its name.
  const ROOMY = 300, WIDE = 240, FAIR = 190, SLIM = 120;
  const HANDLE = 0.75;  // share of the height at which the line of a comparison has its handle
  const MOST_LETTERS = 24;  // of a name beside a picture; the list has all of it

  // What lies over a picture: sides of the patient, scale, cross, measures.

  function annotate(view) {
    if (!isShown(view) || !(view.camera || view.name === "curve")) { view.over.replaceChildren(); return; }
    const width = view.box.clientWidth, height = view.box.clientHeight, camera = view.camera, drawn = [];
    const make = (kind, more) => {
      const one = document.createElementNS(SVG, kind);
      for (const [name, value] of Object.entries(more)) one.setAttribute(name, value);
      drawn.push(one);
      return one;
    };
    const write = (text, x, y, name, anchor = "middle") => {
      const one = make("text", { x, y, class: name, "text-anchor": anchor });
      one.textContent = text;
    };
    const line = (points, name) => make("polyline", { points: points.map((point) => point.join()).join(" "), class: name });
    const segments = (drawn, name) => {
      for (const [from, to] of drawn) line([from, to], name);
    };
    if (view.name === "curve") write(width < FAIR ? "curve" : "along the curve", width < FAIR ? 5 : 10, 14, "name curve", "start");
    if (SLICES.includes(view.name)) annotateSlice(view, write, width, height);
    if (!camera) { view.over.replaceChildren(...drawn); return; }  // a curve is straightened: it has no sides
    const less = (row) => row.map((value) => -value);
    write(sideOf(camera.up), width / 2, 14, "side");
    write(sideOf(less(camera.up)), width / 2, height - 14, "side");
    write(sideOf(less(camera.right)), 20, height / 2, "side");
    write(sideOf(camera.right), width - 20, height / 2, "side");
    const focal = camera.parallel ? 1 : facts ? dot(minus(facts.camera.focal_point, camera.position), camera.forward) : 1;
    const mm = ((2 * camera.half_height) / height) * focal, length = roundLength((width / 4) * mm);
    const end = 14 + length / mm, low = height - 16;
    line([[14, low - 6], [14, low], [end, low], [end, low - 6]], "halo");
    line([[14, low - 6], [14, low], [end, low], [end, low - 6]], "bar");
    write(sayLength(length) + (camera.parallel ? "" : " in the middle"), 14, low - 17, width < FAIR ? "side small" : "side", "start");
    if (facts && facts.scale && view.name === "scene") annotateScale(make, write, width, height);
    if (facts && facts.iso) annotateCross(view, make, segments, width, height);
    if (facts) annotateMeasures(view, line, write, width, height);
    if (facts && facts.compare !== null) annotateCompare(view, make, line, write, width, height);
    if (facts && view.pointer && SLICES.includes(view.name)) annotateRegion(view, make);
    view.over.replaceChildren(...drawn);
  }

  // Which slice it is, its window, and HU and mm under the pointer.
  function annotateSlice(view, write, width, height) {
    const { number, count, place } = facts ? facts.slices[view.name] : {}, wide = width >= WIDE;
    const [low, high] = facts ? facts.window : [0, 0], level = Math.round((low + high) / 2), span = Math.round(high - low);
    const which = count ? `${number} / ${count}` : "";
    const title = width >= ROOMY ? [`${view.name} ${which}`, place]
      : [width < SLIM ? view.name.slice(0, 3) : view.name, wide ? [which, place].filter(Boolean).join(" · ") : which || place];
    write(title[0], wide ? 10 : 5, 14, `name ${wide ? "" : "small "}${view.name}`, "start");
    if (!facts) return;
    write(title[1], wide ? 10 : 5, 32, "words", "start");
    view.canvas.role = "img";
    view.canvas.ariaLabel = `${view.name} slice ${count ? `${number} of ${count}` : ""}, ${place}, level ${level}, width ${span} HU`;
    const lines = width >= FAIR ? [`L ${level} W ${span}`] : [];
    const { mm, combine } = facts.slab;
    if (mm) lines.push(`${{ mean: "mean", max: "most", min: "least" }[combine]} of ${mm} mm`);
    if (view.pointer && probed) {
      lines.push(probed.hu === null ? "outside" : `${probed.hu.toFixed(0)} HU`);
      if (width >= FAIR) lines.push(probed.words);  // above the words of the scale
    }
    const plain = lines.length - (view.pointer && probed ? (width >= FAIR ? 2 : 1) : 0);
    const foot = height - (wide ? 14 : 31);  // beside the letter of the lower side there is no room in a narrow one
    lines.forEach((line, n) => write(line, width - 8, foot - 17 * n, n < plain ? "words" : "words probe", "end"));
  }

  // The scale of the colours of a surface, its numbers in mm beside it.
  function annotateScale(make, write, width, height) {
    const { title, ticks, colors } = facts.scale, top = height / 2 + 48, low = height - 22, step = (low - top) / colors.length;
    colors.forEach((rgb, n) => make("rect", { x: width - 26, y: low - (n + 1) * step, width: 14, height: step + 0.5, fill: `rgb(${rgb})` }));
    ticks.forEach((tick, n) => write(String(tick), width - 32, low - (n / (ticks.length - 1)) * (low - top), "words", "end"));
    write(title, width - 12, top - 18, "words", "end");
  }

  // How far the iso value lies from the bone, once the surface was fitted there.
  function showOffset() {
    const { offset, iso } = facts, chip = find("offset");
    chip.hidden = !offset;
    if (!offset) return;
    const { mm, range_mm: [least, most], error_mm: error } = offset;
    chip.textContent = `${iso.hu.toFixed(0)} HU: ${Math.abs(mm).toFixed(2)} mm ${mm < 0 ? "inside" : "outside"} the bone`;
    chip.className = offset.is_good ? "good" : "wrong";
    chip.title = `median of the surface at the iso value; of 90 % ${least.toFixed(2)} to ${most.toFixed(2)} mm; error of the fit`
      + ` ${error.toFixed(2)} mm. Click: fitted to the bone, or at the iso value (t)`;
  }

  // The line of a comparison, with a handle to drag, and what is on either side of it.
  function annotateCompare(view, make, line, write, width, height) {
    const x = facts.compare * width, y = height * HANDLE, [first, second] = facts.objects.map(({ name }) => name);
    for (const name of ["halo", "bar"]) line([[x, 0], [x, height]], name);
    make("circle", { cx: x, cy: y, r: 9, class: "handle divide" });
    if (width < WIDE) return;
    write(first.slice(0, MOST_LETTERS), x - 16, y, "words", "end");
    write(second.slice(0, MOST_LETTERS), x + 16, y, "words", "start");
  }

  const isDivider = (view, [x, y], reach) => Boolean(facts) && facts.compare !== null && view.name !== "curve"
    && Math.hypot(x - facts.compare * view.box.clientWidth, y - HANDLE * view.box.clientHeight) < reach;

  // Where the slices meet: in a slice the lines of the two others, whose ends turn them, in the picture a short line
  // across each.
  function annotateCross(view, make, segments, width, height) {
    const middle = project(view, facts.cross);
    view.handles = [];
    if (!middle) return;
    for (const plane of SLICES) {
      const forward = facts.forward[plane];
      if (view.name === "scene") {
        const mm = (facts.camera.height_mm / height) * CROSS_PIXELS;
        const ends = [-mm, mm].map((by) => project(view, facts.cross.map((value, at) => value + by * forward[at])));
        if (ends.every(Boolean)) segments([ends], `cross ${plane}`);
      } else if (plane !== view.name) {
        const along = cross(forward, view.camera.forward), x = dot(along, view.camera.right), y = -dot(along, view.camera.up);
        const sides = [-1, 1].map((sign) => [sign * x, sign * y]).map((way) => [way, lengthWithin(middle, way, width, height)]);
        const ahead = ([way], far) => middle.map((value, axis) => value + far * way[axis]);
        segments(sides.filter(([, far]) => far > GAP).map((side) => [ahead(side, GAP), ahead(side, side[1])]), `cross ${plane}`);
        view.handles.push(...sides.filter(([, far]) => far > 2 * INSET).map((side) => ahead(side, side[1] - INSET)));
        if (!view.pointer && !view.turning && !COARSE_POINTER.matches) continue;
        for (const [cx, cy] of view.handles.slice(-2)) make("circle", { cx, cy, r: 4.5, class: `handle ${plane}` });
      }
    }
  }

  const COARSE_POINTER = matchMedia("(pointer: coarse)");

  // How far a way of length 1 goes from a place to the border of a view.
  function lengthWithin(place, way, width, height) {
    const sizes = [width, height];
    if (place.some((value, axis) => value < 0 || value > sizes[axis])) return 0;
    return Math.min(...way.map((by, axis) => {
      if (Math.abs(by) < 1e-9) return Infinity;
      return ((by > 0 ? sizes[axis] : 0) - place[axis]) / by;
    }));
  }

  const isHandle = (view, [x, y], reach) => (view.handles || []).some((end) => Math.hypot(end[0] - x, end[1] - y) < reach);

  // Texts of measures stand in the nearer upper corner, with a thin line to what they belong to: bone stays free.
  function annotateMeasures(view, line, write, width, height) {
    const placed = SLICES.includes(view.name) ? { start: 2, end: width < ROOMY ? 2 : 1 } : { start: 0, end: 1 };  // words, and the button
    const unfinished = facts.points.length ? [{ outline: facts.points.map(({ point }) => point), text: "" }] : [];
    for (const measure of [...facts.measures, ...unfinished]) {
      const points = measure.outline.map((point) => project(view, point)).filter(Boolean), closed = Boolean(measure.voxels);
      if (points.length !== measure.outline.length || !isNear(view, measure.outline)) continue;
      for (const name of ["halo", "line"]) {
        if (points.length > 1) line(points, view.name === "scene" ? `${name} behind` : name);
        for (const [x, y] of closed ? [] : points) { line([[x - 5, y], [x + 5, y]], name); line([[x, y - 5], [x, y + 5]], name); }
      }
      if (!measure.text || width < FAIR) continue;  // the list has it
      const wide = width >= WIDE && height >= FAIR, value = measure.kind === "seed" ? "" : measure.text;
      const name = measure.name.length > MOST_LETTERS ? `${measure.name.slice(0, MOST_LETTERS - 1)}…` : measure.name;
      const words = wide ? `${name} ${value}`.trim() : value || name;
      const middle = points.length === 3 && measure.kind === "angle" ? points[1]
        : [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
      const side = middle[0] < width / 2 ? "start" : "end", x = side === "start" ? 12 : width - 12;
      const y = 18 + 20 * placed[side]++;
      line([[x + (side === "start" ? 1 : -1) * (4 + 8 * words.length), y], middle], "lead");
      write(words, x, y, wide ? "measure" : "measure small", side);
    }
    if (view.name !== "scene") return;
    for (const piece of facts.seen_lines) {  // what no bone hides
      const ends = piece.map((point) => project(view, point));
      if (ends.every(Boolean)) line(ends, "line seen");
    }
  }

  // A circle or box that is being drawn.
  function annotateRegion(view, make) {
    const [first] = facts.points, [x, y] = (first && project(view, first.point)) || [], [toX, toY] = view.pointer;
    if (x === undefined || !["circle", "box"].includes(facts.tool)) return;
    for (const name of ["halo", "line"]) {
      if (facts.tool === "circle") make("circle", { cx: x, cy: y, r: Math.hypot(toX - x, toY - y), class: name });
      else make("rect", { x: Math.min(x, toX), y: Math.min(y, toY), width: Math.abs(toX - x), height: Math.abs(toY - y), class: name });
    }
  }

  // In a slice only what lies within 3 mm of its plane.
  function isNear(view, points) {
    if (!SLICES.includes(view.name)) return view.name !== "curve";
    return points.every((point) => Math.abs(dot(minus(point, facts.cross), view.camera.forward)) < 3);
  }

  // Gestures: what came since the last frame goes out as one command each.

  const waiting = new Map();

  function gather(key, join) {
    waiting.set(key, join(waiting.get(key)));
    if (!asked) requestAnimationFrame(flush);
    asked = true;
  }

  function flush() {
    asked = false;
    for (const what of waiting.values()) run(what.do, what.more);
    waiting.clear();
  }

  const sumUp = (name, x, y) => gather(name, (old) => (
    { do: name, more: { dx: x + (old ? old.more.dx : 0), dy: y + (old ? old.more.dy : 0) } }
  ));
  const last = (name, more, key = name) => gather(key, () => ({ do: name, more }));

  const sizeOf = ({ box }) => [box.clientWidth, box.clientHeight];
  const middleOf = (view) => sizeOf(view).map((value) => value / 2);

  function zoomBy(view, factor, x, y) {
    const [width, height] = sizeOf(view), at = [(x - width / 2) / height, (y - height / 2) / height];
    const make = SLICES.includes(view.name)
      ? (by) => ({ do: "zoom_slice", more: { factor: by, about: at, plane: view.name, size: [width, height] } })
      : (by) => ({ do: "zoom", more: { factor: by, at } });
    gather(`zoom ${view.name}`, (old) => make(factor * (old ? old.more.factor : 1)));
  }

  function panBy(view, x, y) {  // pixels
    const height = view.box.clientHeight, dx = x / height, dy = y / height;
    if (!SLICES.includes(view.name)) { sumUp("pan", dx, dy); return; }
    gather(`pan ${view.name}`, (old) => ({ do: "pan_slice",
      more: { dx: dx + (old ? old.more.dx : 0), dy: dy + (old ? old.more.dy : 0), plane: view.name, size: sizeOf(view) } }));
  }

  // Ask what a slice shows under the pointer.
  function probe(view) {
    if (!facts || !view.pointer || !view.camera || !SLICES.includes(view.name)) return;
    const { position, right, up, forward, half_height: half } = view.camera, [x, y] = view.pointer;
    const mm = (2 * half) / view.box.clientHeight, [middleX, middleY] = middleOf(view);
    const deep = dot(minus(facts.cross, position), forward);
    last("probe", { point: position.map((value, axis) => value + (x - middleX) * mm * right[axis]
      - (y - middleY) * mm * up[axis] + deep * forward[axis]) });
  }

  const scrollBy = (view, steps) => gather(`scroll ${view.name}`, (old) => (
    { do: "scroll", more: { plane: view.name, steps: steps + (old ? old.more.steps : 0) } }
  ));

  function windowBy(x, y) {
    const [low, high] = waiting.has("set_window") ? Object.values(waiting.get("set_window").more) : facts.window;
    const width = Math.max(1, (high - low) * Math.exp(x / 200)), level = (low + high) / 2 + (y * (high - low)) / 300;
    facts.window = [level - width / 2, level + width / 2];
    last("set_window", { low: facts.window[0], high: facts.window[1] });
    showWindow();
  }

  // A drag about the middle of the picture rolls it, about that of the cross it turns the slices.
  function turnAt(view, x, y, slice) {
    const middle = slice ? project(view, facts.cross) : middleOf(view);
    const now = Math.atan2(y - middle[1], x - middle[0]);
    const by = view.angle === undefined ? 0 : ((now - view.angle) * 180) / Math.PI;
    view.angle = now;
    const degrees = by > 180 ? by - 360 : by < -180 ? by + 360 : by;
    const more = slice ? { plane: view.name } : {};
    gather(slice ? "turn_cross" : "roll", (old) => (
      { do: slice ? "turn_cross" : "roll", more: { ...more, degrees: degrees + (old ? old.more.degrees : 0) } }
    ));
  }

  for (const view of Object.values(views)) {
    const fingers = new Map(), slice = SLICES.includes(view.name);
    let moved = 0, steps = 0;
    const at = (event) => {
      const box = view.box.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    view.box.addEventListener("pointerdown", (event) => {
      if (event.target.closest("button")) return;
      view.box.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, at(event));
      moved = fingers.size > 1 ? Infinity : 0;
      steps = 0;
      last("hold", { on: true });
      delete view.angle;
      const reach = event.pointerType === "touch" ? INSET : INSET / 2;
      view.dividing = fingers.size === 1 && event.button === 0 && isDivider(view, at(event), reach);
      view.turning = slice && !view.dividing && !choosing && !event.shiftKey && event.button === 0 && fingers.size === 1
        && isHandle(view, at(event), reach);
      if (view.turning) turnAt(view, ...at(event), true);  // from here on
    });
    view.box.addEventListener("pointerenter", () => annotate(view));
    view.box.addEventListener("pointermove", (event) => {
      view.pointer = at(event);
      const before = fingers.get(event.pointerId);
      if (!before) probe(view);
      if (facts && facts.points.length) annotate(view);
      if (!before && slice) view.box.classList.toggle("turns", !choosing && isHandle(view, view.pointer, INSET / 2));
      if (!before || view.name === "curve") return;
      const now = at(event), x = now[0] - before[0], y = now[1] - before[1], height = view.box.clientHeight;
      moved += Math.hypot(x, y);
      if (moved < 4) return;
      if (view.dividing) {
        facts.compare = Math.min(Math.max(now[0] / view.box.clientWidth, 0), 1);
        last("set_compare", { share: facts.compare });
        for (const other of Object.values(views)) annotate(other);
      } else if (fingers.size > 1) {
        const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
        const apart = (finger) => Math.max(Math.hypot(finger[0] - other[0], finger[1] - other[1]), 1);
        panBy(view, x / 2, y / 2);
        zoomBy(view, apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      } else if (view.turning) turnAt(view, ...now, true);
      else if (slice && event.buttons & 2) windowBy(x, y);
      else if (slice && (event.shiftKey || event.buttons & 4)) panBy(view, x, y);
      else if (slice && event.pointerType === "touch") {
        steps += y / 6;
        if (Math.trunc(steps)) scrollBy(view, Math.trunc(steps));
        steps -= Math.trunc(steps);
      } else if (slice) {
        if (!choosing) last("cross_at", pixel(view, now));
      } else if (event.ctrlKey && event.shiftKey) {
        zoomBy(view, 6 ** (-y / height), view.box.clientWidth / 2, height / 2);
      } else if (event.ctrlKey) turnAt(view, ...now);
      else if (event.shiftKey || event.buttons & 6) panBy(view, x, y);
      else sumUp("turn", x / height, y / height);
      fingers.set(event.pointerId, now);
    });
    for (const name of ["pointerup", "pointercancel"]) {
      view.box.addEventListener(name, (event) => {
        if (!fingers.delete(event.pointerId)) return;
        if (!fingers.size) last("hold", { on: false }, "release");
        const turned = view.turning || view.dividing;
        view.turning = view.dividing = false;
        if (name === "pointerup" && moved < 4 && event.button === 0 && !turned) click(view, at(event), event.shiftKey);
      });
    }
    view.box.addEventListener("pointerleave", () => { view.pointer = null; annotate(view); });
    view.box.addEventListener("dblclick", (event) => {
      if (!choosing && !event.target.closest("button")) setFull(view.name);
    });
    view.box.addEventListener("wheel", (event) => {
      event.preventDefault();
      const by = Math.max(-1, Math.min(1, event.deltaY / 100));
      if (slice && !event.ctrlKey) {
        steps += by;
        if (Math.trunc(steps)) scrollBy(view, Math.trunc(steps));
        steps -= Math.trunc(steps);
      } else if (view.name !== "curve") zoomBy(view, Math.exp(-0.2 * by), ...at(event));
    }, { passive: false });
    view.box.addEventListener("contextmenu", (event) => event.preventDefault());
  }
