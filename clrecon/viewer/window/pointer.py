"""`Pointer`: what the mouse does in the window, as commands; the habits of pyvista, and no toolkit.

An action is a command of `ViewSession.do` (``{"do": ...}``), what a key does (``{"key": "m"}``), or something that the
window works out itself (``{"at": "picture", ...}``), because it needs what is shown there.
"""

from __future__ import annotations

from typing import Any

from clrecon.viewer.window.layout import PLANES, Box, Layout
from clrecon.viewer.window.panels import Hit, Panel

Action = dict[str, Any]

STILL_PIXELS = 4
"""A press that is moved by less is a click."""

WHEEL_FACTOR = 1.1
ZOOM_PER_HEIGHT = 6.0
"""Factor of the zoom by a drag over the height of the picture, as pyvista's right button has it about."""

ROLL_DEGREES = 180.0
WINDOW_HU = 4.0
"""By which a pixel of a drag changes window and level."""


class Pointer:
    """The state of the mouse between a press and a release."""

    def __init__(self) -> None:
        self.button = ""
        self.area = ""
        self._start = self._last = (0.0, 0.0)
        self._shift = self._control = self._moved = False
        self._hit: Hit | None = None

    @property
    def is_busy(self) -> bool:
        """True while a button is held."""
        return bool(self.button)

    def press(
        self, button: str, layout: Layout, panels: dict[str, Panel], at: tuple[float, float], *, shift: bool = False,
        control: bool = False,
    ) -> list[Action]:  # fmt: skip
        """Press "left", "middle" or "right" at a place of the window, from its top left corner."""
        area = layout.find(*at)
        if self.button or area is None:
            return []
        self.button, self.area = button, area
        self._start = self._last = at
        self._shift, self._control, self._moved, self._hit = shift, control, False, None
        if area in panels and button == "left":
            box = layout.boxes[area]
            x, y = at[0] - box.left, at[1] - box.top
            self._hit = panels[area].find(x, y)
            return [] if self._hit is None else [self._hit.command(x)]
        return self._on_slice(layout, at) if area in PLANES and button == "left" else []

    def move(self, layout: Layout, at: tuple[float, float]) -> list[Action]:
        """Move to a place."""
        if not self.button or self.area not in layout.boxes:
            return []
        if not self._moved and max(abs(a - b) for a, b in zip(at, self._start, strict=True)) < STILL_PIXELS:
            return []
        self._moved = True
        box = layout.boxes[self.area]
        dx, dy = at[0] - self._last[0], at[1] - self._last[1]
        if (dx, dy) == (0.0, 0.0):
            return []
        self._last = at
        if self.area == "picture":
            return [self._on_picture(box, dx, dy)]
        if self.area in PLANES:
            if self.button == "left":
                return self._on_slice(layout, at)
            return [{"window": (WINDOW_HU * dx, WINDOW_HU * dy)}] if self.button == "right" else []
        if self._hit is not None and (self._hit.share or "slider" in self._hit.action):
            return [self._hit.command(at[0] - box.left)]
        return []

    def release(self, layout: Layout, at: tuple[float, float]) -> list[Action]:
        """Let go; a click on the picture is a point of a tool, or with shift a pick."""
        button, self.button = self.button, ""
        if not button or self._moved or self.area != "picture" or self.area not in layout.boxes or button != "left":
            return []
        box = layout.boxes[self.area]
        return [{"at": "picture", "place": (at[0] - box.left, at[1] - box.top), "pick": self._shift}]

    def wheel(self, layout: Layout, at: tuple[float, float], steps: int) -> list[Action]:
        """Turn the wheel: positive steps away from the user."""
        area = layout.find(*at)
        if area == "picture":
            box = layout.boxes[area]
            return [{"do": "zoom", "factor": WHEEL_FACTOR**steps, "at": list(_from_middle(box, at))}]
        if area in PLANES:
            return [{"do": "scroll", "plane": area, "steps": steps}]
        if area == "side":
            return [{"scroll": -3 * steps}]
        return [{"nudge": steps}] if area == "slider" else []

    def _on_picture(self, box: Box, dx: float, dy: float) -> Action:
        right, up = dx / box.height, dy / box.height
        if self.button == "right" or (self.button == "left" and self._shift and self._control):
            return {"do": "zoom", "factor": ZOOM_PER_HEIGHT**-up}
        if self.button == "middle" or (self.button == "left" and self._shift):
            return {"do": "pan", "dx": right, "dy": up}
        if self._control:
            return {"do": "roll", "degrees": ROLL_DEGREES * right}
        return {"do": "turn", "dx": right, "dy": up}

    def _on_slice(self, layout: Layout, at: tuple[float, float]) -> list[Action]:
        box = layout.boxes[self.area]
        x = min(max(at[0] - box.left, 0), box.width - 1)
        y = min(max(at[1] - box.top, 0), box.height - 1)
        return [{"at": self.area, "place": (x, y), "pick": self._shift, "drag": self._moved}]


def _from_middle(box: Box, at: tuple[float, float]) -> tuple[float, float]:
    """Return a place in shares of a box's height, from its middle to the right and down."""
    x, y = at[0] - box.left - 0.5 * box.width, at[1] - box.top - 0.5 * box.height
    return x / box.height, y / box.height
