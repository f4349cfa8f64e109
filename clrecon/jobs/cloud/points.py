"""The points of a cloud job, from a scan or a file, and the steps on them while the scan is on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from clrecon.errors import ClreconError, DeviceError
from clrecon.jobs.cloud.chain import run_steps
from clrecon.jobs.cloud.ghosts import drop_ghosts, find_ghosts, warn_of_ghosts
from clrecon.jobs.cloud.settings import CloudSettings
from clrecon.jobs.cloud.trail import Trail
from clrecon.jobs.mesh.presets import DEFAULT_PRESET, find_preset
from clrecon.system.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.opencl import Device
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.points import PointCloud
    from clrecon.points.ghost_slices import GhostSlices


def take_points(
    subject: Volume | PointCloud,
    labels: LabelMap | None,
    device: Device,
    settings: CloudSettings,
    progress: Progress,
    ghosts: GhostSlices | None = None,
) -> Trail:
    """Make the cloud of a volume, or take one that was read, and run the steps on it.

    ghosts: Of the scan before it was masked; None: they are looked for in the volume.
    """
    from clrecon.geometry import Volume
    from clrecon.operators.resident.device_volume import DeviceVolume

    if not isinstance(subject, Volume):
        trail = Trail(subject)
        run_steps(trail, settings, device, None, progress)
        return trail
    with DeviceVolume(subject, device=device, memory=settings.memory) as resident:
        if ghosts is None:
            ghosts = find_ghosts(resident, iso_value_of(settings), settings, progress)
        trail = _extract(resident, labels, settings, progress)
        if settings.ghost_slices == "drop":
            drop_ghosts(trail, ghosts, subject)
        else:
            warn_of_ghosts(trail, ghosts)
        run_steps(trail, settings, device, resident, progress)
    return trail


def _extract(resident: DeviceVolume, labels: LabelMap | None, settings: CloudSettings, progress: Progress) -> Trail:
    from clrecon.operators.points.point_extraction import extract_points

    began = Trail.clock()
    what: dict[str, Any] = {"hu": settings.hu} if settings.is_band else {"iso_value": iso_value_of(settings)}
    cloud = extract_points(
        resident, **what, kind=settings.kind, labels=labels, label=settings.label, paper=settings.paper,
        progress=progress,
    )  # fmt: skip
    return Trail(cloud, began)


def iso_value_of(settings: CloudSettings) -> float:
    """Return the iso value that was given, or that of the default preset of meshes."""
    if settings.hu is None or settings.is_band:
        return find_preset(DEFAULT_PRESET).iso_value
    assert not isinstance(settings.hu, (tuple, list))
    return float(settings.hu)  # type: ignore[arg-type]


def prepare_chain(device: Device, settings: CloudSettings, is_cloud: bool) -> None:
    """Build the kernels by running all steps on a cube of a few voxels; what it comes to does not matter."""
    import numpy as np

    from clrecon.geometry import Volume
    from clrecon.points import PointCloud

    k, j, i = np.indices((12, 12, 12))
    voxels = (3000 - 600 * np.abs([i - 5, j - 5, k - 5]).max(axis=0)).astype(np.int16)
    subject: Volume | PointCloud = Volume(voxels, np.eye(4))
    if is_cloud:
        subject = PointCloud(np.argwhere(voxels >= 0).astype(np.float32))
    try:
        take_points(subject, None, device, settings.for_trial(), ignore_progress)
    except DeviceError:
        raise
    except ClreconError:
        pass  # a rule that leaves nothing of a cube
