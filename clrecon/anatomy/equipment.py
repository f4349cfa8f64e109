"""Equipment beside a patient that is as hard as bone: bars, rails and pieces of metal.

A bar has the same cross section from end to end, and no marrow; a bone tapers, bends and is hollow.  Metal has HU that
bone has not.  What lies in soft tissue is left to the patient: it may be the bone of a thin limb.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.body_cells import Cells, Mask

Float64Array = NDArray[np.float64]

METAL_SHARE = 0.25
"""Least share of voxels above `SURE_METAL_HU` among the dense voxels of a piece of metal; their blurred edges are the
rest.  Jaws with teeth have a share below 0.1."""
BAR_MM, BAR_RATIO = 50.0, 3.0
"""Least length of a bar, in mm and in its larger thickness."""
SECTION_MM = 12.0
"""Least length of the sections in which a bar is measured."""
SECTION_SPREAD, EVEN_SECTIONS = 0.1, 0.75
"""At least this share of the sections of a bar differ by at most the first number, a share, from their median."""
BEND_CELLS = 0.5
"""Largest distance of the middles of these sections from the axis, root mean square, in cells."""
THIN_MM = 10.0
"""A thicker bar is solid along its axis: shafts of bones as thick are hollow."""
FEWEST_CELLS = 8
"""Smaller pieces have no shape."""
RING_CELLS, SOFT_RING = 2, 0.8
"""A piece lies in soft tissue if at least this share of the cells within so many cells of it is tissue."""


def find_equipment(cells: Cells, labels: NDArray[np.int32], chosen: Mask, tissue: Mask) -> Mask:
    """Return which of the chosen pieces are bars or metal and do not lie in soft tissue.

    labels: ndarray, shape (ck, cj, ci). Number of the piece of each cell.
    chosen: ndarray, shape (n,), bool. By number.
    tissue: ndarray, shape (ck, cj, ci), bool. Cells that are not air.
    """
    from scipy import ndimage

    found = np.zeros_like(chosen)
    boxes = ndimage.find_objects(labels)
    for number in np.flatnonzero(chosen):
        box = tuple(slice(max(0, part.start - RING_CELLS), part.stop + RING_CELLS) for part in boxes[number - 1])
        piece = labels[box] == number
        metal = cells.metal[box] > 0
        # A clip on a rail is one piece with it: without the metal a bar is left.
        bar = piece & ~ndimage.binary_dilation(metal)
        if _is_metal(cells, box, piece) or _is_bar(bar, cells.mean[box], cells.size_mm[::-1]):
            ring = ndimage.binary_dilation(piece, iterations=RING_CELLS) & ~piece
            found[number] = not ring.any() or tissue[box][ring].mean() < SOFT_RING
    return found


def _is_metal(cells: Cells, box: tuple[slice, ...], piece: Mask) -> bool:
    metal, dense = (of[box][piece].sum(dtype=np.float64) for of in (cells.metal, cells.dense))
    return bool(metal >= METAL_SHARE * dense)


def _is_bar(piece: Mask, hu: NDArray[np.float32], size_mm: tuple[float, ...]) -> bool:
    """Tell whether a piece is straight, long, and of the same cross section from end to end."""
    if np.count_nonzero(piece) < FEWEST_CELLS:
        return False
    weights = np.maximum(hu[piece].astype(np.float64), 1.0)
    offsets = np.argwhere(piece) * np.array(size_mm)
    offsets -= np.average(offsets, axis=0, weights=weights)
    _, axes = np.linalg.eigh((offsets.T * weights) @ offsets)
    across, along = offsets @ axes[:, :2], offsets @ axes[:, 2]
    cell = math.sqrt(size_mm[1] * size_mm[2])
    length, widths = np.ptp(along), np.ptp(across, axis=0) + cell
    if length < max(BAR_MM, BAR_RATIO * widths.max()):
        return False
    middles, sums = _measure_sections(along, across, weights, float(np.abs(axes[:, 2]) @ size_mm))
    even = np.abs(sums - np.median(sums)) <= SECTION_SPREAD * np.median(sums)
    if even.mean() < EVEN_SECTIONS or np.mean(np.sum(middles[even] ** 2, axis=1)) > (BEND_CELLS * cell) ** 2:
        return False
    on_axis = np.sum(across**2, axis=1) <= cell**2
    is_solid = len(np.unique(along[on_axis] // SECTION_MM)) >= EVEN_SECTIONS * length / SECTION_MM
    return bool(is_solid or widths.min() <= THIN_MM)


def _measure_sections(
    along: Float64Array, across: Float64Array, weights: Float64Array, cell_mm: float
) -> tuple[Float64Array, Float64Array]:
    """Divide a bar, without its ends, into sections; return their middles, (n, 2) mm, and the sums of the weights.

    Each cell is spread over its own length along the bar, so that the steps of the cells do not count.
    """
    ends = along.min() + 0.5 * cell_mm, along.max() - 0.5 * cell_mm
    edges = np.linspace(*ends, max(2, int((ends[1] - ends[0]) / SECTION_MM) + 1))
    shares = np.clip((edges[:, None] - along + 0.5 * cell_mm) / cell_mm, 0.0, 1.0)
    parts = np.diff(shares, axis=0) * weights
    sums = parts.sum(axis=1)
    return (parts @ across) / np.maximum(sums, 1e-9)[:, None], sums
