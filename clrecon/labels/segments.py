"""Label numbers read slice by slice, and segments stored separately that become one map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry.affine import Float64Array
from clrecon.labels.label_map import LARGEST_NUMBER, LabelMap, check_name, find_number
from clrecon.reading.grids.grid_file import GridFile
from clrecon.system.arguments import name_parameter
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


def _as_labels(stored: NDArray[Any], name: str, subject: str) -> NDArray[Any]:
    if stored.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            broken = ~(stored == np.floor(stored))  # NaN and infinity give warnings; both are refused below
        if broken.any():
            raise RefusedInputError(
                f"{name} is not a label map: {subject} holds {float(stored[broken][0]):g}; labels are whole numbers,"
                " probabilities and CT images are not"
            )
    low, high = float(stored.min()), float(stored.max())
    if low < 0 or high > LARGEST_NUMBER:
        raise RefusedInputError(
            f"{name} is not a label map that can be read: {subject} holds {low if low < 0 else high:g};"
            f" labels run from 0 to {LARGEST_NUMBER:,}"
        )
    return stored.astype(np.uint16)


class Wanted(NamedTuple):
    """The labels that are wanted, None for all, and whether others, which tell where a label ends, are read."""

    labels: tuple[str | int, ...] | None = None
    others: bool = True


class Painter:
    """Writes segments into one map (nk, nj, ni) of zeros.

    No two wanted segments may overlap.  A voxel of a wanted and another segment goes to the wanted one; a voxel of
    several others goes to the lowest number.
    """

    def __init__(self, file: str, voxels: NDArray[Any], names: Mapping[int, str], wanted: Wanted):
        wrong = [number for number in names if not 0 < number <= LARGEST_NUMBER]
        if wrong:
            raise RefusedInputError(f"{file} numbers a segment {wrong[0]}: 1 to {LARGEST_NUMBER:,} are possible")
        self._file, self._voxels = file, voxels
        self._names = {number: check_name(name) for number, name in names.items()}
        shown = {number: name or f"label_{number}" for number, name in self._names.items()}
        chosen = names if wanted.labels is None else {find_number(label, shown, names) for label in wanted.labels}
        self._wanted = sorted(chosen)
        others = sorted(set(names) - set(self._wanted), reverse=True) if wanted.others else []
        self.order = [*others, *self._wanted]
        """Segment numbers in the order in which they have to be painted."""
        self._is_wanted = np.zeros(LARGEST_NUMBER + 1, dtype=bool)
        self._is_wanted[self._wanted] = True
        self._shared: dict[tuple[int, int], int] = {}

    def paint(self, k: int, number: int, mask: NDArray[np.bool_]) -> None:
        """Write `number` into the voxels of slice `k` where `mask` (nj, ni) is true."""
        plane = self._voxels[k]
        if self._is_wanted[number]:
            before = plane[mask]
            before = before[self._is_wanted[before] & (before != number)]
            for previous, count in zip(*np.unique(before, return_counts=True), strict=True):
                pair = (int(previous), number)
                self._shared[pair] = self._shared.get(pair, 0) + int(count)
        plane[mask] = number

    def finish(self, affine: Float64Array, **options: Any) -> LabelMap:
        if self._shared:
            (a, b), count = max(self._shared.items(), key=lambda item: item[1])
            raise RefusedInputError(
                f"segments of {self._file} overlap: {a} {self._names[a]} and {b} {self._names[b]} share {count:,}"
                f" voxels{f', and {len(self._shared) - 1} more pairs' if len(self._shared) > 1 else ''};"
                f" choose labels that do not overlap ({name_parameter('label')}), one run each"
            )
        return LabelMap(self._voxels, affine, self._names, **options)
