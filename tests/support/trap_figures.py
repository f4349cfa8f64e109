"""Rows of the trap matrix with figures that no scanner writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from trap_plan import (
    BACKGROUND_HU,
    BODY_HU,
    WARNED,
    MarkedPlan,
    Marks,
    Size,
    add_case,
    add_simple,
    plan_for,
    write_slices,
)


@dataclass
class StrayPlan(MarkedPlan):
    """Two rows of a body whose stored values have the bit above HighBit set."""

    def stored(self, k: int) -> np.ndarray:
        marks = super().stored(k)
        inside = np.zeros(marks.shape, bool)
        inside[2:4] = True
        body = (BODY_HU - self.intercept) | 1 << self.bits_stored
        return np.where(inside & (marks == BACKGROUND_HU - self.intercept), body, marks).astype(marks.dtype)


def _write_stray(folder: Path, size: Size) -> Marks:
    return write_slices(folder, StrayPlan(**vars(plan_for(size, bits_stored=12, signed=False))))


def add_figure_cases() -> None:
    """Put the rows into `CASES`."""
    add_case("a bit above HighBit that is no overlay", WARNED, ("(bits above HighBit 11, neither sign nor",))(
        _write_stray
    )
    add_simple("pixels of 0.003 mm", WARNED, ("(pixels of 0.003 mm)",), plan={"pixel_spacing": (0.003, 0.003)})
    words = ("(1000 mm at a thickness of 5 mm)",)
    add_simple("gaps of 1000 mm, SliceThickness 5", WARNED, words, plan={"gap": 1000.0, "angles": (0, 0, 0)})
    add_simple("RescaleSlope -1", WARNED, ("(RescaleSlope -1",), plan={"slopes": (-1,)})
