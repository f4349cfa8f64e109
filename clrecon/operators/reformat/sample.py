"""Values of the pixels of a sheet: the host side of cl/render/reformat.cl."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import DeviceError, DeviceMemoryError, UsageError
from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    describe_shortage,
    download,
    launch,
    load_program,
    memory_limits,
    upload,
)
from clrecon.operators.resident.voxel_types import voxel_variants
from clrecon.rendering.views.plane import Sheet, SlabSamples
from clrecon.system.progress import Progress

__all__ = ["COMBINATIONS", "Reformation", "prepare_reformat", "sample_sheet"]

COMBINATIONS = ("mean", "max", "min")
"""How the samples of a slab are combined, by their numbers in cl/render/reformat.cl."""

SAMPLES_A_LAUNCH = 1 << 23
"""Keeps launches short: systems stop those that hold a display's GPU for seconds."""

FARTHEST = 2.0**30
"""Index steps, or mm, from the volume that fixed point can hold."""


@dataclass(frozen=True)
class Reformation:
    """Values of the pixels of a sheet, and how they were made.

    Attributes
    ----------
    values : ndarray, shape (h, w), float32
        HU; NaN where no sample lies within the volume.
    slices : int
        Slices of the volume that the sheet meets.
    slabs : int
        Parts in which the volume went through the device.
    device_bytes : int
        Most that was taken on the device at a time.
    """

    values: NDArray[np.float32]
    slices: int
    slabs: int
    device_bytes: int


def prepare_reformat(device: Device, dtype: DTypeLike = np.int16, uneven: bool = False) -> Program:
    """Build the kernel for volumes of `dtype`, with `uneven` for those whose slices no affine places.

    Raises
    ------
    DeviceError
        The driver's compiler refuses.
    """
    return load_program(device, "render/reformat.cl", {**voxel_variants(dtype), "UNEVEN": str(int(uneven))})


@dataclass(frozen=True)
class _Places:
    """A sheet in the coordinates of a volume, in fixed point: see the kernel's contract."""

    rows: NDArray[np.int64]
    slices: NDArray[np.int64]
    first: int
    end: int


def _to_fixed(places: Float64Array) -> NDArray[np.int64]:
    return np.rint(places * 2.0**32).astype(np.int64)


def _place_rows(volume: Volume, sheet: Sheet, samples: SlabSamples) -> _Places:
    """Map the rows of a sheet to coordinates of the volume, and find the slices that they meet."""
    if volume.uneven:
        heights_at = volume.slice_origins()
        normal = slice_normal(volume.affine)
        normal *= np.sign(normal @ (heights_at[-1] - heights_at[0]))
        to_places = np.vstack([np.linalg.pinv(volume.affine[:3, :2]), normal])
        slices = (heights_at - heights_at[0]) @ to_places.T
        origins = (sheet.origins - heights_at[0]) @ to_places.T
    else:
        to_places = np.linalg.inv(volume.affine[:3, :3])
        slices = np.zeros((2, 3))
        origins = volume.lps_to_ijk(sheet.origins)
    steps, depths = sheet.steps @ to_places.T, samples.step * (sheet.normals @ to_places.T)
    last, half = (sheet.width - 1) * steps, samples.intervals // 2 * depths
    corners = np.stack([origins + across + along for across in (0.0 * last, last) for along in (-half, half)])
    if np.abs(corners).max() >= FARTHEST:
        raise UsageError(
            "the picture reaches more than a thousand kilometres beyond the volume: check its place and size"
        )
    low, high = corners[..., 2].min(), corners[..., 2].max()
    nk = volume.shape_ijk[2]
    if volume.uneven:
        layers = np.searchsorted(slices[:, 2], [low, high], side="right") - 1
        first, end = int(max(layers[0], 0)), int(min(layers[1] + 2, nk))
    else:
        first, end = int(np.clip(np.floor(low - 0.5), 0, nk - 1)), int(np.clip(np.floor(high) + 2, 1, nk))
    return _Places(_to_fixed(np.hstack([origins, steps, depths])), _to_fixed(slices), min(first, nk - 1), max(end, 1))


