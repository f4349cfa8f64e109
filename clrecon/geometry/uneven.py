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
from clrecon.system.messages import Message

__all__ = ["UnevenStack"]


@dataclass(frozen=True)
class UnevenStack(Message):
    """Positions of all slices, with the in-plane steps that they share.

    Attributes
    ----------
    in_plane : ndarray, shape (3, 2), float64
        Steps along i and j, mm.
    positions : ndarray, shape (nk, 3), float64
        Centre of voxel (0, 0, k), LPS mm.
    normal : ndarray, shape (3,), float64
        Unit length, towards larger k.
    """

    in_plane: Float64Array
    positions: Float64Array
    normal: Float64Array

    @classmethod
    def of(cls, affine: Float64Array, positions: ArrayLike, slices: int) -> UnevenStack:
        """Check positions against an affine, which gives the in-plane steps and the direction of growing k.

        Raises
        ------
        UsageError
            There is not one finite position for each slice, there are fewer than two, or a position does not advance in
            the affine's direction.
        """
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
        layer = np.clip(np.floor(k).astype(np.int64), 0, len(self.positions) - 2)
        part = (k - layer)[:, None]
        return self.positions[layer] * (1.0 - part) + self.positions[layer + 1] * part

    def ijk_to_lps(self, points: Float64Array) -> Float64Array:
        """Map index coordinates (n, 3) to LPS mm (n, 3)."""
        return self.origins_at(points[:, 2]) + points[:, :2] @ self.in_plane.T

    def lps_to_ijk(self, points: Float64Array) -> Float64Array:
        """Map LPS mm (n, 3) to index coordinates (n, 3)."""
        heights = self.positions @ self.normal
        wanted = points @ self.normal
        layer = np.clip(np.searchsorted(heights, wanted, side="right") - 1, 0, len(heights) - 2)
        k = layer + (wanted - heights[layer]) / (heights[layer + 1] - heights[layer])
        in_slice = points - self.origins_at(k)
        return np.column_stack([in_slice @ np.linalg.pinv(self.in_plane).T, k])
