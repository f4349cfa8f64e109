"""Where everything lies in the window: boxes in pixels from the top left, by the window's size.  No toolkit."""

from __future__ import annotations

from dataclasses import dataclass

PLANES = ("axial", "coronal", "sagittal")
"""The slices, from the top to the bottom of the window."""

SIDE = 214
"""Width of the list of modes, parts and tools."""

NARROW = 760
"""A window less wide has no list beside the picture: keys do the same."""

SLIDER, STATUS = 62, 26
"""Heights of the slider and of the line below it."""

GAP = 2


@dataclass(frozen=True)
class Box:
    """A part of the window: pixels from its top left corner."""

    left: int
    top: int
    width: int
    height: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height

    def holds(self, x: float, y: float) -> bool:
        """True for a place inside."""
        return self.left <= x < self.left + self.width and self.top <= y < self.top + self.height

    def viewport(self, size: tuple[int, int]) -> tuple[float, float, float, float]:
        """Return left, bottom, right and top as VTK has them: shares of the window, from its bottom."""
        width, height = size
        return (
            self.left / width,
            1.0 - (self.top + self.height) / height,
            (self.left + self.width) / width,
            1.0 - self.top / height,
        )


@dataclass(frozen=True)
class Layout:
    """The boxes of a window.

    size: Width and height of the window.
    boxes: ``picture``, ``slider``, ``status``, the planes where scans are shown, and ``side`` where there is room.
    """

    size: tuple[int, int]
    boxes: dict[str, Box]

    def find(self, x: float, y: float) -> str | None:
        """Return the name of the box at a place, None between them."""
        return next((name for name, box in self.boxes.items() if box.holds(x, y)), None)


def lay_out(size: tuple[int, int], *, slices: bool = True) -> Layout:
    """Divide a window.

    size: (width, height)
    slices: False where no scan is shown: the picture gets their room.
    """
    width, height = max(size[0], 64), max(size[1], 64)
    below = SLIDER + STATUS if height > 4 * (SLIDER + STATUS) else STATUS
    left = SIDE + GAP if width >= NARROW else 0
    room = height - below - GAP
    right = min(round(0.26 * width), room // 3 * 3 // 2) if slices and width >= NARROW // 2 else 0
    boxes = {"picture": Box(left, 0, max(width - left - right - (GAP if right else 0), 1), max(room, 1))}
    if left:
        boxes["side"] = Box(0, 0, SIDE, room)
    if right:
        each = (room - 2 * GAP) // 3
        for n, plane in enumerate(PLANES):
            top = n * (each + GAP)
            boxes[plane] = Box(width - right, top, right, each if n < 2 else room - top)
    if below > STATUS:
        boxes["slider"] = Box(0, height - below, width, SLIDER)
    boxes["status"] = Box(0, height - STATUS, width, STATUS)
    return Layout((width, height), boxes)
