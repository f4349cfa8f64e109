"""Deviation: whether a decimated surface and the original lie within the error bound of each other."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.distances import NearDistance, SurfaceDistance
from clrecon.mesh.connectivity import Fans, find_edges, find_used
from clrecon.mesh.refine.topology import any_corner
from clrecon.mesh.triangles import corner_edges
from clrecon.system.pieces import chunks, in_threads

WITNESSES = 7
"""Most faces that are needed to show that a triangle is within the bound: for its corners, its middle and its edges."""

MIDDLES = np.array([[1, 1, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]]) / [[3], [2], [2], [2]]
"""Barycentric coordinates of the middle of a triangle and of its edges."""

_PIECE = 1 << 13
"""Triangles or points in a piece: what belongs to it stays in the processor's cache."""

Float64Array = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.integer]
Corners = list[Float32Array]
"""First, second and third corners of triangles, each shape (3, k): one row each for x, y, z."""


class SurfaceBounds(NearDistance):
    """A surface to which distances are bounded, by numpy, mm near zero; on a device
    `clrecon.operators.surface.decimation.DeviceBounds` does the same.
    """

    def find_bounds(
        self, points: Float64Array, near: IntArray, limit: float, walks: int = 0
    ) -> tuple[Float32Array, IntArray]:
        """Return upper bounds of the distances from points to the surface, and the triangles that they are taken from.

        The triangles around each of the vertices near a point, shape (k, v), are measured, and then, `walks` times,
        those around the nearest corner of the nearest triangle.  Nothing nearer than `limit` mm is looked for.  Where
        no triangle was measured the bound is infinite and the row -1.
        """
        bounds: tuple[Float32Array, IntArray] = (np.full(len(points), np.inf, np.float32), np.full(len(points), -1))
        self.prepare()

        def bound_piece(piece: slice) -> None:
            length, rows = bounds[0][piece], bounds[1][piece]
            columns = points[piece].T.astype(np.float32)
            rest = np.arange(columns.shape[1])
            for turn in range(near.shape[1] + walks):
                here = columns[:, rest]
                if turn < near.shape[1]:
                    vertex = near[piece][rest, turn]
                else:
                    vertex = self._nearest_corner(here, rows[rest])
                bound, row = self.upper_bounds(here, vertex)
                shorter = bound < length[rest]
                length[rest[shorter]], rows[rest[shorter]] = bound[shorter], row[shorter]
                rest = rest[~(length[rest] <= limit)]
                if turn >= near.shape[1] - 1:  # no triangle leads further
                    rest = rest[rows[rest] >= 0]

        in_threads(bound_piece, len(points), _PIECE)
        return bounds

    def find_witnesses(
        self, places: Float32Array, triangles: IntArray, names: IntArray, beside: IntArray, limit: float
    ) -> tuple[IntArray, NDArray[np.uint8]]:
        """Find triangles of this surface that show that those of another lie within a limit in mm.

        If one triangle is within the limit of all corners, it is so of every point between them.  If not, the middles
        of the triangle and of its edges are compared with the triangles nearest to the corners, then with all around
        the names.

        names, beside: For each vertex of the other surface one of this near it, and a triangle within the limit, or -1.
        Returns: Of each triangle witnesses for the corners, the middle and the middles of the edges, shape (7, k), -1
            for corners without one; and bits that say that nothing shows a middle of `MIDDLES` to be within the limit.
            Triangles that have a corner without witness are not examined.
        """
        witnesses: NDArray[np.int32] = np.empty((WITNESSES, len(triangles)), dtype=np.int32)
        witnesses[:3] = beside[triangles].T
        witnesses[3:] = witnesses[0]
        left = np.zeros(len(triangles), dtype=np.uint8)
        columns = np.ascontiguousarray(places.T)
        far = any_corner(beside < 0, triangles)
        self.prepare()

        def judge_piece(piece: slice) -> None:
            near = witnesses[:3, piece]
            corners = [columns.take(corner, axis=1, mode="clip") for corner in triangles[piece].T]
            rest = np.flatnonzero(~far[piece])
            rest = rest[~self._are_within([corner[:, rest] for corner in corners], near[:, rest], limit)]
            self._leave_middles(corners, rest, names[triangles[piece]], limit, witnesses[:, piece], left[piece])

        in_threads(judge_piece, len(triangles), _PIECE)
        return witnesses, left

    def _most(self, limit: float) -> float:
        """Return the square below which a square is surely within the limit."""
        return max(limit - self.slack, 0.0) ** 2

    def _are_within(self, corners: Corners, near: IntArray, limit: float) -> NDArray[np.bool_]:
        """True where one of the faces nearest to the corners, shape (3, k), is surely within the limit of all three."""
        most = self._most(limit)
        within = (near[0] == near[1]) & (near[1] == near[2])
        for corner, others in ((0, (1, 2)), (1, (2, 0)), (2, (0, 1))):
            rest = np.flatnonzero(~within)
            for neighbour in others:
                apart = near[neighbour, rest] != near[corner, rest]
                some = rest[apart]
                beyond = np.zeros(len(rest), dtype=bool)
                beyond[apart] = ~(self.frames.squares(corners[neighbour][:, some], near[corner, some]) < most)
                rest = rest[~beyond]
            within[rest] = True
        return within

    def _leave_middles(
        self,
        corners: Corners,
        rest: IntArray,
        names: IntArray,
        limit: float,
        witnesses: IntArray,
        left: NDArray[np.uint8],
    ) -> None:
        """Look at middles, see `find_witnesses`, of the triangles `rest`; `witnesses` and `left` change in place."""
        a, b, c = (corner[:, rest] for corner in corners)
        half = np.float32(0.5)
        points = np.concatenate([(a + b + c) * np.float32(1 / 3), (a + b) * half, (b + c) * half, (c + a) * half], 1)
        point = np.arange(len(MIDDLES) * len(rest))
        most = self._most(limit)
        for corner in range(3):
            beside = witnesses[corner, rest[point % max(len(rest), 1)]]
            point = point[~(self.frames.squares(points[:, point], beside) < most)]
        for corner in range(3):
            of = rest[point % max(len(rest), 1)]
            length, row = self.upper_bounds(points[:, point], names[of, corner])
            within = length <= limit
            witnesses[3 + point[within] // len(rest), of[within]] = row[within]
            point = point[~within]
        np.bitwise_or.at(left, rest[point % max(len(rest), 1)], (1 << point // max(len(rest), 1)).astype(np.uint8))

    def _nearest_corner(self, columns: Float32Array, rows: IntArray) -> IntArray:
        """Return the nearest corner of a triangle of the surface for each point, shape (3, k)."""
        corners = self._triangles[rows]
        squares = np.empty((len(rows), 3), dtype=np.float32)
        for number, corner in enumerate(corners.T):
            away = columns - self._columns.take(corner, axis=1)
            squares[:, number] = np.einsum("ak,ak->k", away, away)
        return np.asarray(corners[np.arange(len(rows)), squares.argmin(axis=1)].astype(np.int64))


_MOST_STEPS = 12
"""Most parts into which an edge of the present surface is divided for points."""

_POINTS = 1 << 18
"""Points that are made and measured together: many would take more memory than both surfaces."""

_NEAREST = 6
"""Most vertices near a point around which the original surface is looked for by upper bounds."""

_WALKS = 2
"""Steps from triangle to triangle towards a point before the nearest vertex is looked for in the tree."""

MakeBounds = Callable[..., SurfaceBounds]
"""Makes what bounds distances to a surface, from the arguments of `SurfaceBounds`."""


class Deviation:
    """The original surface, and the bound in mm."""

    def __init__(
        self,
        vertices: Float64Array,
        triangles: NDArray[np.uint32],
        bound: float,
        make_bounds: MakeBounds = SurfaceBounds,
        fans: Fans | None = None,
    ):
        from scipy.spatial import cKDTree

        self._vertices, self._triangles = vertices, triangles
        self._bound, self._make = bound, make_bounds
        # scipy builds the tree without Python's lock: this goes on while the first edges are collapsed.
        pool = ThreadPoolExecutor(1)
        self._tree = pool.submit(cKDTree, vertices, balanced_tree=False, compact_nodes=False)
        pool.shutdown(wait=False)
        self._places = vertices.astype(np.float32)
        self._distance = make_bounds(vertices, triangles, fans)
        self._exact: SurfaceDistance | None = None
        total = 0.0
        for _, _, p, q in corner_edges(vertices, triangles, np.zeros(3)):
            total += sum(float(np.sqrt(np.einsum("an,an->n", edge, edge)).sum()) for edge in (p, q, q - p))
        self._step = total / max(triangles.size, 1)

    def can_be_far(self, rows: IntArray, names: IntArray, places: Float64Array) -> NDArray[np.bool_]:
        """Mark triangles that have changed, or a corner that moved farther than the bound: no others can be far."""
        triangles = self._triangles[rows]
        a, b, c = names[triangles].T
        changed = (a == b) | (b == c) | (c == a)
        used = find_used(triangles, len(names))
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

        names: For each vertex a near vertex of the present surface.
        faces: The present surface, at least all faces around the names of the corners.
        Returns witnesses too: shape (7, k), rows of `faces` that show that a triangle is within the bound; it is so as
            long as these faces stay.  -1 where it is not.
        """
        triangles = self._triangles[rows]
        used = find_used(triangles, len(names))
        now = self._make(places, faces)
        length, nearest = now.find_surely_within(self._vertices[used], names[used], self._bound)
        beside = np.full(len(names), -1, dtype=np.int32)
        beside[used] = np.where(length > self._bound, -1, nearest)
        far = any_corner(beside < 0, triangles)
        witnesses, left = now.find_witnesses(self._places, triangles, names, beside, self._bound)
        # What upper bounds do not decide is measured.
        some = np.flatnonzero(left)
        middle, of = np.nonzero(left[some] >> np.arange(len(MIDDLES), dtype=np.uint8)[:, None] & 1)
        of = some[of]
        if len(of):
            points = np.einsum("ki,kia->ka", MIDDLES[middle], self._vertices[triangles[of]])
            length, row = now.find_around(points, names[triangles[of]])
            witnesses[3 + middle, of] = row
            far[of[length > self._bound]] = True
        witnesses[:, far] = -1
        return far, witnesses

    def are_left_behind(
        self, vertices: IntArray, names: IntArray, places: Float64Array, faces: NDArray[np.uint32]
    ) -> NDArray[np.bool_]:
        """Mark vertices of the original surface for which no upper bound shows that they lie within the bound."""
        length, _ = self._make(places, faces).find_surely_within(self._vertices[vertices], names[vertices], self._bound)
        return np.asarray(length > self._bound)

    def are_far(self, places: Float64Array, faces: NDArray[np.uint32], rows: IntArray) -> NDArray[np.bool_]:
        """Mark triangles of the present surface that have a tested point farther than the bound.

        Tested are the corners, the middle, and points of a lattice with steps of at most two mean edges of the original
        surface; the middle of each edge is one of them.

        rows: The triangle of the original surface that each face came from: its corners are near the face.
        """
        far = np.zeros(len(faces), dtype=bool)
        if len(faces) == 0:
            return far
        is_far, used = np.zeros(len(places), dtype=bool), find_used(faces, len(places))
        is_far[used[self._find_far(places[used], used[:, None])]] = True
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
        """Mark edges (n, 2) or triangles (n, 3) with a point inside too far from the original near vertices `near`."""
        steps: NDArray[np.int8] = np.empty(len(corners), dtype=np.int8)
        for piece in chunks(len(corners)):
            sides = places[corners[piece]]
            sides -= np.roll(sides, 1, axis=1)
            longest = np.sqrt(np.einsum("nca,nca->nc", sides, sides).max(axis=1))
            steps[piece] = np.clip(2 * np.ceil(longest / (4.0 * self._step)), 2, _MOST_STEPS)
        far = np.zeros(len(corners), dtype=bool)
        for count in np.unique(steps[look_at]):
            rows = np.flatnonzero((steps == count) & look_at)
            weights = _inner_weights(int(count), corners.shape[1])
            for piece in chunks(len(rows), max(_POINTS // len(weights), 1)):
                these = rows[piece]
                ends = places[corners[these].T].reshape(corners.shape[1], -1)
                points = (weights @ ends).reshape(-1, 3)
                hints = np.tile(near[these], (len(weights), 1))
                far[these[self._find_far(points, hints) % len(these)]] = True
        return far

    def _find_far(self, points: Float64Array, hints: IntArray) -> IntArray:
        """Return the rows of points that are farther than the bound from the original surface.

        Around vertices that may be near them, shape (k, v), it is looked for first, then around the nearest corner of
        the nearest triangle there, and around the nearest vertices; what upper bounds do not decide is measured.
        """
        left = self._not_within(np.arange(len(points)), points, hints, _WALKS)
        for several in (1, _NEAREST):
            if len(left):
                near = self._tree.result().query(points[left], k=np.arange(1, several + 1), workers=-1)[1]
                near = np.minimum(near, len(self._vertices) - 1)  # as many as there are
                left = self._not_within(left, points[left], near)
        if len(left):
            self._exact = self._exact or SurfaceDistance(self._vertices, self._triangles)
            left = left[self._exact(points[left]) > self._bound]
        return left

    def _not_within(self, rows: IntArray, points: Float64Array, near: IntArray, walks: int = 0) -> IntArray:
        """Return those of some rows whose points no upper bound shows to lie within the bound."""
        length, _ = self._distance.find_bounds(points, near, self._bound, walks)
        return rows[~(length <= self._bound)]


def _inner_weights(steps: int, corners: int) -> Float64Array:
    """Return barycentric coordinates of a lattice inside an edge (2 corners) or a triangle (3), and of its middle."""
    axes = np.meshgrid(*[np.arange(1, steps)] * (corners - 1), indexing="ij")
    lattice = np.stack([axis.reshape(-1) for axis in axes], axis=1)
    last = steps - lattice.sum(axis=1, keepdims=True)
    lattice = np.concatenate([lattice, last], axis=1)[last[:, 0] > 0]
    middle = np.full((1, corners), 1.0 / corners)
    return np.unique(np.concatenate([lattice / steps, middle]), axis=0)
