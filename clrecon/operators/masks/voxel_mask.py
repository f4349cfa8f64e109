"""Bit masks of voxels on a device: marked from a band of HU or a list of voxels, joined, inverted and counted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import voxel_variants
from clrecon.points.cloud import VoxelNumbers
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_band


def prepare_classify(device: Device, dtype: DTypeLike = np.int16, inside: str = "above") -> Program:
    """Build the kernels for volumes of `dtype`; `inside` as in `IsoRule.inside`."""
    variants = {"above": {}, "below": {"BORDER_INSIDE": "1"}, "between": {"RANGE": "1"}}[inside]
    return ocl.load_program(
        device, "masks/classify.cl", {**voxel_variants(dtype), **device.kernel_variants, **variants}
    )


LONGEST_ROW = 65_535
"""Most voxels in a row: columns of runs have 16 bits."""

MOST_WORDS = 2**31 - 1
"""Most words of a mask, so that their places fit a signed 32-bit integer."""

BAND = "voxels of a band"
"""Purpose by which slabs are planned."""


@dataclass(frozen=True)
class VoxelMask:
    """One bit for each voxel of a volume, on a device; the last `pad` words of a row are zeros.

    `row_extents_d`, (nk, nj, 2) uint16, are the first word of a row with a bit set, and the one after the last, or 0,
    0.
    """

    mask_d: Any
    row_extents_d: Any
    shape_ijk: tuple[int, int, int]
    words: int
    pad: int

    @property
    def rows(self) -> int:
        return self.shape_ijk[1] * self.shape_ijk[2]

    def needs(self) -> dict[str, int]:
        return mask_bytes(self.shape_ijk, self.pad)


def mask_bytes(shape_ijk: tuple[int, int, int], pad: int = 0) -> dict[str, int]:
    ni, nj, nk = shape_ijk
    return {"mask of the voxels": 4 * (-(-ni // 32) + pad) * nj * nk, "row extents": 4 * nj * nk}


_OPEN_BAND = (-math.inf, math.inf)


def checked_band(hu: ArrayLike | Sequence[float | None]) -> tuple[float, float]:
    """Return the two ends of a band of HU, both included; None or infinity leaves an end open."""
    try:
        ends = np.asarray(hu, dtype=object).tolist()
        low, high = (open_end if end is None else float(end) for end, open_end in zip(ends, _OPEN_BAND, strict=True))
    except (TypeError, ValueError, OverflowError):
        low = high = math.nan
    if not low <= high:
        raise UsageError(f"{name_parameter('hu')}: a band is two numbers in HU, the lower one first, not {hu!r}")
    return low, high


def check_shape(shape_ijk: tuple[int, int, int], pad: int = 0) -> None:
    """Refuse volumes whose masks are too large."""
    ni, nj, nk = shape_ijk
    words = -(-ni // 32) + pad
    if ni > LONGEST_ROW or words * nj * nk > MOST_WORDS:
        raise UsageError(
            f"the volume has {ni:,} x {nj:,} x {nk:,} voxels: masks hold rows of up to {LONGEST_ROW:,}, and up to"
            f" {MOST_WORDS:,} words of 32 voxels ({words * nj * nk:,} here)"
        )


def band_bounds(volume: Volume, hu: tuple[float, float]) -> tuple[Any, Any]:
    """Return the band's ends as scalars of the voxels' type: for whole numbers the first and last within."""
    dtype = volume.voxels.dtype
    if dtype.kind == "f":
        most = float(np.finfo(dtype).max)
        return dtype.type(max(hu[0], -most)), dtype.type(min(hu[1], most))
    limits = np.iinfo(dtype)
    low, high = max(hu[0], float(limits.min)), min(hu[1], float(limits.max))
    if math.ceil(low) > math.floor(high):
        raise NoSurfaceError(f"no voxel can have {format_band(*hu)}: voxels are {dtype}")
    return dtype.type(math.ceil(low)), dtype.type(math.floor(high))


def mark_band(
    resident: DeviceVolume,
    hu: tuple[float, float],
    *,
    pad: int = 0,
    beside: Mapping[str, int] | None = None,
    stopwatch: Stopwatch | None = None,
    progress: Progress = ignore_progress,
) -> VoxelMask:
    """Mark the voxels from ``hu[0]`` to ``hu[1]`` HU, both included, see `checked_band`; NaN lies in no band.

    The mask is that of the whole volume.  Where its voxels do not fit beside it, they go to the device slab by slab.

    pad: Words of zeros behind each row.
    beside: Bytes on the device that are taken already, or will be as long as voxels are there.
    """
    volume, stopwatch = resident.volume, stopwatch or Stopwatch()
    check_shape(volume.shape_ijk, pad)
    bounds = band_bounds(volume, hu)
    ni, nj, nk = volume.shape_ijk
    words = -(-ni // 32) + pad
    masks = {**mask_bytes(volume.shape_ijk, pad), **(beside or {})}

    def needs(slices: int) -> dict[str, int]:
        part = {f"{what} of a slab": size for what, size in mask_bytes((ni, nj, slices), pad).items()}
        return {"volume": slices * resident.slice_bytes, **masks, **({} if slices == nk else part)}

    planned = resident.plan(BAND, nk, needs)
    if planned == 0:
        needed = sum(needs(1).values())
        raise resident.limits.refusal(f"the mask of the voxels and one slice need {needed:,} bytes")
    run = _Marking(resident, bounds, words, pad, stopwatch, progress)
    for attempt in resident.attempts(BAND, planned):
        with attempt as slices:
            mask = run.mark(slices)
    return mask


@dataclass(frozen=True, eq=False)
class _Marking:
    """One mask, whatever the number of slices in a slab."""

    resident: DeviceVolume
    bounds: tuple[Any, Any]
    words: int
    pad: int
    stopwatch: Stopwatch
    progress: Progress

    def mark(self, slices: int) -> VoxelMask:
        resident, device = self.resident, self.resident.device
        ni, nj, nk = resident.volume.shape_ijk
        mask_d, extents_d = ocl.allocate(device, 4 * self.words * nj * nk), ocl.allocate(device, 4 * nj * nk)
        if slices == nk:
            voxels_d = resident.whole(self.stopwatch)
            with self.stopwatch.running(device):
                self._classify(voxels_d, mask_d, extents_d, nk)
            return VoxelMask(mask_d, extents_d, (ni, nj, nk), self.words, self.pad)
        resident.make_way()
        part_d, part_extents_d = (ocl.allocate(device, size * nj * slices) for size in (4 * self.words, 4))
        for first in range(0, nk, slices):
            end = min(first + slices, nk)
            voxels_d = resident.part(first, end, self.stopwatch)
            with self.stopwatch.running(device):
                self._classify(voxels_d, part_d, part_extents_d, end - first)
                for source_d, target_d, size in (
                    (part_d, mask_d, 4 * self.words * nj),
                    (part_extents_d, extents_d, 4 * nj),
                ):
                    ocl.copy_buffer(device, source_d, target_d, size * (end - first), size * first)
            resident.volume.release_slices(first, end)
            self.progress("mask", end, nk)
        return VoxelMask(mask_d, extents_d, (ni, nj, nk), self.words, self.pad)

    def _classify(self, voxels_d: Any, mask_d: Any, extents_d: Any, slices: int) -> None:
        volume = self.resident.volume
        ni, nj, _ = volume.shape_ijk
        ocl.launch(
            self.resident.device,
            prepare_classify(self.resident.device, volume.voxels.dtype, "between")["classify_samples"], nj * slices,
            voxels=voxels_d, mask=mask_d, row_extents=extents_d, level=self.bounds[0], highest=self.bounds[1], ni=ni,
            nj=nj, nk=slices, border=0, first_slice=0, first_sample_slice=0, gk=slices, words=self.words,
        )  # fmt: skip


def zero_words(device: Device, words: int) -> Any:
    """Return a buffer of words of 32 zero bits that kernels may write: uploaded buffers are for reading alone."""
    words_d = ocl.allocate(device, 4 * words)
    clear = ocl.load_program(device, "masks/band_mask.cl")["clear_words"]
    ocl.launch(device, clear, words, mask=words_d, n=words)
    return words_d


def mark_voxels(
    device: Device, voxels: NDArray[np.int32] | VoxelNumbers, shape_ijk: tuple[int, int, int], *, pad: int = 0
) -> VoxelMask:
    """Mark voxels within the volume, by index, (n, 3), or by number, with `pad` words of zeros behind each row."""
    check_shape(shape_ijk, pad)
    ni, nj, nk = shape_ijk
    words, rows = -(-ni // 32) + pad, nj * nk
    program = ocl.load_program(device, "masks/band_mask.cl")
    mask_d, extents_d = zero_words(device, words * rows), ocl.allocate(device, 4 * rows)
    if isinstance(voxels, VoxelNumbers):
        n, kernel = len(voxels.numbers), "set_numbered_bits"
        given = {"numbers": np.ascontiguousarray(voxels.numbers, np.uint32)}
        sizes = {"ni": ni}
    else:
        n, kernel = len(voxels), "set_bits"
        given, sizes = {"ijk": np.ascontiguousarray(voxels, np.int32)}, {"nj": nj}
    if n:
        given_d = {name: ocl.upload(device, values) for name, values in given.items()}
        ocl.launch(device, program[kernel], n, mask=mask_d, n=n, words=words, **given_d, **sizes)
    ocl.launch(device, program["find_extents"], rows, mask=mask_d, row_extents=extents_d, rows=rows, words=words)
    return VoxelMask(mask_d, extents_d, shape_ijk, words, pad)


_OPERATIONS = {
    "and": ocl.kernel_constant("masks/logic.cl", "OPERATION_AND"),
    "or": ocl.kernel_constant("masks/logic.cl", "OPERATION_OR"),
    "xor": ocl.kernel_constant("masks/logic.cl", "OPERATION_XOR"),
    "and not": ocl.kernel_constant("masks/logic.cl", "OPERATION_AND_NOT"),
}
"""Words of an operation, and its number in the kernel."""


def prepare_logic(device: Device, dtype: DTypeLike = np.int16) -> Program:
    return ocl.load_program(device, "masks/logic.cl", voxel_variants(dtype))


def combine(device: Device, a_d: Any, b_d: Any, shape_ijk: tuple[int, int, int], operation: str) -> Any:
    """Return the words of two masks of one shape joined; `operation` is one of `_OPERATIONS`."""
    words, rows = _words(shape_ijk)
    combined_d = ocl.allocate(device, 4 * words * rows)
    ocl.launch(
        device, prepare_logic(device)["combine_masks"], words * rows, a=a_d, b=b_d,
        combined=combined_d, n=words * rows, operation=_OPERATIONS[operation],
    )  # fmt: skip
    return combined_d


def invert(device: Device, mask_d: Any, shape_ijk: tuple[int, int, int]) -> Any:
    words, rows = _words(shape_ijk)
    inverted_d = ocl.allocate(device, 4 * words * rows)
    ocl.launch(
        device, prepare_logic(device)["invert_mask"], words * rows, mask=mask_d,
        inverted=inverted_d, n=words * rows, ni=shape_ijk[0], words=words,
    )  # fmt: skip
    return inverted_d


def count_bits(device: Device, mask_d: Any, shape_ijk: tuple[int, int, int]) -> int:
    words, rows = _words(shape_ijk)
    counts, counts_d = ocl.empty_output(device, (rows,), np.uint32)
    ocl.launch(
        device, prepare_logic(device)["count_row_bits"], rows, mask=mask_d, counts=counts_d, rows=rows, words=words
    )
    return int(ocl.download(device, counts, counts_d).sum(dtype=np.int64))


def find_extents(device: Device, mask_d: Any, shape_ijk: tuple[int, int, int]) -> VoxelMask:
    words, rows = _words(shape_ijk)
    extents_d = ocl.allocate(device, 4 * rows)
    ocl.launch(
        device, ocl.load_program(device, "masks/band_mask.cl")["find_extents"], rows, mask=mask_d,
        row_extents=extents_d, rows=rows, words=words,
    )  # fmt: skip
    return VoxelMask(mask_d, extents_d, shape_ijk, words, 0)


def replace_outside(
    device: Device, voxels_d: Any, dtype: np.dtype[Any], mask_d: Any, shape_ijk: tuple[int, int, int], outside: float
) -> tuple[NDArray[Any], Any]:
    """Return voxels with `outside` where the mask is not set: a host array, (nk, nj, ni), and a buffer."""
    ni, nj, nk = shape_ijk
    words, rows = _words(shape_ijk)
    replaced, replaced_d = ocl.empty_output(device, (nk, nj, ni), dtype)
    ocl.launch(
        device, prepare_logic(device, dtype)["replace_outside"], rows, voxels=voxels_d,
        mask=mask_d, replaced=replaced_d, outside=dtype.type(outside), rows=rows, words=words, ni=ni,
    )  # fmt: skip
    return ocl.download(device, replaced, replaced_d), replaced_d


def _words(shape_ijk: tuple[int, int, int]) -> tuple[int, int]:
    ni, nj, nk = shape_ijk
    return -(-ni // 32), nj * nk
