"""A mesh against the true surface of a phantom: where it lies, how much it scatters, how its normals turn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry.grid import Grid
from clrecon.mesh.compare.distances import sample_surface_points
from clrecon.mesh.mesh import Mesh
from clrecon.proof.compare.mesh_cells import GridCells
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record

_TRUTH_SAMPLES = 20_000
"""Points on the mesh; each asks the true surface seven times."""

REACH_MM = 1.5
"""Points farther away are of another surface: walls of inner cavities that face outwards, ribs, discs."""

_STEP_MM = 0.2
"""Half the length over which the direction of the true surface is measured."""


@dataclass(frozen=True, eq=False)
class TruthDistance(Record):
    """How far the outer side of a mesh lies from the true surface.

    bias_mm: Mean of the signed distances, positive outside: what the level does.
    scatter_mm: Standard deviation of the signed distances about their mean: what the method does.
    p95_mm, max_mm: Of the distances without their sign.
    normals_median_deg, normals_p95_deg: Angle between the triangles' normals and those of the true surface.
    outer_share: Share of the points within reach of the true surface that face as it does.
    samples: Points on the whole mesh.
    """

    bias_mm: float
    scatter_mm: float
    p95_mm: float
    max_mm: float
    normals_median_deg: float
    normals_p95_deg: float
    outer_share: float
    reach_mm: float
    samples: int


@explains_arguments
def measure_truth(
    mesh: Mesh,
    truth: SignedSurface,
    samples: int = _TRUTH_SAMPLES,
    *,
    reach_mm: float | None = None,
    grid: Grid | None = None,
    progress: Progress | None = None,
) -> TruthDistance:
    """Measure how far the outer side of a mesh lies from the true surface of a phantom.

    Points cover the mesh evenly by area.  Those whose triangle faces as the true surface does, and that lie within
    reach of it, are of the outer side; walls of inner cavities face the other way.

    Parameters
    ----------
    mesh : Mesh
    truth : SignedSurface
        Such as `clrecon.phantom_truth` gives.
    samples : int
        Points on the mesh.
    reach_mm : float, optional
        Points farther from the true surface are left out.  Default: 1.5 mm, and with ``grid`` not less than the longest
        step of its voxels.
    grid : Volume or LabelMap, optional
        The scan; points within a voxel of its border, where a mesh is closed by a cut, are then left out.
    progress : callable, optional
        Called as ``progress("truth", n, 2)``: 1 after the distances, 2 after the directions.

    Returns
    -------
    TruthDistance

    Raises
    ------
    NoSurfaceError
        The mesh is empty, has no area, or no point of its outer side.
    UsageError
        An argument is wrong.
    """
    if not hasattr(truth, "signed_distance"):
        raise UsageError(f"a {type(truth).__name__} has no signed distance: give the truth of a phantom")
    if samples < 1:
        raise UsageError(f"distances need at least 1 sample, not {samples}")
    if reach_mm is None:
        reach_mm = REACH_MM if grid is None else max(REACH_MM, *grid.spacing)
    if not 0.0 < reach_mm < np.inf:
        raise UsageError(f"the reach is a number of mm above 0, not {reach_mm}")
    mesh.check()
    report = progress or ignore_progress
    points, rows = sample_surface_points(mesh.vertices, mesh.triangles, samples)
    report("truth", 0, 2)
    distance = truth.signed_distance(points)
    report("truth", 1, 2)
    near = np.abs(distance) <= reach_mm
    if grid is not None:
        ijk = grid.lps_to_ijk(points)
        near &= ((ijk >= 1.0) & (ijk <= np.array(grid.shape_ijk) - 2.0)).all(axis=1)
    points, rows, distance = points[near], rows[near], distance[near]
    cosine = np.einsum("ij,ij->i", _face_normals(mesh, rows), _directions(truth, points))
    report("truth", 2, 2)
    outer = cosine > 0.0
    if not outer.any():
        raise NoSurfaceError(
            f"no point of the mesh lies within {reach_mm:g} mm of the true surface and faces as it does: see whether"
            " both are in the same patient frame, and the triangles counter-clockwise from outside"
        )
    distance, angle = distance[outer], np.degrees(np.arccos(np.clip(cosine[outer], -1.0, 1.0)))
    away = np.abs(distance)
    return TruthDistance(
        bias_mm=float(distance.mean()),
        scatter_mm=float(distance.std()),
        p95_mm=float(np.percentile(away, 95)),
        max_mm=float(away.max()),
        normals_median_deg=float(np.median(angle)),
        normals_p95_deg=float(np.percentile(angle, 95)),
        outer_share=float(outer.sum() / samples),
        reach_mm=float(reach_mm),
        samples=samples,
    )


def _face_normals(mesh: Mesh, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    a, b, c = (mesh.vertices[corner].astype(np.float64) for corner in mesh.triangles[rows].T)
    normals = np.cross(b - a, c - a)
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


def _directions(truth: SignedSurface, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors in which the signed distance grows fastest: outward normals of the nearest surface."""
    steps = _STEP_MM * np.vstack([np.eye(3), -np.eye(3)])[:, None]
    ahead, behind = truth.signed_distance((points + steps).reshape(-1, 3)).reshape(2, 3, -1)
    gradient = (ahead - behind).T
    length = np.linalg.norm(gradient, axis=1)
    return np.asarray(gradient / np.where(length > 0.0, length, 1.0)[:, None])


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
    edge = _BLOCK
    asked = 0
    report = progress or ignore_progress
    while True:
        report("truth", asked, 0)
        low = low[(low < cells - 1).all(axis=1)]
        reach = _half_diagonals(grid, low, edge)
        distance = np.abs(truth.signed_distance(grid.ijk_to_lps(low + 0.5 * edge)))
        asked += len(low)
        low = low[distance <= reach + _SLACK_MM]
        if edge == 1:
            break
        edge //= 2
        low = (low[:, None] + _cell_corners(2) * edge).reshape(-1, 3)
    report("truth", asked, 0)
    return GridCells(low[_is_cut(truth, grid, low)], name)


def _cell_corners(points: int) -> NDArray[np.int64]:
    """Return `points` places along each axis, from 0 on, shape (points^3, 3)."""
    return np.stack(np.meshgrid(*[np.arange(points)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def _half_diagonals(grid: Grid, low: NDArray[np.int64], edge: int) -> NDArray[np.float64]:
    """Return the distance from the middle of each block to its farthest corner, mm."""
    middle = grid.ijk_to_lps(low + 0.5 * edge)
    farthest = np.zeros(len(low))
    for corner in _cell_corners(2):
        np.maximum(farthest, np.linalg.norm(grid.ijk_to_lps(low + corner * edge) - middle, axis=1), out=farthest)
    return farthest


def _is_cut(truth: SignedSurface, grid: Grid, low: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark cells with points of a lattice of half voxels on both sides; each point is asked once."""
    if len(low) == 0:
        return np.zeros(0, dtype=bool)
    places = 2 * low[:, None] + _cell_corners(3)
    unique, number = np.unique(places.reshape(-1, 3), axis=0, return_inverse=True)
    inside = _is_inside(truth, grid.ijk_to_lps(0.5 * unique))[number.reshape(len(low), -1)].sum(axis=1)
    return np.asarray((inside > 0) & (inside < 27))


def _is_inside(truth: SignedSurface, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mark the points inside; the label of a phantom tells it in an eighth of the time of a distance."""
    label = getattr(truth, "label", None)
    if label is None:
        return np.asarray(truth.signed_distance(points) < 0.0)
    return np.asarray(label(points) > 0)
