"""Thickness of the walls of a closed surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.distances import sample_surface_points
from clrecon.mesh.vtk import CellLocator
from clrecon.system.pieces import local_origin

__all__ = ["SAMPLES", "measure_walls", "wall_thickness"]

SAMPLES = 20_000
"""Points on the surface, so that the 5th percentile is based on the 1000 thinnest places."""

_INWARD = 1e-3
"""Depth below the surface, mm, at which a ray begins, so that it does not meet its own triangle."""


def wall_thickness(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], samples: int = SAMPLES
) -> NDArray[np.float64]:
    """Measure the wall thickness at points that cover a surface evenly by area, the same points at every call.

    From each point a ray goes inward, against the normal of its triangle, to the first triangle that it meets.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), mm
    triangles : ndarray, shape (m, 3), uint32
        Triangles of a closed surface, facing outward.
    samples : int

    Returns
    -------
    ndarray, shape (samples,), float64, mm
        NaN where the ray meets nothing: between triangles that do not close, or on an edge.

    Raises
    ------
    NoSurfaceError
        The surface has no area.
    """
    origin = local_origin(vertices)
    near = vertices - origin
    points, rows = sample_surface_points(near, triangles, samples)
    a, b, c = near[triangles[rows]].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    farthest = float(np.linalg.norm(near.max(axis=0) - near.min(axis=0))) + 1.0
    found = CellLocator(near, triangles).first_hits(points - _INWARD * normals, points - farthest * normals)
    return np.asarray(np.linalg.norm(found - points, axis=1))


def measure_walls(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], thin_mm: float, samples: int = SAMPLES
) -> dict[str, Any]:
    """Summarise `wall_thickness`.

    Parameters
    ----------
    vertices, triangles, samples
        As for `wall_thickness`.
    thin_mm : float
        Walls below this are thin.

    Returns
    -------
    dict
        ``min_mm``, ``p5_mm``, ``median_mm`` : float or None, None where no ray met a triangle
        ``thin_mm`` : float, and ``thin_share`` : float or None, share of the surface whose wall is thinner
        ``samples``, ``not_measured`` : int, number of points, and of those whose ray met nothing
    """
    thickness = wall_thickness(vertices, triangles, samples)
    measured = thickness[np.isfinite(thickness)]
    figures: dict[str, Any] = dict.fromkeys(("min_mm", "p5_mm", "median_mm", "thin_share"))
    if len(measured):
        figures = {
            "min_mm": float(measured.min()),
            "p5_mm": float(np.percentile(measured, 5)),
            "median_mm": float(np.median(measured)),
            "thin_share": float(np.mean(measured < thin_mm)),
        }
    return {**figures, "thin_mm": thin_mm, "samples": samples, "not_measured": samples - len(measured)}
