"""Checks of filters of volumes."""

from __future__ import annotations

from functools import partial

import numpy as np

from clrecon.errors import DeviceError
from clrecon.opencl import Device, Stopwatch, download
from clrecon.operators.filters.bilateral import SlicesThere, list_mixed_groups, row_words, run_bilateral
from clrecon.operators.filters.settings import BilateralSettings
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.proof.checking.check import Check, require_close, require_equal
from clrecon.proof.checking.scenes import OBLIQUE, random_integers, stack
from clrecon.proof.filters import filter_twins as near_twin
from clrecon.proof.filters import filter_twins as twin

SHAPE = (9, 31, 53)
"""Rows of four groups: 1,116 of them, and 558 strips for the ends of the rows."""

ROUNDED_HU = 0.501
"""Largest difference of a whole number from the mean that it is rounded from."""

FLOAT_HU = 2e-3
"""Largest difference of a float: sums of 100 weights in float32, each within 4e-6."""


def _check_bilateral(device: Device, types: tuple[str, ...], uneven: bool) -> str:
    worst = 0.0
    for dtype in types:
        volume = stack(random_integers(SHAPE, dtype, 120), OBLIQUE, uneven)
        for dimensions, taps in ((3, 120), (2, 13)):
            settings = BilateralSettings.checked(volume, 0.8, 40.0, dimensions, None, False, taps)
            found = run_bilateral(DeviceVolume(volume, device=device), settings)
            if found.slabs != 1:
                raise DeviceError("filtered in parts: the device has too little memory")
            offsets = settings.window.offsets
            expected = twin.filter_bilateral(
                volume.voxels, offsets, twin.spatial_weights(volume, offsets, settings.sigma_mm), settings.sigma_hu
            )
            allowed = FLOAT_HU if volume.voxels.dtype.kind == "f" else ROUNDED_HU
            worst = max(worst, require_close(found.voxels, expected, allowed, f"filtered {dtype} voxels, in HU"))
    return f"{2 * len(types)} volumes within {worst:.2g} HU"


def _check_near_level(device: Device) -> str:
    """Compare the listed groups with the twin's, and a filter of them alone with that of all."""
    shape = (30, 40, 1100)
    k, j, i = np.indices(shape)
    values = 100.0 + 60.0 * np.sin(0.12 * j + 0.2 * k + 0.004 * i)
    volume = stack(np.rint(values).astype(np.int16), np.diag((0.9, 1.0, 1.1, 1.0)))
    ni, nj, nk = volume.shape_ijk
    for reach in ((3, 1, 2), (16, 4, 1)):
        resident = DeviceVolume(volume, device=device)
        there = SlicesThere(resident.whole(Stopwatch()), ni, nj, 0, nk, 0, nk)
        listed = list_mixed_groups(device, there, volume.voxels.dtype, np.int16(99), reach)
        numbers = download(device, np.empty(listed.count, np.uint32), listed.positions_d)
        rows, groups = numbers // (32 * row_words(ni)), numbers % (32 * row_words(ni))
        marked = np.zeros((nk * nj, -(-ni // near_twin.GROUP)), np.bool_)
        if groups.size and groups.max() >= marked.shape[1]:
            raise DeviceError("groups near a level: some lie beyond their row")
        marked[rows, groups] = True
        expected = near_twin.mark_mixed_groups(volume.voxels, 99.0, reach)
        require_equal(marked.reshape(expected.shape), expected, "groups near a level")
    settings = BilateralSettings.checked(volume, 0.8, 20.0, 2, 99.0, False, 13)
    near = run_bilateral(DeviceVolume(volume, device=device), settings)
    whole = run_bilateral(
        DeviceVolume(volume, device=device), BilateralSettings.checked(volume, 0.8, 20.0, 2, None, False, 13)
    )
    require_equal(near.voxels >= 99, whole.voxels >= 99, "sides of the level")
    return f"{int(expected.sum()):,} of {expected.size:,} groups"


CHECKS = (
    Check(
        "bilateral filter",
        ("copy_row_ends", "filter_bilateral"),
        partial(_check_bilateral, types=("int8", "uint8", "int16", "uint16", "int32", "float32"), uneven=False),
    ),
    Check(
        "bilateral filter of uneven stacks",
        ("copy_row_ends", "filter_bilateral"),
        partial(_check_bilateral, types=("int16",), uneven=True),
    ),
    Check("filter near a level", ("classify_groups", "spread_groups", "mark_mixed_groups"), _check_near_level),
)
