"""Pictures of several objects in one place, layer by layer from front to back: meshes, clouds, and volumes in or behind
which they lie.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.mesh import Mesh
from clrecon.opencl import Device, Stopwatch
from clrecon.operators.masks.voxel_mask import zero_words
from clrecon.operators.rays import mesh_pictures
from clrecon.operators.rays.picture_buffers import Between, DrawnVolume, LateDepths, PictureBuffers, Shot
from clrecon.operators.rays.point_pictures import PointPictures, cloud_box, eye_table
from clrecon.operators.rays.volume_renderer import VolumeRenderer, shown_box
from clrecon.operators.resident.device_volume import DeviceVolume, DeviceWorker
from clrecon.points.cloud import PointCloud
from clrecon.rendering import Lighting, Rendering
from clrecon.rendering.pictures.object_looks import MeshLook, PointLook
from clrecon.rendering.pictures.styles import SlicesInSpace, Style, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.system.progress import Progress, ignore_progress

LAYERS = 16
"""Most layers of a picture."""

COUNTED = ocl.kernel_constant("rays/layers.cl", "COUNTED")

PIXEL_BYTES = 16 + 20 + 48 + 12 + 8 + 4
"""Bytes a pixel: keys, a layer, states and marks, the picture, the still, the depth of the layer before."""


class Still(NamedTuple):
    """A picture that was made before: its colours (h, w, 4) uint8, not premultiplied, and depths (h, w) float32."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]


class LayeredPicture(NamedTuple):
    """A picture of layers, (h, w, 4) uint8; `open_pixels` may have more layers."""

    image: NDArray[np.uint8]
    late_depths: LateDepths
    layers: int
    open_pixels: int

    @property
    def depth(self) -> NDArray[np.float32]:
        return self.late_depths()[0]

    @property
    def expected_depth(self) -> NDArray[np.float32]:
        return self.late_depths()[1]


def draw_layers(
    volume: DrawnVolume,
    parts: Sequence[mesh_pictures.MeshPart],
    shot: Shot,
    *,
    still: Still | None = None,
    most: int = LAYERS,
    memory: int | None = None,
) -> LayeredPicture:
    """Draw triangles, with what lies before, between and behind them.

    volume: Its `sample` is called from front to back, and waits.
    parts: Of triangles at the same depth those of lower numbers are nearer, the first of the first part first.
    still: A picture of the same camera: one further layer at its depth.
    most: Most layers; there is progress before each.
    """
    pixels = math.prod(shot.size)
    needs = {"picture": PIXEL_BYTES * pixels, "triangles": sum(part.device_bytes for part in parts)}
    ocl.check_budget(volume.device, needs, memory)
    return _Layers(volume, parts, shot, still).run(volume.sample, most)


