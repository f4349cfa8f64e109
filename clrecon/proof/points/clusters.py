"""Twins of grids over points and what their cells decide, of clusters (DBSCAN), and of what a volume says to points:
the voxels of a band of HU, what neighbouring slices have in common, gradients over half a voxel.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry import Volume


@dataclass(frozen=True, eq=False)
class GridTwin:
    """The arrays of a grid: names and contents are those of `clrecon.operators.points.grid.PointGrid`."""

    corner: NDArray[np.float32]
    shape: tuple[int, int, int]
    mask: NDArray[np.uint32]
    ranks: NDArray[np.uint32]
    starts: NDArray[np.uint32]
    order: NDArray[np.uint32]
    points: NDArray[np.float32]


def find_cells(points: NDArray[np.float32], corner: NDArray[np.float32], edge: np.float32) -> NDArray[np.int64]:
    """Return the cell (x, y, z) of each point, in the arithmetic of float32."""
    return ((points - corner) * (np.float32(1.0) / edge)).astype(np.int64)


def make_grid(points: NDArray[np.float32], edge: float) -> GridTwin:
    """Sort points, (n, 3) float32, mm from the base of a far cloud, by cubic cells; the edge is rounded to float32."""
    cell = np.float32(edge)
    corner = (points.min(axis=0).astype(np.float64) - 1e-3 * float(cell)).astype(np.float32)
    x, y, z = find_cells(points, corner, cell).T
    nx, ny, nz = (int(axis.max()) + 1 for axis in (x, y, z))
    words = -(-nx // 32)
    has_points = np.zeros((nz, ny, 32 * words), dtype=bool)
    has_points[z, y, x] = True
    bits = np.packbits(has_points.reshape(-1, 32), axis=1, bitorder="little")
    mask = bits.view("<u4").astype(np.uint32).reshape(nz, ny, words)
    counts = has_points.reshape(-1, 32).sum(axis=1)
    ranks = (np.cumsum(counts) - counts).astype(np.uint32).reshape(nz, ny, words)
    linear = (z * ny + y) * 32 * words + x
    order = np.argsort(linear, kind="stable")
    starts = np.append(np.unique(linear[order], return_index=True)[1], len(points))
    return GridTwin(corner, (nx, ny, nz), mask, ranks, starts.astype(np.uint32), order.astype(np.uint32), points[order])


def choose_points(points: NDArray[np.float32], spacing: float) -> NDArray[np.uint32]:
    """Return the point nearest to the mean of each cell with an edge of `spacing` mm, in the order of the cells."""
    grid = make_grid(points, spacing)
    chosen = []
    for begin, end in zip(grid.starts[:-1], grid.starts[1:], strict=True):
        places = grid.points[begin:end] - grid.points[begin]
        total = np.cumsum(places, axis=0, dtype=np.float32)[-1]
        dx, dy, dz = (np.float32(len(places)) * places - total).T
        chosen.append(grid.order[begin + np.argmin(dx * dx + dy * dy + dz * dz)])
    return np.array(chosen, dtype=np.uint32)


def grow_cells(
    points: NDArray[np.float32], edge: float, fewest: int, threshold: int, largest: bool
) -> NDArray[np.uint8]:
    """Say of each point: 0 kept, 1 in a cell with few points, 2 not reached by growth, 3 in a smaller component."""
    from scipy import ndimage

    grid = make_grid(points, edge)
    nx, ny, nz = grid.shape
    counts = np.zeros((nz, ny, nx), dtype=np.int64)
    x, y, z = find_cells(points, grid.corner, np.float32(edge)).T
    np.add.at(counts, (z, y, x), 1)
    parts, number = ndimage.label(counts >= fewest, np.ones((3, 3, 3), bool))
    kinds = np.full(number + 1, 2, dtype=np.uint8)
    kinds[np.unique(parts[counts >= max(threshold, fewest)])] = 0
    kinds[0] = 1
    if largest and (kinds == 0).any():
        cells = np.bincount(parts.reshape(-1), minlength=number + 1)
        point_counts = np.bincount(parts.reshape(-1), weights=counts.reshape(-1), minlength=number + 1)
        best = max(np.flatnonzero(kinds == 0), key=lambda part: (cells[part], point_counts[part], -part))
        kinds[(kinds == 0) & (np.arange(number + 1) != best)] = 3
    return kinds[parts[z, y, x]]


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
    cores = 1 + np.bincount(pairs.reshape(-1), minlength=n) >= min_samples
    first, second = pairs[cores[pairs].all(axis=1)].T
    _, parts = connected_components(coo_array((np.ones(len(first), bool), (first, second)), shape=(n, n)), False)
    # A component's number is the rank of its first core point.
    members = np.flatnonzero(cores)
    kinds, places = np.unique(parts[members], return_index=True)
    number = np.full(n + 1, -1, dtype=np.int32)
    number[kinds[np.argsort(places)]] = np.arange(len(kinds))
    labels[members] = number[parts[members]]
    lowest = np.full(n, n, dtype=np.int64)
    for core, neighbour in (pairs.T, pairs.T[::-1]):
        borders = cores[core] & ~cores[neighbour]
        np.minimum.at(lowest, neighbour[borders], labels[core[borders]])
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
    word_of = np.repeat(np.arange(words), np.diff(np.append(grid.ranks.reshape(-1), len(labels))))
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


def mark_shell(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark those of the marked voxels that have one of their six neighbours outside; beyond the ends all is outside."""
    from scipy.ndimage import binary_erosion

    return marked & ~binary_erosion(marked)


