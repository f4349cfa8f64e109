"""Exact distances from points of one surface to the triangles of another, or to those near a vertex, and between the
walls of a closed surface.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh.connectivity import Fans
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.quality import measure_triangles
from clrecon.mesh.triangle_tree import TriangleTree
from clrecon.mesh.triangles import cross_product, enclosed_ml
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import in_threads, local_origin
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record

SAMPLES = 50_000
"""Points on each surface, so that the 95th percentile is based on the 2500 largest distances."""

_STEPS_U, _STEPS_V = 0.7548776662466927, 0.5698402909980532
"""Powers of the inverse of the plastic number: the two-dimensional low-discrepancy sequence R2 (Roberts 2018)."""

Points = NDArray[np.float64]


def sample_surface(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    count: int = SAMPLES,
    twice_areas: NDArray[np.float64] | None = None,
) -> Points:
    """Return points that cover a surface evenly by area, the same at every call: shape (count, 3), float64, mm."""
    return sample_surface_points(vertices, triangles, count, twice_areas)[0]


def sample_surface_points(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    count: int = SAMPLES,
    twice_areas: NDArray[np.float64] | None = None,
) -> tuple[Points, NDArray[np.int64]]:
    """As `sample_surface`, with the row of the triangle of each point, shape (count,)."""
    if twice_areas is None:
        twice_areas = measure_triangles(vertices, triangles, by_triangle=True).twice_areas
    up_to = np.cumsum(twice_areas)
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


def summarise_distances(distances: NDArray[np.float64], weights: NDArray[np.float64] | None = None) -> DistanceSummary:
    """Sum up distances, shape (n,), at least one; `weights`, above 0, are the areas that they stand for."""
    if weights is None:
        p95 = float(np.percentile(distances, 95))
    else:
        p95 = _find_weighted_p95(distances, weights)
    return DistanceSummary(
        float(np.average(distances, weights=weights)),
        float(np.sqrt(np.average(distances * distances, weights=weights))),
        p95,
        float(distances.max()),
    )


def _find_weighted_p95(distances: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the distance that 95 % of the weight do not exceed; the farther fifth alone is sorted, if it will do."""
    rank, total = 4 * len(distances) // 5, weights.sum()
    rows = np.flatnonzero(distances >= np.partition(distances, rank)[rank])
    if weights[rows].sum() < 0.06 * total:
        rows = np.arange(len(distances))
    rows = rows[np.argsort(-distances[rows])]
    return float(distances[rows[np.searchsorted(np.cumsum(weights[rows]), total - 0.95 * total, side="right")]])


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
    return ReferenceSurface(reference, samples).compare(mesh, progress)


class ReferenceSurface:
    """A surface with which others are compared: see `compare_meshes`."""

    def __init__(self, mesh: Mesh, samples: int):
        if samples < 1:
            raise UsageError(f"distances need at least 1 sample, not {samples}")
        mesh.check()
        self._mesh, self._samples = mesh, samples
        self._points = sample_surface(mesh.vertices, mesh.triangles, samples)
        self._origin = local_origin(mesh.vertices)
        self._volume = enclosed_ml(mesh.vertices, mesh.triangles, self._origin)
        self.distance = SurfaceDistance(mesh.vertices, mesh.triangles)

    def compare(self, mesh: Mesh, progress: Progress | None = None) -> MeshDistance:
        """Compare a surface, which may be that of the reference itself."""
        progress = progress or ignore_progress
        mesh.check()
        points = sample_surface(mesh.vertices, mesh.triangles, self._samples)
        progress("compare", 0, 2)
        there = back = summarise_distances(self.distance(points))
        progress("compare", 1, 2)
        if mesh is not self._mesh:
            back = summarise_distances(SurfaceDistance(mesh.vertices, mesh.triangles)(self._points))
        progress("compare", 2, 2)
        volume, wanted = enclosed_ml(mesh.vertices, mesh.triangles, self._origin), self._volume
        return MeshDistance(
            hd95_mm=max(there.p95, back.p95),
            assd_mm=0.5 * (there.mean + back.mean),
            max_mm=max(there.max, back.max),
            to_reference_mm=there,
            from_reference_mm=back,
            volume_change_percent=100.0 * (volume - wanted) / abs(wanted) if wanted else None,
            samples=self._samples,
        )


_WALL_SAMPLES = 20_000
"""Points on the surface, so that the 5th percentile is based on the 1000 thinnest places."""

_INWARD = 1e-3
"""Depth below the surface, mm, at which a ray begins, so that it does not meet its own triangle."""


def cast_walls(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], samples: int = _WALL_SAMPLES
) -> tuple[Points, Points, NDArray[np.float64]]:
    """Go through the walls at points that cover a closed surface evenly by area, the same points at every call.

    From each point a ray goes inward, against the normal of its triangle, to the first triangle that it meets.

    Returns: points and normals, shape (samples, 3), and lengths, (samples,), mm.  Those are NaN where the ray meets
        nothing: between triangles that do not close, or on an edge.
    """
    origin = local_origin(vertices)
    near = vertices - origin
    points, rows = sample_surface_points(near, triangles, samples)
    a, b, c = near[triangles[rows]].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    farthest = float(np.linalg.norm(near.max(axis=0) - near.min(axis=0))) + 1.0
    hits = TriangleTree(near, triangles).first_hits(points - _INWARD * normals, points - farthest * normals)
    return points + origin, normals, np.asarray(np.linalg.norm(hits - points, axis=1))


