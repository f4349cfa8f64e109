"""Regions of a mask of voxels or cells: connected components, how wide a space is, where the end of a scan is open."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry.affine import Float64Array

Mask = NDArray[np.bool_]

_BLOCK_MM, _FINE_MM = 2.0, 1.0
"""Side of the blocks in which the width of a space is measured, and their side if the width is near the limit."""
_BLOCKS_OFF, _FINE_BLOCKS_OFF = 2.0, 0.75
"""Blocks by which the width can be wrong, and that of a ball too low, as its middle need not be that of a block."""

Connection = tuple[int, tuple[tuple[int, int], ...]]
"""Which cells touch: their reach along i into other rows, and the steps (dk, dj) to those of the rows that follow."""
IN_SLICE: Connection = (0, ((0, 1),))
FACES: Connection = (0, ((0, 1), (1, 0)))
CORNERS: Connection = (1, ((0, 1), (1, -1), (1, 0), (1, 1)))
_BITS = np.array([value.bit_count() for value in range(256)], dtype=np.uint8)


class Regions:
    """Connected components of a mask of cells, numbered from 1 in the order of their first cells.

    They are held as runs of cells along i: a body of a million cells has some ten thousand.  Arrays with a value for
    each component have an entry 0 too, for the cells in none.
    """

    def __init__(self, mask: Mask, connection: Connection) -> None:
        kind = np.int32 if mask.size < 2**30 else np.int64  # noise has many runs
        flat, is_end = mask.reshape(-1), np.empty(mask.shape, dtype=bool)
        np.greater(flat[1:], flat[:-1], out=is_end.reshape(-1)[1:])
        is_end[..., 0] = mask[..., 0]
        self.starts = np.flatnonzero(is_end).astype(kind)
        np.greater(flat[:-1], flat[1:], out=is_end.reshape(-1)[:-1])
        is_end[..., -1] = mask[..., -1]
        self.ends = np.flatnonzero(is_end).astype(kind) + 1
        self.shape = mask.shape
        self.numbers = number_connected(len(self.starts), *self._find_touching(connection))
        self.count = int(self.numbers.max(initial=0))
        self.sizes = np.bincount(self.numbers, weights=self.ends - self.starts, minlength=self.count + 1)
        """Number of cells of each component."""

    def _find_touching(self, connection: Connection) -> NDArray[np.signedinteger[Any]]:
        """Return the pairs of runs that touch, (2, n)."""
        _, nj, ni = self.shape
        reach, steps = connection
        # A cell after each row, and a row after each slice, keep apart what does not touch.
        rows = self.starts // ni
        shift = rows + rows // nj * (ni + 1)
        starts, ends = self.starts + shift, self.ends + shift
        pairs = []
        for dk, dj in steps:
            step = (dk * (nj + 1) + dj) * (ni + 1)
            begin = np.searchsorted(ends, starts + (step - reach), side="right")
            counts = np.searchsorted(starts, ends + (step + reach)) - begin
            runs = np.repeat(np.arange(len(counts)), counts), _count_up(begin, counts)
            pairs.append(np.stack(runs, dtype=starts.dtype, casting="same_kind"))
        return np.concatenate(pairs, axis=1)

    def sum_of(self, values: NDArray[Any]) -> Float64Array:
        """Sum the values of the cells of each component; of a mask, count the cells in it."""
        flat, places = values.reshape(-1), np.stack((self.starts, self.ends))
        if values.dtype == bool:
            packed = np.append(np.packbits(flat, bitorder="little"), np.uint8(0))
            counts = _BITS.take(packed)
            before = np.cumsum(counts, dtype=np.uint32) - counts  # differences are right modulo 2^32
            byte = places >> 3
            begin, end = before[byte] + _BITS[packed[byte] & ((1 << (places & 7)) - 1)]
        else:
            filled = np.flatnonzero(flat != 0)
            begin, end = np.append(0, np.cumsum(flat[filled], dtype=np.int64))[np.searchsorted(filled, places)]
        return np.asarray(np.bincount(self.numbers, end - begin, self.count + 1), dtype=np.float64)

    def cells_of(self, chosen: Mask) -> Mask:
        """Return the cells of the chosen components (count + 1,); entry 0 is ignored."""
        picked = chosen[self.numbers]
        ends = np.stack((self.starts[picked], self.ends[picked]), axis=1).reshape(-1)
        lengths = np.diff(ends, prepend=0, append=math.prod(self.shape))
        return np.repeat(np.arange(len(lengths)) % 2 == 1, lengths).reshape(self.shape)

    @cached_property
    def _runs_by_number(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the runs, sorted by their numbers, and where those of each number begin."""
        order = np.argsort(self.numbers, kind="stable")
        return order, np.searchsorted(self.numbers[order], np.arange(self.count + 2))

    def places_of(self, number: int) -> tuple[NDArray[np.int64], ...]:
        """Return the indices k, j and i of the cells of a component."""
        order, begin = self._runs_by_number
        runs = order[begin[number] : begin[number + 1]]
        return np.unravel_index(_count_up(self.starts[runs], self.ends[runs] - self.starts[runs]), self.shape)

    @cached_property
    def boxes(self) -> NDArray[np.int64]:
        """First and last k, j and i of each component, (count + 1, 3, 2)."""
        boxes = np.zeros((self.count + 1, 3, 2), dtype=np.int64)
        order, begin = self._runs_by_number
        if self.count:
            for side, (extreme, cells) in enumerate(((np.minimum, self.starts), (np.maximum, self.ends - 1))):
                for axis, index in enumerate(np.unravel_index(cells[order], self.shape)):
                    boxes[1:, axis, side] = extreme.reduceat(index, begin[1:-1])
        return boxes

    def reach_border(self, axes: tuple[int, ...] = (1, 2)) -> Mask:
        """Tell which components reach the first or the last index along axes, at first those of a slice."""
        last = np.array(self.shape)[list(axes)] - 1
        boxes = self.boxes[:, axes]
        return np.asarray(((boxes[..., 0] == 0) | (boxes[..., 1] == last)).any(axis=1))

    def measure_diagonals(self, cell_mm: tuple[float, float, float]) -> Float64Array:
        """Return the diagonal of the box of each component, mm; of a cell by its lengths along i, j and k."""
        lengths = (np.diff(self.boxes, axis=2)[..., 0] + 1) * cell_mm[::-1]
        return np.array([math.hypot(*sides) for sides in lengths])

    def crop(self, number: int, margin: int = 0) -> tuple[tuple[slice, ...], Mask]:
        """Return the box around a component, wider by a margin within the grid, and the component in it."""
        box = tuple(slice(max(0, first - margin), last + margin + 1) for first, last in self.boxes[number])
        piece = np.zeros([min(part.stop, size) - part.start for part, size in zip(box, self.shape, strict=True)], bool)
        piece[tuple(index - part.start for index, part in zip(self.places_of(number), box, strict=True))] = True
        return box, piece


