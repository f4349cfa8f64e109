(async () => {
  const facts = JSON.parse(find("facts").textContent);
  const scene = find("scene"), over = find("over"), message = find("message");

  // The surface: what clrecon/exchange/page.py wrote.

  async function unpack(id) {
    const text = find(id).textContent;
    let packed;
    if (Uint8Array.fromBase64) packed = Uint8Array.fromBase64(text);
    else {
      const letters = atob(text);
      packed = new Uint8Array(letters.length);
      for (let i = 0; i < letters.length; i++) packed[i] = letters.charCodeAt(i);
    }
    find(id).remove();
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  function decode(planes) {
    const n = facts.vertices, m = 3 * facts.triangles;
    const place = new Uint16Array(4 * n), normal = new Int8Array(4 * n), index = new Uint32Array(m);
    const unfold = (folded) => (folded >> 1) ^ -(folded & 1);
    for (let axis = 0; axis < 3; axis++) {
      const low = axis * n, high = low + 3 * n;
      for (let i = 0, at = 0; i < n; i++) {
        place[4 * i + axis] = at = (at + unfold(planes[low + i] | (planes[high + i] << 8))) & 65535;
      }
    }
    const byte = (value) => (value << 24) >> 24;
    for (let i = 0, x = 0, y = 0; i < n; i++) {
      x = byte(x + unfold(planes[6 * n + i])), y = byte(y + unfold(planes[7 * n + i]));
      const z = 127 - Math.abs(x) - Math.abs(y), back = Math.max(-z, 0);
      const right = x - Math.sign(x) * back, up = y - Math.sign(y) * back;
      const scale = 127 / Math.sqrt(right * right + up * up + z * z);
      normal[4 * i] = Math.round(scale * right), normal[4 * i + 1] = Math.round(scale * up);
      normal[4 * i + 2] = Math.round(scale * z);
    }
    const lags = 8 * n, first = lags + m;
    for (let i = 0, next = 0; i < m; i++) {
      const at = first + i, lag = planes[lags + i];
      const code = planes[at] | (planes[at + m] << 8) | (planes[at + 2 * m] << 16) | (planes[at + 3 * m] << 24);
      index[i] = (lag ? index[i - lag] : next) + unfold(code);
      if (index[i] === next) next++;
    }
    const columns = (facts.values || []).map((_, column, all) => {
      const codes = new Uint16Array(n), low = first + 4 * m + column * n, high = low + all.length * n;
      for (let i = 0, at = 0; i < n; i++) codes[i] = at = (at + unfold(planes[low + i] | (planes[high + i] << 8))) & 65535;
      return codes;
    });
    return { place, normal, index, columns };
  }

  // Drawing.  Positions on the device are mm from the lowest corner of the box.

  const VERTEX = `#version 300 es
    uniform vec3 span, centre, middle; uniform mat3 turn; uniform vec2 halfSize; uniform float reach;
    in vec3 place, normal; in vec2 number; out vec3 at, facing; out vec2 share;
    void main() {
      share = number;
      at = span * place;
      facing = turn * normal;
      gl_Position = vec4((turn * (at - centre)).xy / halfSize, -(turn * (at - middle)).z / reach, 1.0);
    }`;
  const SHADE = `#version 300 es
    precision highp float;
    uniform vec4 color, cut; uniform vec2 scale; uniform vec3 table[7]; in vec3 at, facing; in vec2 share; out vec4 shown;
    vec3 paint() {
      if (scale.y == 0.0) return color.rgb;
      if (share.y < 0.999) return vec3(0.5);
      float step = 6.0 * clamp(scale.x + scale.y * share.x, 0.0, 1.0), below = min(floor(step), 5.0);
      return mix(table[int(below)], table[int(below) + 1], step - below);
    }
    void main() {
      if (dot(at, cut.xyz) > cut.w) discard;
      vec3 n = normalize(facing) * (gl_FrontFacing ? 1.0 : -1.0);
      float light = max(dot(n, normalize(vec3(-0.25, 0.35, 1.0))), 0.0);
      vec3 lit = paint() * (0.22 + 0.78 * light) + 0.10 * pow(light, 24.0);
      shown = vec4(gl_FrontFacing ? lit : 0.6 * lit, color.a);
    }`;
  // The exact place under the middle of a pixel: what a click picks.
  const PICK = `#version 300 es
    precision highp float; precision highp int;
    uniform vec4 cut; uniform uint part; in vec3 at, facing; in vec2 share; out uvec4 picked;
    void main() {
      if (dot(at, cut.xyz) > cut.w) discard;
      uint number = share.y < 0.999 ? 65535u : uint(65534.0 * share.x + 0.5);
      picked = uvec4(floatBitsToUint(at), (number << 16) | part);
    }`;
  const gl = scene.getContext("webgl2", { antialias: true });
  if (!gl || typeof DecompressionStream === "undefined") {
    message.textContent = "This page needs a browser with WebGL 2 and DecompressionStream: one from 2023 or later.";
    return;
  }
  scene.addEventListener("webglcontextlost", () => { message.textContent = "The graphics failed: load it again."; });

  function link(fragment) {
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "place");
    gl.bindAttribLocation(program, 1, "normal");
    gl.bindAttribLocation(program, 2, "number");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return { program, at: new Proxy({}, { get: (_, name) => gl.getUniformLocation(program, name) }) };
  }

  const span = facts.step, extent = span.map((step) => 65535 * step);
  const middle = extent.map((size) => size / 2), reach = 0.51 * Math.hypot(...extent) + 1;
  const parts = facts.parts.map((part, n) => ({ ...part, number: n + 1, shown: true, opacity: 1 }));
  // Rows of turn: what points right, up and to the viewer, LPS.
  const camera = { turn: [], centre: middle, mm: 1, fits: "A" };
  const clip = { direction: "", along: [1, 0, 0], share: 0.5, flipped: false };
  let slices = null;  // of a page that has some
  let columns = [], painted = null;  // numbers at the vertices, and which of them colours show
  let measures = [], tool = "", picks = [], coarse = false, asked = false, shade, pick, pickTarget, numberBuffer;

  const VIEWS = { A: [0, -1, 0], P: [0, 1, 0], L: [1, 0, 0], R: [-1, 0, 0], S: [0, 0, 1], I: [0, 0, -1] };

  function look(letter) {
    camera.fits = letter;  // as long as nobody moves it
    const back = VIEWS[letter], up = back[2] ? [0, -1, 0] : [0, 0, 1];
    camera.turn = [cross(up, back), up, back];
    camera.centre = middle;
    const shown = camera.turn.map((row) => dot(row.map(Math.abs), extent));
    camera.mm = 1.12 * Math.max(shown[0] / (scene.clientWidth || 1), shown[1] / (scene.clientHeight || 1), 1e-4);
    redraw();
  }

  function cutPlane() {
    if (!clip.direction) return [0, 0, 0, 1];
    const along = clip.along.map((value) => (clip.flipped ? -value : value));
    const half = dot(along.map(Math.abs), extent) / 2;
    return [...along, dot(along, middle) + half * (1 - 2 * clip.share)];
  }

  function use(tools, width, height) {
    const { turn, centre, mm } = camera, at = tools.at;
    gl.useProgram(tools.program);
    gl.uniform3fv(at.span, span);
    gl.uniform3fv(at.centre, centre);
    gl.uniform3fv(at.middle, middle);
    gl.uniformMatrix3fv(at.turn, false, [0, 1, 2].flatMap((axis) => turn.map((row) => row[axis])));
    gl.uniform2f(at.halfSize, (width * mm) / 2, (height * mm) / 2);
    gl.uniform1f(at.reach, reach);
    gl.uniform4fv(at.cut, cutPlane());
    if (tools !== shade) return;
    const { low, step, ticks, colors } = painted || {}, wide = painted && ticks[4] - ticks[0];
    gl.uniform2fv(at.scale, painted ? [(low - ticks[0]) / wide, (65534 * step) / wide] : [0, 0]);
    if (painted) gl.uniform3fv(at.table, colors.flatMap(channels));
  }

  const sayNumber = (value) => String(Number(value.toPrecision(3)));
  const nameOf = (column) => column.name.slice(0, -3).replace(/_/g, " ");

  function choosePaint(name) {
    const row = (facts.values || []).findIndex((column) => column.name === name), shares = new Float32Array(2 * facts.vertices);
    painted = row < 0 ? null : facts.values[row];
    if (painted) {
      columns[row].forEach((code, i) => { if (code !== 65535) shares.set([code / 65534, 1], 2 * i); });
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, numberBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, shares, gl.STATIC_DRAW);
    redraw();
  }

  const drawPart = (part) => gl.drawElements(gl.TRIANGLES, 3 * part.count, gl.UNSIGNED_INT, 12 * part.first);
  const channels = (color) => [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16) / 255);

  function draw() {
    asked = false;
    const width = scene.clientWidth, height = scene.clientHeight;
    if (!width || !height) return;
    const sharp = Math.min(devicePixelRatio, 2);
    for (const [canvas, ratio] of [[scene, coarse ? 0.5 : sharp], [over, sharp]]) {
      const size = [Math.round(width * ratio), Math.round(height * ratio)];
      if (canvas.width !== size[0]) canvas.width = size[0];
      if (canvas.height !== size[1]) canvas.height = size[1];
    }
    gl.viewport(0, 0, scene.width, scene.height);
    const ground = getComputedStyle(document.body).backgroundColor.match(/[\d.]+/g).map((value) => value / 255);
    gl.clearColor(ground[0], ground[1], ground[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    use(shade, width, height);
    for (const part of parts) {
      if (!part.shown || part.opacity < 1) continue;
      gl.uniform4f(shade.at.color, ...channels(part.color), 1);
      drawPart(part);
    }
    // Of a translucent part only what is nearest: first its depth, then its colour where the depth is equal.
    gl.enable(gl.BLEND);
    for (const part of parts) {
      if (!part.shown || part.opacity === 1 || part.opacity === 0) continue;
      gl.colorMask(false, false, false, false);
      drawPart(part);
      gl.colorMask(true, true, true, false);
      gl.uniform4f(shade.at.color, ...channels(part.color), part.opacity);
      drawPart(part);
    }
    gl.colorMask(true, true, true, true);
    gl.disable(gl.BLEND);
    annotate(width, height, over.width / width);
  }

  function redraw() {
    if (!asked) requestAnimationFrame(draw);
    asked = true;
  }

  // Places: on the screen in CSS pixels, in the patient in LPS mm from the lowest corner of the box.

  function project(point) {
    const along = camera.turn.map((row) => dot(row, minus(point, camera.centre)));
    return [scene.clientWidth / 2 + along[0] / camera.mm, scene.clientHeight / 2 - along[1] / camera.mm];
  }

  function pickAt(x, y) {
    const width = scene.clientWidth, height = scene.clientHeight;
    gl.bindFramebuffer(gl.FRAMEBUFFER, pickTarget);
    gl.viewport(-Math.floor(x), Math.floor(y) + 1 - height, width, height);
    gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    use(pick, width, height);
    for (const part of parts) {
      if (!part.shown || part.opacity === 0) continue;
      gl.uniform1ui(pick.at.part, part.number);
      drawPart(part);
    }
    const found = new Uint32Array(4);
    gl.readPixels(0, 0, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    if (!found[3]) return null;
    const code = found[3] >>> 16, number = painted && code < 65535 ? painted.low + painted.step * code : null;
    return { point: Array.from(new Float32Array(found.buffer, 0, 3)), part: (found[3] & 65535) - 1, number };
  }

  const toPatient = (point) => point.map((value, axis) => value + facts.low[axis]);
  const inSpace = (point) => point.map((value, axis) => (facts.space === "RAS" && axis < 2 ? -value : value));

  function measureText({ points }) {
    if (points.length === 2) return `${Math.hypot(...minus(points[1], points[0])).toFixed(1)} mm`;
    const cosine = dot(unit(minus(points[0], points[1])), unit(minus(points[2], points[1])));
    return `${((180 / Math.PI) * Math.acos(Math.max(-1, Math.min(1, cosine)))).toFixed(1)}\u00b0`;
  }

  // What lies over the picture: sides of the patient, scale, measures.

  function annotate(width, height, ratio) {
    const pen = over.getContext("2d"), style = getComputedStyle(document.body);
    const ink = style.color, ground = style.backgroundColor;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "600 15px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.lineJoin = "round";
    const write = (text, x, y) => {
      pen.lineWidth = 4;
      pen.strokeStyle = ground;
      pen.strokeText(text, x, y);
      pen.fillStyle = ink;
      pen.fillText(text, x, y);
    };
    const line = (points) => {
      for (const [color, size] of [[ground, 4], [ink, 1.5]]) {
        pen.strokeStyle = color;
        pen.lineWidth = size;
        pen.beginPath();
        points.forEach(([x, y], n) => (n ? pen.lineTo(x, y) : pen.moveTo(x, y)));
        pen.stroke();
      }
    };
    const [right, up] = camera.turn, less = (row) => row.map((value) => -value);
    write(sideOf(up), width / 2, 14);
    write(sideOf(less(up)), width / 2, height - 14);
    write(sideOf(less(right)), 18, height / 2);
    write(sideOf(right), width - 18, height / 2);
    const length = roundLength((width / 4) * camera.mm), end = 16 + length / camera.mm;
    line([[16, height - 22], [16, height - 16], [end, height - 16], [end, height - 22]]);
    pen.textAlign = "left";
    write(sayLength(length), 16, height - 32);
    if (painted) {
      const top = 44, tall = Math.min(180, height / 2 - 90), bar = pen.createLinearGradient(0, top + tall, 0, top);
      painted.colors.forEach((color, n) => bar.addColorStop(n / 6, color));
      pen.fillStyle = bar;
      pen.fillRect(16, top, 16, tall);
      pen.lineWidth = 1;
      pen.strokeStyle = ink;
      pen.strokeRect(16, top, 16, tall);
      write(`${nameOf(painted)}, mm`, 16, 24);
      painted.ticks.forEach((tick, n) => write(sayNumber(tick), 38, top + tall * (1 - n / 4)));
    }
    if (slices) {
      const [x, y] = project(minus(slices.place(), facts.low));
      line([[x - 9, y], [x + 9, y]]);
      line([[x, y - 9], [x, y + 9]]);
    }
    for (const measure of [...measures, { points: picks }]) {
      const points = measure.points.map(project);
      line(points);
      for (const [x, y] of points) line([[x - 4, y], [x + 4, y], [x, y], [x, y - 4], [x, y + 4]]);
      if (measure.points === picks) continue;
      const [x, y] = points.length === 3 ? points[1] : [0, 1].map((axis) => (points[0][axis] + points[1][axis]) / 2);
      write(measureText(measure), x + 8, y - 12);
    }
  }

  // The panel.

  function choose(name) {
    tool = tool === name ? "" : name;
    picks = [];
    for (const id of ["distance", "angle"]) find(id).setAttribute("aria-pressed", String(tool === id));
    scene.classList.toggle("picks", tool !== "");
    find("hint").textContent = { distance: "Click two points.", angle: "Click three points." }[tool] || "";
    redraw();
  }

  function click(x, y) {
    if (!tool && !slices && !painted) return;
    const found = pickAt(x, y);
    if (found && slices) slices.moveTo(toPatient(found.point));
    if (!tool && !painted) return;
    if (!found) {
      find("hint").textContent = "There is no surface.";
      return;
    }
    if (tool) picks.push(found.point);
    const place = sayPlace(inSpace(toPatient(found.point)));
    const number = !painted ? "" : `, ${nameOf(painted)} ${found.number === null ? "not known" : `${sayNumber(found.number)} mm`}`;
    find("hint").textContent = `${parts[found.part].name}: ${facts.space} (${place}) mm${number}`;
    if (picks.length === { distance: 2, angle: 3 }[tool]) {
      measures.push({ kind: tool, points: picks });
      picks = [];
      listMeasures();
    }
    redraw();
  }

  function listMeasures() {
    find("measures").replaceChildren(...measures.map((measure) => {
      const row = element("li", `${measure.kind} ${measureText(measure)}`);
      const drop = element("button", "\u00d7", { type: "button", title: "remove this measure" });
      drop.onclick = () => { measures = measures.filter((other) => other !== measure); listMeasures(); redraw(); };
      row.append(drop);
      return row;
    }));
  }

  function listParts() {
    find("parts").replaceChildren(...parts.map((part) => {
      const row = element("li"), name = element("span", part.name, { className: "name" });
      const input = (type, label, more) => element("input", "", { type, ariaLabel: `${label} ${part.name}`, ...more });
      const shown = input("checkbox", "show", { checked: part.shown });
      const color = input("color", "colour of", { value: part.color });
      const opacity = input("range", "opacity of", { min: 0, max: 1, step: 0.05, value: part.opacity, title: "opacity" });
      shown.onchange = () => { part.shown = shown.checked; redraw(); };
      color.oninput = () => { part.color = color.value; redraw(); };
      opacity.oninput = () => { part.opacity = Number(opacity.value); redraw(); };
      row.append(shown, color, name, element("span", sayMl(part.ml), { className: "ml" }), opacity);
      return row;
    }));
  }

  function setClip() {
    clip.direction = find("clip").value;
    if (clip.direction === "view") clip.along = camera.turn[2];
    else clip.along = [0, 1, 2].map((axis) => Number(String(axis) === clip.direction));
    redraw();
  }

  function showAll(shown) {
    for (const part of parts) part.shown = shown;
    listParts();
    redraw();
  }

  for (const [letter, name] of Object.entries(VIEW_NAMES)) {
    const button = element("button", letter, { type: "button", title: name, ariaLabel: `view from ${name}` });
    button.onclick = () => look(letter);
    find("views").append(button);
  }
  for (const id of ["distance", "angle"]) find(id).onclick = () => choose(id);
  find("clear").onclick = () => { measures = []; picks = []; listMeasures(); redraw(); };
  find("clip").onchange = setClip;
  find("flip").onclick = () => { clip.flipped = !clip.flipped; redraw(); };
  find("depth").oninput = () => { clip.share = Number(find("depth").value); redraw(); };
  find("all").onclick = () => showAll(true);
  find("none").onclick = () => showAll(false);
  for (const column of facts.values || []) find("paint").append(element("option", nameOf(column), { value: column.name }));
  find("paint").onchange = () => choosePaint(find("paint").value);
  find("numbers").hidden = !facts.values;
  listParts();
  find("about").replaceChildren(...facts.about.map((text) => element("p", text)));

  // Mouse, touch, keys: one finger turns, two move and zoom.

  const fingers = new Map();
  let moved = 0, last = 0;

  function turnBy(x, y) {
    const [right, up, back] = camera.turn, size = Math.hypot(x, y) / 150;
    if (!size) return;
    camera.fits = "";
    // About the axis across the drag: the point that faces the viewer goes along with the finger.
    const way = [x, -y].map((value) => value / Math.hypot(x, y));
    const along = [0, 1, 2].map((axis) => way[0] * right[axis] + way[1] * up[axis]);
    const axis = cross(back, along), cosine = Math.cos(-size), sine = Math.sin(-size);
    const turned = (row) => {
      const side = cross(axis, row), rest = dot(axis, row) * (1 - cosine);
      return row.map((value, n) => value * cosine + side[n] * sine + axis[n] * rest);
    };
    const newBack = unit(turned(back)), newRight = unit(cross(turned(up), newBack));
    camera.turn = [newRight, cross(newBack, newRight), newBack];
  }

  function moveBy(x, y) {
    const [right, up] = camera.turn, mm = camera.mm;
    camera.fits = "";
    camera.centre = camera.centre.map((value, n) => value - x * mm * right[n] + y * mm * up[n]);
  }

  function zoomBy(factor, x, y) {
    const away = [x - scene.clientWidth / 2, y - scene.clientHeight / 2];
    moveBy(-away[0], -away[1]);
    camera.mm = Math.min(Math.max(camera.mm * factor, 1e-4), 10 * reach);
    moveBy(away[0], away[1]);
    redraw();
  }

  scene.addEventListener("pointerdown", (event) => {
    scene.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    moved = fingers.size > 1 ? Infinity : 0;
    last = 0;
  });
  scene.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.offsetX, event.offsetY], x = now[0] - before[0], y = now[1] - before[1];
    moved += Math.hypot(x, y);
    if (moved < 4) return;
    if (fingers.size > 1) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const apart = (finger) => Math.max(Math.hypot(finger[0] - other[0], finger[1] - other[1]), 1);
      moveBy(x / 2, y / 2);
      zoomBy(apart(before) / apart(now), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    } else if (event.shiftKey || event.buttons & 6) moveBy(x, y);
    else turnBy(x, y);
    fingers.set(event.pointerId, now);
    if (!asked) {  // half the pixels each way where frames are slow
      requestAnimationFrame((time) => { coarse = coarse || (last > 0 && time - last > 80); last = time; });
    }
    redraw();
  });
  for (const name of ["pointerup", "pointercancel"]) {
    scene.addEventListener(name, (event) => {
      fingers.delete(event.pointerId);
      if (name === "pointerup" && moved < 4 && event.button === 0) click(event.offsetX, event.offsetY);
      coarse = coarse && fingers.size > 0;
      redraw();
    });
  }
  scene.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY / 500))), event.offsetX, event.offsetY);
  }, { passive: false });
  scene.addEventListener("contextmenu", (event) => event.preventDefault());
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(SELECT|INPUT)$/.test(event.target.tagName)) return;
    const view = Object.keys(VIEWS)[Number(event.key) - 1];
    if (view) look(view);
    else if (event.key === "d") choose("distance");
    else if (event.key === "a") choose("angle");
    else if (event.key === "Escape") choose("");
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

  try {
    const decoded = decode(await unpack("surface")), { place, normal, index } = decoded;
    columns = decoded.columns;
    shade = link(SHADE);
    pick = link(PICK);
    for (const [slot, kind, values, isUnit] of [[0, gl.UNSIGNED_SHORT, place, false], [1, gl.BYTE, normal, true]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(slot);
      gl.vertexAttribPointer(slot, 3, kind, isUnit, 4 * values.BYTES_PER_ELEMENT, 0);
    }
    if (facts.values) {
      numberBuffer = gl.createBuffer();
      choosePaint(find("paint").value = facts.values[0].name);
      gl.enableVertexAttribArray(2);
      gl.vertexAttribPointer(2, 2, gl.FLOAT, false, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, index, gl.STATIC_DRAW);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    pickTarget = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, pickTarget);
    for (const [slot, format] of [[gl.COLOR_ATTACHMENT0, gl.RGBA32UI], [gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24]]) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, gl.createRenderbuffer());
      gl.renderbufferStorage(gl.RENDERBUFFER, format, 1, 1);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, slot, gl.RENDERBUFFER, gl.getParameter(gl.RENDERBUFFER_BINDING));
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    message.hidden = true;
    look("A");
    draw();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));  // waits until it is drawn
    new ResizeObserver(() => (camera.fits ? look(camera.fits) : redraw())).observe(scene);
    const toBox = (point) => minus(point, facts.low);
    window.clrecon = Object.freeze({
      facts, look, pick: (x, y) => { const found = pickAt(x, y); return found && { ...found, point: toPatient(found.point) }; },
      project: (point) => project(toBox(point)),
    });
    if (facts.slices) slices = await openSlices(facts, unpack, inSpace, redraw);
    redraw();
    document.documentElement.dataset.ready = Math.round(performance.now());
  } catch (error) {
    message.hidden = false;
    message.textContent = `The surface cannot be shown: ${error.message}`;
    throw error;
  }
})();
