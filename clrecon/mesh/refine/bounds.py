"""Upper bounds of distances to a surface by numpy: where vertices of it near each point are known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.near_distances import NearDistance
from clrecon.mesh.refine.faults import any_corner
from clrecon.system.pieces import in_threads

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
    """A surface to which distances are bounded, by numpy.

    `clrecon.operators.surface.decimation.DeviceBounds` does the same on a device.

    vertices: ndarray, shape (n, 3), mm, near zero
    triangles: ndarray, shape (m, 3), uint32
    """

    def find_bounds(
        self, points: Float64Array, near: IntArray, limit: float, walks: int = 0
    ) -> tuple[Float32Array, IntArray]:
        """Return upper bounds of the distances from points to the surface, and the triangles that they are taken from.

        The triangles around each of the vertices near a point are measured, and then, some times, those around the
        nearest corner of the nearest triangle.  Nothing nearer than `limit` is looked for.

        points: ndarray, shape (k, 3), float64, mm
        near: ndarray, shape (k, v), int. Vertices near each point.
        limit: mm.
        walks: Most steps from triangle to triangle.

        Returns:
        length: ndarray, shape (k,), float32, mm. Infinity where no triangle was measured.
        rows: ndarray, shape (k,), int. -1 where no triangle was measured.
        """
        found: tuple[Float32Array, IntArray] = (np.full(len(points), np.inf, np.float32), np.full(len(points), -1))
        self.prepare()

        def work(where: slice) -> None:
            length, rows = found[0][where], found[1][where]
            columns = points[where].T.astype(np.float32)
            rest = np.arange(columns.shape[1])
            for turn in range(near.shape[1] + walks):
                here = columns[:, rest]
                if turn < near.shape[1]:
                    vertex = near[where][rest, turn]
                else:
                    vertex = self._nearest_corner(here, rows[rest])
                bound, row = self.upper_bounds(here, vertex)
                shorter = bound < length[rest]
                length[rest[shorter]], rows[rest[shorter]] = bound[shorter], row[shorter]
                rest = rest[~(length[rest] <= limit)]
                if turn >= near.shape[1] - 1:  # no triangle leads further
                    rest = rest[rows[rest] >= 0]

        in_threads(work, len(points), _PIECE)
        return found

    def find_witnesses(
        self, places: Float32Array, triangles: IntArray, names: IntArray, beside: IntArray, limit: float
    ) -> tuple[IntArray, NDArray[np.uint8]]:
        """Find triangles of this surface that show that those of another lie within a limit.

        If one triangle is within the limit of all corners, it is so of every point between them.  If not, the middles
        of the triangle and of its edges are compared with the triangles nearest to the corners, then with all around
        the names.

        places: ndarray, shape (v, 3), float32, mm. Vertices of the other surface.
        triangles: ndarray, shape (k, 3), uint32. Its triangles that are examined.
        names: ndarray, shape (v,), int. For each vertex one of this surface near it.
        beside: ndarray, shape (v,), int32. For each vertex a triangle of this surface that is within the limit; -1
            where there is none.
        limit: mm.

        Returns:
        witnesses: ndarray, shape (7, k), int32. For the corners, the middle and the middles of the edges of each; -1
            for corners without one.
        left: ndarray, shape (k,), uint8. Bit b says that nothing shows middle b of `MIDDLES` to be within the limit.
            Triangles that have a corner without witness are not examined.
        """
        witnesses: NDArray[np.int32] = np.empty((WITNESSES, len(triangles)), dtype=np.int32)
        witnesses[:3] = beside[triangles].T
        witnesses[3:] = witnesses[0]
        left = np.zeros(len(triangles), dtype=np.uint8)
        columns = np.ascontiguousarray(places.T)
        far = any_corner(beside < 0, triangles)
        self.prepare()

        def work(where: slice) -> None:
            near = witnesses[:3, where]
            corners = [columns.take(corner, axis=1, mode="clip") for corner in triangles[where].T]
            rest = np.flatnonzero(~far[where])
            rest = rest[~self._are_within([corner[:, rest] for corner in corners], near[:, rest], limit)]
            self._leave_middles(corners, near, rest, names[triangles[where]], limit, witnesses[:, where], left[where])

        in_threads(work, len(triangles), _PIECE)
        return witnesses, left

    def _most(self, limit: float) -> float:
        """Return the square below which a square is surely within the limit."""
        return max(limit - self.slack, 0.0) ** 2

    def _are_within(self, corners: Corners, near: IntArray, limit: float) -> NDArray[np.bool_]:
        """True where one of the faces nearest to the corners, shape (3, k), is surely within the limit of all three."""
        most = self._most(limit)
        within = (near[0] == near[1]) & (near[1] == near[2])
        for one, others in ((0, (1, 2)), (1, (2, 0)), (2, (0, 1))):
            rest = np.flatnonzero(~within)
            for other in others:
                apart = near[other, rest] != near[one, rest]
                some = rest[apart]
                beyond = np.zeros(len(rest), dtype=bool)
                beyond[apart] = ~(self.frames.squares(corners[other][:, some], near[one, some]) < most)
                rest = rest[~beyond]
            within[rest] = True
        return within

    def _leave_middles(
        self,
        corners: Corners,
        near: IntArray,
        rest: IntArray,
        names: IntArray,
        limit: float,
        witnesses: IntArray,
        left: NDArray[np.uint8],
    ) -> None:
        """Look at the middles of triangles and edges, see `find_witnesses`, of a piece.

        corners, near, names: Places in columns, faces nearest to them, shape (3, k), names, shape (k, 3).
        rest: ndarray, shape (r,), int. Triangles of this piece that are looked at.
        witnesses, left: Of this piece; changed in place.
        """
        one, two, three = (corner[:, rest] for corner in corners)
        half = np.float32(0.5)
        points = np.concatenate(
            [(one + two + three) * np.float32(1 / 3), (one + two) * half, (two + three) * half, (three + one) * half], 1
        )
        point = np.arange(len(MIDDLES) * len(rest))
        most = self._most(limit)
        for corner in range(3):
            beside = near[corner, rest[point % max(len(rest), 1)]]
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
