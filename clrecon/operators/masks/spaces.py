"""Spaces that a mask encloses: which they are, how large and how wide, and what HU they hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.marrow import find_open_places, holds_ball
from clrecon.geometry import Volume
from clrecon.opencl import download, upload
from clrecon.operators.masks.band_mask import mask_bytes, zero_words
from clrecon.operators.masks.mask import Mask
from clrecon.operators.masks.runs import Components, find_components, mark_with_voxels, write_runs

WIDE_ML = 20.0
"""Smaller spaces are not wide: even a slice of 5 mm through a ball of 35 mm has 19 ml."""


@dataclass(frozen=True)
class Spaces:
    """The components of what is not in a mask that it encloses, see `find_spaces`.

    numbers: ndarray, shape (n,). Number of each among all components, ascending.
    ml, mean_hu: ndarray, shape (n,)
    at_ends: ndarray, shape (n,), bool. True where an end of the volume cuts the space.
    """

    volume: Volume
    numbers: NDArray[np.intp]
    ml: NDArray[np.float64]
    mean_hu: NDArray[np.float64]
    at_ends: NDArray[np.bool_]
    _runs: _Runs
    _found: Components
    _mask: Mask

    @property
    def count(self) -> int:
        """Number of spaces."""
        return len(self.numbers)

    def choose(self, wanted: NDArray[np.bool_]) -> Mask:
        """Return the voxels of some of the spaces; `wanted` has shape (n,)."""
        mask, found = self._mask, self._found
        words_d = zero_words(mask.device, mask_bytes(mask.shape_ijk)["mask of the voxels"] // 4)
        if wanted.any():
            marks = np.zeros(4 * -(-found.count // 4), np.uint8)
            marks[self.numbers[wanted]] = 1
            write_runs(
                mask.device, found.runs.runs_d, found.runs.row_counts_d, found.numbers_d, upload(mask.device, marks),
                words_d, mask.shape_ijk,
            )  # fmt: skip
        return Mask(mask.volume, words_d, f"spaces in ({mask.name})", device=mask.device, memory=mask.memory)

    def are_wide(self, radius_mm: float) -> NDArray[np.bool_]:
        """Tell of each space whether a ball of this radius fits into it, see `holds_ball`, shape (n,).

        What lies beyond the ends of the volume counts as part of a space that they cut.
        """
        wide = np.zeros(self.count, bool)
        for place in np.flatnonzero(self.ml >= WIDE_ML) if np.isfinite(radius_mm) else ():
            wide[place] = self._runs.of(self.numbers[place]).holds_ball(self.volume, radius_mm)
        return wide

    def describe(self, which: NDArray[np.bool_]) -> dict[str, Any]:
        """Return number, ml and the largest of some of the spaces, with LPS mm of a voxel in the middle of it."""
        facts: dict[str, Any] = {"spaces": int(np.count_nonzero(which)), "ml": float(self.ml[which].sum())}
        if not which.any():
            return {**facts, "largest_ml": 0.0, "at_mm": None}
        largest = int(np.argmax(np.where(which, self.ml, -1.0)))
        middle = self._runs.of(self.numbers[largest]).middle()
        at = self.volume.ijk_to_lps(np.array([middle], np.float64))[0]
        return {**facts, "largest_ml": float(self.ml[largest]), "at_mm": [round(float(x), 1) for x in at]}


@dataclass(frozen=True)
class _Runs:
    """Runs of voxels on the host: j, k, first and last i and component of each, shapes (n,)."""

    j: NDArray[np.int64]
    k: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    numbers: NDArray[np.int32]

    @classmethod
    def read(cls, mask: Mask, found: Components) -> _Runs:
        """Read the runs of components from the device."""
        count, (_, nj, nk) = found.runs.count, mask.shape_ijk
        ends = download(mask.device, np.empty((count, 2), np.uint16), found.runs.runs_d).astype(np.int64)
        starts = download(mask.device, np.empty(nj * nk + 1, np.uint32), found.runs.row_counts_d)
        numbers = download(mask.device, np.empty(count, np.int32), found.numbers_d)
        counts = starts[1:].astype(np.int64) - starts[:-1].astype(np.int64)
        rows = np.repeat(np.arange(nj * nk), counts)
        return cls(rows % nj, rows // nj, ends[:, 0], ends[:, 1], numbers)

    def where(self, which: NDArray[np.bool_]) -> _Runs:
        return _Runs(self.j[which], self.k[which], self.first[which], self.last[which], self.numbers[which])

    def of(self, number: int) -> _Runs:
        """Return the runs of one component."""
        return self.where(self.numbers == number)

    def sum_hu(self, volume: Volume, count: int) -> NDArray[np.float64]:
        """Return the sum of the HU of each component, shape (count,)."""
        sums = np.zeros(count)
        nj, ni = volume.voxels.shape[1:]
        bounds = np.searchsorted(self.k, np.arange(len(volume.voxels) + 1))
        for k in np.flatnonzero(np.diff(bounds)):
            own = slice(int(bounds[k]), int(bounds[k + 1]))
            totals = np.zeros(nj * ni + 1)
            np.cumsum(volume.voxels[k].ravel(), dtype=np.float64, out=totals[1:])
            row = self.j[own] * ni
            hu = totals[row + self.last[own] + 1] - totals[row + self.first[own]]
            sums += np.bincount(self.numbers[own], hu, count)
        return sums

    def middle(self) -> tuple[int, int, int]:
        """Return i, j, k of a voxel in the middle of the middle slice."""
        at = np.flatnonzero(self.k == self.k[len(self.k) // 2])
        one = at[len(at) // 2]
        return int(self.first[one] + self.last[one]) // 2, int(self.j[one]), int(self.k[one])

    def holds_ball(self, volume: Volume, radius_mm: float) -> bool:
        """Tell whether a ball fits into these voxels."""
        lows = [int(low.min()) for low in (self.k, self.j, self.first)]
        highs = [int(high.max()) + 1 for high in (self.k, self.j, self.last)]
        steps = np.zeros([high - low for low, high in zip(lows, highs, strict=True)] + np.array([0, 0, 1]), np.int8)
        np.add.at(steps, (self.k - lows[0], self.j - lows[1], self.first - lows[2]), 1)
        np.add.at(steps, (self.k - lows[0], self.j - lows[1], self.last + 1 - lows[2]), -1)
        body = np.cumsum(steps, axis=2, dtype=np.int8)[:, :, :-1] > 0
        ends = tuple((low == 0, high == n) for low, high, n in zip(lows, highs, volume.voxels.shape, strict=True))
        di, dj, dk = volume.spacing
        return holds_ball(body, ends, (dk, dj, di), radius_mm)


def find_spaces(mask: Mask) -> Spaces:
    """Find the spaces that a mask encloses.

    A space is a component, by faces of voxels, of what is not in the mask.  It is enclosed if it does not reach the
    border of the volume, or reaches it only within what the mask encloses in that end slice alone: there an end of the
    volume cuts it, as that of a scan cuts the canal of a long bone.
    """
    device, shape, volume = mask.device, mask.shape_ijk, mask.volume
    rest = (~mask).bits
    found = find_components(device, rest, beside=2 * rest.needs()["mask of the voxels"], memory=mask.memory)
    none = np.empty(0)
    if not found.count:
        empty = np.empty(0, np.int64)
        runs = _Runs(empty, empty, empty, empty, empty.astype(np.int32))
        return Spaces(volume, none.astype(np.intp), none, none, none.astype(bool), runs, found, mask)
    marks_d, _ = mark_with_voxels(device, found, shape, _open_ends(mask))
    outside = download(device, np.empty(found.count, np.uint8), marks_d) != 0
    numbers = np.flatnonzero(~outside)
    runs = _Runs.read(mask, found)
    runs = runs.where(~outside[runs.numbers])
    from clrecon.labels.volumes import slice_voxel_ml  # label maps load pydicom, which others need not wait for

    lengths = (runs.last - runs.first + 1).astype(np.float64)
    voxels = np.bincount(runs.numbers, lengths, found.count)[numbers]
    each_ml = np.bincount(runs.numbers, lengths * slice_voxel_ml(volume)[runs.k], found.count)[numbers]
    hu = runs.sum_hu(volume, found.count)[numbers] / np.maximum(voxels, 1.0)
    ni, nj, nk = shape
    at_end = np.zeros(found.count, bool)
    ends = (runs.k == 0) | (runs.k == nk - 1) | (runs.j == 0) | (runs.j == nj - 1)
    at_end[runs.numbers[ends | (runs.first == 0) | (runs.last == ni - 1)]] = True
    return Spaces(volume, numbers, each_ml.astype(np.float64), hu, at_end[numbers], runs, found, mask)


def find_joints(mask: Mask, reach_mm: float, least_ml: float) -> Mask:
    """Choose what lies within a distance of two pieces of a mask that are apart and have some volume each."""
    device, shape, volume = mask.device, mask.shape_ijk, mask.volume
    words = mask_bytes(shape)["mask of the voxels"]
    found = find_components(device, mask.bits, beside=3 * words, memory=mask.memory)
    from clrecon.labels.volumes import slice_voxel_ml  # label maps load pydicom, which others need not wait for

    joints = Mask(volume, zero_words(device, words // 4), "joints", device=device, memory=mask.memory)
    if found.count < 2:
        return joints
    runs = _Runs.read(mask, found)
    ml = np.bincount(runs.numbers, (runs.last - runs.first + 1) * slice_voxel_ml(volume)[runs.k], found.count)
    large = np.flatnonzero(ml >= least_ml)
    # Two pieces differ in at least one bit of their places in the list.
    for bit in range(max(len(large) - 1, 0).bit_length()):
        sides = []
        for value in (0, 1):
            marks = np.zeros(4 * -(-found.count // 4), np.uint8)
            marks[large[(np.arange(len(large)) >> bit & 1) == value]] = 1
            side_d = zero_words(device, words // 4)
            write_runs(
                device,
                found.runs.runs_d,
                found.runs.row_counts_d,
                found.numbers_d,
                upload(device, marks),
                side_d,
                shape,
            )
            sides.append(Mask(volume, side_d, "bones", device=device, memory=mask.memory).dilate(reach_mm))
        joints = joints | (sides[0] & sides[1])
    return joints


def _open_ends(mask: Mask) -> NDArray[np.int32]:
    """Return i, j, k of the voxels of the six ends of the volume that the mask does not enclose there, shape (n, 3)."""
    ni, nj, nk = mask.shape_ijk
    words = download(mask.device, np.empty((nk, nj, -(-ni // 32)), "<u4"), mask._mask_d)
    found = []
    for place in (0, nk - 1):
        face = np.unpackbits(words[place].view(np.uint8), axis=1, count=ni, bitorder="little")
        j, i = np.nonzero(find_open_places(face))
        found.append((i, j, np.full_like(i, place)))
    for place in (0, nj - 1):
        rows = np.ascontiguousarray(words[:, place])
        face = np.unpackbits(rows.view(np.uint8), axis=1, count=ni, bitorder="little")
        k, i = np.nonzero(find_open_places(face))
        found.append((i, np.full_like(i, place), k))
    for place in (0, ni - 1):
        face = (words[:, :, place // 32] >> np.uint32(place % 32)) & 1
        k, j = np.nonzero(find_open_places(face))
        found.append((np.full_like(j, place), j, k))
    return np.concatenate([np.stack(axes, axis=1) for axes in found]).astype(np.int32)
