"""The table of a picture's rays (cl/rays/view.h), its buffers, and the arguments that all ray casters share."""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceLostError
from clrecon.geometry import Volume, normal_matrix
from clrecon.geometry.affine import Float64Array
from clrecon.opencl import Device, Stopwatch, allocate, download_all, empty_output, kernel_constant
from clrecon.operators.resident.tables import FieldFrame
from clrecon.rendering import Lighting
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.looks.lighting import LEAST_SOFT_GRADIENT
from clrecon.rendering.pictures.picture import Depths
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress

TILE = kernel_constant("rays/view.h", "TILE")
"""Pixels along each side of a tile."""

_BOX_ROW = kernel_constant("rays/view.h", "VIEW_BOX_LOW")
"""Row of the box in the table; its upper end and both of the focus follow."""

NEAR_ROW = kernel_constant("rays/view.h", "VIEW_NEAR")
"""Row of the table with the depth at which rays begin."""

ENDLESS = 1e30
"""Offset of a clip plane that nothing reaches, in float32."""

SAMPLES_A_LAUNCH = 1 << 28
"""Most samples of a launch on a part of a processor, which draws the screen too, were all rays as long as the longest:
systems stop kernels that block a display for seconds.  Cards of their own are faster, and take eight times as many."""


def light_row(light: Lighting) -> tuple[float, float, float, float]:
    """Return the unit vector towards a fixed light, and 1; zeros for a headlight."""
    return (0.0, 0.0, 0.0, 0.0) if light.direction is None else (*light.direction, 1.0)


def background_color(background: str | Sequence[float] | None) -> NDArray[np.float32]:
    """Return red, green, blue and opacity for a kernel; nothing without a background."""
    color = (0.0, 0.0, 0.0, 0.0) if background is None else (*find_color(background), 1.0)
    return np.array(color, np.float32)


def describe_picture(
    mode: str, device: Device, stopwatch: Stopwatch, warnings: Sequence[str], **facts: Any
) -> dict[str, Any]:
    """Return the report of a picture, with `facts` in the middle; the device's own warnings come first."""
    return {
        "mode": mode,
        "device": device.label,
        "driver": device.driver,
        **facts,
        "seconds": dict(stopwatch.seconds),
        "kernel_seconds": dict(stopwatch.by_kernel),
        "warnings": [*device.warnings, *warnings],
    }


