  const AT_A_TIME = 4;  // uploads
  const PROGRESS_MS = 400;

  const ask = async (name, more = {}, body = null) => {
    const query = new URLSearchParams(location.search);
    for (const [key, value] of Object.entries(more)) query.set(key, value);
    const answer = await fetch(`/start/${name}?${query}`, { method: name === "progress" ? "GET" : "POST", body });
    const told = await answer.json().catch(() => ({ error: `clrecon answers with ${answer.status}` }));
    if (told.error) throw new Error(told.error);
    return told;
  };

  function say(text, wrong = false) {
    find("said").textContent = text;
    find("said").classList.toggle("wrong", wrong);
  }

  // A saved view that waits for the scan that it belongs to.
  function showWaiting(words) {
    find("waiting").hidden = !words;
    find("waiting").firstElementChild.textContent = `A saved view is waiting. It was saved from ${words}: choose or drop what it belongs to.`;
  }

  function showProgress(share) {
    find("bar").hidden = share === null;
    if (share === undefined) find("bar").removeAttribute("value");
    else if (share !== null) find("bar").value = share;
  }

  // Files with their paths from what was dropped; folders give theirs in pieces.
  async function walk(entry, before = "") {
    if (entry.isFile) {
      const file = await new Promise((done, failed) => { entry.file(done, failed); });
      return [[before + file.name, file]];
    }
    const reader = entry.createReader(), files = [];
    for (;;) {
      const some = await new Promise((done, failed) => { reader.readEntries(done, failed); });
      if (!some.length) return files;
      for (const each of some) files.push(...await walk(each, `${before}${entry.name}/`));
    }
  }

  let busy = false;

  async function take(gather) {
    if (busy) return;
    busy = true;
    try {
      const files = await gather();
      if (!files.length) { say("There is no file in it.", true); return; }
      const { drop, total_bytes: most, files: mostFiles } = await ask("begin");
      const total = files.reduce((sum, [, file]) => sum + file.size, 0);
      if (total > most || files.length > mostFiles) {
        throw new Error(`${files.length.toLocaleString("en")} files of ${(total / 2 ** 30).toFixed(2)} GB are more than the`
          + ` ${mostFiles.toLocaleString("en")} files and ${most / 2 ** 30} GB that a page takes: clrecon view FOLDER reads them where they are.`);
      }
      find("choices").replaceChildren();
      find("title").hidden = true;
      let next = 0, done = 0;
      const work = async () => {
        while (next < files.length) {
          const [path, file] = files[next++];
          await ask("upload", { drop, path }, file);
          done += file.size;
          say(`Taking ${files.length.toLocaleString("en")} files: ${(done / 1e6).toFixed(0)} of ${(total / 1e6).toFixed(0)} MB.`);
          showProgress(total ? done / total : 1);
        }
      };
      await Promise.all(Array.from({ length: AT_A_TIME }, work));
      say("Looking what it is.");
      showProgress(undefined);
      await showList();
    } catch (error) {
      say(error.message, true);
    } finally {
      showProgress(null);
      busy = false;
    }
  }

  async function showList() {
    const { choices, waiting } = await ask("list");
    showWaiting(waiting);
    showChoices(choices, waiting);
  }

  function showChoices(choices, waiting) {
    say(choices.length || waiting ? "" : "Nothing in it can be shown: DICOM, NIfTI, NRRD, MetaImage, STL, PLY and other meshes and clouds can.", true);
    find("title").hidden = !choices.length;
    const ready = choices.filter(({ button }) => button).length;
    find("title").textContent = `${ready} of ${choices.length} can be opened`;
    find("choices").replaceChildren(...choices.map((choice, number) => {
      const row = element("li", "", { className: choice.is_refused ? "refused" : "" });
      const shot = element("div", "", { className: "shot" }), words = element("div");
      if (choice.thumbnail) shot.append(element("img", "", { src: choice.thumbnail, alt: "its middle slice" }));
      words.append(element("div", choice.title, { className: "name" }), element("div", choice.words, { className: "faint" }));
      const verdict = element("div", choice.verdict || "✓ can be read", { className: `verdict ${choice.verdict ? "" : "good"}` });
      row.append(shot, words, verdict);
      if (choice.button) {
        const button = element("button", choice.button, { type: "button", ariaLabel: `${choice.button}: ${choice.title}` });
        button.onclick = () => open(number, choice.title);
        row.append(button);
      }
      return row;
    }));
    const first = find("choices").querySelector("button");
    if (first) first.focus();
  }

  async function open(number, title) {
    if (busy) return;
    busy = true;
    const buttons = find("choices").querySelectorAll("button");
    for (const button of buttons) button.disabled = true;
    say(`Reading ${title}.`);
    showProgress(undefined);
    const timer = setInterval(async () => {
      const { stage, done, total } = await ask("progress").catch(() => ({}));
      if (stage && total) showProgress(done / total);
    }, PROGRESS_MS);
    try {
      await ask("open", { choice: number });
      sessionStorage.removeItem("clrecon-tab");  // a view of its own
      const query = new URLSearchParams(location.search);
      query.delete("start");
      location.search = query;
    } catch (error) {
      say(error.message, true);
      showProgress(null);
      for (const button of buttons) button.disabled = false;
      busy = false;
    } finally {
      clearInterval(timer);
    }
  }

  ask("progress").then(({ waiting, listed }) => { if (listed) showList(); else showWaiting(waiting); });
  find("forget").onclick = () => { ask("forget").then(() => { showWaiting(""); say(""); }); };

  const picked = (input) => [...input.files].map((file) => [file.webkitRelativePath || file.name, file]);
  for (const [button, input] of [["folder", "pickfolder"], ["files", "pickfiles"]]) {
    find(button).onclick = () => find(input).click();
    find(input).onchange = () => { take(async () => picked(find(input))).then(() => { find(input).value = ""; }); };
  }
  for (const name of ["dragenter", "dragover"]) {
    addEventListener(name, (event) => { event.preventDefault(); find("drop").classList.add("over"); });
  }
  addEventListener("dragleave", (event) => { if (!event.relatedTarget) find("drop").classList.remove("over"); });
  addEventListener("drop", (event) => {
    event.preventDefault();
    find("drop").classList.remove("over");
    const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry && item.webkitGetAsEntry()).filter(Boolean);
    const files = [...event.dataTransfer.files].map((file) => [file.name, file]);
    take(async () => (entries.length ? (await Promise.all(entries.map((entry) => walk(entry)))).flat() : files));
  });
