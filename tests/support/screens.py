"""A screen without a screen (Xvfb), and hands for the windows on it (xdotool): for tests of the window."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

SIZE = (1400, 950)
"""Pixels of the screen: the window is smaller than it."""

SECONDS = 60.0
"""Until something is seen that takes 5 s with cold caches where nothing else runs."""

TOOLS = {"Xvfb": "xvfb", "xdotool": "xdotool"}
"""Programs, and their packages in Debian."""


def need_screen() -> None:
    """Skip, or fail where CLRECON_REQUIRE_SCREEN is set, without the programs."""
    missing = [package for program, package in TOOLS.items() if shutil.which(program) is None]
    if not missing:
        return
    words = f"needs a screen: apt-get install {' '.join(missing)}"
    if os.environ.get("CLRECON_REQUIRE_SCREEN"):
        pytest.fail(f"CLRECON_REQUIRE_SCREEN is set: {words}")
    pytest.skip(words)


@contextmanager
def open_screen() -> Iterator[str]:
    """Start a screen; yields its name for DISPLAY."""
    need_screen()
    reading, writing = os.pipe()
    words = [f"{SIZE[0]}x{SIZE[1]}x24", "-nolisten", "tcp", "-noreset"]
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", *words], pass_fds=[writing], stderr=subprocess.DEVNULL
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as told:
            number = told.readline().strip()
        assert number, "Xvfb did not start"
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()


class _XImage(ctypes.Structure):
    """The beginning of Xlib's structure."""

    _fields_ = [
        *((name, ctypes.c_int) for name in ("width", "height", "xoffset", "format")),
        ("data", ctypes.c_void_p),
        *(
            (name, ctypes.c_int)
            for name in ("byte_order", "unit", "bit_order", "pad", "depth", "bytes_per_line", "bits")
        ),
    ]


@cache
def _x11() -> Any:
    """Xlib, whose errors end nothing: a window may be gone when it is asked."""
    x11 = ctypes.CDLL("libX11.so.6")
    for name in ("XOpenDisplay", "XGetImage"):
        getattr(x11, name).restype = ctypes.c_void_p
    x11.XInternAtom.restype = ctypes.c_ulong
    ignore = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(lambda *_: 0)
    x11.XSetErrorHandler(ignore)
    setattr(x11, "kept", ignore)  # noqa: B010  else it is freed
    return x11


def _connect(display: str) -> Any:
    return ctypes.c_void_p(_x11().XOpenDisplay(display.encode()))


def grab_window(display: str, window: int) -> np.ndarray | None:
    """What a window shows, (h, w, 3) uint8; None where it is not there any more."""
    x11, connection = _x11(), _connect(display)
    try:
        root, sizes = ctypes.c_ulong(), [ctypes.c_int() for _ in range(2)] + [ctypes.c_uint() for _ in range(4)]
        drawable = ctypes.c_ulong(window)
        if not x11.XGetGeometry(connection, drawable, ctypes.byref(root), *map(ctypes.byref, sizes)):
            return None
        width, height = sizes[2], sizes[3]
        every = ctypes.c_ulong(0xFFFFFFFF)
        place = x11.XGetImage(connection, drawable, 0, 0, width, height, every, 2)
        if not place:
            return None
        image = _XImage.from_address(place)
        assert image.bits == 32
        content = ctypes.string_at(image.data, image.bytes_per_line * image.height)
        rows = np.frombuffer(content, np.uint8).reshape(image.height, -1, 4)
        x11.XFree(ctypes.c_void_p(image.data))
        x11.XFree(ctypes.c_void_p(place))
        return np.ascontiguousarray(rows[:, : width.value, 2::-1])
    finally:
        x11.XCloseDisplay(connection)


