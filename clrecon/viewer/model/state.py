"""`ViewState`: everything that a view shows, frozen, which a painter draws; picks and clip planes."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from typing import Any, Literal

import numpy as np

from clrecon.errors import UsageError
from clrecon.rendering.pictures.annotations import orientation_letters
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.directions import DIRECTIONS, checked_vector
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.text import unknown_name
from clrecon.viewer.model.measures import Measure, Point

FIT_COLORS: tuple[Literal["thickness", "error"], ...] = ("thickness", "error")
"""Numbers at the vertices of a fitted surface that colours can show, in mm."""

LAYOUTS = ("1", "1+3", "4")
"""Ways to lay the views out: the picture alone, with the slices beside it, four of one size."""

COMBINATIONS: tuple[Literal["mean", "max", "min"], ...] = ("mean", "max", "min")
"""What a thick slice shows of its samples."""

Color = tuple[float, float, float]
Box = tuple[Point, Point]
Turn = tuple[Point, Point, Point]
"""Rows of a rotation in LPS."""


@dataclass(frozen=True, kw_only=True)
class Pick:
    """A place in LPS mm that was pointed at, the object (None in a slice) and its part there, and the HU, trilinear."""

    point: Point
    object: int | None = None
    part: str | None = None
    hu: float | None = None

    def describe(self) -> dict[str, Any]:
        return {
            "point": [round(value, 3) for value in self.point],
            "object": self.object,
            "part": self.part,
            "hu": None if self.hu is None else round(self.hu, 1),
        }


@dataclass(frozen=True, kw_only=True)
class ClipPlane:
    """A plane that cuts everything, along a direction in the patient.

    direction: Unit vector in LPS towards the side that is taken away.
    low, high: Of what is shown along the direction, mm.
    share: 0 takes all away, 1 nothing.
    flipped: The other side is taken away, with 0 nothing and with 1 all.
    """

    direction: Point
    name: str
    low: float
    high: float
    share: float
    flipped: bool = False

    @property
    def row(self) -> tuple[float, float, float, float]:
        """Normal and offset as of `clrecon.Clip`: ``normal . p >= offset`` is kept."""
        height = self.low + self.share * (self.high - self.low)
        sign = 1.0 if self.flipped else -1.0
        x, y, z = (sign * value for value in self.direction)
        return x, y, z, sign * height

    def describe(self) -> dict[str, Any]:
        at_mm = self.low + self.share * (self.high - self.low)
        return {
            "name": self.name,
            "words": f"{self.name if self.name.isalpha() else orientation_letters(np.array(self.direction))} side",
            "direction": [round(value, 5) for value in self.direction],
            "share": round(self.share, 5),
            "at_mm": round(at_mm, 2),
            "flipped": self.flipped,
        }


def clip_direction(direction: str | Sequence[float]) -> tuple[Point, str]:
    """Return the unit vector of a side of the patient or of a vector in LPS, and its name."""
    if isinstance(direction, str):
        if direction not in DIRECTIONS:
            raise UsageError(unknown_name("side of the patient", direction, DIRECTIONS))
        return DIRECTIONS[direction], direction
    vector = np.array(checked_vector("the direction of a clip plane", direction))
    length = float(np.linalg.norm(vector))
    if not 1e-9 <= length < math.inf:
        raise UsageError(f"the direction of a clip plane has a length above 0, not {length:g}")
    x, y, z = (vector if abs(length - 1.0) < 1e-12 else vector / length).tolist()  # a saved one stays as it is
    return (x, y, z), f"{x:.2f}, {y:.2f}, {z:.2f}"


@dataclass(frozen=True, kw_only=True)
class ShownPart:
    """A part that can be switched: an object as a whole, a cluster of a scan's voxels, or a label.

    key: "2" for the object of number 2, "2/5" for its part of number 5.
    kind: "scan", "mesh", "cloud", "labels", "cluster", "rest" (what of a scan lies below the iso value) or "label".
    number: Number of the cluster or label in the label map by which it is drawn; 0 for "rest" and for whole objects.
    ml: Volume of its voxels.
    count: Voxels, triangles or points.
    color: (red, green, blue), 0 to 1; None: as it looks by itself.
    opacity: 0 to 1; seen only while it is visible.
    box: LPS mm.
    inside: LPS mm of a place within the cluster, by which it is known again at another iso value.
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
        return self.kind in ("scan", "mesh", "cloud", "labels")

    @property
    def is_plain(self) -> bool:
        """True where nothing of its look was changed."""
        return self.visible and self.color is None and self.opacity >= 1.0

    def describe(self) -> dict[str, Any]:
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


LEAST_ZOOM, MOST_ZOOM = 0.5, 50.0
"""Of slices, by how they fit."""


@dataclass(frozen=True, kw_only=True)
class SliceFrame:
    """What of a plane its slice shows: `zoom` times as large as it fits, about a place in LPS mm."""

    plane: str
    zoom: float
    center: Point


