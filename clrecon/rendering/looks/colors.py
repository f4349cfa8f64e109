"""Colours by name, in hexadecimal or as numbers, and colours of numbers on a scale."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.system.light_dataclass import dataclass
from clrecon.system.text import unknown_name

COLORS = {
    "black": "000000",
    "white": "ffffff",
    "gray": "808080",
    "darkgray": "404040",
    "lightgray": "c0c0c0",
    "red": "ff0000",
    "green": "008000",
    "blue": "0000ff",
    "yellow": "ffff00",
    "cyan": "00ffff",
    "magenta": "ff00ff",
    "orange": "ffa500",
    "navy": "000080",
    "bone": "e3dac9",
}
"""Known names of colours, with red, green and blue in hexadecimal."""


def is_transparent(background: Any) -> bool:
    """True for the name that means no background."""
    return isinstance(background, str) and background == "transparent"


def find_color(color: str | Sequence[float]) -> Float64Array:
    """Return red, green and blue, 0 to 1, of a name of `COLORS`, ``#rgb``, ``#rrggbb`` or three such numbers."""
    if isinstance(color, str):
        text = color.strip().lower()
        digits = COLORS.get(text.replace("grey", "gray"), text.removeprefix("#") if text.startswith("#") else "")
        if re.fullmatch("[0-9a-f]{3}", digits):
            digits = "".join(2 * digit for digit in digits)
        if re.fullmatch("[0-9a-f]{6}", digits):
            return np.array([int(digits[at : at + 2], 16) / 255.0 for at in (0, 2, 4)])
    else:
        try:
            numbers = np.array(color, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            numbers = np.empty(0)
        if numbers.shape == (3,) and (numbers >= 0.0).all() and (numbers <= 1.0).all():
            return numbers
    raise UsageError(f"{unknown_name('colour', color, COLORS)}, #rrggbb, or three numbers from 0 to 1")


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

    @property
    def low(self) -> float:
        return -self.limit if self.signed else 0.0

    @property
    def ticks(self) -> list[float]:
        """Five numbers that are named beside the scale, ascending."""
        return [self.low + part * (self.limit - self.low) / 4.0 for part in range(5)]

    def colors(self, values: ArrayLike) -> NDArray[np.uint8]:
        """Return red, green and blue of numbers, shape (n, 3)."""
        table = _ABOUT_ZERO if self.signed else _FROM_ZERO
        places = (np.asarray(values, dtype=np.float64) - self.low) / (self.limit - self.low) * (len(table) - 1)
        known, unknown = np.arange(len(table)), np.isnan(places)[..., None]
        rgb = np.stack([np.interp(places, known, column) for column in table.T], axis=-1)
        return np.rint(np.where(unknown, _UNKNOWN, rgb)).astype(np.uint8)
