"""Checks of masks: joined, inverted, counted, of boxes and tubes, and volumes of what they choose."""

from __future__ import annotations

import numpy as np

from clrecon.errors import DeviceError
from clrecon.jobs.selftest.check import Check, require_equal
from clrecon.jobs.selftest.scenes import OBLIQUE, noise, stack
from clrecon.opencl import Device
from clrecon.operators.masks.mask import Mask
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.reference.masks import regions as twin

__all__ = ["CHECKS"]

SHAPE = (26, 41, 70)
"""Voxels (k, j, i): more than 1,000 rows, and three words in each."""


def _check_logic(device: Device) -> str:
    volume = stack(noise(SHAPE, "int16", 100), OBLIQUE)
    a, b = volume.voxels > 40, volume.voxels % 3 == 0
    with DeviceVolume(volume, device=device) as resident:
        one, other = Mask.from_array(resident, a), Mask.from_array(resident, b)
        for made, expected, what in (
            (one & other, a & b, "and"), (one | other, a | b, "or"), (one ^ other, a ^ b, "exclusive or"),
            (one - other, a & ~b, "and not"), (~one, ~a, "not"),
        ):  # fmt: skip
            require_equal(made.to_numpy(), expected, f"{what} of masks")
            if made.count != expected.sum():
                raise DeviceError(f"{what} of masks: {made.count:,} voxels are counted in place of {expected.sum():,}")
        kept = one.apply(resident).volume.voxels
    require_equal(kept, np.where(a, volume.voxels, -1024), "a volume of what a mask chooses")
    return f"{a.size:,} voxels equal"


def _check_regions(device: Device) -> str:
    said = 0
    for uneven in (False, True):
        volume = stack(noise(SHAPE, "int16", 100), OBLIQUE, uneven)
        places = twin.find_places(volume)
        low, high = places[2, 3, 4], places[-4, -5, -6]
        sides = np.stack([np.minimum(low, high), np.maximum(low, high)], axis=1)
        line = places[[1, 9, 20], [5, 30, 12], [60, 20, 40]]
        with DeviceVolume(volume, device=device) as resident:
            box, tube = Mask.from_box(resident, sides.ravel().tolist()), Mask.from_tube(resident, line, 6.0)
        require_equal(box.to_numpy(), twin.find_in_box(volume, sides), "the voxels in a box")
        require_equal(tube.to_numpy(), twin.find_in_tube(volume, line, 6.0), "the voxels in a tube")
        said += box.count + tube.count
    return f"{said:,} voxels equal"


CHECKS = (
    Check(
        "logic of masks",
        ("combine_masks", "invert_mask", "count_row_bits", "replace_outside"),
        _check_logic,
    ),
    Check("boxes and tubes", ("write_runs",), _check_regions),
)
