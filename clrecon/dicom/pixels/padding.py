"""Padding, the voxels without a measurement: they are filled with the value of the air measured beside them.

Padding and measured air of different value would have a surface between them: the reconstruction circle as a tube, at
every iso value between the two.  So no fixed value is safe: air is -1000 HU in theory, but -970 to -1010 HU in scans.
The median of the air beside the padding separates the fewest neighbours from it, at every iso value: none where air has
no noise, else no more than noise separates anyway.  Where the body reaches the circle it still meets air there, so its
surface stays closed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import AIR_HU

AIR_RANGE_HU = (-1100, -900)
"""Range of air beside the padding.  The table and a blanket are denser; noise exceeds both ends alike."""
SAMPLED_SLICES = 16
"""Number of evenly spread slices that are sampled; they give some thousand voxels beside the padding."""

KEPT_MASKS = 16
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
        self._mask = lru_cache(KEPT_MASKS)(partial(_unpack_mask, voxels.shape[1:]))

    def add(self, k: int, packed: tuple[bytes, int] | None) -> None:
        """Record the padding of slice `k`, as `pack_mask` returns it; None if the slice has none."""
        if packed is not None:
            bits, self._counts[k] = packed
            self._packed[k] = self._distinct.setdefault(bits, bits)  # equal masks share their memory

    @property
    def count(self) -> int:
        """Number of voxels that are padding."""
        return sum(self._counts.values())

    def fill(self, run: Map = map) -> float | None:
        """Set all padding to the value of the air beside it, or to `AIR_HU` where there is no air beside it.

        run: Processes several slices at once: the ``map`` of a pool.

        Returns: The value in HU; None without padding.
        """
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
