"""Points as discs on a device: the host's side of cl/rays/splats.cl."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.opencl import (
    Device,
    Stopwatch,
    allocate,
    check_budget,
    download,
    empty_output,
    kernel_constant,
    kernel_number,
    launch,
    load_program,
    memory_limits,
    settle,
    upload,
)
from clrecon.operators.rays.buffers import highlight_table
from clrecon.rendering import Lighting
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.views.camera import Camera
from clrecon.system.progress import Progress

LARGEST_DISC = kernel_number("rays/splats.cl", "MOST_PIXELS")
"""Largest radius of a disc in pixels."""

SMALLEST_DISC = kernel_number("rays/splats.cl", "LEAST_PIXELS")

PIXELS_A_LAUNCH = 1 << 27
"""Pixels of all discs of a launch: a fraction of a second, so that graphics drivers do not take it for a hang."""

MOST_PIXELS = 1 << 36
"""Pixels of all discs of a picture: half an hour on two cores."""

FEWEST_POINTS = 1 << 16
"""Points that a part is not made smaller than for want of memory."""

_SHADINGS = {
    name: kernel_constant("rays/splats.cl", macro)
    for name, macro in {"none": "UNSHADED_POINTS", "normals": "SHADED_BY_NORMALS", "depths": "SHADED_BY_DEPTHS"}.items()
}


class SplatPicture(NamedTuple):
    """A picture of points.

    image: ndarray, shape (h, w, 4), uint8
    depth: ndarray, shape (h, w), float32. Mm along the ray; NaN where no point is.
    shading: {"none", "normals", "depths"}
    parts: Parts of the cloud that went through the device one after the other.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    shading: str
    parts: int


