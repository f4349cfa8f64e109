#!/usr/bin/env python3
"""Paper A's chain with other libraries: cloud_chain.py FOLDER OUT.ply LOW HIGH EPS MIN CLUSTERER [drop].

numpy, pydicom and Open3D in all; CLUSTERER is sklearn or open3d.  Slices are sorted by position, voxels of the HU band
are placed by the affine, with `drop` ghost slices are told by the overlap of neighbours, density clusters tell noise,
and the points in clusters are written.  Prints one JSON object with the number of points and seconds.
"""

from __future__ import annotations

import json
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pydicom


def read(folder: str) -> tuple[Any, Any]:
    """Return voxels (nk, nj, ni) in HU and the affine (4, 4), LPS mm."""
    paths = [path for path in Path(folder).iterdir() if path.is_file()]
    slices = [pydicom.dcmread(path) for path in paths]
    rows, columns = (np.array(slices[0].ImageOrientationPatient[n : n + 3], float) for n in (0, 3))
    normal = np.cross(rows, columns)
    slices.sort(key=lambda ds: np.dot(normal, ds.ImagePositionPatient))
    hu = np.stack(
        [(ds.pixel_array * int(ds.RescaleSlope) + int(ds.RescaleIntercept)).astype(np.int16) for ds in slices]
    )
    dj, di = map(float, slices[0].PixelSpacing)
    first, last = (np.array(slices[n].ImagePositionPatient, float) for n in (0, -1))
    affine = np.eye(4)
    affine[:3] = np.column_stack([rows * di, columns * dj, (last - first) / (len(slices) - 1), first])
    return hu, affine


def find_ghosts(mask: Any) -> list[int]:
    """Return slices that are less like their neighbours than these are like each other."""
    flat = mask.reshape(len(mask), -1)
    counts = flat.sum(axis=1)

    def dice(a: int, b: int) -> float:
        total = counts[a] + counts[b]
        return 2.0 * float(np.count_nonzero(flat[a] & flat[b])) / total if total else 1.0

    near = [dice(k, k + 1) for k in range(len(mask) - 1)]
    return [k for k in range(1, len(mask) - 1) if max(near[k - 1], near[k]) < 0.75 * dice(k - 1, k + 1)]


def label(points: Any, eps: float, fewest: int, clusterer: str) -> Any:
    """Return the cluster of each point, -1 for noise."""
    if clusterer == "sklearn":
        from sklearn.cluster import DBSCAN

        return DBSCAN(eps=eps, min_samples=fewest, algorithm="kd_tree", n_jobs=-1).fit_predict(points)
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    return np.asarray(cloud.cluster_dbscan(eps, fewest))


def write(path: str, points: Any, hu: Any, labels: Any) -> None:
    """Write a PLY with Open3D, HU and labels as attributes."""
    open3d: Any = import_module("open3d")  # its stubs know no arrays

    cloud = open3d.t.geometry.PointCloud()
    cloud.point["positions"] = open3d.core.Tensor(np.ascontiguousarray(points, np.float32))
    cloud.point["hu"] = open3d.core.Tensor(np.ascontiguousarray(hu[:, None], np.float32))
    cloud.point["label"] = open3d.core.Tensor(np.ascontiguousarray(labels[:, None], np.int32))
    open3d.t.io.write_point_cloud(path, cloud)


def main(
    folder: str, out: str, low: str, high: str, eps: str, fewest: str, clusterer: str, ghost_slices: str = ""
) -> None:
    """Run the chain."""
    start = time.perf_counter()
    voxels, affine = read(folder)
    mask = (voxels >= float(low)) & (voxels <= float(high))
    ghosts = find_ghosts(mask) if ghost_slices == "drop" else []
    mask[ghosts] = False
    kji = np.argwhere(mask)
    points = kji[:, ::-1] @ affine[:3, :3].T + affine[:3, 3]
    labels = label(points, float(eps), int(fewest), clusterer)
    kept = labels >= 0
    write(out, points[kept], voxels[tuple(kji[kept].T)], labels[kept])
    told = {"points": int(kept.sum()), "clusters": int(labels.max()) + 1, "ghosts": ghosts}
    print(json.dumps({**told, "seconds": time.perf_counter() - start}))


if __name__ == "__main__":
    main(*sys.argv[1:])
