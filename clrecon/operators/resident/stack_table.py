"""The table of uneven slices for kernels, see cl/rays/stack.h."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.iso_rule import slice_normal_matrices
from clrecon.opencl import Device, upload
from clrecon.operators.resident.frame import FieldFrame

MOST_LAYERS = 1 << 16
"""Most entries of the lookup by height; with smaller gaps kernels continue from slice to slice."""


@dataclass(frozen=True)
class StackTable:
    """The place of each slice.

    arguments: The arguments of kernels with STACK_PARAMETERS; none for even volumes.
    slope: ndarray, shape (4,), float32. Largest number of index steps along i, j and k per mm of height.
    """

    arguments: dict[str, Any]
    slope: NDArray[np.float32]

    @classmethod
    def of(cls, volume: Volume, device: Device) -> StackTable:
        """Make the table of a volume on the device."""
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
        count = int(min(np.ceil(heights[-1] / gaps.min()) + 1, MOST_LAYERS))
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
        """Return the most index steps (3,) between places that differ by `apart` (3,) in field coordinates, not
        negative.
        """
        if not self.arguments:
            return apart
        # Places at another height are also shifted sideways.
        steps: Float64Array = np.array([apart[0], apart[1], 0.0]) + apart[2] * self.slope[:3]
        return steps
