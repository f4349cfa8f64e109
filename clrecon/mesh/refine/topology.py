"""Topology of a surface whose vertices were merged: Euler numbers by component, and what they tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.connectivity import Edges, find_edges
from clrecon.system.records import Record

LISTED = 20
"""Most components that are listed one by one."""


@dataclass(frozen=True, eq=False)
class Topology:
    """Euler numbers of the components of a surface.

    euler: ndarray, shape (count,), int64. Vertices - edges + faces of each component: 2 for a closed surface without
        tunnels, and 2 less for each tunnel.
    faces: ndarray, shape (count,), int64
    loose_edges: Edges that are not in two faces.
    """

    euler: NDArray[np.int64]
    faces: NDArray[np.int64]
    loose_edges: int


@dataclass(frozen=True, eq=False)
class TopologyChange(Record):
    """What became of the topology of a surface.

    euler_number_before, euler_number_after: Used vertices - edges + faces.
    components_before, components_lost: Components of the surface before, and those of them that have no face any more.
    loose_edges_before, loose_edges_after: Edges that are not in two faces: where the surface is open, or several sheets
        meet.
    components_changed: Components that are still there with another Euler number.
    changes: The first of these: ``component`` (numbered in order of the first vertex), ``euler_number_before``,
        ``euler_number_after``.  In a closed and manifold component 2 more is a tunnel closed, 2 less a tunnel opened.
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
    """Measure the Euler number of each component.

    triangles: ndarray, shape (m, 3), uint32
    labels: ndarray, shape (n,), int64. Component of each vertex.
    count: Number of components.
    edges: Edges of the triangles if they are known.
    """
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
            for number in differ[:LISTED]
        ],
    )
