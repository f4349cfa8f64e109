"""Variants of kernels for the type of a volume's voxels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from clrecon.opencl import Device

_NAMES = {
    "int8": "char", "uint8": "uchar", "int16": "short", "uint16": "ushort", "int32": "int", "float32": "float",
}  # fmt: skip


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
