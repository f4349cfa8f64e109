"""`MaskShapes`: masks that are dilated, eroded, opened and closed by balls in mm."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.opencl import check_budget
from clrecon.operators.masks.balls import ball_of, reaches_beyond, spread_bits, table_bytes, whole_ball_of
from clrecon.operators.masks.band_mask import mask_bytes, zero_words
from clrecon.operators.masks.mask_bits import MaskBits
from clrecon.operators.masks.regions import checked_mm
from clrecon.points.stencil import SLACK, Stencil
from clrecon.system.arguments import explains_arguments

Shapes = TypeVar("Shapes", bound="MaskShapes")


class MaskShapes(MaskBits):
    """A mask that is changed by balls; what `clrecon.Mask` is made of."""

    @explains_arguments
    def dilate(self: Shapes, mm: float, *, by_slice: bool = False) -> Shapes:
        """Choose all voxels within a distance of a chosen voxel.

        The distance is that of the voxels' centres in the patient: the result is that of a distance transform in mm
        that is at most `mm` (1 + 1e-6).  Tilted, oblique and uneven stacks are exact.

        mm: Above 0; below every step of the voxels nothing changes.
        by_slice: Within each slice alone, by discs.
        """
        return self._made(self._spread(mm, by_slice), f"({self.name}) dilated by {mm:g} mm")

    @explains_arguments
    def erode(self: Shapes, mm: float, *, by_slice: bool = False) -> Shapes:
        """Choose the voxels that have no other voxel than chosen ones within a distance.

        Nothing beyond the volume is chosen, so that what reaches its border is eroded from there too.

        mm, by_slice: As for `dilate`.
        """
        return self._made(self._erode(mm, by_slice), f"({self.name}) eroded by {mm:g} mm")

    @explains_arguments
    def open(self: Shapes, mm: float, *, by_slice: bool = False) -> Shapes:
        """Erode, then dilate: all balls of this radius that fit into what is chosen and into the volume.

        mm, by_slice: As for `dilate`.
        """
        eroded = self._made(self._erode(mm, by_slice), self.name)
        return self._made(eroded._spread(mm, by_slice), f"({self.name}) opened by {mm:g} mm")

    @explains_arguments
    def close(self: Shapes, mm: float, *, by_slice: bool = False) -> Shapes:
        """Dilate, then erode: gaps into which no ball of this radius fits are filled.

        What lies beyond the volume counts as chosen for the erosion, so that all that was chosen stays.

        mm, by_slice: As for `dilate`.
        """
        dilated = self._made(self._spread(mm, by_slice), self.name)
        return self._made(dilated._spread(mm, by_slice, erode=True, beyond=True), f"({self.name}) closed by {mm:g} mm")

    @explains_arguments
    def dilate_within(self: Shapes, room: Shapes, mm: float) -> Shapes:
        """Choose the voxels of another mask that short ways over faces of its voxels join with chosen ones.

        A way takes a step along i, j or k at a time; along each axis it may be as long as `mm`, in whole steps rounded
        up.  Along an axis whose step is longer than `mm` there is none.

        room: Of the same volume.
        mm: Above 0.
        """
        radius = checked_mm(mm, "the length of the ways")
        steps = np.array(self.volume.spacing)
        most = np.where(steps <= radius * (1.0 + SLACK), np.ceil(radius / steps - SLACK), 0).astype(int)
        reached = self
        for done in range(int(most.max())):
            self._check_budget(4)
            cross = _cross_of(self.volume, most > done)
            spread = self._made(spread_bits(self.device, reached.bits, cross), self.name)
            reached = reached | (spread & room)
        return self._made(reached._mask_d, f"({self.name}) dilated by {mm:g} mm within ({room.name})")

    def _erode(self, mm: float, by_slice: bool) -> Any:
        radius = checked_mm(mm, "the radius of the ball")
        if not reaches_beyond(self.volume, radius, by_slice=by_slice):
            return self._spread(mm, by_slice, erode=True, whole=True)
        self._check_budget(2)
        return zero_words(self.device, mask_bytes(self.shape_ijk)["mask of the voxels"] // 4)

    def _spread(
        self, mm: float, by_slice: bool, *, erode: bool = False, beyond: bool = False, whole: bool = False
    ) -> Any:
        radius = checked_mm(mm, "the radius of the ball")
        ball = (whole_ball_of if whole else ball_of)(self.volume, radius, by_slice=by_slice)
        size, extents = mask_bytes(self.shape_ijk).values()
        needs = {"2 masks of the voxels": 2 * size, "row extents": extents, "rows of the ball": table_bytes(ball)}
        check_budget(self.device, needs, self.memory)
        return spread_bits(self.device, self.bits, ball, erode=erode, beyond=beyond)


def _cross_of(volume: Volume, axes: NDArray[np.bool_]) -> Stencil:
    """Return the neighbours of a voxel by its faces along some of the axes i, j, k, and itself."""
    rows = [[0, 0, -int(axes[0]), int(axes[0])]]
    rows += [[step, 0, 0, 0] for step in (-1, 1) if axes[1]] + [[0, step, 0, 0] for step in (-1, 1) if axes[2]]
    nk = volume.shape_ijk[2]
    tables = np.tile(np.array([[0, len(rows)]], np.int32), (nk, 1))
    in_plane = 1 + 2 * int(axes[0]) + 2 * int(axes[1])
    members = in_plane + 2 * int(axes[2])
    return Stencil(np.array(rows, np.int32), tables, in_plane, (members, members), int(axes[0]))
