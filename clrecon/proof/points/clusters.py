"""Twins of clusters of points: DBSCAN on points in mm, whatever their order, and its passes on the device."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.proof.points.grid import GridTwin, find_cells


def cluster_points(points: ArrayLike, eps: float, min_samples: int) -> tuple[int, NDArray[np.int32], NDArray[np.bool_]]:
    """Cluster points by DBSCAN (Ester, Kriegel, Sander and Xu 1996) in float64.

    Neighbours of a point are all points within ``eps * (1 + 1e-6)``, itself included.  A point with at least
    `min_samples` neighbours is a core point.  Core points that are neighbours are in one cluster.

    Return the number of clusters, labels and core points.  Clusters are numbered by their first core point.  Other
    neighbours of core points take the lowest number among these; all further points are noise, -1.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    n = len(points)
    labels = np.full(n, -1, dtype=np.int32)
    if n == 0:
        return 0, labels, np.zeros(0, dtype=bool)
    pairs = cKDTree(points).query_pairs(eps * (1.0 + 1e-6), output_type="ndarray")
    counts = 1 + np.bincount(pairs.reshape(-1), minlength=n)
    cores = counts >= min_samples
    first, second = pairs[cores[pairs].all(axis=1)].T
    _, parts = connected_components(coo_array((np.ones(len(first), bool), (first, second)), shape=(n, n)), False)
    # A component's number is the rank of its first core point.
    members = np.flatnonzero(cores)
    kinds, places = np.unique(parts[members], return_index=True)
    number = np.full(n + 1, -1, dtype=np.int32)
    number[kinds[np.argsort(places)]] = np.arange(len(kinds))
    labels[members] = number[parts[members]]
    lowest = np.full(n, n, dtype=np.int64)
    for core, other in (pairs.T, pairs.T[::-1]):
        borders = cores[core] & ~cores[other]
        np.minimum.at(lowest, other[borders], labels[core[borders]])
    labels[lowest < n] = lowest[lowest < n]
    return len(kinds), labels, cores


NO_CELL = np.uint32(0xFFFFFFFF)
"""Label of a cell without core points, and root of a word without core cells."""

SEVERAL_ROOTS = np.uint32(0xFFFFFFFE)
"""Root of a word whose core cells have several."""


def join_chunks(grid: GridTwin, cores: NDArray[np.bool_], reach: float, per_chunk: int) -> NDArray[np.uint32]:
    """Label core cells, (cells,), with the least cell linked in their chunk of `per_chunk`; else `NO_CELL`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cells = len(grid.starts) - 1
    starts = grid.starts.astype(np.int64)
    cell_of = np.repeat(np.arange(cells), starts[1:] - starts[:-1])
    members = np.flatnonzero(cores)
    pairs = cKDTree(grid.points[members].astype(np.float64)).query_pairs(reach, output_type="ndarray")
    a, b = cell_of[members][pairs].T
    same = a // per_chunk == b // per_chunk
    links = coo_array((np.ones(int(same.sum()), bool), (a[same], b[same])), shape=(cells, cells))
    _, parts = connected_components(links, False)
    least = np.unique(parts, return_index=True)[1]
    labels = np.full(cells, NO_CELL, np.uint32)
    labels[cell_of[members]] = least[parts[cell_of[members]]]
    return labels


def note_words(grid: GridTwin, labels: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the root of the core cells of each word of the mask, (nz * ny * words,) uint32."""
    words = grid.ranks.size
    counts = np.diff(np.append(grid.ranks.reshape(-1), len(labels)))
    word_of = np.repeat(np.arange(words), counts)
    is_core = labels != NO_CELL
    low, high = np.full(words, NO_CELL), np.zeros(words, np.uint32)
    np.minimum.at(low, word_of[is_core], labels[is_core])
    np.maximum.at(high, word_of[is_core], labels[is_core])
    return np.where((low != NO_CELL) & (low != high), SEVERAL_ROOTS, low)


def count_pairs(grid: GridTwin, edge: float, min_samples: int) -> NDArray[np.float64]:
    """Return the most pairs of points that may have to be compared for each cell with points, (cells,)."""
    nx, ny, nz = grid.shape
    counts = np.diff(grid.starts.astype(np.int64))
    x, y, z = find_cells(grid.points[grid.starts[:-1]], grid.corner, np.float32(edge)).T
    around = np.zeros((nz + 4, ny + 4, nx + 4))
    around[z + 2, y + 2, x + 2] = counts
    offsets = list(product(range(-2, 3), repeat=3))
    sums = {offset: around[z + 2 + offset[0], y + 2 + offset[1], x + 2 + offset[2]] for offset in offsets}
    after = sum(sums[offset] for offset in offsets if offset > (0, 0, 0))
    return np.asarray(counts * (after + np.where(counts < min_samples, sum(sums.values()), 0)))