def find_holes(mask: Mask) -> Mask:
    """Return the cells of each slice that the mask encloses there."""
    gaps = Regions(~mask, IN_SLICE)
    return gaps.cells_of(~gaps.reach_border())


def _count_up(begin: NDArray[Any], counts: NDArray[Any]) -> NDArray[np.int64]:
    """Return ``begin, begin + 1, ...`` of each length in turn."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) + np.repeat(begin - ends + counts, counts)


def number_connected(count: int, first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.signedinteger[Any]]:
    """Number the components of nodes that are connected in pairs, from 1 in the order of their first nodes."""
    roots = np.arange(count, dtype=np.int32 if count < 2**31 else np.int64)
    first, second = (nodes.astype(roots.dtype, copy=False) for nodes in (first, second))
    while len(first):
        np.minimum.at(roots, np.maximum(first, second), np.minimum(first, second))
        while not np.array_equal(above := roots[roots], roots):
            roots = above
        first, second = roots[first], roots[second]
        apart = first != second
        first, second = first[apart], second[apart]
    return np.cumsum(roots == np.arange(count), dtype=roots.dtype)[roots]


def holds_ball(
    body: NDArray[np.bool_], ends: tuple[tuple[bool, bool], ...], steps: tuple[float, float, float], radius_mm: float
) -> bool:
    """Tell whether a ball of this radius, or one smaller by a voxel or 1 mm, fits into a body; see `measure_width`."""
    width = measure_width(body, ends, steps)
    if abs(width - radius_mm) > _BLOCKS_OFF * max(_BLOCK_MM, *steps):
        return width > radius_mm
    width = measure_width(body, ends, steps, _FINE_MM)
    return width + _FINE_BLOCKS_OFF * max(_FINE_MM, *steps) >= radius_mm


def measure_width(
    body: NDArray[np.bool_],
    ends: tuple[tuple[bool, bool], ...],
    steps: tuple[float, float, float],
    block_mm: float = _BLOCK_MM,
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
    mask = np.asarray(face, dtype=bool)[None]
    return np.asarray(~(mask | find_holes(mask))[0])
