"""The active cell of a sample grid that is nearest to a point, from the inside mask on the device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.opencl import Device, download
from clrecon.operators.surface.cells import Classified
from clrecon.operators.surface.seeds import SEED_REACH_MM
from clrecon.operators.surface.slabs import SampleGrid

FARTHEST_TOLD_MM = 50.0
"""Of a seed in air the nearest cell is looked for up to here, for the message."""

_NEAR_MM = 2.0
"""Most seeds lie on the surface: it is looked for as near as this first, among few cells."""


def find_cell_near(
    device: Device, grid: SampleGrid, classified: Classified, point: NDArray[np.float64]
) -> tuple[int, int, int]:
    """Return the active cell (k, j, i) whose centre is nearest to a point.

    classified: Inside mask of the whole grid.
    point: ndarray, shape (3,), LPS mm
    """
    for reach in (_NEAR_MM, SEED_REACH_MM):
        found = _look(device, grid, classified, point, reach)
        if found is not None and found[1] <= reach:
            return found[0]
    farther = _look(device, grid, classified, point, FARTHEST_TOLD_MM)
    raise UsageError(_describe_lone(grid, point, None if farther is None else farther[1]))


def _look(
    device: Device, grid: SampleGrid, classified: Classified, point: NDArray[np.float64], reach: float
) -> tuple[tuple[int, int, int], float] | None:
    """Return the cell and how far it is; cells farther than `reach` may be missed."""
    volume, (gi, gj, gk), border = grid.volume, grid.shape, grid.rule.border
    normal = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
    heights = np.abs((volume.slice_origins(border) - point) @ (normal / np.linalg.norm(normal)))
    near = np.flatnonzero(heights <= reach)
    if not len(near):
        return None
    first, end = max(int(near[0]) - 1, 0), min(int(near[-1]) + 2, gk)
    (begin_j, end_j), (begin_word, end_word) = _rows_near(grid, point, reach, first, end)
    mask = download(
        device, np.empty((end - first, gj, grid.words), np.uint32), classified.mask_d, 4 * first * gj * grid.words
    )[:, begin_j:end_j, begin_word:end_word]
    bits = np.unpackbits(np.ascontiguousarray(mask).view(np.uint8), axis=2, bitorder="little")
    inside = bits[..., : gi - 32 * begin_word].view(bool)
    some, every = inside[:-1] | inside[1:], inside[:-1] & inside[1:]
    some, every = some[:, :-1] | some[:, 1:], every[:, :-1] & every[:, 1:]
    cells = np.argwhere((some[..., :-1] | some[..., 1:]) & ~(every[..., :-1] & every[..., 1:]))
    if not len(cells):
        return None
    cells += (first, begin_j, 32 * begin_word)
    away = np.linalg.norm(volume.ijk_to_lps(cells[:, ::-1] + 0.5 - border) - point, axis=1)
    best = int(np.argmin(away))
    k, j, i = (int(n) for n in cells[best])
    return (k, j, i), float(away[best])


def _rows_near(
    grid: SampleGrid, point: NDArray[np.float64], reach: float, first: int, end: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return begin and end of the rows, and of the words in them, that cells within `reach` have in some slices."""
    volume, border = grid.volume, grid.rule.border
    steps = np.linalg.pinv(volume.affine[:3, :2])  # to i and j of the nearest point of a slice
    places = (point - volume.slice_origins(border)[first:end]) @ steps.T + border
    around = reach * np.linalg.norm(steps, axis=1) + 2
    (low_i, low_j), (high_i, high_j) = places.min(axis=0) - around, places.max(axis=0) + around
    begin_j, begin_word = max(0, int(low_j)), max(0, int(low_i)) // 32
    return (begin_j, min(grid.shape[1], int(high_j) + 2)), (begin_word, min(grid.words, int(high_i) // 32 + 1))


def _describe_lone(grid: SampleGrid, point: NDArray[np.float64], away: float | None) -> str:
    volume = grid.volume
    i, j, k = np.clip(np.rint(volume.lps_to_ijk(point[None])[0]).astype(int), 0, np.array(volume.shape_ijk) - 1)
    far = f"more than {FARTHEST_TOLD_MM:g}" if away is None or away > FARTHEST_TOLD_MM else f"{away:.1f}"
    return (
        f"seed {','.join(f'{n:g}' for n in point)} has {float(volume.voxels[k, j, i]):g} HU and is {far} mm away"
        f" from the surface {grid.rule.phrase()}: a seed lies within {SEED_REACH_MM:g} mm of it"
    )
