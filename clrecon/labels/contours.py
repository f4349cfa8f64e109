"""Closed contours rasterised on slices: a voxel is inside where its centre is, by the even-odd rule.

The rule counts the sides of all contours of a slice that a line from the centre crosses: a contour within another is a
hole, and one within that is filled again.  A centre on a side belongs to one of both neighbours, never to both: the
lower end of an interval is inside, the upper end is not.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

__all__ = ["fill_contours"]


def fill_contours(contours: Iterable[NDArray[np.float64]], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the pixels of one slice whose centres lie inside of contours.

    Parameters
    ----------
    contours : iterable of ndarray, shape (n, 2), float64
        Corners (i, j) in pixels, 0 at the centre of the first; the last corner is joined to the first.
    shape : (int, int)
        (nj, ni).

    Returns
    -------
    ndarray, shape (nj, ni), bool
    """
    nj, ni = shape
    inside = np.zeros(shape, dtype=bool)
    crossings = [_cross_rows(corners, nj) for corners in contours]
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *(own for own, _ in crossings)])
    if not len(rows):
        return inside
    places = np.concatenate([places for _, places in crossings])
    first = np.clip(np.ceil(places), 0, ni).astype(np.int64)  # what lies at ni is beyond the slice
    top, end = int(rows.min()), int(rows.max()) + 1
    turns = np.bincount((rows - top) * (ni + 1) + first, minlength=(end - top) * (ni + 1))
    turns = turns.reshape(end - top, ni + 1)[:, :ni]
    inside[top:end] = np.cumsum(turns, axis=1) % 2
    return inside


def _cross_rows(corners: NDArray[np.float64], nj: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the rows that the sides of a contour cross, and the coordinate i of each crossing."""
    following = np.roll(corners, -1, axis=0)
    upward = corners[:, 1] <= following[:, 1]
    low = np.where(upward[:, None], corners, following)
    high = np.where(upward[:, None], following, corners)
    first = np.clip(np.ceil(low[:, 1]), 0, nj).astype(np.int64)
    end = np.clip(np.ceil(high[:, 1]), 0, nj).astype(np.int64)  # a row at the upper end belongs to the next side
    counts = end - first
    side = np.repeat(np.arange(len(corners)), counts)
    rows = np.arange(len(side)) - np.repeat(np.cumsum(counts) - counts, counts) + first[side]
    rise = high[side, 1] - low[side, 1]
    share = (rows - low[side, 1]) / rise
    return rows, low[side, 0] + share * (high[side, 0] - low[side, 0])
