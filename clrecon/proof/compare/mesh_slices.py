"""A mesh cut into slices again, against the voxels that it was made from.

Both are compared on a lattice of points finer than the voxels: the rows of it pierce the mesh, and the trilinear HU
reach a level in them.  What is inside is written by its ends, as rows of runs.  A row of the lattice runs along i; each
point from which on the state differs from that of the point before has a key, (k * nj + j) * (ni + 1) + i.  The state
before a row is outside, and where its last point is inside the run ends at i = ni, beyond the row: every row has an
even number of keys.  Memory grows with the surface, not with the lattice.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule, choose_iso_rule
from clrecon.mesh.mesh import Mesh
from clrecon.system.arguments import explains_arguments
from clrecon.system.pieces import chunks
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record

FINER = 3
"""Points of the lattice for each voxel, along each axis."""

OFFSETS = (0.137, 0.271, 0.389)
"""Where the lattice begins, in its own steps along i, j, k: off the planes of the voxels and of each other."""

_MOST_ODD = 0.01
"""Share of the rows with the mesh that it may pierce an odd number of times before it is refused as open."""


@dataclass(frozen=True, eq=False)
class SliceOverlap(Record):
    """How far a mesh, filled in slices, agrees with the voxels' trilinear HU.

    dice: 2 common / (points in the mesh + points in the HU) on the fine lattice.
    voxel_dice: The same on the voxels' own lattice.  It cannot see where on its edge a vertex lies.
    finer: Points of the fine lattice for each voxel and axis.
    points_mesh, points_hu, points_common: Points of the fine lattice inside of the mesh, at the level or above, and
        both.
    rows_odd: Rows of the fine lattice that the mesh pierces an odd number of times, where it is open; left out.
    """

    dice: float
    voxel_dice: float
    finer: int
    points_mesh: int
    points_hu: int
    points_common: int
    rows_odd: int


@explains_arguments
def measure_slices(
    mesh: Mesh,
    volume: Volume,
    iso_value: float,
    *,
    closed: bool = True,
    finer: int = FINER,
    offsets: Sequence[float] = OFFSETS,
    progress: Progress | None = None,
) -> SliceOverlap:
    """Cut a mesh into slices again and compare them with the HU, on a lattice finer than the voxels and off their
    planes.

    A point of the lattice is in the mesh when a row of the lattice has pierced it an odd number of times before.  A
    row that runs through an edge or a vertex pierces one of the triangles there, by half-open intervals.  A point is
    in the bone when the trilinear HU reach the level.

    Parameters
    ----------
    mesh : Mesh
        Closed; the patient frame is that of the volume.
    volume : Volume
        The voxels, uneven ones too.
    iso_value : float
        HU, that of the mesh.
    closed : bool
        The mesh was closed where it leaves the volume: see `extract_isosurface`.
    finer : int
        Points of the lattice for each voxel and axis, 1 to 16.
    offsets : three floats
        Where the lattice begins, in its own steps along i, j, k, from 0 to below 1.
    progress : callable, optional
        Called as ``progress("slices", layers of cells done, all layers)``, once for each lattice.

    Returns
    -------
    SliceOverlap

    Raises
    ------
    UsageError
        The mesh is open: more than one row in a hundred is pierced an odd number of times.  Or an argument is wrong,
        or the mesh lies wholly outside of the volume.
    NoSurfaceError
        The mesh is empty.
    """
    return ScanSlices(volume, iso_value, closed, finer, offsets).measure(mesh, progress or ignore_progress)


class ScanSlices:
    """The HU of a scan on the lattices of `measure_slices`, for several meshes."""

    def __init__(
        self, volume: Volume, iso_value: float, closed: bool, finer: int = FINER, offsets: Sequence[float] = OFFSETS
    ):
        shifts = _check_lattice(finer, offsets)
        if np.ndim(iso_value):
            raise UsageError(f"slices are compared at one iso value, not at {iso_value!r}")
        self._volume, self._rule = volume, choose_iso_rule(volume, iso_value, closed=closed)
        lattices = ((int(finer), shifts), (1, (0.0, 0.0, 0.0)))
        self._lattices = [Lattice.over(volume, self._rule, *lattice) for lattice in lattices]
        self._runs: dict[Lattice, Keys] = {}

    def measure(self, mesh: Mesh, report: Progress = ignore_progress) -> SliceOverlap:
        mesh.check()
        if mesh.triangle_count == 0:
            raise NoSurfaceError("a mesh without triangles has no slices")
        ijk = self._volume.lps_to_ijk(mesh.vertices)
        _check_place(ijk, self._volume, self._rule)
        layers = self._lattices[0].cells_ijk[2]
        overlaps = []
        for n, lattice in enumerate(self._lattices):
            report("slices", n * layers, 2 * layers)
            overlaps.append(self._count_overlap(find_piercings(ijk, mesh.triangles, lattice), lattice))
        fine, overlap = overlaps
        report("slices", 2 * layers, 2 * layers)
        return SliceOverlap(
            dice=fine.dice,
            voxel_dice=overlap.dice,
            finer=self._lattices[0].finer,
            points_mesh=fine.mesh,
            points_hu=fine.hu,
            points_common=fine.common,
            rows_odd=fine.odd,
        )

    def _count_overlap(self, mesh: Keys, lattice: Lattice) -> _Counts:
        """Count the points of a lattice that are in a mesh, by its piercings, in the HU, and in both."""
        if lattice not in self._runs:
            self._runs[lattice] = find_level_runs(self._volume, self._rule, lattice)
        hu = self._runs[lattice]
        rows, ends = np.unique(lattice.row_of(mesh), return_counts=True)
        odd = rows[ends % 2 == 1]
        if len(odd) > _MOST_ODD * len(rows):
            raise UsageError(
                f"the mesh is open: {len(odd)} of {len(rows)} rows through it pierce it an odd number of times, and"
                " what lies inside is not defined; close it first"
            )
        if len(odd):
            mesh, hu = (keys[~np.isin(lattice.row_of(keys), odd)] for keys in (mesh, hu))
        inside, wanted = count_points(mesh), count_points(hu)
        apart = count_points(exclusive_or(mesh, hu))
        return _Counts(inside, wanted, (inside + wanted - apart) // 2, len(odd))


def _check_lattice(finer: int, offsets: Sequence[float]) -> tuple[float, float, float]:
    if isinstance(finer, bool) or not isinstance(finer, int | np.integer) or not 1 <= finer <= 16:
        raise UsageError(f"the lattice is a whole number of times finer than the voxels, 1 to 16, not {finer!r}")
    if len(offsets) != 3 or not all(0.0 <= offset < 1.0 for offset in offsets):
        raise UsageError(f"the lattice has three offsets from 0 to below 1, not {tuple(offsets)}")
    return float(offsets[0]), float(offsets[1]), float(offsets[2])


def _check_place(ijk: NDArray[np.float64], volume: Volume, rule: IsoRule) -> None:
    low, high = ijk.min(axis=0), ijk.max(axis=0)
    if (high < -rule.border).any() or (low > np.array(volume.shape_ijk) - 1 + rule.border).any():
        raise UsageError(
            f"the mesh lies outside of the volume: it runs from {low.round(1).tolist()} to {high.round(1).tolist()} in"
            f" voxels (i, j, k) of {list(volume.shape_ijk)}; see whether both are in the same patient frame"
        )


@dataclass(frozen=True)
class _Counts:
    mesh: int
    hu: int
    common: int
    odd: int

    @property
    def dice(self) -> float:
        both = self.mesh + self.hu
        return 2.0 * self.common / both if both else 0.0


_PIECE = 1 << 14
"""Triangles at a time."""

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def find_piercings(ijk: Float64Array, triangles: NDArray[np.uint32], lattice: Lattice) -> IntArray:
    """Find the points of a lattice from which on rows along i have passed through a mesh once more.

    A triangle is cut by the planes of the lattice, and the line of the cut by its rows.  An edge takes part in the
    planes from its lower end on up to, but without, its upper end, and so does a line of a cut in rows.  The two
    triangles at an edge compute the same point there, in the same order of operations: a closed mesh is pierced an
    even number of times by every row, whatever the rounding.

    ijk: ndarray, shape (n, 3), float64. Vertices in index coordinates of the voxels.

    Returns: ndarray, shape (p,), int64, ascending. Ends of runs of points inside, see the head of this file;
        those that would be there an even number of times are not.
    """
    points = np.ascontiguousarray(lattice.number(ijk).T)
    piercings = [np.zeros(0, dtype=np.int64)]
    piercings += [_pierce(points, triangles[where], lattice.shape_ijk) for where in chunks(len(triangles), _PIECE)]
    keys = np.sort(np.concatenate(piercings))
    fresh = np.flatnonzero(np.diff(keys, prepend=-1))
    return keys[fresh[np.diff(fresh, append=len(keys)) % 2 == 1]]


def _spread_rows(first: IntArray, end: IntArray) -> tuple[IntArray, IntArray]:
    """Return, for intervals of whole numbers, the interval of each number and the number."""
    count = np.maximum(end - first, 0)
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) + (first - np.cumsum(count) + count)[row]


def _pierce(points: Float64Array, triangles: NDArray[np.uint32], shape_ijk: tuple[int, int, int]) -> IntArray:
    """Return the numbers of `find_piercings` for triangles, shape (m, 3), between points, shape (3, n)."""
    ni, nj, nk = shape_ijk
    heights = points[2]
    a, b, c = triangles.T.astype(np.intp)
    a, b = _put_in_order(a, b, heights)
    b, c = _put_in_order(b, c, heights)
    a, b = _put_in_order(a, b, heights)
    row, plane = _spread_rows(_first_from(heights[a], nk), _first_from(heights[c], nk))
    a, b, c = (point[row] for point in (a, b, c))
    upper = plane >= heights[b]
    first = _points_at(points[:, a], points[:, c], plane)
    second = _points_at(points[:, np.where(upper, b, a)], points[:, np.where(upper, c, b)], plane)
    swapped = first[1] > second[1]
    first, second = np.where(swapped, second, first), np.where(swapped, first, second)
    line, at_row = _spread_rows(_first_from(first[1], nj), _first_from(second[1], nj))
    i = _first_from(_points_at(first[:, line], second[:, line], at_row)[0], ni)
    return np.asarray((plane[line] * nj + at_row) * (ni + 1) + i)


def _put_in_order(first: IntArray, second: IntArray, heights: Float64Array) -> tuple[IntArray, IntArray]:
    """Return points with those first that are not higher."""
    swapped = heights[first] > heights[second]
    return np.where(swapped, second, first), np.where(swapped, first, second)


def _first_from(values: Float64Array, size: int) -> IntArray:
    """Return the first whole number that is not below each value, from 0 to `size`."""
    return np.clip(np.ceil(values), 0, size).astype(np.int64)


def _points_at(low: Float64Array, high: Float64Array, coordinate: IntArray) -> Float64Array:
    """Return the points of lines from `low` to `high`, by columns, at a last coordinate; the coordinates before it."""
    share = (coordinate - low[-1]) / (high[-1] - low[-1])
    return low[:-1] + share * (high[:-1] - low[:-1])


_SLAB_VOXELS = 1 << 23
"""Voxels at a time: some 200 MB with what is computed from them."""

Keys = NDArray[np.int64]


@dataclass(frozen=True)
class Lattice:
    """Points `finer` along each axis of cells (`cells_ijk`, `border` layers around) from `offsets` (0 to 1) on."""

    finer: int
    offsets: tuple[float, float, float]
    border: int
    cells_ijk: tuple[int, int, int]

    @classmethod
    def over(cls, volume: Volume, rule: IsoRule, finer: int, offsets: tuple[float, float, float]) -> Lattice:
        ni, nj, nk = (size + 2 * rule.border - 1 for size in volume.shape_ijk)
        return cls(finer, offsets, rule.border, (ni, nj, nk))

    @property
    def shape_ijk(self) -> tuple[int, int, int]:
        ni, nj, nk = (cells * self.finer for cells in self.cells_ijk)
        return ni, nj, nk

    def number(self, ijk: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return index coordinates of the voxels, shape (n, 3), in numbers of points from the first."""
        return (ijk + self.border) * self.finer - np.array(self.offsets)

    def shares(self, axis: int) -> list[float]:
        """Return where the points of a cell lie along an axis, as shares of the cell."""
        return [(point + self.offsets[axis]) / self.finer for point in range(self.finer)]

    def row_of(self, keys: Keys) -> Keys:
        return keys // (self.shape_ijk[0] + 1)


