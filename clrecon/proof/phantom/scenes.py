"""Scenes: bodies made of many parts, each of one material, drawn in HU, with a material label for every voxel.

Pieces have their own frame and box, and are drawn only in slices that meet the box.

The parts are painted in order, later ones over earlier ones, in mm about the centre of the volume.  Axes are the
patient's: x to the left, y to the posterior, z to the superior.

Tables that bodies lie on are plates and a head rest, made of thin dense shells around foam.  Each table is planned for
a body that ends at y = 0, y downwards; `lay_under` moves it under the back, or under the front of a prone patient.  HU
and thickness are round figures of carbon fibre (100 to 400 HU, 1.5 to 4 mm) around foam (-930 HU).  The flat table has
metal rails, as some real tables have."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry import column_spacing
from clrecon.geometry.affine import Float64Array
from clrecon.proof.phantom.fields import Field, Point, capsule, coverage, ellipse, ellipsoid
from clrecon.proof.phantom.settings import CENTRE_LPS_MM, PhantomSettings
from clrecon.system.progress import Progress


class Window:
    """The part of a slice in which a piece lies, with the coordinates there."""

    def __init__(self, region: tuple[slice, slice], local: Float64Array, k: float):
        self.region = region
        j = np.arange(region[0].start, region[0].stop, dtype=np.float64)[:, None]
        i = np.arange(region[1].start, region[1].stop, dtype=np.float64)[None, :]
        self.x, self.y, self.z = (
            (row[0] * i + row[1] * j + (row[2] * k + row[3])).astype(np.float32) for row in local[:3]
        )


class PlacedPiece:
    """A piece, from `low` to `high` in its own frame, with its box in indices and its local affine."""

    def __init__(
        self, center: Float64Array, axes: Float64Array, low: Float64Array, high: Float64Array, affine: Float64Array,
        shape_kji: tuple[int, int, int],
    ):  # fmt: skip
        inverse = np.linalg.inv(affine)
        corners = center + np.array(list(itertools.product(*zip(low, high, strict=True)))) @ axes
        ijk = corners @ inverse[:3, :3].T + inverse[:3, 3]
        self.low = np.floor(ijk.min(axis=0)).astype(int)
        self.high = np.ceil(ijk.max(axis=0)).astype(int) + 1
        nk, nj, ni = shape_kji
        self.region = (
            slice(min(max(self.low[1], 0), nj), max(min(self.high[1], nj), 0)),
            slice(min(max(self.low[0], 0), ni), max(min(self.high[0], ni), 0)),
        )
        self.local = np.eye(4)
        self.local[:3, :3] = axes @ affine[:3, :3]
        self.local[:3, 3] = axes @ (affine[:3, 3] - center)

    def meets(self, k: int) -> bool:
        """True where slice k can hold some of the piece."""
        rows, columns = self.region
        return bool(self.low[2] <= k < self.high[2]) and rows.start < rows.stop and columns.start < columns.stop

    def window(self, k: float) -> Window:
        """Return the window of the piece, with its coordinates, in (sub-)slice k."""
        return Window(self.region, self.local, k)


def paint(canvas: Field, region: tuple[slice, slice], share: Field, hu: float | Field) -> None:
    """Blend `hu` into a region of a slice; the weight is the share of each voxel that lies in the part."""
    view = canvas[region]
    view += share * (hu - view)


Float32Array = NDArray[np.float32]
LabelArray = NDArray[np.uint8]

MATERIALS = ("air", "tissue", "bone", "contrast", "metal", "water", "table")
"""Materials of the parts; the label of a voxel is the index in this tuple."""

AIR_HU = -1000.0
METAL_HU = 8000.0
"""Far above the highest 12-bit value, so that it is cut off when stored."""
CEILING_HU = 3071
"""Highest value of 12 stored bits with the intercept -1024; metal is cut off there."""
DENSE_HU = 300.0
"""Voxels above this are counted for each material."""


@dataclass(frozen=True)
class Part:
    """One solid of one of `MATERIALS`.

    distance: Takes x, y, z (float32, mm in the part's own frame) and gives the distance to the surface in mm, positive
        inside.
    low, high: (x, y, z). Box that holds the part, in its own frame, mm.
    center: (x, y, z). Origin of the frame of the part, mm about the centre of the volume.
    axes: ndarray, shape (3, 3). Rows are the directions of that frame.
    """

    material: str
    hu: float
    distance: Callable[[Field, Field, Field], Field]
    low: Point
    high: Point
    center: Point = (0.0, 0.0, 0.0)
    axes: Float64Array = field(default_factory=lambda: np.eye(3))

    def distance_at(self, x: Field, y: Field, z: Field) -> Field:
        """Return the distance to the surface at points in mm about the centre of the volume."""
        from_center = [at - np.float32(origin) for at, origin in zip((x, y, z), self.center, strict=True)]
        local = (sum(np.float32(c) * at for c, at in zip(axis, from_center, strict=True)) for axis in self.axes)
        return np.asarray(self.distance(*local), dtype=np.float32)


@dataclass(frozen=True)
class Plan:
    """The parts of a body in order, y of its front and back for a table, and the head's middle (x, z) for a rest."""

    parts: Sequence[Part]
    front: float
    back: float
    rest: tuple[float, float] = (0.0, 0.0)


def plan_subslices(affine: Float64Array) -> tuple[Float64Array, float]:
    """Return the places, in slices, of thin slices that are averaged to one, and mm of an interface's ramp: a voxel."""
    di, dj, dk = column_spacing(affine)
    count = int(np.clip(round(dk / math.sqrt(di * dj)), 1, 4))
    return (np.arange(count) + 0.5) / count - 0.5, (di * dj * dk / count) ** (1.0 / 3.0)


def draw_scene(
    parts: Sequence[Part], settings: PhantomSettings, affine: Float64Array, progress: Progress | None = None
) -> tuple[Float32Array, LabelArray]:
    """Draw the parts, in order, without point spread and noise: HU, (nk, nj, ni) float32, and labels, uint8, index in
    `MATERIALS` of the part that holds the centre of each voxel.

    Every interface is a linear ramp of about one voxel.  Thick slices are averaged from thin ones.
    """
    shape = settings.shape_kji
    grid = affine.copy()
    grid[:3, 3] -= CENTRE_LPS_MM
    offsets, ramp = plan_subslices(affine)
    margin = np.full(3, 2.0 * ramp + float(np.linalg.norm(grid[:3, :3], axis=0).max()))
    placed = [PlacedPiece(np.array(p.center), p.axes, p.low - margin, p.high + margin, grid, shape) for p in parts]
    voxels, labels = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.uint8)
    for k in range(shape[0]):
        met = [(part, piece) for part, piece in zip(parts, placed, strict=True) if piece.meets(k)]
        for offset in offsets:
            canvas = np.full(shape[1:], AIR_HU, dtype=np.float32)
            for part, piece in met:
                window = piece.window(k + offset)
                paint(canvas, window.region, coverage(_distance(part, window), ramp), part.hu)
            voxels[k] += canvas
        voxels[k] /= np.float32(len(offsets))
        for part, piece in met:
            window = piece.window(float(k))
            labels[k][window.region][_distance(part, window) >= 0.0] = MATERIALS.index(part.material)
        if progress is not None:
            progress("draw", k + 1, shape[0])
    return voxels, labels


