"""What marrow cannot be: how wide a space is, and where the end of a scan is open."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

BLOCK_MM, FINE_MM = 2.0, 1.0
"""Side of the blocks in which the width of a space is measured, and their side if the width is near the limit."""
_BLOCKS_OFF, _FINE_BLOCKS_OFF = 2.0, 0.75
"""Blocks by which the width can be wrong, and that of a ball too low, as its middle need not be that of a block."""


def holds_ball(
    body: NDArray[np.bool_], ends: tuple[tuple[bool, bool], ...], steps: tuple[float, float, float], radius_mm: float
) -> bool:
    """Tell whether a ball of this radius, or one smaller by a voxel or 1 mm, fits into a body; see `measure_width`."""
    width = measure_width(body, ends, steps)
    if abs(width - radius_mm) > _BLOCKS_OFF * max(BLOCK_MM, *steps):
        return width > radius_mm
    width = measure_width(body, ends, steps, FINE_MM)
    return width + _FINE_BLOCKS_OFF * max(FINE_MM, *steps) >= radius_mm


def measure_width(
    body: NDArray[np.bool_],
    ends: tuple[tuple[bool, bool], ...],
    steps: tuple[float, float, float],
    block_mm: float = BLOCK_MM,
) -> float:
    """Return the radius of the largest ball that fits into a body (nk, nj, ni), mm, right to about `block_mm`.

    Where an end of the volume cuts the body, as `ends` say of both ends of each axis, a disc there counts as a ball: of
    a skull only the cap may be there.  `steps` are along k, j, i, mm.
    """
    from scipy.ndimage import distance_transform_edt

    blocks = [max(1, round(block_mm / step)) for step in steps]
    counts = body.astype(np.int32)
    for axis, (block, (first, last)) in enumerate(zip(blocks, ends, strict=True)):
        rest = [(0, -counts.shape[axis] % block if a == axis else 0) for a in range(3)]
        whole = np.pad(counts, rest, mode="edge") if last else np.pad(counts, rest)
        counts = np.add.reduceat(whole, np.arange(0, whole.shape[axis], block), axis=axis)
        counts = np.pad(counts, [(int(not first), int(not last)) if a == axis else (0, 0) for a in range(3)])
    full = 2 * counts >= math.prod(blocks)
    if full.all():
        return float(np.inf)
    sides = [block * step for block, step in zip(blocks, steps, strict=True)]
    widths = [distance_transform_edt(full, sampling=sides).max()]
    for axis, at_ends in enumerate(ends):
        across = [side for other, side in enumerate(sides) if other != axis]
        faces = [np.take(full, place, axis=axis) for place, is_end in zip((0, -1), at_ends, strict=True) if is_end]
        widths += [distance_transform_edt(face, sampling=across).max() for face in faces if not face.all()]
    return float(max(widths))


def find_open_places(face: ArrayLike) -> NDArray[np.bool_]:
    """Return the places of an end slice that what is chosen in it does not enclose there, of the same shape, bool."""
    from scipy.ndimage import binary_fill_holes

    return np.asarray(~binary_fill_holes(np.asarray(face, dtype=bool)), dtype=bool)
