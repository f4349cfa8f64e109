"""`ViewState`: everything that a view shows, frozen: what a painter draws, and what undo goes back to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip
from clrecon.viewer.model.tools import ClipPlane, Measure, Pick

Color = tuple[float, float, float]
Point = tuple[float, float, float]
Box = tuple[Point, Point]


def as_point(vector: Any) -> Point:
    """Return three numbers as floats."""
    x, y, z = (float(value) for value in vector)
    return x, y, z


@dataclass(frozen=True, kw_only=True)
class ShownPart:
    """A part that can be switched: an object as a whole, a cluster of a scan's voxels, or a label.

    key: "2" for the object of number 2, "2/5" for its part of number 5.
    name, kind: Kinds are "scan", "mesh", "cloud", "cluster", "rest" (what of a scan lies below the iso value) and
        "label".
    number: Number of the cluster or label in the label map by which it is drawn; 0 for "rest" and for whole objects.
    ml: Volume of its voxels.
    count: Voxels, triangles or points.
    color: (red, green, blue) or None. 0 to 1; None: as it looks by itself.
    opacity: 0 to 1; seen only while it is visible.
    box: ((x, y, z), (x, y, z)) or None. LPS mm.
    inside: (x, y, z) or None. LPS mm of a place within the cluster, by which it is known again at another iso value.
    """

    key: str
    name: str
    kind: str
    object: int
    number: int = 0
    ml: float | None = None
    count: int | None = None
    color: Color | None = None
    opacity: float = 1.0
    visible: bool = True
    box: Box | None = None
    inside: Point | None = None

    @property
    def is_whole(self) -> bool:
        """True for an object as a whole."""
        return self.kind in ("scan", "mesh", "cloud", "labels")

    @property
    def is_plain(self) -> bool:
        """True where nothing of its look was changed."""
        return self.visible and self.color is None and self.opacity >= 1.0

    def describe(self) -> dict[str, Any]:
        """Return what lists show, for JSON."""
        return {
            "key": self.key,
            "name": self.name,
            "kind": self.kind,
            "object": self.object,
            "ml": None if self.ml is None else round(self.ml, 3),
            "count": self.count,
            "color": None if self.color is None else [round(float(value), 4) for value in self.color],
            "opacity": self.opacity,
            "visible": self.visible,
        }


@dataclass(frozen=True, kw_only=True)
class ViewState:
    """What a view shows.

    camera: LPS mm.
    mode: One of `clrecon.viewer.model.model.view_modes`.
    iso_value: HU, of all scans.
    window: HU shown as black and white in slices.
    picture_window: The same in projections; None: that of the mode.
    table: Table and blankets are shown.
    cross: (x, y, z). LPS mm, where the three slices go through.
    parts_at: Iso value of the clusters; None: they are not known.
    parts_table: Of which volume, see `table`.
    points: Points of the tool that is used.
    clip_box: ((x, y, z), (x, y, z)) or None. LPS mm.
    """

    camera: Camera
    mode: str
    iso_value: float
    window: tuple[float, float]
    cross: Point
    picture_window: tuple[float, float] | None = None
    table: bool = True
    parts: tuple[ShownPart, ...] = ()
    parts_at: float | None = None
    parts_table: bool = True
    tool: str | None = None
    points: tuple[Pick, ...] = ()
    measures: tuple[Measure, ...] = ()
    clips: tuple[ClipPlane, ...] = ()
    clip_box: Box | None = None

    @property
    def clip(self) -> Clip | None:
        """The part of space that is shown; None: all."""
        rows = [each.row for each in self.clips]
        clip = Clip(np.array(rows)) if rows else Clip()
        if self.clip_box is not None:
            clip = clip & Clip.box(*self.clip_box)
        return clip if len(clip.planes) else None

    @property
    def curve(self) -> tuple[Point, ...]:
        """Points of the curve that is being made, else of the last one, LPS mm."""
        if self.tool == "curve" and len(self.points) > 1:
            return tuple(each.point for each in self.points)
        return next((each.points for each in reversed(self.measures) if each.kind == "curve"), ())

    def part(self, key: str) -> ShownPart | None:
        """Return the part with this key."""
        return next((each for each in self.parts if each.key == key), None)

    def parts_of(self, number: int) -> list[ShownPart]:
        """Return the parts of an object but for itself as a whole."""
        return [each for each in self.parts if each.object == number and not each.is_whole]

    def whole(self, number: int) -> ShownPart | None:
        """Return an object as a whole."""
        return next((each for each in self.parts if each.object == number and each.is_whole), None)
