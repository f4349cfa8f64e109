"""Colours of numbers on a scale."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.system.light_dataclass import dataclass

_ABOUT_ZERO = np.array(
    [(33, 102, 172), (67, 147, 195), (146, 197, 222), (222, 222, 222), (244, 165, 130), (214, 96, 77), (178, 24, 43)],
    dtype=np.float64,
)
"""ColorBrewer's RdBu with seven classes, turned round, its middle grey; readable with red-green blindness."""

_FROM_ZERO = np.array(
    [(255, 255, 178), (254, 217, 118), (254, 178, 76), (253, 141, 60), (252, 78, 42), (227, 26, 28), (128, 0, 38)],
    dtype=np.float64,
)
"""ColorBrewer's YlOrRd, its lightest and darkest classes spread over seven."""

_UNKNOWN = (128, 128, 128)

_LEAST_LIMIT_MM = 1e-3


def round_up(value: float) -> float:
    """Return the least number of the form 1, 2 or 5 x 10^n that is not below a positive number."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1.0 - 1e-9))


@dataclass(frozen=True)
class ColorScale:
    """A scale of colours for numbers from 0 or, if `signed`, from ``-limit`` to `limit`; those beyond have its ends."""

    limit: float
    signed: bool = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.limit) and self.limit > 0.0):
            raise UsageError(f"the colours span a number of mm above 0, not {self.limit:g}")

    @classmethod
    def spanning(cls, values: NDArray[np.floating]) -> ColorScale | None:
        """Return the scale on which 95 % of numbers in mm lie, rounded up; None where none of them is finite."""
        known = values[np.isfinite(values)]
        if not len(known):
            return None
        limit = round_up(max(float(np.percentile(np.abs(known), 95.0)), _LEAST_LIMIT_MM))
        return cls(limit, bool((known < 0.0).any()))

    @property
    def low(self) -> float:
        return -self.limit if self.signed else 0.0

    @property
    def ticks(self) -> list[float]:
        """Five numbers that are named beside the scale, ascending."""
        return [self.low + part * (self.limit - self.low) / 4.0 for part in range(5)]

    @property
    def table(self) -> NDArray[np.float64]:
        """Red, green and blue, 0 to 255, at even steps from the lowest number to the highest, shape (7, 3)."""
        return _ABOUT_ZERO if self.signed else _FROM_ZERO

    def colors(self, values: ArrayLike) -> NDArray[np.uint8]:
        """Return red, green and blue of numbers, shape (n, 3)."""
        table = self.table
        places = (np.asarray(values, dtype=np.float64) - self.low) / (self.limit - self.low) * (len(table) - 1)
        known, unknown = np.arange(len(table)), np.isnan(places)[..., None]
        rgb = np.stack([np.interp(places, known, column) for column in table.T], axis=-1)
        return np.rint(np.where(unknown, _UNKNOWN, rgb)).astype(np.uint8)
