"""Rows of the trap matrix with two volumes in one series, the slices of one half a gap from those of the other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydicom.dataset import Dataset
from trap_plan import (
    BACKGROUND_HU,
    BODY_HU,
    FIELD_SIZE,
    REFUSED,
    WARNED,
    MarkedPlan,
    Marks,
    Size,
    add_case,
    plan_for,
    write_slices,
)


def _interleaved(name: str, keyword: str, *, first: Any, second: Any) -> None:
    """None leaves the element away."""

    @add_case(
        f"{name}, interleaved", REFUSED, ("one with phase", "lie between each other", keyword), again={"phase": 1}
    )
    def write(folder: Path, size: Size) -> Marks:
        def change(ds: Dataset, k: int) -> None:
            value = (first, second)[k % 2]
            if value is not None:
                setattr(ds, keyword, value)
            elif keyword in ds:
                delattr(ds, keyword)

        write_slices(folder, plan_for(size), change=change)
        return plan_for(size).marks(range(1, size.slices, 2))


@dataclass
class MovedPlan(MarkedPlan):
    """Every second slice shows the same body somewhere else."""

    def stored(self, k: int) -> np.ndarray:
        marks = super().stored(k)
        _, rows, columns = self.shape
        y, x = np.mgrid[:rows, :columns]
        body = np.hypot(y - rows / 2, x - columns / 2 + (4, -4)[k % 2]) < rows / 4
        return np.where(body & (marks == BACKGROUND_HU - self.intercept), marks - BACKGROUND_HU + BODY_HU, marks)


def _write_moved(folder: Path, size: Size) -> Marks:
    plan = plan_for(Size(size.slices, FIELD_SIZE.rows, FIELD_SIZE.columns))
    return write_slices(folder, MovedPlan(**vars(plan)))


def add_mixture_cases() -> None:
    """Put the rows into `CASES`."""
    _interleaved("two recon kernels", "ConvolutionKernel", first="B30f", second="B70f")
    _interleaved("two acquisition times", "AcquisitionTime", first="101500", second="103000")
    _interleaved("two acquisition dates", "AcquisitionDate", first="20200101", second="20200102")
    _interleaved("two content times", "ContentTime", first="101500", second="103000")
    _interleaved("before and after contrast agent", "ContrastBolusAgent", first=None, second="IODINE")
    _interleaved("AcquisitionNumber only in every second slice", "AcquisitionNumber", first=None, second=2)
    _interleaved("two acquisition numbers", "AcquisitionNumber", first=1, second=2)
    name = "two volumes that differ only in their pixels, interleaved"
    add_case(name, WARNED, ("maybe two volumes between each other",))(_write_moved)