def _distance(part: Part, window: Window) -> Field:
    return np.asarray(part.distance(window.x, window.y, window.z), dtype=np.float32)


def facts_of_parts(voxels: NDArray[np.int16], labels: LabelArray, affine: Float64Array) -> dict[str, dict[str, float]]:
    """Describe each material that is present: its label, voxels, volume and number of dense voxels."""
    voxel_ml = abs(float(np.linalg.det(affine[:3, :3]))) / 1000.0
    facts = {}
    for label, material in enumerate(MATERIALS):
        mask = labels == label
        if count := int(np.count_nonzero(mask)):
            facts[material] = {
                "label": label,
                "voxels": count,
                "volume_ml": round(count * voxel_ml, 3),
                "volume_mm3": round(1000.0 * count * voxel_ml, 4),
                "voxels_above_300_hu": int(np.count_nonzero(voxels[mask] > DENSE_HU)),
            }
    return facts


def bone_depth(parts: Sequence[Part], points_mm: Float64Array, *materials: str) -> Float32Array:
    """Return how deep points, (n, 3) LPS mm, lie in parts of these materials, mm; exact for rods and balls."""
    x, y, z = np.ascontiguousarray((points_mm - CENTRE_LPS_MM).T, dtype=np.float32)
    depth = np.full(len(points_mm), -np.inf, dtype=np.float32)
    for part in parts:
        part_depth = part.distance_at(x, y, z)
        depth = np.maximum(depth, part_depth) if part.material in materials else np.minimum(depth, -part_depth)
    return depth


Distance = Callable[[Field, Field, Field], Field]


def to_point(vector: ArrayLike) -> Point:
    x, y, z = map(float, np.asarray(vector))
    return x, y, z


def ball(material: str, hu: float, center: Point, half: Point) -> Part:
    low = (-half[0], -half[1], -half[2])
    return Part(material, hu, lambda x, y, z: ellipsoid(x, y, z, half), low, half, center)


def rod(material: str, hu: float, a: Point, b: Point, radius_a: float, radius_b: float | None = None) -> Part:
    end = radius_a if radius_b is None else radius_b
    wide = max(radius_a, end)
    low, high = np.minimum(a, b) - wide, np.maximum(a, b) + wide
    return Part(material, hu, lambda x, y, z: capsule((x, y, z), a, b, radius_a, end), to_point(low), to_point(high))


def column(
    material: str,
    hu: float,
    center: tuple[float, float],
    half: tuple[float, float],
    z: tuple[float, float] = (-1e4, 1e4),
) -> Part:
    """Make an elliptic column along z between two heights; by default without ends."""

    def distance(x: Field, y: Field, height: Field) -> Field:
        ends = np.minimum(height - np.float32(z[0]), np.float32(z[1]) - height)
        return np.minimum(ellipse(x, y, *half), ends)

    return Part(material, hu, distance, (-half[0], -half[1], z[0]), (*half, z[1]), (*center, 0.0))


