"""Where the rows of a lattice pierce a mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.lattice import Lattice
from clrecon.system.pieces import chunks

_PIECE = 1 << 16
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
    triangles: ndarray, shape (m, 3), uint32

    Returns: ndarray, shape (p,), int64, ascending. Ends of runs of points inside, see `clrecon.mesh.compare.lattice`;
        those that would be there an even number of times are not.
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
