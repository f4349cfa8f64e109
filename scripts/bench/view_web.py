"""The view in a browser: pictures a second in Chromium on the same machine, and bytes of a visit."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from measure import spread
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
        with _server(path, job) as address, _browser() as page:
            start = time.perf_counter()
            page.get(address)
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


@contextmanager
def _server(path: Path, job: Job) -> Iterator[str]:
    command = [sys.executable, "-m", "clrecon", "view", str(path), "--no-open", "--json"]
    process = subprocess.Popen(
        [*command, "--device", str(job.device.index), "--hu", f"{job.hu:g}"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        text = ""
        while not text.endswith("}\n"):
            line = process.stdout.readline()
            if not line:
                raise RuntimeError("the server ended before it was ready")
            text += line
        yield str(json.loads(text)["address"])
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)


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
