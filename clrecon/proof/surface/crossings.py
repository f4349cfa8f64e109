"""Twin of `clrecon.operators.surface.decimation.find_crossings`: all pairs of triangles, edge by edge, in float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array


def mark_crossings(vertices: NDArray[np.floating], triangles: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Mark triangles that cut another one by an edge through its inside; none lies in the plane of another."""
    corners = vertices.astype(np.float64)[triangles]
    marked = np.zeros(len(triangles), bool)
    for number, triangle in enumerate(corners):
        others = corners[number + 1 :]
        same = triangles[number + 1 :, :, None] == triangles[number]
        alone = np.broadcast_to(triangle, others.shape)
        cut = _edges_pass(others, alone, same.any(axis=2)) | _edges_pass(alone, others, same.any(axis=1))
        marked[number + 1 :] |= cut
        marked[number] |= cut.any()
    return marked


def _edges_pass(left: Float64Array, right: Float64Array, common: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True where an edge of a triangle (k, 3, 3) without a common corner passes through the inside of the other one."""
    a, b, c = right.swapaxes(0, 1)
    sides = [_volume(a, b, c, left[:, corner]) for corner in range(3)]
    is_passed = np.zeros(len(left), bool)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        p, q = left[:, first], left[:, second]
        turns = np.sign([_volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)])
        passes = (sides[first] * sides[second] < 0.0) & (np.abs(turns.sum(axis=0)) == 3.0)
        is_passed |= passes & ~(common[:, first] | common[:, second])
    return is_passed


def _volume(a: Float64Array, b: Float64Array, c: Float64Array, d: Float64Array) -> Float64Array:
    """Return six times the signed volume of tetrahedra."""
    return np.asarray(np.linalg.det(np.stack([b - a, c - a, d - a], axis=1)))
