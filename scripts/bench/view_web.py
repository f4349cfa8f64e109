"""The view in a browser: its start, pictures a second in Chromium on the same machine, bytes, memory, and its page."""

from __future__ import annotations

import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from measure import busy_seconds, spread
from registry import Job, case

WINDOW = (1100, 800)
"""Pixels of the browser; the picture is somewhat smaller and said in the result."""

GESTURE_S = 4.0
PATIENCE_S = 120.0
MODES = ("surface", "bone")

FLAGS = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--force-device-scale-factor=1")

DRAG = """
const [seconds, id, done] = arguments, box = document.getElementById(id), at = box.getBoundingClientRect();
const fire = (name, x, buttons) => box.dispatchEvent(new PointerEvent(name, { pointerId: 1, button: 0, buttons,
  clientX: at.left + x, clientY: at.top + at.height / 2, bubbles: true }));
box.setPointerCapture = () => {};
const shown = [], begin = performance.now();
let before = clrecon.pictures, x = at.width / 3, frames = 0;
fire("pointerdown", x, 1);
const step = (now) => {
  frames += 1;
  if (clrecon.pictures !== before) { shown.push(now); before = clrecon.pictures; }
  if (now - begin > 1000 * seconds) {
    fire("pointerup", x, 0);
    done({ shown, frames, seconds: (now - begin) / 1000 });
    return;
  }
  x += 3 * Math.sin((now - begin) / 400);
  fire("pointermove", x, 1);
  requestAnimationFrame(step);
};
requestAnimationFrame(step);
"""
"""A drag of so many seconds, one move a frame: when pictures appeared, in ms."""

SLIDE = """
const [seconds, done] = arguments, slider = document.getElementById("hu"), begin = performance.now(), shown = [];
let before = clrecon.pictures, frames = 0;
const step = (now) => {
  frames += 1;
  if (clrecon.pictures !== before) { shown.push(now); before = clrecon.pictures; }
  if (now - begin > 1000 * seconds) { done({ shown, frames, seconds: (now - begin) / 1000 }); return; }
  slider.value = Math.round(300 + 100 * Math.sin((now - begin) / 700));
  slider.dispatchEvent(new Event("input"));
  requestAnimationFrame(step);
};
requestAnimationFrame(step);
"""


@case(
    "view-web", "view in Chromium on the same machine: pictures a second by drag and slider, bytes of a visit; no peer"
)
def measure_view_web(job: Job) -> dict[str, Any]:
    """Drag and slide in a real browser; the bar is 10 pictures a second."""
    from clrecon import write_volume

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.nii"
        write_volume(job.input.volume(), path)
        with _served(path, job, "--hu", f"{job.hu:g}") as served, _browser() as page:
            start = time.perf_counter()
            page.get(served.address)
            _wait(page, "return clrecon.pictures > 0")
            first = time.perf_counter() - start
            _settle(page)
            time.sleep(3.0)  # kernels are built in the background
            visit = _received(page)
            box = page.execute_script(
                "const one = document.getElementById('scene'); return [one.clientWidth, one.clientHeight]"
            )
            made: dict[str, Any] = {}
            for mode in MODES:
                page.execute_script("clrecon.run('set_mode', { name: arguments[0] })", mode)
                _settle(page)
                made[f"drag {mode}"] = _gesture(page, DRAG, GESTURE_S, "scene")
            page.execute_script("clrecon.run('set_mode', { name: 'surface' })")
            _settle(page)
            made["slider surface"] = _gesture(page, SLIDE, GESTURE_S)
    return {
        "ratios": {},
        "picture": box,
        "first_picture_s": round(first, 3),
        "visit_bytes": visit,
        "pictures_per_second": {name: found["per_second"] for name, found in made.items()},
        "gestures": made,
    }


@case(
    "view-web-start",
    "seconds from the start of a process, kernels in the cache, to its first words in the terminal, to its address and"
    " to the picture in a Chromium that is open; no peer",
)
def measure_start(job: Job) -> dict[str, Any]:
    """Start processes that show a folder of DICOM as bone without its table; the first is not counted."""
    folder = job.input.ct_folder()
    runs: list[dict[str, float]] = []
    with _browser() as page:
        for _ in range(max(2, min(job.pairs, 5)) + 1):
            page.get("about:blank")
            begin = time.perf_counter()
            with _served(folder, job) as served:
                address = time.perf_counter()
                page.get(served.address)
                _wait(page, "return clrecon.pictures > 0")
                picture = time.perf_counter()
                used = cpu_seconds(served.process.pid)
            assert served.spoke is not None
            ends = {"words_s": served.spoke, "address_s": address, "picture_s": picture}
            runs.append({name: end - begin for name, end in ends.items()} | {"server_cpu_s": used})
    figures = {name: spread([run[name] for run in runs[1:]]) for name in runs[0]}
    return {"ratios": {}, **figures, "bars_s": {"words": 0.5, "picture": 1.5}}


SESSIONS = (60, 160)
MOST_GROWTH_MB = 20.0


@case("view-web-sessions", "memory of the server after 60 browsers that looked and left, and after 160; no peer")
def measure_sessions(job: Job) -> dict[str, Any]:
    """Connect, wait for a sharp picture and leave, one browser after another, each in a tab of its own."""
    with _served(job.input.ct_folder(), job) as served:
        resident: dict[int, float] = {}
        for number in range(1, SESSIONS[-1] + 1):
            look_and_leave(served.address, f"bench{number:04d}")
            if number in SESSIONS:
                time.sleep(2.0)
                resident[number] = resident_mb(served.process.pid)
    grown = resident[SESSIONS[1]] - resident[SESSIONS[0]]
    return {"ratios": {}, "resident_mb": resident, "grown_mb": grown, "bar_grown_mb": MOST_GROWTH_MB}


