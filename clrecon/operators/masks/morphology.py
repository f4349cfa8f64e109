"""`MaskShapes`: masks that are dilated, eroded, opened and closed by balls in mm."""

from __future__ import annotations

from typing import Any, TypeVar

from clrecon.opencl import check_budget
from clrecon.operators.masks.balls import ball_of, reaches_beyond, spread_bits, table_bytes, whole_ball_of
from clrecon.operators.masks.band_mask import mask_bytes, zero_words
from clrecon.operators.masks.mask_bits import MaskBits
from clrecon.operators.masks.regions import checked_mm

__all__ = ["MaskShapes"]

Shapes = TypeVar("Shapes", bound="MaskShapes")


class MaskShapes(MaskBits):
    """A mask that is changed by balls; what `clrecon.Mask` is made of."""

    def dilate(self: Shapes, mm: float, *, by_slice: bool = False) -> Shapes:
        """Choose all voxels within a distance of a chosen voxel.

        The distance is that of the voxels' centres in the patient: the result is that of a distance transform in mm
        that is at most `mm` (1 + 1e-6).  Tilted, oblique and uneven stacks are exact.

        Parameters
        ----------
        mm : float
            Above 0; below every step of the voxels nothing changes.
        by_slice : bool
            Within each slice alone, by discs.

        Raises
        ------
        UsageError
            `mm` is not a number above 0, or so large that the work would take hours.
        DeviceError
            The device has no room for two masks, or it fails.
        """
        return self._made(self._spread(mm, by_slice), f"({self.name}) dilated by {mm:g} mm")

    def erode(self: Shapes, mm: float, *, by_slice: bool = False) -> Shapes:
        """Choose the voxels that have no other voxel than chosen ones within a distance.

        Nothing beyond the volume is chosen, so that what reaches its border is eroded from there too.

        Parameters
        ----------
        mm, by_slice
            As for `dilate`.

        Raises
        ------
        UsageError, DeviceError
            As for `dilate`.
        """
        return self._made(self._erode(mm, by_slice), f"({self.name}) eroded by {mm:g} mm")

    def open(self: Shapes, mm: float, *, by_slice: bool = False) -> Shapes:
        """Erode, then dilate: all balls of this radius that fit into what is chosen and into the volume.

        Parameters
        ----------
        mm, by_slice
            As for `dilate`.

        Raises
        ------
        UsageError, DeviceError
            As for `dilate`.
        """
        eroded = self._made(self._erode(mm, by_slice), self.name)
        return self._made(eroded._spread(mm, by_slice), f"({self.name}) opened by {mm:g} mm")

    def close(self: Shapes, mm: float, *, by_slice: bool = False) -> Shapes:
        """Dilate, then erode: gaps into which no ball of this radius fits are filled.

        What lies beyond the volume counts as chosen for the erosion, so that all that was chosen stays.

        Parameters
        ----------
        mm, by_slice
            As for `dilate`.

        Raises
        ------
        UsageError, DeviceError
            As for `dilate`.
        """
        dilated = self._made(self._spread(mm, by_slice), self.name)
        return self._made(dilated._spread(mm, by_slice, erode=True, beyond=True), f"({self.name}) closed by {mm:g} mm")

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
