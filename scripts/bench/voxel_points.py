"""Case of the points of voxels: a band of HU as a cloud, beside numpy three ways."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from registry import Job, case
from voxel_clusters import BANDS, compare_sides


@case(
    "voxel-points", "voxels of a band as a cloud, against numpy: nonzero and a matrix, one axis at a time, all voxels"
)
def measure_voxel_points(job: Job) -> dict[str, Any]:
    """Time clouds in host memory, from a volume that is on the device; every call makes mask, points and report.

    Ratios are of wall time and, with ``-cpu``, of processor time.  ``copy`` is one copy of the volume by numpy.  The
    matrix of all voxels, a product for each of them kept or not, is tried on one cloud alone.
    """
    import numpy as np

    from clrecon.operators.points.point_extraction import extract_points
    from clrecon.operators.resident.device_volume import DeviceVolume

    volume = job.input.volume()
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "points": {}, "worst_mm": {}}
    with DeviceVolume(volume, device=job.device) as resident:
        for name, lowest in BANDS.items():

            def ours(lowest: float = lowest) -> Any:
                return extract_points(resident, hu=(lowest, None))

            for peer, theirs in _peers(name, volume.voxels, volume.affine, lowest).items():
                compare_sides(job, f"{name}-{peer}", ours, theirs, figures)
            cloud = ours()
            figures["points"][name] = len(cloud)
            figures["worst_mm"][name] = float(np.abs(cloud.points - volume.ijk_to_lps(cloud.ijk)).max())
    return figures


def _peers(name: str, voxels: Any, affine: Any, lowest: float) -> dict[str, Callable[[], Any]]:
    import numpy as np

    steps = affine[:3].astype(np.float32)

    def nonzero() -> Any:
        k, j, i = np.nonzero(voxels >= lowest)
        places = np.stack([i, j, k, np.ones_like(i)], axis=1) @ affine.T
        return places[:, :3].astype(np.float32), voxels[k, j, i]

    def by_axis() -> Any:
        at = np.flatnonzero(voxels.reshape(-1) >= lowest)
        rows, i = np.divmod(at, voxels.shape[2])
        k, j = np.divmod(rows, voxels.shape[1])
        index = [part.astype(np.float32) for part in (i, j, k)]
        points = np.empty((len(at), 3), np.float32)
        for axis, (a, b, c, d) in enumerate(steps):
            points[:, axis] = index[0] * a + index[1] * b + (index[2] * c + d)
        return points

    def matrix() -> Any:
        whole = np.empty((*voxels.shape, 4), np.float32)
        k, j, i = np.ogrid[tuple(map(slice, voxels.shape))]
        for axis, (a, b, c, d) in enumerate(steps):
            whole[..., axis] = i * a + j * b + (k * c + d)
        whole[..., 3] = voxels
        return whole[voxels >= lowest]

    peers = {"nonzero": nonzero, "by-axis": by_axis, "copy": voxels.copy}
    return {**peers, "matrix": matrix} if name == "T1" else peers
