"""The directions of rows and columns that the slices of a stack share, and the deviation of each slice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.headers.slice_header import SliceHeader

Float64Array = NDArray[np.float64]

ORIENTATION_EXACT = 1e-4
"""Deviation from unit length and right angle that is accepted without a warning (rounding of stored numbers)."""
ORIENTATION_LIMIT = 1e-3
"""Deviation up to which the directions are made orthonormal, with a warning; larger ones are refused."""
ORIENTATION_SPREAD_RAD = 1e-4
"""Largest angle between the directions of a slice and the mean: 0.03 mm over 300 mm."""


@dataclass(frozen=True)
class Directions:
    """Mean directions of a stack.

    row, column: ndarray, shape (3,), float64. Orthonormal, LPS.  Where a slice exceeds `ORIENTATION_LIMIT`, x and y,
        used only for sorting.
    deviations: ndarray, shape (n,), float64. Deviation of each slice's stored directions from unit length and right
        angle.
    angles_rad: ndarray, shape (n,), float64. Angle between the directions of each slice and the mean; NaN where there
        is no mean.
    """

    row: Float64Array
    column: Float64Array
    deviations: Float64Array
    angles_rad: Float64Array

    @property
    def deviation(self) -> float:
        """The largest deviation."""
        return float(self.deviations.max())

    @property
    def spread_rad(self) -> float:
        """The largest angle."""
        return float(self.angles_rad.max())

    @property
    def spread_allowed_rad(self) -> float:
        """Largest allowed angle: skew is removed from every slice alike, so it does not count as a difference between
        slices.
        """
        return ORIENTATION_SPREAD_RAD + self.deviation


def measure_directions(headers: Sequence[SliceHeader]) -> Directions:
    """Measure ImageOrientationPatient (0020,0037) of one or more slices."""
    stored = np.array([(*h.row_cosines, *h.column_cosines) for h in headers], dtype=np.float64).reshape(-1, 2, 3)
    lengths = np.linalg.norm(stored, axis=2)
    skew = np.abs(np.sum(stored[:, 0] * stored[:, 1], axis=1))
    deviations = np.maximum(np.abs(lengths - 1.0).max(axis=1), skew)
    if deviations.max() > ORIENTATION_LIMIT:
        row, column, _ = np.eye(3)
        return Directions(row, column, deviations, np.full(len(stored), np.nan))
    row, column = _orthonormalise(*stored.mean(axis=0))
    chords = np.linalg.norm(stored / lengths[:, :, None] - (row, column), axis=2).max(axis=1)
    return Directions(row, column, deviations, 2.0 * np.arcsin(np.clip(chords / 2.0, 0.0, 1.0)))


def _orthonormalise(row: Float64Array, column: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the nearest orthonormal pair, both directions turned by the same angle; an exact pair stays as it is."""
    row, column = row / np.linalg.norm(row), column / np.linalg.norm(column)
    if abs(row @ column) > 1e-9:
        bisector, across = row + column, row - column
        bisector, across = bisector / np.linalg.norm(bisector), across / np.linalg.norm(across)
        row, column = (bisector + across) / np.sqrt(2.0), (bisector - across) / np.sqrt(2.0)
    return row, column
