"""The material below a surface, told by its HU: bone, contrast medium, metal.

Bone has a compact wall: within a few millimetres below its surface, values rise to 600 HU and more at some places of
every bone, and they vary from place to place.  Heart and vessels with contrast medium have one lower value, which
continues below the surface.  Thin shells of a table have neither property.  Values hardly vary within a voxel, so for
voxels larger than 1 mm depths are counted in voxels.  Figures are in docs/iso_value.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.dense_pieces import RAIL_MM, STRAIGHT_MM
from clrecon.errors import UsageError
from clrecon.geometry import METAL_HU, Volume
from clrecon.geometry.iso_rule import IsoRule
from clrecon.mesh.compare.iso_distance import trilinear_values
from clrecon.mesh.mesh import Mesh
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import chunks, find_bounds
from clrecon.system.records import Record

COMPACT_HU = 600.0
"""Compact bone reaches this below its surface; contrast medium in heart and vessels does not."""
WALL_MM = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Depths along the inward normal, to 1.5 voxels if that is deeper; the wall is the highest value at these depths."""
_FLAT_MM, _FLAT_HU = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0), 120.0
"""A wall is flat where values at these depths below it, in voxels of above 1 mm, differ by at most `_FLAT_HU`."""
NEAR_MM, _NEAR_STEPS = 15.0, 5.0
"""Bone has a compact wall within this distance, or this number of voxels, of every place; coarse voxels blur most."""
_CELLS_AROUND = 3**0.5
"""It is looked for in the cell of this size and in the 26 around it."""
_LEAST_COMPACT = 0.05
FAINT_HU, _FAINT_SPREAD_HU = 500.0, 200.0
"""Thin bone without walls reaches the first value, and exceeds the median by the second; vessels have one value."""
_LEAST_FLAT = 0.05
MOST_SAMPLES = 8_000
_MOST_COMPONENT_SAMPLES = 500
FEWEST_VERTICES = 150
"""Least number of vertices of a component that is judged; smaller ones are crumbs."""
_RAIL_SECTIONS = 8
"""Number of parts of the scan, along its slices, in which the cross section of a rail is compared."""
_RAIL_SHIFT_MM = 1.0
"""Sides of a rail differ by at most this, or half a voxel, from part to part, because of noise and shadows."""


@dataclass(frozen=True)
class Walls:
    """Values below some vertices of a surface; shapes (n,).

    points: ndarray, shape (n, 3), float64, LPS mm
    wall: HU. Highest value at the depths `WALL_MM`.
    flat: Values below the wall are equal, below `COMPACT_HU`, and inside down to the last depth.
    near_mm: Largest distance of a compact wall.
    """

    points: NDArray[np.float64]
    wall: NDArray[np.float64]
    flat: NDArray[np.bool_]
    near_mm: float = NEAR_MM

    def where(self, rows: slice) -> Walls:
        return Walls(self.points[rows], self.wall[rows], self.flat[rows], self.near_mm)


def sample_walls(vertices: NDArray[np.floating], normals: NDArray[np.floating], volume: Volume, rule: IsoRule) -> Walls:
    """Sample values below the vertices (n, 3) of a mesh that was extracted from a volume, along their normals."""
    points, inward = vertices.astype(np.float64), -normals.astype(np.float64)
    # mm from one plane of voxels to the next, for the axis crossed soonest
    steps = inward @ np.linalg.inv(volume.affine[:3, :3]).T
    longer = np.maximum(1.0 / np.maximum(np.abs(steps).max(axis=1), 1e-9), 1.0)

    def look_beneath(depths_mm: Sequence[float], times: NDArray[np.float64]) -> NDArray[np.float64]:
        ways = (points + (depth * times)[:, None] * inward for depth in depths_mm)
        return np.stack([trilinear_values(volume, rule, volume.lps_to_ijk(way)) for way in ways])

    wall = look_beneath(WALL_MM, np.maximum(_FLAT_MM[0] * longer / WALL_MM[-1], 1.0)).max(axis=0)
    deep = look_beneath(_FLAT_MM, longer)
    low, high = deep.min(axis=0), deep.max(axis=0)
    flat = (wall < COMPACT_HU) & (low > rule.iso_level) & (high - low < _FLAT_HU)
    return Walls(points, wall, flat, near_mm(volume))


def near_mm(volume: Volume) -> float:
    """Return within which distance of every place bone has a compact wall."""
    return max(NEAR_MM, _NEAR_STEPS * max(volume.spacing))