@dataclass(frozen=True)
class RayView:
    """The rays of a picture for a device: a table, (rows, 4) float32, with `planes` rows of clip planes at its end.

    `spread` is the largest distance in field coordinates between a ray of a tile and its middle one, plus a ray step;
    `longest` are the samples of the longest ray.
    """

    camera: Camera
    size: tuple[int, int]
    ray_step: float
    table: NDArray[np.float32]
    planes: int
    spread: Float64Array
    longest: float

    def rays_a_launch(self, device: Device) -> int | None:
        """Return the most rays of a launch, None for any number."""
        samples = SAMPLES_A_LAUNCH * (8 if device.has_own_memory else 1)
        return int(samples / self.longest) if device.type == "gpu" else None

    @property
    def arguments(self) -> dict[str, int]:
        """Arguments that describe the picture and its clip planes to kernels; the table is uploaded on its own."""
        width, height = self.size
        return {
            "width": width,
            "height": height,
            "planes": self.planes,
            "perspective": int(not self.camera.is_parallel),
        }

    @classmethod
    def of(
        cls,
        volume: Volume,
        camera: Camera,
        size: tuple[int, int],
        ray_step: float,
        *,
        lighting: Lighting | None = None,
        planes: Float64Array | None = None,
        box: tuple[Float64Array, Float64Array],
        focus: tuple[Float64Array, Float64Array],
    ) -> RayView:
        """Set the table up.

        planes: ndarray, shape (n, 4), float64. Half-spaces in LPS mm that are kept: ``normal . p >= offset``.
        box, focus: (low, high), each (3,) float64. Field coordinates of the volume, and of its visible part.
        """
        frame = FieldFrame.of(volume)
        right, up, forward = camera.basis()
        width, height = size
        pixel = 2.0 * camera.half_height() / height
        position = np.array(camera.position)
        corner_x, corner_y = (0.5 - 0.5 * width) * pixel, (0.5 * height - 0.5) * pixel
        corner = right * corner_x + up * corner_y
        corners = box_corners(volume)
        centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        near = float((centre - position) @ forward - np.linalg.norm(corners - centre, axis=1).max())
        if camera.is_parallel:
            origins = (position + corner + near * forward, pixel * right, -pixel * up)
            directions = (forward, np.zeros(3), np.zeros(3))
        else:
            near = max(near, 0.0)
            directions = (forward + corner, pixel * right, -pixel * up)
            origins = (position + near * directions[0], near * directions[1], near * directions[2])
        light = Lighting() if lighting is None else lighting
        begin, *steps = [frame.matrix @ vector for vector in (*origins, *directions)]
        rows = [begin + frame.offset, *steps, *directions, *box, *focus, *normal_matrix(volume.affine)]
        table = np.zeros((len(rows) + 3, 4))
        table[: len(rows), :3] = rows
        table[-3] = light_row(light)
        table[-2] = light.ambient, light.diffuse, light.specular, light.specular_power
        table[-1] = near, ray_step, max(light.soft_gradient, LEAST_SOFT_GRADIENT) ** 2, 0.0
        count = 0
        if planes is not None and len(planes):
            table = np.vstack([table, np.clip(frame.planes(planes), -ENDLESS, ENDLESS)])
            count = len(planes)
        across, along = 0.5 * TILE * pixel, 0.0
        if not camera.is_parallel:
            across, along = _perspective_spread(camera, size, float(np.linalg.norm(corners - position, axis=1).max()))
        axes = np.abs(frame.matrix @ np.column_stack([right, up, forward]))
        spread = axes @ (across, across, along) + ray_step * np.linalg.norm(frame.matrix, axis=1)
        longest = 1.0 + float(np.linalg.norm(np.ptp(corners, axis=0))) / ray_step
        return cls(camera, size, ray_step, table.astype(np.float32), count, spread, longest)

    def widened(self) -> NDArray[np.float32]:
        """Return the table without clip planes, with the focus, enlarged by the spread on all sides, as its box."""
        table = self.table[: len(self.table) - self.planes].copy()
        table[_BOX_ROW, :3] = table[_BOX_ROW + 2, :3] - self.spread
        table[_BOX_ROW + 1, :3] = table[_BOX_ROW + 3, :3] + self.spread
        return table


def _perspective_spread(camera: Camera, size: tuple[int, int], farthest: float) -> tuple[float, float]:
    """Return the distance, across and along the view, of a tile's rays from its middle ray, up to `farthest` mm away.

    Points at equal distance along two rays differ by that distance times the difference of the unit directions.  This
    is at most the difference of the directions scaled to length 1 along the view; along the view, that times the sine
    of the angle to it.
    """
    width, height = size
    pixel = 2.0 * camera.half_height() / height
    edge = pixel * math.hypot(0.5 * width + TILE, 0.5 * height + TILE)  # tiles may extend beyond the picture
    across = math.sqrt(2.0) * 0.5 * (TILE - 1) * pixel * farthest
    return across, across * edge / math.hypot(1.0, edge)


HIGHLIGHTS = kernel_constant("rays/shade.h", "HIGHLIGHTS")
"""Entries of the table of highlights."""


def highlight_table(lighting: Lighting) -> NDArray[np.float32]:
    """Return the specular light (HIGHLIGHTS,), float32, at evenly spaced cosines from 0 to 1."""
    return (lighting.specular * np.linspace(0.0, 1.0, HIGHLIGHTS) ** lighting.specular_power).astype(np.float32)


def count_queues(device: Device) -> int:
    """Return into how many parts a driver divides a launch; neighbouring tiles go to different ones for equal work."""
    return max(1, device.compute_units) if device.type == "cpu" else 1


class Shot(NamedTuple):
    """A picture that is asked for beside its look: from where, how large, before what."""

    camera: Camera
    size: tuple[int, int]
    background: str | Sequence[float] | None = None
    progress: Progress = ignore_progress


@dataclass
class Between:
    """The part of the rays between two layers, for a ray caster that adds a volume to their states, (h, w, 2) float4,
    see cl/rays/layers.cl; `nearest_d` and `farthest_d`, (h, w) float32, are mm along the ray where it begins and ends.
    """

    states_d: Any
    nearest_d: Any
    farthest_d: Any


class DrawnVolume(NamedTuple):
    """A volume for layers; `sample` adds it to the states between two layers; None: no volume.  Its rays begin at
    `near_mm`, see `VIEW_NEAR` in cl/rays/view.h."""

    device: Device
    sample: Callable[[Between], None] | None
    near_mm: float
    stopwatch: Stopwatch
    warnings: list[str]


