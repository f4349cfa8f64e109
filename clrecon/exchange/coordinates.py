"""The storage type of vertex coordinates: float32 near the origin, float64 far from it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.vertices import float32_step, is_far
from clrecon.system.pieces import find_bounds, in_threads, list_distinct

_MOST_STEPS_APART = 64

_PIECE = 1 << 16
"""Vertices that are searched at a time for those at one place, in the processor's cache."""


def rows_of_three(
    values: ArrayLike, name: str, *, one: bool = False, kinds: str = "fiu", words: str = "are numbers"
) -> NDArray[Any]:
    """Return numbers as an array (n, 3), also none or `one` row (3,); refuse other shapes and what is no number."""
    array = as_array(values, name)
    if (array.size == 0 and array.ndim < 2) or (one and array.shape == (3,)):
        array = array.reshape(-1, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise UsageError(f"{name} have shape (n, 3), these have {array.shape}")
    if array.size and array.dtype.kind not in kinds:
        raise UsageError(f"{name} {words}, these are {array.dtype}")
    return array


def as_array(values: ArrayLike, name: str) -> NDArray[Any]:
    try:
        return np.asarray(values)
    except ValueError as error:
        raise UsageError(f"{name} are rows of unequal length") from error


def as_stored(points: NDArray[Any]) -> NDArray[np.floating]:
    """Convert coordinates (n, 3) in mm to the type in which a `Mesh` keeps them, C-contiguous.

    float32; float64 where they are not float32 already and lie so far from the origin that float32 would round them by
    more than 2e-4 mm, see `clrecon.geometry.vertices`.
    """
    dtype = np.float64 if points.dtype != np.float32 and is_far(points) else np.float32
    return np.ascontiguousarray(points, dtype=dtype)


def rounding_step(vertices: NDArray[np.floating]) -> float:
    """Return the step, mm, to which coordinates are rounded: that of float32 at the largest one.

    Those in float64 were computed in float32 relative to a point near their centre: the step there.
    """
    if len(vertices) == 0:
        return 0.0
    low, high = (corner.astype(np.float64) for corner in find_bounds(vertices))
    largest = np.abs([low, high]).max() if vertices.dtype == np.float32 else 0.5 * (high - low).max()
    return float32_step(float(largest))


def find_coincident(vertices: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the vertices that coincide with another vertex, (k,), all of each such place, in order of its coordinates.

    When a file without indices, such as STL, is read, they are joined: a surface closed by index can then be open.
    """
    suspects = _find_repeated(_scramble(vertices, np.uint32))
    if len(suspects) == 0:
        return suspects
    suspects = suspects[np.lexsort(vertices[suspects].T[::-1])]
    same = (vertices[suspects[1:]] == vertices[suspects[:-1]]).all(axis=1)
    return suspects[np.append(same, False) | np.insert(same, 0, False)]


def _find_repeated(numbers: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Return where numbers are that occur several times, rising, by tables in which each number has a slot, or shares
    it: sorting them takes longer.
    """
    kind = np.int32 if len(numbers) < 2**31 else np.int64
    left, rows = np.arange(len(numbers), dtype=kind), [np.empty(0, kind)]
    while len(left):
        bits, here = len(left).bit_length(), np.arange(len(left), dtype=kind)
        slots = (numbers >> np.uint32(32 - bits)).astype(np.intp)
        table = np.empty(1 << bits, kind)
        table[slots] = here
        owners = table.take(slots, mode="clip")
        shared = np.flatnonzero(owners != here)
        owners, hidden = owners.take(shared), numbers.take(shared)
        same = hidden == numbers.take(owners)
        rows += [left[owners[same]], left[shared[same]]]
        left = left[shared[~same]]
        numbers = hidden[~same] * np.uint32(0x85EBCA6B)  # other bits come to the top
    return list_distinct(np.concatenate(rows))


def find_places(vertices: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first vertex at each place, (p,), in the order of vertices, and the place of each vertex, (n,).

    Pieces are searched first, then what differs within each: corners at one place are mostly near to each other.
    """
    count = len(vertices)
    first_of_each = np.empty(count, np.int64)

    def search_piece(piece: slice) -> None:
        first_of_each[piece] = _find_firsts(vertices[piece]) + piece.start

    in_threads(search_piece, count, _PIECE)
    is_first = first_of_each == np.arange(count)
    first = np.flatnonzero(is_first)
    of_first = _find_firsts(vertices[first])
    is_kept = of_first == np.arange(len(first))
    place_of_first = (np.cumsum(is_kept) - 1).take(of_first)
    return first[is_kept], place_of_first.take((np.cumsum(is_first) - 1).take(first_of_each))


def _find_firsts(vertices: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the first vertex at the place of each, (n,), by tables in which each place has a slot, or shares it."""
    mixed, left = _scramble(vertices), np.arange(len(vertices))
    firsts = np.empty_like(left)
    while len(left):
        bits = len(left).bit_length()
        slots = mixed[left] >> np.uint64(64 - bits)
        table = np.empty(1 << bits, np.int64)
        table[slots[::-1]] = left[::-1]  # the first of equals, as it is the last that is written
        owners = table[slots]
        is_same = mixed[owners] == mixed[left]
        firsts[left[is_same]] = owners[is_same]
        left = left[~is_same]
        mixed *= np.uint64(0x9E3779B97F4A7C15)  # other bits come to the top
    if not np.array_equal(vertices.take(firsts, axis=0), vertices):  # two places with one sum, or NaN
        _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
        firsts = first[inverse.reshape(-1)]
    return firsts


def _scramble(vertices: NDArray[np.floating], kind: type[np.unsignedinteger] = np.uint64) -> NDArray[Any]:
    """Return a sum of scrambled coordinates: only vertices with equal sums have to be compared in full."""
    mixed = np.zeros(len(vertices), kind)
    shift, factor = kind(4 * mixed.itemsize - 3), kind(0x9E3779B97F4A7C15 >> (64 - 8 * mixed.itemsize) | 1)
    with np.errstate(invalid="ignore"):  # harmed bits
        numbers = np.add(vertices, vertices.dtype.type(0), order="C")  # + 0 turns -0 into 0
    for word in np.ascontiguousarray(numbers.view(f"u{min(numbers.itemsize, mixed.itemsize)}").T):
        mixed ^= word
        mixed *= factor
        mixed ^= mixed >> shift
    return mixed


def rounded_apart(vertices: NDArray[np.floating]) -> NDArray[np.float32]:
    """Round vertices to float32 so that no two coincide unless they did before.

    Returns: The nearest values; where several places round to one, all but the first are moved by steps of float32,
        each with all of its vertices.  That keeps about 1,000 places apart that round to one; of more some may
        coincide.
    """
    rounded = vertices.astype(np.float32)
    if vertices.dtype == np.float32:
        return rounded
    first, inverse = find_places(vertices)
    apart = rounded[first]
    for turn in range(_MOST_STEPS_APART):
        meeting = find_coincident(apart)
        again = np.concatenate([[False], (apart[meeting[1:]] == apart[meeting[:-1]]).all(axis=1)])
        going = meeting[again[: len(meeting)]]
        if len(going) == 0:
            break
        axis = (turn + np.arange(len(going))) % 3
        apart[going, axis] = np.nextafter(apart[going, axis], np.float32(np.inf))
    return apart[inverse]
