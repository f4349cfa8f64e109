"""Twin of `clrecon.operators.points.voxel_clusters`: DBSCAN on points in mm, whatever their order."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def cluster_points(points: ArrayLike, eps: float, min_samples: int) -> tuple[int, NDArray[np.int32], NDArray[np.bool_]]:
    """Cluster points by DBSCAN in float64.

    Neighbours of a point are all points within ``eps * (1 + 1e-6)``, itself included.  A point with at least
    `min_samples` neighbours is a core point.  Core points that are neighbours are in one cluster.

    points: array_like, shape (n, 3). mm.
    eps: mm.

    Returns:
    count: Number of clusters.
    labels: ndarray, shape (n,), int32. Clusters are numbered by their first core point.  Other neighbours of core
        points take the lowest number among these; all further points are noise, -1.
    cores: ndarray, shape (n,), bool

    References
    ----------
    Ester, Kriegel, Sander and Xu 1996.
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
