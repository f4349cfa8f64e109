"""Pictures of point clouds as discs: one cloud on a device, any number of pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.opencl import Device, Stopwatch
from clrecon.operators.rays.picture_buffers import Shot, background_color, describe_picture, highlight_table, light_row
from clrecon.operators.resident.device_volume import DeviceWorker
from clrecon.points.cloud import PointCloud
from clrecon.points.spacing import mean_spacing
from clrecon.rendering import Lighting, Rendering
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.looks.window import checked_window, choose_window
from clrecon.rendering.pictures.label_style import distinct_colors
from clrecon.rendering.pictures.object_looks import PointLook
from clrecon.rendering.views.camera import Camera, box_between
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress, ignore_progress

LARGEST_DISC = ocl.kernel_number("rays/splats.cl", "MOST_PIXELS")
"""Largest radius of a disc in pixels."""

SMALLEST_DISC = ocl.kernel_number("rays/splats.cl", "LEAST_PIXELS")

_PIXELS_A_LAUNCH = 1 << 27
"""Pixels of all discs of a launch: a fraction of a second, so that graphics drivers do not take it for a hang."""

MOST_PIXELS = 1 << 36
"""Pixels of all discs of a picture: half an hour on two cores."""

FEWEST_POINTS = 1 << 16
"""Points that a part is not made smaller than for want of memory."""

_SHADINGS = {
    name: ocl.kernel_constant("rays/splats.cl", macro)
    for name, macro in {"none": "UNSHADED_POINTS", "normals": "SHADED_BY_NORMALS", "depths": "SHADED_BY_DEPTHS"}.items()
}


class SplatPicture(NamedTuple):
    """A picture: (h, w, 4) uint8, depth (h, w) float32 mm, NaN: none; `shading` by what; the cloud's `parts`."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    shading: str
    parts: int


class Discs(NamedTuple):
    """Discs at points (n, 3), mm from `base`, with colours (n, 4): red, green, blue, 255.

    normals: Unit vectors (n, 3), LPS; without them points are shaded by what lies around them.
    radius_mm: On the picture it is at least 0.7 and at most 128 pixels.
    """

    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    normals: NDArray[np.float32] | None
    radius_mm: float
    lighting: Lighting
    base: Float64Array | None = None


