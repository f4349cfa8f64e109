"""Pieces of a phantom on its grid: each has its own frame and box, and is drawn only in slices that meet the box."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from clrecon.phantom.fields import Field

Float64Array = NDArray[np.float64]


class Piece:
    """A piece with its own box, drawn only in slices that meet the box."""

    def __init__(self, center: Float64Array, axes: Float64Array, low: Float64Array, high: Float64Array):
        self.center, self.axes = center, axes
        self.corners = center + np.array(list(itertools.product(*zip(low, high, strict=True)))) @ axes


class Window:
    """The part of a slice in which a piece lies, with the coordinates there."""

    def __init__(self, region: tuple[slice, slice], local: Float64Array, k: float):
        self.region = region
        j = np.arange(region[0].start, region[0].stop, dtype=np.float64)[:, None]
        i = np.arange(region[1].start, region[1].stop, dtype=np.float64)[None, :]
        self.x, self.y, self.z = (
            (row[0] * i + row[1] * j + (row[2] * k + row[3])).astype(np.float32) for row in local[:3]
        )


def _local_affine(affine: Float64Array, center: Float64Array, axes: Float64Array) -> Float64Array:
    """Return the affine from indices to the local frame of a part."""
    local = np.eye(4)
    local[:3, :3] = axes @ affine[:3, :3]
    local[:3, 3] = axes @ (affine[:3, 3] - center)
    return local


class PlacedPiece:
    """A part with its box in indices and its local affine."""

    def __init__(self, part: Piece, affine: Float64Array, shape_kji: tuple[int, int, int]):
        inverse = np.linalg.inv(affine)
        ijk = part.corners @ inverse[:3, :3].T + inverse[:3, 3]
        self.low = np.floor(ijk.min(axis=0)).astype(int)
        self.high = np.ceil(ijk.max(axis=0)).astype(int) + 1
        nk, nj, ni = shape_kji
        self.region = (
            slice(min(max(self.low[1], 0), nj), max(min(self.high[1], nj), 0)),
            slice(min(max(self.low[0], 0), ni), max(min(self.high[0], ni), 0)),
        )
        self.local = _local_affine(affine, part.center, part.axes)

    def meets(self, k: int) -> bool:
        """True where slice k can hold some of the part."""
        rows, columns = self.region
        return bool(self.low[2] <= k < self.high[2]) and rows.start < rows.stop and columns.start < columns.stop

    def window(self, k: float) -> Window:
        """Return the window of the part, with its coordinates, in (sub-)slice k."""
        return Window(self.region, self.local, k)


def paint(canvas: Field, region: tuple[slice, slice], share: Field, hu: float | Field) -> None:
    """Blend `hu` into a region of a slice; the weight is the share of each voxel that lies in the part."""
    view = canvas[region]
    view += share * (hu - view)
