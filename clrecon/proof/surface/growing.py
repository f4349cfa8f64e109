"""Twin of `clrecon.operators.surface.growing`: the paper's frontier over cells, and components of active cells.

Cells (k, j, i) have the samples (k, j, i) to (k + 1, j + 1, i + 1) as their corners.

References
----------
Liu et al. 2019, "Vertebrae CT Images 3D Reconstruction with Improve Marching Cubes Algorithm", J. Harbin Inst. Technol.
(New Series) 26(6): section 3.1, growing over cells through faces with mixed corner states.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray


def _corners(inside: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    gk, gj, gi = inside.shape
    return [inside[z : gk - 1 + z, y : gj - 1 + y, x : gi - 1 + x] for z, y, x in product((0, 1), repeat=3)]


def find_active(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the cells whose corners are neither all inside nor all outside, shape (gk - 1, gj - 1, gi - 1)."""
    corners = _corners(inside)
    return np.logical_or.reduce(corners) & ~np.logical_and.reduce(corners)


def find_mixed(inside: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    """Mark mixed faces between each cell and the next along an axis: cases (a), (b) and (c) of the paper."""
    inner = [slice(None)] * 3
    inner[axis] = slice(1, -1)
    faces = inside[tuple(inner)]
    others = [n for n in range(3) if n != axis]
    count = np.zeros([n - 1 if at in others else n for at, n in enumerate(faces.shape)], np.int64)
    for first in (0, 1):
        for second in (0, 1):
            part = [slice(None)] * 3
            part[others[0]] = slice(first, faces.shape[others[0]] - 1 + first)
            part[others[1]] = slice(second, faces.shape[others[1]] - 1 + second)
            count += faces[tuple(part)]
    return (count > 0) & (count < 4)


@dataclass(frozen=True)
class Frontier:
    """The cells that `grow_cells` entered, (gk - 1, gj - 1, gi - 1), and the number of all that it looked at."""

    cells: NDArray[np.bool_]
    visited: int


def grow_cells(inside: NDArray[np.bool_], seeds: Iterable[tuple[int, int, int]]) -> Frontier:
    """Grow from active seed cells (k, j, i) through mixed faces, one cell after the other, as the paper does."""
    active = find_active(inside)
    mixed = [find_mixed(inside, axis) for axis in range(3)]
    entered, looked_at = np.zeros(active.shape, bool), np.zeros(active.shape, bool)
    queue: deque[tuple[int, ...]] = deque()
    for seed in seeds:
        if active[seed] and not entered[seed]:
            entered[seed] = looked_at[seed] = True
            queue.append(tuple(seed))
    while queue:
        cell = queue.popleft()
        for axis in range(3):
            for step in (-1, 1):
                next_cell = tuple(n + step * (at == axis) for at, n in enumerate(cell))
                if not 0 <= next_cell[axis] < active.shape[axis]:
                    continue
                looked_at[next_cell] = True
                face = min(cell, next_cell)
                if mixed[axis][face] and not entered[next_cell]:
                    entered[next_cell] = True
                    queue.append(next_cell)
    return Frontier(entered, int(looked_at.sum()))


def label_cells(inside: NDArray[np.bool_]) -> tuple[int, NDArray[np.int64]]:
    """Number the components of active cells that mixed faces join, in the order of their first cell; -1: not active."""
    import scipy.sparse
    from scipy.sparse.csgraph import connected_components

    active = find_active(inside)
    nodes = np.cumsum(active).reshape(active.shape) - 1
    links: list[NDArray[Any]] = []
    for axis in range(3):
        mixed = find_mixed(inside, axis)
        first, second = [slice(None)] * 3, [slice(None)] * 3
        first[axis], second[axis] = slice(0, -1), slice(1, None)
        links.append(np.stack([nodes[tuple(first)][mixed], nodes[tuple(second)][mixed]]))
    pairs, total = np.concatenate(links, axis=1), int(active.sum())
    graph = scipy.sparse.coo_array((np.ones(pairs.shape[1], bool), (pairs[0], pairs[1])), shape=(total, total))
    count, of_node = connected_components(graph, directed=False)
    firsts = np.full(count, total)
    np.minimum.at(firsts, of_node, np.arange(total))
    rank = np.argsort(np.argsort(firsts))
    numbers = np.full(active.shape, -1, np.int64)
    numbers[active] = rank[of_node]
    return int(count), numbers


def count_visited(cells: NDArray[np.bool_]) -> int:
    """Count the cells that are grown or share a face with one that is."""
    visited = cells.copy()
    for axis in range(3):
        for target, source in ((slice(1, None), slice(0, -1)), (slice(0, -1), slice(1, None))):
            to, by = [slice(None)] * 3, [slice(None)] * 3
            to[axis], by[axis] = target, source
            visited[tuple(to)] |= cells[tuple(by)]
    return int(visited.sum())


def find_seeded(
    inside: NDArray[np.bool_], seeds: NDArray[np.bool_], numbers: NDArray[np.int64], count: int
) -> NDArray[np.bool_]:
    """Mark the components with a cell that has an inside corner among seeds, which are voxels (nk, nj, ni)."""
    marked = np.pad(seeds, (inside.shape[0] - seeds.shape[0]) // 2) & inside
    seeded = np.logical_or.reduce(_corners(marked)) & (numbers >= 0)
    return np.isin(np.arange(count), numbers[seeded])


def choose_largest(sizes: NDArray[np.integer], share: float) -> NDArray[np.bool_]:
    """Mark the components with at least `share` of the cells of the largest."""
    return sizes >= share * sizes.max(initial=0)
