"""Collapses of edges in their order, the last of which can be undone, and the places of what is left of a cluster."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.connectivity import Fans, order_by_number
from clrecon.mesh.triangles import cross_products
from clrecon.system.pieces import in_threads

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]

_PATIENCE = 3
"""After so many turns of undoing a cluster, each turn undoes twice as many of its collapses as before."""

_MOST_TURNS = 60

_PULL = 1e-3
"""Weight of the mean of the vertices, in sums of the planes: it decides where planes leave a direction open."""


def last_of_collapses(collapses: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """Return for each vertex the one that it was merged into in the end by collapses, see `Collapses.add`."""
    into = np.arange(count)
    into[collapses[:, 1]] = collapses[:, 0]
    while True:
        further = into[into]
        if np.array_equal(further, into):
            return into
        into = further


class Collapses:
    """Collapses that stand, in order: those of a cluster form a tree, so that the last of them can be undone."""

    def __init__(self, count: int):
        # In columns: each is looked through by itself, several dozen times.
        self._into, self._gone = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        self._turns = np.zeros(count, dtype=np.int8)

    def add(self, pairs: IntArray) -> None:
        """Append collapses, shape (c, 2): in each, the second vertex is merged into the first."""
        self._into, self._gone = np.append(self._into, pairs[:, 0]), np.append(self._gone, pairs[:, 1])
        self._turns[:] = 0

    def latest(self, names: IntArray) -> IntArray:
        """Return for each cluster the number of its last collapse, -1 where there is none, from names of vertices."""
        found = np.full(len(names), -1)
        found[names[self._into]] = np.arange(len(self._into))  # the last of equals stays
        return found

    def undo(self, marked: NDArray[np.bool_], names: IntArray) -> tuple[NDArray[np.bool_], IntArray]:
        """Undo the last collapses of marked clusters: one of each, and more where one is undone often in this round.

        names: ndarray, shape (n,), int. Cluster of each vertex.
        Returns: Which clusters had collapses, shape (n,), and their collapses that stay, shape (k, 2).
        """
        undone = np.zeros(len(marked), dtype=bool)
        # "clip" avoids checking each index, which takes longer than the look-up.
        name = names.take(self._into, mode="clip")
        rows = np.flatnonzero(marked.take(name, mode="clip"))
        if len(rows) == 0:
            return undone, np.zeros((0, 2), dtype=np.int64)
        name = name[rows]
        order = order_by_number(name, len(names))
        rows, name = rows[order], name[order]
        first = np.flatnonzero(np.append(True, name[1:] != name[:-1]))
        count = np.diff(np.append(first, len(name)))
        back = np.repeat(first + count, count) - np.arange(len(name))  # the last has 1
        heads = name[first]
        undone[heads] = True
        gone = back <= np.repeat(1 << self._turns[heads].astype(np.int64) // _PATIENCE, count)
        # What comes apart takes over how often it was undone.
        turns = np.minimum(self._turns[heads] + 1, _MOST_TURNS)
        self._turns[heads] = turns
        self._turns[self._gone[rows[gone]]] = np.repeat(turns, count)[gone]
        kept = np.sort(rows[~gone])
        left = np.stack([self._into[kept], self._gone[kept]], axis=1)
        stays = np.ones(len(self._into), dtype=bool)
        stays[rows[gone]] = False
        self._into, self._gone = self._into[stays], self._gone[stays]
        return undone, left


class Quadrics:
    """Squared distances to the planes of the triangles around each vertex (Garland and Heckbert 1997), near zero."""

    def __init__(self, vertices: Float64Array, triangles: NDArray[np.uint32], fans: Fans):
        planes = np.empty((len(triangles), 4))
        for where, corner, normal in cross_products(vertices, triangles, np.zeros(3)):
            length = np.sqrt(np.einsum("ij,ij->j", normal, normal))
            normal /= np.where(length > 0.0, length, 1.0)
            planes[where, :3], planes[where, 3] = normal.T, np.einsum("ij,ij->j", normal, corner)
        self._vertices, self._sums = vertices, np.zeros((len(vertices), 9))

        def work(where: slice) -> None:
            begin = fans.begin[where.start : where.stop + 1]
            around = planes.take(fans.rows[begin[0] : begin[-1]], axis=0)
            products = around[:, [0, 0, 0, 1, 1, 2, 0, 1, 2]] * around[:, [0, 1, 2, 1, 2, 2, 3, 3, 3]]
            used = np.diff(begin) > 0
            if used.any():
                self._sums[where][used] = np.add.reduceat(products, (begin[:-1] - begin[0])[used])

        in_threads(work, len(vertices))

    def best_places(self, clusters: IntArray, members: IntArray, count: int) -> Float64Array:
        """Return places (count, 3), mm, of the least sum of squares of `clusters` (k,), from 0 on, of `members`."""
        from scipy.sparse import csr_array

        shape = (count, len(self._vertices))
        which = csr_array((np.ones(len(members)), (clusters, members)), shape=shape)
        sums, size = which @ self._sums, np.bincount(clusters, minlength=count)
        mean = which @ self._vertices / size[:, None]
        matrix = sums[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        right = sums[:, 6:] - np.einsum("nij,nj->ni", matrix, mean)
        pull = _PULL * (sums[:, 0] + sums[:, 3] + sums[:, 5])
        matrix = matrix + np.where(pull > 0.0, pull, 1.0)[:, None, None] * np.eye(3)
        return mean + np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
