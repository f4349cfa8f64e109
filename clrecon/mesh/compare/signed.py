"""Signed distances between two surfaces: as `compare_meshes` measures them, with a sign where a surface is closed.

The sign is that of the angle-weighted pseudonormal at the nearest point of the surface, which is right for every
closed surface whose triangles face outward (Baerentzen and Aanaes 2005): on a face its normal, on an edge the sum of
the normals of both faces, at a vertex the sum of those around it weighted by their angles.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh.compare.distances import (
    SAMPLES,
    DistanceSummary,
    Points,
    SurfaceDistance,
    sample_surface,
    summarise_distances,
)
from clrecon.mesh.connectivity import IntArray, Topology, find_edges, number_used, opposite_half_edges
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.quality import MeshQuality, TriangleSums, survey_surface
from clrecon.mesh.triangle_tree import TriangleTree
from clrecon.mesh.triangles import cross_product, vertex_normals
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import chunks, local_origin
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record

_AT_CORNER = 1e-6
"""Share of a triangle within which the nearest point counts as on its edge or at its corner."""

_PIECE = 1 << 16
"""Points between two calls of `progress`."""


class SignedDistance:
    """Exact distances from points to the nearest triangle of a closed surface, below zero inside.

    triangles: Every edge in two triangles, which run along it in opposite directions; triangles with a corner twice,
        which are no surface, are left out.
    outward: False: the triangles face inward, and the sign is turned.
    opposite: The half-edge opposite each where it is known: then no triangle has a corner twice.
    """

    def __init__(
        self,
        vertices: NDArray[np.floating],
        triangles: NDArray[np.uint32],
        *,
        outward: bool = True,
        opposite: IntArray | None = None,
    ):
        if opposite is None:
            a, b, c = triangles.T
            triangles = triangles[(a != b) & (b != c) & (c != a)]  # one with a corner twice is no surface
            opposite = opposite_half_edges(triangles, find_edges(triangles, len(vertices)))
        if opposite is None:
            raise UsageError("distances have a sign where the surface is closed and its triangles agree on the outside")
        self._origin = local_origin(vertices)
        self._vertices = (vertices - self._origin).astype(np.float64)
        self._triangles = triangles
        self._tree = TriangleTree(vertices - self._origin, triangles)
        self._sign = 1.0 if outward else -1.0
        self._opposite = opposite

    def __call__(self, points: Points) -> NDArray[np.float64]:
        """Distances in mm, shape (k,), from `points`, shape (k, 3), mm; positive outside."""
        local = points - self._origin
        nearest, rows, _ = self._tree.nearest(local)
        away = local - nearest
        distance = np.sqrt(np.einsum("ij,ij->i", away, away))
        side = np.einsum("ij,ij->i", away, self._normals_at(nearest, rows))
        return np.where(side < 0.0, -self._sign, self._sign) * distance + 0.0

    def _normals_of(self, rows: IntArray) -> Points:
        """Return the normals of triangles, (k, 3), of unit length or zero."""
        a, b, c = (self._vertices[corner].T for corner in self._triangles[rows].T)
        cross = cross_product(b - a, c - a)
        length = np.sqrt(np.einsum("ij,ij->j", cross, cross))
        return np.divide(cross, length, out=np.zeros_like(cross), where=length > 0.0).T

    def _normals_at(self, places: Points, rows: NDArray[np.int64]) -> Points:
        """Return pseudonormals at places on triangles, shape (k, 3)."""
        a, b, c = (self._vertices[corner] for corner in self._triangles[rows].T)
        p, q = b - a, c - a
        there = places - a
        cross = np.cross(p, q)
        square = np.einsum("ij,ij->i", cross, cross)
        safe = np.where(square > 0.0, square, 1.0)
        shares = np.empty((len(rows), 3))
        shares[:, 1] = np.einsum("ij,ij->i", np.cross(there, q), cross) / safe
        shares[:, 2] = np.einsum("ij,ij->i", np.cross(p, there), cross) / safe
        shares[:, 0] = 1.0 - shares[:, 1] - shares[:, 2]
        near = np.stack([np.linalg.norm(places - corner, axis=1) for corner in (a, b, c)], axis=1)
        absent = shares <= _AT_CORNER
        absent[square == 0.0] = True  # a triangle without area: the nearest of its corners
        count = absent.sum(axis=1)
        normals = self._normals_of(rows)
        on_edge = np.flatnonzero(count == 1)
        # Half-edge i runs from corner i to the next one: the corner that is absent is the one before.
        half = (absent[on_edge].argmax(axis=1) + 1) % 3
        normals[on_edge] += self._normals_of(self._opposite[3 * rows[on_edge] + half] // 3)
        at_corner = np.flatnonzero(count >= 2)
        corner = self._triangles[rows[at_corner], near[at_corner].argmin(axis=1)]
        normals[at_corner] = self._normals_around(corner)
        return np.asarray(normals)

    def _normals_around(self, corners: NDArray[np.integer]) -> Points:
        """Return pseudonormals at vertices, (k, 3), from the triangles around these alone."""
        wanted = np.zeros(len(self._vertices), dtype=bool)
        wanted[corners] = True
        a, b, c = (wanted[corner] for corner in self._triangles.T)
        used, triangles = number_used(self._triangles[a | b | c], len(wanted))
        return vertex_normals(self._vertices[used], triangles)[np.searchsorted(used, corners)].astype(np.float64)


@dataclass(frozen=True, eq=False)
class Ruler:
    """What measures distances from a surface, `signed` where it is closed, and `warnings` of what was found in it."""

    distances_of: SignedDistance | SurfaceDistance
    signed: bool
    warnings: list[str]
    twice_areas: NDArray[np.float64]

    @classmethod
    def of(cls, mesh: Mesh, name: str, survey: tuple[MeshQuality, Topology, TriangleSums] | None = None) -> Ruler:
        """Make the ruler of a mesh that warnings call `name`; `survey`: that by triangle, if it is known."""
        mesh.check()
        if not mesh.triangle_count:
            raise NoSurfaceError(f"{name} has no triangles: there is nothing to measure from")
        quality, topology, sums = survey or survey_surface(mesh.vertices, mesh.triangles, by_triangle=True)
        why = why_unsigned(quality, name)
        if why is not None:
            return cls(SurfaceDistance(mesh.vertices, mesh.triangles), False, [why], sums.twice_areas)
        inverted = f"{name} is turned inside out: the sign of distances from it is turned back"
        signed = SignedDistance(mesh.vertices, mesh.triangles, outward=quality.outward, opposite=topology.opposite)
        return cls(signed, True, [] if quality.outward else [inverted], sums.twice_areas)

    def measure(
        self, points: NDArray[np.floating], progress: Progress | None, side: tuple[int, int] = (0, 1)
    ) -> NDArray[np.float64]:
        """Measure points (k, 3), mm; `side`: its number and how many there are, for `progress`."""
        report, distances = progress or ignore_progress, np.empty(len(points))
        before, total = (number * len(points) for number in side)
        for piece in chunks(len(points), _PIECE):
            report("compare", before + piece.start, total)
            distances[piece] = self.distances_of(points[piece].astype(np.float64))
        report("compare", before + len(points), total)
        return distances


@dataclass(frozen=True, eq=False)
class SideDistance(Record):
    """Signed distances of points of one surface from another, mm; positive outside of the other."""

    mean: float
    sd: float
    p5: float
    median: float
    p95: float
    min: float
    max: float
    outside_share: float


@dataclass(frozen=True, eq=False, kw_only=True)
class MeshDeviation(Record):
    """How far two surfaces lie apart, and on which side.

    hausdorff_mm: Largest distance found, of both sides; what lies between the points can be a little further.
    hd95_mm: The larger of the two 95th percentiles (robust Hausdorff distance).
    assd_mm: Mean of both sides (average symmetric surface distance).
    to_reference_mm, from_reference_mm: From points of the mesh to the reference, and back, without sign.
    to_reference_signed_mm: Positive where the mesh lies outside the reference; None where the reference is not closed.
    from_reference_signed_mm: Positive where the reference lies outside the mesh; None where the mesh is not closed.
    warnings: Why a side has no sign, or that one was turned.
    samples: Number of points on each surface.
    """

    hausdorff_mm: float
    hd95_mm: float
    assd_mm: float
    to_reference_mm: DistanceSummary
    from_reference_mm: DistanceSummary
    to_reference_signed_mm: SideDistance | None
    from_reference_signed_mm: SideDistance | None
    warnings: list[str]
    samples: int


def why_unsigned(quality: MeshQuality, name: str) -> str | None:
    """Say why distances from a surface have no sign; None where they have one."""
    if quality.boundary_edges or quality.nonmanifold_edges:
        edges = quality.boundary_edges + quality.nonmanifold_edges
        loose = f"{edges:,} edge{'s' * (edges != 1)} not in two triangles"
        return f"{name} is not closed ({loose}): distances from it have no sign"
    if not quality.oriented:
        return f"the triangles of {name} do not agree which side is outside: distances from it have no sign"
    return None


@explains_arguments
def measure_distance(
    mesh: Mesh,
    reference: Mesh,
    samples: int = SAMPLES,
    *,
    names: tuple[str, str] = ("the mesh", "the reference"),
    progress: Progress | None = None,
) -> MeshDeviation:
    """Measure how far two surfaces lie apart, and on which side.

    As `compare_meshes`, from points that cover each surface evenly by area to the nearest triangle of the other; where
    the other is closed, the distances have a sign.

    Parameters
    ----------
    mesh, reference : Mesh
    samples : int
        Number of points on each surface.
    names : (str, str)
        Words for both, in warnings.
    progress : callable, optional
        Called as ``progress("compare", points done, all points)``.

    Returns
    -------
    MeshDeviation

    Raises
    ------
    NoSurfaceError
        A mesh is empty or has no area.
    UsageError
        ``samples`` is below 1.
    """
    if samples < 1:
        raise UsageError(f"distances need at least 1 sample, not {samples}")
    rulers = Ruler.of(reference, names[1]), Ruler.of(mesh, names[0])
    return compare_sides((mesh, reference), rulers, samples, progress)


def compare_sides(
    meshes: Sequence[Mesh], rulers: Sequence[Ruler], samples: int, progress: Progress | None = None
) -> MeshDeviation:
    """Measure two meshes as `measure_distance` does, points of each with the ruler of the other."""
    sides, signed = [], []
    for number, (source, ruler) in enumerate(zip(meshes, rulers, strict=True)):
        points = sample_surface(source.vertices, source.triangles, samples, rulers[1 - number].twice_areas)
        distances = ruler.measure(points, progress, (number, 2))
        sides.append(summarise_distances(np.abs(distances)))
        signed.append(_summarise_sides(distances) if ruler.signed else None)
    return MeshDeviation(
        hausdorff_mm=max(side.max for side in sides),
        hd95_mm=max(side.p95 for side in sides),
        assd_mm=0.5 * (sides[0].mean + sides[1].mean),
        to_reference_mm=sides[0],
        from_reference_mm=sides[1],
        to_reference_signed_mm=signed[0],
        from_reference_signed_mm=signed[1],
        warnings=[*rulers[0].warnings, *rulers[1].warnings],
        samples=samples,
    )


@explains_arguments
def measure_vertex_distances(
    mesh: Mesh, reference: Mesh, *, progress: Progress | None = None
) -> tuple[NDArray[np.float64], bool]:
    """Measure the distance of each vertex of a mesh from another surface.

    Parameters
    ----------
    mesh, reference : Mesh
    progress : callable, optional
        Called as ``progress("compare", vertices done, all vertices)``.

    Returns
    -------
    distances : ndarray, shape (n,), float64
        mm; positive outside of the reference where that is closed.
    signed : bool
        False: the reference is not closed, and the distances have no sign.

    Raises
    ------
    NoSurfaceError
        The reference is empty.
    """
    ruler = Ruler.of(reference, "the reference")
    return ruler.measure(mesh.vertices, progress), ruler.signed


def _summarise_sides(distances: NDArray[np.float64]) -> SideDistance:
    p5, median, p95 = np.percentile(distances, (5, 50, 95)).tolist()
    low, high = float(distances.min()), float(distances.max())
    outside = float(np.mean(distances > 0.0))
    return SideDistance(float(distances.mean()), float(distances.std()), p5, median, p95, low, high, outside)
