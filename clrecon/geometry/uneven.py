"""Uneven stacks: the map between indices and millimetres for slices that no single affine places.

Rows and columns run in the same directions in every slice, and slice k is the plane through its own position.  Between
slices k and k + 1 every point moves along the step from one position to the next.  So the map is linear in each layer,
continuous across slices, and exact at every voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, checked_points, slice_normal
from clrecon.system.base_classes import Message

POSITION_TOLERANCE_MM = 0.01
POSITION_TOLERANCE_GAPS = 0.01
"""A residual up to 1 % of the gap (or 0.01 mm if larger) is due to rounding and does not make a stack uneven."""


def position_tolerance(gap_mm: float) -> float:
    """Return the largest distance in mm of a slice from even places that is taken as rounding."""
    return max(POSITION_TOLERANCE_MM, POSITION_TOLERANCE_GAPS * gap_mm)


def fit_line(positions: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Fit step and origin (LPS mm) by least squares to positions (n, 3) that are numbered 0 to n - 1, n >= 2."""
    k = np.arange(len(positions), dtype=np.float64)
    centre, mean = k.mean(), positions.mean(axis=0)
    step = (k - centre) @ (positions - mean) / np.sum((k - centre) ** 2)
    return step, mean - centre * step


def fit_even(positions: Float64Array, normal: Float64Array) -> tuple[Float64Array, Float64Array, bool]:
    """Fit even places to slices at positions (n, 3), n >= 2.

    Returns:
    step, origin: ndarray, shape (3,). LPS mm.
    is_even: No position is further off than `position_tolerance` of the median gap along the normal.
    """
    step, origin = fit_line(positions)
    off = np.linalg.norm(positions - (origin + np.arange(len(positions))[:, None] * step), axis=1)
    usual = float(np.median(np.abs(np.diff(positions @ normal))))
    return step, origin, bool(off.max() <= position_tolerance(usual))


@dataclass(frozen=True)
class UnevenStack(Message):
    """Positions of all slices, with the in-plane steps that they share.

    in_plane: ndarray, shape (3, 2), float64. Steps along i and j, mm.
    positions: ndarray, shape (nk, 3), float64. Centre of voxel (0, 0, k), LPS mm.
    normal: ndarray, shape (3,), float64. Unit length, towards larger k.
    """

    in_plane: Float64Array
    positions: Float64Array
    normal: Float64Array

    @classmethod
    def of(cls, affine: Float64Array, positions: ArrayLike, slices: int) -> UnevenStack:
        """Check positions against an affine, which gives the in-plane steps and the direction of growing k."""
        table = np.array(checked_points(positions))
        if len(table) != slices or slices < 2:
            raise UsageError(f"{len(table)} slice positions for {slices} slices: one each, and at least two")
        if not np.isfinite(table).all():
            raise UsageError("slice positions hold NaN or infinite numbers")
        normal = slice_normal(affine)
        if normal @ affine[:3, 2] < 0.0:
            normal = -normal
        gaps = np.diff(table @ normal)
        if gaps.min() <= 0.0:
            k = int(gaps.argmin())
            raise UsageError(
                f"slice positions advance along the slice step of the affine, but from slice {k} to {k + 1} they go"
                f" {gaps[k]:.4g} mm"
            )
        in_plane = np.array(affine[:3, :2])
        table.flags.writeable = in_plane.flags.writeable = normal.flags.writeable = False
        return cls(in_plane, table, normal)

    def origins_at(self, k: Float64Array) -> Float64Array:
        """Return positions (n, 3) at slice coordinates (n,); fractions and coordinates beyond the ends are allowed."""
        layer = np.nan_to_num(np.clip(np.floor(k), 0, len(self.positions) - 2)).astype(np.int64)
        part = (k - layer)[:, None]
        with np.errstate(invalid="ignore"):  # a point that is not finite has no place
            return self.positions[layer] * (1.0 - part) + self.positions[layer + 1] * part

    def ijk_to_lps(self, points: Float64Array) -> Float64Array:
        """Map index coordinates (n, 3) to LPS mm (n, 3)."""
        return self.origins_at(points[:, 2]) + points[:, :2] @ self.in_plane.T

    def lps_to_ijk(self, points: Float64Array) -> Float64Array:
        """Map LPS mm (n, 3) to index coordinates (n, 3)."""
        heights = self.positions @ self.normal
        with np.errstate(invalid="ignore"):
            wanted = points @ self.normal
        layer = np.clip(np.searchsorted(heights, wanted, side="right") - 1, 0, len(heights) - 2)
        k = layer + (wanted - heights[layer]) / (heights[layer + 1] - heights[layer])
        in_slice = points - self.origins_at(k)
        return np.column_stack([in_slice @ np.linalg.pinv(self.in_plane).T, k])
