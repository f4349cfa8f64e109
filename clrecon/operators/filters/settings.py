"""What a bilateral filter is asked for, checked, and what its report says."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from clrecon.anatomy.noise import Noise, measure_noise
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import LARGEST_INTEGER, checked_iso_value
from clrecon.operators.filters.window import Window, choose_window

NOISE_FACTOR = 3.0
"""Sigma of the differences over the noise, where it is not given."""

TAPS = {2: 29, 3: 125}
"""Most taps by dimensions, where they are not given."""

MOST_TAPS = 4096

LEAST_SHARE = 0.9
"""Share of the weight of the whole window below which a cut by the number of taps is warned of."""


@dataclass(frozen=True)
class BilateralSettings:
    """A filter of a volume.

    rings: Rings of voxels around those that may change sides: 1, or 2 where normals count.
    noise: Where it was measured.
    """

    sigma_mm: float
    sigma_hu: float
    dimensions: int
    near: float | None
    rings: int
    most_taps: int
    window: Window
    noise: Noise | None

    @classmethod
    def checked(
        cls,
        volume: Volume,
        sigma_mm: float | None,
        sigma_hu: float | None,
        dimensions: int,
        near: float | None,
        normals: bool,
        taps: int | None,
    ) -> BilateralSettings:
        """Check the parameters of `filter_bilateral`, and choose those that are not given."""
        if dimensions not in (2, 3) or isinstance(dimensions, bool):
            raise UsageError(f"a filter has 2 dimensions, slice by slice, or 3, not {dimensions!r}")
        most_taps = _checked_taps(taps, dimensions)
        if near is not None:
            near = checked_iso_value(near)
            inside_level(volume.voxels.dtype, near)
        _check_whole_numbers(volume)
        steps = volume.spacing[:dimensions]
        default = math.prod(steps) ** (1.0 / dimensions)
        sigma_mm = default if sigma_mm is None else checked_length("sigma_mm", sigma_mm, volume)
        noise = None
        if sigma_hu is None:
            noise = _measured_noise(volume)
            sigma_hu = NOISE_FACTOR * noise.hu
        sigma_hu = _positive("sigma_hu", sigma_hu, "a number of HU above 0")
        window = choose_window(volume, sigma_mm, dimensions, most_taps)
        if window.taps == 1:
            raise UsageError(
                f"taps={most_taps} leaves no neighbour in the window, whose nearest ring has more: allow more taps"
            )
        return cls(sigma_mm, sigma_hu, dimensions, near, 2 if normals else 1, most_taps, window, noise)

    @property
    def warnings(self) -> list[str]:
        """What a user should know of the window."""
        window = self.window
        if window.share >= LEAST_SHARE:
            return []
        return [
            f"the window of {window.taps:,} taps holds {100.0 * window.share:.0f} % of the weight that"
            f" sigma_mm={self.sigma_mm:.3g} gives to {window.whole_taps:,}: the filter smooths"
            " less far than asked for"
        ]

    def as_report(self) -> dict[str, Any]:
        """Return the entries of a volume's report."""
        reach = self.window.reach[: self.dimensions]
        return {
            "filter": "bilateral",
            "dimensions": self.dimensions,
            "sigma_mm": round(self.sigma_mm, 4),
            "sigma_hu": round(self.sigma_hu, 3),
            "noise_hu": None if self.noise is None else round(self.noise.hu, 3),
            "taps": self.window.taps,
            "window": [2 * n + 1 for n in reach],
            "whole_window_taps": self.window.whole_taps,
            "window_share": round(self.window.share, 4),
            "near_hu": self.near,
            "rings": None if self.near is None else self.rings,
        }


def inside_level(dtype: np.dtype[Any], near: float) -> Any:
    """Return the lowest value inside as a scalar of the voxels' type."""
    if dtype.kind == "f":
        return np.float32(near)
    limits, level = np.iinfo(dtype), math.ceil(near)
    if level > limits.max:
        raise NoSurfaceError(f"no voxel can lie near {near:g} HU: voxels are {dtype}, at most {limits.max}")
    return dtype.type(max(level, limits.min))


def _checked_taps(taps: int | None, dimensions: int) -> int:
    if taps is None:
        return TAPS[dimensions]
    if isinstance(taps, bool) or not isinstance(taps, (int, np.integer)) or not 2 <= taps <= MOST_TAPS:
        raise UsageError(f"taps are a whole number from 2 to {MOST_TAPS:,}, not {taps!r}")
    return int(taps)


def _check_whole_numbers(volume: Volume) -> None:
    if volume.voxels.dtype != np.int32:
        return
    low, high = volume.hu_range or (0.0, 0.0)
    if max(-low, high) >= LARGEST_INTEGER:
        raise UsageError(
            f"the voxels run from {low:.0f} to {high:.0f}: integers from {LARGEST_INTEGER} on cannot be filtered"
            " exactly, rescale them or convert them to float32"
        )


def _positive(name: str, value: float, what: str) -> float:
    is_number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not is_number or not 0.0 < value < math.inf:
        raise UsageError(f"{name} is {what}, not {value!r}")
    return float(value)


def checked_length(name: str, value: float, volume: Volume) -> float:
    """Return a length in mm."""
    length = _positive(name, value, "a length in mm above 0")
    sides = [n * step for n, step in zip(volume.shape_ijk, volume.spacing, strict=True)]
    if length > max(sides):
        told = " x ".join(f"{side:.4g}" for side in sides)
        raise UsageError(f"{name} is {length:g} mm, larger than the volume ({told} mm)")
    return length


def _measured_noise(volume: Volume) -> Noise:
    try:
        noise = measure_noise(volume)
    except UsageError as error:
        raise UsageError(f"{error}: give sigma_hu=HU") from error
    if noise.hu == 0.0:
        raise UsageError("the soft tissue of the volume has no noise: give sigma_hu=HU")
    return noise
