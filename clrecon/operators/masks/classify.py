"""The kernels that mark the samples of a volume on one side of a level, or between two: cl/masks/classify.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from clrecon.opencl import Device, Program, load_program
from clrecon.operators.resident.voxel_types import voxel_variants


def prepare_classify(device: Device, dtype: DTypeLike = np.int16, inside: str = "above") -> Program:
    """Build the kernels for volumes of `dtype`; `inside` as in `IsoRule.inside`."""
    own = {"above": {}, "below": {"BORDER_INSIDE": "1"}, "between": {"RANGE": "1"}}[inside]
    return load_program(device, "masks/classify.cl", {**voxel_variants(dtype), **device.kernel_variants, **own})
