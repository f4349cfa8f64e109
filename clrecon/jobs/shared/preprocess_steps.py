"""Steps of preprocessing: the texts by which a job is told what happens to a scan before the surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from clrecon.errors import UsageError

FILTERS = {
    "bilateral": ("sigma_mm", "sigma_hu"),
    "bilateral-2d": ("sigma_mm", "sigma_hu"),
    "bilateral-near": ("sigma_mm", "sigma_hu"),
    "median": ("radius_mm",),
    "gaussian": ("sigma_mm",),
    "curvature-flow": ("iterations",),
    "non-local-means": ("sigma_hu",),
}
"""Filters of HU, with the parameters that may follow them."""

COUNTED = ("curvature-flow",)
"""Filters whose parameter is a whole number."""

MORPHOLOGY = ("erode", "dilate", "open", "close", "fill", "fill-slices")
"""Steps on the voxels at the level and above."""

_WITH_RADIUS = ("erode", "dilate", "open", "close")

PREPROCESS_FORMS = (
    "bilateral[:MM[:HU]], bilateral-2d[:MM[:HU]], bilateral-near[:MM[:HU]], median[:MM], gaussian[:MM],"
    " curvature-flow[:N], non-local-means[:HU], level:HU, erode:MM, dilate:MM, open:MM, close:MM, fill, fill-slices"
    " and region"
)
"""The forms of a step, for messages and help."""


@dataclass(frozen=True)
class PreprocessStep:
    """One step: its name and the numbers behind it, in the order of `FILTERS`; a radius in mm, a level in HU."""

    name: str
    numbers: tuple[float, ...] = ()

    def __str__(self) -> str:
        """Write the step in its own form."""
        return ":".join((self.name, *(f"{number:g}" for number in self.numbers)))


def parse_preprocess(steps: str | Sequence[str]) -> tuple[PreprocessStep, ...]:
    """Read the steps of preprocessing, which run in this order.

    steps: A text with commas, or its parts.  Filters of HU may have parameters: spatial sigma in mm and range sigma in
        HU of the bilateral filters, and so on as `FILTERS` says.  ``erode:MM``, ``dilate:MM``, ``open:MM`` and
        ``close:MM`` take a ball of this radius, ``fill`` and ``fill-slices`` fill holes: all of the voxels at the level
        of the job and above, or of ``level:HU`` if that stands before.  ``region`` is the place of the region of
        interest, which else comes first.
    """
    words = steps.split(",") if isinstance(steps, str) else [str(step) for step in steps]
    parsed = tuple(_parse(word.strip()) for word in words)
    if sum(step.name == "region" for step in parsed) > 1:
        raise UsageError("the region of interest has one place among the steps of preprocessing, it is named twice")
    return parsed


def _parse(word: str) -> PreprocessStep:
    name, *rest = word.lower().split(":")
    try:
        numbers = tuple(float(number) for number in rest)
    except ValueError:
        numbers = (math.nan,)
    most = len(FILTERS[name]) if name in FILTERS else int(name in (*_WITH_RADIUS, "level"))
    least = 0 if name in FILTERS else most
    known = name in FILTERS or name in MORPHOLOGY or name in ("level", "region")
    if not known or not least <= len(numbers) <= most or not all(map(math.isfinite, numbers)):
        raise UsageError(f"the step {word!r:.80} of preprocessing is not known: the steps are {PREPROCESS_FORMS}")
    if name != "level" and any(number <= 0.0 for number in numbers):
        raise UsageError(f"the step {word!r:.80} of preprocessing needs numbers above 0")
    if name in COUNTED:
        if any(number != int(number) for number in numbers):
            raise UsageError(f"the step {word!r:.80} of preprocessing needs a whole number")
        numbers = tuple(int(number) for number in numbers)
    return PreprocessStep(name, numbers)