def extract_voxels(
    volume: Volume,
    low: float,
    high: float = np.inf,
    *,
    shell: bool = False,
    labels: NDArray[Any] | None = None,
    label: int = 0,
    paper: bool = False,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int64]]:
    """Return the centres, (n, 3), LPS mm, in the order k, j, i, the HU and the ijk of voxels from `low` to `high`, both
    included.

    shell: Only voxels with one of six neighbours outside; beyond the volume all is outside.
    labels: ndarray, shape (nk, nj, ni). Only voxels with `label`, or with any number but 0 where it is 0.
    paper: Every slice lies where the first one does.
    """
    marked = (volume.voxels >= low) & (volume.voxels <= high)
    if labels is not None:
        marked &= (labels == label) if label else (labels != 0)
    if shell:
        marked = mark_shell(marked)
    k, j, i = np.nonzero(marked)
    slice_origin = volume.slice_origins()[np.zeros_like(k) if paper else k]
    points = slice_origin + i[:, None] * volume.affine[:3, 0] + j[:, None] * volume.affine[:3, 1]
    return points, volume.voxels[marked].astype(np.float32), np.stack([i, j, k], axis=1)


def count_overlaps(inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Count the voxels of each slice, and those in common with the next one and the one after, as (3, nk)."""
    counts = np.zeros((3, len(inside)), np.int64)
    for apart in range(3):
        both = inside[: len(inside) - apart] & inside[apart:] if apart < len(inside) else inside[:0]
        counts[apart, : len(both)] = both.sum(axis=(1, 2))
    return counts


def _values(voxels: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the trilinear field of padded voxels at index coordinates of the volume."""
    from scipy.ndimage import map_coordinates

    inside = np.clip(places[:, ::-1].T + 1.0, 0.0, np.array(voxels.shape)[:, None] - 1.0)
    values: NDArray[np.float64] = map_coordinates(voxels, inside, order=1, mode="nearest")
    return values


def find_gradients(volume: Volume, points: NDArray[np.floating], outside: float) -> NDArray[np.float64]:
    """Return the gradient of a volume, surrounded by `outside`, at points: (n, 3), HU per mm, LPS."""
    voxels = np.pad(np.asarray(volume.voxels, dtype=np.float64), 1, constant_values=outside)
    places = volume.lps_to_ijk(points)
    origins, nk = volume.slice_origins(1), volume.shape_ijk[2]
    differences, ways = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
    for axis, half in enumerate(0.5 * np.eye(3)):
        differences[:, axis] = _values(voxels, places + half) - _values(voxels, places - half)
        ways[:, :, axis] = volume.affine[:3, axis]
    for row, k in enumerate(places[:, 2]):
        above, below = (
            np.array([np.interp(at, np.arange(-1, nk + 1), column) for column in origins.T])
            for at in (k + 0.5, k - 0.5)
        )
        ways[row, :, 2] = above - below
    gradients = np.zeros((len(points), 3))
    known = np.linalg.det(ways) != 0.0  # above and below all slices nothing changes along k
    gradients[known] = np.linalg.solve(ways[known].transpose(0, 2, 1), differences[known, :, None])[:, :, 0]
    return gradients
