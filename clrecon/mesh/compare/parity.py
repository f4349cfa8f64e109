"""Where the rows of a lattice pierce a mesh, and the trilinear HU on its points."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule
from clrecon.system.pieces import chunks

__all__ = ["Lattice", "find_piercings"]

_PIECE = 1 << 18
"""Triangles at a time."""

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Lattice:
    """Points at (first + n + offset) / finer along each axis of the voxels' index space.

    Attributes
    ----------
    finer : int
    offsets : (float, float, float)
        In steps of the lattice.
    first : (int, int, int)
    shape_ijk : (int, int, int)
        Number of points.
    """

    finer: int
    offsets: tuple[float, float, float]
    first: tuple[int, int, int]
    shape_ijk: tuple[int, int, int]

    @classmethod
    def over(cls, volume: Volume, rule: IsoRule, finer: int, offsets: tuple[float, ...]) -> Lattice:
        """Return the lattice over a volume and its border."""
        first = [math.ceil(-rule.border * finer - shift) for shift in offsets]
        last = [
            math.floor((size - 1 + rule.border) * finer - shift)
            for size, shift in zip(volume.shape_ijk, offsets, strict=True)
        ]
        shape = tuple(end - start + 1 for start, end in zip(first, last, strict=True))
        return cls(finer, tuple(offsets), tuple(first), shape)  # type: ignore[arg-type]

    def number(self, ijk: Float64Array) -> Float64Array:
        """Return index coordinates of the voxels in numbers of the lattice's points, shape (n, 3)."""
        return ijk * self.finer - np.array(self.offsets) - np.array(self.first)

    def places(self, axis: int) -> Float64Array:
        """Return the index coordinates of the points along an axis."""
        return (np.arange(self.shape_ijk[axis]) + self.first[axis] + self.offsets[axis]) / self.finer

    def planes(self, volume: Volume, rule: IsoRule) -> Iterator[NDArray[np.bool_]]:
        """Yield for each plane of the lattice which of its points, shape (nj, ni), the trilinear HU put inside."""
        level = np.float32(rule.iso_level)
        ways = [_split(self.places(axis), volume.shape_ijk[axis], rule.border) for axis in range(3)]
        (i, ti), (j, tj), (k, tk) = ways
        kept: dict[int, NDArray[np.float32]] = {}
        for lower, share in zip(k.tolist(), tk.tolist(), strict=True):
            kept = {n: kept[n] if n in kept else _slice(volume, rule, n) for n in (lower, lower + 1)}
            plane = kept[lower] + np.float32(share) * (kept[lower + 1] - kept[lower])
            rows = plane[j] + tj[:, None] * (plane[j + 1] - plane[j])
            steps = rows[:, 1:] - rows[:, :-1]
            yield rows[:, i] + ti * steps[:, i] >= level


def _split(places: Float64Array, size: int, border: int) -> tuple[IntArray, NDArray[np.float32]]:
    """Return the lower sample of each place, counted in the volume with its border, and the way to the next."""
    places = places + border
    lower = np.clip(np.floor(places).astype(np.int64), 0, size + 2 * border - 2)
    return lower, (places - lower).astype(np.float32)


def _slice(volume: Volume, rule: IsoRule, number: int) -> NDArray[np.float32]:
    """Return a slice of the volume with its border, shape (nj + 2 border, ni + 2 border), float32."""
    ni, nj, nk = volume.shape_ijk
    border = rule.border
    values = np.full((nj + 2 * border, ni + 2 * border), rule.outside, dtype=np.float32)
    if 0 <= number - border < nk:
        values[border : border + nj, border : border + ni] = volume.voxels[number - border]
    return values


def find_piercings(ijk: Float64Array, triangles: NDArray[np.uint32], lattice: Lattice) -> IntArray:
    """Find the points of a lattice from which on rows along i have passed through a mesh once more.

    A triangle is cut by the planes of the lattice, and the line of the cut by its rows.  An edge takes part in the
    planes from its lower end on up to, but without, its upper end, and so does a line of a cut in rows.  The two
    triangles at an edge compute the same point there, in the same order of operations: a closed mesh is pierced an
    even number of times by every row, whatever the rounding.

    Parameters
    ----------
    ijk : ndarray, shape (n, 3), float64
        Vertices in index coordinates of the voxels.
    triangles : ndarray, shape (m, 3), uint32
    lattice : Lattice

    Returns
    -------
    ndarray, shape (p,), int64, ascending
        Numbers (k * nj + j) * (ni + 1) + i; those that would be there an even number of times are not.  i = ni is
        beyond the row.
    """
    points = lattice.number(ijk)
    found = [np.zeros(0, dtype=np.int64)]
    found += [_pierce(points[triangles[where]], lattice.shape_ijk) for where in chunks(len(triangles), _PIECE)]
    keys = np.sort(np.concatenate(found))
    fresh = np.flatnonzero(np.diff(keys, prepend=-1))
    odd = np.diff(fresh, append=len(keys)) % 2 == 1
    return keys[fresh[odd]]


def _spread(first: IntArray, end: IntArray) -> tuple[IntArray, IntArray]:
    """Return, for intervals of whole numbers, the interval of each number and the number."""
    count = np.maximum(end - first, 0)
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) + (first - np.cumsum(count) + count)[row]


def _pierce(corners: Float64Array, shape_ijk: tuple[int, int, int]) -> IntArray:
    """Return the numbers of `find_piercings` for triangles, shape (m, 3, 3)."""
    ni, nj, nk = shape_ijk
    order = np.argsort(corners[:, :, 2], axis=1, kind="stable")
    a, b, c = (corners[np.arange(len(corners)), order[:, n]] for n in range(3))
    row, plane = _spread(*(_first_from(end[:, 2], nk) for end in (a, c)))
    a, b, c = a[row], b[row], c[row]
    upper = (plane >= b[:, 2])[:, None]
    one = _at(a, c, plane, 2)
    other = _at(np.where(upper, b, a), np.where(upper, c, b), plane, 2)
    swapped = (one[:, 1] > other[:, 1])[:, None]
    one, other = np.where(swapped, other, one), np.where(swapped, one, other)
    line, at_row = _spread(*(_first_from(end[:, 1], nj) for end in (one, other)))
    place = _at(one[line], other[line], at_row, 1)[:, 0]
    i = _first_from(place, ni)
    return np.asarray((plane[line] * nj + at_row) * (ni + 1) + i)


def _first_from(values: Float64Array, size: int) -> IntArray:
    """Return the first whole number that is not below each value, from 0 to `size`."""
    return np.clip(np.ceil(values), 0, size).astype(np.int64)


def _at(low: Float64Array, high: Float64Array, place: IntArray, axis: int) -> Float64Array:
    """Return the points of lines from `low` to `high` at a coordinate along an axis; its two other coordinates."""
    share = (place - low[:, axis]) / (high[:, axis] - low[:, axis])
    return low[:, :axis] + share[:, None] * (high[:, :axis] - low[:, :axis])
