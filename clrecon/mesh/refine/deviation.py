"""Deviation: whether a decimated surface and the original are within a bound of each other."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.distances import SurfaceDistance
from clrecon.mesh.connectivity import Fans, find_edges
from clrecon.mesh.refine.bounds import MIDDLES, SurfaceBounds
from clrecon.mesh.refine.faults import any_corner
from clrecon.mesh.triangles import corner_edges

_MOST_STEPS = 12
"""Most parts into which an edge of the present surface is divided for points."""

_NEAREST = 6
"""Most vertices near a point around which the original surface is looked for by upper bounds."""

_WALKS = 2
"""Steps from triangle to triangle towards a point before the nearest vertex is looked for in the tree."""

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]
MakeBounds = Callable[..., SurfaceBounds]
"""Makes what bounds distances to a surface, from the arguments of `SurfaceBounds`."""


class Deviation:
    """The original surface, and the bound.

    vertices: ndarray, shape (n, 3), float64, mm
    triangles: ndarray, shape (m, 3), uint32
    bound: mm.
    make_bounds: `SurfaceBounds`, or what does the same elsewhere.
    fans: Fans of the triangles if they are known.
    """

    def __init__(
        self,
        vertices: Float64Array,
        triangles: NDArray[np.uint32],
        bound: float,
        make_bounds: MakeBounds = SurfaceBounds,
        fans: Fans | None = None,
    ):
        from scipy.spatial import cKDTree

        self._vertices, self._triangles, self._bound, self._make = vertices, triangles, bound, make_bounds
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
        """Mark triangles that have changed, or have a corner that moved farther than the bound.

        In the others no point has moved farther than the corners.

        rows, names, places: As in `is_far_from`.

        Returns: ndarray, shape (k,), bool
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

        rows: ndarray, shape (k,), int. Triangles to examine.
        names: ndarray, shape (n,), int. For each vertex a near vertex of the present surface.
        places: ndarray, shape (n, 3), float64, mm
        faces: ndarray, shape (f, 3), uint32. The present surface, at least all faces around the names of the corners.

        Returns:
        far: ndarray, shape (k,), bool
        witnesses: ndarray, shape (7, k), int. Rows of `faces` that show that a triangle is within the bound; it is so
            as long as these faces stay.  -1 where it is not.
        """
        triangles = self._triangles[rows]
        used = np.zeros(len(names), dtype=bool)
        used[triangles] = True
        used = np.flatnonzero(used)
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
        """Mark vertices of the original surface for which no upper bound shows that they lie within the bound.

        vertices: ndarray, shape (k,), int. Vertices to examine.
        names, places, faces: As in `is_far_from`.

        Returns: ndarray, shape (k,), bool
        """
        length, _ = self._make(places, faces).find_surely_within(self._vertices[vertices], names[vertices], self._bound)
        return np.asarray(length > self._bound)

    def are_far(self, places: Float64Array, faces: NDArray[np.uint32], rows: IntArray) -> NDArray[np.bool_]:
        """Mark triangles of the present surface that have a tested point farther than the bound.

        Tested are the corners, the middle, and points of a lattice with steps of at most two mean edges of the original
        surface; the middle of each edge is one of them.

        places: ndarray, shape (n, 3), float64, mm
        faces: ndarray, shape (f, 3), uint32. Their corners are numbers of vertices of the original surface too.
        rows: ndarray, shape (f,), int. The triangle of the original surface that each face came from: its corners are
            near the face.

        Returns: ndarray, shape (f,), bool
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
        points, hints, of = [np.zeros((0, 3))], [near[:0]], [np.zeros(0, dtype=np.int64)]
        for count in np.unique(steps[look_at]):
            these = np.flatnonzero((steps == count) & look_at)
            weights = _inner_weights(int(count), corners.shape[1])
            flat = np.stack([column[these].reshape(-1) for column in columns])
            points.append((weights @ flat).reshape(-1, 3))
            hints.append(np.tile(near[these], (len(weights), 1)))
            of.append(np.tile(these, len(weights)))
        far = np.zeros(len(corners), dtype=bool)
        far[np.concatenate(of)[self._find_far(np.concatenate(points), np.concatenate(hints))]] = True
        return far

    def _find_far(self, points: Float64Array, hints: IntArray) -> NDArray[np.bool_]:
        """Mark points that are farther than the bound from the original surface.

        Around vertices that may be near them, shape (k, v), it is looked for first, then around the nearest corner of
        the nearest triangle there, and around the nearest vertices; what upper bounds do not decide is measured.
        """
        is_left = np.zeros(len(points), dtype=bool)
        left = self._not_within(np.arange(len(points)), points, hints, _WALKS)
        for several in (1, _NEAREST):
            if len(left):
                near = self._tree.result().query(points[left], k=np.arange(1, several + 1), workers=-1)[1]
                near = np.minimum(near, len(self._vertices) - 1)  # as many as there are
                left = self._not_within(left, points[left], near)
        if len(left):
            self._exact = self._exact or SurfaceDistance(self._vertices, self._triangles)
            is_left[left] = self._exact(points[left]) > self._bound
        return is_left

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
