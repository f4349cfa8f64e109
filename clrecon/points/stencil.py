"""`Lattice` and `Stencil`: where voxels lie, and which of them are within a distance of a voxel."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume, column_spacing, slice_normal
from clrecon.geometry.affine import Float64Array
from clrecon.system.light_dataclass import dataclass

SLACK = 1e-6
"""Distances up to ``eps * (1 + SLACK)`` are within eps, so that an eps of one slice gap reaches the next slice."""

_EPS_STEPS = 1.5
"""Default eps in units of the largest step between neighbouring voxels."""

PLACES = 9
"""Decimals of mm by which slices with the same neighbours are told."""


@dataclass(frozen=True)
class Lattice:
    """Where the voxels of a volume lie, without the volume.

    origins: LPS mm of voxel (0, 0, k) of each slice (nk, 3) where slices are uneven; the affine then says nothing of k.
    """

    shape_ijk: tuple[int, int, int]
    affine: Float64Array
    origins: Float64Array | None = None

    @classmethod
    def of(cls, volume: Volume) -> Lattice:
        return cls(volume.shape_ijk, volume.affine, volume.slice_origins() if volume.uneven else None)

    @property
    def largest_gap(self) -> float:
        """Largest distance in mm of neighbouring slices along their normal; 0 for a single slice."""
        normal = slice_normal(self.affine)
        if self.origins is None:
            return float(abs(normal @ self.affine[:3, 2])) if self.shape_ijk[2] > 1 else 0.0
        return float(np.abs(np.diff(self.origins @ normal)).max())

    @property
    def pixel(self) -> float:
        """The larger step within a slice, mm."""
        return max(column_spacing(self.affine)[:2])

    @property
    def default_eps(self) -> float:
        """1.5 times the largest of the steps in the slices and the largest slice gap, mm."""
        return _EPS_STEPS * max(self.pixel, self.largest_gap)

    @property
    def least_step(self) -> float:
        """Smallest distance in mm of two neighbouring voxels along i, j or the normal of the slices."""
        normal = slice_normal(self.affine)
        steps = [*column_spacing(self.affine)[:2]]
        if self.origins is not None:
            steps.append(float(np.abs(np.diff(self.origins @ normal)).min()))
        elif self.shape_ijk[2] > 1:
            steps.append(self.largest_gap)
        return min(steps)


@dataclass(frozen=True)
class Stencil:
    """Offsets of the voxels within eps of a voxel, row by row of the volume.

    rows: (m, 4). dj, dk, lowest di and highest di of each row, nearest rows first, of one table after the other.
    tables: (nk, 2). First row of the table of each slice, and the one after its last.
    in_plane: Members of the stencil in its own slice, the voxel itself included.
    members: Fewest and most over all slices that have neighbours as far as the stencil reaches; equal in an even stack.
    reach: Largest di, without its sign.
    """

    rows: NDArray[np.int32]
    tables: NDArray[np.int32]
    in_plane: int
    members: tuple[int, int]
    reach: int

    @property
    def is_alone(self) -> bool:
        """True where no voxel has a neighbour."""
        return self.members[1] == 1

    @property
    def joins_columns(self) -> bool:
        """True where neighbouring voxels of a row are within eps."""
        return bool((self.rows[(self.rows[:, 0] == 0) & (self.rows[:, 1] == 0), 3] > 0).any())

    def holds(self, shape_ijk: tuple[int, int, int]) -> bool:
        """Tell whether all voxels of a volume of this shape are within eps of each other."""
        ni, nj, nk = shape_ijk
        counts = {int(end - begin) for begin, end in self.tables.tolist()}
        is_even = len({tuple(table) for table in self.tables.tolist()}) == 1
        slices = 2 * nk - 1 if is_even else nk
        whole = (self.rows[:, 2] == 1 - ni) & (self.rows[:, 3] == ni - 1)
        return counts == {(2 * nj - 1) * slices} and bool(whole.all())

    def forward(self) -> Stencil:
        """Return the rows that lie after the voxel in the order k, j, i, those of its own row included."""
        rows: list[NDArray[np.int32]] = []
        tables, done = np.empty_like(self.tables), {}
        for k, (begin, end) in enumerate(self.tables.tolist()):
            if (begin, end) not in done:
                own_rows = self.rows[begin:end]
                dj, dk = own_rows[:, 0], own_rows[:, 1]
                after = own_rows[(dk > 0) | ((dk == 0) & (dj >= 0))].copy()
                after[(after[:, 0] == 0) & (after[:, 1] == 0), 2] = 1
                first = sum(map(len, rows))
                rows.append(after[after[:, 3] >= after[:, 2]])
                done[begin, end] = first, first + len(rows[-1])
            tables[k] = done[begin, end]
        return Stencil(np.concatenate(rows), tables, self.in_plane, self.members, self.reach)


def checked_eps(eps: float) -> float:
    if isinstance(eps, bool) or not isinstance(eps, (int, float, np.number)) or not 0.0 < float(eps) < math.inf:
        raise UsageError(f"eps is {eps!r}: a distance above 0 mm is needed")
    return float(eps)


def make_stencil(lattice: Lattice, eps: float) -> Stencil:
    """Find the voxels within `eps` mm (see `SLACK`) of a voxel, for each slice; none out of the volume everywhere."""
    eps = checked_eps(eps)
    nk = lattice.shape_ijk[2]
    plane = _Plane(lattice, eps * (1.0 + SLACK))
    if lattice.origins is None:
        step = lattice.affine[:3, 2]
        ahead = [plane.rows_at(dk * step, dk) for dk in range(nk) if dk == 0 or plane.reaches(dk * step)]
        whole = np.concatenate([*ahead, *map(_mirror, ahead[1:])])
        whole = whole[_order(plane, whole, whole[:, 1:2] * step)]
        return _finish_stencil(nk, [whole], np.tile(np.array([[0, len(whole)]], np.int32), (nk, 1)))
    return _finish_stencil(nk, *_uneven_tables(lattice.origins, plane))


class _Plane:
    """The lattice of one slice: which of its voxels lie within a radius of a point."""

    def __init__(self, lattice: Lattice, radius: float):
        self.steps: Float64Array = lattice.affine[:3, :2]
        self.radius = radius
        self.ni, self.nj, _ = lattice.shape_ijk
        self.normal: Float64Array = slice_normal(lattice.affine)
        self.inverse = np.linalg.pinv(self.steps)
        # Half the extents in index steps of the ellipse that a circle of radius 1 is.
        self.extents = np.sqrt((self.inverse**2).sum(axis=1))

    def reaches(self, offset: Float64Array) -> bool:
        """Tell whether a slice at this offset lies within the radius along the normal."""
        return abs(float(self.normal @ offset)) <= self.radius

    def rows_at(self, offset: Float64Array, dk: int) -> NDArray[np.int32]:
        """Return rows (dj, dk, lowest di, highest di) of the slice at `offset` from the voxel's own."""
        centre = -self.inverse @ offset
        spread = self.radius * self.extents[1] + 1.0
        low, high = math.ceil(max(centre[1] - spread, 1 - self.nj)), math.floor(min(centre[1] + spread, self.nj - 1))
        dj = np.arange(low, high + 1)
        if not len(dj):
            return np.empty((0, 4), np.int32)
        aim = offset + dj[:, None] * self.steps[:, 1]
        along = self.steps[:, 0]
        square = float(along @ along)
        middle = -(aim @ along) / square
        rest = self.radius**2 - ((aim + middle[:, None] * along) ** 2).sum(axis=1)
        half = np.sqrt(np.maximum(rest, 0.0) / square)
        first, last = np.ceil(middle - half).astype(np.int64), np.floor(middle + half).astype(np.int64)
        # The ends are decided by distances, not by the quotient.
        first = np.where(self._within(aim, first - 1), first - 1, np.where(self._within(aim, first), first, first + 1))
        last = np.where(self._within(aim, last + 1), last + 1, np.where(self._within(aim, last), last, last - 1))
        first, last = np.maximum(first, 1 - self.ni), np.minimum(last, self.ni - 1)
        return np.stack([dj, np.full_like(dj, dk), first, last], axis=1)[first <= last].astype(np.int32)

    def _within(self, aim: Float64Array, di: NDArray[np.int64]) -> NDArray[np.bool_]:
        near: NDArray[np.bool_] = ((aim + di[:, None] * self.steps[:, 0]) ** 2).sum(axis=1) <= self.radius**2
        return near


