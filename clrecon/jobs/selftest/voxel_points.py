"""Checks of the points of voxels: bands of HU, labels, shells, tilted and uneven slices."""

from __future__ import annotations

from clrecon.jobs.selftest.check import Check, require_close, require_equal, require_whole
from clrecon.jobs.selftest.scenes import OBLIQUE, WIDE, noise, random_integers, stack
from clrecon.labels import LabelMap
from clrecon.opencl import Device
from clrecon.operators.points.point_extraction import extract_points
from clrecon.reference.points import emit as voxel_twin

PLACE_TOLERANCE_MM = 1.6e-5
"""Half a step of float32 below 512 mm."""

BAND = (20.0, 70.0)


def _compare(device: Device, dtype: str, uneven: bool, kind: str, labels: str | None) -> float:
    volume = stack(noise(WIDE, dtype, 100), OBLIQUE, uneven)
    chosen = None if labels is None else random_integers(WIDE, labels, 3)
    label_map = None if chosen is None else LabelMap(chosen, OBLIQUE)
    number = 2 if labels == "uint8" else 0
    cloud = extract_points(
        volume, kind=kind, hu=BAND, labels=label_map, label=number or None, device=device
    )  # fmt: skip
    points, hu, ijk = voxel_twin.extract_voxels(volume, *BAND, shell=kind == "shell", labels=chosen, label=number)
    what = f"{kind} of {dtype} voxels{'' if labels is None else f' with labels of {labels}'}"
    require_whole(cloud.report)
    require_equal(cloud.ijk if cloud.ijk is not None else (), ijk, f"indices of {what}")
    require_equal(cloud.hu if cloud.hu is not None else (), hu, f"HU of {what}")
    return require_close(cloud.points, points, PLACE_TOLERANCE_MM, f"places of {what}, mm")


def _check_voxels(device: Device) -> str:
    worst = max(
        _compare(device, dtype, uneven, kind, labels)
        for dtype, uneven, kind, labels in (
            ("int16", False, "voxels", None),
            ("float32", True, "voxels", None),
            ("uint8", False, "shell", None),
            ("int16", False, "voxels", "uint8"),
            ("int16", False, "shell", "uint16"),
        )
    )
    return f"5 clouds: voxels equal, places within {worst:.1e} mm"


CHECKS = (
    Check(
        "points of voxels",
        ("classify_samples", "restrict_mask", "find_shell", "count_points", "emit_points"),
        _check_voxels,
        {"masks/classify.cl": ("RANGE",)},
    ),
)