def draw_splats(
    device: Device,
    points: NDArray[np.float32],
    colors: NDArray[np.uint8],
    normals: NDArray[np.float32] | None,
    camera: Camera,
    size: tuple[int, int],
    radius_mm: float,
    *,
    base: Float64Array | None = None,
    lighting: Lighting | None = None,
    background: str | Sequence[float] | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
    stopwatch: Stopwatch | None = None,
) -> SplatPicture:
    """Draw each point as a disc that faces the camera; the nearest disc is seen.

    points: ndarray, shape (n, 3), float32. Mm from `base`, finite; at most 2^32 - 2.
    colors: ndarray, shape (n, 4), uint8. Red, green, blue, 255.
    normals: ndarray, shape (n, 3), float32. Unit vectors, LPS.  Without them points are shaded by what lies around
        them, see cl/rays/splats.cl.
    size: (width, height)
    radius_mm: Of the discs; on the picture it is at least 0.7 and at most 128 pixels.
    base: ndarray, shape (3,), float64. LPS mm; default: the origin.
    lighting: One that does not shade leaves the colours as they are.
    background: str or (float, float, float). None: transparent.
    memory: Bytes that may be taken on the device; a cloud over it goes through in parts, and gives the same picture.
    progress: Called as ``progress("points", done, total)``, a point counted for each of the three passes.
    """
    job = _Splats(device, camera, size, radius_mm, base, lighting or Lighting(), background, normals is not None)
    count = job.plan(len(points), memory)
    stopwatch = stopwatch or Stopwatch()
    while True:
        try:
            return job.draw(points, colors, normals, count, stopwatch, progress)
        except DeviceMemoryError as error:
            settle(device, error)
            if count <= FEWEST_POINTS:
                raise
            count = max(FEWEST_POINTS, count // 2)


class _Splats:
    """One picture: its table, and its passes over parts of the cloud."""

    def __init__(
        self,
        device: Device,
        camera: Camera,
        size: tuple[int, int],
        radius_mm: float,
        base: Float64Array | None,
        lighting: Lighting,
        background: str | Sequence[float] | None,
        has_normals: bool,
    ):
        self.device, self.size, self.radius, self.lighting = device, size, np.float32(radius_mm), lighting
        self.shading = ("normals" if has_normals else "depths") if lighting.shades else "none"
        self.table = eye_table(camera, size, lighting, np.zeros(3) if base is None else base)
        self.background = np.zeros(4, np.float32)
        if background is not None:
            self.background[:] = *find_color(background), 1.0
        self.disc_pixels = min(max(radius_mm / camera.pixel_mm(size), SMALLEST_DISC), LARGEST_DISC)

    def plan(self, points: int, memory: int | None) -> int:
        """Return the points of a part: what fits beside the picture, and no more pixels than a launch should have."""
        width, height = self.size
        area = math.pi * self.disc_pixels**2
        if points * area > MOST_PIXELS:
            raise UsageError(
                f"discs of {self.disc_pixels:.0f} pixels in radius for {points:,} points cover {points * area:.1e}"
                f" pixels, at most {MOST_PIXELS:.1e} are drawn: take a smaller radius, or zoom less"
            )
        picture = {"picture": 16 * width * height}
        room = memory_limits(self.device, memory)
        free = min(room.total_bytes - picture["picture"], 2 * room.buffer_bytes) // self._point_bytes
        count = max(1, min(points, int(PIXELS_A_LAUNCH / area), max(free, FEWEST_POINTS)))
        check_budget(self.device, {**picture, "points": self._point_bytes * min(count, FEWEST_POINTS)}, memory)
        return count

    @property
    def _point_bytes(self) -> int:
        return 28 if self.shading == "normals" else 16

    def draw(
        self,
        points: NDArray[np.float32],
        colors: NDArray[np.uint8],
        normals: NDArray[np.float32] | None,
        count: int,
        stopwatch: Stopwatch,
        progress: Progress | None,
    ) -> SplatPicture:
        """Draw the picture with `count` points at a time."""
        device, (width, height) = self.device, self.size
        program = load_program(device, "rays/splats.cl")
        pixels, n = width * height, len(points)
        image, image_d = empty_output(device, (height, width, 4), np.uint8)
        depth, depths_d = empty_output(device, (height, width), np.float32)
        keys_d, numbers_d = allocate(device, 4 * pixels), allocate(device, 4 * pixels)
        view_d, lights_d = upload(device, self.table), upload(device, highlight_table(self.lighting))
        starts, whole_d = range(0, max(n, 1), max(count, 1)), None
        picture: dict[str, Any] = {"view": view_d, "width": width, "height": height}

        def tell(done: int) -> None:
            if progress is not None:
                progress("points", done, 3 * n)

        def hold(first: int) -> Any:
            nonlocal whole_d
            if len(starts) > 1:
                return _upload(device, points[first : first + count], stopwatch)
            whole_d = _upload(device, points, stopwatch) if whole_d is None else whole_d
            return whole_d

        tell(0)
        with stopwatch.running(device):
            launch(
                device, program["clear_splats"], pixels, stopwatch=stopwatch,
                keys=keys_d, numbers=numbers_d, pixels=pixels,
            )  # fmt: skip
        for number, kernel in enumerate(("splat_depths", "splat_numbers")):
            for first in starts:
                held, points_d = min(count, n - first), hold(first)
                more = {"numbers": numbers_d, "first": first} if number else {}
                with stopwatch.running(device):  # wait: CPU devices read the host's arrays
                    launch(
                        device, program[kernel], max(held, 1), stopwatch=stopwatch,
                        points=points_d, keys=keys_d, radius=self.radius, count=held, **more, **picture,
                    )  # fmt: skip
                del points_d
                tell(number * n + first + held)
        whole_d = None
        for first in starts:
            held = min(count, n - first)
            own = np.zeros(3, np.float32) if self.shading != "normals" else normals[first : first + held]  # type: ignore[index]
            normals_d, colors_d = (
                _upload(device, own, stopwatch),
                _upload(device, colors[first : first + held], stopwatch),
            )
            with stopwatch.running(device):
                launch(
                    device, program["shade_splats"], pixels, stopwatch=stopwatch,
                    keys=keys_d, numbers=numbers_d, normals=normals_d, colors=colors_d, highlights=lights_d,
                    image=image_d, depths=depths_d, background=self.background, shading=_SHADINGS[self.shading],
                    apart=self.apart, first=first, count=held, **picture,
                )  # fmt: skip
            del normals_d, colors_d
            tell(2 * n + first + held)
        with stopwatch.timed("download"):
            image, depth = download(device, image, image_d), download(device, depth, depths_d)
        return SplatPicture(image, depth, self.shading, len(starts))

    @property
    def apart(self) -> int:
        """Pixels to the neighbours of eye-dome lighting: those beyond a point's own disc."""
        return int(min(max(round(self.disc_pixels), 1), 8))


def _upload(device: Device, array: NDArray[Any], stopwatch: Stopwatch) -> Any:
    with stopwatch.timed("upload"):
        return upload(device, array if array.size else np.zeros(4, array.dtype))  # OpenCL has no empty buffers


def eye_table(camera: Camera, size: tuple[int, int], lighting: Lighting, base: Float64Array) -> NDArray[np.float32]:
    """Return the table (6, 4) of the view, see cl/rays/eye.h."""
    width, height = size
    position = np.array(camera.position) - base
    rows = [(*axis, -(axis @ position)) for axis in camera.basis()]
    fixed = lighting.direction is not None
    toward = np.zeros(3) if lighting.direction is None else np.array(lighting.direction)
    return np.array(
        [
            *rows,
            (2.0 * camera.half_height() / height, 0.5 * width, 0.5 * height, float(not camera.is_parallel)),
            (*(toward / (np.linalg.norm(toward) if fixed else 1.0)), float(fixed)),
            (lighting.ambient, lighting.diffuse, lighting.specular, lighting.specular_power),
        ],
        dtype=np.float32,
    )