def _mirror(rows: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the same rows seen from the other end."""
    return np.stack([-rows[:, 0], -rows[:, 1], -rows[:, 3], -rows[:, 2]], axis=1)


def _order(plane: _Plane, rows: NDArray[np.int32], offsets: Float64Array) -> NDArray[np.int64]:
    middle = 0.5 * (rows[:, 2] + rows[:, 3])
    places = offsets + rows[:, :1] * plane.steps[:, 1] + middle[:, None] * plane.steps[:, 0]
    order: NDArray[np.int64] = np.argsort((places**2).sum(axis=1), kind="stable")
    return order


def _uneven_tables(origins: Float64Array, plane: _Plane) -> tuple[list[NDArray[np.int32]], NDArray[np.int32]]:
    nk, heights = len(origins), origins @ plane.normal
    cache: dict[bytes, NDArray[np.int32]] = {}
    stored: dict[bytes, tuple[int, int]] = {}
    parts: list[NDArray[np.int32]] = []
    tables = np.empty((nk, 2), np.int32)
    begin = 0
    for k in range(nk):
        near = np.flatnonzero(np.abs(heights - heights[k]) <= plane.radius)
        offsets = np.round(origins[near] - origins[k], PLACES) + 0.0
        key = offsets.tobytes() + (near - k).tobytes()
        if key not in stored:
            rows = [
                _rows_between(plane, offset, int(other - k), cache) for other, offset in zip(near, offsets, strict=True)
            ]
            whole = np.concatenate(rows)
            places = np.repeat(offsets, [len(part) for part in rows], axis=0)
            parts.append(whole[_order(plane, whole, places)])
            stored[key] = begin, begin + len(whole)
            begin += len(whole)
        tables[k] = stored[key]
    return parts, tables


def _rows_between(
    plane: _Plane, offset: Float64Array, dk: int, cache: dict[bytes, NDArray[np.int32]]
) -> NDArray[np.int32]:
    """Return the rows of another slice; those behind mirror those ahead, so that each of two sees the other."""
    if dk < 0:
        return _mirror(_rows_between(plane, -offset + 0.0, -dk, cache))
    key = offset.tobytes() + dk.to_bytes(8, "little")
    if key not in cache:
        cache[key] = plane.rows_at(offset, dk)
    return cache[key]


def _finish_stencil(nk: int, parts: Sequence[ArrayLike], tables: NDArray[np.int32]) -> Stencil:
    rows = np.concatenate(parts).astype(np.int32)
    lengths = rows[:, 3] - rows[:, 2] + 1
    members: dict[int, tuple[bool, int]] = {}
    for k, (begin, end) in enumerate(tables.tolist()):
        reach = int(np.abs(rows[begin:end, 1]).max())
        within = reach <= k < nk - reach
        members[begin] = within or members.get(begin, (False, 0))[0], int(lengths[begin:end].sum())
    counts = [count for within, count in members.values() if within] or [count for _, count in members.values()]
    begin, end = tables[0]
    in_plane = int(lengths[begin:end][rows[begin:end, 1] == 0].sum())
    reach = int(np.abs(rows[:, 2:]).max())
    return Stencil(rows, tables, in_plane, (min(counts), max(counts)), reach)
