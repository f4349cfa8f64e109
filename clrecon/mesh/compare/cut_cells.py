"""The grid cells that a surface given as a signed distance cuts: the true surface of a phantom."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.grid import Grid
from clrecon.mesh.compare.cells import GridCells
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress, ignore_progress

_BLOCK = 16
"""Cells along the edges of the first blocks, a power of two; those that the surface may meet are halved."""

_SLACK_MM = 0.3
"""Mm by which a distance may be too large for a block to be left out: those of a spine are, by up to 0.2 mm."""


class SignedSurface(Protocol):
    """What is known of a true surface, as `clrecon.PhantomTruth` knows it."""

    def signed_distance(self, points_mm: ArrayLike) -> NDArray[np.float64]:
        """Distance to the surface, shape (n,), mm, negative inside, of points (n, 3), LPS mm."""


@explains_arguments
def find_cut_cells(
    truth: SignedSurface, grid: Grid, *, name: str = "truth", progress: Progress | None = None
) -> GridCells:
    """Find the grid cells that a true surface cuts: those with points on both sides of it.

    The eight corners, the middles of edges and faces and the centre are asked: 27 points a cell.  A corner of the body
    that reaches into a cell between these points is missed.

    Parameters
    ----------
    truth : SignedSurface
        Such as `clrecon.phantom_truth` gives; if it has a method ``label``, a point is inside where that is above 0.
    grid : Volume or LabelMap
        Its cells and those of a border of one voxel around it are searched.
    name : str
        Of the set.
    progress : callable, optional
        Called as ``progress("truth", points asked, 0)``: their number is not known before.

    Returns
    -------
    GridCells

    Raises
    ------
    UsageError
        ``truth`` has no signed distance.
    """
    if not hasattr(truth, "signed_distance"):
        raise UsageError(f"a {type(truth).__name__} has no signed distance: give the truth of a phantom")
    cells = np.array(grid.shape_ijk) + 1  # with the border: from -1 on
    counts = -(-cells // _BLOCK)
    low = np.stack(np.meshgrid(*(np.arange(n) * _BLOCK for n in counts), indexing="ij"), axis=-1).reshape(-1, 3) - 1
    edge, asked, told = _BLOCK, 0, progress or ignore_progress
    while True:
        told("truth", asked, 0)
        low = low[(low < cells - 1).all(axis=1)]
        reach = _half_diagonals(grid, low, edge)
        distance = np.abs(truth.signed_distance(grid.ijk_to_lps(low + 0.5 * edge)))
        asked += len(low)
        low = low[distance <= reach + _SLACK_MM]
        if edge == 1:
            break
        edge //= 2
        low = (low[:, None] + _corners(2) * edge).reshape(-1, 3)
    told("truth", asked, 0)
    return GridCells(low[_is_cut(truth, grid, low)], name)


def _corners(points: int) -> NDArray[np.int64]:
    """Return `points` places along each axis, from 0 on, shape (points^3, 3)."""
    return np.stack(np.meshgrid(*[np.arange(points)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def _half_diagonals(grid: Grid, low: NDArray[np.int64], edge: int) -> NDArray[np.float64]:
    """Return the distance from the middle of each block to its farthest corner, mm."""
    middle = grid.ijk_to_lps(low + 0.5 * edge)
    farthest = np.zeros(len(low))
    for corner in _corners(2):
        np.maximum(farthest, np.linalg.norm(grid.ijk_to_lps(low + corner * edge) - middle, axis=1), out=farthest)
    return farthest


def _is_cut(truth: SignedSurface, grid: Grid, low: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark cells with points of a lattice of half voxels on both sides; each point is asked once."""
    if len(low) == 0:
        return np.zeros(0, dtype=bool)
    places = 2 * low[:, None] + _corners(3)
    unique, number = np.unique(places.reshape(-1, 3), axis=0, return_inverse=True)
    within = _holds(truth, grid.ijk_to_lps(0.5 * unique))
    inside = within[number.reshape(len(low), -1)].sum(axis=1)
    return np.asarray((inside > 0) & (inside < 27))


def _holds(truth: SignedSurface, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mark the points inside; the label of a phantom tells it in an eighth of the time of a distance."""
    label = getattr(truth, "label", None)
    if label is None:
        return np.asarray(truth.signed_distance(points) < 0.0)
    return np.asarray(label(points) > 0)