@dataclass(frozen=True, eq=False)
class WallLook(Record):
    """The judgement of a surface by the values below it.

    looks_like: "bone", "faint bone", "metal", "contrast medium" (or another even body) or "no bone" (a thin shell of a
        table, noise).
    compact_share: Share of the surface that has a wall of `COMPACT_HU` or more.
    contrast_share: Share that is flat beneath and has no compact wall within about ``near_mm``.
    metal_share: Share that has a wall above `METAL_HU`.
    """

    looks_like: str
    compact_share: float
    contrast_share: float
    metal_share: float
    wall_hu: Mapping[str, float]
    samples: int


def judge_walls(walls: Walls) -> WallLook:
    median, p90, p99 = (float(value) for value in np.percentile(walls.wall, (50, 90, 99)))
    compact = walls.wall >= COMPACT_HU
    compact_share = float(compact.mean())
    contrast_share = float((walls.flat & ~lie_near(walls.points, compact, walls.near_mm, _CELLS_AROUND)).mean())
    metal_share = float((walls.wall > METAL_HU).mean())
    if metal_share > 0.5:
        looks_like = "metal"
    elif compact_share >= _LEAST_COMPACT:
        looks_like = "bone"
    elif p99 >= FAINT_HU and p99 - median >= _FAINT_SPREAD_HU:
        looks_like = "faint bone"
    else:
        looks_like = "contrast medium" if contrast_share >= _LEAST_FLAT else "no bone"
    return WallLook(
        looks_like,
        round(compact_share, 4),
        round(contrast_share, 4),
        round(metal_share, 4),
        {"median": round(median, 1), "p90": round(p90, 1), "p99": round(p99, 1)},
        len(walls.wall),
    )


def looks_like_bone(judged: WallLook | None) -> bool:
    return judged is not None and judged.looks_like in ("bone", "faint bone")


