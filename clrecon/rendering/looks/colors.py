"""Colours by name, in hexadecimal or as numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.system.arguments import array_or_empty
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
        numbers = array_or_empty(color)
        if numbers.shape == (3,) and (numbers >= 0.0).all() and (numbers <= 1.0).all():
            return numbers
    raise UsageError(f"{unknown_name('colour', color, COLORS)}, #rrggbb, or three numbers from 0 to 1")
