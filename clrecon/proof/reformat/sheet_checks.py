"""Checks of slices through a volume."""

from __future__ import annotations

from functools import partial

from clrecon.opencl import Device
from clrecon.operators.reformat.sheets import sample_sheet
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.proof.checking.check import Check, require_close, require_whole
from clrecon.proof.checking.scenes import OBLIQUE, random_integers, stack
from clrecon.proof.reformat.sheets import reformat_sheet
from clrecon.rendering.views.reformation import find_plane, plane_sheet, slab_samples

SIZE = (41, 37)
"""Pixels, a work-item each."""

VALUE_HU = 1e-4
"""Largest difference: float32 interpolation of values up to 100 HU, and sums of some tens."""

PLANES = (("axial", 0.0, "mean"), ((20.0, 30.0), 2.3, "max"), ("sagittal", 4.0, "mean"), ((-75.0, 10.0), 3.0, "min"))


def _check_sheets(device: Device, types: tuple[str, ...], uneven: bool) -> str:
    worst = 0.0
    for dtype in types:
        volume = stack(random_integers((12, 17, 15), dtype, 100), OBLIQUE, uneven)
        for view, thickness, combine in PLANES:
            sheet, _ = plane_sheet(find_plane(volume, view, SIZE), SIZE, 0.1)
            samples = slab_samples(volume, thickness)
            made = sample_sheet(DeviceVolume(volume, device=device), sheet, samples, combine)
            require_whole({"slabs": made.slabs, "warnings": ()})
            expected = reformat_sheet(volume, sheet, samples, combine)
            worst = max(worst, require_close(made.values, expected, VALUE_HU, f"slices of {dtype} voxels, in HU"))
    return f"{len(types) * len(PLANES)} slices of {SIZE[0]} x {SIZE[1]} pixels within {worst:.1e} HU"


CHECKS = (
    Check(
        "slices",
        ("reformat_rows",),
        partial(_check_sheets, types=("int8", "uint8", "int16", "uint16", "int32", "float32"), uneven=False),
    ),
    Check(
        "slices of uneven stacks",
        ("reformat_rows",),
        partial(_check_sheets, types=("int16", "float32"), uneven=True),
        {"reformat/sample.cl": ("UNEVEN",)},
    ),
)
