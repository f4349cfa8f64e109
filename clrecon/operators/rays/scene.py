"""Pictures of several objects in one place: meshes, clouds, and volumes in or behind which they lie."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.mesh import Mesh
from clrecon.opencl import Device, Stopwatch, check_memory, take_device, work_on
from clrecon.operators.rays.buffers import DrawnVolume
from clrecon.operators.rays.framing import shown_box
from clrecon.operators.rays.layers import PIXEL_BYTES, Still, draw_layers
from clrecon.operators.rays.mesh_pictures import box_around, make_part, mesh_corners
from clrecon.operators.rays.point_pictures import PointPictures, cloud_box
from clrecon.operators.rays.triangles import MOST_TRIANGLES, MeshPart
from clrecon.operators.rays.volume_renderer import VolumeRenderer
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.points import PointCloud
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.mesh_look import MeshLook
from clrecon.rendering.pictures.point_look import PointLook
from clrecon.rendering.pictures.styles import SlicesInSpace, Style, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.system.closing import Closing
from clrecon.system.progress import Progress, ignore_progress

Subject = Volume | DeviceVolume | PointCloud | Mesh
"""What a picture can show."""

_LOOKS: dict[type, tuple[type[Style], ...]] = {Mesh: (MeshLook,), PointCloud: (PointLook,)}
_VOLUME_LOOKS = (VolumeLook, SlicesInSpace, SurfaceLook)


def check_objects(objects: Sequence[tuple[Any, Style]]) -> None:
    """Refuse objects that one picture cannot show together."""
    if not objects:
        raise UsageError("a picture shows at least one object")
    translucent = 0
    for subject, style in objects:
        if not isinstance(subject, Subject):
            kinds = "Volume, DeviceVolume, PointCloud or Mesh"
            raise UsageError(f"an object of a picture is a {kinds}, not {type(subject).__name__}")
        allowed = _LOOKS.get(type(subject), _VOLUME_LOOKS)
        if not isinstance(style, allowed):
            names = " or ".join(each.__name__ for each in allowed)
            raise UsageError(
                f"a {type(subject).__name__} has the style {names} in a picture with other objects, not mode"
                f" {style.mode}"
            )
        translucent += isinstance(style, VolumeLook | SlicesInSpace)
    if translucent > 1:
        raise UsageError(
            f"{translucent} volumes are shown by volume rendering or as slices: one of them can be, others as surfaces"
        )


class ScenePictures(Closing):
    """Objects of which pictures are made together, one after the other.

    Every pixel has layers from front to back: triangles of meshes (`clrecon.operators.rays.layers`), and one for what
    is opaque already when it is drawn, that is discs of points and surfaces of volumes.  Between them lies the volume
    that is shown by volume rendering or as slices.

    Use it as a context manager, or `close` it.

    objects: sequence of (object, style). Mesh and MeshLook; PointCloud and PointLook; Volume or DeviceVolume and
        VolumeLook, SlicesInSpace or SurfaceLook.  Their arrays must not change as long as this object is open.  Of
        triangles at the same depth the first is seen.
    device: See `clrecon.device`; None is the best of the machine.
    memory: Bytes that may be taken on the device.
    takers: What takes pictures of volumes and clouds alone, by the `id` of the object; the caller keeps it for its next
        scenes and closes what is in it.  Objects are not looked at then, and there is no `box`.
    """

    def __init__(
        self,
        objects: Sequence[tuple[Subject, Style]],
        *,
        device: Device | str | int | None = None,
        memory: int | None = None,
        takers: dict[int, VolumeRenderer | PointPictures] | None = None,
    ):
        check_memory(memory)
        check_objects(objects)
        self.memory = memory
        if takers is None:
            self.box = _box_of(objects)
        self._parts: list[MeshPart] = []
        self._objects = list(objects)
        for subject, style in objects:
            if isinstance(subject, Mesh) and isinstance(style, MeshLook):
                self._parts.append(make_part(subject, style))
        self._triangles = sum(len(part.triangles) for part in self._parts)
        if self._triangles > MOST_TRIANGLES:
            raise UsageError(f"a picture shows at most {MOST_TRIANGLES:,} triangles, these are {self._triangles:,}")
        self._stack = ExitStack()
        self._device = take_device(device)
        self._is_own = takers is None
        self._takers: dict[int, VolumeRenderer | PointPictures] = {} if takers is None else takers

    def close(self) -> None:
        """Free what was made for the pictures."""
        self._stack.close()
        if self._is_own:
            self._takers.clear()
        self._parts = []

    @property
    def device(self) -> Device:
        """The device that works."""
        return self._device.current

    def take(
        self,
        camera: Camera,
        size: tuple[int, int],
        background: str | Sequence[float] | None = None,
        progress: Progress | None = None,
    ) -> Rendering:
        """Take one picture.

        size: (width, height)
        background: str or (float, float, float). None: transparent.
        progress: Called as ``progress("render", objects drawn, all objects)``, and as `draw_layers` says.
        """
        tell = progress or ignore_progress
        tell("render", 0, len(self._objects))
        drawn: list[Rendering] = []
        translucent: tuple[VolumeRenderer, VolumeLook | SlicesInSpace] | None = None
        for place, (_, style) in enumerate(self._objects):
            if isinstance(style, PointLook | SurfaceLook):
                drawn.append(self._draw_alone(place, style, camera, size))
                tell("render", len(drawn), len(self._objects))
            elif isinstance(style, VolumeLook | SlicesInSpace):
                renderer = self._taker(place)
                assert isinstance(renderer, VolumeRenderer)
                translucent = renderer, style
        finish = partial(self._finish, drawn, camera, size, background, tell)
        if translucent is None:
            made = work_on(self._device, lambda device, told: finish(device, Stopwatch(), told, None))
        else:
            renderer, look = translucent
            beside = {
                "picture": PIXEL_BYTES * size[0] * size[1],
                "triangles": sum(part.device_bytes for part in self._parts),
            }
            made = renderer.render_with_layers(
                look,
                camera,
                size,
                beside,
                lambda volume: finish(volume.device, volume.stopwatch, volume.warnings, volume),
            )
        tell("render", len(self._objects), len(self._objects))
        return made

    def _taker(self, place: int) -> VolumeRenderer | PointPictures:
        """Return what takes pictures of an object alone; it stays open."""
        subject = self._objects[place][0]
        if id(subject) not in self._takers:
            opened: VolumeRenderer | PointPictures
            if isinstance(subject, PointCloud):
                opened = PointPictures(subject, device=self._device.current, memory=self.memory)
            else:
                assert isinstance(subject, Volume | DeviceVolume)
                own = None if isinstance(subject, DeviceVolume) else self._device.current
                memory = None if isinstance(subject, DeviceVolume) else self.memory
                opened = VolumeRenderer(subject, device=own, memory=memory)
            if self._is_own:
                self._stack.enter_context(opened)
            self._takers[id(subject)] = opened
        return self._takers[id(subject)]

    def _draw_alone(
        self, place: int, style: PointLook | SurfaceLook, camera: Camera, size: tuple[int, int]
    ) -> Rendering:
        taker = self._taker(place)
        if isinstance(taker, PointPictures):
            assert isinstance(style, PointLook)
            return taker.take(style, camera, size, None)
        return taker.render(style, camera=camera, size=size, background="transparent")

    def _finish(
        self,
        drawn: list[Rendering],
        camera: Camera,
        size: tuple[int, int],
        background: str | Sequence[float] | None,
        progress: Progress,
        device: Device,
        stopwatch: Stopwatch,
        told: list[str],
        volume: DrawnVolume | None,
    ) -> Rendering:
        """Draw all layers on a device."""
        found = draw_layers(
            device, self._parts, camera, size, still=_join_stills(drawn),
            volume=None if volume is None else volume.sample,
            near_mm=0.0 if volume is None else volume.near_mm, background=background, memory=self.memory,
            stopwatch=stopwatch, progress=progress,
        )  # fmt: skip
        warnings = [*device.warnings, *told]
        for each in drawn:
            warnings += [text for text in each.report["warnings"] if text not in warnings]
        if found.open_pixels:
            warnings.append(
                f"{found.open_pixels:,} pixels have more than {found.layers} translucent surfaces behind each other:"
                " the rest is left out"
            )
        modes = [style.mode for _, style in self._objects]
        report: dict[str, Any] = {
            "mode": modes[0],
            "objects": modes,
            "device": device.label,
            "driver": device.driver,
            "triangles": self._triangles,
            "layers": found.layers,
            "seconds": dict(stopwatch.seconds),
            "kernel_seconds": dict(stopwatch.by_kernel),
            "warnings": warnings,
        }
        return Rendering(found.image, found.depth, found.expected_depth, camera, None, modes[0], report)


def _box_of(objects: Sequence[tuple[Subject, Style]]) -> Grid:
    """Return what cameras fit: a volume that all others lie in, else the box around all."""
    corners: list[Float64Array] = []
    grids: list[Grid | None] = []
    for subject, style in objects:
        grid = None
        if isinstance(subject, PointCloud):
            grid = cloud_box(subject)
        elif not isinstance(subject, Mesh):
            grid = shown_box(subject, style)
        grids.append(grid if isinstance(grid, Volume) else None)
        corners.append(mesh_corners(subject) if isinstance(subject, Mesh) else box_corners(grid))  # type: ignore[arg-type]
    every = box_around(corners)
    for volume, own in zip(grids, corners, strict=True):
        if volume is not None and np.allclose(box_around([own]).affine, every.affine):
            return volume
    return every


def _join_stills(drawn: Sequence[Rendering]) -> Still | None:
    """Return the nearest of pictures that were made before, pixel by pixel; None of none."""
    if not drawn:
        return None
    depths = np.stack([np.where(each.image[..., 3] > 0, each.depth, np.nan) for each in drawn])
    nearest = np.argmin(np.where(np.isnan(depths), np.inf, depths), axis=0)
    image = np.take_along_axis(np.stack([each.image for each in drawn]), nearest[None, ..., None], axis=0)[0]
    return Still(image, np.take_along_axis(depths, nearest[None], axis=0)[0])