class _Run:
    """One reformation: all rows through one part of the volume after the other."""

    def __init__(
        self, device: Device, volume: Volume, sheet: Sheet, samples: SlabSamples, combine: int, stopwatch: Stopwatch
    ):
        self.device, self.volume, self.sheet, self.samples = device, volume, sheet, samples
        self.combine, self.stopwatch = combine, stopwatch
        self.places = _place_rows(volume, sheet, samples)
        with stopwatch.timed("build"):
            self.program = prepare_reformat(device, volume.voxels.dtype, volume.uneven)

    def needs(self, slices: int) -> dict[str, int]:
        """Bytes of every buffer, with so many slices of the volume on the device."""
        ni, nj, _ = self.volume.shape_ijk
        pixels = self.sheet.width * self.sheet.height
        return {
            "volume": slices * ni * nj * int(self.volume.voxels.dtype.itemsize),
            "rows": self.places.rows.nbytes + self.places.slices.nbytes,
            "values": 4 * pixels,
            "weights": 4 * pixels,
        }

    def plan(self, memory: int | None) -> int:
        """Slices that go to the device at a time.

        Raises
        ------
        DeviceError
            Not even two slices fit.
        """
        limits = memory_limits(self.device, memory)
        wanted = self.places.end - self.places.first
        if not describe_shortage(limits, self.needs(wanted)):
            return wanted
        fewest = self.needs(min(2, wanted))
        shortage = describe_shortage(limits, fewest)
        if shortage:
            raise DeviceError(f"two slices at a time are too much: {shortage}; give more memory or a smaller picture")
        one = self.needs(1)["volume"]
        others = sum(fewest.values()) - fewest["volume"]
        return int(min(limits.buffer_bytes, limits.total_bytes - others) // one)

    def all_slabs(self, slices: int, resident_d: Any, progress: Progress | None) -> Reformation:
        """Take the samples of `slices` slices at a time; each slab but the last repeats its upper one."""
        places, shape = self.places, (self.sheet.height, self.sheet.width)
        rows_d, slices_d = upload(self.device, places.rows), upload(self.device, places.slices)
        values_d, weights_d = (
            allocate(self.device, 4 * shape[0] * shape[1]),
            allocate(self.device, 4 * shape[0] * shape[1]),
        )
        count, own_first = 0, places.first
        while count == 0 or own_first < places.end:
            held_end = places.end if resident_d is not None else min(own_first + slices, places.end)
            own_end = held_end if held_end == places.end else held_end - 1
            with self.stopwatch.timed("upload"):
                part = self.volume.voxels[own_first:held_end]
                voxels_d = upload(self.device, part) if resident_d is None else resident_d
            first_k = own_first if resident_d is None else 0
            with self.stopwatch.running(self.device):
                self._launch_rows(
                    (voxels_d, rows_d, slices_d, values_d, weights_d),
                    [np.int32(n) for n in (first_k, own_first, own_end)], np.int32(count == 0),
                )  # fmt: skip
            if resident_d is None:
                self.volume.release_slices(own_first, held_end)
            count, own_first = count + 1, own_end
            if progress is not None:
                progress("slabs", own_end - places.first, places.end - places.first)
        with self.stopwatch.timed("download"):
            values = download(self.device, np.empty(shape, np.float32), values_d)
            weights = download(self.device, np.empty(shape, np.float32), weights_d)
        empty = weights == 0.0
        if COMBINATIONS[self.combine] == "mean":
            values = values / np.where(empty, np.float32(1.0), weights)
        values[empty] = np.nan
        held = 0 if resident_d is not None else min(slices, places.end - places.first)
        return Reformation(values, places.end - places.first, count, sum(self.needs(held).values()))

    def _launch_rows(self, buffers: tuple[Any, ...], part: list[Any], fresh: Any) -> None:
        height, width = self.sheet.height, self.sheet.width
        rows = max(1, SAMPLES_A_LAUNCH // (width * (self.samples.intervals + 1)))
        for first in range(0, height, rows):
            count = min(rows, height - first)
            launch(
                self.device, self.program["reformat_rows"], count * width, *buffers,
                *(np.uint32(n) for n in (first, count, width)), *(np.int32(n) for n in self.volume.shape_ijk), *part,
                np.int32(self.samples.intervals), np.int32(self.combine), fresh, stopwatch=self.stopwatch,
            )  # fmt: skip


def sample_sheet(
    device: Device,
    volume: Volume,
    sheet: Sheet,
    samples: SlabSamples,
    combine: str = "mean",
    *,
    memory: int | None = None,
    voxels_d: Any = None,
    stopwatch: Stopwatch | None = None,
    progress: Progress | None = None,
) -> Reformation:
    """Values of all pixels of a sheet: the trilinear field, combined through a slab.

    Only slices that the sheet meets go to the device; where they do not fit, some at a time.  Single samples, `max`
    and `min` are then the same bit for bit, means to the rounding of their sums.

    Parameters
    ----------
    device : Device
    volume : Volume
    sheet : Sheet
    samples : SlabSamples
    combine : {"mean", "max", "min"}
        Of the samples of a pixel that lie within the volume.
    memory : int, optional
        Bytes that may be taken on the device; None is all of its memory.
    voxels_d : buffer, (nk, nj, ni), optional
        The whole volume, where it is on the device already; it does not count as `memory`.
    stopwatch : Stopwatch, optional
    progress : callable, optional
        Called as ``progress("slabs", slices done, all slices)``.

    Raises
    ------
    UsageError
        `combine` is none of the three, or the sheet lies absurdly far away.
    DeviceError
        Two slices and the picture do not fit the device, or it fails.
    """
    if not isinstance(combine, str) or combine not in COMBINATIONS:
        raise UsageError(f"the samples of a slab are combined by one of {', '.join(COMBINATIONS)}, not {combine!r}")
    run = _Run(device, volume, sheet, samples, COMBINATIONS.index(combine), stopwatch or Stopwatch())
    slices = run.plan(memory) if voxels_d is None else volume.shape_ijk[2]
    while True:
        try:
            return run.all_slabs(slices, voxels_d, progress)
        except DeviceMemoryError:
            if slices <= 2 or voxels_d is not None:
                raise
            slices = max(2, slices // 2)
