"""Exact distances from points of one surface to the triangles of another, to those near a vertex or single ones with
their upper bounds, and between the walls of a closed surface.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh.connectivity import Fans
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.triangle_tree import TriangleTree
from clrecon.mesh.triangles import cross_product, cross_products, enclosed_ml
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
    for side, target in enumerate((reference, mesh)):
        progress("compare", side, 2)
        sides.append(summarise_distances(SurfaceDistance(target.vertices, target.triangles)(points[side])))
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

_PIECE_OF_BOUNDS = 1 << 11
"""Points in a piece for upper bounds, which take 2 MB with six triangles each."""

IntArray = NDArray[np.integer]
Columns = NDArray[np.float64]
"""Shape (3, k): one row each for x, y, z."""


class NearDistance:
    """Distances from points to a surface, where a vertex of the surface near each point is known.

    If a triangle around that vertex is near enough, its distance is returned; it is never less than the distance to the
    surface.  For the other points all triangles are searched, and the result is exact.
    """

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.uint32], fans: Fans | None = None):
        self._vertices, self._triangles = vertices, triangles
        self._fans = fans or Fans(triangles, len(vertices))
        self._exact: SurfaceDistance | None = None
        self._all_columns: Columns | None = None
        self._frames: FaceFrames | None = None

    def __call__(self, points: Points, near: NDArray[np.integer], limit: float) -> NDArray[np.float64]:
        """Return distances in mm, shape (k,), from points (k, 3) with a vertex near each, shape (k,).

        Up to `limit` mm they may be too large, as only nearby triangles are examined.
        """
        lengths, _ = self.find_within(points, near, limit)
        rest = np.flatnonzero(~(lengths <= limit))
        if len(rest):
            self._exact = self._exact or SurfaceDistance(self._vertices, self._triangles)
            lengths[rest] = self._exact(points[rest])
        return lengths

    def find_within(
        self, points: Points, near: NDArray[np.integer], limit: float
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return distances to the triangles around one vertex only, and their rows; up to `limit` as `__call__`."""
        lengths, rows = self._around(points, near, _perpendicular)
        rest = np.flatnonzero(~(lengths <= limit))
        if len(rest):
            lengths[rest], rows[rest] = self._around(points[rest], near[rest], triangle_distances)
        return lengths, rows

    def find_surely_within(
        self, points: Points, near: NDArray[np.integer], limit: float
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """As `find_within`, but by upper bounds first: up to `limit` distances may be too large and rows others."""
        lengths, rows = self.find_upper_bounds(points, near)
        rest = np.flatnonzero(~(lengths <= limit))
        if len(rest):
            lengths[rest], rows[rest] = self._around(points[rest], near[rest], triangle_distances)
        return lengths, rows

    def find_upper_bounds(
        self, points: Points, near: NDArray[np.integer]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return upper bounds of the distances to the triangles around one vertex, and the rows of these."""
        lengths, rows = np.full(len(points), np.inf), np.full(len(points), -1)
        self.prepare()

        def bound_piece(piece: slice) -> None:
            lengths[piece], rows[piece] = self.upper_bounds(points[piece].T.astype(np.float32), near[piece])

        in_threads(bound_piece, len(points), _PIECE_OF_BOUNDS)
        return lengths, rows

    def upper_bounds(
        self, columns: NDArray[np.float32], near: NDArray[np.integer]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """As `find_upper_bounds`, for one piece: points in columns, shape (3, k), float32."""
        pair, row, start, some = self._pairs(near)
        square = self.frames.squares(columns.take(pair, axis=1, mode="clip"), row)
        least = np.full(len(some), np.inf, dtype=np.float32)
        rows = np.full(len(some), -1)
        if some.any():
            least[some] = np.minimum.reduceat(square, start[some])
        best = np.flatnonzero(square == least[pair])[::-1]  # backwards: the first of equals wins
        rows[pair[best]] = row[best]
        np.sqrt(least, out=least)
        least += np.float32(self.slack)
        return least, rows

    @property
    def slack(self) -> float:
        """mm by which rounding may make the root of a square too short for an upper bound."""
        return self.frames.slack

    def prepare(self) -> None:
        """Make what upper bounds need, before threads use it."""
        assert self.frames is not None and len(self._columns) == 3

    @property
    def frames(self) -> FaceFrames:
        """Frames of the triangles, made when they are first asked for."""
        if self._frames is None:
            self._frames = FaceFrames(self._vertices, self._triangles)
        return self._frames

    def find_around(self, points: Points, near: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return distances to the triangles around several vertices of each point, (k, v), and their rows."""
        lengths, rows = self._around(points, near[:, 0], triangle_distances)
        for others in near.T[1:]:
            length, row = self._around(points, others, triangle_distances)
            rows = np.where(length < lengths, row, rows)
            lengths = np.minimum(lengths, length)
        return lengths, rows

    @property
    def _columns(self) -> Columns:
        """Vertices in columns, made when they are first asked for."""
        if self._all_columns is None:
            self._all_columns = np.ascontiguousarray(self._vertices.T, dtype=np.float64)
        return self._all_columns

    def _corners(self, rows: NDArray[np.integer]) -> tuple[Columns, Columns, Columns]:
        a, b, c = self._triangles[rows].T.astype(np.intp)
        # "clip" avoids checking each index, which takes longer than the look-up; the triangles have been checked.
        first, second, third = (self._columns.take(corner, axis=1, mode="clip") for corner in (a, b, c))
        return first, second, third

    def _around(
        self, points: Points, near: NDArray[np.integer], measure: Callable[..., NDArray[np.float64]]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the smallest value of a measure among the triangles around the vertices, and the rows of these."""
        lengths, rows = np.full(len(points), np.inf), np.full(len(points), -1)
        assert len(self._columns) == 3  # before threads use them

        def measure_piece(piece: slice) -> None:
            pair, row, start, some = self._pairs(near[piece])
            columns = np.ascontiguousarray(points[piece].T)
            length = measure(columns.take(pair, axis=1, mode="clip"), *self._corners(row))
            if some.any():
                lengths[piece][some] = np.minimum.reduceat(length, start[some])
                shortest = np.flatnonzero(length == lengths[piece][pair])[::-1]  # backwards: the first of equals wins
                rows[piece][pair[shortest]] = row[shortest]

        in_threads(measure_piece, len(points), _PIECE)
        return lengths, rows

    def _pairs(self, near: NDArray[np.integer]) -> tuple[IntArray, IntArray, IntArray, NDArray[np.bool_]]:
        """List pairs of a place in `near` and a triangle around it; where each vertex's pairs begin, if it has any."""
        row, count = self._fans.around(near)
        return np.repeat(np.arange(len(count)), count), row, np.cumsum(count) - count, count > 0


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


class FaceFrames:
    """A frame in each triangle near zero: a corner, two edges, and what gives the coordinates along them."""

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.uint32]):
        columns = np.ascontiguousarray(vertices.T, dtype=np.float64)
        corner, to_b, to_c = (columns.take(index, axis=1) for index in triangles.T.astype(np.intp))
        to_b -= corner
        to_c -= corner
        cross = cross_product(to_b, to_c)
        square = np.einsum("ij,ij->j", cross, cross)
        inverse = np.divide(1.0, square, out=np.zeros_like(square), where=square > 0.0)
        along = (cross_product(to_c, cross) * inverse, cross_product(cross, to_b) * inverse)
        # One row a triangle, 16 numbers: they lie side by side, and a look-up costs one access to memory.
        self._rows = np.zeros((len(triangles), 16), dtype=np.float32)
        for column, part in enumerate((corner, *along, to_b, to_c)):
            self._rows[:, 3 * column : 3 * column + 3] = part.T
        self.slack = rounding_of_bounds(float(np.abs(columns).max(initial=0.0)))

    def squares(self, points: NDArray[np.float32], rows: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return squares of upper bounds, but for `slack` mm by rounding, of distances (k,) to triangles."""
        frames = np.ascontiguousarray(self._rows.take(rows, axis=0, mode="clip").T)
        away = points - frames[0:3]
        u = away[0] * frames[3]
        v = away[0] * frames[6]
        for axis in (1, 2):
            u += away[axis] * frames[3 + axis]
            v += away[axis] * frames[6 + axis]
        # Whatever u and v are by now, the point with these shares of the edges lies in the triangle.
        np.maximum(u, 0.0, out=u)
        np.maximum(v, 0.0, out=v)
        both = u + v
        np.maximum(both, 1.0, out=both)
        u /= both
        v /= both
        away -= u * frames[9:12]
        away -= v * frames[12:15]
        away *= away
        squared: NDArray[np.float32] = away[0] + away[1]
        squared += away[2]
        return squared
