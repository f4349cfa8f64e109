"""A volume on a device for rays: its slices, in slabs where they do not fit at once, and what bricks of it hold."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    check_budget,
    describe_shortage,
    download,
    launch,
    load_program,
    memory_limits,
    upload,
)
from clrecon.operators.resident.frame import BOX_BORDER, enclose
from clrecon.operators.resident.stack_table import StackTable
from clrecon.operators.resident.voxel_types import voxel_variants
from clrecon.rendering.views.camera import Camera

__all__ = [
    "BRICK_CELLS",
    "FARTHEST",
    "LeapMap",
    "RaySlab",
    "ResidentVolume",
    "entry_slice",
    "pad_slices",
    "ray_variants",
]

BRICK_CELLS = 4
"""Cells of a brick along i and j, as in cl/include/leap.h."""

FARTHEST = 15
"""Bricks that a leap goes at most, as in cl/include/leap.h: with that as its margin none is left."""


ROWS_AT_ONCE = 4
"""Rows of bricks that a work-item takes, as in cl/render/occupancy.cl."""


def choose_brick_cells(volume: Volume) -> tuple[int, int, int]:
    """Cells of a brick along i, j and k: fewer along k where slices lie farther apart than voxels in them."""
    di, dj, dk = volume.spacing
    across = dk / max(di, dj)
    return BRICK_CELLS, BRICK_CELLS, 1 if across >= 3.0 else 2 if across >= 1.5 else BRICK_CELLS


OVERLAP = 2
"""Slices that a slab holds beyond its own at either side: those that cells and gradients at its ends read."""

MOST_VOXELS = (1 << 31) - 1
"""Of a slab, where kernels take several samples at once: what they differ by in their places is an int."""


def entry_slice(volume: Volume, camera: Camera) -> float:
    """Slice coordinate that the rays of a picture come from, see `ResidentVolume.slabs`; infinite for parallel rays."""
    if camera.is_parallel:  # however far back they begin, in a view along the slices too
        normal = slice_normal(volume.affine)
        rate = float(normal @ camera.basis().forward) * float(normal @ volume.affine[:3, 2])
        return -np.inf if rate > 0.0 else np.inf
    return float(volume.lps_to_ijk([camera.position])[0, 2])


def ray_variants(device: Device, dtype: np.dtype[Any]) -> dict[str, str]:
    """``-D`` definitions for kernels that sample volumes of `dtype` along rays."""
    lanes = {"LANES": device.kernel_variants["LANES"]}
    return {**voxel_variants(dtype), **lanes, "VOXEL_IS_SHORT": str(int(dtype == np.int16))}


@dataclass
class LeapMap:
    """Which bricks of a slab show something, and how far the next one is.

    Attributes
    ----------
    distances_d : buffer, (bk, bj, bi) uint8
        Chebyshev distance in bricks, 0 where something shows.
    box : (low, high) or None
        Field coordinates of the part of the volume that all bricks with something lie in; None where there is none.
    """

    distances_d: Any
    box: tuple[Float64Array, Float64Array] | None


@dataclass
class RaySlab:
    """Slices ``first_k`` to ``end_k - 1`` of a volume on the device, at least two along each axis.

    Attributes
    ----------
    voxels_d : buffer, (end_k - first_k, nj, ni)
    shape_ijk : (ni, nj, slices) of the buffer
    low_k, high_k : float
        Samples with ``low_k <= k < high_k`` are this slab's.
    stage : int
        Bit 0: the first slab that a picture goes through, bit 1: the last.
    """

    voxels_d: Any
    shape_ijk: tuple[int, int, int]
    first_k: int
    low_k: float
    high_k: float
    brick_cells: tuple[int, int, int]
    stage: int = 3
    ranges_d: Any = None
    maps: dict[Any, LeapMap] = field(default_factory=dict)

    @property
    def bricks(self) -> tuple[int, int, int]:
        """(bi, bj, bk)."""
        bi, bj, bk = (max(1, -(-(n - 1) // c)) for n, c in zip(self.shape_ijk, self.brick_cells, strict=True))
        return bi, bj, bk

    @property
    def brick_arguments(self) -> tuple[np.int32, ...]:
        """How kernels are told of bricks: (bi, bj, bk), and cells of each along k."""
        return tuple(np.int32(n) for n in (*self.bricks, self.brick_cells[2]))

    @property
    def end_k(self) -> int:
        """The slice after the last of the buffer."""
        return self.first_k + self.shape_ijk[2]


def pad_slices(voxels: NDArray[Any]) -> NDArray[Any]:
    """Voxels with every axis of length 1 doubled: a cell needs two, and the field is the same."""
    for axis, length in enumerate(voxels.shape):
        if length == 1:
            voxels = np.repeat(voxels, 2, axis=axis)
    return voxels


class ResidentVolume:
    """A volume on a device, whole or slab by slab.

    Parameters
    ----------
    volume : Volume
        Its voxels must not change.
    device : Device
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.
    """

    def __init__(self, volume: Volume, device: Device, memory: int | None = None):
        self.volume = volume
        self.device = device
        self.memory = memory
        self.dtype = volume.voxels.dtype
        self._whole: RaySlab | None = None
        self._context = device.context
        self._stack = StackTable.of(volume, device)
        self.brick_cells = choose_brick_cells(volume)

    def close(self) -> None:
        """Free what is on the device."""
        self._whole = None

    @property
    def stack(self) -> StackTable:
        """Where the slices lie, on the device."""
        if self._context is not self.device.context:  # it failed, and what was there is lost
            self._context = self.device.context
            self._whole = None
            self._stack = StackTable.of(self.volume, self.device)
        return self._stack

    def program(self, name: str, **variants: str) -> Program:
        """Build a kernel file for this volume's type of voxels."""
        own = {"UNEVEN": "1"} if self.volume.uneven else {}
        return load_program(self.device, name, {**ray_variants(self.device, self.dtype), **own, **variants})

    def slab_bytes(self, slices: int) -> dict[str, int]:
        """Bytes of a slab of so many slices on the device."""
        ni, nj, _ = (max(2, n) for n in self.volume.shape_ijk)
        bricks = math.prod(-(-n // c) for n, c in zip((ni, nj, max(2, slices)), self.brick_cells, strict=True))
        size = self.dtype.itemsize
        return {"volume": ni * nj * max(2, slices) * size, "bricks": bricks * (2 * size + 4)}

    def plan(self, others: dict[str, int], extra: dict[str, int], beside: int = 0) -> int:
        """Slices a slab, all where everything fits.

        Parameters
        ----------
        others, extra : dict of str to int
            Bytes of what else is on the device, and of what comes with more than one slab.
        beside : int
            Bytes a voxel of what a slab has with it, such as labels.

        Raises
        ------
        DeviceError
            Not even the smallest slab fits.
        """
        ni, nj, nk = self.volume.shape_ijk

        def needs(slices: int) -> dict[str, int]:
            with_it = {"labels": beside * max(2, ni) * max(2, nj) * max(2, slices)} if beside else {}
            return {**self.slab_bytes(slices), **with_it, **others}

        limits = memory_limits(self.device, self.memory)
        most = MOST_VOXELS // (max(2, ni) * max(2, nj)) if int(self.device.kernel_variants["LANES"]) > 1 else nk
        if nk <= most and not describe_shortage(limits, needs(nk)):
            return nk
        low, high = 0, nk
        while high - low > 1:
            slices = (low + high) // 2
            held = slices + 2 * OVERLAP + 1
            if held > most or describe_shortage(limits, {**needs(held), **extra}):
                high = slices
            else:
                low = slices
        if low == 0:
            check_budget(self.device, {**needs(2 * OVERLAP + 2), **extra}, self.memory)
        return max(low, 1)

    def slabs(self, slices: int, entry_k: float, stopwatch: Stopwatch) -> Iterator[RaySlab]:
        """The volume in slabs of `slices` slices, from the one that the rays come from on.

        Parameters
        ----------
        slices : int
            As `plan` says.
        entry_k : float
            Slice coordinate of the camera: each ray goes away from it, so slabs are taken by their distance from it.
            Infinite: from that end on.
        """
        nk = self.volume.shape_ijk[2]
        _ = self.stack
        if slices >= nk:
            whole = self._whole
            if whole is None:
                whole = self._whole = self._upload(0, nk, -np.inf, np.inf, stopwatch)
            yield whole
            return
        self._whole = None
        parts = [(first, min(first + slices, nk)) for first in range(0, nk, slices)]
        if np.isfinite(entry_k):
            parts.sort(key=lambda part: max(part[0] - entry_k, entry_k - part[1], 0.0))
        elif entry_k > 0.0:
            parts.reverse()
        for number, (first, end) in enumerate(parts):
            low, high = (-np.inf if first == 0 else first), (np.inf if end == nk else end)
            slab = self._upload(max(first - OVERLAP, 0), min(end + OVERLAP + 1, nk), low, high, stopwatch)
            slab.stage = (number == 0) + 2 * (number == len(parts) - 1)
            yield slab
            self.volume.release_slices(first, end)

    def _upload(self, first: int, end: int, low: float, high: float, stopwatch: Stopwatch) -> RaySlab:
        voxels = pad_slices(self.volume.voxels[first:end])
        with stopwatch.timed("upload"):
            voxels_d = upload(self.device, voxels)
        nk, nj, ni = voxels.shape
        return RaySlab(voxels_d, (ni, nj, nk), first, low, high, self.brick_cells)

    def measure(self, slab: RaySlab, stopwatch: Stopwatch) -> Any:
        """Lowest and highest value that samples in each brick of a slab can have, (bk, bj, bi, 2), on the device."""
        if slab.ranges_d is None:
            bi, bj, bk = slab.bricks
            slab.ranges_d = allocate(self.device, 2 * bi * bj * bk * self.dtype.itemsize)
            launch(
                self.device, self.program("render/occupancy.cl")["measure_cells"], bi * bj * bk,
                slab.voxels_d, slab.ranges_d, *(np.int32(n) for n in slab.shape_ijk),
                *(np.uint32(n) for n in (bi, bj, bk)), np.int32(slab.brick_cells[2]), stopwatch=stopwatch,
            )  # fmt: skip
        return slab.ranges_d

    def find_leaps(
        self, slab: RaySlab, key: Any, shown: NDArray[np.bool_], low: float, scale: float, stopwatch: Stopwatch
    ) -> LeapMap:
        """The leap map for values that show, or the one that was made for `key` before.

        Parameters
        ----------
        key : hashable
            What `shown` follows from.
        shown : ndarray, shape (nodes,), bool
            Which nodes of a table of values show anything.
        low, scale : float
            Nearest node to a value v: ``floor((v - low) * scale + 0.5)``, within the table.
        """
        known = slab.maps.get(key)
        if known is not None:
            return known
        ranges_d = self.measure(slab, stopwatch)
        device, program = self.device, self.program("render/occupancy.cl")
        bi, bj, bk = slab.bricks
        bricks = bi * bj * bk
        counts_d = upload(device, np.concatenate([[0], np.cumsum(shown)]).astype(np.int32))
        from_d, to_d = allocate(device, bricks), allocate(device, bricks)
        launch(
            device, program["mark_bricks"], bricks,
            ranges_d, counts_d, from_d, np.float32(low), np.float32(scale), np.int32(len(shown)), np.uint32(bricks),
            stopwatch=stopwatch,
        )  # fmt: skip
        launch(
            device, program["spread_in_rows"], -(-bj * bk // ROWS_AT_ONCE),
            from_d, to_d, np.int32(bi), np.uint32(bj * bk), stopwatch=stopwatch,
        )  # fmt: skip
        for outer, count, stride in ((bk, bj, bi), (1, bk, bi * bj)):
            from_d, to_d = to_d, from_d
            chunks = -(-stride // 16)
            items = outer * count * chunks
            launch(
                device, program["spread_along"], items,
                from_d, to_d, np.int32(count), np.int32(stride), np.int32(chunks), np.uint32(items),
                stopwatch=stopwatch,
            )  # fmt: skip
        from_d = to_d
        slab.maps.clear()  # one a slab: a map is made in some milliseconds
        marked = download(device, np.empty((bk, bj, bi), np.uint8), from_d) == 0
        made = slab.maps[key] = LeapMap(from_d, self._find_box(marked, slab))
        return made

    def _find_box(self, marked: NDArray[np.bool_], slab: RaySlab) -> tuple[Float64Array, Float64Array] | None:
        ends = []
        across = np.any(marked, axis=0)
        each = np.any(across, axis=0), np.any(across, axis=1), np.any(marked, axis=(1, 2))
        for along, cells in zip(each, self.brick_cells, strict=True):
            where = np.flatnonzero(along)
            if not len(where):
                return None
            ends.append((where[0] * cells, (where[-1] + 1) * cells))
        low, high = np.array(ends, dtype=np.float64).T
        low[2] += slab.first_k
        high[2] += slab.first_k
        # Cells at the ends reach to the border of the volume.
        return enclose(self.volume, low - BOX_BORDER, high + BOX_BORDER)
