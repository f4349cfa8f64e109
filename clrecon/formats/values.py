"""The values of a grid file as voxels of a volume, and doubts whether they are HU.

One rule holds for every stored type.  If all values are whole numbers, the volume is int16 where all fit, else int32.
Otherwise it is float32.  So a CT gives the same volume and the same mesh from DICOM and from a file in which it was
saved as float64.  The type is found in the one pass that reads the values: the volume is converted to a wider type when
a slice needs it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.formats.grid_file import GridFile
from clrecon.geometry import AIR_HU
from clrecon.geometry.affine import column_spacing, tilt_degrees
from clrecon.sources.facts import PixelFacts
from clrecon.sources.likeness import Likeness, judge_slices
from clrecon.system.arguments import name_parameter
from clrecon.system.memory import allocate_voxels
from clrecon.system.progress import Progress
from clrecon.system.text import format_share

LADDER = (np.dtype(np.int16), np.dtype(np.int32), np.dtype(np.float32))
"""Types of a volume, from the narrowest to the widest."""

MOST_LABELS = 256
"""Most different whole numbers of what is probably not a CT: label maps have up to about 120, 8-bit images 256, a CT
some thousand."""
LARGEST_LABEL = 65_535

LEAST_SPAN = 100.0
"""Least range of HU in a CT.  Air and soft tissue differ by 1000 HU; normalised values span 1, standardised ones about
10."""


@dataclass(frozen=True)
class GridValues:
    """Voxels (nk, nj, ni) int16, int32 or float32, with facts about them, warnings, and reasons why they may not be HU.

    `likeness` is that of the slices along the axis of the longest step; None where there are too few.
    """

    voxels: NDArray[Any]
    facts: PixelFacts
    warnings: list[str]
    doubts: list[str]
    likeness: Likeness | None


def read_values(grid: GridFile, progress: Progress | None = None) -> GridValues:
    """Read the voxels of a grid file, scaled as its header says.

    NaN, which resampling writes where there was no image, becomes `AIR_HU` with a warning.

    progress: Called as ``progress("read", done, total)``.
    """
    filling = _Filling(grid)
    for k, stored in enumerate(grid.iterate_slices()):
        filling.add(k, stored)
        if progress is not None:
            progress("read", k + 1, grid.shape_ijk[2])
    return filling.finish()


class _Filling:
    """A volume that is filled slice by slice."""

    def __init__(self, grid: GridFile):
        self._grid = grid
        self._step = 0  # index into LADDER
        self._voxels = allocate_voxels(grid.shape_ijk[::-1], LADDER[0], grid.name)
        self._holes, self._low, self._high = 0, np.inf, -np.inf

    def add(self, k: int, stored: NDArray[Any]) -> None:
        """Add slice `k` as it is stored."""
        values = _scale(stored, self._grid)
        holes = np.isnan(values) if values.dtype.kind == "f" else None
        if holes is not None and holes.any():
            measured = values[~holes]
            self._holes += values.size - measured.size
            values = np.where(holes, values.dtype.type(AIR_HU), values)
        else:
            measured = values
        if measured.size:
            low, high = measured.min().item(), measured.max().item()
            self._low, self._high = min(self._low, low), max(self._high, high)
            self._widen(k, self._step_for(k, measured, low, high))
        np.copyto(self._voxels[k], values, casting="unsafe")  # the type holds all these values

    def _step_for(self, k: int, measured: NDArray[Any], low: float, high: float) -> int:
        """Return the index of the first type that holds these values, not below the current one."""
        grid = self._grid
        if not abs(low) + abs(high) < np.inf:
            raise RefusedInputError(f"{grid.name} is corrupt: {grid.place(k)} holds infinity, which is no CT number")
        whole = measured.dtype.kind != "f"
        if not whole and max(abs(low), abs(high)) > float(np.finfo(np.float32).max):
            raise RefusedInputError(f"{grid.name}: {grid.place(k)} goes from {low:g} to {high:g}, beyond float32")
        if not whole and (self._step == 2 or not np.array_equal(measured, np.rint(measured))):
            return 2
        for step in range(self._step, 2):
            half = 1 << (8 * LADDER[step].itemsize - 1)
            if -half <= low and high < half:
                return step
        if whole:
            raise RefusedInputError(
                f"{grid.name}: {grid.place(k)} goes from {low:,} to {high:,}: whole numbers beyond 32 bits are no CT"
                " numbers"
            )
        return 2

    def _widen(self, k: int, step: int) -> None:
        """Change to a wider type, and copy the first `k` slices."""
        if step > self._step:
            narrow, self._step = self._voxels, step
            self._voxels = allocate_voxels(self._grid.shape_ijk[::-1], LADDER[step], self._grid.name)
            self._voxels[:k] = narrow[:k]

    def finish(self) -> GridValues:
        """Return the volume with the facts about it."""
        voxels, low, high = self._voxels, self._low, self._high
        if self._holes == voxels.size:
            raise RefusedInputError(f"{self._grid.name} holds no values: all of its voxels are NaN")
        doubts, warnings = _doubts(voxels, low, high), []
        share = self._holes / voxels.size
        if self._holes:
            warnings = [
                f"{self._holes:,} voxels ({format_share(share, 2)}) are NaN: {AIR_HU} HU, air, is taken for them"
            ]
            low, high = min(low, AIR_HU), max(high, AIR_HU)
        filled = float(AIR_HU) if self._holes else None
        facts = PixelFacts(share, float(low), float(high), filled)
        return GridValues(voxels, facts, warnings, doubts, _judge_likeness(voxels, self._grid))


def _judge_likeness(voxels: NDArray[Any], grid: GridFile) -> Likeness | None:
    """Judge the likeness of neighbouring slices along the axis of the longest step, which most likely was that of the
    scan.
    """
    spacing = column_spacing(grid.affine)
    axis = max((2, 1, 0), key=lambda place: round(spacing[place], 4))  # equal steps: the last axis
    return judge_slices(np.moveaxis(voxels, 2 - axis, 0), tilt_degrees(grid.affine))


def _scale(stored: NDArray[Any], grid: GridFile) -> NDArray[Any]:
    """Compute ``stored * slope + intercept``: exactly for whole numbers, else in float64."""
    if not grid.scaled:
        return stored
    slope, intercept = grid.slope, grid.intercept
    whole = slope.is_integer() and intercept.is_integer() and max(abs(slope), abs(intercept)) < 2**30
    if whole and stored.dtype.kind in "iu" and stored.dtype.itemsize <= 4:
        return stored.astype(np.int64) * int(slope) + int(intercept)
    with np.errstate(over="ignore", invalid="ignore"):
        return stored.astype(np.float64) * slope + intercept


def _doubts(voxels: NDArray[Any], low: float, high: float) -> list[str]:
    """Return reasons why the values may not be HU; `low` and `high` are the extremes of the measured values."""
    span = f"the values run from {low:.5g} to {high:.5g}"
    if low >= 0 and voxels.dtype.kind == "i" and high <= LARGEST_LABEL:
        seen = np.zeros(int(high) + 1, dtype=bool)
        for plane in voxels:
            seen[plane[plane >= 0]] = True
        if np.count_nonzero(seen) <= MOST_LABELS:
            return [
                f"{span} in {np.count_nonzero(seen)} different whole numbers: this looks like a label map (those go"
                f" with {name_parameter('labels')}) or an 8-bit image, not like HU"
            ]
    if high - low < LEAST_SPAN:
        return [f"{span}: normalised, not HU"]
    if low >= 0:
        return [f"{span}, none is below 0: not HU, or HU with an offset (often 1024), which iso values then need too"]
    return []
