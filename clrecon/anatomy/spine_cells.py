"""The coarse grid on which the spinal canal is looked for: mean HU of cells along the patient's axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.geometry.volume import Volume
from clrecon.system.pieces import in_threads

Field = NDArray[np.float32]

CELL_MM = (2.5, 2.5, 4.0)
"""Size along x, y, z of the cells in which the canal is searched."""
HU_RANGE = (-1024, 1500)
"""Values beyond these count as these in the means."""


@dataclass(frozen=True)
class SpineCells:
    """Mean HU of cells.

    values: ndarray, shape (nz, ny, nx), float32. HU; uppermost slice last; -1024 outside of the scan.
    origin: ndarray, shape (3,), float64. Centre of the first cell, LPS mm.
    """

    values: Field
    origin: Float64Array

    def around(self, first: int, end: int, reach: int) -> Field:
        """Return the values of some slices and of `reach` more above and below; those at the ends are repeated."""
        return self.values[np.clip(np.arange(first - reach, end + reach), 0, len(self.values) - 1)]


def heights(mm: float) -> int:
    """Return the height of a window of `mm` along z in cells, an odd number."""
    return max(1, round(mm / CELL_MM[2]) | 1)


@dataclass(frozen=True)
class Lattice:
    """Where the cells of a volume lie.

    block: ndarray, shape (3,), int64. Voxels that are averaged, along i, j, k.
    count: ndarray, shape (3,), int64. Cells along x, y, z.
    origin: ndarray, shape (3,), float64. Centre of the first cell, LPS mm.
    """

    block: NDArray[np.int64]
    count: NDArray[np.int64]
    origin: Float64Array

    def blocks(self, volume: Volume) -> int:
        """Return the number of blocks along k."""
        return int(volume.shape_ijk[2] // self.block[2])


def plan_cells(volume: Volume) -> Lattice:
    """Place cells in the box around a volume."""
    size = np.array(volume.shape_ijk)
    block = np.maximum(1, np.rint(np.minimum(CELL_MM, 2.5) / volume.spacing)).astype(int)
    corners = volume.ijk_to_lps(
        [tuple(n - 0.5 if upper else -0.5 for n, upper in zip(size, bits, strict=True)) for bits in np.ndindex(2, 2, 2)]
    )
    low, high = corners.min(axis=0), corners.max(axis=0)
    count = np.maximum(((high - low) / CELL_MM).astype(int), 1)
    return Lattice(np.minimum(block, size), count, 0.5 * (low + high) - 0.5 * (count - 1) * CELL_MM)


def average_cells(volume: Volume, lattice: Lattice, done: Callable[[slice], None]) -> SpineCells:
    """Average the voxels in blocks of about a cell, then interpolate at the cells.

    volume: A scan in HU.
    lattice: From `plan_cells`.
    done: Called in the thread of the caller with the slices that are finished: of blocks, then of cells.
    """
    means = _average_blocks(volume, lattice, done)
    x, y, z = (lattice.origin[axis] + CELL_MM[axis] * np.arange(lattice.count[axis]) for axis in range(3))
    values = np.empty(lattice.count[::-1], np.float32)
    steps = volume.affine[:3, :3]
    aligned = not volume.uneven and not (steps - np.diag(np.diag(steps))).any()
    interpolate = _interpolate_aligned if aligned else _interpolate

    def fill(where: slice) -> None:
        for k in range(where.start, where.stop):
            values[k] = interpolate(volume, means, lattice.block, x, y, float(z[k]))

    in_threads(fill, len(values), 4, done)
    return SpineCells(values, lattice.origin)


def _average_blocks(volume: Volume, lattice: Lattice, done: Callable[[slice], None]) -> Field:
    """Return the means of blocks of voxels, shape (bk, bj, bi); what is left at the far ends is left out."""
    size = np.array(volume.shape_ijk)
    whole = size // lattice.block * lattice.block
    fi, fj, fk = (int(n) for n in lattice.block)
    means = np.empty((whole // lattice.block)[::-1], np.float32)
    add: np.dtype[Any] = np.dtype(np.float32)
    if volume.voxels.dtype.kind != "f":  # a type that holds the largest sum of a block, which grows with its voxels
        add = np.promote_types(np.int32, np.min_scalar_type(-HU_RANGE[1] * fi * fj * fk))

    def average(where: slice) -> None:
        for k in range(where.start, where.stop):
            part = np.clip(volume.voxels[fk * k : fk * (k + 1), : whole[1], : whole[0]], *HU_RANGE)
            # Sums of few long arrays: numpy is slow where it adds a few values at a time.
            plane = part[0].astype(add)
            for layer in part[1:]:
                plane += layer
            rows = plane[::fj].copy()
            for n in range(1, fj):
                rows += plane[n::fj]
            total = rows[:, ::fi].copy()
            for n in range(1, fi):
                total += rows[:, n::fi]
            np.divide(total, fi * fj * fk, out=means[k], casting="same_kind")
            volume.release_slices(fk * k, fk * (k + 1))

    in_threads(average, len(means), 4, done)
    return means


def _interpolate(
    volume: Volume, means: Field, block: NDArray[np.int64], x: Float64Array, y: Float64Array, z: float
) -> Field:
    """Return the means at the cells of a slice; -1024 outside of the scan and where a mean is not a number."""
    from scipy.ndimage import map_coordinates

    size = np.array(volume.shape_ijk)
    plane = np.broadcast_arrays(x, y[:, None], z)
    ijk = volume.lps_to_ijk(np.stack(plane, axis=-1).reshape(-1, 3))
    inside = ((ijk >= -0.5) & (ijk <= size - 0.5)).all(axis=1)
    at = ((ijk + 0.5) / block - 0.5).T[::-1]
    found = map_coordinates(means, at, output=np.float32, order=1, mode="nearest")
    return np.where(inside, np.nan_to_num(found, nan=-1024.0), np.float32(-1024.0)).reshape(len(y), len(x))


def _interpolate_aligned(
    volume: Volume, means: Field, block: NDArray[np.int64], x: Float64Array, y: Float64Array, z: float
) -> Field:
    """Do the same for a volume whose axes are those of the patient: one axis after the other, which is faster."""
    field: Field = means
    missing = np.zeros((1, 1), bool)
    for axis, places in zip((2, 1, 0), (np.array([z]), y, x), strict=True):
        points = np.zeros((len(places), 3))
        points[:, axis] = places
        ijk = volume.lps_to_ijk(points)[:, axis]
        outside = (ijk < -0.5) | (ijk > volume.shape_ijk[axis] - 0.5)
        along = 2 - axis
        at = np.clip((ijk + 0.5) / block[axis] - 0.5, 0.0, means.shape[along] - 1)
        low = np.minimum(at.astype(np.int64), max(means.shape[along] - 2, 0))
        high = np.minimum(low + 1, means.shape[along] - 1)
        share = (at - low).astype(np.float32).reshape([-1 if n == along else 1 for n in range(3)])
        field = field.take(low, axis=along) * (1.0 - share) + field.take(high, axis=along) * share
        if axis == 2:
            missing = missing | outside[0]
        else:
            missing = missing | (outside[:, None] if axis == 1 else outside)
    return np.where(missing, np.float32(-1024.0), np.nan_to_num(field[0], nan=-1024.0))


def with_border(field: Field, reach: int, mode: str = "constant") -> Field:
    """Return slices with a border of `reach` cells: zeros, or the values at the edge with mode ``"edge"``."""
    return np.pad(field, ((0, 0), (reach, reach), (reach, reach)), mode=mode)  # type: ignore[call-overload,no-any-return]


def shifted(padded: Field, reach: int, dy: int, dx: int) -> Field:
    """Return a view of slices with a border: each cell has the value `dy` rows and `dx` columns further."""
    ny, nx = padded.shape[1] - 2 * reach, padded.shape[2] - 2 * reach
    return padded[:, reach + dy : reach + dy + ny, reach + dx : reach + dx + nx]


def disc_mean(field: Field, radius: float) -> Field:
    """Return the mean within `radius` mm in each slice; 0 beyond the ends.

    Sums of rows grow from the middle outwards, so that a disc costs as many additions as it has rows and columns.
    """
    reach = int(np.ceil(radius / CELL_MM[0]))
    halves = [int(np.sqrt(max(radius**2 - (dy * CELL_MM[1]) ** 2, -1.0)) / CELL_MM[0] + 1e-9)
              if radius >= abs(dy) * CELL_MM[1] else -1 for dy in range(-reach, reach + 1)]  # fmt: skip
    padded = with_border(field, reach)
    ny, nx = field.shape[1:]
    total, number = np.zeros_like(field), 0
    row = padded[:, :, reach : reach + nx].copy()
    for half in range(max(halves) + 1):
        if half:
            row += padded[:, :, reach - half : reach - half + nx]
            row += padded[:, :, reach + half : reach + half + nx]
        for place, own in enumerate(halves):
            if own == half:
                total += row[:, place : place + ny]
                number += 2 * half + 1
    total /= number
    return total


def grow_cortex(cells: SpineCells, first: int, end: int, height: float) -> Field:
    """Return the density of cortical bone of some slices, 0 to 1: the largest within `height` mm along z."""
    reach = heights(height) // 2
    part = cells.around(first, end, reach)
    highest = part[: end - first].copy()
    for n in range(1, 2 * reach + 1):
        np.maximum(highest, part[n : n + end - first], out=highest)
    return np.asarray(np.clip((highest - 170.0) / 130.0, 0.0, 1.0))


def mean_along_z(part: Field, height: int) -> Field:
    """Return the means of `height` slices each, one slice fewer than `height` less than there are."""
    count = len(part) - height + 1
    total = part[:count].copy()
    for n in range(1, height):
        total += part[n : n + count]
    total /= height
    return total
