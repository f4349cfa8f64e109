"""Decimation within a bound in mm: edges collapse in rounds, and what the result shows to be at fault is undone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import count as count_from_zero
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange.coordinates import as_stored, find_coincident, rounding_step
from clrecon.mesh.compare.distances import rounding_of_bounds
from clrecon.mesh.connectivity import find_edges, label_components, number_used, order_by_number
from clrecon.mesh.intersections import find_changed_intersections
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.refine.collapse import FAR, SEVERAL, Collapser, Surface, collapse_in_rounds
from clrecon.mesh.refine.shifts import Follow, follow_none
from clrecon.mesh.refine.topology import TopologyChange, any_corner, compare_topology, measure_topology
from clrecon.mesh.triangle_tree import Curve
from clrecon.mesh.triangles import cross_products, vertex_normals
from clrecon.system.pieces import list_distinct, local_origin
from clrecon.system.progress import Progress

BOUND_VOXEL = 0.25
"""Default bound in shortest voxel steps; a mean of 0.1 voxel is then kept too."""

_SHARE_SLACK = 0.005
"""The wanted number of triangles counts as reached when it is exceeded by this share or less."""

_SHARE_OF_BOUND = 0.93
"""Of the bound within which points are kept while edges collapse: between them it may be a little more."""

_TURNS_OF_ONE = 5
"""Turns in which the last collapse alone of a place is undone; then the last one at each corner, as few are left."""

IntArray = NDArray[np.integer]
MakeCollapser = Callable[[Surface, float], Collapser]


def default_deviation(mesh: Mesh) -> float:
    """Return the default bound in mm: a quarter of the shortest voxel step that the mesh was made from."""
    if mesh.voxel_mm is None:
        raise UsageError("this mesh does not say how large its voxels were: give max_deviation_mm")
    return BOUND_VOXEL * mesh.voxel_mm


def check_refinement(mesh: Mesh, max_deviation_mm: float | None) -> float:
    bound = default_deviation(mesh) if max_deviation_mm is None else float(max_deviation_mm)
    if not (math.isfinite(bound) and bound > 0.0):
        raise UsageError(f"the largest deviation is a length in mm above 0, not {bound:g}")
    check_triangles(mesh)
    return bound


def check_share(fraction: float) -> None:
    """Check a share of triangles to remove; raises UsageError."""
    if not 0.0 < fraction < 1.0:
        raise UsageError(f"the share of triangles to remove is between 0 and 1, not {fraction:g}")


def check_triangles(mesh: Mesh) -> None:
    """Check that a mesh can be refined; raises as `check_refinement` does."""
    mesh.check()
    if mesh.triangle_count == 0:
        raise NoSurfaceError("the surface is empty: there is nothing to refine")
    if max(mesh.vertex_count, 3 * mesh.triangle_count) >= 2**31:
        raise UsageError(f"a mesh of {mesh.triangle_count} triangles is too large to be refined, at most 715,827,882")


def carry_on(
    mesh: Mesh, vertices: NDArray[np.floating], triangles: NDArray[np.uint32], name: str, facts: dict[str, Any]
) -> Mesh:
    """Return what a mesh has become, with one more entry in ``refinement`` and the values of the nearest vertices.

    Errors grow by the way from these along their normals.
    """
    report = {**mesh.report, "refinement": {**mesh.report.get("refinement", {}), name: facts}}
    refined = Mesh(vertices, triangles, vertex_normals(vertices, triangles), report)
    rows: slice | IntArray = slice(None)
    if triangles is mesh.triangles:
        refined.face_values = dict(mesh.face_values)
    elif mesh.values:
        from scipy.spatial import cKDTree

        rows = cKDTree(mesh.vertices).query(vertices, workers=-1)[1]
    refined.values = {of_value: values[rows] for of_value, values in mesh.values.items()}
    if (errors := refined.values.get("error_mm")) is not None:
        normals = vertex_normals(mesh.vertices, mesh.triangles) if mesh.normals is None else mesh.normals
        ways = ((vertices - mesh.vertices[rows]) * normals[rows]).sum(axis=1)
        refined.values["error_mm"] = np.hypot(errors, ways).astype(errors.dtype)
    return refined


def decimate_mesh(
    mesh: Mesh,
    fraction: float,
    max_deviation_mm: float | None = None,
    *,
    progress: Progress | None = None,
    make_collapser: MakeCollapser,
    follow: Follow = follow_none,
) -> Mesh:
    """Remove triangles within a bound, see `clrecon.operators.surface.decimation.decimate_mesh`.

    make_collapser: Makes a `Collapser` from a surface and the square of a distance, mm2.
    follow: Returns marks of the faces that may cut another one; None where all are looked at.
    """
    check_share(fraction)
    bound = check_refinement(mesh, max_deviation_mm)
    decimation = _Decimation(mesh, bound, make_collapser, follow)
    wanted = (1.0 - fraction) * mesh.triangle_count

    def tell_left(left: int) -> None:
        if progress is not None:
            to_go = math.ceil(mesh.triangle_count - wanted)
            progress("decimate", min(mesh.triangle_count - left, to_go), to_go)

    rounds = decimation.collapse(wanted, tell_left)
    taken_back = decimation.mend()
    vertices, triangles, topology = decimation.finish()
    tell_left(0)  # where the bound has ended it
    facts = {
        "fraction": fraction,
        "reached": 1.0 - len(triangles) / mesh.triangle_count,
        "ended_by": "share" if len(triangles) <= _nearly(wanted) else "bound",
        "rounds": rounds,
        "max_deviation_mm": bound,
        "triangles_before": mesh.triangle_count,
        "vertices_taken_back": taken_back,
        "topology": topology,
    }
    return carry_on(mesh, vertices, triangles, "decimate", facts)


def _nearly(wanted: float) -> float:
    return wanted * (1.0 + _SHARE_SLACK) + 2


def _sort_along_curve(mesh: Mesh) -> tuple[Mesh, IntArray, IntArray]:
    """Return a mesh whose neighbours are near in memory too, and the vertices and triangles from which its own come."""
    columns = mesh.vertices.T
    order = np.argsort(Curve(columns).codes(columns), kind="stable")
    number = np.empty(len(order), np.uint32)
    number[order] = np.arange(len(order), dtype=np.uint32)
    triangles = number[mesh.triangles]
    order_of_faces = order_by_number(triangles.min(axis=1))
    return Mesh(mesh.vertices[order], triangles[order_of_faces], None, {}, trusted=True), order, order_of_faces


class _Decimation:
    """A mesh whose edges collapse, and come back where the result would be at fault."""

    def __init__(self, mesh: Mesh, bound: float, make_collapser: MakeCollapser, follow: Follow):
        self._follow = follow
        mesh, self._order, self._order_of_faces = _sort_along_curve(mesh)
        self._mesh = mesh
        self._origin = local_origin(mesh.vertices)
        places = (mesh.vertices - self._origin).astype(np.float32)
        self._edges = find_edges(mesh.triangles, len(places))
        self._given = Surface.of(places, mesh.triangles, self._edges)
        # Both surfaces are stored rounded, each coordinate by at most half a step, and distances are in float32.
        slack = 2.0 * rounding_step(mesh.vertices) + rounding_of_bounds(float(np.abs(places).max()))
        self._limit = max(bound - slack, 0.0) ** 2
        self._collapser = make_collapser(self._given, _SHARE_OF_BOUND**2 * self._limit)

    def collapse(self, wanted: float, tell: Callable[[int], None]) -> int:
        """Collapse edges; return the number of rounds."""
        rounds = collapse_in_rounds(self._collapser, self._mesh.triangle_count, wanted, tell)
        self._history, self._pairing = self._collapser.finish()
        return rounds

    def mend(self) -> int:
        """Undo collapses until no fault is left; return their number."""
        history, triangles = self._history, self._mesh.triangles
        before, count = history.count, len(triangles)
        self._kind = as_stored(history.places + self._origin).dtype
        self._stored = self._mesh.vertices.astype(np.result_type(self._kind, self._mesh.vertices))
        self._names, self._faces = history.names(), np.empty_like(triangles)
        self._has_moved, self._is_face = np.zeros(len(self._names), bool), np.zeros(count, bool)
        self._witnesses = np.full((4, count), SEVERAL, np.int32)
        new = self._take_over(np.arange(len(self._names)), np.arange(count))
        marks = self._follow(self._stored, self._faces, new)
        suspects = new if marks is None else list_distinct(np.concatenate(marks.look()))
        for turn in count_from_zero():
            places = [*self._find_far(new), *self._find_unsound(suspects, new)]
            collapses = self._latest_of(places, at_corners=turn >= _TURNS_OF_ONE)
            if len(collapses) == 0:
                break
            vertices = history.name_again(self._names, history.undo(collapses))
            new = self._take_over(vertices, self._given.fans.touching(vertices))
            again = (np.flatnonzero(self._is_face),) if marks is None else marks.look_again(self._stored, new)
            suspects = list_distinct(np.concatenate(again))
        return before - history.count

    def _take_over(self, vertices: IntArray, rows: IntArray) -> IntArray:
        """Take over what has become of given vertices, and of triangles; return those of these that are faces.

        A face has the number of the given triangle that it comes from; its places are those that will be stored.
        """
        places, given = self._history.places.take(vertices, axis=0), self._mesh.vertices.take(vertices, axis=0)
        shifted = (places != self._given.places.take(vertices, axis=0)).any(axis=1)
        self._stored[vertices] = np.where(shifted[:, None], (places + self._origin).astype(self._kind), given)
        self._has_moved[vertices] = shifted | (self._names[vertices] != vertices)
        faces = self._names.take(self._mesh.triangles.take(rows, axis=0))
        self._faces[rows] = faces
        a, b, c = faces.T
        self._is_face[rows] = is_face = (a != b) & (b != c) & (c != a)
        return rows[is_face]

    def _find_far(self, new: IntArray) -> Iterator[IntArray]:
        """Find the names at triangles that are not seen to lie within the bound of the other surface.

        Given triangles are looked at again if one of the faces that were near has changed.
        """
        places = self._history.places
        self._collapser.show_present(places, self._faces, np.flatnonzero(self._is_face), new)
        rows = self._find_unseen(new)
        corners, names = self._mesh.triangles.take(rows, axis=0), self._faces.take(rows, axis=0)
        hints = np.column_stack([self._pairing.faces_at[rows], names.view(np.int32)]).astype(np.int32, copy=False)
        near = self._collapser.find_near_faces(self._given.places.take(corners, axis=0), hints, True, self._limit)
        self._witnesses[:, rows] = near.T
        yield names[near[:, 0] == FAR]
        faces = new[any_corner(self._has_moved, self._faces.take(new, axis=0))]
        corners = self._faces.take(faces, axis=0)
        hints = np.column_stack([self._pairing.below[faces], self._pairing.homes.take(corners)])
        hints = hints.astype(np.int32, copy=False)
        near = self._collapser.find_near_faces(places.take(corners, axis=0), hints, False, self._limit)
        yield corners[near[:, 0] == FAR]

    def _find_unseen(self, new: IntArray) -> IntArray:
        """Find given triangles that have moved and that no face that is still there shows to be near."""
        is_unseen = np.zeros(len(self._is_face) - FAR, dtype=bool)
        is_unseen[new] = True
        is_unseen[[SEVERAL, FAR]] = True  # from the end, and -1 is no face
        first, *others = self._witnesses
        has_none, more = is_unseen[first], np.flatnonzero(others[0] != -1)
        for faces in others:
            has_none[more] |= is_unseen[faces[more]]
        rows = np.flatnonzero(has_none)
        return rows[any_corner(self._has_moved, self._mesh.triangles.take(rows, axis=0))]

    def _find_unsound(self, suspects: IntArray, new: IntArray) -> Iterator[IntArray]:
        """Find among some faces names: at new ones that cut others or have no area, and at vertices that coincide."""
        is_new = np.zeros(len(self._is_face), dtype=bool)
        is_new[new] = True
        used, corners = number_used(self._faces.take(suspects, axis=0), len(self._stored))
        places, is_new = self._stored.take(used, axis=0), is_new[suspects]
        pairs = find_changed_intersections(places, corners, is_new)
        yield used[corners[pairs]].reshape(-1, 6)
        of_new = corners[is_new]
        for piece, _, cross in cross_products(places, of_new, self._origin):
            yield used[of_new[piece][~cross.any(axis=0)]]
        yield used[find_coincident(places)][:, None]

    def _latest_of(self, places: list[IntArray], *, at_corners: bool) -> IntArray:
        """Return the last collapse into any vertex of each place, shape (k, v), or into each, where there is any."""
        latest = self._history.latest()
        lists: list[IntArray] = [np.zeros(0, dtype=np.int64)]
        for names in places:
            collapses = latest[names]
            rounds = np.where(collapses >= 0, self._history.rounds[collapses], -1)
            lists.append(collapses.ravel() if at_corners else collapses[np.arange(len(names)), rounds.argmax(axis=1)])
        latest_ones = np.unique(np.concatenate(lists))
        return latest_ones[latest_ones >= 0]

    def finish(self) -> tuple[NDArray[np.floating], NDArray[np.uint32], TopologyChange]:
        """Return vertices and triangles, in the order of the given ones, and what became of the topology."""
        triangles, count = self._mesh.triangles, self._mesh.vertex_count
        components, labels = label_components(triangles, count, self._edges)
        before = measure_topology(triangles, labels, components, self._edges)
        rows = np.flatnonzero(self._is_face)
        after = measure_topology(self._faces[rows], labels, components)
        rows = rows[np.argsort(self._order_of_faces[rows])]
        corners = self._order[self._faces[rows]].astype(np.uint32)
        standing, faces = number_used(corners, count)
        stored = np.empty_like(self._stored)
        stored[self._order] = self._stored
        return as_stored(stored[standing]), faces, compare_topology(before, after)
