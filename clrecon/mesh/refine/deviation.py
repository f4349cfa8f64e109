"""Deviation: whether a decimated surface and the original are within a bound of each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.distances import NearDistance

__all__ = ["WITNESSES", "Deviation"]

WITNESSES = 7
"""Most faces that are needed to show that a triangle is within the bound: for its corners, its middle and its edges."""

_MOST_STEPS = 12
"""Most parts into which an edge of the present surface is divided for points."""

_MANY = 10_000
"""Least number of points for which threads are faster."""

_MIDDLES = np.array([[1, 1, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]]) / [[3], [2], [2], [2]]
"""Barycentric coordinates of the middle of a triangle and of its edges."""

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]


class Deviation:
    """The original surface, and the bound.

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
        """Mark triangles that have changed, or have a corner that moved farther than the bound.

        In the others no point has moved farther than the corners.

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
        one, two, three = triangles.T
        return np.asarray(changed | has_moved[one] | has_moved[two] | has_moved[three])

    def is_far_from(
        self, rows: IntArray, names: IntArray, places: Float64Array, faces: NDArray[np.uint32]
    ) -> tuple[NDArray[np.bool_], IntArray]:
        """Mark triangles of the original surface that lie farther than the bound from the present surface.

        The distance from one triangle is a convex function: if all corners lie within the bound of one triangle, so
        does every point between them.  Of the other triangles, which lie across an edge, the middle and the middles of
        the edges are measured.  Distances are measured only to the triangles around the names of the corners, the part
        of the surface that came from this triangle.  They are never less than those to the whole surface.

        Parameters
        ----------
        rows : ndarray, shape (k,), int
            Triangles to examine.
        names : ndarray, shape (n,), int
            For each vertex a near vertex of the present surface.
        places : ndarray, shape (n, 3), float64, mm
        faces : ndarray, shape (f, 3), uint32
            The present surface.

        Returns
        -------
        far : ndarray, shape (k,), bool
        witnesses : ndarray, shape (7, k), int
            Rows of `faces` that show that a triangle is within the bound; it is so as long as these faces stay.  -1
            where it is not.
        """
        now = NearDistance(places, faces)
        triangles = self._triangles[rows]
        used = np.zeros(len(names), dtype=bool)
        used[triangles] = True
        number = np.cumsum(used)[triangles] - 1
        used = np.flatnonzero(used)
        length, nearest = now.find_within(self._vertices[used], names[used], self._bound)
        far = np.asarray((length > self._bound)[number].any(axis=1))
        beside = nearest[number]
        witnesses = np.concatenate([beside.T, np.repeat(beside[:, :1].T, WITNESSES - 3, axis=0)])
        # The middle of the triangle and of its edges: first to the faces nearest to the corners, then to all.
        rest = np.flatnonzero(~far)
        rest = rest[~self._are_within(now, self._vertices[triangles[rest]], beside[rest])]
        points = np.einsum("wi,nia->wna", _MIDDLES, self._vertices[triangles[rest]]).reshape(-1, 3)
        point = np.arange(len(points))
        for corner in range(3):
            near = beside[rest[point % len(rest)], corner]
            point = point[now.from_triangles(points[point], near) > self._bound]
        of = rest[point % len(rest)]
        length, row = now.find_around(points[point], names[triangles[of]])
        witnesses[3 + point // len(rest), of] = row
        far[of[length > self._bound]] = True
        witnesses[:, far] = -1
        return far, witnesses

    def _are_within(self, now: NearDistance, corners: Float64Array, nearest: IntArray) -> NDArray[np.bool_]:
        """True where one of the faces nearest to the corners, shape (k, 3), is within the bound of all three."""
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
        """Mark triangles of the present surface that have a tested point farther than the bound.

        Tested are the corners, the middle, and points of a lattice with steps of at most two mean edges of the original
        surface; the middle of each edge is one of them.

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
        a, b, c = faces.T
        used = np.unique(faces)
        is_far = np.zeros(len(places), dtype=bool)
        is_far[used] = self._find_far(places[used])
        far |= is_far[a] | is_far[b] | is_far[c]

        start, end = (corners.reshape(-1) for corners in (faces, faces[:, (1, 2, 0)]))
        key = np.minimum(start, end) * np.int64(len(places)) + np.maximum(start, end)
        key, edge = np.unique(key, return_inverse=True)
        ends = np.stack(np.divmod(key, len(places)), axis=1)
        is_far = self._find_far_within(places[ends], ~is_far[ends].any(axis=1))
        a, b, c = edge.reshape(-1, 3).T
        far |= is_far[a] | is_far[b] | is_far[c]
        return far | self._find_far_within(places[faces], ~far)

    def _find_far_within(self, corners: Float64Array, look_at: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mark edges, shape (n, 2, 3), or triangles, shape (n, 3, 3), that have a point inside that is too far away."""
        sides = corners - np.roll(corners, 1, axis=1)
        longest = np.sqrt(np.einsum("nia,nia->in", sides, sides).max(axis=0))
        steps = np.clip(2 * np.ceil(longest / (4.0 * self._step)), 2, _MOST_STEPS).astype(int)
        far = np.zeros(len(corners), dtype=bool)
        for count in np.unique(steps):
            these = np.flatnonzero((steps == count) & look_at)
            weights = _inner_weights(int(count), corners.shape[1])
            points = np.einsum("wi,nia->nwa", weights, corners[these])
            far[these] = self._find_far(points.reshape(-1, 3)).reshape(points.shape[:2]).any(axis=1)
        return far

    def _find_far(self, points: Float64Array) -> NDArray[np.bool_]:
        near = self._tree.query(points, workers=-1 if len(points) > _MANY else 1)[1]
        far: NDArray[np.bool_] = self._distance(points, near, self._bound) > self._bound
        return far


def _inner_weights(steps: int, corners: int) -> Float64Array:
    """Return barycentric coordinates of a lattice inside an edge (2 corners) or a triangle (3), and of its middle."""
    axes = np.meshgrid(*[np.arange(1, steps)] * (corners - 1), indexing="ij")
    lattice = np.stack([axis.reshape(-1) for axis in axes], axis=1)
    last = steps - lattice.sum(axis=1, keepdims=True)
    lattice = np.concatenate([lattice, last], axis=1)[last[:, 0] > 0]
    middle = np.full((1, corners), 1.0 / corners)
    return np.unique(np.concatenate([lattice / steps, middle]), axis=0)
