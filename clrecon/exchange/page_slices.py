"""Slices of a scan on a page of its surface: voxels in steps of 4 HU, averaged where they would take too much room.

Each row of voxels is coded as differences of neighbours, whose signs are folded into the lowest bit, in byte planes, as
the surface is (`clrecon.exchange.page`).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass

MOST_BYTES = 10_000_000
"""Of the text that slices add to a page."""

_STEP_HU, _STEPS = 4.0, 1024
"""HU from one value to the next, and how many values there are: up to 3,068 HU."""

_LOWEST_HU = -1024.0

_GROWTH = 1.05
"""Least factor by which voxels grow from one trial to the next."""

_LEVEL = 6


@dataclass(frozen=True, eq=False)
class PackedSlices:
    """What a page holds of a scan: its facts for the script, and its voxels, packed."""

    facts: dict[str, Any]
    data: bytes


def pack_slices(volume: Volume, windows: Mapping[str, Sequence[float]], most_bytes: int = MOST_BYTES) -> PackedSlices:
    """Pack a scan so that its text on a page has at most so many bytes; blocks of voxels are averaged until it fits.

    windows: HU of black and white by name, the first of which the page begins with.
    """
    if volume.uneven:
        raise UsageError(
            "the slices of this scan are uneven, and a page shows even ones only: leave"
            f" {name_parameter('with_slices')} out"
        )
    spacing = np.array(volume.spacing)
    target = float(spacing.min())
    while True:
        counts = np.minimum(np.maximum(1, np.rint(target / spacing).astype(int)), volume.shape_ijk)
        voxels = _average(volume.voxels, counts[::-1])
        data = _encode(voxels)
        size = 4 * math.ceil(len(data) / 3)  # of base64
        if size <= most_bytes or counts.tolist() == list(volume.shape_ijk):
            break
        target *= max(_GROWTH, (size / most_bytes) ** (1.0 / 3.0))
    affine = volume.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ (0.5 * (counts - 1))
    affine[:3, :3] *= counts
    facts = {
        "shape": list(voxels.shape[::-1]),
        "averaged": counts.tolist(),
        "affine": affine.tolist(),
        "step_hu": _STEP_HU,
        "low_hu": _LOWEST_HU,
        "windows": {name: list(ends) for name, ends in windows.items()},
    }
    return PackedSlices(facts, data)


def describe_slices(facts: dict[str, Any]) -> str:
    size = " x ".join(str(count) for count in facts["shape"])
    averaged = facts["averaged"]
    means = "" if max(averaged) == 1 else f", each the mean of {' x '.join(map(str, averaged))} voxels"
    return f"Slices: {size} values of the scan{means}, in steps of {facts['step_hu']:g} HU."


def _average(voxels: NDArray[Any], counts: Sequence[int] | NDArray[np.int64]) -> NDArray[Any]:
    """Return the means of blocks of (k, j, i) voxels; what is left at the ends is cut off."""
    if max(counts) == 1:
        return voxels
    ck, cj, ci = (int(count) for count in counts)
    nk, nj, ni = (size // count for size, count in zip(voxels.shape, (ck, cj, ci), strict=True))
    layers = [
        voxels[k * ck : (k + 1) * ck, : nj * cj, : ni * ci].reshape(ck, nj, cj, ni, ci).mean(axis=(0, 2, 4))
        for k in range(nk)
    ]
    return np.stack(layers)


def _encode(voxels: NDArray[Any]) -> bytes:
    """Return the packed byte planes of voxels, a layer at a time: scans are larger than what is copied of them."""
    packer = zlib.compressobj(_LEVEL, wbits=16 + zlib.MAX_WBITS)
    folded = np.empty(voxels.shape, np.uint16)
    for layer, codes in zip(voxels, folded, strict=True):
        values = np.rint((layer.astype(np.float64) - _LOWEST_HU) / _STEP_HU)
        steps = np.diff(np.clip(values, 0, _STEPS - 1).astype(np.int32), axis=1, prepend=0)
        codes[...] = (steps << 1) ^ (steps >> 31)
    planes = [packer.compress((folded & 255).astype(np.uint8).tobytes())]
    planes.append(packer.compress((folded >> 8).astype(np.uint8).tobytes()))
    return b"".join(planes) + packer.flush()
