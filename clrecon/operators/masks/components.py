"""`MaskComponents`: masks whose holes are filled, and those that keep the components of given points."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, checked_points
from clrecon.opencl import allocate, copy_buffer
from clrecon.operators.masks import logic
from clrecon.operators.masks.band_mask import mask_bytes, zero_words
from clrecon.operators.masks.morphology import MaskShapes
from clrecon.operators.masks.runs import Components, find_components, mark_at_border, mark_with_voxels, write_runs
from clrecon.system.arguments import explains_arguments

Bits = TypeVar("Bits", bound="MaskComponents")


class MaskComponents(MaskShapes):
    """A mask whose components are looked at; what `clrecon.Mask` is made of."""

    @explains_arguments
    def fill_holes(self: Bits, by_slice: bool = False) -> Bits:
        """Choose the voxels that chosen ones enclose too.

        Enclosed is what no way over faces of voxels that are not chosen joins with the border of the volume.

        by_slice: In each slice alone: what its chosen voxels enclose in the slice.
        """
        self._check_budget(3)
        device, shape, size = self.device, self.shape_ijk, mask_bytes(self.shape_ijk)["mask of the voxels"]
        rest = logic.find_extents(device, logic.invert(device, self._mask_d, shape), shape)
        found = find_components(device, rest, by_slice=by_slice, beside=2 * size, memory=self.memory)
        filled_d = allocate(device, size)
        copy_buffer(device, self._mask_d, filled_d, size)
        if found.count:
            marks_d = mark_at_border(device, found, shape, by_slice=by_slice)
            self._write(found, marks_d, filled_d, wanted=0)
        return self._made(filled_d, f"({self.name}) with holes filled" + " slice by slice" * by_slice)

    def grow(self: Bits, points_mm: ArrayLike) -> Bits:
        """Choose the components that hold a point: chosen voxels joined with it by faces of chosen voxels.

        points_mm: array_like, shape (n, 3). LPS mm; each belongs to the voxel whose centre is nearest along the axes of
            the volume.
        """
        points = checked_points(points_mm)
        if not len(points) or not np.isfinite(points).all():
            raise UsageError(f"to grow needs points that are numbers, these are {len(points)} points")
        device, shape, size = self.device, self.shape_ijk, mask_bytes(self.shape_ijk)["mask of the voxels"]
        voxels = self._find_voxels(points)
        found = find_components(device, self.bits, beside=size, memory=self.memory)
        if not found.count:
            raise UsageError(f"no voxel is chosen ({self.name}): nothing can grow")
        marks_d, components = mark_with_voxels(device, found, shape, voxels)
        if (components < 0).any():
            raise UsageError(self._describe_miss(points[components < 0][0], "lies in a voxel that is not chosen"))
        grown_d = zero_words(device, size // 4)
        self._write(found, marks_d, grown_d, wanted=1)
        return self._made(grown_d, f"({self.name}) grown from {len(points)} point{'s' * (len(points) != 1)}")

    def _find_voxels(self, points: Float64Array) -> NDArray[np.int32]:
        ijk = np.floor(self.volume.lps_to_ijk(points) + 0.5)
        outside = ((ijk < 0) | (ijk >= self.shape_ijk)).any(axis=1)
        if outside.any():
            raise UsageError(self._describe_miss(points[outside][0], "lies outside of the volume"))
        return ijk.astype(np.int32)

    def _describe_miss(self, point: Float64Array, what: str) -> str:
        """Return the message for a point that nothing can grow from."""
        where = ", ".join(f"{x:.1f}" for x in point)
        least = np.inf
        for chosen, origin in zip(self.to_numpy(), self.volume.slice_origins(), strict=True):
            rows = np.argwhere(chosen)
            if len(rows):
                places = origin + rows[:, ::-1] @ self.volume.affine[:3, :2].T
                least = min(least, float(np.linalg.norm(places - point, axis=1).min()))
        near = f"no voxel is chosen ({self.name})"
        if np.isfinite(least):
            near = f"the nearest voxel that is chosen ({self.name}) is {least:.1f} mm away"
        return f"the point ({where}) mm {what}: {near}"

    def _write(self, found: Components, marks_d: object, mask_d: object, wanted: int) -> None:
        runs = found.runs
        write_runs(
            self.device, runs.runs_d, runs.row_counts_d, found.numbers_d, marks_d, mask_d, self.shape_ijk,
            wanted=wanted,
        )  # fmt: skip