def count_points(keys: Keys) -> int:
    """Return the number of points inside, from the ends of their runs in ascending order."""
    return int((keys[1::2] - keys[::2]).sum())


def exclusive_or(first: Keys, second: Keys) -> Keys:
    """Return the ends of the runs of points that are in one but not in the other."""
    keys = np.sort(np.concatenate([first, second]), kind="stable")  # merges two ascending parts
    alone = np.ones(len(keys), dtype=bool)
    equal = keys[1:] == keys[:-1]
    alone[1:] &= ~equal
    alone[:-1] &= ~equal
    return np.asarray(keys[alone])


def find_level_runs(volume: Volume, rule: IsoRule, lattice: Lattice, most: int = _SLAB_VOXELS) -> Keys:
    """Find the ends of runs of points, (n,) int64, ascending, where the trilinear HU reach the one level of a rule.

    A trilinear field has its extremes at the corners of a cell: only cells with corners on both sides have points on
    both sides.
    """
    layers = lattice.cells_ijk[2]
    ni, nj, _ = volume.shape_ijk
    step = max(1, most // (ni * nj))
    runs = [np.zeros(0, dtype=np.int64)]
    for first in range(0, layers, step):
        samples = _slices_with_border(volume, rule, first, min(first + step, layers) + 1)
        runs.append(np.sort(_runs_in(samples, rule, lattice, first)))
    return np.concatenate(runs)


def _slices_with_border(volume: Volume, rule: IsoRule, first: int, end: int) -> NDArray[Any]:
    """Return slices of the volume with its border, counted with it, shape (end - first, nj + 2 b, ni + 2 b)."""
    border = rule.border
    slices = volume.voxels[max(first - border, 0) : max(end - border, 0)]
    if not border:
        return slices
    before = max(border - first, 0)
    widths = ((before, end - first - before - len(slices)), (border, border), (border, border))
    return np.pad(slices, widths, constant_values=np.array(rule.outside).astype(slices.dtype))


def _join_corners(corners: NDArray[np.bool_], join: Callable[..., NDArray[np.bool_]]) -> NDArray[np.bool_]:
    corners = join(corners[1:], corners[:-1])
    corners = join(corners[:, 1:], corners[:, :-1])
    return join(corners[:, :, 1:], corners[:, :, :-1])


def _runs_in(samples: NDArray[Any], rule: IsoRule, lattice: Lattice, first: int) -> Keys:
    """Return the ends of runs in some layers of cells, in no order."""
    inside = rule.mark_inside(samples)
    touched = _join_corners(inside, np.logical_or)
    wanted = touched & ~_join_corners(inside, np.logical_and)
    wanted[:, :, 1:] |= wanted[:, :, :-1].copy()  # a run may end before the first point of the next cell
    wanted[:, :, [0, -1]] |= touched[:, :, [0, -1]]
    k, j, i = np.nonzero(wanted)
    if len(i) == 0:
        return np.zeros(0, dtype=np.int64)
    corners = {
        (c, b, a): samples[k + c, j + b, i + a].astype(np.float32) for c, b, a in itertools.product((0, 1), repeat=3)
    }
    ni, nj, _ = lattice.shape_ijk
    finer = lattice.finer
    base = ((k + first) * finer * nj + j * finer) * (ni + 1) + i * finer
    # Where the cell before is left out, all its points have the state of the corner that both share.
    follows = np.concatenate([[False], (np.diff(i) == 1) & (np.diff(j) == 0) & (np.diff(k) == 0)])
    shared = inside[k, j, i] & (i > 0)
    last = np.flatnonzero(i == lattice.cells_ijk[0] - 1)
    ends = []
    for (row_k, tk), (row_j, tj) in itertools.product(enumerate(lattice.shares(2)), enumerate(lattice.shares(1))):
        if row_j == 0:
            edges = {
                (b, a): _blend_two(corners[0, b, a], corners[1, b, a], tk)
                for b, a in itertools.product((0, 1), repeat=2)
            }
        low, high = (_blend_two(edges[0, a], edges[1, a], tj) for a in (0, 1))
        states = [_blend_two(low, high, ti) >= np.float32(rule.iso_level) for ti in lattice.shares(0)]
        before = shared.copy()
        before[follows] = states[-1][np.flatnonzero(follows) - 1]
        row = base + (row_k * nj + row_j) * (ni + 1)
        for point, state in enumerate(states):
            ends.append(row[state != before] + point)
            before = state
        ends.append(row[last[before[last]]] + finer)
    return np.concatenate(ends)


def _blend_two(low: NDArray[np.float32], high: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    return np.asarray(low + np.float32(share) * (high - low))
