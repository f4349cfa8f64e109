"""Slope and intercept as the user gives them, in place of what the files say."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from clrecon.errors import UsageError
from clrecon.system.arguments import name_parameter

LARGEST = 1e6


class Rescale(NamedTuple):
    """HU are ``slope * stored + intercept``."""

    slope: float
    intercept: float

    def __str__(self) -> str:
        """One line for warnings."""
        return f"HU are {self.slope:g} x the stored value {self.intercept:+g}, as given: not what the files say"


def check_rescale(given: Any) -> Rescale | None:
    """Check two numbers; None stays None."""
    if given is None:
        return None
    try:
        slope, intercept = (float(number) for number in given)
    except (TypeError, ValueError, OverflowError):
        slope = intercept = math.nan
    if not (0.0 < abs(slope) <= LARGEST and abs(intercept) <= LARGEST):
        raise UsageError(
            f"{name_parameter('rescale')} needs a slope other than 0 and an intercept, two numbers up to {LARGEST:g}"
            f" such as 1,-1024, not {given!r}"
        )
    return Rescale(slope, intercept)