class _Layers:
    """One picture: its buffers, and its passes."""

    def __init__(self, volume: DrawnVolume, parts: Sequence[mesh_pictures.MeshPart], shot: Shot, still: Still | None):
        camera, size, *_ = self.shot = shot
        device, _, near_mm, stopwatch, _ = volume
        self.device, self.size = device, size
        self.stopwatch, self.near_mm = stopwatch, near_mm
        self.has_still = still is not None
        self.pixels = size[0] * size[1]
        self.program = ocl.load_program(device, "rays/layers.cl")
        self.view_d = ocl.upload(device, eye_table(camera, size, Lighting(), np.zeros(3)))
        shown = Still(np.zeros((1, 1, 4), np.uint8), np.zeros((1, 1), np.float32)) if still is None else still
        with stopwatch.timed("upload"):
            self.still_d = ocl.upload(device, np.ascontiguousarray(shown.image))
            self.still_depths_d = ocl.upload(device, np.ascontiguousarray(shown.depth, np.float32))
        self.triangles: list[mesh_pictures.Triangles] = []
        first = 0
        for part in parts:
            if len(part.triangles) and len(part.vertices):
                self.triangles.append(mesh_pictures.Triangles(device, part, first, camera, size, stopwatch))
                first += len(part.triangles)
        is_opaque = all(part.opacity >= 1.0 for part in parts)
        self.is_single = is_opaque and (still is None or bool((shown.image[..., 3] % 255 == 0).all()))
        self.keys = mesh_pictures.LayerKeys.of(device, self.pixels)
        self.layer_d = ocl.allocate(device, 16 * self.pixels)
        self.depths_d, self.nearest_d = ocl.allocate(device, 4 * self.pixels), ocl.allocate(device, 4 * self.pixels)
        self.states_d, self.marks_d = ocl.allocate(device, 32 * self.pixels), ocl.allocate(device, 16 * self.pixels)

    def run(self, sample: Callable[[Between], None] | None, most: int) -> LayeredPicture:
        device = self.device
        with self.stopwatch.running(device):
            floors = {"floor_keys": self.keys.floor_keys_d, "floor_numbers": self.keys.floor_numbers_d}
            self._launch("clear_rays", pixels=self.pixels, **self._rays, **floors)
        open_pixels, drawn = self.pixels if self.triangles or self.has_still else 0, 0
        is_first = True
        while open_pixels and drawn < most:
            self.shot.progress("layers", drawn, most)
            self._draw_layer()
            open_pixels = 0 if self.is_single else self._count_open()
            if sample is not None:
                self._sample(sample, is_first)
            with self.stopwatch.running(device):
                self._launch("blend_layer", **self._layer, **self._rays, **self._place, near_mm=self.near_mm)
            drawn, is_first = drawn + 1, False
            self.keys.go_behind()
            self.depths_d, self.nearest_d = self.nearest_d, self.depths_d
        if sample is not None and (is_first or open_pixels):  # else all rays have gone to their ends already
            self._fill(self.depths_d, np.inf)
            self._sample(sample, is_first)
        output = PictureBuffers(device, self.size, self.shot.background, several_slabs=False)
        arguments = {**output.arguments, **self._rays, **self._place}
        with self.stopwatch.running(device):
            self._launch("finish_rays", near_mm=self.near_mm, **arguments)
        with self.stopwatch.timed("download"):
            return LayeredPicture(*output.download_image(), drawn, open_pixels)

    def _draw_layer(self) -> None:
        """Find the nearest of each pixel behind the floor, with its colour and depth."""
        stopwatch, still = self.stopwatch, {"has_still": self.has_still, "still_depths": self.still_depths_d}
        with stopwatch.running(self.device):
            self._launch("begin_layer", **still, **self.keys.arguments, **self._place)
            for finds_numbers in (False, True):
                for triangles in self.triangles:
                    triangles.draw(self.keys, finds_numbers)
            self._launch(
                "show_still", still=self.still_d, numbers=self.keys.numbers_d, keys=self.keys.keys_d,
                pixels=self.pixels, **still, **self._layer,
            )  # fmt: skip
            for triangles in self.triangles:
                triangles.shade(self.keys, self.layer_d, self.depths_d)

    def _sample(self, sample: Callable[[Between], None], is_first: bool) -> None:
        if is_first:
            self._fill(self.nearest_d, -np.inf)
        sample(Between(self.states_d, self.nearest_d, self.depths_d))

    def _count_open(self) -> int:
        with self.stopwatch.running(self.device):
            open_d = zero_words(self.device, 1)
            items = -(-self.pixels // COUNTED)
            self._launch("count_open", items, keys=self.keys.keys_d, open=open_d, pixels=self.pixels)
        return int(ocl.download(self.device, np.zeros(1, np.uint32), open_d)[0])

    def _fill(self, depths_d: Any, depth: float) -> None:
        with self.stopwatch.running(self.device):
            self._launch("fill_depths", depths=depths_d, depth=depth, pixels=self.pixels)

    def _launch(self, kernel: str, items: int | None = None, **arguments: Any) -> None:
        ocl.launch(self.device, self.program[kernel], self.pixels if items is None else items, **arguments)

    @property
    def _rays(self) -> dict[str, Any]:
        return {"states": self.states_d, "marks": self.marks_d}

    @property
    def _layer(self) -> dict[str, Any]:
        return {"layer": self.layer_d, "layer_depths": self.depths_d}

    @property
    def _place(self) -> dict[str, Any]:
        return {"view": self.view_d, "width": self.size[0], "height": self.size[1]}


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


class ScenePictures(DeviceWorker):
    """Objects of which pictures are made together, one after the other: a context manager.

    Every pixel has layers from front to back: triangles of meshes (`LayeredPicture`), and one for what is opaque
    already when it is drawn, that is discs of points and surfaces of volumes.  Between them lies the volume that is
    shown by volume rendering or as slices.

    objects: sequence of (object, style). Mesh and MeshLook; PointCloud and PointLook; Volume or DeviceVolume and
        VolumeLook, SlicesInSpace or SurfaceLook.  Their arrays must not change as long as this object is open.  Of
        triangles at the same depth the first is seen.
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
        ocl.check_memory(memory)
        check_objects(objects)
        if takers is None:
            self.box = _box_of(objects)
        self._parts: list[mesh_pictures.MeshPart] = []
        self._objects = list(objects)
        for subject, style in objects:
            if isinstance(subject, Mesh) and isinstance(style, MeshLook):
                self._parts.append(mesh_pictures.make_part(subject, style))
        self._triangles = sum(len(part.triangles) for part in self._parts)
        if self._triangles > mesh_pictures.MOST_TRIANGLES:
            raise UsageError(
                f"a picture shows at most {mesh_pictures.MOST_TRIANGLES:,} triangles, these are {self._triangles:,}"
            )
        self._stack = ExitStack()
        super().__init__(device, memory)
        self._is_own = takers is None
        self._takers: dict[int, VolumeRenderer | PointPictures] = {} if takers is None else takers

    def close(self) -> None:
        """Free what was made for the pictures."""
        self._stack.close()
        if self._is_own:
            self._takers.clear()
        self._parts = []

    def take(
        self,
        camera: Camera,
        size: tuple[int, int],
        background: str | Sequence[float] | None = None,
        progress: Progress | None = None,
    ) -> Rendering:
        """Take one picture, with ``progress("render", objects drawn, all objects)``, and as `draw_layers` says."""
        tell = progress or ignore_progress
        tell("render", 0, len(self._objects))
        drawn: list[Rendering] = []
        translucent: tuple[VolumeRenderer, VolumeLook | SlicesInSpace] | None = None
        for number, (_, style) in enumerate(self._objects):
            if isinstance(style, PointLook | SurfaceLook):
                drawn.append(self._draw_alone(number, style, camera, size))
                tell("render", len(drawn), len(self._objects))
            elif isinstance(style, VolumeLook | SlicesInSpace):
                renderer = self._taker(number)
                assert isinstance(renderer, VolumeRenderer)
                translucent = renderer, style
        shot = Shot(camera, size, background, tell)
        finish = partial(self._finish, drawn, shot)
        if translucent is None:
            for attempt in ocl.with_fallback(self._device):
                with attempt as (device, warnings):
                    picture = finish(DrawnVolume(device, None, 0.0, Stopwatch(), warnings))
        else:
            renderer, look = translucent
            beside = {
                "picture": PIXEL_BYTES * size[0] * size[1],
                "triangles": sum(part.device_bytes for part in self._parts),
            }
            picture = renderer.render_with_layers(look, shot, beside, finish)
        tell("render", len(self._objects), len(self._objects))
        return picture

    def _taker(self, number: int) -> VolumeRenderer | PointPictures:
        """Return what takes pictures of an object alone; it stays open."""
        subject = self._objects[number][0]
        if id(subject) not in self._takers:
            opened: VolumeRenderer | PointPictures
            if isinstance(subject, PointCloud):
                opened = PointPictures(subject, device=self._device.current, memory=self.memory)
            else:
                assert isinstance(subject, Volume | DeviceVolume)
                device = None if isinstance(subject, DeviceVolume) else self._device.current
                memory = None if isinstance(subject, DeviceVolume) else self.memory
                opened = VolumeRenderer(subject, device=device, memory=memory)
            if self._is_own:
                self._stack.enter_context(opened)
            self._takers[id(subject)] = opened
        return self._takers[id(subject)]

    def _draw_alone(
        self, number: int, style: PointLook | SurfaceLook, camera: Camera, size: tuple[int, int]
    ) -> Rendering:
        taker = self._taker(number)
        if isinstance(taker, PointPictures):
            assert isinstance(style, PointLook)
            return taker.take(style, camera, size, None)
        return taker.render(style, camera=camera, size=size, background="transparent")

    def _finish(self, drawn: list[Rendering], shot: Shot, volume: DrawnVolume) -> Rendering:
        device, stopwatch = volume.device, volume.stopwatch
        layers = draw_layers(volume, self._parts, shot, still=_join_stills(drawn), memory=self.memory)
        warnings = [*device.warnings, *volume.warnings]
        for rendering in drawn:
            warnings += [text for text in rendering.report["warnings"] if text not in warnings]
        if layers.open_pixels:
            warnings.append(
                f"{layers.open_pixels:,} pixels have more than {layers.layers} translucent surfaces behind each other:"
                " the rest is left out"
            )
        modes = [style.mode for _, style in self._objects]
        report: dict[str, Any] = {
            "mode": modes[0],
            "objects": modes,
            "device": device.label,
            "driver": device.driver,
            "triangles": self._triangles,
            "layers": layers.layers,
            "seconds": dict(stopwatch.seconds),
            "kernel_seconds": dict(stopwatch.by_kernel),
            "warnings": warnings,
        }
        return Rendering.with_late_depths(layers.late_depths, layers.image, shot.camera, None, modes[0], report)


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
        corners.append(mesh_pictures.mesh_corners(subject) if isinstance(subject, Mesh) else box_corners(grid))  # type: ignore[arg-type]
    every = mesh_pictures.box_around(corners)
    for volume, object_corners in zip(grids, corners, strict=True):
        if volume is not None and np.allclose(mesh_pictures.box_around([object_corners]).affine, every.affine):
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
