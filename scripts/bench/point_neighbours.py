"""Cases of clouds of points: nearest points, normals, the bilateral filter and outliers, beside CPU libraries.

The clouds come from the input: voxel centres from 500, 200 and 60 HU up, and the vertices of the surface at the iso
value.  Both sides begin with an array of points and end with arrays in memory of the computer; the search structure is
built every time.  Each ratio is given for wall and for processor seconds (names that end in ``_cpu``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from measure import alternate, summarise
from registry import Job, case

K = 16
THREADS = 2
CLOUDS = {"voxels500": 500.0, "surface": None, "voxels200": 200.0, "voxels60": 60.0}


def make_clouds(job: Job, *names: str) -> dict[str, Any]:
    """Make clouds of the input: (n, 3) float32 in LPS mm, by name."""
    import numpy as np

    from clrecon.operators.surface.extract import extract_isosurface

    volume, clouds = job.input.volume(), {}
    for name in names:
        level = CLOUDS[name]
        if level is None:
            clouds[name] = extract_isosurface(volume, job.hu, device=job.device).vertices
            continue
        k, j, i = np.nonzero(volume.voxels >= level)
        clouds[name] = volume.ijk_to_lps(np.stack([i, j, k], axis=1)).astype(np.float32)
    return {name: points for name, points in clouds.items() if len(points) >= 1000}


def compare(job: Job, clouds: dict[str, Any], peers: dict[str, Any], ours: Callable[[Any], Any]) -> dict[str, Any]:
    """Time `ours` and each peer on each cloud, pair by pair; peers are functions of the points."""
    figures: dict[str, Any] = {
        "ratios": {},
        "sides": {},
        "points": {name: len(points) for name, points in clouds.items()},
    }
    for cloud, points in clouds.items():
        for name, peer in peers.items():
            spent: dict[str, list[float]] = {"own": [], "peer": []}
            own_s, peer_s = alternate(
                lambda points=points, kept=spent["own"]: _run(lambda: ours(points), kept),  # type: ignore[misc]
                lambda points=points, peer=peer, kept=spent["peer"]: _run(lambda: peer(points), kept),  # type: ignore[misc]
                job.pairs,
                limit_s=job.limit_s / (len(peers) * len(clouds)),
            )
            for suffix, one, other in (
                ("", own_s, peer_s),
                ("_cpu", spent["own"][-len(own_s) :], spent["peer"][-len(peer_s) :]),
            ):
                key = f"{cloud}_{name}{suffix}"
                figures["sides"][key] = summarise(one, other)
                figures["ratios"][key] = figures["sides"][key]["ratio"]
    return figures


def _run(work: Callable[[], Any], processor_s: list[float]) -> float:
    """Run once and return wall seconds; the processor seconds are appended."""
    start, before = time.perf_counter(), time.process_time()
    work()
    processor_s.append(time.process_time() - before)
    return time.perf_counter() - start


@case("point-neighbours", "16 nearest points of every point, against nanoflann and scipy's tree with two threads")
def measure_neighbours(job: Job) -> dict[str, Any]:
    """Time the search with its structure, and count rows of distances that differ from the tree's."""
    import napf
    import numpy as np
    from scipy.spatial import cKDTree

    from clrecon.operators.points.neighbours import find_neighbours

    clouds = make_clouds(job, *CLOUDS)
    peers = {
        "nanoflann": lambda points: napf.KDT(points, metric=2, nthread=THREADS).knn_search(points, K, THREADS),
        "scipy": lambda points: cKDTree(points).query(points, K, workers=THREADS),
    }
    figures = compare(job, clouds, peers, lambda points: find_neighbours(points, K, device=job.device))
    first = next(iter(clouds.values()))
    found, exact = find_neighbours(first, K, device=job.device), cKDTree(first).query(first, K)[0]
    steps = np.abs(found.distances - exact) / np.spacing(np.maximum(exact, 1e-3).astype(np.float32))
    return {**figures, "largest_difference_in_steps_of_float32": float(steps.max())}


