"""Checks of masks: joined, inverted, counted, of boxes and tubes, and volumes of what they choose."""

from __future__ import annotations

import numpy as np

from clrecon.errors import DeviceError
from clrecon.opencl import Device
from clrecon.operators.masks.mask import Mask
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.proof.checking.check import Check, require_equal
from clrecon.proof.checking.scenes import OBLIQUE, noise, stack
from clrecon.proof.masks import mask_twins as balls_twin
from clrecon.proof.masks import mask_twins as components_twin
from clrecon.proof.masks import mask_twins as twin

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


def _check_balls(device: Device) -> str:
    said = 0
    for uneven, columns in ((False, 70), (True, 70), (False, 530)):
        shape = (*SHAPE[:2], columns) if columns == SHAPE[2] else (9, 60, columns)
        affine = OBLIQUE if columns == SHAPE[2] else np.diag((0.6, 0.6, 1.5, 1.0))
        volume = stack(noise(shape, "int16", 100), affine, uneven)
        few, many = volume.voxels > 97, volume.voxels > 2
        with DeviceVolume(volume, device=device) as resident:
            one, other = Mask.from_array(resident, few), Mask.from_array(resident, many)
            for made, expected, what in (
                (one.dilate(1.3), balls_twin.dilate(volume, few, 1.3), "dilation"),
                (other.erode(1.3), balls_twin.erode(volume, many, 1.3), "erosion"),
                (one.close(1.3), balls_twin.close(volume, few, 1.3), "closing"),
            ):
                require_equal(made.to_numpy(), expected, f"{what} by a ball, rows of {columns} voxels")
        said += 3 * few.size
    return f"{said:,} voxels equal"


def _check_components(device: Device) -> str:
    volume = stack(noise(SHAPE, "int16", 100), OBLIQUE)
    chosen = volume.voxels > 42
    with DeviceVolume(volume, device=device) as resident:
        mask = Mask.from_array(resident, chosen)
        filled, flat = mask.fill_holes(), mask.fill_holes(by_slice=True)
        lone = Mask.from_array(resident, volume.voxels > 70)
        at = np.argwhere(volume.voxels > 70)[::9]
        grown = lone.grow(volume.ijk_to_lps(at[:, ::-1]))
    require_equal(filled.to_numpy(), components_twin.fill_holes(chosen), "filled holes")
    require_equal(flat.to_numpy(), components_twin.fill_holes(chosen, by_slice=True), "filled holes of slices")
    require_equal(grown.to_numpy(), components_twin.grow(volume.voxels > 70, at), "components grown from points")
    return f"{len(at):,} points, {filled.count - mask.count:,} voxels of holes equal"


CHECKS = (
    Check("balls", ("spread_ball",), _check_balls),
    Check("holes and growing", ("mark_border_runs", "mark_voxel_runs", "write_runs"), _check_components),
    Check(
        "logic of masks",
        ("combine_masks", "invert_mask", "count_row_bits", "replace_outside"),
        _check_logic,
    ),
    Check("boxes and tubes", ("write_runs",), _check_regions),
)
