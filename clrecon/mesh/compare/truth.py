"""A mesh against the true surface of a phantom: where it lies, how much it scatters, how its normals turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry.grid import Grid
from clrecon.mesh.compare.cut_cells import SignedSurface
from clrecon.mesh.compare.distances import sample_surface_points
from clrecon.mesh.mesh import Mesh
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record

TRUTH_SAMPLES = 20_000
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
    p95_mm, max_mm: 95th percentile and largest of the distances without their sign.
    normals_median_deg, normals_p95_deg: Angle between the triangles' normals and those of the true surface: median,
        95th percentile.
    outer_share: Share of the points that are of the outer side: within reach of the true surface, and facing as it
        does.
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
    samples: int = TRUTH_SAMPLES,
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
    told = progress or ignore_progress
    points, rows = sample_surface_points(mesh.vertices, mesh.triangles, samples)
    told("truth", 0, 2)
    distance = truth.signed_distance(points)
    told("truth", 1, 2)
    near = np.abs(distance) <= reach_mm
    if grid is not None:
        ijk = grid.lps_to_ijk(points)
        near &= ((ijk >= 1.0) & (ijk <= np.array(grid.shape_ijk) - 2.0)).all(axis=1)
    points, rows, distance = points[near], rows[near], distance[near]
    cosine = np.einsum("ij,ij->i", _face_normals(mesh, rows), _directions(truth, points))
    told("truth", 2, 2)
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
    steps = _STEP_MM * np.eye(3)
    gradient = np.stack([truth.signed_distance(points + s) - truth.signed_distance(points - s) for s in steps], axis=1)
    length = np.linalg.norm(gradient, axis=1)
    return np.asarray(gradient / np.where(length > 0.0, length, 1.0)[:, None])
