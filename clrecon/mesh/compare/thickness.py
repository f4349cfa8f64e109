"""Thickness of the walls of a closed surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.distances import sample_surface_points
from clrecon.mesh.vtk import CellLocator
from clrecon.system.pieces import local_origin
from clrecon.system.records import Record

SAMPLES = 20_000
"""Points on the surface, so that the 5th percentile is based on the 1000 thinnest places."""

_INWARD = 1e-3
"""Depth below the surface, mm, at which a ray begins, so that it does not meet its own triangle."""


def wall_thickness(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], samples: int = SAMPLES
) -> NDArray[np.float64]:
    """Measure the wall thickness at points that cover a surface evenly by area, the same points at every call.

    From each point a ray goes inward, against the normal of its triangle, to the first triangle that it meets.

    vertices: ndarray, shape (n, 3), mm
    triangles: ndarray, shape (m, 3), uint32. Triangles of a closed surface, facing outward.

    Returns: ndarray, shape (samples,), float64, mm. NaN where the ray meets nothing: between triangles that do not
        close, or on an edge.
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


@dataclass(frozen=True, eq=False)
class WallFigures(Record):
    """How thick the walls of a surface are.

    min_mm, p5_mm, median_mm: None where no ray met anything.
    thin_share: Share of the surface whose wall is below `thin_mm`.
    samples, not_measured: Points, and those whose ray met nothing.
    """

    min_mm: float | None
    p5_mm: float | None
    median_mm: float | None
    thin_share: float | None
    thin_mm: float
    samples: int
    not_measured: int


def measure_walls(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], thin_mm: float, samples: int = SAMPLES
) -> WallFigures:
    """Summarise `wall_thickness`.

    vertices, triangles, samples: As for `wall_thickness`.
    thin_mm: Walls below this are thin.
    """
    thickness = wall_thickness(vertices, triangles, samples)
    measured = thickness[np.isfinite(thickness)]
    missed = samples - len(measured)
    if not len(measured):
        return WallFigures(None, None, None, None, thin_mm, samples, missed)
    p5, median = float(np.percentile(measured, 5)), float(np.median(measured))
    share = float(np.mean(measured < thin_mm))
    return WallFigures(float(measured.min()), p5, median, share, thin_mm, samples, missed)
