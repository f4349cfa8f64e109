  const SLICES = ["axial", "coronal", "sagittal"];
  const TOOLS = { distance: "distance", angle: "angle", trace: "curve", circle: "circle", square: "box", seed: "seed", only: "only", hide: "hide" };
  const SVG = "http://www.w3.org/2000/svg";

  const CROSS_PIXELS = 11, GAP = 7, INSET = 32;  // of the cross in the picture, around its middle, of its ends from the border
  const TURN_DEGREES = 5;  // of the cross by a key

  let fixed = null, facts = null, choosing = "", chosen = "", curveOff = false, pictures = 0, asked = false, held = 0, pictured = false;
  let full = "", probed = null, seen = null;
  const message = find("message");

  // The connection: commands as JSON, pictures and facts back.

  const tab = sessionStorage.getItem("clrecon-tab") || crypto.randomUUID();  // a reload goes on with its view
  sessionStorage.setItem("clrecon-tab", tab);
  const socket = new WebSocket(`ws://${location.host}/socket${location.search}&tab=${tab}`);
  socket.binaryType = "arraybuffer";
  const tell = (type, what) => { if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ type, ...what })); };
  const run = (name, more) => tell("command", { do: name, ...more });
  socket.onopen = () => { message.textContent = "Building kernels: the first picture takes seconds."; };
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
    if (told.probe) { probed = told.probe; for (const view of Object.values(views)) if (view.pointer) annotate(view); }
    if (told.undone !== undefined) hint(told.undone ? `Taken back: ${told.undone}.` : "There is nothing to take back.");
    if (told.link !== undefined) copyLink(told.link);
    if (told.thumbnail) showThumbnail(told.thumbnail);
    if (told.saved) fetchSaved(told.saved);
    if (told.written !== undefined) find("saved").textContent = told.written;
  };

  function hint(text, wrong = false) {
    find("hint").textContent = find("hint").title = text;
    find("hint").classList.toggle("wrong", wrong);
  }

  // Views: a canvas that gets pictures, and a drawing over it.

  const views = Object.fromEntries([...document.querySelectorAll(".view")].map((box) => {
    const canvas = element("canvas"), over = document.createElementNS(SVG, "svg");
    const icon = document.createElementNS(SVG, "svg"), path = document.createElementNS(SVG, "path");
    const enlarge = element("button", "", { type: "button", className: "enlarge", title: "full size, or all views again (z)",
      ariaLabel: `${box.dataset.view} at full size`, onclick: () => setFull(box.dataset.view) });
    path.setAttribute("d", "M9 2h5v5M14 2 9 7M7 14H2V9M2 14l5-5");
    icon.setAttribute("viewBox", "0 0 16 16");
    icon.append(path);
    enlarge.append(icon);
    box.append(canvas, over, enlarge);
    const name = box.dataset.view, tab = element("button", name === "scene" ? "3D" : name, { type: "button", onclick: () => setFull(name) });
    find("tabs").append(tab);
    return [name, { name, box, canvas, over, enlarge, tab, pen: null, camera: null }];
  }));
  const phone = matchMedia("(max-width: 640px)");  // one view at a time, chosen by its tab
  phone.onchange = () => { full = ""; layOut(); };
  const narrow = matchMedia("(max-width: 900px)");  // of the panel one section at a time, none at first
  const fold = () => { for (const section of document.querySelectorAll("details")) Object.assign(section, { open: !narrow.matches, name: narrow.matches ? "sheet" : "" }); };
  narrow.onchange = fold;
  find("iso").ontoggle = () => { if (facts && facts.iso) showIso(); };  // as many marks as there is room for
  fold();
  const isShown = (view) => !view.box.hidden && view.box.clientWidth > 0;

  // One view takes the place of all, or gives it back.
  function setFull(name) {
    full = full && !phone.matches ? "" : name;
    for (const view of Object.values(views)) view.pointer = null;  // it lies elsewhere in them now
    layOut();
  }

  function layOut() {
    const alone = !facts || !facts.iso || (facts.layout === "1" && !phone.matches);
    if (full && (views[full].box.hidden || (alone && SLICES.includes(full)))) full = "";
    if (phone.matches && !full) full = "scene";
    find("tabs").hidden = alone;
    find("stage").classList.toggle("alone", alone);
    find("stage").classList.toggle("four", !alone && facts.layout === "4");
    find("stage").classList.toggle("full", full !== "");
    for (const { name, box, enlarge, tab } of Object.values(views)) {
      box.classList.toggle("large", name === full);
      for (const button of [enlarge, tab]) button.setAttribute("aria-pressed", String(name === full));
      tab.hidden = box.hidden;
    }
    find("stage").classList.toggle("curved", !views.curve.box.hidden);
    const sharp = Math.min(devicePixelRatio || 1, 2), sizes = {};
    for (const view of Object.values(views)) {
      if (!isShown(view)) continue;
      sizes[view.name] = [view.box.clientWidth, view.box.clientHeight].map((value) => Math.round(value * sharp));
    }
    const ground = getComputedStyle(document.body).backgroundColor.match(/\d+/g).slice(0, 3).map(Number);
    tell("layout", { sizes, ground });
    if (facts && facts.iso) showIso();  // as many marks as there is room for
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
      tell("shown", { number: head.number });
    }
    pictures += 1;
    message.textContent = "";
    annotate(view);
    probe(view);
    if (head.view === "scene") {
      seen = head;
      showStatus();
    }
    Object.assign(document.documentElement.dataset, { pictures, [head.view]: head.sharp ? "sharp" : "coarse" });
  }

  function showStatus() {
    if (!facts || !seen) return;
    const { size: [width, height], ms, sharp } = seen;
    find("status").textContent = [
      facts.iso && `${facts.iso.hu.toFixed(0)} HU`, `${ms.toFixed(0)} ms`, `${width} × ${height}`, facts.device,
      sharp ? "sharp" : "coarse", ...facts.busy,
    ].filter(Boolean).join(" · ");
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
    find("end").setAttribute("aria-pressed", String(!choosing));
    for (const view of Object.values(views)) view.box.classList.toggle("picks", choosing !== "");
  }

  // What does not change while the page is open: formats, windows, keys.

  function takeFixed(now) {
    fixed = now;
    find("another").hidden = !now.has_start;
    showScans();
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

  // The scan, without the name of a patient: its size, a chip for its gates that opens the certificate, its histogram.
  function showScans() {
    const [scan, ...more] = fixed.scans;
    if (!scan) return;
    find("title").textContent = [scan.words, scan.position, more.length && `and ${more.length} more`].filter(Boolean).join(" \u00b7 ");
    const [passed, judged] = scan.gates, words = passed === judged ? `geometry: ${judged} gates passed` : `${judged - passed} of ${judged} gates failed`;
    const chip = element("button", words, { type: "button", className: passed === judged ? "good" : "wrong",
      title: "the certificate of the scan", onclick: () => find("certificate").showModal() });
    find("chips").replaceChildren(...(judged ? [chip] : []), find("offset"));
    find("certificate").firstElementChild.replaceChildren(...fixed.scans.flatMap(({ name, certificate }) => [
      element("h2", name), ...certificate.map((line) => element("p", line)),
    ]));
    const most = Math.log(1 + Math.max(...scan.counts)), path = document.createElementNS(SVG, "path");
    const tops = scan.counts.map((count, n) => `V${1 - Math.log(1 + count) / most}H${n + 1}`);
    path.setAttribute("d", `M0 1${tops.join("")}V1z`);
    find("counts").setAttribute("viewBox", `0 0 ${scan.counts.length} 1`);
    find("counts").replaceChildren(path);
  }

  // Facts: what the panels show.

  // What changed of them; at first all.
  function takeFacts(changed) {
    const before = facts, now = facts = { ...before, ...changed }, told = (name) => name in changed;
    if (now.tool !== choosing && !["only", "hide"].includes(choosing)) choosing = now.tool || "";
    for (const id of ["iso", "tabled", "smoothed", "hollowed", "layouts", "spine", "windows"]) find(id).hidden = !now.iso;
    find("modes").hidden = find("modewords").hidden = now.modes.length < 2;
    if (told("iso") && now.iso) showIso();
    if (told("modes")) showModes();
    for (const button of find("modes").children) button.setAttribute("aria-pressed", String(button.dataset.mode === now.mode));
    const mode = now.modes.find(({ name }) => name === now.mode);
    find("modewords").textContent = mode.words;
    find("scene").classList.toggle("dark", mode.dark);
    if (now.settled && now.iso && now.modes.length > 1 && !pictured) {
      pictured = true;
      tell("thumbnails");
    }
    find("table").checked = now.table;
    find("smooth").checked = now.smooth_mm > 0;
    find("advice").hidden = !now.advice;
    if (now.advice) Object.assign(find("advice"), { textContent: now.advice.words, onclick: () => run(now.advice.do) });
    find("fitting").hidden = now.fitted === null;
    find("fitted").checked = Boolean(now.fitted);
    find("shade").hidden = !now.fitted;
    find("shade").value = now.color_by || "";
    find("perspective").checked = !now.camera.parallel;
    find("occlusion").checked = now.occlusion;
    find("compared").hidden = !now.comparable;
    find("compare").checked = now.compare !== null;
    find("divide").hidden = now.compare === null;
    if (held !== find("divide") && now.compare !== null) find("divide").value = now.compare;
    find("undo").disabled = !now.undo;
    find("undo").title = now.undo ? `take back ${now.undo} (u)` : "nothing to take back (u)";
    if (told("offset") || told("iso")) showOffset();
    if (told("window")) showWindow();
    if (told("slab")) showSlab();
    find("straighten").hidden = !now.turned;
    for (const button of find("layouts").children) button.setAttribute("aria-pressed", String(button.dataset.layout === now.layout));
    if (told("parts") && !held) showParts();
    const clusters = now.parts.filter(({ kind }) => kind === "cluster");
    find("colors").hidden = !clusters.length;
    find("colors").setAttribute("aria-pressed", String(clusters.some(({ color }) => color)));
    find("small").hidden = now.small_parts === null;
    find("small").setAttribute("aria-pressed", String(now.small_parts === false));
    if (told("measures")) showMeasures();
    if ((told("clips") || told("clip_box")) && !held) showClips();
    if (told("notes") || told("objects") || told("warnings")) showAbout();
    if (told("said") && now.said) hint(now.said);
    showTools();
    showStatus();
    const curves = (all) => all.measures.filter(({ kind }) => kind === "curve").length;
    if (before && curves(now) > curves(before)) curveOff = false;
    const curved = Boolean(now.iso && (curves(now) || (now.tool === "curve" && now.points.length > 1)));
    find("curved").hidden = !curved;
    find("along").checked = !curveOff;
    if (views.curve.box.hidden === (curved && !curveOff) || !before || told("layout")) {
      views.curve.box.hidden = !curved || curveOff;
      layOut();
    }
    for (const view of Object.values(views)) annotate(view);
    if (now.busy.length && !pictures) message.textContent = now.busy.join(", ");
  }

  function showModes() {
    find("modes").replaceChildren(...facts.modes.map(({ name, words }) => {
      const button = element("button", "", { type: "button", title: words, onclick: () => run("set_mode", { name }) });
      button.dataset.mode = name;
      button.append(element("div"), element("span", name));  // room for the thumbnail: nothing moves when it comes
      return button;
    }));
  }

  function showThumbnail({ mode, address }) {
    const button = [...find("modes").children].find(({ dataset }) => dataset.mode === mode);
    if (button) button.firstChild.replaceChildren(element("img", "", { src: address, alt: "" }));
  }

  function showIso() {
    for (const id of ["hu", "exact"]) {
      const input = find(id);
      if (held === input || document.activeElement === find("exact") && id === "exact") continue;
      Object.assign(input, { min: Math.ceil(facts.iso.low), max: Math.floor(facts.iso.high), value: Math.round(facts.iso.hu) });
    }
    const { low, high } = facts.iso, step = roundLength(2.5 * (high - low) / Math.max(1, find("marks").clientWidth / 38)), marks = [];
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

  function showSlab() {
    if (document.activeElement !== find("thick")) find("thick").value = Math.round(10 * facts.slab.mm) / 10;
    find("combine").value = facts.slab.combine;
    find("combine").disabled = !facts.slab.mm;
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
  function saySize({ ml, count, kind }) {
    if (ml !== null || count === null) return sayMl(ml);
    const number = count < 1e5 ? count.toLocaleString("en") : `${(count / 1e6).toFixed(2)} M`;
    return `${number} ${{ mesh: "triangles", cloud: "points" }[kind] || ""}`;
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
    const list = find("measures"), { measures } = facts;
    find("clear").hidden = find("exports").hidden = !measures.length;
    while (list.children.length > measures.length) list.lastChild.remove();
    while (list.children.length < measures.length) list.append(makeMeasureRow(list.children.length));
    measures.forEach((measure, n) => {
      const [name, text, drop] = list.children[n].children;
      if (document.activeElement !== name) name.value = measure.name;
      text.textContent = measure.text;
      text.title = measure.voxels ? `${measure.voxels} voxels, ${measure.area_mm2.toFixed(1)} mm²; slices go there` : "slices go there";
      name.ariaLabel = `name of ${measure.name}`;
      text.ariaLabel = `${measure.name}, ${measure.text}: slices go there`;
      drop.ariaLabel = `remove ${measure.name}`;
    });
  }

  // Rows stay where they are when facts come: the focus is not lost.
  function makeMeasureRow(n) {
    const row = element("li");
    const name = element("input", "", { type: "text", maxLength: 80, title: "name" });
    const text = element("button", "", { type: "button" });
    const drop = element("button", "×", { type: "button", title: "remove this measure" });
    name.onchange = () => {
      if (name.value.trim()) run("rename_measure", { n, name: name.value });
      else name.value = facts.measures[n].name;
    };
    name.onkeydown = ({ key }) => {
      if (key === "Escape") name.value = facts.measures[n].name;
      if (key === "Escape" || key === "Enter") name.blur();
    };
    text.onclick = () => {
      const { points, kind } = facts.measures[n];
      if (kind === "circle") { run("set_cross", { point: points[0] }); return; }
      run("set_cross", { point: [0, 1, 2].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length) });
    };
    drop.onclick = () => run("remove_measure", { n });
    row.append(name, text, drop);
    return row;
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
    if (!facts.iso) find("title").textContent = facts.objects.map(({ name }) => name).join(" \u00b7 ");
    find("about").replaceChildren(...[...facts.notes, ...lines, ...facts.warnings.filter((text) => !lines.includes(text))]
      .map((text) => element("p", text)));
  }

  // Saving: the file is made by the program and then fetched by its ticket.

  function save(format) {
    find("saved").textContent = "The file is being made.";
    tell("save", { format: format || null, size: [views.scene.box.clientWidth, views.scene.box.clientHeight].map((value) => 2 * value) });
  }

  function fetchSaved({ ticket, name, bytes }) {
    find("saved").textContent = `${name}, ${(bytes / 1e6).toFixed(bytes < 1e5 ? 3 : 1)} MB`;
    const link = element("a", "", { href: `/saved/${ticket}`, download: name });
    document.body.append(link);
    link.click();
    link.remove();
  }

  // A link holds the secret: it is for browsers of this computer, while clrecon runs.
  async function copyLink(word) {
    const link = new URL(location.href);
    link.searchParams.set("view", word);
    const copied = await navigator.clipboard.writeText(link.href).then(() => true, () => false);
    const words = copied ? "The link is copied: " : "Copy this link: ";
    find("saved").replaceChildren(words, element("a", "this view", { href: link.href, target: "_blank", rel: "noopener" }),
      "; for this computer, while clrecon runs.");
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
  find("thick").onchange = find("combine").onchange = () => {
    const mm = Number(find("thick").value), { min, max } = find("thick");
    if (find("thick").value !== "" && mm >= min && mm <= max) run("set_slab", { thickness: mm, combine: find("combine").value });
    else { hint(`Slices are ${min} to ${max} mm thick.`, true); document.activeElement.blur(); showSlab(); }
  };
  find("straighten").onclick = () => run("straighten");
  find("spine").onclick = () => run("find_spine");
  for (const button of find("layouts").children) button.onclick = () => run("set_layout", { name: button.dataset.layout });
  find("table").onchange = () => run("set_table", { shown: find("table").checked });
  find("smooth").onchange = () => run("set_smooth", { on: find("smooth").checked });
  find("fitted").onchange = () => run("set_fitted", { shown: find("fitted").checked });
  find("shade").onchange = () => run("set_color_by", { name: find("shade").value || null });
  find("perspective").onchange = () => run("set_perspective", { on: find("perspective").checked });
  find("occlusion").onchange = () => run("set_occlusion", { on: find("occlusion").checked });
  find("offset").onclick = () => run("toggle_fitted");
  find("compare").onchange = () => run("set_compare", { share: find("compare").checked ? 0.5 : null });
  hold(find("divide"), () => last("set_compare", { share: Number(find("divide").value) }));
  find("hu").addEventListener("wheel", (event) => {
    event.preventDefault();
    const by = -Math.sign(event.deltaY) * fixed.iso_step;
    gather("step_iso", (old) => ({ do: "step_iso", more: { by: by + (old ? old.more.by : 0) } }));
  }, { passive: false });
  find("end").onclick = () => choose("");
  find("along").onchange = () => { curveOff = !find("along").checked; takeFacts({}); };
  for (const button of find("exports").children) button.onclick = () => save(button.dataset.format);
  find("clear").onclick = () => run("clear_measures");
  find("all").onclick = () => run("show_all");
  find("colors").onclick = () => run("toggle_colors");
  find("small").onclick = () => run("toggle_small_parts");
  find("cut").onclick = () => run("add_clip", { direction: find("direction").value });
  find("boxed").onclick = () => run("toggle_clip_box");
  find("save").onclick = () => save(find("format").value);
  find("photo").onclick = () => save(".png");
  find("link").onclick = () => tell("link");
  find("undo").onclick = () => run("undo");
  find("another").onclick = () => { location.search += "&start"; };
  find("help").onclick = () => find("keys").showModal();
  for (const name of ["keys", "certificate"]) find(`close${name}`).onclick = () => find(name).close();

  // The view that the Tab key went to, else the one under the pointer.
  const aimed = () => Object.values(views).find(({ box }) => box.matches(":focus-visible"))
    || Object.values(views).find(({ pointer }) => pointer);

  const onAimed = (noun, fits) => (act) => () => {
    const view = aimed();
    if (view && fits(view.name)) act(view);
    else hint(`Point at a ${noun} first.`);
  };
  const onSlice = onAimed("slice", (name) => SLICES.includes(name)), onPicture = onAimed("picture", (name) => name !== "curve");
  const turnBy = (degrees) => onSlice((view) => run("turn_cross", { plane: view.name, degrees }));
  const enlargeBy = (factor) => onPicture((view) => zoomBy(view, factor, ...middleOf(view)));

  // What the page does itself at a key; what else keys do are commands of the session.
  const press = (id) => () => { if (!find(id).hidden) find(id).click(); };
  const OWN = {
    distance: press("distance"), angle: press("angle"), circle: press("circle"), box: press("square"), save: press("save"), photo: press("photo"), link: press("link"), help: press("help"),
    curve: () => { if (choosing === "curve" || find("curved").hidden) find("trace").click(); else find("along").click(); },
    escape: () => { if (choosing) choose(""); else { run("cancel"); run("dismiss"); hint(""); } },
    quit: () => tell("quit"),
    full: () => setFull((aimed() || views.scene).name),
    before: onSlice((view) => scrollBy(view, -1)), behind: onSlice((view) => scrollBy(view, 1)),
    larger: enlargeBy(1.25), smaller: enlargeBy(0.8), turn_left: turnBy(-TURN_DEGREES), turn_right: turnBy(TURN_DEGREES),
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
    if (event.ctrlKey || event.metaKey || event.altKey || !facts || document.querySelector("dialog[open]")) return;
    const { tagName, type } = event.target, isRange = type === "range";
    if (/^(SELECT|INPUT)$/.test(tagName) && !isRange && type !== "checkbox") return;
    if (isRange && event.key.startsWith("Arrow")) return;
    const does = fixed.keys[event.key];
    if (does === undefined) return;
    if (event.key.startsWith("Page")) event.preventDefault();
    if (typeof does === "string") OWN[does]();
    else if (fixed.at_pointer.includes(event.key)) runAtPointer(does.do);
    else tell("command", does);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", layOut);
  new ResizeObserver(layOut).observe(find("stage"));

  window.clrecon = Object.freeze({
    get facts() { return facts; }, project: (name, point) => project(views[name], point), run, get pictures() { return pictures; },
  });
