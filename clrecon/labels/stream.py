"""Label numbers read from the slices of a file, within the memory of this computer."""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.labels.label_map import LARGEST_NUMBER
from clrecon.reading.grids.grid_file import GridFile
from clrecon.system.memory import physical_memory_bytes


def empty_labels(name: str, shape: tuple[int, int, int]) -> NDArray[np.uint16]:
    """Return zeros of `shape` that take memory only where they are written; refuse a shape too large for the memory."""
    size = 2 * prod(shape)
    try:
        if size <= physical_memory_bytes():
            return np.zeros(shape, dtype=np.uint16)
    except MemoryError:
        pass
    raise RefusedInputError(
        f"{name} has {' x '.join(map(str, shape[::-1]))} voxels: {size / 2**30:,.1f} GiB, more memory than there is"
    )


def iterate_labels(grid: GridFile) -> Iterator[NDArray[np.uint16]]:
    """Yield the slices of `grid` as label numbers, shape (nj, ni) or (nj, ni, layers)."""
    for k, stored in enumerate(grid.iterate_slices()):
        numbers = stored * grid.slope + grid.intercept if grid.scaled else stored
        yield _as_labels(numbers, grid.name, grid.place(k))


def _as_labels(stored: NDArray[Any], name: str, where: str) -> NDArray[Any]:
    if stored.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            broken = ~(stored == np.floor(stored))  # NaN and infinity give warnings; both are refused below
        if broken.any():
            raise RefusedInputError(
                f"{name} is not a label map: {where} holds {float(stored[broken][0]):g}; labels are whole numbers,"
                " probabilities and CT images are not"
            )
    low, high = float(stored.min()), float(stored.max())
    if low < 0 or high > LARGEST_NUMBER:
        raise RefusedInputError(
            f"{name} is not a label map that can be read: {where} holds {low if low < 0 else high:g};"
            f" labels run from 0 to {LARGEST_NUMBER:,}"
        )
    return stored.astype(np.uint16)
