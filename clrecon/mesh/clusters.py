"""Vertices of a mesh brought together into clusters, and taken apart again where that has done harm."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.connectivity import (
    Edges,
    find_edges,
    find_faces_back_to_back,
    find_split_vertices,
    label_components,
    opposite_half_edges,
)
from clrecon.mesh.coordinates import as_stored
from clrecon.mesh.distances import NearDistance
from clrecon.mesh.intersections import find_self_intersections
from clrecon.mesh.measures import cross_products

__all__ = ["Clusters"]

_FEW = 0.05
"""Share of faces up to which it pays to look for what lies around them."""

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]


class Clusters:
    """A mesh whose vertices are brought together: the surface is the given one with vertices renamed.

    Every edge collapse renames one vertex to another and drops the triangles that have both.  The end of many of
    them is a name for each vertex and a place for each name; a cluster is undone by giving its vertices their own
    names and places back.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), float64, mm, relative to a local origin
    triangles : ndarray, shape (m, 3), uint32
    names : ndarray, shape (n,), int
        For each vertex the one that stands for its cluster.
    places : ndarray, shape (n, 3), float64
        Where the vertices that stand for a cluster come to lie; of the others not used.
    """

    def __init__(self, vertices: Float64Array, triangles: NDArray[np.uint32], names: IntArray, places: Float64Array):
        self._vertices, self._triangles = vertices, triangles
        self._names, self._places = names, places
        self._components = label_components(triangles, len(vertices))
        self._seen: IntArray = np.full(triangles.shape, -1)
        self._seen_uncut: IntArray = np.full(triangles.shape, -1)
        self._before: tuple[Any, NearDistance] | None = None

    @classmethod
    def from_collapses(
        cls,
        vertices: Float64Array,
        triangles: NDArray[np.uint32],
        collapses: IntArray,
        points: Float64Array,
        faces: IntArray,
    ) -> Clusters:
        """Read the clusters off a list of collapses.

        Parameters
        ----------
        vertices, triangles : ndarray
            The mesh before.
        collapses : ndarray, shape (c, 2)
            In each the second vertex went into the first, which goes on.
        points, faces : ndarray
            The mesh after; its vertices are those that go on and have faces, in their order.

        Raises
        ------
        RuntimeError
            The mesh after is not what the collapses say.
        """
        names = np.arange(len(vertices))
        names[collapses[:, 1]] = collapses[:, 0]
        while True:
            further = names[names]
            if np.array_equal(further, names):
                break
            names = further
        clusters = cls(vertices, triangles, names, vertices.copy())
        left = clusters.faces()
        standing = np.unique(left)
        number = np.full(len(vertices), -1)
        number[standing] = np.arange(len(standing))
        if len(standing) != len(points) or not np.array_equal(number[left], faces):
            raise RuntimeError("the collapses that fast-simplification lists do not lead to its result")
        clusters._places[standing] = points
        return clusters

    @property
    def collapsed_count(self) -> int:
        """Number of vertices that have gone into another."""
        return int(np.count_nonzero(self._names != np.arange(len(self._names))))

    def faces(self) -> NDArray[np.uint32]:
        """Triangles with three different names, shape (k, 3)."""
        named = self._names.astype(np.uint32)[self._triangles]
        return named[self._is_face(named)]

    @staticmethod
    def _is_face(named: IntArray) -> NDArray[np.bool_]:
        a, b, c = named.T
        return (a != b) & (b != c) & (c != a)

    def surface(self, origin: Float64Array) -> tuple[NDArray[np.floating], NDArray[np.uint32]]:
        """Vertices (as stored, moved by `origin`) and triangles, numbered without gaps."""
        faces = self.faces()
        standing = np.unique(faces)
        number = np.zeros(len(self._vertices), dtype=np.uint32)
        number[standing] = np.arange(len(standing), dtype=np.uint32)
        return as_stored(self._places[standing] + origin), number[faces]

    def undo(self, names: IntArray) -> int:
        """Take these clusters apart; returns how many vertices that has moved or brought back."""
        marked = np.zeros(len(self._names), dtype=bool)
        marked[names] = True
        marked = marked[self._names]
        moved = marked & self._has_moved()
        self._names[marked] = np.flatnonzero(marked)
        self._places[marked] = self._vertices[marked]
        return int(np.count_nonzero(moved))

    def _has_moved(self) -> NDArray[np.bool_]:
        """Vertices that have gone into another, or that stand for a cluster elsewhere."""
        return (self._names != np.arange(len(self._names))) | (self._places != self._vertices).any(axis=1)

    def find_faults(self, origin: Float64Array) -> IntArray:
        """Names of clusters that have spoilt the surface.

        At edges and vertices that are not manifold, at faces without area or doubled, and of components of which
        nothing is left or that have come apart.
        """
        faces = self.faces()
        size = len(self._vertices)
        edges = find_edges(faces, size)
        faults = []
        if not edges.oriented:  # as is every mesh with three faces at an edge
            upward = (faces.reshape(-1) < faces[:, (1, 2, 0)].reshape(-1))[edges.half_edges]
            ups = np.add.reduceat(upward, edges.first, dtype=np.int64)
            faults += list(edges.ends[:, (ups > 1) | (edges.uses - ups > 1)])
        opposite = opposite_half_edges(faces, edges)
        if opposite is not None:
            faults.append(faces[find_faces_back_to_back(opposite)].reshape(-1))
        split = find_split_vertices(faces, size, edges, opposite)
        # The waist can be a vertex that stands for itself alone: what touches it twice is a cluster beside it.
        faults += [split, faces[np.isin(faces, split).any(axis=1)].reshape(-1) if len(split) else split]
        if not any(map(len, faults)):  # the rest can only be told, or costs less, when these are gone
            faults += [self._find_lost(faces, edges), *self._find_flat(faces, origin)]
        return np.unique(np.concatenate(faults).astype(np.int64))

    def _find_lost(self, faces: NDArray[np.uint32], edges: Edges) -> IntArray:
        """Names of components without a face, and of all but the largest part of those that have come apart."""
        count, labels = self._components
        now, parts = label_components(faces, len(self._vertices), edges)
        part_size = np.bincount(parts[faces[:, 0]], minlength=now)
        whole = np.full(now, -1)
        whole[parts[faces[:, 0]]] = labels[faces[:, 0]]
        order = np.lexsort((-part_size, whole))
        largest = np.full(count, -1)
        found, first = np.unique(whole[order], return_index=True)
        largest[found] = order[first]
        part = parts[self._names]
        lost = (labels >= 0) & ((part < 0) | (largest[labels] != part))
        # With what lies around: a part that has come apart can consist of vertices that all stand for themselves.
        return np.unique(self._names[self._triangles[lost[self._triangles].any(axis=1)]])

    def _find_flat(self, faces: NDArray[np.uint32], origin: Float64Array) -> list[NDArray[np.uint32]]:
        """Corners of faces without area once coordinates are rounded."""
        rounded = as_stored(self._places + origin)
        pieces = cross_products(rounded, faces, np.zeros(3))
        return [faces[where][~cross.any(axis=0)].reshape(-1) for where, _, cross in pieces]

    def find_crossing(self, origin: Float64Array) -> IntArray:
        """Names of clusters at faces that cut each other once coordinates are rounded.

        Only faces that have changed since the last call are looked at, with what lies around them.
        """
        named = self._names[self._triangles]
        is_face = self._is_face(named)
        faces = named[is_face].astype(np.uint32)
        changed = (named != self._seen_uncut).any(axis=1)[is_face]
        self._seen_uncut = named
        rounded = as_stored(self._places + origin)
        faces = faces[self._beside(faces, changed)]
        return np.unique(faces[find_self_intersections(rounded, faces)])

    def _beside(self, faces: NDArray[np.uint32], changed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Faces that can touch one of those that have changed."""
        if np.count_nonzero(changed) > _FEW * len(faces):
            return np.ones(len(faces), dtype=bool)
        if not changed.any():
            return changed
        from scipy.spatial import cKDTree

        corners = self._places[faces]
        centres = corners.mean(axis=1)
        reach = 2.0 * float(np.linalg.norm(corners - centres[:, None], axis=2).max())
        return np.isfinite(cKDTree(centres[changed]).query(centres, distance_upper_bound=reach, workers=-1)[0])

    def find_far(self, bound: float, all_vertices: bool) -> IntArray:
        """Names of clusters where the surface has moved too far.

        Looked at are the vertices as they were, against the surface as it is now, and every place and the centre of
        every face, against the surface as it was; of these, after the first call, only what has changed since.

        Parameters
        ----------
        bound : float
            mm.
        all_vertices : bool
            Look at all vertices that have moved, also where nothing has changed around the one that stands for them:
            what was close to them can have been given up.
        """
        named = self._names[self._triangles]
        changed = (named != self._seen).any(axis=1)
        self._seen = named
        touched = np.zeros(len(self._names), dtype=bool)
        touched[named[changed]] = True
        has_moved = self._has_moved()
        moved = np.flatnonzero(has_moved if all_vertices else has_moved & touched[self._names])
        gone_into = self._names[moved]
        left_behind = NearDistance(self._places, self.faces())(self._vertices[moved], gone_into, bound) > bound

        faces = named[changed & self._is_face(named) & has_moved[named].any(axis=1)]
        standing = np.unique(gone_into[touched[gone_into]])
        points = np.concatenate([self._places[standing], self._places[faces].mean(axis=1)])
        away = self._distances_from_before(points, bound) > bound
        off_place, off_face = standing[away[: len(standing)]], faces[away[len(standing) :]]
        return np.unique(np.concatenate([gone_into[left_behind], off_place, off_face.reshape(-1)]))

    def _distances_from_before(self, points: Float64Array, bound: float) -> Float64Array:
        from scipy.spatial import cKDTree

        if self._before is None:
            tree = cKDTree(self._vertices, balanced_tree=False, compact_nodes=False)
            self._before = tree, NearDistance(self._vertices, self._triangles)
        tree, distance = self._before
        return distance(points, tree.query(points, workers=-1)[1], bound)
