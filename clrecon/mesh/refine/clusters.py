"""Clusters of vertices: vertices of a mesh are merged, and separated again where that did harm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.exchange.coordinates import as_stored, find_coincident
from clrecon.mesh.connectivity import Edges, Fans, find_edges, find_used, label_components, order_by_number
from clrecon.mesh.intersections import FindCrossings, find_changed_intersections, find_self_intersections
from clrecon.mesh.refine.deviation import WITNESSES, Deviation
from clrecon.mesh.refine.topology import (
    TopologyChange,
    any_corner,
    compare_topology,
    find_faults_beside,
    find_sheets,
    find_torn,
    measure_topology,
)
from clrecon.mesh.triangles import cross_products
from clrecon.system.pieces import in_threads, side_by_side

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
        latest_rows = np.full(len(names), -1)
        latest_rows[names[self._into]] = np.arange(len(self._into))  # the last of equals stays
        return latest_rows

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
        standing = np.sort(rows[~gone])
        left = np.stack([self._into[standing], self._gone[standing]], axis=1)
        stays = np.ones(len(self._into), dtype=bool)
        stays[rows[gone]] = False
        self._into, self._gone = self._into[stays], self._gone[stays]
        return undone, left


class Quadrics:
    """Squared distances to the planes of the triangles around each vertex (Garland and Heckbert 1997), near zero."""

    def __init__(self, vertices: Float64Array, triangles: NDArray[np.uint32], fans: Fans):
        planes = np.empty((len(triangles), 4))
        for piece, corner, normal in cross_products(vertices, triangles, np.zeros(3)):
            length = np.sqrt(np.einsum("ij,ij->j", normal, normal))
            normal /= np.where(length > 0.0, length, 1.0)
            planes[piece, :3], planes[piece, 3] = normal.T, np.einsum("ij,ij->j", normal, corner)
        self._vertices, self._sums = vertices, np.zeros((len(vertices), 9))

        def sum_fans(piece: slice) -> None:
            begin = fans.begin[piece.start : piece.stop + 1]
            around = planes.take(fans.rows[begin[0] : begin[-1]], axis=0)
            products = around[:, [0, 0, 0, 1, 1, 2, 0, 1, 2]] * around[:, [0, 1, 2, 1, 2, 2, 3, 3, 3]]
            used = np.diff(begin) > 0
            if used.any():
                self._sums[piece][used] = np.add.reduceat(products, (begin[:-1] - begin[0])[used])

        in_threads(sum_fans, len(vertices))

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


_FEW = 0.05
"""Share of the vertices or triangles up to which it is faster to look at the triangles around each than at all."""

_CHECKS = ("cuts", "distances", "faults", "components", "vertices", "volumes")

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]


class Clusters:
    """A mesh with merged vertices: its surface is the given one with vertices renamed.

    Every edge collapse renames one vertex to another and drops the triangles that have both.  The result of many
    collapses is a name for each vertex and a place for each name.  The collapses are kept in their order: a cluster is
    undone from the last one on, and what it comes apart into gets places of its own.

    vertices: Relative to `origin`; places are rounded as a `Mesh` stores them after this is added.
    """

    def __init__(
        self,
        vertices: Float64Array,
        triangles: NDArray[np.uint32],
        origin: Float64Array,
        find_crossings: FindCrossings = find_self_intersections,
    ):
        self._triangles, self._origin = triangles, origin
        self._find_crossings = find_crossings
        self._original = self._rounded(vertices)
        self.names: IntArray = np.arange(len(vertices))
        """For each vertex the one that represents its cluster, shape (n,)."""
        self.places = self._original.copy()
        """Places of the vertices that represent a cluster, shape (n, 3), relative to the origin; others are unused."""
        self._collapses = Collapses(len(vertices))
        self._named, self._is_face = triangles.copy(), _are_faces(triangles)
        self._faces: NDArray[np.uint32] | None = None
        self.fans = Fans(triangles, len(vertices))
        """Fans of the given surface."""
        self._quadrics, edges = side_by_side(
            lambda: Quadrics(self._original, triangles, self.fans), lambda: find_edges(triangles, len(vertices))
        )
        self._components = label_components(triangles, len(vertices), edges)
        self._topology = measure_topology(triangles, self._components[1], self._components[0], edges)
        self._is_border = edges.border(len(vertices))
        # For each original triangle, faces that show that it lies within the bound (witnesses); -1 where none is known.
        itself = np.where(self._is_face, np.arange(len(triangles), dtype=np.int32), np.int32(-1))
        self._witnesses = np.repeat(itself[None], WITNESSES, axis=0)
        # Vertices whose name or place has changed since each of these looked at them.
        self._new = {check: np.zeros(len(vertices), dtype=bool) for check in _CHECKS}
        # Whether all of the surface has been examined for faults since the last collapses, and whether none were there.
        self._examined = self._sound = False

    def _rounded(self, places: Float64Array) -> Float64Array:
        return as_stored(places + self._origin).astype(np.float64) - self._origin

    def collapse(self, collapses: IntArray, points: Float64Array, faces: IntArray) -> None:
        """Merge the second vertices of collapses (c, 2) into the first; return `points` and `faces` afterwards."""
        standing = self.standing()
        into = last_of_collapses(collapses, len(standing))
        rename = np.arange(len(self.names))
        rename[standing] = standing[into]
        names, places = rename[self.names], self.places.copy()
        named = names.astype(np.uint32)[self._triangles]
        is_face = _are_faces(named)
        left = named[is_face]
        going_on = find_used(left, len(names))
        number = np.full(len(names), -1)
        number[going_on] = np.arange(len(going_on))
        if len(going_on) != len(points) or not np.array_equal(number[left], faces):
            raise RuntimeError("the collapses that fast-simplification lists do not lead to its result")
        # A vertex that none was merged into keeps its place.
        gained = np.bincount(rename, minlength=len(names))[going_on] > 1
        moved = going_on[gained]
        places[moved] = self._rounded(points[gained])
        self._collapses.add(standing[collapses])
        self.names, self.places = names, places
        self._named, self._is_face = named, is_face
        self._faces = left
        for check, new in self._new.items():
            new[moved] |= check != "faults"
        self._new["components"][rename != np.arange(len(rename))] = True  # of a component that is gone none has moved
        self._examined = self._sound = False

    @property
    def collapsed_count(self) -> int:
        """Number of vertices that were merged into another."""
        return int(np.count_nonzero(self.names != np.arange(len(self.names))))

    def faces(self) -> NDArray[np.uint32]:
        """Triangles with three different names, shape (k, 3)."""
        if self._faces is None:
            self._faces = self._named.take(np.flatnonzero(self._is_face), axis=0)
        return self._faces

    def standing(self) -> IntArray:
        """The vertices that represent a cluster and have faces, in their order."""
        return self.numbered()[0]

    def numbered(self, part: NDArray[np.bool_] | None = None) -> tuple[IntArray, NDArray[np.uint32]]:
        """Return the vertices as of `standing`, and the faces as rows of these, shape (k, 3); of components, (count,),
        if a part is given.
        """
        faces = self.faces()
        if part is not None:
            faces = faces[part[self._components[1].take(faces[:, 0])]]
        standing = find_used(faces, len(self.names))
        number = np.zeros(len(self.names), dtype=np.uint32)
        number[standing] = np.arange(len(standing), dtype=np.uint32)
        return standing, number.take(faces, mode="clip")

    def _take_new(self, check: str) -> NDArray[np.bool_]:
        """Return the vertices that are new to a check, and note that it has seen them."""
        new, self._new[check] = self._new[check], np.zeros(len(self.names), dtype=bool)
        return new

    def _changed_components(self, new: NDArray[np.bool_]) -> NDArray[np.bool_]:
        count, labels = self._components
        is_changed = np.zeros(count + 1, dtype=bool)
        is_changed[labels[new]] = True  # -1, the last, is that of vertices without triangles
        return is_changed[:-1]

    def take_changed(self) -> tuple[IntArray, NDArray[np.uint32]]:
        """Return what is `numbered` of the components that changed since the last call."""
        return self.numbered(self._changed_components(self._take_new("volumes")))

    def undo(self, names: IntArray) -> int:
        """Undo the last collapses of these clusters; return the number of vertices in those that had collapses."""
        if len(names) == 0:
            return 0
        marked = np.zeros(len(self.names), dtype=bool)
        marked[names] = True
        undone, left = self._collapses.undo(marked, self.names)
        moved = undone[self.names]
        members = np.flatnonzero(moved)
        if len(members) == 0:
            return 0
        into = np.arange(len(self.names))
        into[left[:, 1]] = left[:, 0]
        while True:
            back = into[members]
            further = into[back]
            if np.array_equal(further, back):
                break
            into[members] = further
        self.names[members] = back
        self._place(members)
        for new in self._new.values():
            new[back] = True
        rows = self._touching(members)
        self._named[rows] = self.names[self._triangles[rows]]
        self._is_face[rows] = _are_faces(self._named[rows])
        self._faces = None
        return len(members)

    def _place(self, members: IntArray) -> None:
        names = self.names[members]
        size = np.bincount(names, minlength=len(self.names))
        # The border of an open surface has no planes that would hold it.
        alone = (size == 1) | self._is_border
        at_home = names[alone[names]]
        self.places[at_home] = self._original[at_home]
        merged = members[~alone[names]]
        heads, clusters = np.unique(self.names[merged], return_inverse=True)
        if len(heads):
            self.places[heads] = self._rounded(self._quadrics.best_places(clusters, merged, len(heads)))

    def _touching(self, vertices: IntArray) -> IntArray:
        if len(vertices) <= _FEW * len(self.names):
            return self.fans.touching(vertices)
        flags = np.zeros(len(self.names), dtype=bool)
        flags[vertices] = True
        return np.flatnonzero(any_corner(flags, self._triangles))

    def _named_rows(self, flags: NDArray[np.bool_]) -> IntArray:
        """Return the given triangles that have a corner with a flagged name."""
        return self._touching(np.flatnonzero(flags[self.names]))

    def _face_rows(self, flags: NDArray[np.bool_]) -> IntArray:
        rows = self._named_rows(flags)
        return rows[self._is_face[rows]]

    def _has_moved(self) -> NDArray[np.bool_]:
        """Mark vertices that have another name than at first, or a name with another place."""
        x, y, z = (self.places != self._original).T
        return np.asarray((self.names != np.arange(len(self.names))) | (x | y | z)[self.names])

    def _have_moved(self, rows: IntArray) -> NDArray[np.bool_]:
        """Mark those of some given triangles that have a corner that has moved."""
        corners = self._triangles[rows]
        if len(rows) > _FEW * len(self._triangles):
            return any_corner(self._has_moved(), corners)
        names = self.names[corners]
        is_elsewhere = (self.places[names] != self._original[names]).any(axis=2)
        return np.asarray(((names != corners) | is_elsewhere).any(axis=1))

    def find_faults(self, *, everywhere: bool = False) -> IntArray:
        """Find the names of clusters that have spoilt the surface.

        These are clusters at non-manifold edges and vertices, at faces without area or doubled, at places that two
        vertices share, of components that have vanished or come apart, and where tunnels were closed or opened.

        everywhere: Examine all of the surface.  If not, only the surroundings of what was undone are examined once all
            of it has been, until they are sound, and then all of it until it is so once in this round.
        """
        faults: IntArray = np.zeros(0, dtype=np.int64)
        new = self._take_new("faults")
        if self._examined and new.any():
            touched = np.zeros(len(self.names), dtype=bool)
            touched[self._named[self._face_rows(new)]] = True
            faults = find_faults_beside(self._named[self._face_rows(touched)], new)
        if len(faults) or (self._sound and not everywhere):
            return faults
        faults = self._find_faults_everywhere()
        self._examined, self._sound = True, len(faults) == 0
        return faults

    def _find_faults_everywhere(self) -> IntArray:
        """Find the faults of components that changed since the last call that looked for all of them."""
        part = self._changed_components(self._new["components"])
        standing, faces = self.numbered(part)
        edges = find_edges(faces, len(standing))
        faults = find_sheets(faces, len(standing), edges)
        if any(map(len, faults)):  # the other faults can only be found, or cost less, after these are repaired
            return np.asarray(standing[find_used(np.concatenate(faults).astype(np.int64), len(standing))])
        self._take_new("components")
        stored, everywhere = self._stored(), self.standing()
        faults = [
            *(standing[flat] for flat in _find_flat(stored[standing], faces)),
            everywhere[find_coincident(stored[everywhere])],  # also in the place of one that did not change
            self._find_lost(standing, faces, edges, part),
            self._find_torn(standing, faces, edges),
        ]
        return find_used(np.concatenate(faults).astype(np.int64), len(self.names))

    def _find_torn(self, standing: IntArray, faces: NDArray[np.uint32], edges: Edges) -> IntArray:
        """Find names where components that are still there have got another Euler number."""
        count, labels = self._components
        now = measure_topology(faces, labels[standing], count, edges)
        differ = (now.euler != self._topology.euler) & (now.faces > 0)
        if not differ.any():
            return np.zeros(0, dtype=np.int64)
        return find_torn(self._triangles[differ[labels[self._triangles[:, 0]]]], self.names)

    def components(self) -> tuple[int, NDArray[np.int64], NDArray[np.bool_]]:
        """Return the number of components of the given surface, the one of each vertex, and its vertices at borders."""
        return *self._components, self._is_border

    def compare_topology(self) -> TopologyChange:
        count, labels = self._components
        return compare_topology(self._topology, measure_topology(self.faces(), labels, count))

    def _find_lost(
        self, standing: IntArray, faces: NDArray[np.uint32], edges: Edges, within: NDArray[np.bool_]
    ) -> IntArray:
        """Find names of components without a face, and of all but the largest part of those that came apart."""
        count, labels = self._components
        now, parts = label_components(faces, len(standing), edges)
        part_size = np.bincount(parts[faces[:, 0]], minlength=now)
        whole = np.full(now, -1)
        whole[parts] = labels[standing]
        order = np.lexsort((-part_size, whole))
        largest = np.full(count, -1)
        components, first = np.unique(whole[order], return_index=True)
        largest[components] = order[first]
        of_name = np.full(len(self.names), -1)
        of_name[standing] = parts
        part = of_name[self.names]
        lost = np.append(within, False)[labels] & ((part < 0) | (largest[labels] != part))
        if not lost.any():
            return np.zeros(0, dtype=np.int64)
        # With their surroundings: a part that has come apart can consist of vertices without clusters.
        return find_used(self.names[self._triangles[lost[self._triangles].any(axis=1)]], len(self.names))

    def _stored(self) -> NDArray[np.floating]:
        return as_stored(self.places + self._origin)

    def find_crossing(self) -> IntArray:
        """Find names of clusters at faces that cut each other after coordinates are rounded.

        Only faces that changed since the last call are examined with their surroundings: also those that are as at
        first again, as others may have moved to where they were not.
        """
        faces = self.faces()
        changed = any_corner(self._take_new("cuts"), faces)
        cut = faces[find_changed_intersections(self._stored(), faces, changed, self._find_crossings)]
        return find_used(cut, len(self.names))

    def find_far(self, deviation: Deviation) -> IntArray:
        """Find names of clusters where either surface is too far from the other.

        Only faces that changed since the last call are examined.  Of the corners of a triangle that is too far away,
        the one with the last collapse is named: collapses come in order of their error.
        """
        moved = self._take_new("distances")
        if not moved.any():
            return np.zeros(0, dtype=np.int64)
        named, changed = self._named, self._named_rows(moved)
        new = np.zeros(len(named), dtype=bool)
        new[changed] = True

        rows = np.flatnonzero(_any_witness(new, self._witnesses))
        self._witnesses[:, rows] = rows
        rows = rows[self._have_moved(rows)]
        rows = rows[deviation.can_be_far(rows, self.names, self.places)]
        near = np.zeros(len(self.names), dtype=bool)
        near[named[rows]] = True
        around = self._face_rows(near)
        from_rows = changed[self._is_face[changed]]
        from_rows = from_rows[self._have_moved(from_rows)]
        now = named[from_rows]
        (is_left_behind, seen), is_away = side_by_side(
            lambda: deviation.is_far_from(rows, self.names, self.places, named[around]),
            lambda: deviation.are_far(self.places, now, from_rows),
        )
        self._witnesses[:, rows] = np.append(around, -1)[seen]
        return self._pick(np.concatenate([named[rows[is_left_behind]], now[is_away]]))

    def _pick(self, named: NDArray[np.uint32]) -> IntArray:
        """Return the names with the last collapses in each row of names, shape (k, v)."""
        if len(named) == 0:
            return np.zeros(0, dtype=np.int64)
        last = self._collapses.latest(self.names)[named].argmax(axis=1)
        return find_used(named[np.arange(len(named)), last], len(self.names))

    def find_left_behind(self, deviation: Deviation) -> IntArray:
        """Find names of clusters with vertices too far from the changed faces around them; `find_far` is exact."""
        beside, near = (np.zeros(len(self.names), dtype=bool) for _ in range(2))
        beside[self._named[self._face_rows(self._take_new("vertices"))]] = True
        rows = np.flatnonzero(beside[self.names] & self._has_moved())
        near[self.names[rows]] = True
        faces = self._named[self._face_rows(near)]
        left = rows[deviation.are_left_behind(rows, self.names, self.places, faces)]
        return find_used(self.names[left], len(self.names))


def _are_faces(named: IntArray) -> NDArray[np.bool_]:
    """True for triangles, shape (m, 3), with three different corners."""
    a, b, c = named.T
    return np.asarray((a != b) & (b != c) & (c != a))


def _find_flat(places: NDArray[np.floating], faces: NDArray[np.uint32]) -> list[NDArray[np.uint32]]:
    pieces = cross_products(places, faces, np.zeros(3))
    return [faces[where][~cross.any(axis=0)].reshape(-1) for where, _, cross in pieces]


def _any_witness(flags: NDArray[np.bool_], witnesses: IntArray) -> NDArray[np.bool_]:
    """Mark triangles with a witness, shape (7, m), whose flag is set, or without witness."""
    is_flagged = witnesses[0] < 0
    for rows in witnesses:
        is_flagged |= flags.take(rows, mode="clip")
    return is_flagged
