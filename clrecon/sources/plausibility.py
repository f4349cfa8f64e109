"""Plausibility of HU: what the voxels themselves say of their values, in a few milliseconds.

Shares are those of a sample of the voxels.  A figure that a warning states is counted in all voxels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry import METAL_HU
from clrecon.sources.facts import PixelFacts
from clrecon.sources.sample import ValueSample
from clrecon.sources.scale import LOWEST_AIR_HU, SCALE_SAID, judge_scale
from clrecon.sources.sign import SIGN_SAID, judge_sign
from clrecon.sources.stored_values import StoredValues
from clrecon.system.records import Gate, unmeasured

CEILING_BITS = 12
"""Bits of most scanners, even where more bits are stored: 3071 HU with intercept -1024."""
CEILING_HU = 3071
"""Highest value of 12 bits, however the values are stored now."""
CEILING_VOXELS = 10
"""Least number of voxels at the ceiling; fewer may be noise in dense bone."""

CEILING_LEVELS, CEILING_SPIKE = 8, 10.0
"""Values beyond a ceiling: it still counts as one if it has this many times the voxels of the values around it.  Values
that were cut off there and then interpolated, or put beside slices with more bits, exceed it in a few voxels."""

LEAST_PADDING_SHARE = 0.01


@dataclass(frozen=True)
class VoxelFindings:
    """What the voxels say of their values: warnings, the gates ``hu_scale`` and ``stored_sign``, and the values of
    ``air`` and ``soft_tissue`` where the first fails.
    """

    warnings: list[str]
    gates: list[Gate]
    materials: Mapping[str, float] = field(default_factory=dict)


def examine_voxels(
    voxels: NDArray[Any],
    facts: PixelFacts,
    slices: Sequence[StoredValues],
    *,
    known: bool,
    stored: Sequence[StoredValues] = (),
) -> VoxelFindings:
    """Examine the values that were read.

    voxels: ndarray, shape (nk, nj, ni). HU.
    slices: In the order of k; empty for files other than DICOM.
    known: False: the header does not say that the values are HU, or they surely are not.
    stored: As `slices`, for other files of whole numbers.
    """
    if facts.hu_min == facts.hu_max:
        what = "padding" if facts.padding_share == 1.0 else f"{facts.hu_min:g} HU"
        raise RefusedInputError(f"all {voxels.size:,} voxels are {what}: the volume is constant and holds no image")
    sign = judge_sign(voxels, facts, slices or stored)
    if sign.ok is False:
        unknown = unmeasured("hu_scale", 0, None, f"{SCALE_SAID}: the sign of the values is lost")
        return VoxelFindings([], [unknown, sign])
    sample = ValueSample.of(voxels, facts)
    scale, materials = judge_scale(sample, facts, [one.slope for one in slices] or [1.0], known)
    warnings = [facts.padding_text] if facts.padding_text else []
    warnings += _warn_of_saturation(voxels, facts, slices)
    if sample is not None and scale.ok is not False:
        warnings += _warn_of_padding(sample, voxels)
    return VoxelFindings(warnings, [scale, sign], materials)


def leave_unexamined() -> list[Gate]:
    """Return the gates of `examine_voxels` as not measured, for voxels that were not read."""
    return [
        unmeasured(name, 0, None, f"{text}: the pixels were not read")
        for name, text in (("hu_scale", SCALE_SAID), ("stored_sign", SIGN_SAID))
    ]


def _warn_of_saturation(voxels: NDArray[Any], facts: PixelFacts, slices: Sequence[StoredValues]) -> list[str]:
    """Warn of voxels at the highest value that the stored bits, or the 12 bits of the scanner, can express."""
    members: dict[tuple[float, int], set[int]] = {}
    if facts.hu_max >= CEILING_HU:
        members[float(CEILING_HU), CEILING_BITS] = set(range(len(voxels)))
    for k, header in enumerate(slices):
        highest = (1 << (header.bits_stored - header.signed)) - 1
        for bits, stored in {(CEILING_BITS, (1 << CEILING_BITS) - 1), (header.bits_stored, highest)}:
            ceiling = float(np.float32(header.slope * stored + header.intercept))
            if stored <= highest and ceiling <= facts.hu_max:
                members.setdefault((ceiling, bits), set()).add(k)
    warnings = []
    for (ceiling, bits), places in sorted(members.items()):
        slope = abs(slices[min(places)].slope) if slices else 1.0
        at, above, beside = np.sum([_count_near(voxels[k], ceiling, slope) for k in places], axis=0).tolist()
        # Values continue beyond: measured with more bits, unless a great many voxels have exactly this value.
        if at <= CEILING_VOXELS or above and at <= CEILING_SPIKE * beside / (2 * CEILING_LEVELS):
            continue
        what = "metal is saturated, its surface" if ceiling > METAL_HU else "dense bone is cut off, its surface"
        more = f" and {above} are above it, at most at {facts.hu_max:g} HU" if above else ""
        warnings.append(f"{at} voxels are at {ceiling:g} HU, the ceiling of {bits} bits{more}: {what} displaced")
    return warnings


def _count_near(picture: NDArray[Any], ceiling: float, slope: float) -> tuple[int, int, int]:
    """Count voxels of a slice at the ceiling, above it, and on the `CEILING_LEVELS` next values on either side."""
    near = picture[picture >= ceiling - (CEILING_LEVELS + 0.5) * slope]
    at = int(np.count_nonzero(near == ceiling))
    return (
        at,
        int(np.count_nonzero(near > ceiling)),
        int(np.count_nonzero(near <= ceiling + (CEILING_LEVELS + 0.5) * slope)) - at,
    )


def _warn_of_padding(sample: ValueSample, voxels: NDArray[Any]) -> list[str]:
    """Warn of one value far below air that many voxels have, without being declared as padding.

    The value is found in the sample; its voxels are counted in the whole volume.
    """
    found = sample.commonest_below(LOWEST_AIR_HU)
    if found is None or found[1] < LEAST_PADDING_SHARE:
        return []
    value = found[0]
    share = sum(int(np.count_nonzero(picture == value)) for picture in voxels) / voxels.size
    return [
        f"{100.0 * share:.3g} % of the voxels are at {value:g} HU, below air: padding that the files do not declare; it"
        f" is left as it is and counts as outside, only iso values from {value:g} to about -1000 HU show its border"
    ]
