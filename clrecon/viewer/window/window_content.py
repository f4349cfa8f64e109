"""`WindowContent`: what the window shows of a session: the picture with what lies over it, the slices, the panels.

Pictures come from the session's thread through a queue; everything of VTK is done by the thread of the window.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.rendering.views.camera import Camera
from clrecon.system.log import get_logger
from clrecon.viewer.window import panels
from clrecon.viewer.window.layout import PLANES, lay_out
from clrecon.viewer.window.panels import Panel
from clrecon.viewer.window.picture_actor import PictureActor
from clrecon.viewer.window.picture_overlay import PictureOverlay
from clrecon.viewer.window.slice_dressing import dress_curve, dress_slice
from clrecon.viewer.window.window_keys import help_sections, side_buttons

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from clrecon.rendering import Rendering
    from clrecon.viewer.session.session import ViewSession
    from clrecon.viewer.window.glass import Glass

log = get_logger(__name__)

REST_S = 0.2
"""After the last event, until the sharp picture is asked for."""

NEWS_S = 0.1
"""Between two looks at what the session does in the background."""

SAID_S = 8.0
"""For which the status line keeps what was said."""

OF_PICTURE = ("camera", "mode", "iso", "picture_window", "table", "parts", "clips", "clip_box")
OF_SLICES = ("cross", "window", "table", "parts", "measures", "points")
"""Facts by which pictures and slices differ."""

SHARE_TOOLS = ("move_clip", "set_opacity")
HINTS = {
    "distance": "distance: click two points on the picture or on a slice",
    "angle": "angle: click three points, the middle one at the corner",
    "curve": "curve: click points along it, then k",
    "seed": "seed: click a point",
}


class WindowContent:
    """What is shown, and what has been asked for."""

    def __init__(self, glass: Glass):
        self.glass = glass
        self.session: ViewSession | None = None
        self.facts: dict[str, Any] = {}
        self.panels: dict[str, Panel] = {}
        self.slice_cameras: dict[str, Camera] = {}
        self.picture_ms: list[tuple[float, float, bool]] = []
        """When each picture was shown (s), how long it took (ms), and whether it is sharp."""
        self.first_part = 0
        self.chosen: str | None = None
        self.help_shown = self.curve_shown = False
        self.slider_hu: float | None = None
        self._queue: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._came = threading.Event()
        self._actor = PictureActor(glass.renderer("picture"))
        self._overlay = PictureOverlay(glass.renderer("picture"))
        self._shown: Rendering | None = None
        self._first_slices: set[str] = set()
        self._last_event = 0.0
        self._sharp_wanted = False
        self._news_at = 0.0
        self._said, self._said_at, self._warns = "", 0.0, False
        self._lines = ["clrecon", "looking at what is to be shown"]
        self._stale = {"side", "slider", "status"}

    # From the session

    def attach(self, session: ViewSession) -> None:
        """Show a session from now on: the slices first, which take the least time, then the picture, then the rest."""
        self.session = session
        self._lines[1] = "building kernels: seconds, at the first time on this device"
        self.facts = session.facts()
        self._first_slices = {plane for plane in PLANES if plane in lay_out(self._size(), slices=self._cuts).boxes}
        self.lay_out()

    def lay_out(self) -> None:
        """Fill the window as large as it is now."""
        self.glass.arrange(lay_out(self._size(), slices=self._cuts))
        self.panels = {name: panel for name, panel in self.panels.items() if name in self.glass.layout.boxes}
        self._stale |= {"side", "slider", "status"}
        self._draw_cover()
        if self.session is None:
            for plane in PLANES:
                self.wait_at(plane, plane)
            return
        self.ask_slices()
        if not self._first_slices:
            self.ask_picture(moving=self._shown is None)

    def _size(self) -> tuple[int, int]:
        width, height = self.glass.window.GetSize()
        return width, height

    @property
    def _cuts(self) -> bool:
        """True where slices are shown: until it is known, and for scans."""
        return self.session is None or bool(self.facts.get("iso"))

    def do(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Do a command of the session at once, and ask for the pictures that it changes."""
        assert self.session is not None
        facts = self.session.do(command)
        self.take(facts)
        return facts

    def take(self, facts: dict[str, Any]) -> None:
        """Take new facts."""
        before, self.facts = self.facts, facts
        self.touch()
        if any(before.get(name) != facts.get(name) for name in OF_PICTURE):
            self.ask_picture(moving=True)
        if any(before.get(name) != facts.get(name) for name in OF_SLICES):
            self.ask_slices()
            self._overlay_anew()
        self._stale |= {"side", "slider", "status"}

    def touch(self) -> None:
        """Note that the user did something: the sharp picture waits."""
        self._last_event = time.monotonic()

    def ask_picture(self, *, moving: bool) -> None:
        """Ask for the picture: a coarse one, and later the sharp one."""
        box = self.glass.box("picture")
        if self.session is None or min(box.size) < 1:
            return
        self._sharp_wanted = moving
        self.session.picture(box.size, moving, lambda made: self._put(("picture", made)))

    def ask_slices(self) -> None:
        """Ask for the slices that there is room for."""
        if self.session is None:
            return
        facts = self.facts
        for plane in PLANES:
            if plane not in self.glass.layout.boxes:
                continue
            size = self.glass.box(plane).size
            if self.curve_shown and plane == PLANES[-1]:
                self.session.curve_picture(size, lambda made: self._put(("curve", dress_curve(made))))
                continue

            def then(made: Rendering, plane: str = plane) -> None:
                camera = made.camera
                self._put((plane, (camera, dress_slice(made, plane, facts))))

            self.session.slice(plane, size, then)

    # At each tick

    def tick(self, busy_hand: bool, pointer_held: bool) -> None:
        """Show what has come, ask for what is due, and draw."""
        self._take_queue()
        now = time.monotonic()
        if self.session is not None and not busy_hand and now - self._news_at > NEWS_S:
            self._news_at = now
            facts = self.session.facts()
            if facts != self.facts:
                if facts["version"] != self.facts.get("version"):
                    self.take(facts)
                else:
                    self.facts = facts
                    self._stale |= {"side", "status"}
        if self._sharp_wanted and now - self._last_event > REST_S:
            self.ask_picture(moving=False)
            assert self.session is not None
            self.session.rest()
        if self._said and now - self._said_at > SAID_S:
            self._said, self._warns = "", False
            self._stale.add("status")
        self._draw_panels()
        self.glass.draw()

    def wait(self, seconds: float) -> None:
        """Wait until something comes, at most for some seconds."""
        self._came.wait(seconds)
        self._came.clear()

    def _put(self, come: tuple[str, Any]) -> None:
        """Hand something to the thread of the window."""
        self._queue.put(come)
        self._came.set()

    def _take_queue(self) -> None:
        """Show what the session has delivered; of several pictures the last."""
        latest: dict[str, Any] = {}
        while True:
            try:
                kind, made = self._queue.get_nowait()
            except queue.Empty:
                break
            if kind == "call":
                made()
            else:
                latest[kind] = made
        for kind, made in latest.items():
            if kind == "picture":
                self._show_picture(made)
            elif kind == "curve":
                if self.curve_shown:
                    self._show_slice(PLANES[-1], made)
            elif not (self.curve_shown and kind == PLANES[-1]):
                self.slice_cameras[kind] = made[0]
                self._show_slice(kind, made[1])
                if self._first_slices:
                    self._first_slices.discard(kind)
                    if not self._first_slices:
                        self.touch()
                        self.ask_picture(moving=True)

    def call(self, action: Any) -> None:
        """Let the thread of the window call something; for other threads."""
        self._put(("call", action))

    def _show_slice(self, plane: str, image: Any) -> None:
        box = self.glass.box(plane)
        if (image.shape[1], image.shape[0]) == box.size:
            self.glass.show(plane, image)

    def _show_picture(self, made: Rendering) -> None:
        box = self.glass.box("picture")
        if abs(made.size[0] * box.height - made.size[1] * box.width) > 2 * max(box.size):
            return  # of a window of another size
        first, self._shown = self._shown is None, made
        timing = made.report
        self.picture_ms.append((time.monotonic(), float(timing.get("ms", 0.0)), bool(timing.get("sharp", True))))
        mode = str(self.facts.get("mode", ""))
        self._actor.show(made, expected=mode != "surface", smooth=made.size != box.size)
        self._overlay_anew()
        if first:
            self._draw_cover()
            assert self.session is not None
            self.touch()
            self.session.prepare()
            self.session.find_parts()
        self._stale.add("status")

    def _overlay_anew(self) -> None:
        if self._shown is None:
            return
        box = self.glass.box("picture")
        self._overlay.show(self._shown, box.size, self.facts, cross=bool(self.facts.get("iso")))
        self.glass.touch("picture")

    # Panels

    def say(self, words: str, *, warning: bool = False) -> None:
        """Say something on the status line."""
        self._said, self._said_at, self._warns = words, time.monotonic(), warning
        self._stale.add("status")

    def say_lines(self, title: str, words: str) -> None:
        """Say what is done before there is a picture."""
        if [title, words] != self._lines:
            self._lines = [title, words]
            self._stale |= {"cover", "status"}  # drawn at the next tick: a scan has hundreds of slices

    def wait_at(self, plane: str, words: str) -> None:
        """Show words where a slice will be replaced."""
        if plane in self.glass.layout.boxes:
            self.glass.show(plane, panels.draw_words(self.glass.box(plane).size, ["", words]).image)

    def stale(self, panel: str) -> None:
        """Draw a panel anew at the next tick."""
        self._stale.add(panel)

    def show_help(self, shown: bool) -> None:
        """Show or hide the help over the picture."""
        self.help_shown = shown
        self._draw_cover()
        self._stale.add("side")

    def _draw_cover(self) -> None:
        size = self.glass.box("picture").size
        if self.help_shown:
            self.glass.cover(panels.draw_help(size, help_sections()).image)
        elif self._shown is None:
            self.glass.cover(panels.draw_words(size, self._lines).image)
        else:
            self.glass.cover(None)

    def _draw_panels(self) -> None:
        boxes = self.glass.layout.boxes
        if "cover" in self._stale:
            self._draw_cover()
        for name in self._stale & set(boxes):
            panel = self._draw_panel(name, boxes[name].size)
            self.panels[name] = panel
            self.glass.show(name, panel.image)
        self._stale.clear()

    def _draw_panel(self, name: str, size: tuple[int, int]) -> Panel:
        facts = self.facts
        if name == "slider":
            iso = facts.get("iso") or {"hu": 0.0, "low": -1000.0, "high": 2000.0}
            shown = iso["hu"] if self.slider_hu is None else self.slider_hu
            return panels.draw_slider(size, shown, (iso["low"], iso["high"]), active=bool(facts.get("iso")))
        if name == "side":
            buttons = side_buttons(facts, help_shown=self.help_shown) if facts else ()
            if facts.get("clip_box"):
                facts = {**facts, "clip_box_shares": self.clip_box_shares()}
            return panels.draw_side(size, facts, tools=buttons, first=self.first_part, chosen=self.chosen)
        words, warns = self._status()
        return panels.draw_status(size, words, describe_picture(facts), warning=warns)

    def bounds(self) -> NDArray[np.float64]:
        """Return the lowest and the highest corner of all objects, LPS mm."""
        assert self.session is not None
        corners = np.concatenate([each.corners for each in self.session.model.objects])
        return np.array([corners.min(axis=0), corners.max(axis=0)])

    def clip_box_shares(self) -> list[tuple[float, float]]:
        """Return the ends of the clip box along x, y and z, in shares of `bounds`."""
        low, high = self.bounds()
        shares = (np.array(self.facts["clip_box"]) - low) / np.maximum(high - low, 1e-6)
        return [(float(first), float(last)) for first, last in np.clip(shares, 0.0, 1.0).T]

    def _status(self) -> tuple[str, bool]:
        facts = self.facts
        busy = ", ".join(facts.get("busy", ()))
        if self._said and busy and not facts.get("error"):
            return f"{self._said}   ({busy} ...)", self._warns
        for words, warns in (
            (facts.get("error"), True),
            (self._said, self._warns),
            (busy and f"{busy} ...", False),
            (HINTS.get(facts.get("tool") or ""), False),
            (facts.get("said"), False),
            ("; ".join([*facts.get("notes", ()), *facts.get("warnings", ())]), True),
        ):
            if words:
                return str(words), warns
        return ("h: help" if facts else self._lines[1]), False


def describe_picture(facts: Mapping[str, Any]) -> str:
    """Return what the picture is: iso value, mode, time, size, device, coarse or sharp."""
    timing = facts.get("timing") or {}
    if not timing:
        return ""
    iso = facts.get("iso")
    words = [f"{iso['hu']:g} HU"] if iso and facts.get("mode") == "surface" else []
    words.append(str(facts.get("mode")))
    width, height = timing["size"]
    words += [f"{timing['ms']:.0f} ms", f"{width} x {height}", "sharp" if timing["sharp"] else "coarse"]
    return "   ".join([*words, str(timing["device"])])
