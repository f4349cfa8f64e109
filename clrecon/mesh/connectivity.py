"""Connectivity of triangles: edges, fans around vertices, components; from indices alone, without coordinates.

Half-edge h = 3 * f + i runs from corner i of triangle f to the next corner; the corner that it starts from has the same
number.  Two half-edges are opposite when they run along one edge in opposite directions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.regions import number_connected
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import in_threads

_MOST_STEPS = 64
"""Most faces around a vertex that are counted one after the other; vertices with more take the general way."""

_LOOP = np.uint64(2**64 - 1)
"""In place of the vertices of half-edges that start and end at one."""

IntArray = NDArray[np.integer]


@dataclass(frozen=True)
class Edges:
    """The edges of a mesh; half-edges that start and end at one vertex are left out.

    boundary, nonmanifold: Edges with exactly one face, and with more than two.
    oriented: No two faces run along an edge in the same direction.
    half_edges: All half-edges, those of one edge side by side, first those that run to the higher vertex number.
    first: Shape (count,). Index in `half_edges` at which those of an edge begin.
    ends: Shape (2, count). Lower and higher vertex number of each edge; edges are in order of the lower, then of the
        higher one.
    """

    count: int
    boundary: int
    nonmanifold: int
    oriented: bool
    half_edges: IntArray
    first: IntArray
    ends: NDArray[np.uint32]

    @property
    def uses(self) -> IntArray:
        """Number of faces at each edge, shape (count,)."""
        return np.diff(self.first, append=len(self.half_edges))

    def border(self, vertex_count: int) -> NDArray[np.bool_]:
        """Mark the vertices at edges with one face, shape (vertex_count,)."""
        is_border = np.zeros(vertex_count, dtype=bool)
        is_border[self.ends[:, self.uses == 1].reshape(-1)] = True
        return is_border


@dataclass(frozen=True)
class Topology:
    """What the indices of a mesh tell.

    edges, boundary, nonmanifold, oriented: See `Edges`.
    loops: Half-edges that start and end at one vertex.
    split_vertices: Vertices whose faces form several fans.
    labelled: The result of `label_components`.
    opposite: See `opposite_half_edges`; None too where it was not looked for.
    """

    edges: int
    boundary: int
    nonmanifold: int
    oriented: bool
    loops: int
    split_vertices: int
    duplicate_faces: int
    labelled: tuple[int, NDArray[np.int64]]
    opposite: IntArray | None = None


def find_topology(
    triangles: NDArray[np.uint32],
    vertex_count: int,
    known: tuple[tuple[int, NDArray[np.int64]], IntArray] | None = None,
) -> Topology:
    """Find what the indices tell; where components and irregular vertices are `known`, from the triangles at these.

    Around all other vertices each edge is in two triangles, run along in opposite directions, and no two triangles have
    the same corners.
    """
    if known is None:
        rows, is_irregular = triangles, np.ones(vertex_count, bool)
    elif len(known[1]) == 0:
        return Topology(triangles.size // 2, 0, 0, True, 0, 0, 0, known[0])
    else:
        is_irregular = np.zeros(vertex_count, bool)
        is_irregular[known[1]] = True
        a, b, c = (is_irregular.take(corner) for corner in triangles.T)
        rows = triangles[a | b | c]
    edges = find_edges(rows, vertex_count)
    opposite = opposite_half_edges(rows, edges)
    uses, loops = edges.uses[is_irregular[edges.ends].any(axis=0)], rows.size - len(edges.half_edges)
    regular_edges = (triangles.size - loops - int(uses.sum())) // 2
    split = find_split_vertices(rows, vertex_count, edges, opposite)
    return Topology(
        len(uses) + regular_edges, int(np.count_nonzero(uses == 1)), edges.nonmanifold, edges.oriented, loops,
        int(np.count_nonzero(is_irregular[split])), count_duplicate_faces(rows, vertex_count, opposite),
        known[0] if known else label_components(triangles, vertex_count, edges), None if known else opposite,
    )  # fmt: skip


def _index_type(size: int) -> type[np.integer]:
    return np.int32 if size < 2**31 else np.int64


def order_by_number(numbers: IntArray) -> IntArray:
    """Return the stable order of up to 2^32 whole numbers from 0 to 2^32 - 1, like ``argsort(kind="stable")``.

    They are sorted together with their places, as numbers of 64 bits: numpy does that with vectors.
    """
    packed = pack_numbers(numbers, np.arange(len(numbers), dtype=np.uint32))
    packed.sort()
    packed &= np.uint64(0xFFFFFFFF)
    return packed.astype(_index_type(len(numbers)))


def pack_numbers(upper: IntArray, lower: IntArray) -> NDArray[np.uint64]:
    """Return numbers of 64 bits, of which the upper half counts first in an order; both are from 0 to 2^32 - 1."""
    packed = upper.astype(np.uint64)
    packed <<= np.uint64(32)
    packed |= lower.astype(np.uint64, copy=False)
    return packed


def find_used(numbers: IntArray, size: int) -> IntArray:
    """Return the numbers below `size` that occur, ascending, many sooner than `np.unique` does."""
    used = np.zeros(size, dtype=bool)
    used[numbers] = True
    return np.flatnonzero(used)


def list_runs(first: IntArray, size: IntArray, step: int | np.integer = 1) -> IntArray:
    """Return the whole numbers of runs one after the other, each of `size` from `first` on, `step` apart."""
    ends = np.cumsum(size, dtype=first.dtype)
    numbers = np.arange(int(size.sum()), dtype=first.dtype)
    numbers *= first.dtype.type(step)
    numbers += np.repeat(first - step * (ends - size), size)
    return numbers


def number_used(triangles: NDArray[np.uint32], vertex_count: int) -> tuple[IntArray, NDArray[np.uint32]]:
    """Return the vertices that some triangles use, ascending, and the triangles with the places of these as corners."""
    used = find_used(triangles.reshape(-1), vertex_count)
    places = np.empty(vertex_count, np.uint32)
    places[used] = np.arange(len(used), dtype=np.uint32)
    return used, places[triangles]


class Lists:
    """Rows by number: of number v `rows` from ``begin[v]`` to ``begin[v + 1]``, in their order."""

    def __init__(self, numbers: IntArray, size: int):
        self.rows = order_by_number(numbers)
        self.begin = np.zeros(size + 1, dtype=np.int64)
        np.cumsum(np.bincount(numbers, minlength=size), out=self.begin[1:])

    def around(self, numbers: IntArray) -> tuple[IntArray, IntArray]:
        """Return the rows of some numbers one after the other, and how many each number has."""
        first = self.begin[numbers]
        count = self.begin[numbers + 1] - first
        return self.rows[list_runs(first, count)], count


class Fans(Lists):
    """The triangles around each vertex."""

    def __init__(self, triangles: NDArray[np.uint32], vertex_count: int):
        super().__init__(triangles.reshape(-1), vertex_count)
        self.rows //= 3

    def touching(self, vertices: IntArray) -> IntArray:
        """Return the triangles that have one of some vertices, each once, in their order."""
        is_touching = np.zeros(len(self.rows) // 3, dtype=bool)
        is_touching[self.around(vertices)[0]] = True
        return np.flatnonzero(is_touching)

    def sums(self, values: NDArray[np.floating], triangles: NDArray[np.uint32], vertices: IntArray) -> NDArray[Any]:
        """Return sums of values (n, k) over all corners of the triangles around vertices: neighbours count twice."""
        totals = np.zeros((len(vertices), values.shape[1]), values.dtype)
        # Where they are most, the sum of each triangle is looked up three times, not made anew.
        is_most = len(triangles) < int((self.begin[vertices + 1] - self.begin[vertices]).sum())
        of_all = np.empty((len(triangles) if is_most else 0, values.shape[1]), values.dtype)

        def sum_corners(chosen: NDArray[np.uint32]) -> Any:
            # "clip" avoids checking each index, which takes longer than the look-up.
            first, second, third = (values.take(corners, axis=0, mode="clip") for corners in chosen.T)
            return first + second + third

        def sum_triangles(piece: slice) -> None:
            of_all[piece] = sum_corners(triangles[piece])

        def sum_fans(piece: slice) -> None:
            rows, count = self.around(vertices[piece])
            used = count > 0
            if used.any():
                of_rows = of_all.take(rows, axis=0, mode="clip") if is_most else sum_corners(triangles[rows])
                totals[piece][used] = np.add.reduceat(of_rows, (np.cumsum(count) - count)[used])

        in_threads(sum_triangles, len(of_all))
        in_threads(sum_fans, len(vertices))
        return totals


def find_edges(triangles: NDArray[np.uint32], vertex_count: int) -> Edges:
    """Sort half-edges by one number of their lower and their higher vertex and their direction."""
    if vertex_count > 1 << 31:  # a number of 64 bits holds two vertices of 31
        used, numbers = np.unique(triangles, return_inverse=True)
        edges = find_edges(numbers.reshape(-1, 3).astype(np.uint32), len(used))
        return Edges(**vars(edges) | {"ends": used.take(edges.ends)})
    start = triangles.reshape(-1)
    end = triangles[:, (1, 2, 0)].reshape(-1)
    keys = pack_numbers(np.minimum(start, end), np.maximum(start, end))
    keys <<= np.uint64(1)
    keys |= start > end
    is_loop = start == end
    keys[is_loop] = _LOOP
    half_edges = np.argsort(keys)
    ordered = keys.take(half_edges)
    if (ordered[1:] == ordered[:-1]).any():  # else there is only one order, which is found sooner
        half_edges = np.argsort(keys, kind="stable")
    count = len(start) - int(np.count_nonzero(is_loop))
    half_edges, ordered = half_edges[:count].astype(_index_type(len(start))), ordered[:count]
    oriented = not bool((ordered[1:] == ordered[:-1]).any())
    ordered >>= np.uint64(1)
    first = np.flatnonzero(np.concatenate([np.ones(min(count, 1), dtype=bool), ordered[1:] != ordered[:-1]]))
    uses, ends = np.diff(first, append=count), ordered.take(first)
    return Edges(
        count=len(first),
        boundary=int(np.count_nonzero(uses == 1)),
        nonmanifold=int(np.count_nonzero(uses > 2)),
        oriented=oriented,
        half_edges=half_edges,
        first=first,
        ends=np.stack([ends >> np.uint64(32), ends & np.uint64(0xFFFFFFFF)]).astype(np.uint32),
    )


def opposite_half_edges(triangles: NDArray[np.uint32], edges: Edges) -> IntArray | None:
    """Return the half-edge opposite each, (3 * m,); None unless every edge has two faces, oppositely run."""
    clean = edges.oriented and edges.boundary == 0 and edges.nonmanifold == 0
    if not clean or len(edges.half_edges) != triangles.size:
        return None
    first, second = edges.half_edges[0::2], edges.half_edges[1::2]
    opposite = np.empty_like(edges.half_edges)
    opposite[first] = second
    opposite[second] = first
    return opposite


def find_split_vertices(
    triangles: NDArray[np.uint32], vertex_count: int, edges: Edges, opposite: IntArray | None = None
) -> IntArray:
    """Find vertices whose faces form several fans, as a waist; with `opposite`, by going round each once."""
    corners = triangles.reshape(-1)
    degree = np.bincount(corners, minlength=vertex_count)
    if opposite is None or (len(degree) and degree.max() > _MOST_STEPS):
        return _find_split_vertices_of_any_mesh(corners, vertex_count, edges)
    turn = opposite.reshape(-1, 3)[:, (2, 0, 1)].reshape(-1)  # across the edge that ends in the vertex
    start = np.empty(vertex_count, dtype=opposite.dtype)
    start[corners] = np.arange(len(corners), dtype=opposite.dtype)
    going = np.flatnonzero(degree)
    steps = np.zeros(vertex_count, dtype=degree.dtype)
    current = start = start[going]
    step = 0
    while len(going):
        step += 1
        current = turn[current]
        back = current == start
        if back.any():
            steps[going[back]] = step
            going, current = going[~back], current[~back]
            start = start[~back]
    return np.flatnonzero(steps != degree)


def _find_split_vertices_of_any_mesh(corners: NDArray[np.uint32], vertex_count: int, edges: Edges) -> IntArray:
    """Join the corners of a vertex whose faces share an edge: each remaining group is a fan."""
    same_edge = np.ones(max(len(edges.half_edges) - 1, 0), dtype=bool)
    same_edge[edges.first[1:] - 1] = False
    pairs = np.flatnonzero(same_edge)
    first, second = edges.half_edges[pairs], edges.half_edges[pairs + 1]

    def next_corner(half_edge: IntArray) -> IntArray:
        return half_edge + np.where(half_edge % 3 == 2, -2, 1)

    one_end, other_end = next_corner(first), next_corner(second)
    parallel = corners[first] == corners[second]
    joined = (
        np.concatenate([first, one_end]),
        np.concatenate([np.where(parallel, second, other_end), np.where(parallel, other_end, second)]),
    )
    fans = number_connected(corners.size, *joined) - 1
    vertex_of_fan = np.empty(fans.max(initial=-1) + 1, dtype=np.int64)
    vertex_of_fan[fans] = corners  # all corners of a fan have one vertex
    return np.flatnonzero(np.bincount(vertex_of_fan, minlength=vertex_count) > 1)


def label_components(
    triangles: NDArray[np.uint32], vertex_count: int, edges: Edges | None = None
) -> tuple[int, NDArray[np.int64]]:
    """Number the components: triangles that share a vertex belong to one component.

    edges: If they are already known, labelling takes less time.
    Returns:
    count: Number of components, not counting vertices that no triangle uses.
    labels: ndarray, shape (vertex_count,), int64. Component of each vertex, numbered in order of the first vertex; -1
        for unused vertices.
    """
    used = np.zeros(vertex_count, dtype=bool)
    used[triangles.reshape(-1)] = True
    corners = triangles.T
    pairs = edges.ends if edges is not None else np.concatenate((corners[:2], corners[1:]), axis=1)
    labels = number_connected(vertex_count, *pairs)
    if not used.all():
        is_component = np.zeros(vertex_count + 1, dtype=bool)
        is_component[labels[used]] = True
        labels = np.where(used, np.cumsum(is_component)[labels], 0)
    return int(labels.max(initial=0)), labels.astype(np.int64) - 1


def count_duplicate_faces(triangles: NDArray[np.uint32], vertex_count: int, opposite: IntArray | None = None) -> int:
    """Count triangles with the vertices of an earlier one, neighbours on all sides where given `opposite`."""
    if opposite is not None:
        return len(find_faces_back_to_back(opposite)) // 2
    duplicate_faces = find_duplicate_faces(triangles, vertex_count)
    return len(duplicate_faces) - len(np.unique(np.sort(triangles[duplicate_faces], axis=1), axis=0))


def find_duplicate_faces(triangles: NDArray[np.uint32], vertex_count: int) -> IntArray:
    """Find the triangles that have the three vertices of another one, in any order; all of them, in their order.

    Sums of scrambled vertex numbers are compared, which do not depend on the order (splitmix64, Steele, Lea and Flood
    2014); only triangles with equal sums are compared in full.
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
        return np.zeros(0, dtype=np.int64)
    suspects = np.flatnonzero(np.isin(sums, repeated))
    _, number, uses = np.unique(np.sort(triangles[suspects], axis=1), axis=0, return_inverse=True, return_counts=True)
    return suspects[uses[number.reshape(-1)] > 1]


def find_faces_back_to_back(opposite: IntArray) -> IntArray:
    """Find the triangles that have the same single triangle beyond all three edges: a body without volume."""
    beyond = opposite.reshape(-1, 3) // 3
    return np.flatnonzero((beyond[:, 0] == beyond[:, 1]) & (beyond[:, 0] == beyond[:, 2]))
