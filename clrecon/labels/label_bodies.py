"""Labels as bodies: the samples around them, parts and holes inside that are filled, and volumes in ml."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.blocks import MM3_PER_ML
from clrecon.labels.label_map import LabelMap
from clrecon.system.light_dataclass import dataclass

_MOST_OFFSETS = 5000
_SAME_DISTANCE = 1e-6
"""Relative difference; offsets whose lengths differ by less, by rounding alone, are equally near."""


@dataclass(frozen=True)
class Growth:
    """The growth of labels on one grid by mm, or by one voxel in each direction.

    offsets: (n, 3). (di, dj, dk) to the samples around, without (0, 0, 0), nearest in mm first, shear included.
    shells: (n,). Shell numbers from 0; offsets of equal length have the same.
    """

    grow_mm: float | None
    offsets: NDArray[np.int32]
    shells: NDArray[np.int32]

    @classmethod
    def of(cls, volume: Volume, grow_mm: float | None) -> Growth:
        steps = volume.affine[:3, :3]
        if grow_mm is None:
            return cls(None, *_sort(_offsets_within((1, 1, 1)), steps))
        limit = _checked(grow_mm, volume)
        reach = np.floor(limit * np.linalg.norm(np.linalg.inv(steps), axis=1) + 1e-9).astype(int)
        offsets = _offsets_within(tuple(reach))
        near = np.linalg.norm(offsets @ steps.T, axis=1) <= limit * (1.0 + _SAME_DISTANCE)
        return cls(limit, *_sort(offsets[near], steps))

    @property
    def table(self) -> NDArray[np.int32]:
        """Offsets and shells for a device, shape (n, 4)."""
        return np.concatenate([self.offsets, self.shells[:, None]], axis=1)

    @property
    def reach(self) -> tuple[int, int, int]:
        """Largest offset along i, j, k in samples."""
        i, j, k = np.abs(self.offsets).max(axis=0, initial=0)
        return int(i), int(j), int(k)


def _checked(grow_mm: float, volume: Volume) -> float:
    try:
        number = float(grow_mm)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"labels grow by a number of mm, not {grow_mm!r}") from error
    if not (math.isfinite(number) and number >= 0.0):
        raise UsageError(f"labels grow by 0 mm or more, not {number:g}")
    di, dj, dk = volume.spacing
    if 4 / 3 * math.pi * number * number * number / (di * dj * dk) > _MOST_OFFSETS:  # number**3 may overflow
        raise UsageError(
            f"labels cannot grow by {number:g} mm on voxels of {di:.3g} x {dj:.3g} x {dk:.3g} mm: growth mends the"
            " border of a mask, up to some ten voxels"
        )
    return number


def _offsets_within(reach: tuple[Any, ...]) -> NDArray[np.int32]:
    grids: Any = np.meshgrid(*(np.arange(-n, n + 1) for n in reach), indexing="ij")
    offsets = np.stack([grid.ravel() for grid in grids], axis=1).astype(np.int32)
    return offsets[offsets.any(axis=1)]


def _sort(offsets: NDArray[np.int32], steps: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Sort offsets by length and number their shells; within a shell they keep index order despite rounding."""
    lengths = np.linalg.norm(offsets @ steps.T, axis=1)
    order = np.argsort(lengths, kind="stable")
    offsets, lengths = offsets[order], lengths[order]
    shells = np.zeros(len(lengths), dtype=np.int32)
    if len(lengths):
        shells[1:] = np.cumsum(np.diff(lengths) > _SAME_DISTANCE * lengths[:-1])
    order = np.lexsort((*offsets.T, shells))
    return np.ascontiguousarray(offsets[order], dtype=np.int32), shells


Box = tuple[slice, slice, slice]


def find_boxes(labels: NDArray[Any], numbers: tuple[int, ...], reach: tuple[int, int, int]) -> dict[int, Box]:
    """Find the box (k, j, i) of each number's samples in the grid, `reach` (i, j, k) samples and one more around."""
    from scipy.ndimage import find_objects

    found = find_objects(labels, max_label=max(numbers, default=0))
    boxes = {}
    for number in numbers:
        box = found[number - 1]
        if box is not None:
            boxes[number] = tuple(
                slice(max(0, part.start - more - 1), min(size, part.stop + more + 1))
                for part, more, size in zip(box, reach[::-1], labels.shape, strict=True)
            )
    return boxes  # type: ignore[return-value]


def fill_solid(solid: NDArray[Any], labels: NDArray[Any], number: int, box: Box, closed: bool) -> int:
    """Make the inside of one label solid, in place; return the number of samples that were filled.

    A sample becomes inside of the label when one of these is true:

    - It is deep in the mask: all 26 neighbours carry the label too.  (The volume's end is no border of the mask.)
    - It carries the label, and no path three samples wide leads to it from outside.
    - It carries no label, and no path at all leads to it from outside.

    A path is a chain of face neighbours of which none is inside or deep.  So where the outside reaches the outermost
    layer of the mask, the HU decide there: they place the outer surface.  Pores of the cortex are too narrow for a
    path.

    solid: (nk, nj, ni). For each sample the label that it is inside of, 0 for none; changed in place.
    labels: (nk, nj, ni). The mask, not grown.
    box: Box of the label and at least one sample around it, as `find_boxes` returns it.
    closed: Everything beyond the border of the volume is outside.
    """
    from scipy.ndimage import binary_dilation, binary_erosion

    cube = np.ones((3, 3, 3), dtype=bool)
    own, mask = solid[box] == number, labels[box] == number
    deep = binary_erosion(mask, cube, border_value=1)
    passable = np.pad(~(own | deep), 1, constant_values=True)
    if not closed:
        _close_ends(passable, box, solid.shape)
    outside = _reach_from_faces(passable)
    wide = _reach_from_faces(passable & ~binary_dilation(np.pad(own, 1), cube))
    wide = binary_dilation(wide, cube) & outside
    inner = (slice(1, -1),) * 3
    filled = (mask & ~wide[inner]) | ((labels[box] == 0) & ~outside[inner])
    filled &= solid[box] == 0
    solid[box][filled] = number
    return int(np.count_nonzero(filled))


def _close_ends(passable: NDArray[np.bool_], box: Box, shape: tuple[int, ...]) -> None:
    """Block the sides of the box where the volume itself ends: no path from outside begins there."""
    for axis, (part, size) in enumerate(zip(box, shape, strict=True)):
        for side, at_end in ((0, part.start == 0), (-1, part.stop == size)):
            if at_end:
                np.moveaxis(passable, axis, 0)[side] = False


def _reach_from_faces(passable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the samples that can be reached from the sides of the box through face neighbours."""
    from scipy.ndimage import label as find_components

    components, count = find_components(passable)
    reached = np.zeros(count + 1, dtype=bool)
    for axis in range(3):
        for side in (0, -1):
            reached[np.unique(np.moveaxis(components, axis, 0)[side])] = True
    reached[0] = False
    return np.asarray(reached[components])


def label_ml(labels: LabelMap, number: int) -> float:
    """Return the volume of a label on the map's own grid, ml."""
    return labels.counts.get(number, 0) * abs(float(np.linalg.det(labels.affine[:3, :3]))) / MM3_PER_ML


def count_ml(voxels: NDArray[Any], number: int, box: Box, voxel_ml: NDArray[np.float64]) -> float:
    """Return the ml of the voxels with a number, which all lie in the box; `voxel_ml` is that of `slice_voxel_ml`."""
    counts = np.count_nonzero(voxels[box] == number, axis=(1, 2))
    return float(counts @ voxel_ml[box[0]])
