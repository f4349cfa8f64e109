"""Exact distances from points of one surface to the triangles of another, and between the walls of a closed one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.triangle_tree import TriangleTree
from clrecon.mesh.triangles import cross_products, enclosed_ml
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import local_origin
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record

SAMPLES = 50_000
"""Points on each surface, so that the 95th percentile is based on the 2500 largest distances."""

_STEPS_U, _STEPS_V = 0.7548776662466927, 0.5698402909980532
"""Powers of the inverse of the plastic number: the two-dimensional low-discrepancy sequence R2 (Roberts 2018)."""

Points = NDArray[np.float64]


def sample_surface(vertices: NDArray[np.floating], triangles: NDArray[np.uint32], count: int = SAMPLES) -> Points:
    """Return points that cover a surface evenly by area, the same at every call: shape (count, 3), float64, mm."""
    return sample_surface_points(vertices, triangles, count)[0]


def sample_surface_points(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], count: int = SAMPLES
) -> tuple[Points, NDArray[np.int64]]:
    """As `sample_surface`, with the row of the triangle of each point, shape (count,)."""
    area = np.zeros(len(triangles))
    for piece, _, cross in cross_products(vertices, triangles, np.zeros(3)):
        area[piece] = np.sqrt(np.einsum("ij,ij->j", cross, cross))
    up_to = np.cumsum(area)
    if len(up_to) == 0 or up_to[-1] <= 0.0:
        raise NoSurfaceError("a surface without area has no points to measure from")
    number = np.arange(count, dtype=np.float64)
    chosen = np.searchsorted(up_to, (number + 0.5) * (up_to[-1] / count))
    rows = np.minimum(chosen, len(triangles) - 1)
    # The square root spreads the points evenly over a triangle.
    u, v = np.sqrt(number * _STEPS_U % 1.0), number * _STEPS_V % 1.0
    weights = (1.0 - u, u * (1.0 - v), u * v)
    corners = triangles[rows].T
    points = sum(w[:, None] * vertices[corner].astype(np.float64) for w, corner in zip(weights, corners, strict=True))
    return np.asarray(points), rows


class SurfaceDistance:
    """Exact distances from points to the nearest triangle of a surface, which has at least one."""

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.uint32]):
        self._origin = local_origin(vertices)
        self._tree = TriangleTree(vertices - self._origin, triangles)

    def __call__(self, points: Points) -> NDArray[np.float64]:
        """Distances in mm, shape (k,), from `points`, shape (k, 3), mm."""
        return self._tree.nearest(points - self._origin)[2]


@dataclass(frozen=True, eq=False)
class DistanceSummary(Record):
    """What many distances come to: `mean`, `rms`, 95th percentile `p95`, and `max`, in their unit."""

    mean: float
    rms: float
    p95: float
    max: float


def summarise_distances(distances: NDArray[np.float64]) -> DistanceSummary:
    """Sum up distances, shape (n,), at least one."""
    return DistanceSummary(
        float(distances.mean()),
        float(np.sqrt(np.mean(distances * distances))),
        float(np.percentile(distances, 95)),
        float(distances.max()),
    )


@dataclass(frozen=True, eq=False)
class MeshDistance(Record):
    """How far two surfaces lie apart.

    hd95_mm: The larger of the two 95th percentiles (robust Hausdorff distance).
    assd_mm: Mean of both sides (average symmetric surface distance).
    max_mm: Largest distance found; what lies between the points can be a little further.
    volume_change_percent: Enclosed volume against that of the reference; None where that is zero, and without meaning
        for open surfaces.
    samples: Number of points on each surface.
    """

    hd95_mm: float
    assd_mm: float
    max_mm: float
    to_reference_mm: DistanceSummary
    from_reference_mm: DistanceSummary
    volume_change_percent: float | None
    samples: int


@explains_arguments
def compare_meshes(
    mesh: Mesh, reference: Mesh, samples: int = SAMPLES, *, progress: Progress | None = None
) -> MeshDistance:
    """Measure how far two surfaces lie apart.

    Distances are measured from points that cover each surface evenly by area to the nearest triangle of the other.

    Parameters
    ----------
    mesh, reference : Mesh
    samples : int
        Number of points on each surface.
    progress : callable, optional
        Called as ``progress("compare", sides done, 2)``.

    Returns
    -------
    MeshDistance

    Raises
    ------
    NoSurfaceError
        A mesh is empty or has no area.
    UsageError
        ``samples`` is below 1.
    """
    if samples < 1:
        raise UsageError(f"distances need at least 1 sample, not {samples}")
    mesh.check()
    reference.check()
    sides = []
    progress = progress or ignore_progress
    points = [sample_surface(each.vertices, each.triangles, samples) for each in (mesh, reference)]
    for side, second in enumerate((reference, mesh)):
        progress("compare", side, 2)
        sides.append(summarise_distances(SurfaceDistance(second.vertices, second.triangles)(points[side])))
    progress("compare", 2, 2)
    origin = local_origin(reference.vertices)
    volume, wanted = (enclosed_ml(each.vertices, each.triangles, origin) for each in (mesh, reference))
    return MeshDistance(
        hd95_mm=max(side.p95 for side in sides),
        assd_mm=0.5 * (sides[0].mean + sides[1].mean),
        max_mm=max(side.max for side in sides),
        to_reference_mm=sides[0],
        from_reference_mm=sides[1],
        volume_change_percent=100.0 * (volume - wanted) / abs(wanted) if wanted else None,
        samples=samples,
    )


_WALL_SAMPLES = 20_000
"""Points on the surface, so that the 5th percentile is based on the 1000 thinnest places."""

_INWARD = 1e-3
"""Depth below the surface, mm, at which a ray begins, so that it does not meet its own triangle."""


def wall_thickness(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], samples: int = _WALL_SAMPLES
) -> NDArray[np.float64]:
    """Measure the wall thickness at points that cover a closed surface evenly by area, the same points at every call.

    From each point a ray goes inward, against the normal of its triangle, to the first triangle that it meets.

    Returns: ndarray, shape (samples,), mm. NaN where the ray meets nothing: between triangles that do not close, or on
        an edge.
    """
    origin = local_origin(vertices)
    near = vertices - origin
    points, rows = sample_surface_points(near, triangles, samples)
    a, b, c = near[triangles[rows]].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    farthest = float(np.linalg.norm(near.max(axis=0) - near.min(axis=0))) + 1.0
    hits = TriangleTree(near, triangles).first_hits(points - _INWARD * normals, points - farthest * normals)
    return np.asarray(np.linalg.norm(hits - points, axis=1))


@dataclass(frozen=True, eq=False)
class WallFigures(Record):
    """How thick the walls of a surface are; None where no ray met anything.

    thin_share: Share of the surface whose wall is below `thin_mm`.
    not_measured: Points whose ray met nothing.
    """

    min_mm: float | None
    p5_mm: float | None
    median_mm: float | None
    thin_share: float | None
    thin_mm: float
    samples: int
    not_measured: int


def measure_walls(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], thin_mm: float, samples: int = _WALL_SAMPLES
) -> WallFigures:
    """Summarise `wall_thickness`; walls below `thin_mm` are thin."""
    thickness = wall_thickness(vertices, triangles, samples)
    measured = thickness[np.isfinite(thickness)]
    missed = samples - len(measured)
    if not len(measured):
        return WallFigures(None, None, None, None, thin_mm, samples, missed)
    p5, median = float(np.percentile(measured, 5)), float(np.median(measured))
    share = float(np.mean(measured < thin_mm))
    return WallFigures(float(measured.min()), p5, median, share, thin_mm, samples, missed)
