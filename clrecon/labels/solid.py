"""Filling of labels: parts inside a label that are less dense than its surface (marrow), and holes in the mask."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Box = tuple[slice, slice, slice]


def find_boxes(labels: NDArray[Any], numbers: tuple[int, ...], reach: tuple[int, int, int]) -> dict[int, Box]:
    """Find the box (k, j, i) of each number's samples, grown by `reach` (i, j, k) samples and one more, within the
    grid.
    """
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
    """Make the inside of one label solid, in place.

    A sample becomes inside of the label when one of these is true:

    - It is deep in the mask: all 26 neighbours carry the label too.  (The volume's end is no border of the mask.)
    - It carries the label, and no path three samples wide leads to it from outside.
    - It carries no label, and no path at all leads to it from outside.

    A path is a chain of face neighbours of which none is inside or deep.  So where the outside reaches the outermost
    layer of the mask, the HU decide there: they place the outer surface.  Pores of the cortex are too narrow for a
    path.

    solid: ndarray, shape (nk, nj, ni). For each sample the label that it is inside of, 0 for none; changed in place.
    labels: ndarray, shape (nk, nj, ni). The mask, not grown.
    box: Box of the label and at least one sample around it, as `find_boxes` returns it.
    closed: Everything beyond the border of the volume is outside.

    Returns: Number of samples that were filled.
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
