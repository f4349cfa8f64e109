"""Deviation: whether a decimated surface and the original are within a bound of each other."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.distances import SurfaceDistance
from clrecon.mesh.compare.near_distances import NearDistance
from clrecon.mesh.connectivity import find_edges
from clrecon.mesh.refine.faults import any_corner
from clrecon.system.pieces import in_threads

__all__ = ["WITNESSES", "Deviation"]

WITNESSES = 7
"""Most faces that are needed to show that a triangle is within the bound: for its corners, its middle and its edges."""

_MOST_STEPS = 12
"""Most parts into which an edge of the present surface is divided for points."""

_PIECE = 1 << 13
"""Triangles or points in a piece: what belongs to it stays in the processor's cache."""

_NEAREST = 6
"""Most vertices near a point around which the original surface is looked for by upper bounds."""

_WALKS = 2
"""Steps from triangle to triangle towards a point before the nearest vertex is looked for in the tree."""

_MIDDLES = np.array([[1, 1, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]]) / [[3], [2], [2], [2]]
"""Barycentric coordinates of the middle of a triangle and of its edges."""

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]
Corners = list[NDArray[np.float32]]
"""First, second and third corners of triangles, each shape (3, k): one row each for x, y, z."""


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
        # scipy builds the tree without Python's lock: this goes on while the first edges are collapsed.
        pool = ThreadPoolExecutor(1)
        self._tree = pool.submit(cKDTree, vertices, balanced_tree=False, compact_nodes=False)
        pool.shutdown(wait=False)
        self._columns = np.ascontiguousarray(vertices.T, dtype=np.float32)
        self._distance = NearDistance(vertices, triangles)
        self._exact: SurfaceDistance | None = None
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
        used = np.zeros(len(names), dtype=bool)
        used[triangles] = True
        used = np.flatnonzero(used)
        step = places[names[used]] - self._vertices[used]
        has_moved = np.zeros(len(names), dtype=bool)
        has_moved[used] = np.einsum("na,na->n", step, step) > self._bound * self._bound
        return changed | any_corner(has_moved, triangles)

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
        triangles = self._triangles[rows]
        around, now = _surface_around(np.unique(names[triangles]), places, faces)
        used = np.zeros(len(names), dtype=bool)
        used[triangles] = True
        used = np.flatnonzero(used)
        length, nearest = now.find_surely_within(self._vertices[used], names[used], self._bound)
        is_far, beside = np.zeros(len(names), dtype=bool), np.zeros(len(names), dtype=np.int32)
        is_far[used], beside[used] = length > self._bound, nearest
        far = any_corner(is_far, triangles)
        witnesses = np.empty((WITNESSES, len(rows)), dtype=np.int32)
        witnesses[:3] = beside[triangles].T
        witnesses[3:] = witnesses[0]
        left: list[tuple[IntArray, IntArray]] = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))]

        def work(where: slice) -> None:
            near = witnesses[:3, where]
            corners = [self._columns.take(corner, axis=1, mode="clip") for corner in triangles[where].T]
            rest = np.flatnonzero(~far[where])
            rest = rest[~self._are_within(now, [corner[:, rest] for corner in corners], near[:, rest])]
            point = self._leave_middles(now, corners, near, rest, names[triangles[where]], witnesses[:, where])
            left.append((point // len(_MIDDLES) + where.start, point % len(_MIDDLES)))

        in_threads(work, len(rows), _PIECE)
        # What upper bounds do not decide is measured.
        of, middle = (np.concatenate(parts) for parts in zip(*left, strict=True))
        if len(of):
            points = np.einsum("ki,kia->ka", _MIDDLES[middle], self._vertices[triangles[of]])
            length, row = now.find_around(points, names[triangles[of]])
            witnesses[3 + middle, of] = row
            far[of[length > self._bound]] = True
        found = around[witnesses]
        found[:, far] = -1
        return far, found

    def are_left_behind(
        self, vertices: IntArray, names: IntArray, places: Float64Array, faces: NDArray[np.uint32]
    ) -> NDArray[np.bool_]:
        """Mark vertices of the original surface for which no upper bound shows that they lie within the bound.

        Parameters
        ----------
        vertices : ndarray, shape (k,), int
            Vertices to examine.
        names, places, faces : ndarray
            As in `is_far_from`.

        Returns
        -------
        ndarray, shape (k,), bool
        """
        _, now = _surface_around(np.unique(names[vertices]), places, faces)
        length, _ = now.find_surely_within(self._vertices[vertices], names[vertices], self._bound)
        return np.asarray(length > self._bound)

    def _leave_middles(
        self, now: NearDistance, corners: Corners, near: IntArray, rest: IntArray, names: IntArray, witnesses: IntArray
    ) -> IntArray:
        """Find the middles of triangles and edges that upper bounds do not show to be within the bound.

        Middles are compared with the faces nearest to the corners first, then with all around the names.

        Parameters
        ----------
        now : NearDistance
            The present surface.
        corners, near, names
            Of a piece of triangles: places in columns, faces nearest to them, shape (3, k), names, shape (k, 3).
        rest : ndarray, shape (r,), int
            Triangles of this piece that are looked at.
        witnesses : ndarray, shape (7, k), int
            Changed in place where a face around a name shows it.

        Returns
        -------
        ndarray, shape (l,), int
            ``4 * triangle + middle``.
        """
        one, two, three = (corner[:, rest] for corner in corners)
        half = np.float32(0.5)
        points = np.concatenate(
            [(one + two + three) * np.float32(1 / 3), (one + two) * half, (two + three) * half, (three + one) * half], 1
        )
        point = np.arange(len(_MIDDLES) * len(rest))
        most = max(self._bound - now.frames.slack, 0.0) ** 2
        for corner in range(3):
            beside = near[corner, rest[point % max(len(rest), 1)]]
            point = point[~(now.frames.squares(points[:, point], beside) < most)]
        for corner in range(3):
            of = rest[point % max(len(rest), 1)]
            length, row = now.upper_bounds(points[:, point], names[of, corner])
            within = length <= self._bound
            witnesses[3 + point[within] // len(rest), of[within]] = row[within]
            point = point[~within]
        return rest[point % max(len(rest), 1)] * len(_MIDDLES) + point // max(len(rest), 1)

    def _are_within(self, now: NearDistance, corners: Corners, near: IntArray) -> NDArray[np.bool_]:
        """True where one of the faces nearest to the corners, shape (3, k), is surely within the bound of all three."""
        most = max(self._bound - now.frames.slack, 0.0) ** 2
        within = (near[0] == near[1]) & (near[1] == near[2])
        for one, others in ((0, (1, 2)), (1, (2, 0)), (2, (0, 1))):
            rest = np.flatnonzero(~within)
            for other in others:
                apart = near[other, rest] != near[one, rest]
                some = rest[apart]
                beyond = np.zeros(len(rest), dtype=bool)
                beyond[apart] = ~(now.frames.squares(corners[other][:, some], near[one, some]) < most)
                rest = rest[~beyond]
            within[rest] = True
        return within

    def are_far(self, places: Float64Array, faces: NDArray[np.uint32], rows: IntArray) -> NDArray[np.bool_]:
        """Mark triangles of the present surface that have a tested point farther than the bound.

        Tested are the corners, the middle, and points of a lattice with steps of at most two mean edges of the original
        surface; the middle of each edge is one of them.

        Parameters
        ----------
        places : ndarray, shape (n, 3), float64, mm
        faces : ndarray, shape (f, 3), uint32
            Their corners are numbers of vertices of the original surface too.
        rows : ndarray, shape (f,), int
            The triangle of the original surface that each face came from: its corners are near the face.

        Returns
        -------
        ndarray, shape (f,), bool
        """
        far = np.zeros(len(faces), dtype=bool)
        if len(faces) == 0:
            return far
        is_far = np.zeros(len(places), dtype=bool)
        is_far[faces] = True
        used = np.flatnonzero(is_far)
        is_far[used] = self._find_far(places[used], used[:, None])
        far |= any_corner(is_far, faces)

        edges = find_edges(faces, len(places))
        source = self._triangles[rows]
        half_edge = edges.half_edges[edges.first]
        near = np.stack([source.reshape(-1)[half_edge], source[:, (1, 2, 0)].reshape(-1)[half_edge]], axis=1)
        is_far_edge = self._find_far_within(
            places, edges.ends.T, near, ~(is_far[edges.ends[0]] | is_far[edges.ends[1]])
        )
        half_far = np.zeros(3 * len(faces), dtype=bool)
        half_far[edges.half_edges] = np.repeat(is_far_edge, edges.uses)
        far |= half_far.reshape(-1, 3).any(axis=1)
        return far | self._find_far_within(places, faces, source, ~far)

    def _find_far_within(
        self, places: Float64Array, corners: NDArray[np.uint32], near: IntArray, look_at: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Mark edges, shape (n, 2), or triangles, shape (n, 3), that have a point inside that is too far away; `near`,
        of the same shape, are vertices of the original surface near them.
        """
        columns = [places.take(corner, axis=0) for corner in corners.T]
        longest = np.zeros(len(corners))
        for one, other in zip(columns, columns[1:] + columns[:1], strict=True):
            side = one - other
            np.maximum(longest, np.einsum("na,na->n", side, side), out=longest)
        steps = np.clip(2 * np.ceil(np.sqrt(longest) / (4.0 * self._step)), 2, _MOST_STEPS).astype(int)
        far = np.zeros(len(corners), dtype=bool)
        for count in np.unique(steps):
            these = np.flatnonzero((steps == count) & look_at)
            weights = _inner_weights(int(count), corners.shape[1])
            flat = np.stack([column[these].reshape(-1) for column in columns])
            points = (weights @ flat).reshape(-1, 3)
            hints = np.tile(near[these], (len(weights), 1))
            far[these] = self._find_far(points, hints).reshape(len(weights), len(these)).any(axis=0)
        return far

    def _nearest_corner(self, columns: NDArray[np.float32], rows: IntArray) -> IntArray:
        """Return the nearest corner of a triangle of the original surface for each point, shape (3, k)."""
        corners = self._triangles[rows]
        squares = np.empty((len(rows), 3), dtype=np.float32)
        for number, corner in enumerate(corners.T):
            away = columns - self._columns.take(corner, axis=1)
            squares[:, number] = np.einsum("ak,ak->k", away, away)
        return np.asarray(corners[np.arange(len(rows)), squares.argmin(axis=1)].astype(np.int64))

    def _find_far(self, points: Float64Array, hints: IntArray) -> NDArray[np.bool_]:
        """Mark points that are farther than the bound from the original surface.

        Around vertices that may be near them, shape (k, v), it is looked for first, then around the nearest corner of
        the nearest triangle there, and around the nearest vertices; what upper bounds do not decide is measured.
        """
        is_left, tree = np.zeros(len(points), dtype=bool), self._tree.result()
        self._distance.prepare()

        def work(where: slice) -> None:
            columns = points[where].T.astype(np.float32)
            rest = np.arange(columns.shape[1])
            for near in hints[where].T:
                length, row = self._distance.upper_bounds(columns[:, rest], near[rest])
                rest, row = rest[~(length <= self._bound)], row[~(length <= self._bound)]
            for _ in range(_WALKS):
                length, row = self._distance.upper_bounds(columns[:, rest], self._nearest_corner(columns[:, rest], row))
                rest, row = rest[~(length <= self._bound)], row[~(length <= self._bound)]
            near = tree.query(points[where][rest])[1]
            rest = rest[~(self._distance.upper_bounds(columns[:, rest], near)[0] <= self._bound)]
            for turn in range(1, _NEAREST if len(rest) else 0):
                if turn == 1:
                    several = tree.query(points[where][rest], k=_NEAREST)[1]
                near = np.minimum(several[:, turn], len(self._vertices) - 1)  # as many as there are
                within = self._distance.upper_bounds(columns[:, rest], near)[0] <= self._bound
                rest, several = rest[~within], several[~within]
            is_left[where.start + rest] = True

        in_threads(work, len(points), _PIECE)
        left = np.flatnonzero(is_left)
        if len(left):
            self._exact = self._exact or SurfaceDistance(self._vertices, self._triangles)
            is_left[left] = self._exact(points[left]) > self._bound
        return is_left


def _surface_around(names: IntArray, places: Float64Array, faces: NDArray[np.uint32]) -> tuple[IntArray, NearDistance]:
    """Return the rows of the faces around these vertices, int32, and distances to these faces."""
    is_near = np.zeros(len(places), dtype=bool)
    is_near[names] = True
    rows = np.flatnonzero(any_corner(is_near, faces)).astype(np.int32)
    return rows, NearDistance(places, faces[rows])


def _inner_weights(steps: int, corners: int) -> Float64Array:
    """Return barycentric coordinates of a lattice inside an edge (2 corners) or a triangle (3), and of its middle."""
    axes = np.meshgrid(*[np.arange(1, steps)] * (corners - 1), indexing="ij")
    lattice = np.stack([axis.reshape(-1) for axis in axes], axis=1)
    last = steps - lattice.sum(axis=1, keepdims=True)
    lattice = np.concatenate([lattice, last], axis=1)[last[:, 0] > 0]
    middle = np.full((1, corners), 1.0 / corners)
    return np.unique(np.concatenate([lattice / steps, middle]), axis=0)
