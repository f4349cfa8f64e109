"""Measures of a surface: the figures that tell whether it can be printed, and its components by their size."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.exchange.content import Pieces
from clrecon.exchange.coordinates import find_coincident
from clrecon.mesh import connectivity
from clrecon.mesh.triangles import cross_product, cross_products, take_edges
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import CHUNK, find_bounds, in_threads, local_origin
from clrecon.system.records import Record


@dataclass(frozen=True, eq=False, kw_only=True)
class MeshQuality(Record):
    """The figures of a triangle surface.

    closed: Every edge is in exactly two triangles, also after coincident vertices are joined, as readers of STL do.
    manifold: Oriented, no edge in more than two faces, faces around a vertex one fan, no face with a vertex twice.
    oriented: No two faces run along an edge in the same direction.
    boundary_edges, nonmanifold_edges: Edges in one face, in more than two.
    nonmanifold_vertices: Vertices whose faces form several fans.
    coincident_vertices: Used vertices that coincide with another one.
    open_edges_by_place: Edges that are not in exactly two faces after coincident vertices are joined.
    components: Parts that share no vertex.
    euler_number: Used vertices - edges + faces.
    genus: Handles of all parts together; None if not closed and manifold.
    shortest_edge_mm: None without edges.
    volume_ml: Enclosed volume; cavities count negative, and so does a surface turned inside out.  Only if closed.
    outward: The volume is positive.
    bounds_mm: [[x, y, z], [x, y, z]] or None. Lowest and highest corner; None without vertices.
    self_intersections: Pairs of triangles that cut each other, as CGAL counts them; None unless a strict job looked.
    """

    _SHOWN = ("triangles", "closed", "manifold", "components", "volume_ml")
    vertices: int
    triangles: int
    closed: bool
    manifold: bool
    oriented: bool
    boundary_edges: int
    nonmanifold_edges: int
    nonmanifold_vertices: int
    coincident_vertices: int
    open_edges_by_place: int
    components: int
    euler_number: int
    genus: int | None
    zero_area_faces: int
    duplicate_faces: int
    unused_vertices: int
    shortest_edge_mm: float | None
    area_mm2: float
    volume_ml: float
    outward: bool
    bounds_mm: list[list[float]] | None
    self_intersections: int | None = None


def measure_quality(vertices: NDArray[np.floating], triangles: NDArray[np.uint32]) -> MeshQuality:
    return survey_surface(vertices, triangles)[0]


def survey_surface(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    topology: connectivity.Topology | None = None,
    *,
    by_triangle: bool = False,
) -> tuple[MeshQuality, connectivity.Topology, TriangleSums]:
    """Measure a surface; return also what that rests on.

    topology: Of these triangles, if it is known.
    by_triangle: The sums have the arrays of all triangles.
    """
    vertex_count, triangle_count = len(vertices), len(triangles)
    if topology is None and triangle_count and int(triangles.max()) >= vertex_count:
        raise UsageError(f"a triangle refers to vertex {int(triangles.max())}, the mesh has {vertex_count} vertices")
    topology = topology or connectivity.find_topology(triangles, vertex_count)
    components, labels = topology.labelled
    unused = int(np.count_nonzero(labels < 0))
    euler_number = vertex_count - unused - topology.edges + triangle_count
    open_edges = topology.boundary + topology.nonmanifold
    coincident, open_by_place = _count_by_place(vertices, triangles, labels >= 0, open_edges)
    closed = triangle_count > 0 and open_edges == 0 and open_by_place == 0
    is_split = topology.nonmanifold > 0 or topology.split_vertices > 0 or topology.loops > 0
    manifold = triangle_count > 0 and topology.oriented and not is_split
    sums = measure_triangles(vertices, triangles, by_triangle=by_triangle)
    quality = MeshQuality(
        vertices=vertex_count,
        triangles=triangle_count,
        closed=closed,
        manifold=manifold,
        oriented=topology.oriented,
        boundary_edges=topology.boundary,
        nonmanifold_edges=topology.nonmanifold,
        nonmanifold_vertices=topology.split_vertices,
        coincident_vertices=coincident,
        open_edges_by_place=open_by_place,
        components=components,
        euler_number=euler_number,
        genus=components - euler_number // 2 if closed and manifold else None,
        zero_area_faces=sums.zero_area_faces,
        duplicate_faces=topology.duplicate_faces,
        unused_vertices=unused,
        shortest_edge_mm=sums.shortest_edge_mm,
        area_mm2=sums.area_mm2,
        volume_ml=sums.volume_mm3 / 1000.0,
        outward=sums.volume_mm3 > 0.0,
        bounds_mm=[corner.tolist() for corner in find_bounds(vertices)] if vertex_count else None,
    )
    return quality, topology, sums


def _count_by_place(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], used: NDArray[np.bool_], open_edges: int
) -> tuple[int, int]:
    """Count used vertices that coincide with another, and edges that are not in two faces after these are joined."""
    coincident = find_coincident(vertices)
    coincident = coincident[used[coincident]]
    places, first, number = np.unique(vertices[coincident], axis=0, return_index=True, return_inverse=True)
    if len(places) == len(coincident):  # the vertices that they coincide with are not used
        return 0, open_edges
    joined = np.arange(len(vertices), dtype=np.uint32)
    joined[coincident] = coincident[first][number.reshape(-1)]
    faces = joined[triangles]
    a, b, c = faces.T
    by_place = connectivity.find_edges(faces[(a != b) & (b != c) & (c != a)], len(vertices))
    return len(coincident), by_place.boundary + by_place.nonmanifold


@dataclass(frozen=True, eq=False)
class TriangleSums:
    """Measures of triangles; volumes have signs.

    twice_areas, six_volumes: Of each triangle, mm2 and mm3, the latter over an origin that all have in common.  Empty
        unless they were wanted.
    """

    area_mm2: float
    volume_mm3: float
    zero_area_faces: int
    shortest_edge_mm: float | None
    twice_areas: NDArray[np.float64]
    six_volumes: NDArray[np.float64]


def measure_triangles(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], *, by_triangle: bool = False
) -> TriangleSums:
    columns, origin = np.ascontiguousarray(vertices.T.astype(np.float64)), local_origin(vertices)
    pieces: dict[int, tuple[float, ...]] = {}
    twice_areas, six_volumes = (np.empty(len(triangles) if by_triangle else 0) for _ in range(2))

    def measure_piece(piece: slice) -> None:
        corner, p, q = take_edges(columns, triangles[piece], origin)
        cross = cross_product(p, q)
        squares = np.einsum("ij,ij->j", cross, cross)
        shortest = min(np.einsum("ij,ij->j", edge, edge).min() for edge in (p, q, q - p))
        volume = np.einsum("ij,ij->", corner, cross)
        lengths = np.sqrt(squares)
        if by_triangle:
            twice_areas[piece] = lengths
            np.einsum("ij,ij->j", corner, cross, out=six_volumes[piece])
        pieces[piece.start] = lengths.sum(), volume, int(np.count_nonzero(squares == 0.0)), shortest

    in_threads(measure_piece, len(triangles))
    if not pieces:
        return TriangleSums(0.0, 0.0, 0, None, twice_areas, six_volumes)
    rows = np.array([pieces[start] for start in sorted(pieces)])
    twice_area, six_volume, zero_area, _ = rows.sum(axis=0).tolist()
    shortest = math.sqrt(rows[:, 3].min())
    return TriangleSums(twice_area / 2.0, six_volume / 6.0, int(zero_area), shortest, twice_areas, six_volumes)


def measure_component_ml(
    triangles: NDArray[np.uint32], sums: TriangleSums, topology: connectivity.Topology
) -> NDArray[np.float64]:
    """Return the enclosed volume of each closed component, ml, without sign, from sums of each triangle."""
    count, labels = topology.labelled
    return np.abs(np.bincount(labels.take(triangles[:, 0]), sums.six_volumes, count)) / 6000.0


def find_pieces(vertices: NDArray[np.floating], triangles: NDArray[np.uint32], most: int) -> Pieces:
    """Divide a surface into its `most` components of largest area, that first, and one part of all others.

    The volume of an open component is measured as if its rim were joined to the mean of its corners; that of all others
    together is the sum, regardless of sign.

    most: 1: the surface is one part, whatever its components.
    """
    if most == 1:
        whole = np.zeros(len(triangles), dtype=np.int64)
        _, volumes = measure_components(vertices, triangles, whole, 1, areas=False, volumes=True)
        return Pieces(whole, ("",), (float(volumes[0]),))
    count, labels = connectivity.label_components(triangles, len(vertices))
    of_triangle = labels[triangles[:, 0]]
    areas, volumes = measure_components(vertices, triangles, of_triangle, count, areas=True, volumes=True)
    ranked = np.argsort(-areas, kind="stable")
    rank = np.empty(count, dtype=np.int64)
    rank[ranked] = np.minimum(np.arange(count), most)
    names = [f"part {number}" for number in range(1, min(count, most) + 1)] if count > 1 else [""]
    sizes = [float(value) for value in volumes[ranked[:most]]]
    if count > most:
        names.append("1 smaller part" if count == most + 1 else f"{count - most:,} smaller parts")
        sizes.append(float(volumes[ranked[most:]].sum()))
    return Pieces(rank[of_triangle], tuple(names), tuple(sizes))


def measure_components(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    label_of_triangle: NDArray[np.int64],
    count: int,
    *,
    areas: bool,
    volumes: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure area in mm2 and enclosed volume in ml, without sign, of each component; zeros where not wanted."""
    twice_area = np.zeros(count)
    six_volumes = np.zeros(count)
    cross_sum = np.zeros((3, count))
    corner_sum = np.zeros((3, count))
    if not areas and not volumes:
        return twice_area, six_volumes
    # Every piece adds to all components: with many components, larger pieces save time.
    size = max(CHUNK, count)
    for piece, corner, cross in cross_products(vertices, triangles, local_origin(vertices), size):
        label = label_of_triangle[piece]
        if areas:
            twice_area += np.bincount(label, np.sqrt(np.einsum("ij,ij->j", cross, cross)), count)
        if volumes:
            six_volumes += np.bincount(label, np.einsum("ij,ij->j", corner, cross), count)
            for axis in range(3):
                cross_sum[axis] += np.bincount(label, cross[axis], count)
                corner_sum[axis] += np.bincount(label, corner[axis], count)
    # From the common origin to one within each component.  This changes nothing for closed components, whose cross
    # products sum to zero.
    centre = corner_sum / np.bincount(label_of_triangle, minlength=count)
    six_volumes -= np.einsum("ij,ij->j", centre, cross_sum)
    return twice_area / 2.0, np.abs(six_volumes) / 6000.0
