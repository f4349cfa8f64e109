"""Upper bounds of distances from points to triangles, in float32: several times as fast as the distances themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.triangles import cross_product

_ROUNDINGS = 16.0
"""Units of the last place of the largest coordinate by which a bound may be too small; each of 16 steps rounds by half
a unit of a number that is no larger."""


def rounding_of_bounds(largest: float) -> float:
    """Return by how many mm a distance in float32 may be too short, from the largest coordinate in mm."""
    return _ROUNDINGS * float(np.spacing(np.float32(largest)))


class FaceFrames:
    """A frame in each triangle: a corner, two edges, and what gives the coordinates along them.

    vertices: ndarray, shape (n, 3), mm, near zero
    triangles: ndarray, shape (m, 3), uint32
    """

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.uint32]):
        columns = np.ascontiguousarray(vertices.T, dtype=np.float64)
        corner, one, two = (columns.take(index, axis=1) for index in triangles.T.astype(np.intp))
        one -= corner
        two -= corner
        cross = cross_product(one, two)
        square = np.einsum("ij,ij->j", cross, cross)
        inverse = np.divide(1.0, square, out=np.zeros_like(square), where=square > 0.0)
        along = (cross_product(two, cross) * inverse, cross_product(cross, one) * inverse)
        # One row a triangle, 16 numbers: they lie side by side, and a look-up costs one access to memory.
        self._rows = np.zeros((len(triangles), 16), dtype=np.float32)
        for place, part in enumerate((corner, *along, one, two)):
            self._rows[:, 3 * place : 3 * place + 3] = part.T
        self.slack = rounding_of_bounds(float(np.abs(columns).max(initial=0.0)))

    def squares(self, points: NDArray[np.float32], rows: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return squares of distances from points to a point of the triangle, the nearest one or one near it.

        The square root is an upper bound of the distance, but for `slack` mm by rounding.

        points: ndarray, shape (3, k), float32, mm
        rows: ndarray, shape (k,), int. Triangle of each point.

        Returns: ndarray, shape (k,), float32, mm2
        """
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
        found: NDArray[np.float32] = away[0] + away[1]
        found += away[2]
        return found