def look_and_leave(address: str, tab: str) -> None:
    """Connect as the page does, and leave once a sharp picture has come."""
    import websocket

    base, _, secret = address.partition("/?")
    socket = websocket.create_connection(
        f"{base.replace('http', 'ws')}/socket?{secret}&tab={tab}", origin=base, timeout=PATIENCE_S
    )
    layout = {"type": "layout", "sizes": {"scene": [544, 579]}, "ground": [0, 0, 0]}
    socket.send(json.dumps(layout))
    is_sharp = False
    while not is_sharp:
        data = socket.recv()
        if isinstance(data, bytes):
            head = json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")])
            socket.send(json.dumps({"type": "shown", "number": head["number"]}))
            is_sharp = head["sharp"]
    socket.close()


@case("view-page", "bytes a triangle of the page that view --html writes, and milliseconds until it is ready; no peer")
def measure_page(job: Job) -> dict[str, Any]:
    import clrecon

    mesh = clrecon.extract_isosurface(job.input.volume(), job.hu, device=job.device)
    with tempfile.TemporaryDirectory() as folder, _browser() as page:
        path = Path(folder) / "page.html"
        begin = busy_seconds()
        mesh.save(path)
        written = busy_seconds() - begin
        ready = []
        for _ in range(max(3, min(job.pairs, 7))):
            page.get(path.as_uri())
            _wait(page, "return document.documentElement.dataset.ready")
            ready.append(float(page.execute_script("return document.documentElement.dataset.ready")))
        size = path.stat().st_size
    return {
        "ratios": {},
        "triangles": mesh.triangle_count,
        "bytes": size,
        "bytes_a_triangle": round(size / mesh.triangle_count, 3),
        "written_cpu_s": round(written, 3),
        "ready_ms": spread(ready),
        "bars": {"bytes_a_triangle": 5.0, "ready_ms": 2000.0},
    }


def compiling_environment() -> dict[str, str]:
    """This environment, without the variable that lets modules be compiled anew in each process."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def cpu_seconds(pid: int) -> float:
    """Processor seconds of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)


@dataclass
class _Served:
    """A server: its address, and when it wrote its first words to its terminal."""

    process: subprocess.Popen[str]
    address: str = ""
    spoke: float | None = None


@contextmanager
def _served(path: Path, job: Job, *options: str) -> Iterator[_Served]:
    """Start a server as in a terminal, which is given back once its address is known.

    Its modules are compiled once, as those of an installed package are.
    """
    own, terminal = pty.openpty()
    command = [sys.executable, "-m", "clrecon", "view", str(path), "--no-open", "--device", str(job.device.index)]
    process = subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=terminal, text=True, env=compiling_environment()
    )
    os.close(terminal)
    served = _Served(process)

    def listen() -> None:
        with suppress(OSError):  # as a terminal says that its other side is closed
            while os.read(own, 4096):
                served.spoke = served.spoke or time.perf_counter()

    listener = threading.Thread(target=listen)
    listener.start()
    try:
        assert process.stdout is not None
        while not served.address:
            line = process.stdout.readline()
            if not line:
                raise RuntimeError("the server ended before it was ready")
            if line.startswith("view "):
                served.address = line.split()[1]
        yield served
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)
        listener.join(PATIENCE_S)
        os.close(own)


@contextmanager
def _browser() -> Iterator[Any]:
    program, beside = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or beside is None:
        raise RuntimeError("needs chromium and chromedriver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in (*FLAGS, f"--window-size={WINDOW[0]},{WINDOW[1]}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(beside))
    driver.set_script_timeout(PATIENCE_S)
    try:
        yield driver
    finally:
        driver.quit()


def _wait(page: Any, script: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not page.execute_script(script):
        if time.monotonic() > end:
            raise RuntimeError(f"not within {PATIENCE_S:g} s: {script}")
        time.sleep(0.02)


def _settle(page: Any) -> None:
    time.sleep(0.6)
    _wait(page, "return clrecon.facts && clrecon.facts.settled")


def _gesture(page: Any, script: str, *arguments: Any) -> dict[str, Any]:
    _received(page)
    found = page.execute_async_script(script, *arguments)
    received = _received(page)
    shown = found["shown"]
    return {
        "per_second": round(len(shown) / found["seconds"], 2),
        "pictures": len(shown),
        "browser_frames_per_second": round(found["frames"] / found["seconds"], 1),
        "between_ms": spread([after - before for before, after in zip(shown, shown[1:], strict=False)]),
        "kilobytes_per_second": round(received / found["seconds"] / 1000, 1),
    }


def _received(page: Any) -> int:
    """Bytes that the page received since the last call: the document, and messages of the WebSocket."""
    total = 0
    for entry in page.get_log("performance"):
        event = json.loads(entry["message"])["message"]
        if event["method"] == "Network.loadingFinished":
            total += int(event["params"]["encodedDataLength"])
        elif event["method"] == "Network.webSocketFrameReceived":
            frame = event["params"]["response"]
            size = len(frame["payloadData"])
            total += size * 3 // 4 if frame["opcode"] == 2 else size  # binary ones are told as base64
    return total
