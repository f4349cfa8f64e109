"""Non-local means of slices: the host's side of cl/filters/means.cl."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceError
from clrecon.geometry import Volume
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress

_WIDTH, _HEIGHT = (ocl.kernel_constant("filters/means.cl", name) for name in ("WIDTH", "HEIGHT"))
"""Voxels of a tile along i and j."""

_SCRATCH = ocl.kernel_constant("filters/means.cl", "SCRATCH")
"""Floats that the work on a tile needs."""

_TILES = 1024
"""Tiles of a launch: work for some tens of cores, and 33 MB of memory for it."""

_ITERATIONS = 30_000
"""Iterations of the loops of a work-item in a launch; llvmpipe ends them after 65,535, counted in a way of its own:
with 60,000 of these it did."""

_SOFTNESS = 0.8
"""Differences that have the weight 1 / e, over the noise: those that A. Buades et al. recommend."""

_PURPOSE = "non-local means"


@dataclass(frozen=True)
class MeansSettings:
    """patch: Voxels of a side, odd.  reach: Voxels around the middle.  noise: Standard deviation, in HU.

    As in scikit-image 0.26, sums go over a square that is one voxel smaller than the patch, and count as of all of it.
    """

    patch: int
    reach: int
    noise: float

    @property
    def side(self) -> int:
        """Voxels of a side that are summed."""
        return self.patch - 1

    @property
    def frame(self) -> int:
        """Mirrored voxels on each side of a slice."""
        return self.reach + self.side // 2

    def scale(self) -> tuple[float, float]:
        """Return what the sum of the squared differences of two patches may be, and exponents of 2 a unit beyond it."""
        softness = _SOFTNESS * self.noise
        return 2.0 * (self.side * self.noise) ** 2, math.log2(math.e) / (self.patch * softness) ** 2


def run_means(
    resident: DeviceVolume, settings: MeansSettings, warnings: list[str], progress: Progress
) -> NDArray[np.float32]:
    """Return the means of all voxels, shape (nk, nj, ni), not rounded."""
    volume, slices = resident.volume, resident.volume.shape_ijk[2]
    tiles = _TiledSlices(resident, settings)
    planned = resident.plan(_PURPOSE, slices, tiles.needs, most=max(1, _TILES // tiles.tiles))
    if planned == 0:
        needs = sum(tiles.needs(1).values())
        raise DeviceError(f"non-local means of a slice need {needs:,} bytes: {resident.limits.describe()}; allow more")
    result = np.empty(volume.voxels.shape, np.float32)
    for attempt in resident.attempts(_PURPOSE, planned, warnings):
        with attempt as count:
            for first in range(0, slices, count):
                end = min(first + count, slices)
                result[first:end] = tiles.filter(first, end)
                progress("filter", end, slices)
    return result


class _TiledSlices:
    """Slices in frames that hold whole tiles."""

    def __init__(self, resident: DeviceVolume, settings: MeansSettings):
        self._resident, self._settings = resident, settings
        ni, nj, _ = resident.volume.shape_ijk
        self._columns, self._rows = -(-ni // _WIDTH), -(-nj // _HEIGHT)
        self.tiles = self._columns * self._rows
        self._pitch = self._columns * _WIDTH + 2 * settings.frame
        self._height = self._rows * _HEIGHT + 2 * settings.frame

    def needs(self, slices: int) -> dict[str, int]:
        ni, nj, _ = self._resident.volume.shape_ijk
        return {
            "slices in frames": 4 * (slices * self._height * self._pitch + 8),
            "sums of patches": 4 * slices * self.tiles * (_SCRATCH + 2 * _WIDTH * _HEIGHT),
            "filtered slices": 4 * slices * nj * ni,
        }

    def _framed(self, volume: Volume, first: int, end: int) -> NDArray[np.float32]:
        """Return slices in their frames, and 8 floats more."""
        ni, nj, _ = volume.shape_ijk
        frame = self._settings.frame
        floats = np.zeros((end - first) * self._height * self._pitch + 8, np.float32)
        framed = floats[:-8].reshape(-1, self._height, self._pitch)
        for layer, voxels in zip(framed, volume.voxels[first:end], strict=True):
            mirrored = np.pad(voxels.astype(np.float32), frame, mode="reflect")
            layer[: nj + 2 * frame, : ni + 2 * frame] = mirrored
        return floats

    def _steps_of_launch(self, is_tiled: bool) -> int:
        """Return how many steps to other voxels are added in a launch."""
        side = self._settings.side
        vectors = -(-(_WIDTH + side - 1) // 8)
        squares, sums = (_HEIGHT + side) * (vectors + 1), _HEIGHT * (side + 1) * (vectors + _WIDTH // 8)
        return max(1, _ITERATIONS // (squares + sums if is_tiled else side * (side + 2)))

    def filter(self, first: int, end: int) -> NDArray[np.float32]:
        device, volume = self._resident.device, self._resident.volume
        settings = self._settings
        ni, nj, _ = volume.shape_ijk
        lanes = device.kernel_variants["LANES"]
        is_tiled = lanes == "8"
        columns, rows = (self._columns, self._rows) if is_tiled else (ni, nj)
        items = (end - first) * columns * rows
        noise, scale = settings.scale()
        filtered, filtered_d = ocl.empty_output(device, (end - first, nj, ni), np.float32)
        size = 4 * items * (_WIDTH * _HEIGHT if is_tiled else 1)
        sums = {"weights": ocl.allocate(device, size), "changes": ocl.allocate(device, size)}
        scratch_d: Any = ocl.allocate(device, 4 * items * _SCRATCH if is_tiled else 4)
        program = ocl.load_program(device, "filters/means.cl", {"LANES": lanes})
        slices = {"padded": ocl.upload(device, self._framed(volume, first, end)), "pitch": self._pitch}
        slices |= {"height": self._height, "columns": columns, "rows": rows}
        steps, at_once = (2 * settings.reach + 1) ** 2 - 1, self._steps_of_launch(is_tiled)
        for step in range(0, steps, at_once):
            ocl.launch(
                device, program["average_patches"], items, scratch=scratch_d, **slices, **sums, items=items,
                reach=settings.reach, patch=settings.side, noise=noise, scale=scale, first=step,
                end=min(step + at_once, steps),
            )  # fmt: skip
        ocl.launch(
            device, program["finish_means"], filtered.size, filtered=filtered_d, **slices, **sums, ni=ni, nj=nj,
            voxels=filtered.size, frame=settings.frame,
        )  # fmt: skip
        return ocl.download(device, filtered, filtered_d)