def box(material: str, hu: float, low: Point, high: Point) -> Part:
    half = np.subtract(high, low) / 2.0
    middle = np.add(high, low) / 2.0

    def distance(x: Field, y: Field, z: Field) -> Field:
        sides = (np.float32(length) - np.abs(at) for length, at in zip(half, (x, y, z), strict=True))
        return np.minimum.reduce(list(sides))

    return Part(material, hu, distance, to_point(-half), to_point(half), to_point(middle))


def cut(part: Part, keep: Distance) -> Part:
    """Cut a part: keep the points where `keep`, in the part's own frame, is above 0."""
    whole = part.distance
    return dataclasses.replace(part, distance=lambda x, y, z: np.minimum(whole(x, y, z), keep(x, y, z)))


ENDLESS = 1e4
FOAM_HU = -930.0


def _sandwich(outline: Distance, thickness: float, hu: float, half_width: float, height: float) -> list[Part]:
    """Make a shell `thickness` mm thick around foam, endless along z, from `height` above 0 to 60 mm below."""
    low, high = (-half_width, -height, -ENDLESS), (half_width, 60.0, ENDLESS)
    return [
        Part("table", hu, outline, low, high),
        Part("table", FOAM_HU, lambda x, y, z: outline(x, y, z) - np.float32(thickness), low, high),
    ]


def _flat(plan: Plan) -> list[Part]:
    """Make a plate 24 mm thick and 420 mm wide, with a metal rail along either edge."""

    def outline(x: Field, y: Field, z: Field) -> Field:
        return np.minimum(np.minimum(y, 24.0 - y), np.float32(210.0) - np.abs(x))

    def rail(x: Field, y: Field, z: Field) -> Field:
        return np.minimum(4.0 - np.abs(np.abs(x) - np.float32(200.0)), 4.0 - np.abs(y - 34.0))

    rails = Part("table", 1800.0, rail, (-205.0, 29.0, -ENDLESS), (205.0, 39.0, ENDLESS))
    return [*_sandwich(outline, 3.0, 250.0, 210.0, 0.0), rails]


def _curved(plan: Plan) -> list[Part]:
    """Make a trough 18 mm thick: an arc of 260 mm radius, 400 mm wide."""

    def outline(x: Field, y: Field, z: Field) -> Field:
        radius = np.sqrt(x * x + (y + np.float32(260.0)) ** 2) - np.float32(260.0)
        return np.minimum(np.minimum(radius, 18.0 - radius), np.float32(200.0) - np.abs(x))

    return _sandwich(outline, 2.5, 350.0, 200.0, 100.0)


def _head_rest(plan: Plan) -> list[Part]:
    """Make a bowl of 4 mm close around the head on a foam cushion, and a bar along z that carries it."""
    x0, z0 = plan.rest
    high = np.float32(95.0)  # radius of the bowl

    def bowl(x: Field, y: Field, z: Field) -> Field:
        across = np.sqrt((x - np.float32(x0)) ** 2 + (y + np.float32(84.0)) ** 2)
        along = np.clip(np.abs(z - np.float32(z0)) - np.float32(70.0), 0.0, None)
        radius = np.sqrt(across * across + along * along) - high
        return np.minimum(np.minimum(radius, 4.0 - radius), y + np.float32(60.0))

    def cushion(x: Field, y: Field, z: Field) -> Field:
        across = np.sqrt((x - np.float32(x0)) ** 2 + (y + np.float32(84.0)) ** 2)
        length = np.float32(70.0) - np.abs(z - np.float32(z0))
        return np.minimum(np.minimum(high - across, y + np.float32(40.0)), length)

    def bar(x: Field, y: Field, z: Field) -> Field:
        return np.minimum(30.0 - np.abs(x - np.float32(x0)), np.minimum(y - 14.0, 24.0 - y))

    low, top = (x0 - 105.0, -62.0, -ENDLESS), (x0 + 105.0, 30.0, ENDLESS)
    return [
        Part("table", FOAM_HU, cushion, low, top),
        Part("table", 220.0, bowl, low, top),
        Part("table", 220.0, bar, low, top),
        Part("table", FOAM_HU, lambda x, y, z: bar(x, y, z) - np.float32(2.0), low, top),
    ]


TABLES: dict[str, Callable[[Plan], list[Part]]] = {
    "none": lambda plan: [],
    "flat": _flat,
    "curved": _curved,
    "headrest": _head_rest,
}


def lay_under(plan: Plan, table: str, gap_mm: float, prone: bool) -> list[Part]:
    """Make a table `gap_mm` under a body's back, or under its front when it lies prone; below 0 the body sinks in."""
    down = -1.0 if prone else 1.0
    center = (0.0, plan.front - gap_mm if prone else plan.back + gap_mm, 0.0)
    axes = np.diag((1.0, down, 1.0))
    return [dataclasses.replace(part, center=center, axes=axes) for part in TABLES[table](plan)]
