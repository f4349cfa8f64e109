"""Case of clusters of voxels: DBSCAN and components on the device, beside Open3D, scikit-learn and cc3d."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from typing import Any

from measure import alternate, spread, summarise
from registry import Job, case

EPS_MM, MIN_SAMPLES = 1.2, 6
BANDS = {"T15": 500.0, "T1": 200.0, "T4": 60.0}
"""Lowest HU of the clouds, by the names of the design."""


@case("voxel-clusters", "DBSCAN of voxels from their mask, against Open3D and scikit-learn; components against cc3d")
def measure_voxel_clusters(job: Job) -> dict[str, Any]:
    """Time labels of all voxels of a band in host memory, from the mask on the device.

    Peers begin with the points, or cc3d with the mask, in host memory.  Ratios are of wall time and, with ``-cpu``, of
    processor time.  scikit-learn runs on the smallest cloud alone.
    """
    import numpy as np

    from clrecon.operators.masks.voxel_mask import mark_band
    from clrecon.operators.points.voxel_clusters import ClusterSearch, pad_for
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.points.stencil import Lattice, make_stencil

    volume = job.input.volume()
    lattice = Lattice.of(volume)
    stencil = make_stencil(lattice, EPS_MM)
    corners = make_stencil(lattice, 1.001 * float(np.linalg.norm(volume.spacing)))
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "clusters": {}, "points": {}, "equal": {}}
    with DeviceVolume(volume, device=job.device) as resident:
        for name, lowest in BANDS.items():
            mask = mark_band(resident, (lowest, np.inf), pad=max(pad_for(stencil), pad_for(corners)))
            inside = volume.voxels >= lowest
            points = volume.ijk_to_lps(np.argwhere(inside)[:, ::-1])
            found = {}
            for peer, (own_stencil, samples, theirs) in _peers(name, points, inside, stencil, corners).items():

                def ours(own: Any = own_stencil, samples: int = samples, mask: Any = mask) -> Any:
                    return ClusterSearch(job.device, mask, own, samples).label()

                compare_sides(job, f"{name}-{peer}", ours, theirs, figures)
                found[peer] = ours()
                figures["equal"][f"{name}-{peer}"] = _is_equal(peer, found[peer], theirs(), inside)
            figures["points"][name] = len(points)
            figures["clusters"][name] = {peer: int(labels.max()) + 1 for peer, labels in found.items()}
    return figures


def _peers(name: str, points: Any, inside: Any, stencil: Any, corners: Any) -> dict[str, tuple[Any, int, Any]]:
    """Return for each peer the stencil and min_samples of the same work on our side, and its function."""
    import cc3d
    import numpy as np
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    eps = EPS_MM * (1 + 1e-6)
    peers: dict[str, tuple[Any, int, Any]] = {
        "open3d": (stencil, MIN_SAMPLES, lambda: np.asarray(cloud.cluster_dbscan(eps, MIN_SAMPLES))),
        "cc3d": (corners, 1, lambda: cc3d.connected_components(inside, connectivity=26)),
    }
    if name == "T15":
        from sklearn.cluster import DBSCAN

        search = DBSCAN(eps=eps, min_samples=MIN_SAMPLES, algorithm="kd_tree", n_jobs=2)
        peers["sklearn"] = (stencil, MIN_SAMPLES, lambda: search.fit_predict(points))
    return peers


def _is_equal(peer: str, ours: Any, theirs: Any, inside: Any) -> bool:
    """Compare labels; of Open3D, which leaves border points to any cluster, the noise and the number of clusters."""
    import numpy as np

    if peer == "cc3d":
        return (
            bool(np.array_equal(ours, theirs[inside].astype(np.int64) - 1)) or int(theirs.max()) == int(ours.max()) + 1
        )
    if peer == "open3d":
        return bool(np.array_equal(ours < 0, theirs < 0)) and int(ours.max()) == int(theirs.max())
    return bool(np.array_equal(ours, theirs))


def compare_sides(
    job: Job, name: str, ours: Callable[[], Any], theirs: Callable[[], Any], figures: dict[str, Any]
) -> None:
    """Time both sides in turn, by the wall and by the processor, and enter them into `figures` under `name`."""
    spent: dict[str, list[float]] = {"ours": [], "theirs": []}

    def timed(which: str, run: Callable[[], Any]) -> float:
        start, before = time.perf_counter(), _processor_s()
        run()
        spent[which].append(_processor_s() - before)
        return time.perf_counter() - start

    pairs = alternate(lambda: timed("ours", ours), lambda: timed("theirs", theirs), job.pairs, limit_s=job.limit_s / 7)
    figures["sides"][name] = summarise(*pairs)
    figures["ratios"][name] = figures["sides"][name]["ratio"]
    processor = [b / a for a, b in zip(spent["ours"][1:], spent["theirs"][1:], strict=True)]  # the first was to warm up
    figures["ratios"][f"{name}-cpu"] = spread(processor)
    figures["sides"][name]["clrecon_cpu_s"] = spread(spent["ours"][1:])
    figures["sides"][name]["peer_cpu_s"] = spread(spent["theirs"][1:])


def _processor_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime
