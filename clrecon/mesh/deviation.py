"""Is a decimated surface within a bound of the surface as it was, and that within the bound of it?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.distances import NearDistance

__all__ = ["Deviation"]

_MOST_STEPS = 12
"""Parts of an edge of the surface as it is now that are looked at, at most."""

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]


class Deviation:
    """The surface as it was, and the bound.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), float64, mm
    triangles : ndarray, shape (m, 3), uint32
    bound : float
        mm.
    """

    def __init__(self, vertices: Float64Array, triangles: NDArray[np.uint32], bound: float):
        from scipy.spatial import cKDTree

        self._vertices, self._triangles, self._bound = vertices, triangles, bound
        self._tree = cKDTree(vertices, balanced_tree=False, compact_nodes=False)
        self._distance = NearDistance(vertices, triangles)
        edges = vertices[triangles[:, (1, 2, 0)]] - vertices[triangles]
        self._step = float(np.sqrt(np.einsum("nia,nia->ni", edges, edges)).mean())

    def can_be_far(self, rows: IntArray, names: IntArray, places: Float64Array) -> NDArray[np.bool_]:
        """Which of these triangles are no more what they were, or have a corner that has moved further than the bound.

        Of the others no point has moved further than the corners.

        Parameters
        ----------
        rows, names, places : ndarray
            As in `is_far_from`.

        Returns
        -------
        ndarray, shape (k,), bool
        """
        triangles = self._triangles[rows]
        a, b, c = names[triangles].T
        changed = (a == b) | (b == c) | (c == a)
        step = places[names] - self._vertices
        has_moved = np.einsum("na,na->n", step, step) > self._bound * self._bound
        return np.asarray(changed | has_moved[triangles].any(axis=1))

    def is_far_from(
        self, rows: IntArray, names: IntArray, places: Float64Array, faces: NDArray[np.uint32]
    ) -> NDArray[np.bool_]:
        """Which triangles of the surface as it was lie further than the bound from the surface as it is now.

        The distance from one triangle is a convex function: where the corners all lie within the bound of one triangle,
        so does every point between them.  Of the others, which lie across an edge, the middle and the middles of the
        edges are looked at.  Distances are from the triangles around the names of the corners alone, which is the part
        of the surface that has come from this triangle: never less than from the surface.

        Parameters
        ----------
        rows : ndarray, shape (k,), int
            Triangles to look at.
        names : ndarray, shape (n,), int
            For each vertex one of the surface as it is now that is near.
        places : ndarray, shape (n, 3), float64, mm
        faces : ndarray, shape (f, 3), uint32
            The surface as it is now.

        Returns
        -------
        ndarray, shape (k,), bool
        """
        now = NearDistance(places, faces)
        triangles = self._triangles[rows]
        used, number = np.unique(triangles, return_inverse=True)
        number = number.reshape(triangles.shape)
        length, nearest = now.find_around(self._vertices[used], names[used][:, None])
        far = np.asarray((length > self._bound)[number].any(axis=1))
        # The middle of the triangle and of its edges, from the faces that are nearest to the corners, then from all.
        rest = np.flatnonzero(~far)
        rest = rest[~self._are_within(now, self._vertices[triangles[rest]], nearest[number[rest]])]
        corners = self._vertices[triangles[rest]]
        points = np.einsum("wi,nia->nwa", _weights(2), corners).reshape(-1, 3)
        of, beside = (np.repeat(values, 4, axis=0) for values in (rest, nearest[number[rest]]))
        for corner in range(3):
            beyond = now.from_triangles(points, beside[:, corner]) > self._bound
            of, points, beside = of[beyond], points[beyond], beside[beyond]
        beyond = now.find_around(points, names[triangles[of]])[0] > self._bound
        far[of[beyond]] = True
        return far

    def _are_within(self, now: NearDistance, corners: Float64Array, nearest: IntArray) -> NDArray[np.bool_]:
        """Whether one of the faces that are nearest to the corners, shape (k, 3), is within the bound of all three."""
        within = (nearest[:, 0] == nearest[:, 1]) & (nearest[:, 1] == nearest[:, 2])
        for one, others in ((0, (1, 2)), (1, (2, 0)), (2, (0, 1))):
            rest = np.flatnonzero(~within)
            for other in others:
                apart = nearest[rest, one] != nearest[rest, other]
                beyond = np.zeros(len(rest), dtype=bool)
                beyond[apart] = now.from_triangles(corners[rest[apart], other], nearest[rest[apart], one]) > self._bound
                rest = rest[~beyond]
            within[rest] = True
        return within

    def are_far(self, places: Float64Array, faces: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Which triangles of the surface as it is now have a point that was looked at further than the bound.

        Looked at are the corners, the middle, and points of a lattice no further apart than two mean edges of the
        surface as it was; the middle of each edge is one of them.

        Parameters
        ----------
        places : ndarray, shape (n, 3), float64, mm
        faces : ndarray, shape (f, 3), uint32

        Returns
        -------
        ndarray, shape (f,), bool
        """
        far = np.zeros(len(faces), dtype=bool)
        if len(faces) == 0:
            return far
        used = np.unique(faces)
        is_far = np.zeros(len(places), dtype=bool)
        is_far[used] = self._find_far(places[used])
        far |= is_far[faces].any(axis=1)
        edges = places[faces[:, (1, 2, 0)]] - places[faces]
        longest = np.sqrt(np.einsum("nia,nia->ni", edges, edges)).max(axis=1)
        steps = np.clip(2 * np.ceil(longest / (4.0 * self._step)), 2, _MOST_STEPS).astype(int)
        for count in np.unique(steps):
            these = np.flatnonzero((steps == count) & ~far)
            weights = _weights(int(count))
            points = np.einsum("wi,nia->nwa", weights, places[faces[these]])
            found = self._find_far(points.reshape(-1, 3))
            far[these] = found.reshape(points.shape[:2]).any(axis=1)
        return far

    def _find_far(self, points: Float64Array) -> NDArray[np.bool_]:
        near = self._tree.query(points, workers=-1)[1]
        far: NDArray[np.bool_] = self._distance(points, near, self._bound) > self._bound
        return far


def _weights(steps: int) -> Float64Array:
    """Barycentric coordinates of the middle of a triangle and of a lattice without its corners, shape (w, 3)."""
    i, j = (axis.reshape(-1) for axis in np.meshgrid(np.arange(steps), np.arange(steps), indexing="ij"))
    inside = i + j <= steps
    k = steps - i - j
    inside &= k < steps
    lattice = np.column_stack([i, j, k])[inside] / steps
    return np.concatenate([np.full((1, 3), 1.0 / 3.0), lattice])