@dataclass(frozen=True, eq=False)
class WallFigures(Record):
    """How thick the walls of a surface are; None where none was measured.

    thin_share: Share of the surface whose wall is below `thin_mm`.
    not_measured: Points whose wall is not known.
    """

    min_mm: float | None
    p5_mm: float | None
    median_mm: float | None
    thin_share: float | None
    thin_mm: float
    samples: int
    not_measured: int

    @classmethod
    def of(cls, lengths: NDArray[np.float64], thin_mm: float) -> WallFigures:
        """Summarise thicknesses in mm, NaN where none was measured; walls below `thin_mm` are thin."""
        measured = lengths[np.isfinite(lengths)]
        missed = len(lengths) - len(measured)
        if not len(measured):
            return cls(None, None, None, None, thin_mm, len(lengths), missed)
        p5, median = float(np.percentile(measured, 5)), float(np.median(measured))
        share = float(np.mean(measured < thin_mm))
        return cls(float(measured.min()), p5, median, share, thin_mm, len(lengths), missed)


_PIECE = 1 << 13
"""Points in a piece: with six triangles each they take about 8 MB."""

IntArray = NDArray[np.integer]
Columns = NDArray[np.float64]
"""Shape (3, k): one row each for x, y, z."""


class NearDistance:
    """Distances from points to the triangles around vertices near each: never less than that to the surface."""

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.uint32]):
        self._triangles, self._fans = triangles, Fans(triangles, len(vertices))
        self._columns: Columns = np.ascontiguousarray(vertices.T, dtype=np.float64)

    def find_around(self, points: Points, near: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return distances to the triangles around several vertices of each point, (k, v), and their rows."""
        lengths, rows = self._around(points, near[:, 0])
        for others in near.T[1:]:
            length, row = self._around(points, others)
            rows = np.where(length < lengths, row, rows)
            lengths = np.minimum(lengths, length)
        return lengths, rows

    def _corners(self, rows: NDArray[np.integer]) -> tuple[Columns, Columns, Columns]:
        a, b, c = self._triangles[rows].T.astype(np.intp)
        # "clip" avoids checking each index, which takes longer than the look-up; the triangles have been checked.
        first, second, third = (self._columns.take(corner, axis=1, mode="clip") for corner in (a, b, c))
        return first, second, third

    def _around(self, points: Points, near: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the least distance to the triangles around one vertex of each point, and their rows."""
        lengths, rows = np.full(len(points), np.inf), np.full(len(points), -1)

        def measure_piece(piece: slice) -> None:
            row, count = self._fans.around(near[piece])
            pair, some = np.repeat(np.arange(len(count)), count), count > 0
            columns = np.ascontiguousarray(points[piece].T)
            length = triangle_distances(columns.take(pair, axis=1, mode="clip"), *self._corners(row))
            if some.any():
                lengths[piece][some] = np.minimum.reduceat(length, (np.cumsum(count) - count)[some])
                shortest = np.flatnonzero(length == lengths[piece][pair])[::-1]  # backwards: the first of equals wins
                rows[piece][pair[shortest]] = row[shortest]

        in_threads(measure_piece, len(points), _PIECE)
        return lengths, rows


def _perpendicular(points: Columns, a: Columns, b: Columns, c: Columns) -> NDArray[np.float64]:
    """Return the length of the perpendicular from each point to its triangle, infinity where its foot lies outside."""
    b, c = b - a, c - a
    points = points - a
    cross = cross_product(b, c)
    square = np.einsum("ij,ij->j", cross, cross)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Barycentric coordinates by volumes relative to that of the face (Ericson 2005, section 3.4).
        u = np.einsum("ij,ij->j", cross_product(points, c), cross) / square
        v = np.einsum("ij,ij->j", cross_product(b, points), cross) / square
        length = np.abs(np.einsum("ij,ij->j", points, cross)) / np.sqrt(square)
    return np.where((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0), length, np.inf)


def triangle_distances(points: Columns, a: Columns, b: Columns, c: Columns) -> NDArray[np.float64]:
    """Return the distance of each point (3, k) from its triangle: by the perpendicular, else to the nearest edge."""
    shortest = _perpendicular(points, a, b, c)
    beside = np.flatnonzero(np.isinf(shortest))
    points, a, b, c = (columns.take(beside, axis=1) for columns in (points, a, b, c))
    square = np.full(len(beside), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along, there = end - start, points - start
        length = np.einsum("ij,ij->j", along, along)
        share = np.clip(np.einsum("ij,ij->j", along, there) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
        there -= share * along
        np.minimum(square, np.einsum("ij,ij->j", there, there), out=square)
    shortest[beside] = np.sqrt(square)
    return shortest


_ROUNDINGS = 16.0
"""Units of the last place of the largest coordinate by which a bound may be too small: 16 steps of half a unit."""


def rounding_of_bounds(largest: float) -> float:
    """Return by how many mm a distance in float32 may be too short, from the largest coordinate in mm."""
    return _ROUNDINGS * float(np.spacing(np.float32(largest)))