def judge_components(
    mesh: Mesh, volume: Volume, rule: IsoRule, count: int, label_of_vertex: NDArray[np.int64],
    fewest: int = FEWEST_VERTICES,
) -> list[WallLook | None]:  # fmt: skip
    """Judge each component of a surface with normals; None for crumbs of less than the `fewest` vertices."""
    is_large = np.bincount(label_of_vertex[label_of_vertex >= 0], minlength=count) >= fewest
    judged: list[WallLook | None] = [None] * count
    if not is_large.any():
        return judged
    chosen = [rows[:: -(-len(rows) // _MOST_COMPONENT_SAMPLES)] for rows in _rows_of(label_of_vertex, is_large)]
    rows = np.concatenate(chosen)
    walls = sample_walls(mesh.vertices[rows], normals_of(mesh)[rows], volume, rule)
    first = 0
    for component, samples in zip(np.flatnonzero(is_large), chosen, strict=True):
        judged[component] = judge_walls(walls.where(slice(first, first + len(samples))))
        first += len(samples)
    return judged


def find_rails(
    mesh: Mesh, volume: Volume, label_of_vertex: NDArray[np.int64], chosen: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Find which of the chosen components are rails of a table: thin, and equal in all slices.

    A table moves through the scanner along the step of the slices; bones taper and bend, and shafts are thicker than
    `RAIL_MM`. In scans shorter than `STRAIGHT_MM` bones are just as straight, so nothing is found.

    label_of_vertex: Shape (n,), below 0 for none.
    chosen: Shape (count,).
    """
    rails = np.zeros(len(chosen), dtype=bool)
    for number, rows in zip(np.flatnonzero(chosen), _rows_of(label_of_vertex, chosen), strict=True):
        width = _measure_section(mesh.vertices, rows, volume)
        # it is blurred by about a voxel
        rails[number] = width is not None and bool((width - volume.spacing[:2]).min() <= RAIL_MM)
    return rails


def _rows_of(label_of_vertex: NDArray[np.int64], chosen: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the vertices of each of the chosen components, at least one, in their order."""
    count = int(np.count_nonzero(chosen))
    if count <= 8:  # which takes less time than to put all in order
        return [np.flatnonzero(label_of_vertex == number) for number in np.flatnonzero(chosen)]
    rank = np.full(len(chosen) + 1, -1, np.int16 if count < 2**15 else np.int64)  # sorted in linear time in 16 bits
    rank[:-1][chosen] = np.arange(count)
    ranks = rank[label_of_vertex]  # the last entry is for vertices that no triangle uses, -1
    rows = np.flatnonzero(ranks >= 0)
    ranks = ranks[rows]
    return np.split(rows[np.argsort(ranks, kind="stable")], np.cumsum(np.bincount(ranks, minlength=count))[:-1])


def is_straight(points: NDArray[np.float64], volume: Volume) -> bool:
    """True where points (n, 3) of a surface, LPS mm, keep the same sides from the first slice to the last."""
    return _measure_section(points, np.arange(len(points)), volume) is not None


def _measure_section(
    points: NDArray[np.floating], rows: NDArray[np.intp], volume: Volume
) -> NDArray[np.float64] | None:
    """Return width and height, mm, of a cross section that is equal in all slices; None where it is not.

    points: Shape (n, 3), LPS mm, of which those of the `rows` count.  All of them as float64 would fill new memory.
    """
    last = volume.shape_ijk[2] - 1
    if last * volume.spacing[2] < STRAIGHT_MM:
        return None
    lowest, highest = np.inf, -np.inf
    section = np.empty(len(rows), np.int8)
    for piece in chunks(len(rows)):
        k = volume.lps_to_ijk(points.take(rows[piece], axis=0))[:, 2]
        lowest, highest = min(lowest, k.min()), max(highest, k.max())
        parts = ((k - 1.0) * (_RAIL_SECTIONS / max(last - 2.0, 1.0))).astype(np.int8).clip(0, _RAIL_SECTIONS - 1)
        # without the faces that close the surface at the border of the scan
        section[piece] = np.where((k >= 1.0) & (k <= last - 1.0), parts, _RAIL_SECTIONS)
    if lowest > 1.0 or highest < last - 1.0:
        return None
    if np.bincount(section, minlength=_RAIL_SECTIONS)[:_RAIL_SECTIONS].min() == 0:
        return None
    sides = []
    for part in (0, _RAIL_SECTIONS - 1, *range(1, _RAIL_SECTIONS - 1)):  # the ends first: bones differ there
        across = volume.lps_to_ijk(points.take(rows[section == part], axis=0))[:, :2] * volume.spacing[:2]
        sides.append(np.percentile(across, (2, 98), axis=0))
        moved = np.ptp(sides, axis=0).max(axis=0)
        if (moved > np.maximum(_RAIL_SHIFT_MM, 0.5 * np.array(volume.spacing[:2]))).any():
            return None
    return np.asarray(np.diff(np.median(sides, axis=0), axis=0)[0])


def normals_of(mesh: Mesh) -> NDArray[np.float32]:
    if mesh.normals is None:
        raise UsageError("walls are looked for along normals: the mesh has none")
    return mesh.normals


def lie_near(
    points: NDArray[np.floating], marked: NDArray[np.bool_], size_mm: float, cells: float
) -> NDArray[np.bool_]:
    """Mark points, mm, whose cell of `size_mm` is at most so many cells from the nearest one with a marked point."""
    reach = math.ceil(cells)
    start, end = find_bounds(points)
    size = np.floor((end - start) / size_mm).astype(np.int64) + 1
    numbers: NDArray[np.int64] = np.zeros(len(points), np.int64)
    for column, first, count in zip(points.T, start, size, strict=True):
        numbers *= count
        numbers += np.floor((column - first) / size_mm).astype(np.int64)
    has_marked, is_near = np.zeros(size, dtype=bool), np.zeros(size, dtype=bool)
    has_marked.reshape(-1)[numbers[marked]] = True
    is_marked = np.pad(has_marked, reach)
    for offset in product(range(2 * reach + 1), repeat=3):
        if math.dist(offset, (reach,) * 3) <= cells:
            is_near |= is_marked[tuple(slice(first, first + count) for first, count in zip(offset, size, strict=True))]
    return is_near.reshape(-1).take(numbers)


def lie_near_line(points: NDArray[np.floating], line: NDArray[np.float64], distance: float) -> NDArray[np.bool_]:
    """Mark the points nearer than `distance` to a line through points (n, 3), all in mm."""
    near = np.zeros(len(points), dtype=bool)
    for start, end in zip(line[:-1], line[1:], strict=True):
        line_vector = end - start
        along = np.clip((points - start) @ line_vector / max(float(line_vector @ line_vector), 1e-12), 0.0, 1.0)
        near |= np.linalg.norm(points - start - along[:, None] * line_vector, axis=1) < distance
    return near
