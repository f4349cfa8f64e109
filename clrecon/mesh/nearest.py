"""The nearest triangle of a surface to a point."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clrecon.exchange.coordinates import rounding_step
from clrecon.system.pieces import chunks

Points = NDArray[np.float64]


def find_nearest_triangle(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], point: NDArray[np.float64]
) -> tuple[int, float]:
    """Find the triangle nearest to a point.

    The box around a triangle is never farther away than the triangle, and its nearest corner is never nearer.  So only
    triangles whose box is nearer than the nearest of all corners are measured exactly.

    vertices: ndarray, shape (n, 3), float32 or float64. mm.
    triangles: ndarray, shape (m, 3), uint32. At least one, every index below n.
    point: ndarray, shape (3,), float64. mm.

    Returns:
    triangle: Row of `triangles`; of several that are equally near, up to the rounding of the coordinates, the first.
    distance: mm.
    """
    columns = np.ascontiguousarray(vertices.T.astype(np.float64)) - point[:, None]
    corner_distance = np.einsum("ij,ij->j", columns, columns)
    box_distance = np.empty(len(triangles))
    nearest_corner = np.inf
    for where in chunks(len(triangles)):
        a, b, c = triangles[where].T.astype(np.intp)
        one, two, three = (np.take(columns, index, axis=1, mode="clip") for index in (a, b, c))
        low = np.minimum(np.minimum(one, two), three)
        high = np.maximum(np.maximum(one, two), three)
        gap = np.maximum(np.maximum(low, -high), 0.0)
        box_distance[where] = np.einsum("ij,ij->j", gap, gap)
        nearest_corner = min(nearest_corner, *(float(corner_distance[corner].min()) for corner in (a, b, c)))
    slack = 2.0 * rounding_step(vertices)  # a point and a triangle are each rounded
    near = np.flatnonzero(box_distance <= (math.sqrt(nearest_corner) + slack) ** 2)
    distances = _distances_from_origin(*(columns[:, triangles[near, corner]].T for corner in range(3)))
    first = int(np.flatnonzero(distances <= distances.min() + slack)[0])
    return int(near[first]), float(distances[first])


def _distances_from_origin(a: Points, b: Points, c: Points) -> NDArray[np.float64]:
    """Return the distance of the origin from each triangle (a, b, c), corners of shape (k, 3): from its face or an
    edge.
    """
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
