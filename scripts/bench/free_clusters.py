"""Cases of points sorted by keys, and of clusters of free points by density."""

from __future__ import annotations

from typing import Any

from registry import Job, case
from wall_and_cpu import alternate_twice

EPS_MM = 1.2
MIN_SAMPLES = 6


@case("clusters-free", "DBSCAN of the voxel centres from the level on as free points, against Open3D")
def measure_voxel_clusters(job: Job) -> dict[str, Any]:
    """Time DBSCAN with eps 1.2 mm and 6 samples of the centres of all voxels of at least so many HU."""
    import numpy as np

    volume = job.input.volume()
    kji = np.argwhere(volume.voxels >= job.hu)
    return _measure(job, volume.ijk_to_lps(kji[:, ::-1]).astype(np.float32))


@case("clusters-surface", "DBSCAN of the vertices of the surface as free points, against Open3D")
def measure_surface_clusters(job: Job) -> dict[str, Any]:
    """Time DBSCAN with eps 1.2 mm and 6 samples of the vertices of the iso surface."""
    import numpy as np

    from clrecon.operators.surface.extract import extract_isosurface

    mesh = extract_isosurface(job.input.volume(), job.hu, device=job.device)
    return _measure(job, np.ascontiguousarray(mesh.vertices, dtype=np.float32))


def _measure(job: Job, points: Any) -> dict[str, Any]:
    import numpy as np
    import open3d

    from clrecon.operators.points.free_clusters import cluster_free_points

    vector = open3d.utility.Vector3dVector(points.astype(np.float64))
    cloud = open3d.geometry.PointCloud(vector)
    found = cluster_free_points(points, EPS_MM, MIN_SAMPLES, device=job.device)
    theirs = np.asarray(cloud.cluster_dbscan(EPS_MM, MIN_SAMPLES))
    sides = alternate_twice(
        lambda: cluster_free_points(points, EPS_MM, MIN_SAMPLES, device=job.device),
        lambda: cloud.cluster_dbscan(EPS_MM, MIN_SAMPLES),
        job.pairs,
        job.limit_s,
    )
    return {
        "ratios": {"open3d_wall": sides["wall"]["ratio"], "open3d_cpu": sides["cpu"]["ratio"]},
        "sides": sides,
        "points": len(points),
        "eps_mm": EPS_MM,
        "min_samples": MIN_SAMPLES,
        "clusters": {"clrecon": found.count, "open3d": int(theirs.max(initial=-1)) + 1},
        "noise_points": {"clrecon": int((found.labels < 0).sum()), "open3d": int((theirs < 0).sum())},
        "kernel_seconds": found.facts["kernel_seconds"],
    }


@case("radix-sort", "stable sort of keys of 21 bits, one for each voxel from the level on, against numpy.argsort")
def measure_sort(job: Job) -> dict[str, Any]:
    """Time the order of random keys, on the device from key to order; numpy's also with memory of its own."""
    import numpy as np

    from clrecon.opencl import upload, wait
    from clrecon.operators.primitives.scan import radix_sort

    n = int((job.input.volume().voxels >= job.hu).sum())
    keys = np.random.default_rng(1).integers(0, 2**21, n, dtype=np.uint32)
    keys_d = upload(job.device, keys)

    def sort() -> None:
        made = radix_sort(job.device, keys_d, n, bits=21)
        wait(job.device)
        del made

    sides = alternate_twice(sort, lambda: np.argsort(keys, kind="stable"), job.pairs, job.limit_s)
    return {
        "ratios": {"numpy_wall": sides["wall"]["ratio"], "numpy_cpu": sides["cpu"]["ratio"]},
        "sides": sides,
        "keys": n,
    }
