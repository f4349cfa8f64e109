"""How triangles hang together: edges, fans around vertices, components.  Counts only, no coordinates.

Words: half-edge h = 3 * f + i runs from corner i of triangle f to the next corner; the corner that it starts from
has the same number.  Two half-edges are opposite when they run along one edge in contrary directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError

__all__ = ["Edges", "count_duplicate_faces", "count_split_vertices", "find_edges", "label_components"]

_MOST_VERTICES = 3_037_000_499
"""Largest n with 2 * n * n below 2**64: an edge and its direction are one 64-bit key."""

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Edges:
    """The edges of a mesh; half-edges that start and end at one vertex are left out.

    Attributes
    ----------
    count : int
        Number of different edges.
    boundary, nonmanifold : int
        Edges with exactly one face, and with more than two.
    oriented : bool
        No two faces run along an edge in the same direction.
    half_edges : ndarray, int64
        All half-edges, those of one edge side by side.
    first : ndarray, int64, shape (count,)
        Where in `half_edges` the ones of an edge begin.
    """

    count: int
    boundary: int
    nonmanifold: int
    oriented: bool
    half_edges: IntArray
    first: IntArray

    @property
    def uses(self) -> IntArray:
        """Number of faces at each edge, shape (count,)."""
        return np.diff(self.first, append=len(self.half_edges))


def find_edges(triangles: NDArray[np.uint32], vertex_count: int) -> Edges:
    """Sort the half-edges by edge and direction.

    Raises
    ------
    UsageError
        More than 3,037,000,499 vertices.
    """
    if vertex_count > _MOST_VERTICES:
        raise UsageError(f"a mesh of {vertex_count} vertices is too large to be measured, at most {_MOST_VERTICES}")
    start = triangles.astype(np.uint64)
    end = start[:, (1, 2, 0)]
    keys = np.minimum(start, end)
    keys *= np.uint64(vertex_count)
    keys += np.maximum(start, end)
    keys <<= np.uint64(1)
    keys += start < end
    loops = start == end
    half_edges = None
    keys = keys.reshape(-1)
    if loops.any():
        half_edges = np.flatnonzero(~loops.reshape(-1))
        keys = keys[half_edges]
    del start, end, loops
    order = np.argsort(keys)
    keys = keys[order]
    half_edges = order if half_edges is None else half_edges[order]
    oriented = not bool((keys[1:] == keys[:-1]).any())
    keys >>= np.uint64(1)
    is_first = np.ones(len(keys), dtype=bool)
    np.not_equal(keys[1:], keys[:-1], out=is_first[1:])
    first = np.flatnonzero(is_first)
    uses = np.diff(first, append=len(keys))
    return Edges(
        count=len(first),
        boundary=int(np.count_nonzero(uses == 1)),
        nonmanifold=int(np.count_nonzero(uses > 2)),
        oriented=oriented,
        half_edges=half_edges,
        first=first,
    )


def count_split_vertices(triangles: NDArray[np.uint32], vertex_count: int, edges: Edges) -> int:
    """Count the vertices whose faces fall apart into several fans, such as the waist of an hourglass.

    Joins the corners of one vertex whose faces share an edge: what stays apart is another fan.
    """
    corners = triangles.reshape(-1)
    same_edge = np.ones(max(len(edges.half_edges) - 1, 0), dtype=bool)
    same_edge[edges.first[1:] - 1] = False
    pairs = np.flatnonzero(same_edge)
    one, other = edges.half_edges[pairs], edges.half_edges[pairs + 1]

    def next_corner(half_edge: IntArray) -> IntArray:
        return half_edge + np.where(half_edge % 3 == 2, -2, 1)

    one_end, other_end = next_corner(one), next_corner(other)
    parallel = corners[one] == corners[other]
    joined = (
        np.concatenate([one, one_end]),
        np.concatenate([np.where(parallel, other, other_end), np.where(parallel, other_end, other)]),
    )
    count, labels = _connect(*joined, corners.size)
    vertex_of_fan = np.empty(count, dtype=np.int64)
    vertex_of_fan[labels] = corners  # all corners of a fan have one vertex
    return int(np.count_nonzero(np.bincount(vertex_of_fan, minlength=vertex_count) > 1))


def label_components(triangles: NDArray[np.uint32], vertex_count: int) -> tuple[int, NDArray[np.int64]]:
    """Number the components: triangles that share a vertex belong to one.

    Returns
    -------
    count : int
        Number of components; vertices that no triangle uses are none.
    labels : ndarray, shape (vertex_count,), int64
        Component of each vertex, numbered in order of the first vertex; -1 for unused vertices.
    """
    used = np.zeros(vertex_count, dtype=bool)
    used[triangles.reshape(-1)] = True
    one = np.concatenate([triangles[:, 0], triangles[:, 1]])
    other = np.concatenate([triangles[:, 1], triangles[:, 2]])
    groups, labels = _connect(one, other, vertex_count)
    if used.all():
        return groups, labels
    is_component = np.zeros(groups, dtype=bool)
    is_component[labels[used]] = True
    number = np.cumsum(is_component) - 1
    return int(np.count_nonzero(is_component)), np.where(used, number[labels], -1)


def _connect(one: NDArray[np.integer], other: NDArray[np.integer], size: int) -> tuple[int, IntArray]:
    """Connected components of an undirected graph with `size` nodes, numbered in order of the first node."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    index_type = np.int32 if size < 2**31 else np.int64
    # bool: entries that come twice are joined by "or"; as numbers they could add up to 0
    links = (np.ones(len(one), dtype=bool), (one.astype(index_type), other.astype(index_type)))
    count, labels = connected_components(coo_matrix(links, shape=(size, size)).tocsr(), directed=False)
    return int(count), labels.astype(np.int64)


def count_duplicate_faces(triangles: NDArray[np.uint32], vertex_count: int) -> int:
    """Count the triangles that have the three vertices of an earlier one, in whatever order.

    Sums of scrambled vertex numbers (splitmix64, Steele, Lea and Flood 2014) do not depend on the order; only
    triangles whose sums are equal are compared in full.
    """
    with np.errstate(over="ignore"):
        mixed = np.arange(1, vertex_count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
        sums = mixed[triangles[:, 0]] + mixed[triangles[:, 1]] + mixed[triangles[:, 2]]
    ordered = np.sort(sums)
    repeated = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(repeated) == 0:
        return 0
    suspects = np.sort(triangles[np.isin(sums, repeated)], axis=1)
    return len(suspects) - len(np.unique(suspects, axis=0))
