"""Plausibility of HU: whether the voxels can be HU, judged by their values in a few milliseconds.

Headers may be wrong about rescale: an intercept that is missing or was applied twice shifts all values by 1024 HU, and
no check of the geometry notices.  The figures below are shares of a sample of the voxels.  A warning needs air *and*
soft tissue in the wrong places, 1000 HU apart, so that scans without air (a cropped spine) or without soft tissue (a
dry bone) give none.  A figure that a warning states is counted in all voxels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry import AIR_HU
from clrecon.sources.facts import PixelFacts

__all__ = ["StoredValues", "collect_voxel_warnings"]

CEILING_BITS = 12
"""Bits of most scanners, even where more bits are stored: 3071 HU with intercept -1024."""
CEILING_HU = 3071
"""Highest value where no header says how values were stored."""
CEILING_VOXELS = 10
"""Least number of voxels at the ceiling; fewer may be noise in dense bone."""

CEILING_LEVELS, CEILING_SPIKE = 8, 10.0
"""Values beyond a ceiling: it still counts as one if it has this many times the voxels of the values around it.  Values
that were cut off there and then interpolated, or put beside slices with more bits, exceed it in a few voxels."""

METAL_HU = 2000
"""Highest value of cortical bone."""

SAMPLED_SLICES, SAMPLED_VOXELS = 16, 1 << 16
LEAST_SAMPLE = 1000
"""Least number of sampled voxels for stating a share."""

LOWEST_AIR_HU = -1100
"""Noise may be lower, but no value that many voxels share."""
LEAST_PADDING_SHARE = 0.01

INTERCEPT_HU = 1024
LEAST_SHARE = 0.02
"""Least share of air and soft tissue for reporting a shift.  Air counts within 100 HU, soft tissue within 150."""
LEAST_RAW_HU = -300
"""Stored values without their intercept are not negative; soft tissue and fat alone are not below this."""
MOST_BEYOND = 0.002
"""Largest share in ranges that are empty in a shifted scan: below air, or above the shifted values of bone."""


class StoredValues(Protocol):
    """What a header says of the values of its slice.

    Attributes
    ----------
    bits_stored : int
    signed : bool
    slope, intercept : float
        Of the rescale to HU.
    """

    @property
    def bits_stored(self) -> int: ...
    @property
    def signed(self) -> bool: ...
    @property
    def slope(self) -> float: ...
    @property
    def intercept(self) -> float: ...


def collect_voxel_warnings(voxels: NDArray[Any], facts: PixelFacts, slices: Sequence[StoredValues]) -> list[str]:
    """Return warnings about the HU that were read.

    Parameters
    ----------
    voxels : ndarray, shape (nk, nj, ni)
        HU.
    facts : PixelFacts
    slices : sequence of StoredValues
        In the order of k; empty for files other than DICOM.

    Raises
    ------
    RefusedInputError
        All voxels have one value.
    """
    if facts.hu_min == facts.hu_max:
        what = "padding" if facts.padding_share == 1.0 else f"{facts.hu_min:g} HU"
        raise RefusedInputError(f"all {voxels.size:,} voxels are {what}: the volume is constant and holds no image")
    warnings = _warn_of_saturation(voxels, facts, slices)
    if LOWEST_AIR_HU <= facts.hu_min < LEAST_RAW_HU and facts.padding_hu != AIR_HU:
        return warnings  # a usual scan: no further checks
    shares = _Shares.of(voxels, facts)
    if shares is None:
        return warnings
    if shares.fits(0):
        return warnings + _warn_of_padding(shares, voxels)
    if facts.hu_min < LOWEST_AIR_HU and shares.fits(-INTERCEPT_HU) and not shares.is_specimen():
        return [*warnings, _describe_shift(-INTERCEPT_HU, "seems to have been applied twice")]
    if shares.fits(INTERCEPT_HU) and shares.between(-np.inf, LEAST_RAW_HU) < MOST_BEYOND:
        return [*warnings, _describe_shift(INTERCEPT_HU, "seems to be missing")]
    return warnings + _warn_of_padding(shares, voxels)


def _describe_shift(shift: int, what: str) -> str:
    return (
        f"air lies near {shift - 1000} HU and soft tissue near {shift} HU: the rescale intercept {what},"
        f" iso values are {abs(shift)} HU too {'low' if shift > 0 else 'high'} for this scan"
    )


def _warn_of_saturation(voxels: NDArray[Any], facts: PixelFacts, slices: Sequence[StoredValues]) -> list[str]:
    """Warn of voxels at the highest value that the stored bits, or the 12 bits of the scanner, can express."""
    members: dict[tuple[float, int], list[int]] = {}
    if not slices and facts.hu_max >= CEILING_HU:
        members[float(CEILING_HU), CEILING_BITS] = list(range(len(voxels)))
    for k, header in enumerate(slices):
        highest = (1 << (header.bits_stored - header.signed)) - 1
        for bits, stored in {(CEILING_BITS, (1 << CEILING_BITS) - 1), (header.bits_stored, highest)}:
            ceiling = float(np.float32(header.slope * stored + header.intercept))
            if stored <= highest and ceiling <= facts.hu_max:
                members.setdefault((ceiling, bits), []).append(k)
    warnings = []
    for (ceiling, bits), places in sorted(members.items()):
        slope = abs(slices[places[0]].slope) if slices else 1.0
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


class _Shares:
    """A sorted sample of the measured voxels; `between` returns the share in a range of HU."""

    def __init__(self, values: NDArray[Any]):
        self.values = values

    @classmethod
    def of(cls, voxels: NDArray[Any], facts: PixelFacts) -> _Shares | None:
        """Take a sample; None where it is too small for shares."""
        slices = voxels[:: -(-voxels.shape[0] // SAMPLED_SLICES)]
        step = max(1, int((slices.size / SAMPLED_VOXELS) ** 0.5))
        values = slices[:, ::step, ::step].ravel()
        if facts.padding_hu is not None:
            values = values[values != facts.padding_hu]  # measured air of this value is left out too
        return cls(np.sort(values)) if len(values) >= LEAST_SAMPLE else None

    def between(self, low: float, high: float) -> float:
        """Return the share with ``low <= HU < high``."""
        first, end = np.searchsorted(self.values, (low, high))
        return float(end - first) / len(self.values)

    def fits(self, shift: int) -> bool:
        """True if air and soft tissue lie where a shift of the HU by `shift` puts them, with less between them than
        tissue.
        """
        air = self.between(shift - 1100, shift - 900)
        tissue = self.between(shift - 150, shift + 150)
        return min(air, tissue) >= LEAST_SHARE and self.between(shift - 800, shift - 300) < tissue

    def is_specimen(self) -> bool:
        """True for dense bone in air with padding of one value: it looks like soft tissue and air 1024 HU too low."""
        found = self.commonest_below(LOWEST_AIR_HU)
        padded = found is not None and found[1] > 0.9 * self.between(-np.inf, LOWEST_AIR_HU)
        return padded and self.between(500, np.inf) >= MOST_BEYOND

    def commonest_below(self, limit: float) -> tuple[float, float] | None:
        """Return the most frequent value below `limit`, and its share of all voxels."""
        low = self.values[: np.searchsorted(self.values, limit)]
        if not len(low):
            return None
        found, counts = np.unique(low, return_counts=True)
        return float(found[counts.argmax()]), float(counts.max()) / len(self.values)


def _warn_of_padding(shares: _Shares, voxels: NDArray[Any]) -> list[str]:
    """Warn of one value far below air that many voxels have, without being declared as padding.

    The value is found in the sample; its voxels are counted in the whole volume.
    """
    found = shares.commonest_below(LOWEST_AIR_HU)
    if found is None or found[1] < LEAST_PADDING_SHARE:
        return []
    value = found[0]
    share = sum(int(np.count_nonzero(picture == value)) for picture in voxels) / voxels.size
    return [
        f"{100.0 * share:.3g} % of the voxels are at {value:g} HU, below air: padding that the files do not declare; it"
        f" is left as it is and counts as outside, only iso values from {value:g} to about -1000 HU show its border"
    ]