class Window:
    """A command with a window, and what a user sees and does.

    arguments: Of ``clrecon``.
    folder: Its current folder.
    """

    def __init__(self, display: str, arguments: Sequence[str | Path], folder: Path):
        self._environment = {**os.environ, "DISPLAY": display}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "clrecon", *map(str, arguments)],
            env=self._environment, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._id = ""

    def _run(self, *words: str) -> bytes:
        return subprocess.run(words, env=self._environment, capture_output=True).stdout

    @property
    def id(self) -> str:
        """Number of the window, once it is there."""
        end = time.monotonic() + SECONDS
        while not self._id:
            assert self.process.poll() is None, self.finish()
            assert time.monotonic() < end, "no window came"
            found = self._run("xdotool", "search", "--name", "^clrecon view$").split()
            self._id = found[0].decode() if found else ""
        return self._id

    def look(self) -> np.ndarray | None:
        """What the window shows, (h, w, 3) uint8; None where it cannot be asked."""
        return grab_window(self._environment["DISPLAY"], int(self.id))

    def wait(self, is_there: Callable[[np.ndarray], bool], what: str) -> np.ndarray:
        """Wait until the window shows something; returns what it shows then."""
        end = time.monotonic() + SECONDS
        while True:
            assert self.process.poll() is None, f"it ended before {what}: {self.finish()}"
            seen = self.look()
            if seen is not None and is_there(seen):
                return seen
            assert time.monotonic() < end, f"not seen: {what}"
            time.sleep(0.05)

    def wait_change(self, before: np.ndarray, region: tuple[slice, slice], share: float, what: str) -> np.ndarray:
        """Wait until a share of the pixels of a region differ from before."""

        def differs(seen: np.ndarray) -> bool:
            return seen.shape == before.shape and changed_share(seen[region], before[region]) > share

        return self.wait(differs, what)

    def move(self, x: float, y: float) -> None:
        """Move the pointer to a place of the window."""
        self._run("xdotool", "mousemove", "--window", self.id, str(round(x)), str(round(y)))

    def click(self, x: float, y: float, *, shift: bool = False) -> None:
        """Click with the left button."""
        self.move(x, y)
        held = (["keydown", "shift"], ["keyup", "shift"]) if shift else ([], [])
        self._run("xdotool", *held[0], "click", "1", *held[1])

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: int = 1, steps: int = 14) -> None:
        """Drag in small moves, and let go."""
        self.move(*start)
        self._run("xdotool", "mousedown", str(button))
        for n in range(1, steps + 1):
            self.move(*(a + (b - a) * n / steps for a, b in zip(start, end, strict=True)))
            time.sleep(0.02)
        self._run("xdotool", "mouseup", str(button))

    def wheel(self, x: float, y: float, steps: int) -> None:
        """Turn the wheel, positive steps away from the user."""
        self.move(x, y)
        self._run("xdotool", "click", "--repeat", str(abs(steps)), "4" if steps > 0 else "5")

    def key(self, name: str) -> None:
        """Press a key."""
        self._run("xdotool", "windowfocus", self.id)
        self._run("xdotool", "key", "--window", self.id, name)
        self._run("xdotool", "keyup", name)  # a window that closes at the press leaves the key down, for the next one

    def close(self) -> None:
        """Ask the window to close, as a window manager does: there is none on this screen."""
        x11, display = _x11(), _connect(self._environment["DISPLAY"])
        atoms = [x11.XInternAtom(display, name, 0) for name in (b"WM_PROTOCOLS", b"WM_DELETE_WINDOW")]
        event = (ctypes.c_long * 24)()
        event[0], event[4], event[5], event[6], event[7] = 33, int(self.id), atoms[0], 32, atoms[1]  # ClientMessage
        x11.XSendEvent(display, ctypes.c_ulong(int(self.id)), 0, ctypes.c_long(0), ctypes.byref(event))
        x11.XSync(display, 0)
        x11.XCloseDisplay(display)

    def finish(self) -> tuple[int, str, str]:
        """Wait for the end; returns exit code, stdout and stderr."""
        said, complained = self.process.communicate(timeout=SECONDS)
        return self.process.returncode, said, complained


def changed_share(one: np.ndarray, other: np.ndarray, levels: int = 12) -> float:
    """Share of the pixels that differ by more than some levels."""
    return float((np.abs(one.astype(int) - other).max(axis=2) > levels).mean())


@contextmanager
def open_view(display: str, arguments: Sequence[str | Path], folder: Path) -> Iterator[Window]:
    """Start ``clrecon view`` on a screen; what is left of it is ended."""
    window = Window(display, ["view", *arguments], folder)
    try:
        yield window
    finally:
        if window.process.poll() is None:
            window.process.kill()
        with suppress(ValueError):
            window.process.communicate()
