"""The part of an input that is read, and slope and intercept as the user gives them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from clrecon.errors import UsageError
from clrecon.system.arguments import name_parameter

LARGEST = 1e6


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The part of an input that is read.

    series: Series of the input; None leaves the choice to `read_volume`.
    phase: Number of the phase, if the series has several.
    allow_gaps: Read a stack with missing slices.
    force: Read data sets without preamble or meta header.
    follow_links: Read the files and folders that symbolic links out of the folder lead to.
    rescale: (slope, intercept). In place of what the files say.
    """

    series: int | str | None = None
    phase: int | None = None
    allow_gaps: bool = False
    force: bool = False
    follow_links: bool = False
    rescale: tuple[float, float] | None = None


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
