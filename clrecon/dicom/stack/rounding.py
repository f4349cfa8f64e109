"""Rounded positions: even steps that were written with few digits look like gaps, or like missing slices.

Steps of 0.0105 mm written with two digits are 0.01 mm, and every twentieth 0.02 mm.  A slice that is missing leaves the
same gap.  The two are told apart by the digits and by a distance that the headers state beside the positions: where all
positions are even steps of that distance, each rounded to its last digit, none is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.headers.slice_header import SliceHeader
from clrecon.dicom.stack.numbers import median

Float64Array = NDArray[np.float64]

SLACK = 1e-6
"""Relative excess over the unit of the last digit that is due to float64."""
WHOLE = 1e-3
"""A distance that is a multiple of the unit, within this part of it, is not changed by rounding."""


@dataclass(frozen=True)
class Rounding:
    """Even steps that explain the written positions.

    unit_mm: Unit of the last digit, along the normal.
    digits: Number of decimals of the positions.
    keyword: The element that states the distance of the slices.
    """

    unit_mm: float
    digits: int
    keyword: str
    stated_mm: float

    def __str__(self) -> str:
        plural = "s" * (self.digits != 1)
        return (
            f"positions are written with {self.digits} decimal{plural}, too few for slices that are "
            f"{self.stated_mm:g} mm apart by {self.keyword}: all of them are even steps, rounded"
        )


def measure_unit(headers: Sequence[SliceHeader], normal: Float64Array) -> tuple[float, int]:
    """Return the unit in mm of the last digit of the positions along the normal, and the decimals of its main axis.

    Writers leave out zeros at the end, so the slice with most digits counts.
    """
    digits = np.max([header.position_digits for header in headers], axis=0)
    return float(np.abs(normal) @ 10.0 ** -digits.astype(np.float64)), int(digits[np.argmax(np.abs(normal))])


def find_rounding(
    headers: Sequence[SliceHeader], distances: Float64Array, normal: Float64Array, tolerance: float
) -> Rounding | None:
    """Explain uneven positions by their digits.

    headers: In the order of their places.
    distances: ndarray, shape (n,). Positions along the normal, mm, n >= 2.
    normal: ndarray, shape (3,)
    tolerance: Largest distance in mm that counts as rounding anyway.

    Returns: None where positions have digits enough, no distance is stated, or a stated one does not explain them.
    """
    unit, digits = measure_unit(headers, normal)
    if len(headers) < 3 or unit / 2.0 <= SLACK or np.ptp(np.diff(distances)) < min(unit / 2.0, tolerance):
        return None
    k = np.arange(len(distances), dtype=np.float64)
    fitted = float((k - k.mean()) @ distances / np.sum((k - k.mean()) ** 2))
    for keyword, stated in (
        ("SpacingBetweenSlices", _stated(headers, "stated_gap_mm")),
        ("SliceThickness", _stated(headers, "slice_thickness_mm")),
    ):
        if stated is None or stated <= unit or abs(stated / unit - round(stated / unit)) < WHOLE:
            continue
        # A missing slice would move the ends by a whole step against even steps of the stated distance.
        steps = [stated, fitted] if abs(fitted - stated) * (len(distances) - 1) < stated / 2.0 else [stated]
        if any(float(np.ptp(distances - k * step)) <= unit * (1.0 + SLACK) for step in steps):
            return Rounding(unit, digits, keyword, stated)
    return None


def _stated(headers: Sequence[SliceHeader], field: str) -> float | None:
    """Return the distance that the headers state, if all of them state it and about the same one."""
    values = [getattr(header, field) for header in headers]
    if any(value is None or value <= 0.0 for value in values):
        return None
    middle = median(values)
    return middle if max(values) - min(values) <= WHOLE * middle else None
