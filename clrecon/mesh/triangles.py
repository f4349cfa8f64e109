"""Triangles, in pieces that fit the processor's cache: areas, volumes, normals, the triangle nearest to a point."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clrecon.exchange.coordinates import rounding_step
from clrecon.system.pieces import CHUNK, chunks, in_threads, local_origin


def corner_edges(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], origin: NDArray[np.float64], size: int = CHUNK
) -> Iterator[tuple[slice, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the first corner of the triangles and the two edges from it, float64, `size` triangles at a time.

    Differences of float32 coordinates and their products are exact in float64.

    Yields:
    piece: Of the triangles.
    corner, p, q: ndarray, shape (3, k), float64. One row each for x, y, z, mm; the corner is relative to `origin`, p is
        the edge to the second corner, q to the third.
    """
    columns = np.ascontiguousarray(vertices.T.astype(np.float64))
    for piece in chunks(len(triangles), size):
        yield piece, *take_edges(columns, triangles[piece], origin)


def take_edges(
    columns: NDArray[np.float64], triangles: NDArray[np.uint32], origin: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return first corner and edges as `corner_edges` yields them, from the vertices in columns, (3, n)."""
    # "clip" is three times as fast as numpy's default check; callers have checked the indices.
    corner, p, q = (np.take(columns, index, axis=1, mode="clip") for index in triangles.T.astype(np.intp))
    p -= corner
    q -= corner
    corner -= origin[:, None]
    return corner, p, q


def cross_product(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross product of vectors in columns, shape (3, k)."""
    cross = np.empty_like(p)
    cross[0] = p[1] * q[2] - p[2] * q[1]
    cross[1] = p[2] * q[0] - p[0] * q[2]
    cross[2] = p[0] * q[1] - p[1] * q[0]
    return cross


def cross_products(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], origin: NDArray[np.float64], size: int = CHUNK
) -> Iterator[tuple[slice, NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the first corner of the triangles and the cross product of the edges from it, as `corner_edges`.

    The cross product c of the edges from the first corner a, mm2, is twice the area times the outward normal, and a . c
    is six times the signed volume of the tetrahedron over the origin (divergence theorem). With float32 coordinates, c
    is zero exactly for triangles without area.
    """
    for piece, corner, p, q in corner_edges(vertices, triangles, origin, size):
        yield piece, corner, cross_product(p, q)


def enclosed_ml(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], origin: NDArray[np.float64] | None = None
) -> float:
    """Return the volume that a closed mesh encloses, in ml, signed: cavities count negative; `origin` is near it."""
    pieces = cross_products(vertices, triangles, local_origin(vertices) if origin is None else origin)
    return float(sum(float(np.einsum("ij,ij->", corner, cross)) for _, corner, cross in pieces)) / 6000.0


def vertex_normals(vertices: NDArray[np.floating], triangles: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Return unit normals (n, 3), weighted by the angle of each face (Thuermer and Wuethrich 1998), else (0, 0, 1)."""
    columns = np.ascontiguousarray(vertices.T.astype(np.float64))
    total = np.zeros((3, len(vertices)))
    parts: dict[int, tuple[int, NDArray[np.float64]]] = {}

    def sum_piece(piece: slice) -> None:
        corners = triangles[piece].T
        low = int(corners.min())
        parts[piece.start] = low, _sum_normals(columns, corners, low)

    def add(piece: slice) -> None:
        low, part = parts.pop(piece.start)
        total[:, low : low + part.shape[1]] += part

    in_threads(sum_piece, len(triangles), CHUNK, add)
    length = np.sqrt(np.einsum("ij,ij->j", total, total))
    flat = length == 0.0
    total[:, flat] = np.array([[0.0], [0.0], [1.0]])
    length[flat] = 1.0
    return np.ascontiguousarray((total / length).T, dtype=np.float32)


def _sum_normals(columns: NDArray[np.float64], corners: NDArray[np.uint32], low: int) -> NDArray[np.float64]:
    """Sum the normals of triangles at corners (3, m), weighted by angle, for vertices from `low` on, (3, k)."""
    a, b, c = (columns.take(corner, axis=1, mode="clip") for corner in corners.astype(np.intp))
    p, q = b - a, c - a
    cross = cross_product(p, q)
    twice_area = np.sqrt(np.einsum("ij,ij->j", cross, cross))
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = np.where(twice_area > 0.0, cross / twice_area, 0.0)
    dots = (np.einsum("ij,ij->j", p, q), np.einsum("ij,ij->j", p, p - q))
    part = np.zeros((3, int(corners.max()) - low + 1))
    first, second = (np.arctan2(twice_area, dot) for dot in dots)
    for corner, angle in zip(corners, (first, second, np.pi - first - second), strict=True):
        for axis in range(3):
            part[axis] += np.bincount(corner - low, cross[axis] * angle, part.shape[1])
    return part


Points = NDArray[np.float64]


def find_nearest_triangle(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], point: NDArray[np.float64]
) -> tuple[int, float]:
    """Find the triangle nearest to a point, and its distance in mm.

    The box around a triangle is never farther away than the triangle, and its nearest corner is never nearer.  So only
    triangles whose box is nearer than the nearest of all corners are measured exactly.  Of several that are equally
    near, up to the rounding of the coordinates, it is the first.
    """
    columns = np.ascontiguousarray(vertices.T.astype(np.float64)) - point[:, None]
    corner_distance = np.einsum("ij,ij->j", columns, columns)
    box_distance = np.empty(len(triangles))
    nearest_corner = np.inf
    for piece in chunks(len(triangles)):
        a, b, c = triangles[piece].T.astype(np.intp)
        corner_a, corner_b, corner_c = (np.take(columns, index, axis=1, mode="clip") for index in (a, b, c))
        low = np.minimum(np.minimum(corner_a, corner_b), corner_c)
        high = np.maximum(np.maximum(corner_a, corner_b), corner_c)
        gap = np.maximum(np.maximum(low, -high), 0.0)
        box_distance[piece] = np.einsum("ij,ij->j", gap, gap)
        nearest_corner = min(nearest_corner, *(float(corner_distance[corner].min()) for corner in (a, b, c)))
    slack = 2.0 * rounding_step(vertices)  # a point and a triangle are each rounded
    near = np.flatnonzero(box_distance <= (math.sqrt(nearest_corner) + slack) ** 2)
    distances = _distances_from_origin(*(columns[:, triangles[near, corner]].T for corner in range(3)))
    first = int(np.flatnonzero(distances <= distances.min() + slack)[0])
    return int(near[first]), float(distances[first])


def _distances_from_origin(a: Points, b: Points, c: Points) -> NDArray[np.float64]:
    """Return the distance of the origin from each triangle (a, b, c), corners of shape (k, 3): from face or edge."""
    edges = np.minimum(np.minimum(_distances_to_edge(a, b), _distances_to_edge(b, c)), _distances_to_edge(c, a))
    normal = np.cross(b - a, c - a)
    above = [np.einsum("ij,ij->i", normal, np.cross(p, q)) for p, q in ((a, b), (b, c), (c, a))]
    length = np.linalg.norm(normal, axis=1)
    inside = (np.minimum(np.minimum(*above[:2]), above[2]) >= 0.0) & (length > 0.0)
    face = np.abs(np.einsum("ij,ij->i", normal, a)) / np.where(inside, length, 1.0)
    return np.where(inside, face, edges)


def _distances_to_edge(a: Points, b: Points) -> NDArray[np.float64]:
    along = b - a
    square = np.einsum("ij,ij->i", along, along)
    share = np.clip(-np.einsum("ij,ij->i", a, along) / np.where(square > 0.0, square, 1.0), 0.0, 1.0)
    distance: NDArray[np.float64] = np.linalg.norm(a + share[:, None] * along, axis=1)
    return distance
