"""Blocks of a grid: the voxels in a box of millimetres, the affine of the block, and what a certificate says of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from clrecon.geometry.affine import Float64Array, signed_tilt, slice_normal
from clrecon.geometry.grid import Grid
from clrecon.geometry.orientation import describe_orientation
from clrecon.geometry.uneven import fit_even

ON_EDGE_MM = 1e-6
"""A voxel centre this near to the side of a box lies in the box."""


class Block(NamedTuple):
    """Voxels first to end - 1 along each axis.

    first, end: Indices (i, j, k).
    """

    first: tuple[int, int, int]
    end: tuple[int, int, int]

    @property
    def shape_ijk(self) -> tuple[int, int, int]:
        """(ni, nj, nk) of the block."""
        ni, nj, nk = (end - first for first, end in zip(self.first, self.end, strict=True))
        return ni, nj, nk


def find_block(grid: Grid, origins: Float64Array, low: ArrayLike, high: ArrayLike, margin: int = 0) -> Block | None:
    """Return the smallest block that holds every voxel whose centre lies in a box; None where no centre does.

    origins: ndarray, shape (nk, 3). LPS mm of voxel (0, 0, k) of each slice.
    low, high: array_like, shape (3,). Corners of the box along the axes of the patient, LPS mm; infinite numbers leave
        a side open.
    margin: Voxels more on each side, as far as the grid goes.
    """
    ni, nj, nk = grid.shape_ijk
    low, high = np.asarray(low, np.float64) - ON_EDGE_MM, np.asarray(high, np.float64) + ON_EDGE_MM
    # In each row (k, j) the voxels in the box are an interval of i: that which lies within all three pairs of sides.
    first, last = np.zeros((nk, nj)), np.full((nk, nj), ni - 1.0)
    for a in range(3):
        start = origins[:, a, None] + np.arange(nj) * grid.affine[a, 1]
        step = grid.affine[a, 0]
        if step == 0.0:
            last[(start < low[a]) | (start > high[a])] = -1.0
            continue
        ends = (low[a] - start) / step, (high[a] - start) / step
        first = np.maximum(first, np.ceil(np.minimum(*ends)))
        last = np.minimum(last, np.floor(np.maximum(*ends)))
    held = first <= last
    if not held.any():
        return None
    slices, rows = np.flatnonzero(held.any(axis=1)), np.flatnonzero(held.any(axis=0))
    begins = first[held].min(), rows[0], slices[0]
    ends_at = last[held].max(), rows[-1], slices[-1]
    i0, j0, k0 = (max(0, int(one) - margin) for one in begins)
    i1, j1, k1 = (min(n, int(one) + 1 + margin) for one, n in zip(ends_at, (ni, nj, nk), strict=True))
    return Block((i0, j0, k0), (i1, j1, k1))


def place_block(affine: Float64Array, origins: Float64Array, uneven: bool, block: Block) -> tuple[Any, Any]:
    """Return the affine of a block, and the positions (n, 3) of its slices where they are uneven, else None.

    A block of uneven slices that are even among themselves, by the rule of the reader, has an affine alone: that which
    these slices have when they are read without the others.

    affine: ndarray, shape (4, 4). Of the whole grid.
    origins: ndarray, shape (nk, 3). LPS mm of voxel (0, 0, k) of each slice of the whole grid.
    uneven: The slices of the whole grid lie elsewhere than its affine says.
    """
    placed = np.array(affine)
    aside = affine[:3, 0] * block.first[0] + affine[:3, 1] * block.first[1]
    positions = origins[block.first[2] : block.end[2]] + aside
    placed[:3, 3] = positions[0]
    if not uneven or len(positions) < 2:
        return placed, None
    step, origin, is_even = fit_even(positions, slice_normal(affine))
    if is_even:
        placed[:3, 2], placed[:3, 3] = step, origin
        return placed, None
    placed[:3, 2] = (positions[-1] - positions[0]) / (len(positions) - 1)
    return placed, positions


def describe_place(report: Mapping[str, Any], volume: Any) -> dict[str, Any]:
    """Return the entries of a report that change with the shape and the place of a volume, as far as it has them.

    report: Of the volume that `volume` was made of.
    """
    ni, nj, nk = volume.shape_ijk
    di, dj, dk = volume.spacing
    origins, normal = volume.slice_origins(), slice_normal(volume.affine)
    gaps = np.abs(np.diff(origins, axis=0) @ normal) if nk > 1 else np.array([abs(volume.affine[:3, 2] @ normal)])
    usual = float(np.median(gaps))
    even = volume.affine[:3, 3] + np.arange(nk)[:, None] * volume.affine[:3, 2]
    off = np.linalg.norm(origins - even, axis=1)
    hu = volume.hu_range
    entries = {
        "slices": nk,
        "shape_ijk": [ni, nj, nk],
        "spacing_mm": [di, dj, dk],
        "extent_mm": [ni * di, nj * dj, float(gaps.sum()) + usual if nk > 1 else usual],
        "affine_ijk_to_lps_mm": volume.affine.tolist(),
        "orientation": describe_orientation(volume.affine),
        "tilt_deg": signed_tilt(volume.affine),
        "gap_mm": {"min": float(gaps.min()), "max": float(gaps.max()), "median": usual},
        "uneven": volume.uneven,
        "gap_runs": None,
        "slice_positions_mm": origins.tolist() if volume.uneven else None,
        "hu_range": None if hu is None else [float(hu[0]), float(hu[1])],
    }
    if report.get("uneven"):  # of even slices the residual is that of reading
        entries["grid_residual_max_mm"] = float(off.max()) if volume.uneven else None
        entries["grid_residual_rms_mm"] = float(np.sqrt(np.mean(off**2))) if volume.uneven else None
    return {name: value for name, value in entries.items() if name in report}
