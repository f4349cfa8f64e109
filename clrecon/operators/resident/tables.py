"""What kernels are told of a volume: variants for the type of its voxels, its field coordinates, the table of uneven
slices (cl/rays/stack.h), and the ranges of its bricks, which are measured once and let later passes skip most bricks.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.iso_rule import slice_normal_matrices
from clrecon.opencl import Device, Program, allocate, kernel_constant, launch, load_program, upload
from clrecon.system.light_dataclass import dataclass

_NAMES = {"int8": "char", "uint8": "uchar", "int16": "short", "uint16": "ushort", "int32": "int", "float32": "float"}


def voxel_variants(dtype: DTypeLike) -> dict[str, str]:
    """Return ``-D`` definitions of VOXEL and VALUE, see cl/include/volume.h."""
    dtype = np.dtype(dtype)
    return {"VOXEL": _NAMES[dtype.name], "VALUE": "float" if dtype.kind == "f" else "int"}


def label_variants(dtype: DTypeLike) -> dict[str, str]:
    """Return the ``-D`` definition of LABEL, see cl/include/label_type.h."""
    return {"LABEL": _NAMES[np.dtype(dtype).name]}


def ray_variants(device: Device, dtype: np.dtype[Any]) -> dict[str, str]:
    """Return ``-D`` definitions for kernels that sample volumes of `dtype` along rays."""
    lanes = {"LANES": device.kernel_variants["LANES"]}
    return {**voxel_variants(dtype), **lanes, "VOXEL_IS_SHORT": str(int(dtype == np.int16))}


BOX_BORDER = 0.5
"""Index steps beyond the outermost voxel centres that still belong to a volume."""


@dataclass(frozen=True)
class FieldFrame:
    """The map from LPS mm to field coordinates, ``matrix @ p + offset``: indices; for uneven slices indices in the
    plane of slice 0, and height in mm.
    """

    matrix: Float64Array
    offset: Float64Array

    @classmethod
    def of(cls, volume: Volume) -> FieldFrame:
        if volume.uneven:
            origin = volume.slice_origins()[0]
            normal = slice_normal(volume.affine)
            if normal @ volume.affine[:3, 2] < 0.0:
                normal = -normal
            matrix = np.vstack([np.linalg.pinv(volume.affine[:3, :2]), normal])
            return cls(matrix, -matrix @ origin)
        inverse: Float64Array = np.asarray(np.linalg.inv(volume.affine), dtype=np.float64)
        return cls(inverse[:3, :3], inverse[:3, 3])

    def places(self, points: Float64Array) -> Float64Array:
        return points @ self.matrix.T + self.offset

    def planes(self, planes: Float64Array) -> Float64Array:
        """Convert half-spaces (n, 4) of LPS, ``normal . p >= offset``, to field coordinates."""
        normals = planes[:, :3] @ np.linalg.inv(self.matrix)
        return np.column_stack([normals, planes[:, 3] + normals @ self.offset])


def volume_box(volume: Volume) -> tuple[Float64Array, Float64Array]:
    """Return the lowest and highest field coordinates of a volume, half a voxel beyond its outermost centres."""
    return enclose(volume, np.full(3, -BOX_BORDER), np.array(volume.shape_ijk) - 1.0 + BOX_BORDER)


def enclose(volume: Volume, low: Float64Array, high: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the lowest and highest field coordinates of the box between two corners in voxel indices."""
    if not volume.uneven:
        return low, high
    ks = {low[2], high[2], *range(math.ceil(low[2]), math.floor(high[2]) + 1)}
    corners = [(i, j, k) for k, i, j in product(ks, (low[0], high[0]), (low[1], high[1]))]
    places = FieldFrame.of(volume).places(volume.ijk_to_lps(corners))
    return places.min(axis=0), places.max(axis=0)


_MOST_LAYERS = 1 << 16
"""Most entries of the lookup by height; with smaller gaps kernels continue from slice to slice."""