def draw_splats(
    device: Device, discs: Discs, shot: Shot, *, memory: int | None = None, stopwatch: Stopwatch | None = None
) -> SplatPicture:
    """Draw discs that face the camera; the nearest disc is seen.

    memory: A cloud over it goes through in parts, and gives the same picture.
    """
    job = _Splats(device, discs, shot)
    count = job.plan(memory)
    stopwatch = stopwatch or Stopwatch()
    while True:
        try:
            return job.draw(count, stopwatch)
        except DeviceMemoryError as error:
            ocl.settle(device, error)
            if count <= FEWEST_POINTS:
                raise
            count = max(FEWEST_POINTS, count // 2)


class _Splats:
    """One picture: its table, and its passes over parts of the cloud."""

    def __init__(self, device: Device, discs: Discs, shot: Shot):
        camera, self.size, background, self.progress = shot
        self.device, self.discs = device, discs
        shading = "depths" if discs.normals is None else "normals"
        self.shading = shading if discs.lighting.shades else "none"
        base = np.zeros(3) if discs.base is None else discs.base
        self.table = eye_table(camera, self.size, discs.lighting, base)
        self.background = background_color(background)
        self.disc_pixels = min(max(discs.radius_mm / camera.pixel_mm(self.size), SMALLEST_DISC), LARGEST_DISC)

    def plan(self, memory: int | None) -> int:
        """Return the points of a part: what fits beside the picture, and no more pixels than a launch should have."""
        (width, height), points = self.size, len(self.discs.points)
        area = math.pi * self.disc_pixels**2
        if points * area > MOST_PIXELS:
            raise UsageError(
                f"discs of {self.disc_pixels:.0f} pixels in radius for {points:,} points cover {points * area:.1e}"
                f" pixels, at most {MOST_PIXELS:.1e} are drawn: take a smaller radius, or zoom less"
            )
        picture = {"picture": 16 * width * height}
        room = ocl.memory_limits(self.device, memory)
        free = min(room.total_bytes - picture["picture"], 2 * room.buffer_bytes) // self._point_bytes
        count = max(1, min(points, int(_PIXELS_A_LAUNCH / area), max(free, FEWEST_POINTS)))
        ocl.check_budget(self.device, {**picture, "points": self._point_bytes * min(count, FEWEST_POINTS)}, memory)
        return count

    @property
    def _point_bytes(self) -> int:
        return 28 if self.shading == "normals" else 16

    def draw(self, count: int, stopwatch: Stopwatch) -> SplatPicture:
        points, colors, normals, radius_mm, lighting, _ = self.discs
        device, (width, height) = self.device, self.size
        program = ocl.load_program(device, "rays/splats.cl")
        pixels, n = width * height, len(points)
        image, image_d = ocl.empty_output(device, (height, width, 4), np.uint8)
        depth, depths_d = ocl.empty_output(device, (height, width), np.float32)
        keys_d, numbers_d = ocl.allocate(device, 4 * pixels), ocl.allocate(device, 4 * pixels)
        view_d, lights_d = ocl.upload(device, self.table), ocl.upload(device, highlight_table(lighting))
        starts, whole_d = range(0, max(n, 1), max(count, 1)), None
        picture: dict[str, Any] = {"view": view_d, "width": width, "height": height}

        def hold(first: int) -> Any:
            nonlocal whole_d
            if len(starts) > 1:
                return _upload(device, points[first : first + count], stopwatch)
            whole_d = _upload(device, points, stopwatch) if whole_d is None else whole_d
            return whole_d

        self.progress("points", 0, 3 * n)
        with stopwatch.running(device):
            ocl.launch(device, program["clear_splats"], pixels, keys=keys_d, numbers=numbers_d, pixels=pixels)
        for number, kernel in enumerate(("splat_depths", "splat_numbers")):
            for first in starts:
                piece, points_d = min(count, n - first), hold(first)
                more = {"numbers": numbers_d, "first": first} if number else {}
                with stopwatch.running(device):  # wait: CPU devices read the host's arrays
                    ocl.launch(
                        device, program[kernel], max(piece, 1),
                        points=points_d, keys=keys_d, radius=radius_mm, count=piece, **more, **picture,
                    )  # fmt: skip
                del points_d
                self.progress("points", number * n + first + piece, 3 * n)
        whole_d = None
        for first in starts:
            piece = min(count, n - first)
            shown = np.zeros(3, np.float32) if self.shading != "normals" else normals[first : first + piece]  # type: ignore[index]
            normals_d = _upload(device, shown, stopwatch)
            colors_d = _upload(device, colors[first : first + piece], stopwatch)
            with stopwatch.running(device):
                ocl.launch(
                    device, program["shade_splats"], pixels, keys=keys_d, numbers=numbers_d, normals=normals_d,
                    colors=colors_d, highlights=lights_d, image=image_d, depths=depths_d, background=self.background,
                    shading=_SHADINGS[self.shading], apart=self.apart, first=first, count=piece, **picture,
                )  # fmt: skip
            del normals_d, colors_d
            self.progress("points", 2 * n + first + piece, 3 * n)
        with stopwatch.timed("download"):
            ocl.download_all(device, (image, image_d, 0), (depth, depths_d, 0))
        return SplatPicture(image, depth, self.shading, len(starts))

    @property
    def apart(self) -> int:
        """Pixels to the neighbours of eye-dome lighting: those beyond a point's own disc."""
        return int(min(max(round(self.disc_pixels), 1), 8))


def _upload(device: Device, array: NDArray[Any], stopwatch: Stopwatch) -> Any:
    with stopwatch.timed("upload"):
        return ocl.upload(device, array if array.size else np.zeros(4, array.dtype))  # OpenCL has no empty buffers


def eye_table(camera: Camera, size: tuple[int, int], lighting: Lighting, base: Float64Array) -> NDArray[np.float32]:
    """Return the table (6, 4) of the view, see cl/rays/eye.h."""
    width, height = size
    position = np.array(camera.position) - base
    rows = [(*axis, -(axis @ position)) for axis in camera.basis()]
    return np.array(
        [
            *rows,
            (2.0 * camera.half_height() / height, 0.5 * width, 0.5 * height, float(not camera.is_parallel)),
            light_row(lighting),
            (lighting.ambient, lighting.diffuse, lighting.specular, lighting.specular_power),
        ],
        dtype=np.float32,
    )


LONE_POINT_MM = 1.0
"""Radius of the discs for a cloud without a spacing; for others the radius is the mean spacing, with few gaps."""

_NOISE_COLOR = "#707070"
_KEPT_COLOR = "#a0a0a0"
_PLAIN_COLOR = "bone"

DARKEST_SHARE = 1 / 3
"""Width that is added below the 1st percentile of the HU: that is a quarter of the way from black to white."""

MOST_NAMED = 24
"""Most entries of a legend; those with the most points."""


def cloud_box(cloud: PointCloud) -> Grid:
    """Return the box of a cloud, see `box_between`."""
    if not len(cloud):
        raise UsageError("the cloud has no points: there is nothing to show")
    return box_between(cloud.points.min(axis=0), cloud.points.max(axis=0))


class _Colors(NamedTuple):
    """Colours (n, 4) uint8 of points, what they show, and what they mean."""

    table: NDArray[np.uint8]
    color_by: str
    legend: list[dict[str, Any]]
    left_out: int
    window: tuple[float, float] | None


class PointPictures(DeviceWorker):
    """A cloud of points of which pictures are made one after the other: a context manager.

    Its arrays must not change as long as this object is open; a cloud over `memory` goes through in parts.
    """

    def __init__(self, cloud: PointCloud, *, device: Device | str | int | None = None, memory: int | None = None):
        ocl.check_memory(memory)
        self.box = cloud_box(cloud)
        self.cloud = cloud
        super().__init__(device, memory)
        self._spacing: float | None = None
        self._colors: tuple[PointLook, _Colors] | None = None
        self._base: Float64Array | None = None
        points = cloud.points
        if points.dtype != np.float32:
            self._base = np.rint(self.box.affine[:3, 3])
            points = (points - self._base).astype(np.float32)
        self._points: NDArray[np.float32] = points

    def close(self) -> None:
        """Free what was made for the pictures."""
        self._colors = None

    def take(
        self,
        style: PointLook,
        camera: Camera,
        size: tuple[int, int],
        background: str | Sequence[float] | None = None,
        progress: Progress | None = None,
    ) -> Rendering:
        radius = self._radius(style)
        if self._colors is None or self._colors[0] != style:
            self._colors = style, _color_points(self.cloud, style)
        colors = self._colors[1]
        cloud, points = self.cloud, self._points
        table, normals = colors.table, cloud.normals
        if style.clip is not None:
            is_inside = style.clip.contains(cloud.points)
            points, table = points[is_inside], table[is_inside]
            normals = None if normals is None else normals[is_inside]
        discs = Discs(points, table, normals, radius, style.light, self._base)
        stopwatch, shot = Stopwatch(), Shot(camera, size, background, progress or ignore_progress)
        for attempt in ocl.with_fallback(self._device):
            with attempt as (device, notes):
                splats = draw_splats(device, discs, shot, memory=self.memory, stopwatch=stopwatch)
        report = describe_picture(
            "points", device, stopwatch, [*notes, *_warn_of_radius(radius, camera, size)],
            points=len(points), radius_mm=radius, color_by=colors.color_by, legend=colors.legend,
            legend_left_out=colors.left_out, window_hu=colors.window, shading=splats.shading, slabs=splats.parts,
        )  # fmt: skip
        return Rendering(splats.image, splats.depth, splats.depth, camera, None, "points", report)

    def _radius(self, style: PointLook) -> float:
        if style.radius_mm is not None:
            return style.radius_mm
        if self._spacing is None:
            self._spacing = mean_spacing(self._points)
        return self._spacing or LONE_POINT_MM


def _warn_of_radius(radius: float, camera: Camera, size: tuple[int, int]) -> list[str]:
    pixels = radius / camera.pixel_mm(size)
    if pixels <= LARGEST_DISC:
        return []
    return [
        f"discs of {radius:.3g} mm are {pixels:.0f} pixels in radius: they are drawn with {LARGEST_DISC:g}, which is"
        f" {radius * LARGEST_DISC / pixels:.3g} mm"
    ]


def _color_points(cloud: PointCloud, style: PointLook) -> _Colors:
    by = style.color_by
    if by is None and style.color is None:
        if cloud.labels is not None:
            by = "label"
        elif cloud.hu is not None and cloud.hu.min() < cloud.hu.max():
            by = "hu"
    if by in ("label", "removed"):
        if cloud.labels is None:
            raise UsageError(f"the cloud has no labels, and {name_parameter('color_by', by)} needs them: leave it out")
        return _color_by_label(cloud, cloud.labels, by == "removed")
    if by == "hu":
        if cloud.hu is None:
            raise UsageError(f"the cloud has no HU, and {name_parameter('color_by', by)} needs them: leave it out")
        window = _choose_window(cloud.hu) if style.window is None else checked_window(style.window)
        share = np.clip((cloud.hu - np.float32(window[0])) * np.float32(255.0 / (window[1] - window[0])), 0, 255)
        grey = np.rint(share).astype(np.uint8)
        return _Colors(_rows(grey, grey, grey), by, [], 0, window)
    color = np.rint(255.0 * find_color(_PLAIN_COLOR if style.color is None else style.color)).astype(np.uint8)
    return _Colors(np.broadcast_to(np.append(color, np.uint8(255)), (len(cloud), 4)), "none", [], 0, None)


def _choose_window(hu: NDArray[np.float32]) -> tuple[float, float]:
    """Return a window in which the lowest HU are dark grey, so that they show before black."""
    low, high = choose_window(hu)
    return low - DARKEST_SHARE * (high - low), high


def _rows(*channels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    table = np.full((len(channels[0]), 4), 255, np.uint8)
    for number, channel in enumerate(channels):
        table[:, number] = channel
    return table


def _color_by_label(cloud: PointCloud, labels: NDArray[np.int32], removed: bool) -> _Colors:
    """Colour points by label; with `removed` by the reason for which each was removed, 0 being those that are kept."""
    numbers, places, counts = _count_labels(labels)
    grey = numbers <= 0 if removed else numbers < 0
    palette = np.tile(find_color(_KEPT_COLOR if removed else _NOISE_COLOR), (len(numbers), 1))
    palette[~grey] = distinct_colors(int(np.count_nonzero(~grey)))
    levels = np.rint(255.0 * palette).astype(np.uint8)
    names: Mapping[Any, Any] = cloud.report.get("label_names") or {}
    usual = {-1: "noise"} if not removed else {0: "kept"}
    order = sorted(np.argsort(-counts, kind="stable")[:MOST_NAMED].tolist())
    legend = [
        {
            "label": int(numbers[place]),
            "name": names.get(int(numbers[place])) or names.get(str(numbers[place])) or usual.get(int(numbers[place])),
            "color": "#" + bytes(levels[place]).hex(),
            "points": int(counts[place]),
        }
        for place in order
    ]
    table = np.concatenate([levels, np.full((len(levels), 1), 255, np.uint8)], axis=1)
    return _Colors(table[places], "removed" if removed else "label", legend, len(numbers) - len(order), None)


def _count_labels(labels: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the labels that occur, ascending, the place of each point's label among them, and their counts."""
    low, high = int(labels.min()), int(labels.max())
    if high - low > 1 << 24:
        numbers, places, counts = np.unique(labels, return_inverse=True, return_counts=True)
        return numbers.astype(np.int64), places.astype(np.int64), counts.astype(np.int64)
    offsets = labels - np.int32(low)
    by_number = np.bincount(offsets, minlength=high - low + 1)
    there = by_number > 0
    return np.flatnonzero(there) + low, (np.cumsum(there) - 1)[offsets], by_number[there]
