"""What a row of the trap matrix is made of: slices whose corner voxels are marks of their own, and the list of cases.

Every corner voxel of every slice has an HU of its own (a mark), everything else is `BACKGROUND_HU`.  A reader is
judged by where it puts the marks, so its order of axes and slices plays no part.  Marks of images that are not of the
stack (a localizer, another phase) start at `FOREIGN_HU`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from dicom_series import ROOT, Change, Plan, make_dataset, save_dataset

BACKGROUND_HU = -1000
BODY_HU = -100
"""Of what is there to be seen, where a case has it."""
FOREIGN_HU = 10_000
GAP_MM = 1.25
OBLIQUE = (12.0, -7.0, 20.0)

EXACT, WARNED, REFUSED = "exact", "exact+warning", "refused"


@dataclass(frozen=True)
class Size:
    """Slices, rows and columns."""

    slices: int = 24
    rows: int = 6
    columns: int = 7


FIELD_SIZE = Size(120, 48, 56)
"""The size of the published table."""


@dataclass
class Marks:
    """Where every mark of the stack lies: HU (m,) and LPS mm (m, 3); the count of slices that carry them.

    NaN where a mark has no place in the frame of the first slice.
    """

    hu: np.ndarray
    lps_mm: np.ndarray
    slices: int


@dataclass
class MarkedPlan(Plan):
    """A plan whose corner voxels are marks, counted from `first_hu`."""

    first_hu: int = 1
    slopes: tuple[int, ...] = (1,)
    """Slope of slice k is ``slopes[k % len(slopes)]``; with more than one, marks and background divide by all."""

    def corners(self) -> list[tuple[int, int]]:
        _, rows, columns = self.shape
        return [(i, j) for j in (0, rows - 1) for i in (0, columns - 1)]

    def mark_hu(self, k: int, corner: int) -> int:
        mark = self.first_hu + 4 * k + corner
        return mark if self.slopes == (1,) else 12 * mark - 4

    def stored(self, k: int) -> np.ndarray:
        slope = self.slopes[k % len(self.slopes)]
        hu = np.full(self.shape[1:], BACKGROUND_HU)
        for corner, (i, j) in enumerate(self.corners()):
            hu[j, i] = self.mark_hu(k, corner)
        stored, rest = np.divmod(hu - self.intercept, slope)
        assert not rest.any()
        return stored.astype("i2" if self.signed else "u2")

    def marks(self, left_out: Sequence[int] = ()) -> Marks:
        found = [
            (self.mark_hu(k, corner), self.truth(np.array([[i, j, k]]))[0])
            for k in range(self.shape[0])
            if k not in left_out
            for corner, (i, j) in enumerate(self.corners())
        ]
        return Marks(np.array([hu for hu, _ in found]), np.array([place for _, place in found]), len(found) // 4)


@dataclass(frozen=True)
class Case:
    """One row of the matrix.

    verdict: What clrecon must do: exact, exact+warning or refused.
    words: Texts that the warnings, or the refusal, must hold.
    again: Options of `read_volume` that make a refused series readable: then exact, with `again_words` in the warnings.
    bound: Which tolerance of tests/support/tolerances.py holds for the positions.
    looks_right: Each slice has its place, and yet it is not the volume that it seems: a table of its own.
    harmless: Who reads it without a word is right all the same.
    """

    name: str
    write: Callable[[Path, Size], Marks]
    verdict: str = EXACT
    words: tuple[str, ...] = ()
    again: Mapping[str, Any] | None = None
    again_words: tuple[str, ...] = ()
    bound: str = "written"
    looks_right: bool = False
    harmless: bool = False


CASES: dict[str, Case] = {}


def add_case(name: str, *args: Any, **options: Any) -> Callable[[Callable[[Path, Size], Marks]], None]:
    """A decorator that adds a row to `CASES`."""

    def add(write: Callable[[Path, Size], Marks]) -> None:
        assert name not in CASES
        CASES[name] = Case(name, write, *args, **options)

    return add


def plan_for(size: Size, **changes: Any) -> MarkedPlan:
    """An oblique plan of this size."""
    plan = MarkedPlan(shape=(size.slices, size.rows, size.columns), gap=GAP_MM, angles=OBLIQUE)
    return replace(plan, **changes)


def write_slices(folder: Path, plan: MarkedPlan, *, change: Change | None = None, prefix: str = "") -> Marks:
    """Write the slices with every attribute that readers ask for; InstanceNumber runs along the normal."""
    for k in range(plan.shape[0]):
        if k in plan.leave_out:
            continue
        ds = make_dataset(plan, k)
        ds.RescaleSlope = plan.slopes[k % len(plan.slopes)]
        ds.InstanceNumber = k + 1
        ds.StudyInstanceUID, ds.StudyID, ds.AccessionNumber = f"{ROOT}.77", "1", "1"
        ds.StudyDate, ds.StudyTime, ds.PatientPosition = "20200101", "120000", "HFS"
        ds.Manufacturer, ds.KVP, ds.AcquisitionNumber = "PHANTOM", 120, 1
        if change is not None:
            change(ds, k)
        ds.file_meta.MediaStorageSOPInstanceUID = ds.SOPInstanceUID
        save_dataset(ds, folder / (prefix + plan.name(k)))
    return plan.marks(plan.leave_out)


def add_simple(
    name: str, *args: Any, change: Change | None = None, plan: Mapping[str, Any] | None = None, **kw: Any
) -> None:
    """A case of one stack, its plan and its slices changed."""
    add_case(name, *args, **kw)(
        lambda folder, size: write_slices(folder, plan_for(size, **(plan or {})), change=change)
    )
