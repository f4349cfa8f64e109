"""Topology of a surface whose vertices were merged: Euler numbers by component."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.connectivity import Edges, find_edges
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
