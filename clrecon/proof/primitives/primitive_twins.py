"""Twins of `clrecon.operators.primitives`: scans, compaction, sorting and components."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def exclusive_scan(counts: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], int]:
    """Return the sum of all counts before each element, (n,) uint32, and the total."""
    sums = np.cumsum(counts, dtype=np.uint64)
    total = int(sums[-1]) if sums.size else 0
    return (sums - counts).astype(np.uint32), total


def compact(mask: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the positions of the set bits of a bit mask in ascending order; bit b of word w is position 32 w + b."""
    bits = mask[:, None] >> np.arange(32, dtype=np.uint32) & 1
    return np.flatnonzero(bits).astype(np.uint32)


def radix_sort(keys: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Sort keys, equal ones in the order of the input.

    Returns:
    keys: ndarray, shape (n,), uint32, ascending
    values: ndarray, shape (n,), uint32. Number of each of them in the input.
    """
    order = np.argsort(keys, kind="stable")
    return keys[order], order.astype(np.uint32)


def label_components(triangles: NDArray[np.uint32], vertex_count: int) -> tuple[int, NDArray[np.int64]]:
    """Number the components of a mesh by label propagation.

    Every vertex takes the smallest label in any of its triangles, until no label changes: the label of a component
    is then its smallest vertex.

    triangles: ndarray, shape (m, 3), uint32

    Returns:
    count: Number of components, not counting vertices that no triangle uses.
    labels: ndarray, shape (vertex_count,), int64. Component of each vertex, numbered in order of the first vertex; -1
        for unused vertices.
    """
    roots = np.arange(vertex_count)
    while True:
        before = roots.copy()
        least = roots[triangles].min(axis=1)
        for corner in range(3):
            np.minimum.at(roots, triangles[:, corner], least)
        if np.array_equal(roots, before):
            break
    used = np.zeros(vertex_count, dtype=bool)
    used[triangles.reshape(-1)] = True
    is_root = used & (roots == np.arange(vertex_count))
    number = np.cumsum(is_root) - 1
    return int(np.count_nonzero(is_root)), np.where(used, number[roots], -1).astype(np.int64)
