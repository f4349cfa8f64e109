"""Padding, the voxels without a measurement: they are filled with the value of the air measured beside them.

Padding and measured air of different value would have a surface between them: the reconstruction circle as a tube, at
every iso value between the two.  So no fixed value is safe: air is -1000 HU in theory, but -970 to -1010 HU in scans.
The median of the air beside the padding separates the fewest neighbours from it, at every iso value: none where air has
no noise, else no more than noise separates anyway.  Where the body reaches the circle it still meets air there, so its
surface stays closed.

Some padding no header declares: many cone-beam scanners write 0, maybe the value of tissue, outside of a round field of
view.  Nothing that was measured has one value without noise everywhere outside of a circle, and nowhere inside along
it.

A wrong PixelPaddingValue or PixelPaddingRangeLimit masks tissue, and air stands in its place.  Padding has one value,
mostly far below air, and reaches the edge of the picture: voxels with the HU of tissue are measured ones where they lie
within the picture, or have values between the ends of a range.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import AIR_HU
from clrecon.reading.common.source_facts import StoredValues

AIR_RANGE_HU = (-1100, -900)
"""Range of air beside the padding.  The table and a blanket are denser; noise exceeds both ends alike."""
SAMPLED_SLICES = 16
"""Number of evenly spread slices that are sampled; they give some thousand voxels beside the padding."""

_KEPT_MASKS = 16
"""Masks of this many slices stay unpacked; most scans have the same mask in all slices."""

Map = Callable[[Callable[[int], Any], Iterable[int]], Iterable[Any]]
"""The function `map`, or that of a thread pool."""


def pack_mask(mask: NDArray[np.bool_]) -> tuple[bytes, int]:
    """Return a mask of padding with one bit for each voxel, and its number of voxels."""
    return np.packbits(mask).tobytes(), int(np.count_nonzero(mask))


def _unpack_mask(shape: tuple[int, int], bits: bytes) -> NDArray[np.bool_]:
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=shape[0] * shape[1]).view(np.bool_).reshape(shape)


class PaddingMasks:
    """The padding of a volume that is being read, slice by slice."""

    def __init__(self, voxels: NDArray[Any]):
        self._voxels = voxels
        self._packed: dict[int, bytes] = {}
        self._counts: dict[int, int] = {}
        self._distinct: dict[bytes, bytes] = {}
        self._mask = lru_cache(_KEPT_MASKS)(partial(_unpack_mask, voxels.shape[1:]))

    def add(self, k: int, packed: tuple[bytes, int] | None) -> None:
        """Record the padding of slice `k`, as `pack_mask` returns it; None if the slice has none."""
        if packed is not None:
            bits, self._counts[k] = packed
            self._packed[k] = self._distinct.setdefault(bits, bits)  # equal masks share their memory

    @property
    def count(self) -> int:
        return sum(self._counts.values())

    def fill(self, run: Map = map) -> float | None:
        """Set all padding to the HU of the air beside it, `AIR_HU` if there is none; `run` is the ``map`` of a pool."""
        if not self._packed:
            return None
        bordered = [k for k in sorted(self._packed) if self._counts[k] < self._voxels[k].size]
        sampled = bordered[:: -(-len(bordered) // SAMPLED_SLICES)] if bordered else []
        air = np.concatenate([*run(self._air_beside, sampled), self._voxels[:0].ravel()])
        value = np.sort(air)[(len(air) - 1) // 2] if len(air) else self._voxels.dtype.type(AIR_HU)

        def fill_slice(k: int) -> None:
            np.copyto(self._voxels[k], value, where=self._mask(self._packed[k]))

        for _ in run(fill_slice, self._packed):
            pass
        return float(value)

    def _air_beside(self, k: int) -> NDArray[Any]:
        """Return measured air next to the padding of a slice, in rows and columns."""
        mask = self._mask(self._packed[k])
        beside = np.zeros_like(mask)
        beside[1:] |= mask[:-1]
        beside[:-1] |= mask[1:]
        beside[:, 1:] |= mask[:, :-1]
        beside[:, :-1] |= mask[:, 1:]
        beside &= ~mask
        values = self._voxels[k][beside]
        low, high = AIR_RANGE_HU
        return values[(values >= low) & (values <= high)]


_SMALLEST = 32
_ROUND = 0.03
"""Largest difference of the four radii along the middle row and column, as a share of the radius."""
_OUTSIDE, _RIM = 1.03, (0.9, 0.97)
"""Where all voxels have the value, and where hardly any has it, in radii."""
_LEAST_PART = 0.05
_LEAST_OUTSIDE = 0.999
_MOST_IN_RIM = 0.05
FEWEST_VALUES = 16
"""Least share of a slice that lies outside, least share of it that has the value, largest share of the rim that has it,
and fewest values there."""


class Disc(NamedTuple):
    """Padding outside of a round field of view: its value, how many voxels, what they were filled with."""

    value: float
    voxels: int
    filled: float

    def describe(self, total: int) -> str:
        return (
            f"{100.0 * self.voxels / total:.3g} % of the voxels, all outside of a round field of view, are at"
            f" {self.value:g} HU: padding that the files do not declare, {self.filled:g} HU is taken for it"
        )


def fill_disc_padding(voxels: NDArray[Any]) -> Disc | None:
    """Fill outside a round field of view of a value above air; None where there is no disc."""
    nk, nj, ni = voxels.shape
    value = voxels[0, 0, 0]
    if min(nj, ni) < _SMALLEST or value <= AIR_RANGE_HU[1]:
        return None
    distance = _measure_disc(voxels[nk // 2] != value)
    sampled = [picture for picture in voxels[:: -(-nk // SAMPLED_SLICES)] if picture.min() < picture.max()]
    if distance is None or not all(_is_disc(picture, value, distance) for picture in sampled):
        return None
    masks = PaddingMasks(voxels)
    for k, picture in enumerate(voxels):
        masks.add(k, pack_mask((picture == value) & (distance >= _RIM[1])))
    filled = masks.fill()
    return Disc(float(value), masks.count, float(value if filled is None else filled))


def _measure_disc(measured: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """Return each pixel's distance from a disc's centre, in radii; None if no disc ends as middle row and column do."""
    nj, ni = measured.shape
    row, column = np.flatnonzero(measured[nj // 2]), np.flatnonzero(measured[:, ni // 2])
    if not len(row) or not len(column):
        return None
    radii = ((column[-1] - column[0] + 1) / 2.0, (row[-1] - row[0] + 1) / 2.0)
    j, i = np.ogrid[:nj, :ni]
    distance = np.hypot(j - (column[0] + column[-1]) / 2.0, i - (row[0] + row[-1]) / 2.0) / min(radii)
    is_round = abs(radii[0] - radii[1]) <= _ROUND * min(radii)
    return distance if is_round and np.mean(distance > _OUTSIDE) >= _LEAST_PART else None


def _is_disc(picture: NDArray[Any], value: Any, distance: NDArray[np.float64]) -> bool:
    """True where a slice has the value everywhere outside, and other ones of many kinds within."""
    within = picture[(distance > _RIM[0]) & (distance < _RIM[1])]
    return bool(
        np.mean(picture[distance > _OUTSIDE] == value) >= _LEAST_OUTSIDE
        and np.mean(within == value) <= _MOST_IN_RIM
        and len(np.unique(within)) >= FEWEST_VALUES
    )


def count_masked_tissue(
    ends: tuple[float, float], header: StoredValues, stored: NDArray[Any], padding: NDArray[np.bool_]
) -> int:
    """Count voxels of a slice's padding, stored values between `ends`, that are tissue by their value and place."""
    low, high = ends
    # Padding below air is the usual case and needs no search.  NaN is not above air either.
    if not max(low * header.slope, high * header.slope) + header.intercept > AIR_RANGE_HU[1]:
        return 0
    # the padding that reaches an edge of the picture along its row or its column
    outer = np.zeros_like(padding)
    for axis in (0, 1):
        outer |= np.logical_and.accumulate(padding, axis=axis)
        outer |= np.flip(np.logical_and.accumulate(np.flip(padding, axis), axis=axis), axis)
    suspect = padding & ~outer | padding & (stored > low) & (stored < high)
    values = stored[suspect] * np.float64(header.slope) + header.intercept
    return int(np.count_nonzero(values > AIR_RANGE_HU[1]))


def describe_masked_tissue(count: int) -> str:
    """Return one line about the masked voxels of all slices; empty where there are none."""
    if not count:
        return ""
    return (
        f"{count:,} voxels with the HU of tissue are padding by PixelPaddingValue (0028,0120) or PixelPaddingRangeLimit"
        " (0028,0121) and are read as air, but lie inside of the picture or have many values: correct or remove these"
        " elements if the holes are not meant"
    )
