"""The part of an input that is read, and slope and intercept as the user gives them."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

from clrecon.errors import UsageError
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.options import numbers_reader, option

LARGEST = 1e6


_reading_option = partial(option, group="reading")


def series_option(text: str, **how: Any) -> Any:
    return option("--series S", text, **how)


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The part of an input that is read."""

    series: int | str | None = series_option(
        'number, hash, UID (or the start of one) or description of the series, see "clrecon info" (default: the CT'
        " series with most slices; of similar ones, original before derived, then the thinnest slices)",
        group="reading",
        first=True,
    )
    phase: int | None = _reading_option(
        "--phase N", "read this phase of a series with several volumes at the same position"
    )
    allow_gaps: bool = _reading_option(
        "--allow-gaps", "read a stack with missing slices: the others are placed exactly, and surfaces bridge the gap"
    )
    force: bool = _reading_option(
        "--force",
        "read data sets without preamble or meta header too, with a guessed encoding; ignore trailing data after"
        " the pixel data",
    )
    follow_links: bool = _reading_option(
        "--follow-links", "read files and folders outside the folder to which symbolic links lead (git-annex, DataLad)"
    )
    rescale: tuple[float, float] | None = _reading_option(
        "--rescale SLOPE,INTERCEPT",
        "compute HU as SLOPE x stored value + INTERCEPT, regardless of the files, such as 1,-1024",
        parse=numbers_reader(2, "is no slope and intercept: SLOPE,INTERCEPT, such as 1,-1024"),
    )
    voxel_size: tuple[float, float, float] | None = _reading_option(
        "--voxel-size I,J,K",
        "mm between voxels along i, j and k, i along the last axis of the array: for Zarr that does not say it in mm",
        parse=numbers_reader(3, "is no size of a voxel: I,J,K in mm, such as 0.5,0.5,0.8"),
    )


class Rescale(NamedTuple):
    """HU are ``slope * stored + intercept``."""

    slope: float
    intercept: float

    def __str__(self) -> str:
        return f"HU are {self.slope:g} x the stored value {self.intercept:+g}, as given: not what the files say"


def check_voxel_size(given: Any) -> tuple[float, float, float] | None:
    if given is None:
        return None
    try:
        i, j, k = (float(number) for number in given)
    except (TypeError, ValueError, OverflowError):
        i = j = k = math.nan
    if not all(0.0 < step <= LARGEST for step in (i, j, k)):
        raise UsageError(
            f"{name_parameter('voxel_size')} needs three lengths above 0 mm, up to {LARGEST:g}, not {given!r}"
        )
    return i, j, k


def check_rescale(given: Any) -> Rescale | None:
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
