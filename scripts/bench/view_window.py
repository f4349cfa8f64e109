"""The window of a view, driven by xdotool on a screen of Xvfb: its start, and frames while it moves."""

from __future__ import annotations

import json
import os
import shutil
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

__all__ = ["measure_view_window"]

CHILD = Path(__file__).with_name("view_window_child.py")
SCREEN = (1024, 900)
"""Pixels of the screen; the picture is then about 600 pixels wide."""

DRAG_S, MOVES_S = 4.0, 0.01
SETTLE_S = 12.0
"""After the start, while kernels are built and parts are found."""

REST_S = 1.5
PATIENCE_S = 120.0
BARS = {"words_s": 1.0, "first_picture_s": 1.5, "picture_ms": 50.0, "between_ms": 100.0}


@case("view-window", "window under Xvfb: words and first picture, moving frames by drag and slider; it has no peer")
def measure_view_window(job: Job) -> dict[str, Any]:
    """Start the window with empty caches and again; turn in two modes, and drag the slider."""
    from clrecon import write_volume

    with tempfile.TemporaryDirectory() as folder, _screen() as display:
        path = Path(folder) / "scan.nii"
        write_volume(job.input.volume(), path)
        empty = {"XDG_CACHE_HOME": f"{folder}/xdg", "POCL_CACHE_DIR": f"{folder}/pocl"}
        for place in empty.values():
            os.makedirs(place, mode=0o700)
        cold = _run(job, path, {"DISPLAY": display, **empty}, gestures=False)
        _run(job, path, {"DISPLAY": display}, gestures=False)  # whatever was built before, it is now
        warm = _run(job, path, {"DISPLAY": display}, gestures=True)
    return {"ratios": {}, "bars": BARS, "cold": _start_of(cold), "warm": _start_of(warm), "moving": warm["moving"]}


def _start_of(found: dict[str, Any]) -> dict[str, Any]:
    return {name: round(found[name], 3) for name in ("words_s", "read_s", "first_slice_s", "first_picture_s")}


@contextmanager
def _screen() -> Iterator[str]:
    if shutil.which("Xvfb") is None or shutil.which("xdotool") is None:
        raise RuntimeError("needs xvfb and xdotool")
    reading, writing = os.pipe()
    words = [f"{SCREEN[0]}x{SCREEN[1]}x24", "-nolisten", "tcp", "-noreset"]
    server = subprocess.Popen(["Xvfb", "-displayfd", str(writing), "-screen", "0", *words], pass_fds=[writing])
    os.close(writing)
    try:
        with os.fdopen(reading) as told:
            yield f":{told.readline().strip()}"
    finally:
        server.terminate()
        server.wait()


def _run(job: Job, path: Path, environment: dict[str, str], *, gestures: bool) -> dict[str, Any]:
    """Open the window, make gestures, close it; returns what the child told."""
    own = {**os.environ, **environment}

    def do(*words: str) -> str:
        return subprocess.run(["xdotool", *words], env=own, capture_output=True, text=True).stdout

    words = [str(time.time()), str(job.device.index), f"{job.hu:g}", str(path)]
    child = subprocess.Popen([sys.executable, str(CHILD), *words], env=own, stdout=subprocess.PIPE, text=True)
    try:
        end = time.monotonic() + PATIENCE_S
        while not (window := do("search", "--name", "^clrecon view$").strip()):
            if child.poll() is not None or time.monotonic() > end:
                raise RuntimeError("the window did not come")
            time.sleep(0.05)
        time.sleep(SETTLE_S)
        spans = _gestures(do, window) if gestures else {}
        do("key", "--window", window, "q")
        told, _ = child.communicate(timeout=PATIENCE_S)
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()
    found: dict[str, Any] = json.loads(told)
    found["moving"] = {name: _frames(found["pictures"], *span) for name, span in spans.items()}
    return found


def _gestures(do: Any, window: str) -> dict[str, tuple[float, float]]:
    """Turn and slide for a while; returns when each gesture began and ended."""
    width, height = (int(line.split("=")[1]) for line in do("getwindowgeometry", "--shell", window).splitlines()[3:5])
    spans = {}
    middle = (width // 2, height // 3)
    for name, key, (x, y) in (
        ("turn surface", "", middle),
        ("turn bone", "o", middle),
        ("slider", "O", (width // 2, height - 60)),
    ):
        if key:
            do("key", "--window", window, key)
            time.sleep(2 * REST_S)
        begun = time.time()
        do("mousemove", "--window", window, str(x), str(y), "mousedown", "1")
        while time.time() - begun < DRAG_S:
            step = 6 if (time.time() - begun) % 1.0 < 0.5 else -6
            do("mousemove_relative", "--", str(step if name != "slider" else step // 3), "0")
            time.sleep(MOVES_S)
        spans[name] = (begun, time.time())
        do("mouseup", "1")
        time.sleep(2 * REST_S)
    return spans


def _frames(pictures: list[list[Any]], begun: float, ended: float) -> dict[str, Any]:
    """Return the figures of the coarse pictures of a gesture, and of the first sharp one after it."""
    moving = [each for each in pictures if begun <= each[0] <= ended and not each[2]]
    sharp = next((each for each in pictures if each[0] > ended and each[2]), None)
    between = [1000.0 * (b[0] - a[0]) for a, b in zip(moving, moving[1:], strict=False)]
    if not between:
        raise RuntimeError("nothing moved")
    return {
        "frames": len(moving),
        "picture_ms": spread([each[1] for each in moving]),
        "between_ms": spread(between),
        "width": spread([float(each[3]) for each in moving]),
        "sharp": None if sharp is None else {"ms": sharp[1], "after_s": round(sharp[0] - ended, 3), "width": sharp[3]},
    }
