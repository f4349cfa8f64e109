"""Kernels that a view needs soon, built before they are waited for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.mesh import Mesh
from clrecon.opencl import Device
from clrecon.operators.rays.scene import ScenePictures
from clrecon.operators.rays.volume_renderer import VolumeRenderer
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.extract import SurfaceExtractor
from clrecon.rendering.pictures.object_looks import MeshLook
from clrecon.rendering.pictures.styles import PlaneCut, Style, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.system.progress import Progress, ignore_progress
from clrecon.viewer.model.objects import ShownMesh, ShownObject, ShownScan
from clrecon.viewer.model.parts import find_clusters

SIDE = 20
"""Voxels along each side of the volume by which kernels are built."""

PICTURE = (8, 8)


def warm_kernels(objects: Sequence[ShownObject], device: Device, progress: Progress | None = None) -> None:
    """Build what the first pictures, the slider and the parts need, on a small volume of each type of voxels.

    Views are not kept waiting: nothing of theirs is used but the device.
    """
    tell = progress or ignore_progress
    done = set()
    for each in objects:
        if isinstance(each, ShownScan):
            kind = each.volume.voxels.dtype, each.volume.uneven
            if kind not in done:
                done.add(kind)
                _warm_scan(_ball(*kind), device, tell)
    if any(isinstance(each, ShownMesh) for each in objects):
        _warm_mesh(device)


def _ball(dtype: np.dtype, uneven: bool) -> Volume:
    """Return a ball of 1000 HU in air."""
    places = np.indices((SIDE,) * 3) - 0.5 * (SIDE - 1)
    inside = (places**2).sum(axis=0) < (0.3 * SIDE) ** 2
    voxels = np.where(inside, 1000, -1000).astype(dtype)
    if not uneven:
        return Volume(voxels, np.eye(4))
    heights = np.arange(SIDE, dtype=np.float64) + 0.2 * (np.arange(SIDE) % 2)
    positions = np.stack([np.zeros(SIDE), np.zeros(SIDE), heights], axis=1)
    return Volume(voxels, np.eye(4), slice_positions=positions)


def _warm_scan(volume: Volume, device: Device, tell: Progress) -> None:
    camera = Camera.fit(volume, "anterior", size=PICTURE)
    labels = LabelMap((volume.voxels > 0).astype(np.uint8), np.eye(4))
    with DeviceVolume(volume, device=device) as resident, VolumeRenderer(resident) as renderer:
        styles: list[Style] = [
            SurfaceLook(200.0), PlaneCut(), VolumeLook("bone", jitter=True),
            SurfaceLook(200.0, labels=labels), VolumeLook("bone", jitter=True, labels=labels), PlaneCut(labels=labels),
        ]  # fmt: skip
        for style in styles[:3]:
            tell("build", 0, 0)
            renderer.render(style, camera=camera, size=PICTURE, background="transparent")
        with SurfaceExtractor(resident) as extractor:
            for level in (200.0, 300.0):  # the second uses bricks
                tell("build", 0, 0)
                try:
                    extractor.extract(level)
                except NoSurfaceError:
                    pass
        find_clusters(resident, 1, 200.0, True, tell)
        for style in styles[3:]:
            tell("build", 0, 0)
            renderer.render(style, camera=camera, size=PICTURE, background="transparent")


def _warm_mesh(device: Device) -> None:
    mesh = Mesh(np.eye(3), [(0, 1, 2)], np.tile([0.0, 0.0, 1.0], (3, 1)))
    with ScenePictures([(mesh, MeshLook())], device=device) as scene:
        scene.take(Camera((0.3, 0.3, 5.0), (0.3, 0.3, 0.3), (0.0, 1.0, 0.0), parallel_scale=1.0), PICTURE)
