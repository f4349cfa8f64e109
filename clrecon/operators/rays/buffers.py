"""Pictures on a device: their buffers, and the arguments that all ray casters share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.opencl import Device, Stopwatch, allocate, download, empty_output, kernel_constant
from clrecon.operators.rays.ray_view import TILE
from clrecon.rendering import Lighting
from clrecon.rendering.looks.colors import find_color

HIGHLIGHTS = kernel_constant("rays/shade.h", "HIGHLIGHTS")
"""Entries of the table of highlights."""


def highlight_table(lighting: Lighting) -> NDArray[np.float32]:
    """Return the specular light (HIGHLIGHTS,), float32, at evenly spaced cosines from 0 to 1."""
    return (lighting.specular * np.linspace(0.0, 1.0, HIGHLIGHTS) ** lighting.specular_power).astype(np.float32)


def count_queues(device: Device) -> int:
    """Return the number of parts into which a driver divides a launch; neighbouring tiles go to different parts for
    equal work.
    """
    return max(1, device.compute_units) if device.type == "cpu" else 1


@dataclass
class Between:
    """The part of the rays between two layers, for a ray caster that adds a volume to their states.

    states_d: buffer, (h, w, 2) float4. See cl/rays/layers.cl.
    nearest_d, farthest_d: buffer, (h, w) float32. Mm along the ray where it begins and ends.
    """

    states_d: Any
    nearest_d: Any
    farthest_d: Any


class DrawnVolume(NamedTuple):
    """A volume for a picture of layers.

    sample: Adds what the volume shows between two layers to the states of the rays, and waits.
    near_mm: Where its rays begin, see `VIEW_NEAR` in cl/rays/view.h.
    """

    device: Device
    sample: Callable[[Between], None]
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
        self.background = np.zeros(4, np.float32)
        if background is not None:
            self.background[:] = *find_color(background), 1.0

    @classmethod
    def of_states(cls, device: Device, size: tuple[int, int], states_d: Any) -> PictureBuffers:
        """Return the buffers of a picture that others finish: kernels write states alone."""
        made = cls(device, (1, 1), None, False)
        made.size, made.states_d = size, states_d
        return made

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments for kernels that blend."""
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
        """Number of tiles of the picture."""
        width, height = self.size
        return -(-width // TILE) * -(-height // TILE)

    def download(self) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
        """Wait for the device and return image, depths and means."""
        device = self.device
        return (
            download(device, self.image, self.image_d),
            download(device, self.depths, self.depths_d),
            download(device, self.means, self.means_d),
        )
