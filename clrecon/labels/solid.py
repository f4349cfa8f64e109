"""Fill what lies within a label and is less dense than its surface: marrow, and holes in the mask."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Box", "fill_solid", "find_boxes"]

Box = tuple[slice, slice, slice]


def find_boxes(labels: NDArray[Any], numbers: tuple[int, ...], reach: tuple[int, int, int]) -> dict[int, Box]:
    """The box (k, j, i) of each number's samples, grown by `reach` (i, j, k) samples and one more, within the grid."""
    from scipy.ndimage import find_objects

    found = find_objects(labels, max_label=max(numbers))
    boxes = {}
    for number in numbers:
        box = found[number - 1]
        if box is not None:
            boxes[number] = tuple(
                slice(max(0, part.start - more - 1), min(size, part.stop + more + 1))
                for part, more, size in zip(box, reach[::-1], labels.shape, strict=True)
            )
    return boxes  # type: ignore[return-value]


def fill_solid(
    solid: NDArray[np.uint16],
    labels: NDArray[np.uint16],
    number: int,
    box: Box,
    offsets: NDArray[np.int32],
    closed: bool,
) -> int:
    """Make the inside of one label solid, in place.

    A sample below the iso value counts as inside of the label when it lies deep in the mask (all samples within the
    growth carry the label), or when no way through samples that are not inside leads from it to the outside.  Within
    the growth of the mask's border it stays what HU say, as far as the outside reaches: HU place the outer surface.

    Parameters
    ----------
    solid : ndarray, shape (nk, nj, ni), uint16
        For each sample the label that it is inside of, 0 for none; changed.
    labels : ndarray, shape (nk, nj, ni), uint16
        The mask, not grown.
    number : int
    box : 3 slices
        Of the label and what surrounds it by at least one sample, as `find_boxes` gives it.
    offsets : ndarray, shape (n, 3), int32
        Of the growth, see `near_offsets`.
    closed : bool
        Beyond the border of the volume is outside.

    Returns
    -------
    int
        Samples that were filled.
    """
    from scipy.ndimage import label as find_components

    own = solid[box] == number
    passable = np.pad(~(own | _deep(labels[box] == number, offsets)), 1, constant_values=True)
    if not closed:
        # The way out leads through the sides of the box, but not where the volume itself ends.
        for axis, (part, size) in enumerate(zip(box, solid.shape, strict=True)):
            for side, at_end in ((0, part.start == 0), (-1, part.stop == size)):
                face: list[Any] = [slice(None)] * 3
                face[axis] = side
                if at_end:
                    passable[tuple(face)] = False
    components, _ = find_components(passable)
    outer = np.ones(passable.shape, dtype=bool)
    outer[1:-1, 1:-1, 1:-1] = False
    ways_out = np.unique(components[outer & passable])
    is_outside = np.zeros(int(components.max()) + 1, dtype=bool)
    is_outside[ways_out] = True
    enclosed = ~is_outside[components][1:-1, 1:-1, 1:-1] | ~passable[1:-1, 1:-1, 1:-1]
    mine = (labels[box] == number) | (labels[box] == 0)
    filled = enclosed & ~own & mine & (solid[box] == 0)
    solid[box][filled] = number
    return int(np.count_nonzero(filled))


def _deep(mask: NDArray[np.bool_], offsets: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Samples of the mask all of whose neighbours within the growth are of it; beyond the box goes on as its border."""
    if not len(offsets):
        return mask.copy()
    reach = np.abs(offsets).max(axis=0)
    padded = np.pad(mask, [(n, n) for n in reach[::-1]], mode="edge")
    deep = mask.copy()
    nk, nj, ni = mask.shape
    for di, dj, dk in offsets:
        i, j, k = di + reach[0], dj + reach[1], dk + reach[2]
        deep &= padded[k : k + nk, j : j + nj, i : i + ni]
    return deep
