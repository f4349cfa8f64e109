"""Plausibility of HU: what the voxels themselves say of their values, in a few milliseconds.

Shares are those of a sample of the voxels; a figure that a warning states is counted in all voxels.

The gate ``stored_sign``: whether the highest stored bit was read as what it is, a sign or a part of the value. Where it
was not, values wrap around: air becomes the densest of all, or dense bone turns negative inside of bone.  Neighbours on
either side of the highest bit are close together in a picture; once wrapped they are nearly the whole range of the
stored bits apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry import METAL_HU
from clrecon.reading.common.hu_scale import LOWEST_AIR_HU, SCALE_SAID, Layers, ValueSample, judge_scale, sample_slices
from clrecon.reading.common.likeness import SHOWN_SAID, judge_shown_places
from clrecon.reading.common.source_facts import PixelFacts, StoredValues
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.records import Gate, none_of, unmeasured
from clrecon.system.text import count_of

PADDING_SHARE = 0.75
"""Largest share of padding.  A circle in its square leaves 0.21, a 500 mm circle in a field of 800 mm 0.69; above that
a wrong PixelPaddingValue probably masks measured voxels."""
PIXEL_MM = (0.005, 10.0)
"""Range of pixel sizes: from the finest micro-CT in use to attenuation maps of PET and SPECT."""
GAP_MM = (0.005, 50.0)
LOWEST_HU, _DENSEST_HU = (-10_000.0, 1000.0), (-900.0, 70_000.0)
"""Ranges of the lowest and the densest voxel.  Undeclared padding goes down to -8192; a cut-out of bone has spongy
parts.  A densest voxel below -900 is air; 16 bits end at 65535."""


def judge_steps(pixels_mm: Sequence[float], gap_mm: float | None) -> Gate:
    """Judge whether pixels and gaps are those of scanners: a mesh a thousand times too large looks like any other."""
    (low, high), (gap_low, gap_high) = PIXEL_MM, GAP_MM
    odd = [f"pixels of {mm:g} mm" for mm in sorted(set(pixels_mm)) if not low <= mm <= high]
    if gap_mm is not None and not gap_low <= gap_mm <= gap_high:
        odd.append(f"gaps of {gap_mm:g} mm")
    words = f"spacings that no scanner has, outside of {low:g} to {high:g} mm, gaps up to {gap_high:g} mm"
    return none_of("plausible_spacing", len(odd), f"{words} ({', '.join(odd)})" if odd else words)


def list_odd_values(facts: PixelFacts) -> list[str]:
    """Return the lowest and the densest voxel if they lie outside the range of every CT."""
    return [
        f"{name} voxel {value:g} HU, expected {low:g} to {high:g}"
        for name, value, (low, high) in (("lowest", facts.hu_min, LOWEST_HU), ("densest", facts.hu_max, _DENSEST_HU))
        if not low <= value <= high
    ]


def judge_figures(odd: Sequence[str]) -> Gate:
    """Judge the gate ``plausible_hu``, given the unusual figures."""
    words = "implausible HU values"
    return none_of("plausible_hu", len(odd), f"{words} ({'; '.join(odd)})" if odd else words)


_SIGN_SAID = "neighbouring values that lie nearly the whole range of the stored bits apart: the sign is lost"

_FEWEST_BITS = 9
"""An image of 8 bits or fewer has edges from the lowest to the highest value."""
_CLOSE = 0.125
"""Neighbours this share of the range apart are close."""
_FEWEST_JUMPS = 50
JUMPS = 4
FEWEST_VALUES = 8
"""Fewest pairs of neighbours that are close only if they are read the other way, how many times those that are close as
they were read, and fewest different values of theirs: a mask has two."""


def judge_sign(voxels: NDArray[Any], facts: PixelFacts, slices: Sequence[StoredValues]) -> Gate:
    """Judge the gate ``stored_sign`` by the sampled slices of a volume (nk, nj, ni); `slices` in the order of k."""
    if not slices:
        return unmeasured("stored_sign", 0, None, f"{_SIGN_SAID}: the values are no whole numbers")
    close, jumps = 0, 0
    pairs = []
    first = slices[0]
    for k in sample_slices(len(slices)):
        header = slices[k]
        span = header.slope * 2.0**header.bits_stored
        if header.bits_stored < _FEWEST_BITS or facts.hu_max - facts.hu_min < (1.0 - _CLOSE) * span or span <= 0.0:
            continue
        picture = voxels[k]
        half = 0.0 if header.signed else 2.0 ** (header.bits_stored - 1)
        above = picture >= half * header.slope + header.intercept
        crossing = above[:, 1:] != above[:, :-1]
        left, right = picture[:, :-1][crossing].astype(np.float64), picture[:, 1:][crossing].astype(np.float64)
        apart = np.abs(left - right)
        close += int(np.count_nonzero(apart < _CLOSE * span))
        wrapped = apart > (1.0 - _CLOSE) * span
        jumps += int(np.count_nonzero(wrapped))
        pairs.append(left[wrapped])
    if jumps < _FEWEST_JUMPS or jumps <= JUMPS * close or len(np.unique(np.concatenate(pairs))) < FEWEST_VALUES:
        return none_of("stored_sign", 0, _SIGN_SAID)
    count = 2**first.bits_stored
    if first.signed:
        why = "values of dense bone or metal turn negative: the values seem to be stored without a sign, but"
        wrong, right_one = "PixelRepresentation is 1 (signed)", 0
    else:
        why = "no air, and values at the far end of the range: the values seem to be signed, but"
        wrong, right_one = "PixelRepresentation is 0 (unsigned)", 1
    return none_of(
        "stored_sign",
        jumps,
        f"neighbouring values nearly {count:,} apart, the whole range of {first.bits_stored} stored bits, and {why}"
        f" {wrong}; write the files anew with PixelRepresentation {right_one}. Pairs found in the sampled slices",
    )


_CEILING_BITS = 12
"""Bits of most scanners, even where more bits are stored: 3071 HU with intercept -1024."""
CEILING_HU = 3071
"""Highest value of 12 bits, however the values are stored now."""
_CEILING_VOXELS = 10
"""Least number of voxels at the ceiling; fewer may be noise in dense bone."""

_CEILING_LEVELS, _CEILING_SPIKE = 8, 10.0
"""Values beyond a ceiling: it still counts as one if it has this many times the voxels of the values around it.  Values
that were cut off there and then interpolated, or put beside slices with more bits, exceed it in a few voxels."""

_LEAST_PADDING_SHARE = 0.01
_BLANK_SHOWN = 5


@dataclass(frozen=True)
class VoxelFindings:
    """Warnings, the gates ``hu_scale``, ``stored_sign`` and ``shown_places``, both materials where the first fails."""

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
    """Examine values, of DICOM with its slices by k, else as `stored`; `known`: nothing says that they are no HU."""
    if facts.hu_min == facts.hu_max:
        content = "padding" if facts.padding_share == 1.0 else f"{facts.hu_min:g} HU"
        raise RefusedInputError(f"all {voxels.size:,} voxels are {content}: the volume is constant and holds no image")
    sign, shown = judge_sign(voxels, facts, slices or stored), judge_shown_places(voxels)
    if sign.ok is False:
        unknown = unmeasured("hu_scale", 0, None, f"{SCALE_SAID}: the sign of the values is lost")
        return VoxelFindings([], [unknown, sign, shown])
    sample = ValueSample.of(voxels, facts)
    slopes = [one.slope for one in slices] or [1.0]
    scale, materials = judge_scale(sample, Layers(voxels), facts, slopes, known=known)
    warnings = [facts.padding_text] if facts.padding_text else []
    if facts.blank:
        named = ", ".join(str(k + 1) for k in facts.blank[:_BLANK_SHOWN]) + ", ..." * (len(facts.blank) > _BLANK_SHOWN)
        warnings.append(
            f"{count_of(len(facts.blank), 'slice')} of {len(voxels):,} between others show one value alone, no picture"
            f" ({named}): what is there is cut in two"
        )
    warnings += _warn_of_saturation(voxels, facts, slices)
    if sample is not None and scale.ok is not False:
        warnings += _warn_of_padding(sample, voxels)
    return VoxelFindings(warnings, [scale, sign, shown], materials)


def leave_unexamined() -> list[Gate]:
    """Return the gates of `examine_voxels` as not measured, for voxels that were not read."""
    return [
        unmeasured(name, 0, None, f"{text}: the pixels were not read")
        for name, text in (("hu_scale", SCALE_SAID), ("stored_sign", _SIGN_SAID), ("shown_places", SHOWN_SAID))
    ]


def _warn_of_saturation(voxels: NDArray[Any], facts: PixelFacts, slices: Sequence[StoredValues]) -> list[str]:
    """Warn of voxels at the highest value that the stored bits, or the 12 bits of the scanner, can express."""
    members: dict[tuple[float, int], set[int]] = {}
    if facts.hu_max >= CEILING_HU:
        members[float(CEILING_HU), _CEILING_BITS] = set(range(len(voxels)))
    for k, header in enumerate(slices):
        highest = (1 << (header.bits_stored - header.signed)) - 1
        for bits, stored in {(_CEILING_BITS, (1 << _CEILING_BITS) - 1), (header.bits_stored, highest)}:
            ceiling = float(np.float32(header.slope * stored + header.intercept))
            if stored <= highest and ceiling <= facts.hu_max:
                members.setdefault((ceiling, bits), set()).add(k)
    warnings = []
    for (ceiling, bits), places in sorted(members.items()):
        slope = abs(slices[min(places)].slope) if slices else 1.0
        count, above, beside = np.sum([_count_near(voxels[k], ceiling, slope) for k in places], axis=0).tolist()
        # Values continue beyond: measured with more bits, unless a great many voxels have exactly this value.
        if count <= _CEILING_VOXELS or above and count <= _CEILING_SPIKE * beside / (2 * _CEILING_LEVELS):
            continue
        cause = "metal is saturated" if ceiling > METAL_HU else "metal or dense bone is cut off"
        more = f" and {above} are above it, at most at {facts.hu_max:g} HU" if above else ""
        warnings.append(
            f"{count} voxels are at {ceiling:g} HU, the ceiling of {bits} bits{more}: {cause}, its surface displaced"
        )
    return warnings


def _count_near(picture: NDArray[Any], ceiling: float, slope: float) -> tuple[int, int, int]:
    """Count voxels of a slice at the ceiling, above it, and on the `_CEILING_LEVELS` next values on either side."""
    near = picture[picture >= ceiling - (_CEILING_LEVELS + 0.5) * slope]
    equal = int(np.count_nonzero(near == ceiling))
    return (
        equal,
        int(np.count_nonzero(near > ceiling)),
        int(np.count_nonzero(near <= ceiling + (_CEILING_LEVELS + 0.5) * slope)) - equal,
    )


def _warn_of_padding(sample: ValueSample, voxels: NDArray[Any]) -> list[str]:
    """Warn of one value far below air that many voxels have, without being declared as padding."""
    padding = sample.commonest_below(LOWEST_AIR_HU)
    if padding is None or padding[1] < _LEAST_PADDING_SHARE:
        return []
    value = padding[0]
    share = sum(int(np.count_nonzero(picture == value)) for picture in voxels) / voxels.size
    return [
        f"{100.0 * share:.3g} % of the voxels are at {value:g} HU, below air: padding that the files do not declare; it"
        f" is left as it is and counts as outside, only iso values from {value:g} to about -1000 HU show its border"
    ]
