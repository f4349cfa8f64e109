"""Twins of the passes of `clrecon.operators.points.free_clusters`; the twin of the whole is
`clrecon.reference.points.clusters`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.reference.points.grid import GridTwin, find_cells

NO_CELL = np.uint32(0xFFFFFFFF)
"""Label of a cell without core points, and root of a word without core cells."""

SEVERAL_ROOTS = np.uint32(0xFFFFFFFE)
"""Root of a word whose core cells have several."""


def join_chunks(grid: GridTwin, cores: NDArray[np.bool_], reach: float, per_chunk: int) -> NDArray[np.uint32]:
    """Label the core cells: the least cell of the same chunk that each is linked with, by cells of that chunk.

    cores: ndarray, shape (n,), bool. Core points in the sorted order.
    reach: Largest distance of neighbours in mm.
    per_chunk: Cells of a chunk.

    Returns: ndarray, shape (cells,), uint32. `NO_CELL` for cells without core points.
    """
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
    offsets = [(dz, dy, dx) for dz in range(-2, 3) for dy in range(-2, 3) for dx in range(-2, 3)]
    sums = {offset: around[z + 2 + offset[0], y + 2 + offset[1], x + 2 + offset[2]] for offset in offsets}
    after = sum(sums[offset] for offset in offsets if offset > (0, 0, 0))
    return np.asarray(counts * (after + np.where(counts < min_samples, sum(sums.values()), 0)))
