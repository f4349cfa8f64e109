"""Twin of cl/points/emit.cl: the voxels of a band of HU as points, in plain numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume


def mark_shell(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark those of the marked voxels that have one of their six neighbours outside; beyond the ends all is outside."""
    padded = np.pad(marked, 1)
    inner = np.ones_like(marked)
    for axis in range(3):
        for step in (-1, 1):
            inner &= np.roll(padded, step, axis)[1:-1, 1:-1, 1:-1]
    return marked & ~inner


def extract_voxels(
    volume: Volume,
    low: float,
    high: float = np.inf,
    *,
    shell: bool = False,
    labels: NDArray[Any] | None = None,
    label: int = 0,
    paper: bool = False,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int64]]:
    """Return the centres of voxels from `low` to `high` HU, both included.

    shell: Only voxels with one of six neighbours outside; beyond the volume all is outside.
    labels: ndarray, shape (nk, nj, ni). Only voxels with `label`, or with any number but 0 where it is 0.
    paper: Every slice lies where the first one does.

    Returns:
    points: ndarray, shape (n, 3), float64, LPS mm, in the order k, j, i
    hu: ndarray, shape (n,), float32
    ijk: ndarray, shape (n, 3)
    """
    marked = (volume.voxels >= low) & (volume.voxels <= high)
    if labels is not None:
        marked &= (labels == label) if label else (labels != 0)
    if shell:
        marked = mark_shell(marked)
    k, j, i = np.nonzero(marked)
    origins = volume.slice_origins()
    place = origins[np.zeros_like(k) if paper else k]
    points = place + i[:, None] * volume.affine[:3, 0] + j[:, None] * volume.affine[:3, 1]
    return points, volume.voxels[marked].astype(np.float32), np.stack([i, j, k], axis=1)