@dataclass(frozen=True, kw_only=True)
class ViewState:
    """What a view shows; places are LPS mm.

    iso_value: HU, of all scans.
    window: HU shown as black and white in slices.
    picture_window: The same in projections; None: that of the mode.
    table: Table and blankets are shown.
    smooth_mm: Standard deviation of the Gaussian that scans are smoothed by; 0: they are as they were read.
    fitted: The surfaces of scans lie where they were fitted to the bone, in the mode "surface".
    occlusion: Hollows of volume rendering and of surfaces at the iso value are darker (ambient occlusion).
    color_by: Number at the vertices of fitted surfaces that their colours show, one of `FIT_COLORS`.
    cross: Where the three slices go through.
    turn: Of the three slices, about the cross; None: they lie along the axes of the patient.
    slab_mm: Thickness of the slices, 0 for planes; `combine` is what is shown of its samples.
    layout: One of `LAYOUTS`.
    compare: Where pictures and slices are divided, a share of their width: the first input is shown left of it, the
        others right of it.  None: all are shown together.
    frames: Of the slices that were zoomed or shifted; the others fit.
    parts_at: Iso value of the clusters; None: they are not known.
    parts_voxels: Of which voxels, see `voxels`.
    points: Points of the tool that is used.
    """

    camera: Camera
    mode: str
    iso_value: float
    window: tuple[float, float]
    cross: Point
    turn: Turn | None = None
    slab_mm: float = 0.0
    combine: Literal["mean", "max", "min"] = "mean"
    layout: str = "1+3"
    compare: float | None = None
    frames: tuple[SliceFrame, ...] = ()
    picture_window: tuple[float, float] | None = None
    table: bool = True
    smooth_mm: float = 0.0
    fitted: bool = False
    occlusion: bool = False
    color_by: str | None = None
    parts: tuple[ShownPart, ...] = ()
    parts_at: float | None = None
    parts_voxels: tuple[bool, float] = (True, 0.0)
    tool: str | None = None
    points: tuple[Pick, ...] = ()
    measures: tuple[Measure, ...] = ()
    clips: tuple[ClipPlane, ...] = ()
    clip_box: Box | None = None

    @property
    def clip(self) -> Clip | None:
        rows = [each.row for each in self.clips]
        clip = Clip(np.array(rows)) if rows else Clip()
        if self.clip_box is not None:
            clip = clip & Clip.box(*self.clip_box)
        return clip if len(clip.planes) else None

    @property
    def voxels(self) -> tuple[bool, float]:
        """Which voxels of the scans are shown."""
        return self.table, self.smooth_mm

    @property
    def curve(self) -> tuple[Point, ...]:
        """Points of the curve that is being made, else of the last one, LPS mm."""
        if self.tool == "curve" and len(self.points) > 1:
            return tuple(each.point for each in self.points)
        return next((each.points for each in reversed(self.measures) if each.kind == "curve"), ())

    @property
    def sides(self) -> tuple[ViewState, ViewState]:
        """The state with the first input alone, and with the others: left and right of the line of `compare`."""
        inputs = [each for each in self.parts if each.is_whole and each.kind != "labels"]

        def show_some(numbers: set[int]) -> ViewState:
            parts = tuple(
                replace(each, visible=each.visible and each.object in numbers) if each in inputs else each
                for each in self.parts
            )
            return replace(self, compare=None, parts=parts)

        first, *others = (each.object for each in inputs)
        return show_some({first}), show_some(set(others))

    def frame(self, plane: str) -> SliceFrame | None:
        return next((each for each in self.frames if each.plane == plane), None)

    def part(self, key: str) -> ShownPart | None:
        return next((each for each in self.parts if each.key == key), None)

    def parts_of(self, number: int) -> list[ShownPart]:
        return [each for each in self.parts if each.object == number and not each.is_whole]

    def whole(self, number: int) -> ShownPart | None:
        return next((each for each in self.parts if each.object == number and each.is_whole), None)


SCENE, SLICES = "scene", ("axial", "coronal", "sagittal")
VIEWS = (SCENE, *SLICES, "curve")
"""The picture in three dimensions, the three slices, and the reformation along the points of the curve tool."""


def picture_key(state: ViewState, view: str) -> Hashable:
    """Return what the picture of a view depends on: equal keys, equal pictures."""
    looks = tuple(part for part in state.parts if not part.is_plain)  # the others are drawn as if they were not known
    parts = (looks, (state.parts_at, state.parts_voxels) if looks else None)
    if view == SCENE:
        cut = (state.clips, state.clip_box)
        return (
            *(state.camera, state.mode, state.iso_value, state.picture_window, state.voxels),
            *(state.fitted, state.color_by, parts, cut, state.compare, state.occlusion),
        )
    if view in SLICES:
        return (
            state.cross,
            state.turn,
            state.frame(view),
            state.window,
            state.slab_mm,
            state.combine,
            state.voxels,
            parts,
            state.compare,
        )
    return (state.curve, state.window, state.voxels)
