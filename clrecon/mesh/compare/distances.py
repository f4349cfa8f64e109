"""Distances between two surfaces: exact distances from points of one to the triangles of the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh.connectivity import order_by_number
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.triangles import cross_product, cross_products
from clrecon.mesh.vtk import CellLocator
from clrecon.system.pieces import chunks, local_origin
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record

__all__ = [
    "SAMPLES",
    "DistanceSummary",
    "MeshDistance",
    "NearDistance",
    "SurfaceDistance",
    "compare_meshes",
    "sample_surface",
    "sample_surface_points",
    "summarise_distances",
    "triangle_distances",
]

SAMPLES = 50_000
"""Points on each surface, so that the 95th percentile is based on the 2500 largest distances."""

_PIECE = 1 << 13
"""Points in a piece: with six triangles each they take about 8 MB."""

_STEPS_U, _STEPS_V = 0.7548776662466927, 0.5698402909980532
"""Powers of the inverse of the plastic number: the two-dimensional low-discrepancy sequence R2 (Roberts 2018)."""

Points = NDArray[np.float64]
Columns = NDArray[np.float64]
"""Shape (3, k): one row each for x, y, z."""


def sample_surface(vertices: NDArray[np.floating], triangles: NDArray[np.uint32], count: int = SAMPLES) -> Points:
    """Return points that cover a surface evenly by area, the same points at every call.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), mm
    triangles : ndarray, shape (m, 3), uint32
    count : int

    Returns
    -------
    ndarray, shape (count, 3), float64, mm

    Raises
    ------
    NoSurfaceError
        The surface has no area.
    """
    return sample_surface_points(vertices, triangles, count)[0]


def sample_surface_points(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], count: int = SAMPLES
) -> tuple[Points, NDArray[np.int64]]:
    """As `sample_surface`, with the row of the triangle of each point, shape (count,)."""
    area = np.zeros(len(triangles))
    for where, _, cross in cross_products(vertices, triangles, np.zeros(3)):
        area[where] = np.sqrt(np.einsum("ij,ij->j", cross, cross))
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
    """Exact distances from points to the nearest triangle of a surface.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), mm
    triangles : ndarray, shape (m, 3), uint32, at least one
    """

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.uint32]):
        self._origin = local_origin(vertices)
        self._locator = CellLocator(vertices - self._origin, triangles)

    def __call__(self, points: Points) -> NDArray[np.float64]:
        """Distances in mm, shape (k,), from `points`, shape (k, 3), mm."""
        return self._locator.distances(points - self._origin)


class NearDistance:
    """Distances from points to a surface, where a vertex of the surface near each point is known.

    If a triangle around that vertex is near enough, its distance is returned; it is never less than the distance to the
    surface.  For the other points all triangles are searched, and the result is exact.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), mm
    triangles : ndarray, shape (m, 3), uint32
    """

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.uint32]):
        self._vertices, self._triangles = vertices, triangles
        corners = triangles.reshape(-1)
        self._face_of = order_by_number(corners, len(vertices)) // 3
        self._begin = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=len(vertices)))])
        self._columns = np.ascontiguousarray(vertices.T, dtype=np.float64)
        self._exact: SurfaceDistance | None = None

    def __call__(self, points: Points, near: NDArray[np.integer], limit: float) -> NDArray[np.float64]:
        """Return distances in mm, shape (k,); up to `limit` they may be too large, as only nearby triangles are
        examined.

        Parameters
        ----------
        points : ndarray, shape (k, 3), float64, mm
        near : ndarray, shape (k,), int
            A vertex near each point.
        limit : float
            mm.
        """
        found, _ = self.find_within(points, near, limit)
        rest = np.flatnonzero(~(found <= limit))
        if len(rest):
            self._exact = self._exact or SurfaceDistance(self._vertices, self._triangles)
            found[rest] = self._exact(points[rest])
        return found

    def find_within(
        self, points: Points, near: NDArray[np.integer], limit: float
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return distances to the triangles around one vertex only, and the rows of these; up to `limit` as for
        `__call__`.

        Parameters
        ----------
        points, near, limit
            As in `__call__`.
        """
        found, rows = self._around(points, near, _perpendicular)
        rest = np.flatnonzero(~(found <= limit))
        if len(rest):
            found[rest], rows[rest] = self._around(points[rest], near[rest], triangle_distances)
        return found, rows

    def find_around(self, points: Points, near: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return distances to the triangles around some vertices only; infinity and row -1 where there are no
        triangles.

        Parameters
        ----------
        points : ndarray, shape (k, 3), float64, mm
        near : ndarray, shape (k, v), int
            Several vertices for each point.
        """
        found, rows = self._around(points, near[:, 0], triangle_distances)
        for others in near.T[1:]:
            length, row = self._around(points, others, triangle_distances)
            rows = np.where(length < found, row, rows)
            found = np.minimum(found, length)
        return found, rows

    def from_triangles(self, points: Points, rows: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return the distance in mm of each of the points from one triangle, shape (k,)."""
        found = np.empty(len(points))
        for where in chunks(len(points), 4 * _PIECE):
            found[where] = triangle_distances(points[where].T, *self._corners(rows[where]))
        return found

    def _corners(self, rows: NDArray[np.integer]) -> tuple[Columns, Columns, Columns]:
        a, b, c = self._triangles[rows].T.astype(np.intp)
        # "clip" avoids checking each index, which takes longer than the look-up; the triangles have been checked.
        one, two, three = (self._columns.take(corner, axis=1, mode="clip") for corner in (a, b, c))
        return one, two, three

    def _around(
        self, points: Points, near: NDArray[np.integer], measure: Callable[..., NDArray[np.float64]]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the smallest value of a measure among the triangles around the vertices, and the rows of these."""
        found, rows = np.full(len(points), np.inf), np.full(len(points), -1)
        for where in chunks(len(points), _PIECE):
            first = self._begin[near[where]]
            count = self._begin[near[where] + 1] - first
            start = np.concatenate([[0], np.cumsum(count)[:-1]])
            pair = np.repeat(np.arange(len(count)), count)
            row = self._face_of[np.arange(len(pair)) - start[pair] + first[pair]]
            columns = np.ascontiguousarray(points[where].T)
            length = measure(columns.take(pair, axis=1, mode="clip"), *self._corners(row))
            some = count > 0
            if some.any():
                found[where][some] = np.minimum.reduceat(length, start[some])
                shortest = np.flatnonzero(length == found[where][pair])[::-1]  # backwards: the first of equals wins
                rows[where][pair[shortest]] = row[shortest]
        return found, rows


def _perpendicular(points: Columns, a: Columns, b: Columns, c: Columns) -> NDArray[np.float64]:
    """Return the length of the perpendicular from each point to its triangle, infinity where its foot lies outside."""
    b, c, points = b - a, c - a, points - a
    cross = cross_product(b, c)
    square = np.einsum("ij,ij->j", cross, cross)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Barycentric coordinates by volumes relative to that of the face (Ericson 2005, section 3.4).
        u = np.einsum("ij,ij->j", cross_product(points, c), cross) / square
        v = np.einsum("ij,ij->j", cross_product(b, points), cross) / square
        length = np.abs(np.einsum("ij,ij->j", points, cross)) / np.sqrt(square)
    return np.where((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0), length, np.inf)


def triangle_distances(points: Columns, a: Columns, b: Columns, c: Columns) -> NDArray[np.float64]:
    """Return the distance of each point from its triangle: to the face by the perpendicular, else to the nearest edge.

    Parameters
    ----------
    points, a, b, c : ndarray, shape (3, k), float64, mm
        Points and corners of the triangles, one row each for x, y, z.

    Returns
    -------
    ndarray, shape (k,), float64, mm
    """
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

    Attributes
    ----------
    hd95_mm : float
        The larger of the two 95th percentiles (robust Hausdorff distance).
    assd_mm : float
        Mean of both sides (average symmetric surface distance).
    max_mm : float
        Largest distance found; what lies between the points can be a little further.
    to_reference_mm, from_reference_mm : DistanceSummary
        Of each side.
    volume_change_percent : float or None
        Enclosed volume against that of the reference; None where that is zero, and without meaning for open surfaces.
    samples : int
        Number of points on each surface.
    """

    hd95_mm: float
    assd_mm: float
    max_mm: float
    to_reference_mm: DistanceSummary
    from_reference_mm: DistanceSummary
    volume_change_percent: float | None
    samples: int


def _enclosed_ml(mesh: Mesh, origin: NDArray[np.float64]) -> float:
    six = sum(
        float(np.einsum("ij,ij->", corner, cross))
        for _, corner, cross in cross_products(mesh.vertices, mesh.triangles, origin)
    )
    return six / 6000.0


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
        `samples` is below 1.
    """
    if samples < 1:
        raise UsageError(f"distances need at least 1 sample, not {samples}")
    mesh.check()
    reference.check()
    sides = []
    progress = progress or ignore_progress
    for side, (one, other) in enumerate(((mesh, reference), (reference, mesh))):
        progress("compare", side, 2)
        points = sample_surface(one.vertices, one.triangles, samples)
        sides.append(summarise_distances(SurfaceDistance(other.vertices, other.triangles)(points)))
    progress("compare", 2, 2)
    origin = local_origin(reference.vertices)
    volume, wanted = _enclosed_ml(mesh, origin), _enclosed_ml(reference, origin)
    return MeshDistance(
        hd95_mm=max(side.p95 for side in sides),
        assd_mm=0.5 * (sides[0].mean + sides[1].mean),
        max_mm=max(side.max for side in sides),
        to_reference_mm=sides[0],
        from_reference_mm=sides[1],
        volume_change_percent=100.0 * (volume - wanted) / abs(wanted) if wanted else None,
        samples=samples,
    )