@case("point-normals", "normals by 16 neighbours without orientation, against small_gicp and Open3D")
def measure_normals(job: Job) -> dict[str, Any]:
    """Time search and normals; all sides begin with an array of points."""
    import numpy as np
    import open3d
    import small_gicp

    from clrecon.operators.points.normals import estimate_normals
    from clrecon.points.cloud import PointCloud

    def with_open3d(points: Any) -> Any:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(K))
        return np.asarray(cloud.normals)

    def with_small_gicp(points: Any) -> Any:
        cloud = small_gicp.PointCloud(points.astype(np.float64))
        small_gicp.estimate_normals(cloud, num_neighbors=K, num_threads=THREADS)
        return cloud.normals()

    clouds = make_clouds(job, "voxels500", "surface", "voxels200")
    peers = {"small_gicp": with_small_gicp, "open3d": with_open3d}
    return compare(job, clouds, peers, lambda points: estimate_normals(PointCloud(points), K, device=job.device))


@case("point-filter", "neighbours, normals and bilateral filter of points, against scipy and numpy in float64")
def measure_filter(job: Job) -> dict[str, Any]:
    """Time the whole filter, and the kernel of the filter alone beside numpy with neighbours and normals given."""
    import numpy as np
    from scipy.spatial import cKDTree

    from clrecon.operators.points.denoising import denoise_points
    from clrecon.points.cloud import PointCloud
    from clrecon.proof.points.neighbours import denoise_points as filter_twin
    from clrecon.proof.points.neighbours import principal_axes

    def with_numpy(points: Any) -> Any:
        _, indices = cKDTree(points).query(points, K, workers=THREADS)
        axes, _ = principal_axes(points, indices)
        return filter_twin(points, axes, indices)

    clouds = make_clouds(job, "surface", "voxels200")
    figures = compare(
        job,
        clouds,
        {"scipy_numpy": with_numpy},
        lambda points: denoise_points(PointCloud(points), K, device=job.device),
    )
    for name, points in clouds.items():
        _, indices = cKDTree(points).query(points, K, workers=THREADS)
        axes, _ = principal_axes(points, indices)
        own = [_kernel_seconds(points, job) for _ in range(job.pairs)]
        for kind in (np.float64, np.float32):
            peer = [_filter_seconds(kind, points, axes, indices) for _ in range(3)]
            key = f"{name}_alone_numpy_{np.dtype(kind).name}"
            figures["sides"][key] = summarise(own[: len(peer)], peer)
            figures["ratios"][key] = figures["sides"][key]["ratio"]
    return figures


def _kernel_seconds(points: Any, job: Job) -> float:
    """Return the device's seconds of the kernel filter_points alone."""
    from clrecon.operators.points.denoising import denoise_points
    from clrecon.points.cloud import PointCloud

    seconds: float = denoise_points(PointCloud(points), K, device=job.device).facts["kernel_seconds"]["filter_points"]
    return seconds


def _filter_seconds(kind: Any, points: Any, axes: Any, indices: Any) -> float:
    return _run(lambda: _filter_as(kind, points, axes, indices), [])


def _filter_as(kind: Any, points: Any, axes: Any, indices: Any) -> Any:
    """Filter with numpy in one type of numbers, neighbours and normals given."""
    import numpy as np

    points, axes = points.astype(kind), axes.astype(kind)
    away = points[:, None] - points[indices]
    heights = np.einsum("nki,ni->nk", away, axes)
    squares = np.einsum("nki,nki->nk", away, away)
    spread = heights.std(axis=1)
    spread = np.maximum(kind(2.0) * spread, kind(1e-6))
    weights = np.exp(-squares / (2 * squares[:, -1:]) - heights**2 / (2 * spread[:, None] ** 2))
    return points - ((weights * heights).sum(axis=1) / weights.sum(axis=1))[:, None] * axes


@case("point-outliers", "statistical outliers by 16 neighbours, against Open3D")
def measure_outliers(job: Job) -> dict[str, Any]:
    """Time the removal, and count the points on which both sides decide differently."""
    import numpy as np
    import open3d

    from clrecon.operators.points.denoising import remove_outliers
    from clrecon.points.cloud import PointCloud

    def with_open3d(points: Any) -> Any:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
        return cloud.remove_statistical_outlier(K, 2.0)[1]

    clouds = make_clouds(job, "voxels200")
    figures = compare(
        job,
        clouds,
        {"open3d": with_open3d},
        lambda points: remove_outliers(PointCloud(points), K, 2.0, device=job.device),
    )
    differing = {}
    for name, points in clouds.items():
        kept = np.zeros(len(points), bool)
        kept[np.asarray(with_open3d(points))] = True
        removed = remove_outliers(PointCloud(points), K, 2.0, device=job.device).removed.astype(bool)
        differing[name] = int(np.count_nonzero(kept == removed))
    return {**figures, "decided_differently": differing}
