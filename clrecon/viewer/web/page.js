(() => {
  const SLICES = ["axial", "coronal", "sagittal"];
  const TOOLS = { distance: "distance", angle: "angle", trace: "curve", seed: "seed", only: "only", hide: "hide" };
  const SVG = "http://www.w3.org/2000/svg";

  // Axis of the patient across each slice, and the colour of its plane.
  const ACROSS = { sagittal: 0, coronal: 1, axial: 2 };
  const CROSS_PIXELS = 11, GAP = 7;

  let fixed = null, facts = null, choosing = "", chosen = "", curveOff = false, pictures = 0, asked = false, held = 0;
  const message = find("message");

  // The connection: commands as JSON, pictures and facts back.

  const socket = new WebSocket(`ws://${location.host}/socket${location.search}`);
  socket.binaryType = "arraybuffer";
  const tell = (what) => { if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(what)); };
  const run = (name, more) => tell({ do: name, ...more });
  socket.onopen = () => { message.textContent = "Building kernels: the first picture takes seconds."; layOut(); };
  socket.onclose = (event) => {
    const reason = { 1001: "clrecon has ended", 1006: "the connection was lost: is clrecon still running?" };
    message.textContent = `No more pictures: ${event.reason || reason[event.code] || event.code}.`;
    document.documentElement.dataset.closed = event.code;
  };
  socket.onmessage = ({ data }) => {
    if (data instanceof ArrayBuffer) { showPicture(data); return; }
    const told = JSON.parse(data);
    if (told.fixed) takeFixed(told.fixed);
    if (told.facts) takeFacts(told.facts);
    if (told.error !== undefined) hint(told.error, true);
    if (told.pick !== undefined) picked(told.pick);
    if (told.undone !== undefined) hint(told.undone ? `Taken back: ${told.undone}.` : "There is nothing to take back.");
    if (told.saved) fetchSaved(told.saved);
    if (told.written !== undefined) find("saved").textContent = told.written;
  };

  function hint(text, wrong = false) {
    find("hint").textContent = text;
    find("hint").classList.toggle("wrong", wrong);
  }

  // Views: a canvas that gets pictures, and a drawing over it.

  const views = Object.fromEntries([...document.querySelectorAll(".view")].map((box) => {
    const canvas = element("canvas"), over = document.createElementNS(SVG, "svg");
    box.append(canvas, over);
    return [box.dataset.view, { name: box.dataset.view, box, canvas, over, pen: null, camera: null }];
  }));
  const isShown = (view) => !view.box.hidden && view.box.clientWidth > 0;

  function layOut() {
    find("stage").classList.toggle("alone", !find("sliced").checked || !facts || !facts.iso);
    find("stage").classList.toggle("curved", !views.curve.box.hidden);
    const sharp = Math.min(devicePixelRatio || 1, 2), sizes = {};
    for (const view of Object.values(views)) {
      if (!isShown(view)) continue;
      sizes[view.name] = [view.box.clientWidth, view.box.clientHeight].map((value) => Math.round(value * sharp));
    }
    const ground = getComputedStyle(document.body).backgroundColor.match(/\d+/g).slice(0, 3).map(Number);
    tell({ sizes, ground });
    for (const view of Object.values(views)) annotate(view);
  }

  async function showPicture(data) {
    const bytes = new Uint8Array(data), length = new DataView(data).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
    const view = views[head.view];
    try {
      const bitmap = await createImageBitmap(new Blob([bytes.subarray(4 + length)], { type: "image/jpeg" }));
      view.pen = view.pen || view.canvas.getContext("bitmaprenderer");
      view.pen.transferFromImageBitmap(bitmap);
      view.camera = head.camera;
    } finally {
      tell({ shown: head.number });
    }
    pictures += 1;
    message.textContent = "";
    annotate(view);
    const [width, height] = head.size;
    if (head.view === "scene") {
      find("status").textContent = [
        facts && facts.iso && `${facts.iso.hu.toFixed(0)} HU`, `${head.ms.toFixed(0)} ms`, `${width} × ${height}`,
        facts && facts.device, head.sharp ? "sharp" : "coarse", ...((facts && facts.busy) || []),
      ].filter(Boolean).join(" · ");
    }
    Object.assign(document.documentElement.dataset, { pictures, [head.view]: head.sharp ? "sharp" : "coarse" });
  }

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
    if (view.name !== "scene") write(view.name === "curve" ? "along the curve" : view.name, 10, 14, `name ${view.name}`, "start");
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
    write(sayLength(length) + (camera.parallel ? "" : " in the middle"), 14, low - 17, "side", "start");
    if (facts && facts.iso) annotateCross(view, segments, width, height);
    if (facts) annotateMeasures(view, line, write, width, height);
    view.over.replaceChildren(...drawn);
  }

  // Where the slices meet: in a slice the lines of the two others, in the picture a short line along each axis.
  function annotateCross(view, segments, width, height) {
    const [x, y] = project(view, facts.cross) || [];
    if (x === undefined) return;
    for (const [plane, axis] of Object.entries(ACROSS)) {
      if (view.name === "scene") {
        const mm = (facts.camera.height_mm / height) * CROSS_PIXELS;
        const ends = [-mm, mm].map((by) => project(view, facts.cross.map((value, at) => value + (at === axis ? by : 0))));
        if (ends.every(Boolean)) segments([ends], `cross ${plane}`);
      } else if (plane !== view.name) {
        const upright = Math.abs(view.camera.right[axis]) > Math.abs(view.camera.up[axis]);
        segments(upright ? [[[x, 0], [x, y - GAP]], [[x, y + GAP], [x, height]]]
          : [[[0, y], [x - GAP, y]], [[x + GAP, y], [width, y]]], `cross ${plane}`);
      }
    }
  }

  // Texts of measures stand in the nearer upper corner, with a thin line to what they belong to: bone stays free.
  function annotateMeasures(view, line, write, width, height) {
    const placed = { start: 0, end: 0 };
    const unfinished = facts.points.length ? [{ points: facts.points.map(({ point }) => point), text: "" }] : [];
    for (const measure of [...facts.measures, ...unfinished]) {
      const points = measure.points.map((point) => project(view, point)).filter(Boolean);
      if (points.length !== measure.points.length || !isNear(view, measure.points)) continue;
      for (const name of ["halo", "line"]) {
        if (points.length > 1) line(points, view.name === "scene" ? `${name} behind` : name);
        for (const [x, y] of points) { line([[x - 5, y], [x + 5, y]], name); line([[x, y - 5], [x, y + 5]], name); }
      }
      if (!measure.text) continue;
      const middle = points.length === 3 && measure.kind === "angle" ? points[1]
        : [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
      const side = middle[0] < width / 2 ? "start" : "end", x = side === "start" ? 12 : width - 12;
      const y = 18 + 20 * placed[side]++;
      line([[x + (side === "start" ? 1 : -1) * (4 + 8 * measure.text.length), y], middle], "lead");
      write(measure.text, x, y, "measure", side);
    }
    if (view.name !== "scene") return;
    for (const piece of facts.seen_lines) {  // what no bone hides
      const ends = piece.map((point) => project(view, point));
      if (ends.every(Boolean)) line(ends, "line seen");
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

  function zoomBy(view, factor, x, y) {
    const { clientWidth: width, clientHeight: height } = view.box, at = [(x - width / 2) / height, (y - height / 2) / height];
    gather("zoom", (old) => ({ do: "zoom", more: { factor: factor * (old ? old.more.factor : 1), at } }));
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

  function turnAt(view, x, y) {  // Ctrl and drag: about the middle of the picture
    const now = Math.atan2(y - view.box.clientHeight / 2, x - view.box.clientWidth / 2);
    const by = view.angle === undefined ? 0 : ((now - view.angle) * 180) / Math.PI;
    view.angle = now;
    const degrees = by > 180 ? by - 360 : by < -180 ? by + 360 : by;
    gather("roll", (old) => ({ do: "roll", more: { degrees: degrees + (old ? old.more.degrees : 0) } }));
  }

  for (const view of Object.values(views)) {
    const fingers = new Map(), slice = SLICES.includes(view.name);
    let moved = 0, steps = 0;
    const at = (event) => {
      const box = view.box.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    view.box.addEventListener("pointerdown", (event) => {
      view.box.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, at(event));
      moved = fingers.size > 1 ? Infinity : 0;
      steps = 0;
      last("hold", { on: true });
      delete view.angle;
    });
    view.box.addEventListener("pointermove", (event) => {
      view.pointer = at(event);
      const before = fingers.get(event.pointerId);
      if (!before || view.name === "curve") return;
      const now = at(event), x = now[0] - before[0], y = now[1] - before[1], height = view.box.clientHeight;
      moved += Math.hypot(x, y);
      if (moved < 4) return;
      if (slice) {
        if (event.buttons & 2 || fingers.size > 1) windowBy(x / fingers.size, y / fingers.size);
        else if (event.pointerType === "touch") {
          steps += y / 6;
          if (Math.trunc(steps)) scrollBy(view, Math.trunc(steps));
          steps -= Math.trunc(steps);
        } else if (!choosing) last("cross_at", pixel(view, now));
      } else if (fingers.size > 1) {
        const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
        const apart = (finger) => Math.max(Math.hypot(finger[0] - other[0], finger[1] - other[1]), 1);
        sumUp("pan", x / 2 / height, y / 2 / height);
        zoomBy(view, apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      } else if (event.ctrlKey && event.shiftKey) {
        zoomBy(view, 6 ** (-y / height), view.box.clientWidth / 2, height / 2);
      } else if (event.ctrlKey) turnAt(view, ...now);
      else if (event.shiftKey || event.buttons & 6) sumUp("pan", x / height, y / height);
      else sumUp("turn", x / height, y / height);
      fingers.set(event.pointerId, now);
    });
    for (const name of ["pointerup", "pointercancel"]) {
      view.box.addEventListener(name, (event) => {
        fingers.delete(event.pointerId);
        if (!fingers.size) last("hold", { on: false }, "release");
        if (name === "pointerup" && moved < 4 && event.button === 0) click(view, at(event), event.shiftKey);
      });
    }
    view.box.addEventListener("pointerleave", () => { view.pointer = null; });
    view.box.addEventListener("wheel", (event) => {
      event.preventDefault();
      const by = Math.max(-1, Math.min(1, event.deltaY / 100));
      if (slice) {
        steps += by;
        if (Math.trunc(steps)) scrollBy(view, Math.trunc(steps));
        steps -= Math.trunc(steps);
      } else if (view.name === "scene") zoomBy(view, Math.exp(-0.2 * by), ...at(event));
    }, { passive: false });
    view.box.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  // Tools.

  // A place in a picture, as the commands that look there take it.
  function pixel(view, [x, y]) {
    const size = [view.box.clientWidth, view.box.clientHeight];
    const [inX, inY] = [x, y].map((value, axis) => Math.min(Math.max(value, 0), size[axis]));
    return { x: inX, y: inY, size, plane: view.name === "scene" ? null : view.name };
  }

  function click(view, place, asks) {
    if (view.name === "curve" || (!choosing && !asks && view.name === "scene")) return;
    const use = { "": "cross_at", only: "only_at", hide: "hide_at" }[choosing] || "add_point";
    run(asks ? "cross_at" : use, pixel(view, place));
  }

  function picked(pick) {
    if (!pick) { hint("Nothing is shown there.", true); return; }
    if (pick.part) choosePart(pick.part);
    hint(pick.words);
    if (choosing === "only") choose("");
  }

  function choosePart(key) {
    chosen = key;
    for (const row of find("parts").children) row.classList.toggle("chosen", row.dataset.key === key);
  }

  // The parts tools live in the page; the others are the model's, whose facts say which one is used.
  function choose(name) {
    const before = choosing;
    choosing = name;
    if (name && !["only", "hide"].includes(name)) run("start_tool", { name });
    else if (before && !["only", "hide"].includes(before)) run("end_tool");
    hint(fixed.hints[name] || "");
    showTools();
  }

  function showTools() {
    for (const [id, name] of Object.entries(TOOLS)) find(id).setAttribute("aria-pressed", String(choosing === name));
    find("end").hidden = !choosing;
    for (const view of Object.values(views)) view.box.classList.toggle("picks", choosing !== "");
  }

  // What does not change while the page is open: formats, windows, keys.

  function takeFixed(now) {
    fixed = now;
    const kinds = now.save_as.length ? { "--save-as": [""], ...now.formats } : now.formats;
    find("format").replaceChildren(...Object.entries(kinds).map(([kind, endings]) => {
      const group = element("optgroup", "", { label: kind });
      group.append(...endings.map((ending) => element("option", ending || now.save_as.join(", "), { value: ending })));
      return group;
    }));
    find("presets").replaceChildren(...Object.entries(now.windows).map(([name, [low, high]]) => {
      const button = element("button", name, { type: "button", title: `level ${(low + high) / 2}, width ${high - low}` });
      button.onclick = () => run("set_window", { low, high });
      return button;
    }));
    find("keylist").replaceChildren(...Object.entries(now.help).map(([title, rows]) => {
      const body = element("tbody");
      body.append(element("th", title, { colSpan: 2 }), ...rows.map((cells) => {
        const row = element("tr");
        row.append(...cells.map((words) => element("td", words)));
        return row;
      }));
      return body;
    }));
  }

  // Facts: what the panels show.

  function takeFacts(now) {
    const before = facts;
    facts = now;
    const told = (name) => !before || JSON.stringify(before[name]) !== JSON.stringify(now[name]);
    if (now.tool !== choosing && !["only", "hide"].includes(choosing)) choosing = now.tool || "";
    for (const id of ["iso", "tabled", "slicing", "windows"]) find(id).hidden = !now.iso;
    find("mode").hidden = now.modes.length < 2;
    if (told("iso") && now.iso) showIso();
    if (told("modes")) {
      find("mode").replaceChildren(...now.modes.map(({ name, words }) => element("option", `${name}: ${words}`, { value: name })));
    }
    find("mode").value = now.mode;
    find("table").checked = now.table;
    find("perspective").checked = !now.camera.parallel;
    find("undo").disabled = !now.undo;
    find("undo").title = now.undo ? `take back ${now.undo} (u)` : "nothing to take back (u)";
    if (told("window")) showWindow();
    if (told("parts") && !held) showParts();
    const clusters = now.parts.filter(({ kind }) => kind === "cluster");
    find("colors").hidden = !clusters.length;
    find("colors").setAttribute("aria-pressed", String(clusters.some(({ color }) => color)));
    if (told("measures")) showMeasures();
    if ((told("clips") || told("clip_box")) && !held) showClips();
    if (told("notes") || told("objects") || told("warnings")) showAbout();
    if (told("said") && now.said) hint(now.said);
    showTools();
    const curves = (all) => all.measures.filter(({ kind }) => kind === "curve").length;
    if (before && curves(now) > curves(before)) curveOff = false;
    const curved = Boolean(now.iso && (curves(now) || (now.tool === "curve" && now.points.length > 1)));
    find("curved").hidden = !curved;
    find("along").checked = !curveOff;
    if (views.curve.box.hidden === (curved && !curveOff) || !before) {
      views.curve.box.hidden = !curved || curveOff;
      layOut();
    }
    for (const view of Object.values(views)) annotate(view);
    if (now.busy.length && !pictures) message.textContent = now.busy.join(", ");
  }

  function showIso() {
    for (const id of ["hu", "exact"]) {
      const input = find(id);
      if (held === input || document.activeElement === find("exact") && id === "exact") continue;
      Object.assign(input, { min: Math.ceil(facts.iso.low), max: Math.floor(facts.iso.high), value: Math.round(facts.iso.hu) });
    }
    const { low, high } = facts.iso, step = roundLength((high - low) / 5), marks = [];
    for (let hu = Math.ceil(low / step) * step; hu <= high; hu += step) marks.push(hu);
    find("marks").replaceChildren(...marks.map((hu) => {
      const mark = element("span", String(hu).replace("-", "\u2212"));
      mark.style.left = `calc(8px + ${(hu - low) / (high - low)} * (100% - 16px))`;
      return mark;
    }));
  }

  function showWindow() {
    const [low, high] = facts.window;
    for (const [id, value] of [["level", (low + high) / 2], ["width", high - low]]) {
      if (document.activeElement !== find(id)) find(id).value = Math.round(value);
    }
  }

  // An input that is dragged keeps its value until it is let go, whatever comes back meanwhile.
  function hold(input, changed) {
    input.addEventListener("pointerdown", () => { held = input; });
    for (const name of ["pointerup", "pointercancel", "blur"]) {
      input.addEventListener(name, () => {
        if (held !== input) return;
        held = 0;
        if (facts) { showParts(); showClips(); }
      });
    }
    input.addEventListener("input", () => changed(input));
    return input;
  }

  const hexadecimal = (color) => `#${color.map((value) => Math.round(255 * value).toString(16).padStart(2, "0")).join("")}`;
  const channels = (color) => [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16) / 255);

  // Ml of what is enclosed, else how many points or triangles there are.
  function saySize({ ml, count }) {
    if (ml !== null || count === null) return sayMl(ml);
    return count < 1e5 ? count.toLocaleString("en") : `${(count / 1e6).toFixed(2)} M`;
  }

  function showParts() {
    find("parts").replaceChildren(...facts.parts.map((part) => {
      const row = element("li", "", { className: ["cluster", "label", "rest"].includes(part.kind) ? "" : "whole" });
      row.dataset.key = part.key;
      row.classList.toggle("chosen", part.key === chosen);
      const input = (type, label, more) => element("input", "", { type, ariaLabel: `${label} ${part.name}`, ...more });
      const shown = input("checkbox", "show", { checked: part.visible });
      const color = input("color", "colour of", { value: hexadecimal(part.color || [0.9, 0.86, 0.78]), disabled: part.kind === "rest" });
      const opacity = input("range", "opacity of", { min: 0, max: 1, step: 0.05, value: part.opacity, title: "opacity" });
      const alone = element("button", "only", { type: "button", title: `show ${part.name} alone` });
      shown.onchange = () => run("show", { key: part.key, visible: shown.checked });
      hold(color, () => last("set_color", { key: part.key, rgb: channels(color.value) }, `color ${part.key}`));
      hold(opacity, () => last("set_opacity", { key: part.key, value: Number(opacity.value) }, `opacity ${part.key}`));
      const name = element("span", part.name, { className: "name" });
      const plain = element("button", "plain", { type: "button", title: `${part.name} as it looks by itself` });
      alone.onclick = () => run("only", { key: part.key });
      name.onclick = () => choosePart(chosen === part.key ? "" : part.key);
      plain.onclick = () => run("set_color", { key: part.key, rgb: null });
      plain.hidden = !part.color;
      row.append(shown, color, name, element("span", saySize(part), { className: "ml" }), alone, opacity, plain);
      return row;
    }));
  }

  function showMeasures() {
    find("clear").hidden = !facts.measures.length;
    find("measures").replaceChildren(...facts.measures.map(({ kind, text }) => element("li", `${kind === "seed" ? "place" : kind} ${text}`)));
  }

  function showClips() {
    find("clips").replaceChildren(...facts.clips.map((clip, n) => {
      const row = element("li");
      const place = element("input", "", { type: "range", min: 0, max: 1, step: 0.001, value: clip.share, ariaLabel: `place of clip plane ${n + 1}` });
      const flip = element("button", "other side", { type: "button" }), drop = element("button", "×", { type: "button", title: "remove this plane" });
      hold(place, () => last("move_clip", { n, share: Number(place.value) }, `clip ${n}`));
      flip.onclick = () => run("flip_clip", { n });
      drop.onclick = () => run("remove_clip", { n });
      row.append(element("span", clip.words), flip, drop, place);
      return row;
    }));
    const box = facts.clip_box, ends = facts.bounds;
    find("boxed").setAttribute("aria-pressed", String(Boolean(box)));
    find("box").hidden = !box;
    find("box").replaceChildren(...(box ? ["right, left", "front, back", "feet, head"].flatMap((words, axis) => [
      element("span", words),
      ...[0, 1].map((which) => {
        const input = element("input", "", { type: "range", min: ends[0][axis], max: ends[1][axis], step: 0.5,
          ariaLabel: `box, ${words.split(", ")[which]}`, value: box[which][axis] });
        return hold(input, () => {
          const made = facts.clip_box.map((corner) => [...corner]);
          made[which][axis] = Number(input.value);
          if (made[0][axis] >= made[1][axis]) return;
          facts.clip_box = made;
          last("set_clip_box", { low: made[0], high: made[1] });
        });
      }),
    ]) : []));
  }

  function showAbout() {
    const lines = facts.objects.flatMap(({ name, said }) => [name, ...said]);
    find("about").replaceChildren(...[...facts.notes, ...lines, ...facts.warnings.filter((text) => !lines.includes(text)),
      "Not a medical device."].map((text) => element("p", text)));
  }

  // Saving: the file is made by the program and then fetched by its ticket.

  function save(format) {
    find("saved").textContent = "The file is being made.";
    tell({ save: format || null, size: [views.scene.box.clientWidth, views.scene.box.clientHeight].map((value) => 2 * value) });
  }

  function fetchSaved({ ticket, name, bytes }) {
    find("saved").textContent = `${name}, ${(bytes / 1e6).toFixed(bytes < 1e5 ? 3 : 1)} MB`;
    const link = element("a", "", { href: `/saved/${ticket}`, download: name });
    document.body.append(link);
    link.click();
    link.remove();
  }

  // Buttons and keys.

  const look = (letter) => run("look", { view: VIEW_NAMES[letter] });
  for (const [letter, name] of Object.entries(VIEW_NAMES)) {
    const button = element("button", letter, { type: "button", title: name, ariaLabel: `view from ${name}` });
    button.onclick = () => look(letter);
    find("views").append(button);
  }
  for (const [id, name] of Object.entries(TOOLS)) find(id).onclick = () => choose(choosing === name ? "" : name);
  hold(find("hu"), () => {
    find("exact").value = find("hu").value;
    last("set_iso", { hu: Number(find("hu").value) });
  });
  find("exact").onchange = () => {
    const hu = Number(find("exact").value), { low, high } = facts.iso;
    if (find("exact").value !== "" && hu >= low && hu <= high) find("hu").value = hu;
    else find("exact").value = find("hu").value;
    if (hu >= low && hu <= high) last("set_iso", { hu: Number(find("hu").value) });
    else hint(`The iso value runs from ${low} to ${high} HU here.`, true);
  };
  const setWindow = () => {
    if (find("level").value === "" || find("width").value === "") { document.activeElement.blur(); showWindow(); return; }
    const level = Number(find("level").value), half = Math.max(1, Number(find("width").value)) / 2;
    run("set_window", { low: level - half, high: level + half });
  };
  find("level").onchange = find("width").onchange = setWindow;
  find("mode").onchange = () => run("set_mode", { name: find("mode").value });
  find("table").onchange = () => run("set_table", { shown: find("table").checked });
  find("perspective").onchange = () => run("set_perspective", { on: find("perspective").checked });
  find("iso").addEventListener("wheel", (event) => {
    event.preventDefault();
    const by = -Math.sign(event.deltaY) * fixed.iso_step;
    gather("step_iso", (old) => ({ do: "step_iso", more: { by: by + (old ? old.more.by : 0) } }));
  }, { passive: false });
  find("sliced").onchange = layOut;
  find("end").onclick = () => choose("");
  find("along").onchange = () => { curveOff = !find("along").checked; takeFacts(facts); };
  find("clear").onclick = () => run("clear_measures");
  find("all").onclick = () => run("show_all");
  find("colors").onclick = () => run("toggle_colors");
  find("cut").onclick = () => run("add_clip", { direction: find("direction").value });
  find("boxed").onclick = () => run("toggle_clip_box");
  find("save").onclick = () => save(find("format").value);
  find("photo").onclick = () => save(".png");
  find("undo").onclick = () => run("undo");
  find("help").onclick = () => find("keys").showModal();
  find("closekeys").onclick = () => find("keys").close();

  // What the page does itself at a key; what else keys do are commands of the session.
  const press = (id) => () => { if (!find(id).hidden) find(id).click(); };
  const OWN = {
    distance: press("distance"), angle: press("angle"), save: press("save"), photo: press("photo"), help: press("help"),
    curve: () => { if (choosing === "curve" || find("curved").hidden) find("trace").click(); else find("along").click(); },
    escape: () => { if (choosing) choose(""); else { run("cancel"); run("dismiss"); hint(""); } },
    quit: () => tell({ quit: true }),
  };

  // A command for what lies under the pointer; elsewhere what is like it for the part that was chosen in the list.
  function runAtPointer(name) {
    const view = Object.values(views).find(({ pointer }) => pointer);
    if (view && view.name !== "curve") run(name, pixel(view, view.pointer));
    else if (chosen && name === "hide_at") run("show", { key: chosen, visible: false });
    else if (chosen && name === "only_at") run("only", { key: chosen });
    else if (name === "mark_at") find("seed").click();
    else hint("Point at a picture first.");
  }

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !facts || find("keys").open) return;
    const { tagName, type } = event.target, isRange = type === "range";
    if (/^(SELECT|INPUT)$/.test(tagName) && !isRange && type !== "checkbox") return;
    if (isRange && event.key.startsWith("Arrow")) return;
    const does = fixed.keys[event.key];
    if (does === undefined) return;
    if (typeof does === "string") OWN[does]();
    else if (fixed.at_pointer.includes(event.key)) runAtPointer(does.do);
    else tell(does);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", layOut);
  new ResizeObserver(layOut).observe(find("stage"));

  window.clrecon = Object.freeze({
    get facts() { return facts; }, project: (name, point) => project(views[name], point), run, get pictures() { return pictures; },
  });
})();
