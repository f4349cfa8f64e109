"""Topology of a surface whose vertices were merged: Euler numbers by component, and where it is no manifold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.connectivity import (
    Edges,
    find_duplicate_faces,
    find_edges,
    find_faces_back_to_back,
    find_split_vertices,
    find_used,
    opposite_half_edges,
)
from clrecon.system.light_dataclass import dataclass
from clrecon.system.records import Record

_LISTED = 20
"""Most components that are listed one by one."""


@dataclass(frozen=True, eq=False)
class Topology:
    """Euler numbers of components, 2 less a tunnel, their faces, and the edges that are not in two faces."""

    euler: NDArray[np.int64]
    faces: NDArray[np.int64]
    loose_edges: int


@dataclass(frozen=True, eq=False)
class TopologyChange(Record):
    """What became of the topology of a surface.

    components_lost: Those that have no face any more.
    loose_edges_before, loose_edges_after: Edges that are not in two faces: where the surface is open, or several sheets
        meet.
    components_changed: Components that are still there with another Euler number.
    changes: The first of these, numbered in order of the first vertex.  In a closed and manifold component 2 more is a
        tunnel closed, 2 less a tunnel opened.
    """

    euler_number_before: int
    euler_number_after: int
    components_before: int
    components_lost: int
    loose_edges_before: int
    loose_edges_after: int
    components_changed: int
    changes: list[dict[str, int]]


def measure_topology(
    triangles: NDArray[np.uint32], labels: NDArray[np.int64], count: int, edges: Edges | None = None
) -> Topology:
    edges = find_edges(triangles, len(labels)) if edges is None else edges
    used = np.zeros(len(labels), dtype=bool)
    used[triangles.reshape(-1)] = True
    faces = np.bincount(labels[triangles[:, 0]], minlength=count)
    euler = np.bincount(labels[used], minlength=count) - np.bincount(labels[edges.ends[0]], minlength=count) + faces
    return Topology(euler, faces, int(np.count_nonzero(edges.uses != 2)))


def compare_topology(before: Topology, after: Topology) -> TopologyChange:
    """Compare the topology of a surface with that before; both have the same components."""
    differ = np.flatnonzero((before.euler != after.euler) & (after.faces > 0))
    return TopologyChange(
        euler_number_before=int(before.euler.sum()),
        euler_number_after=int(after.euler.sum()),
        components_before=int(np.count_nonzero(before.faces)),
        components_lost=int(np.count_nonzero((before.faces > 0) & (after.faces == 0))),
        loose_edges_before=before.loose_edges,
        loose_edges_after=after.loose_edges,
        components_changed=len(differ),
        changes=[
            {
                "component": int(number),
                "euler_number_before": int(before.euler[number]),
                "euler_number_after": int(after.euler[number]),
            }
            for number in differ[:_LISTED]
        ],
    )


IntArray = NDArray[np.integer]


def any_corner(flags: NDArray[np.bool_], triangles: IntArray) -> NDArray[np.bool_]:
    """Mark triangles, shape (m, 3), that have a corner whose flag is set."""
    # "clip" avoids checking each index, which takes longer than the look-up.
    first, second, third = flags.take(triangles, mode="clip").T
    return np.asarray(first | second | third)


def find_sheets(faces: NDArray[np.uint32], size: int, edges: Edges) -> list[IntArray]:
    """Find the vertices at edges with several sheets, of doubled faces and of several fans of faces."""
    faults = _find_ridges(faces, edges)
    opposite = opposite_half_edges(faces, edges)
    if opposite is not None:
        faults.append(faces[find_faces_back_to_back(opposite)].reshape(-1))
    split = find_split_vertices(faces, size, edges, opposite)
    # The waist can be a vertex without a cluster: the cluster beside it touches it twice.
    return [*faults, split, faces[np.isin(faces, split).any(axis=1)].reshape(-1) if len(split) else split]


def _find_ridges(faces: NDArray[np.uint32], edges: Edges) -> list[IntArray]:
    """Find the ends of edges along which two faces run in one direction, as at every edge with three faces."""
    if edges.oriented:
        return []
    upward = (faces.reshape(-1) < faces[:, (1, 2, 0)].reshape(-1))[edges.half_edges]
    ups = np.add.reduceat(upward, edges.first, dtype=np.int64)
    return list(edges.ends[:, (ups > 1) | (edges.uses - ups > 1)])


def find_faults_beside(faces: NDArray[np.uint32], new: NDArray[np.bool_]) -> IntArray:
    """Find the faults of `find_sheets` that the vertices `new`, which every new face has one of, can have made."""
    touched = np.zeros(len(new), dtype=bool)
    touched[faces[any_corner(new, faces)]] = True
    # With their neighbours: the fans around the touched vertices and the faces along their edges are complete.
    around = faces[any_corner(touched, faces)]
    numbers = find_used(around, len(new))
    number = np.empty(len(new), dtype=np.uint32)
    number[numbers] = np.arange(len(numbers), dtype=np.uint32)
    local = number[around]
    if len(local) == 0:
        return np.zeros(0, dtype=np.int64)
    edges = find_edges(local, len(numbers))
    faults = _find_ridges(local, edges)
    faults.append(local[find_duplicate_faces(local, len(numbers))].reshape(-1))
    split = find_split_vertices(local, len(numbers), edges)
    split = split[touched[numbers[split]]]
    faults += [split, local[np.isin(local, split).any(axis=1)].reshape(-1) if len(split) else split]
    return numbers[find_used(np.concatenate(faults).astype(np.int64), len(numbers))]


def find_torn(triangles: NDArray[np.uint32], names: IntArray) -> IntArray:
    """Find the names at which merging vertices has changed the Euler number.

    It stays as it was where the triangles that shrank to a vertex form a disc, and those that shrank to an edge a strip
    from one side of it to the other: their vertices - edges + faces are then 1 and, as they have no vertices, -1.

    names: For each vertex the one that it was merged into.
    """
    size = len(names)
    edges = find_edges(triangles, size)
    first, second = names[edges.ends]
    low, high = np.minimum(first, second), np.maximum(first, second)
    named = np.sort(names[triangles], axis=1).T
    within, two = named[0] == named[2], (named[0] == named[1]) ^ (named[1] == named[2])
    used = find_used(triangles, size)
    disc = np.bincount(names[used], minlength=size) - np.bincount(low[low == high], minlength=size)
    disc += np.bincount(named[0, within], minlength=size)
    standing = find_used(names[used], size)
    torn = standing[disc[standing] != 1]

    apart = low != high
    strips = np.concatenate([low[apart] * size + high[apart], named[0, two] * size + named[2, two]])
    weight = np.concatenate([np.ones(np.count_nonzero(apart), int), np.full(np.count_nonzero(two), -1)])
    key, number = np.unique(strips, return_inverse=True)
    key = key[np.bincount(number, weight, minlength=len(key)) != 1]
    return find_used(np.concatenate([torn, key // size, key % size]), size)