class PictureBuffers:
    """The picture that kernels write, slab by slab.

    image_d: buffer, (h, w, 4) uint8
    depths_d, means_d: buffer, (h, w) float32. First hit, and expected depth or a value.
    states_d: buffer, (h, w, 8) float32. State that a slab hands to the next slab; one entry if there is only one slab.
    background: ndarray, shape (4,), float32. Red, green, blue, and 1; the last is 0 without a background.
    """

    def __init__(
        self, device: Device, size: tuple[int, int], background: str | Sequence[float] | None, several_slabs: bool
    ):
        width, height = size
        self.device = device
        self.size = size
        self.image, self.image_d = empty_output(device, (height, width, 4), np.uint8)
        self.depths, self.depths_d = empty_output(device, (height, width), np.float32)
        self.means, self.means_d = empty_output(device, (height, width), np.float32)
        self.states_d: Any = allocate(device, 32 * width * height if several_slabs else 32)
        self.background = background_color(background)

    @classmethod
    def of_states(cls, device: Device, size: tuple[int, int], states_d: Any) -> PictureBuffers:
        """Return the buffers of a picture that others finish: kernels write states alone."""
        buffers = cls(device, (1, 1), None, False)
        buffers.size, buffers.states_d = size, states_d
        return buffers

    @property
    def arguments(self) -> dict[str, Any]:
        return {
            "states": self.states_d,
            "image": self.image_d,
            "depths": self.depths_d,
            "means": self.means_d,
            "background": self.background,
        }

    @staticmethod
    def needs(size: tuple[int, int]) -> tuple[dict[str, int], dict[str, int]]:
        """Return the bytes of a picture on the device, and those that several slabs add."""
        pixels = size[0] * size[1]
        return {"picture": 12 * pixels}, {"states of the rays": 32 * pixels}

    def items(self, queues: int, lanes: int) -> int:
        """Return the number of work-items of a launch, each with `lanes` pixels."""
        return -(-self.tiles // queues) * queues * (TILE * TILE // lanes)

    @property
    def tiles(self) -> int:
        width, height = self.size
        return -(-width // TILE) * -(-height // TILE)

    def download_image(self) -> tuple[NDArray[np.uint8], LateDepths]:
        """Wait for the device and return the image; depths and means stay on a card until they are wanted."""
        download_all(self.device, (self.image, self.image_d, 0))
        return self.image, LateDepths(self.device, (self.depths, self.depths_d), (self.means, self.means_d))

    def download_means(self) -> tuple[NDArray[np.float32], LateDepths]:
        """Wait for the device and return the means, which are values; first and mean depths are the same."""
        download_all(self.device, (self.means, self.means_d, 0))
        return self.means, LateDepths(self.device, (self.depths, self.depths_d))


_MOST_LATE_BYTES = 64 << 20
"""Bytes of late depths on a card: eight pictures of 1024 x 1024 pixels with both depths."""


class LateDepths:
    """Depths of a picture that a card holds until they are wanted; those of pictures that are gone are never read.

    Other devices write them in the computer's memory.  Of pictures that somebody keeps, the card holds at most
    `_MOST_LATE_BYTES`: the oldest are read before.
    """

    def __init__(self, device: Device, *wanted: tuple[NDArray[np.float32], Any]):
        self._device, self._lock = device, threading.Lock()
        self._arrays = [array for array, _ in wanted]
        self._unread = [(array, array_d, 0) for array, array_d in wanted]
        self._waiting = device.of_context(_list_waiting)
        if device.shares_host_memory:
            self()
            return
        with device.lock:
            self._waiting.append(weakref.ref(self))
            unread = [late for each in self._waiting if (late := each()) is not None and late._unread]
            self._waiting[:] = map(weakref.ref, unread)
        sizes = [sum(array.nbytes for array in late._arrays) for late in unread]
        for number, late in enumerate(unread):
            if sum(sizes[number:]) > _MOST_LATE_BYTES:
                late()

    def __call__(self) -> Depths:
        """Return first and mean depths, after reading them if they were not read before."""
        with self._lock:
            if self._unread and self._device.of_context(_list_waiting) is not self._waiting:
                raise DeviceLostError(f"{self._device.label} failed before the depths of the picture were asked for")
            download_all(self._device, *self._unread)
            self._unread = []
        first, *mean = self._arrays
        return first, mean[0] if mean else first.copy()


def _list_waiting(device: Device) -> list[weakref.ref[LateDepths]]:
    return []