@dataclass(frozen=True)
class StackTable:
    """Arguments for STACK_PARAMETERS, none for even volumes; `slope` (4,) float32: most index steps per mm of z."""

    arguments: dict[str, Any]
    slope: NDArray[np.float32]

    @classmethod
    def of(cls, volume: Volume, device: Device) -> StackTable:
        slope = np.zeros(4, np.float32)
        if not volume.uneven:
            return cls({}, slope)
        nk = volume.shape_ijk[2]
        places = FieldFrame.of(volume).places(volume.slice_origins())
        heights = places[:, 2]
        gaps = np.diff(heights)
        table = np.zeros((nk, 4, 4), np.float32)
        table[:, 0, 0] = heights
        table[:, 0, 1:3] = places[:, :2]
        table[:-1, 0, 3] = 1.0 / gaps
        table[:, 1:, :3] = slice_normal_matrices(volume, border=0)
        count = int(min(np.ceil(heights[-1] / gaps.min()) + 1, _MOST_LAYERS))
        per_mm = count / heights[-1]
        # Half an entry lower, so that rounding in the kernel cannot skip a slice.
        starts = (np.arange(count) - 0.5) / per_mm
        layers = np.clip(np.searchsorted(heights, starts, side="right") - 1, 0, nk - 2).astype(np.int32)
        slope[:2] = np.abs(np.diff(places[:, :2], axis=0) / gaps[:, None]).max(axis=0)
        slope[2] = 1.0 / gaps.min()
        arguments = {
            "stack_slices": upload(device, table),
            "stack_layers": upload(device, layers),
            "layers_per_mm": per_mm,
            "layer_count": count,
            "stack_nk": nk,
        }
        return cls(arguments, slope)

    def index_steps(self, apart: Float64Array) -> Float64Array:
        """Return the most index steps (3,), not negative, between places `apart` (3,) in field coordinates."""
        if not self.arguments:
            return apart
        # Places at another height are also shifted sideways.
        steps: Float64Array = np.array([apart[0], apart[1], 0.0]) + apart[2] * self.slope[:3]
        return steps


BRICK = kernel_constant("include/bricks.h", "BRICK")
"""Voxels along each side of a brick."""


@dataclass(frozen=True)
class BrickRanges:
    """Lowest and highest value of every brick, (bk, bj, bi, 2) of the voxels' type; the shape is (bi, bj, bk)."""

    ranges_d: Any
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]


@dataclass(frozen=True)
class BrickStates:
    """The result of comparing words of 32 samples with an iso value, one row of words for each row of bricks: states_d
    (bk, bj, words) uint8, extents_d (bk, bj, 2) uint16.
    """

    states_d: Any
    extents_d: Any


def brick_bytes(shape_ijk: tuple[int, int, int], dtype: np.dtype[Any]) -> int:
    return 2 * math.prod(-(-n // BRICK) for n in shape_ijk) * int(dtype.itemsize)


def prepare_bricks(device: Device, dtype: np.dtype[Any]) -> Program:
    return load_program(device, "resident/bricks.cl", voxel_variants(dtype))


def measure_bricks(device: Device, voxels_d: Any, shape_ijk: tuple[int, int, int], dtype: np.dtype[Any]) -> BrickRanges:
    """Find the lowest and highest value of each brick of 8 x 8 x 8 voxels, or fewer at upper ends, none of them NaN."""
    ni, nj, nk = shape_ijk
    bi, bj, bk = (-(-n // BRICK) for n in shape_ijk)
    ranges_d = allocate(device, brick_bytes(shape_ijk, dtype))
    launch(
        device, prepare_bricks(device, dtype)["measure_bricks"], bi * bj * bk,
        voxels=voxels_d, ranges=ranges_d, ni=ni, nj=nj, nk=nk, bi=bi, bj=bj, bk=bk,
    )  # fmt: skip
    return BrickRanges(ranges_d, (bi, bj, bk), dtype)


def compare_bricks(device: Device, ranges: BrickRanges, level: Any, ni: int, border: int) -> BrickStates:
    """Classify each word of 32 samples by its bricks, all outside (0), all inside (1) or mixed (2), with extents of
    rows.

    The extent is the first word that is not all outside, and the one after the last; `level` is the lowest inside
    value. Word w begins at voxel ``32 * w - border``, up to ``ni - 1 + border``; samples beyond the volume are ignored.
    """
    _, bj, bk = ranges.shape
    words = -(-(ni + 2 * border) // 32)
    states_d, extents_d = allocate(device, words * bj * bk), allocate(device, 4 * bj * bk)
    launch(
        device, prepare_bricks(device, ranges.dtype)["compare_bricks"], bj * bk, ranges=ranges.ranges_d,
        states=states_d, extents=extents_d, level=level, ni=ni, border=border, words=words, rows=bj * bk,
    )  # fmt: skip
    return BrickStates(states_d, extents_d)
