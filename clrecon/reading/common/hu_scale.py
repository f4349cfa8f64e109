"""The gate ``hu_scale``: whether air and soft tissue have the values that a CT gives them.

Headers may be wrong about rescale, and cone-beam scanners often have a scale of their own: no check of the geometry
notices.  The gate fails only where both are in the wrong places: a dry bone has no soft tissue, a crop of a body no
air, bone in water neither, and raw values of a micro-CT may be any.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.reading.common.source_facts import PixelFacts
from clrecon.system.records import Gate, none_of, unmeasured

SAMPLED_SLICES, SAMPLED_VOXELS = 16, 1 << 16
_LEAST_SAMPLE = 1000
"""Least number of sampled voxels for stating a share."""
_SPIKE_SHARE, _SPIKE_RATIO = 0.01, 10.0
"""A value that so many voxels have, so many times more than has one of the values next to it, was not measured."""


def sample_slices(count: int) -> range:
    """Return the places of the slices that are sampled, of `count`."""
    return range(0, count, -(-count // SAMPLED_SLICES))


class ValueSample:
    """Sorted values of voxels; `between` returns the share in a range."""

    def __init__(self, values: NDArray[Any]):
        self.values = values

    @classmethod
    def of(cls, voxels: NDArray[Any], facts: PixelFacts) -> ValueSample | None:
        """Take a sample of the measured voxels; None where it is too small for shares."""
        places = sample_slices(voxels.shape[0])
        step = max(1, int((len(places) * voxels[0].size / SAMPLED_VOXELS) ** 0.5))
        values = voxels[:: places.step, ::step, ::step].ravel()
        if facts.padding_hu is not None:
            values = values[values != facts.padding_hu]  # measured air of this value is left out too
        return cls(np.sort(values)) if len(values) >= _LEAST_SAMPLE else None

    def between(self, low: float, high: float) -> float:
        first, end = np.searchsorted(self.values, (low, high))
        return float(end - first) / len(self.values)

    def median_between(self, low: float, high: float) -> float:
        first, end = np.searchsorted(self.values, (low, high))
        return float(self.values[(first + end) // 2])

    def commonest_below(self, limit: float) -> tuple[float, float] | None:
        """Return the most frequent value below `limit`, and its share of all voxels."""
        low = self.values[: np.searchsorted(self.values, limit)]
        if not len(low):
            return None
        values, counts = np.unique(low, return_counts=True)
        return float(values[counts.argmax()]), float(counts.max()) / len(self.values)

    def without_spikes(self, low: float = np.inf, high: float = -np.inf) -> ValueSample | None:
        """Leave out values outside of a range that stand out of those beside them; None where too few are left."""
        distinct, counts = np.unique(self.values, return_counts=True)
        before, after = np.pad(counts, (1, 0))[:-1], np.pad(counts, (0, 1))[1:]
        spikes = (counts >= _SPIKE_SHARE * len(self.values)) & (counts >= _SPIKE_RATIO * np.minimum(before, after))
        spikes &= (distinct < low) | (distinct > high)
        values = self.values[np.repeat(~spikes, counts)]
        return ValueSample(values) if len(values) >= _LEAST_SAMPLE else None


_SMOOTHING = 20.0
_FINEST_BIN = 5.0
_MOST_BINS = 8000
"""Standard deviation of the smoothing and width of a bin, HU; of wider ranges the bins get wider."""
_TAILS = 0.0005
"""Share of the values that is left out at either end."""
_VALLEY = 0.5
"""Two peaks are two where the histogram between them falls below this share of the lower one."""
_LEAST_PEAK_SHARE = 0.02
_SMALL_AIR_SHARE, _SMALL_PEAK_SHARE = 0.01, 0.004
"""Least share of air around a body that fills the field, and of soft tissue around bone in a wide field."""


class Peak(NamedTuple):
    """A peak: its place, its width at half of its height, and the share of the values within that width."""

    at: float
    width: float
    share: float

    @property
    def height(self) -> float:
        return self.share / self.width


def find_peaks(values: NDArray[Any]) -> list[Peak]:
    """Return the peaks of sorted values, from the lowest to the highest."""
    end = int(_TAILS * len(values))
    inner = values[end : len(values) - end].astype(np.float64)
    low, high = float(inner[0]), float(inner[-1])
    width = max(_FINEST_BIN, (high - low) / _MOST_BINS)
    sigma = max(_SMOOTHING / width, 1.0)
    border = int(4 * sigma) + 1
    counts = np.bincount(((inner - low) / width).astype(np.int64) + border)
    weights = np.exp(-0.5 * (np.arange(-border, border + 1) / sigma) ** 2)
    smooth = np.convolve(np.pad(counts, (0, border)), weights / weights.sum(), mode="same")
    peaks = []
    for top in _find_tops(smooth):
        below, above = (np.flatnonzero(half <= smooth[top] / 2.0) for half in (smooth[:top], smooth[top:]))
        first, last = (int(below[-1]) if len(below) else 0), top + (int(above[0]) if len(above) else len(smooth))
        share = float(smooth[first : last + 1].sum()) / len(values)
        peaks.append(Peak(low + (top - border + 0.5) * width, (last - first) * width, share))
    return peaks


def _find_tops(smooth: NDArray[np.float64]) -> list[int]:
    """Return the places of the maxima with a valley between each two of them."""
    inner = smooth[1:-1]
    tops = np.flatnonzero((inner > smooth[:-2]) & (inner >= smooth[2:])) + 1
    floors = np.array([smooth[a : b + 1].min() for a, b in zip(tops[:-1], tops[1:], strict=True)])
    while len(tops) > 1:
        depths = floors / np.minimum(smooth[tops[:-1]], smooth[tops[1:]])
        shallow = int(np.argmax(depths))
        if depths[shallow] <= _VALLEY:
            break
        lower = shallow + int(smooth[tops[shallow]] >= smooth[tops[shallow + 1]])
        beside = floors[max(lower - 1, 0) : lower + 1].min()
        tops, floors = np.delete(tops, lower), np.delete(floors, shallow)
        if 0 < lower <= len(floors):
            floors[lower - 1] = beside
    return [int(top) for top in tops]


SCALE_SAID = "peaks of air (near -1000 HU) and soft tissue (0 to 80 HU) that lie elsewhere"

FEWEST_VALUES = 4000

LOWEST_AIR_HU, _HIGHEST_AIR_HU = -1100, -900
"""Range of the peak of air.  Noise may be lower, but no value that many voxels share."""
TISSUE_HU = (-150, 200)
"""Range of the peaks of fat, water, muscle, organs and blood with contrast medium."""

_OFFSET_AIR_HU = (-880, -160)
"""Range in which the air of an offset scan is looked for; from there on it lies among fat and water, up to the end of
`TISSUE_HU`."""
LUNG_HU, _LUNG_WIDTH = -700, 115
"""Lung may be as low as this; its peak is wider than that."""
STEP_HU, _CT_STEP_HU = (450, 1200), (850, 1200)
"""Range of the step from air to soft tissue, and that of a CT, from fat to blood."""
_LEAST_STEP_HU, _HIGHEST_AMONG_HU = 300, 500
"""Least step from air to the soft tissue around bone on any scale, and up to where fat, water or trabecular bone may
be, so that it is that of a CT."""
_AS_LUNG_HU, _ABOVE_LUNG_HU = -600, 150
"""Up to where "air" may be lung, around which soft tissue is lower than this."""
_BELOW_AIR_HU, _MOST_BEYOND = 150, 0.002
"""So far below the peak of air is at most this share, and so it is in other ranges that a shift leaves empty."""

_INTERCEPT_HU, MISSING = 1024, "the rescale intercept seems to be missing"
LEAST_SHARE = 0.02
_LEAST_TISSUE = 0.1
_TISSUE_PART = 0.6
"""Least share of air (within 100 HU) and, for a shift by `_INTERCEPT_HU`, of soft tissue (within 150 HU): of all
values, and of those as dense or denser.  Brain and its skull are no air and soft tissue."""
_LEAST_OFFSET_TISSUE = 0.05
_EMPTY_HU, _MOST_IN_EMPTY = (-150, 100), 0.2
"""Range where soft tissue belongs, and the most that lies there in an offset scan, as a share of what lies within 100
HU of its soft tissue: partial volume.  Contrast medium beside lung has more there, of walls and muscle."""
_LEAST_HEIGHT = 0.1
"""Least height of the peak of faint soft tissue, as a share of the highest one: lower ones are partial volume."""
_LEAST_RAW_HU = -300
"""Stored values without their intercept are not negative; soft tissue and fat alone are not below this."""

FAINT_HU = (-800, -200)
_FAINT_SHARE = 0.05
_MOST_DENSE = 0.03
"""Range and share of soft tissue where the slope is too small, and the largest share above `TISSUE_HU` begins."""
_STRETCHED_HU = 300
"""Soft tissue where the slope is too large lies above this value."""

_CALMED, _RING = 3, 2
"""Width of the mean that takes the noise out of a slice, and distance of the ring round what is dense, voxels."""
_LEAST_CORE = 0.01
DENSER = 0.2
ALIKE = 0.2
_NEAR_AIR = 0.3
"""Least share of a body that is denser than soft tissue, by how much, how much soft tissue varies, and how far up from
air the border of a body reaches: shares of the step from air to soft tissue."""
WIDER, _WIDEST_TISSUE = 1.3, 0.4
"""Lung is so many times wider than the peak of soft tissue; that of bone is wider than this share of the step."""
_LEAST_AROUND, _MOST_AIR_AROUND = 0.5, 0.1
"""Least share of soft tissue and largest share of air in the ring.  Sound scans and phantoms have 0.54 to 1.00 and 0 to
0.09, dry bones 0 to 0.08 and 0.49 to 0.87."""


class Layers:
    """Sampled slices of a volume: whether bone lies in soft tissue, and not in what may be air."""

    def __init__(self, voxels: NDArray[Any]):
        self.voxels = voxels
        self._calm: list[NDArray[np.float32]] = []

    def find_enclosing(self, air: Peak, above: Sequence[Peak]) -> Peak | None:
        """Do what `find_around` does, for a peak in a place where it need not be that of air."""
        around = self.find_around(air, above)
        if around is None or (air.at < _AS_LUNG_HU and around.at < _ABOVE_LUNG_HU):
            return None
        among = air.at < _AS_LUNG_HU or _OFFSET_AIR_HU[1] < air.at <= _HIGHEST_AMONG_HU
        return around if not among or _CT_STEP_HU[0] <= around.at - air.at <= _CT_STEP_HU[1] else None

    def find_around(self, air: Peak, above: Sequence[Peak]) -> Peak | None:
        """Return the soft tissue that lies around bone, of the peaks above that of air; None without any."""
        around = []
        for peak in above:
            step = peak.at - air.at
            is_lung, is_bone = air.width > max(_LUNG_WIDTH, WIDER * peak.width), peak.width > _WIDEST_TISSUE * step
            off = None if is_lung or is_bone or step < _LEAST_STEP_HU else self._measure_around(air.at, peak.at)
            if off is not None:
                around.append((off, peak))
        return min(around)[1] if around else None

    def _measure_around(self, air: float, tissue: float) -> float | None:
        """Return how far what is around dense parts lies from `tissue`; None where it is something else."""
        self._calm = self._calm or [_calm(self.voxels[k]) for k in sample_slices(len(self.voxels))]
        step = tissue - air
        core, body = 0, 0
        ring = []
        for picture in self._calm:
            dense = picture > tissue + DENSER * step
            core += int(np.count_nonzero(dense))
            body += int(np.count_nonzero(picture > air + step / 2.0))
            ring.append(picture[_grow_mask(dense, _RING) & ~_grow_mask(dense, _RING - 1)])
        around = np.concatenate(ring)
        if core < _LEAST_CORE * body or not len(around):
            return None
        off = np.abs(around - tissue)
        alike, beside = np.mean(off < ALIKE * step), np.mean(around < air + _NEAR_AIR * step)
        return float(np.median(off)) if alike >= _LEAST_AROUND and beside <= _MOST_AIR_AROUND else None


def _calm(picture: NDArray[Any]) -> NDArray[np.float32]:
    calm = np.asarray(picture, np.float32)
    for axis in (0, 1):
        calm = _windows(calm, _CALMED // 2, axis).mean(axis=-1)
    return calm


def _grow_mask(mask: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    for axis in (0, 1):
        mask = np.any(_windows(mask, reach, axis), axis=-1)
    return mask


def _windows(picture: NDArray[Any], reach: int, axis: int) -> NDArray[Any]:
    """Return the ``2 * reach + 1`` values around each place of an axis, as a last axis."""
    widths = [(reach, reach) if other == axis else (0, 0) for other in (0, 1)]
    return np.lib.stride_tricks.sliding_window_view(np.pad(picture, widths, mode="edge"), 2 * reach + 1, axis)


class _Doubt(NamedTuple):
    """Air and soft tissue as found, on a scale that is not that of HU, and the likely reason."""

    air: float
    tissue: float
    reason: str


def judge_scale(
    sample: ValueSample | None, layers: Layers, facts: PixelFacts, slopes: Sequence[float] = (1.0,), *, known: bool
) -> tuple[Gate, dict[str, float]]:
    """Judge the gate ``hu_scale``; where it fails, return the places of ``air`` and ``soft_tissue`` too.

    Where all slopes of the rescale are 1, one that is too large cannot be told from a dry specimen.  Of values that are
    not known to be HU only a missing or doubled intercept is told.
    """
    if sample is None or len(sample.values) < FEWEST_VALUES:
        return unmeasured("hu_scale", 0, None, f"{SCALE_SAID}: too few voxels"), {}
    doubt = _find_shift(sample, facts) or _find_body(sample, layers, known)
    if doubt is None and not known:
        return unmeasured("hu_scale", 0, None, f"{SCALE_SAID}: the values are not known to be HU"), {}
    peaks: list[Peak] = []
    if doubt is None:
        peaks = _list_peaks(sample.without_spikes(LOWEST_AIR_HU, _HIGHEST_AIR_HU), _LEAST_PEAK_SHARE)
        doubt = _find_doubt(sample, layers, peaks, slopes, facts.disc)
    if doubt is not None:
        text = (
            f"air lies near {doubt.air:.0f} HU and soft tissue near {doubt.tissue:.0f} HU, where a CT has -1000 and 0"
            f" to 80: {doubt.reason}; thresholds in HU do not fit these values"
        )
        levels = {"air": round(doubt.air, 1), "soft_tissue": round(doubt.tissue, 1)}
        return Gate("hu_scale", 2, 0, None, False, text), levels
    places = [f"{peak.at:.0f}" for peak in peaks if _is_air(peak) or _is_tissue(peak)]
    if not places:
        return unmeasured("hu_scale", 0, None, f"{SCALE_SAID}: neither was found"), {}
    return none_of("hu_scale", 0, f"{SCALE_SAID} (found at {', '.join(places)} HU)"), {}


def _is_air(peak: Peak) -> bool:
    return LOWEST_AIR_HU <= peak.at <= _HIGHEST_AIR_HU


def _is_tissue(peak: Peak) -> bool:
    return TISSUE_HU[0] <= peak.at <= TISSUE_HU[1]


def _find_shift(sample: ValueSample, facts: PixelFacts) -> _Doubt | None:
    """Find an intercept that is missing or was applied twice, for which the values need not be known to be HU."""
    if facts.hu_min < LOWEST_AIR_HU and _fits(sample, -_INTERCEPT_HU) and not _is_padded_specimen(sample):
        shift, reason = -_INTERCEPT_HU, "the rescale intercept seems to have been applied twice"
    elif _may_be_raw(sample) and _fits(sample, _INTERCEPT_HU):
        shift, reason = _INTERCEPT_HU, MISSING
    else:
        return None
    air, tissue = sample.median_between(shift - 1100, shift - 900), sample.median_between(shift - 150, shift + 150)
    return _Doubt(air, tissue, reason)


def _find_body(sample: ValueSample, layers: Layers, known: bool) -> _Doubt | None:
    """Take the lowest peak for air that lies too high, where the bone above it has soft tissue around it.

    Values that many voxels share are left out: outside of a round field of view lies what is no air on this scale. Of
    values that are not known to be HU only a missing intercept is told.
    """
    measured = sample.without_spikes()
    peaks = _list_peaks(measured, _SMALL_PEAK_SHARE)
    air = next((peak for peak in peaks if peak.share >= _SMALL_AIR_SHARE), None)
    if measured is None or air is None or air.at < _OFFSET_AIR_HU[0] or not _is_lowest(measured, air):
        return None
    raw = abs(air.at + 1000.0 - _INTERCEPT_HU) <= 100.0 and _may_be_raw(measured)
    tissue = layers.find_enclosing(air, [peak for peak in peaks if peak.at > air.at]) if known or raw else None
    if tissue is None:
        return None
    return _Doubt(air.at, tissue.at, MISSING) if raw else _describe_step(air, tissue)


def _list_peaks(measured: ValueSample | None, least: float) -> list[Peak]:
    """Return the peaks that hold a `least` share of the values; none of too few values."""
    return [peak for peak in find_peaks(measured.values) if peak.share >= least] if measured is not None else []


def _is_lowest(sample: ValueSample, air: Peak) -> bool:
    return sample.between(-np.inf, air.at - max(_BELOW_AIR_HU, 1.3 * air.width)) < _MOST_BEYOND


def _may_be_raw(sample: ValueSample) -> bool:
    return not _fits(sample, 0) and sample.between(-np.inf, _LEAST_RAW_HU) < _MOST_BEYOND


def _fits(sample: ValueSample, shift: int) -> bool:
    """True if air and soft tissue lie where a shift of the HU puts them, with less between them than tissue."""
    air = sample.between(shift - 1100, shift - 900)
    tissue = sample.between(shift - 150, shift + 150)
    least = max(_LEAST_TISSUE, _TISSUE_PART * sample.between(shift - 300, np.inf)) if shift else LEAST_SHARE
    return air >= LEAST_SHARE and tissue >= least and sample.between(shift - 800, shift - 300) < tissue


def _is_padded_specimen(sample: ValueSample) -> bool:
    """True for dense bone in air with padding of one value: it looks like soft tissue and air 1024 HU too low."""
    padding = sample.commonest_below(LOWEST_AIR_HU)
    padded = padding is not None and padding[1] > 0.9 * sample.between(-np.inf, LOWEST_AIR_HU)
    return padded and sample.between(500, np.inf) >= _MOST_BEYOND


def _find_doubt(
    sample: ValueSample, layers: Layers, peaks: Sequence[Peak], slopes: Sequence[float], disc: float | None
) -> _Doubt | None:
    if len(peaks) < 2:
        return None
    lowest, above = peaks[0], peaks[1:]
    air, tissue = any(map(_is_air, peaks)), any(map(_is_tissue, peaks))
    if lowest.at < LOWEST_AIR_HU:
        return None if air and tissue else _describe_step(lowest, max(above, key=lambda peak: peak.share))
    if air:
        return None if tissue else _find_wrong_slope(sample, layers, lowest, above, slopes)
    return _find_offset(sample, lowest, above, disc)


def _find_offset(sample: ValueSample, air: Peak, above: Sequence[Peak], disc: float | None) -> _Doubt | None:
    """Take the lowest peak for air that lies too high.

    A round field of view that is filled with a value far above it tells it anywhere.  Among fat and water nothing else
    does, and above these the step of a CT alone.
    """
    lung = air.at < LUNG_HU and air.width > _LUNG_WIDTH
    padded = disc is not None and disc >= air.at + _BELOW_AIR_HU
    among = _OFFSET_AIR_HU[1] < air.at <= TISSUE_HU[1] and not padded
    if air.at < _OFFSET_AIR_HU[0] or among or not _is_lowest(sample, air) or lung:
        return None
    low, high = _CT_STEP_HU if air.at > TISSUE_HU[1] and not padded else STEP_HU
    fitting = [peak for peak in above if low <= peak.at - air.at <= high]
    tissue = max(fitting, key=lambda peak: peak.share, default=None)
    if tissue is None or tissue.share < _LEAST_OFFSET_TISSUE:
        return None
    first, last = max(_EMPTY_HU[0], air.at + 1.5 * air.width), _EMPTY_HU[1]
    empty = sample.between(first, max(first, last)) < _MOST_IN_EMPTY * sample.between(tissue.at - 100, tissue.at + 100)
    return _describe_step(air, tissue) if padded or (tissue.at > TISSUE_HU[1] and empty) else None


def _find_wrong_slope(
    sample: ValueSample, layers: Layers, air: Peak, above: Sequence[Peak], slopes: Sequence[float]
) -> _Doubt | None:
    """Look for soft tissue, given air in its place and no peak where soft tissue belongs."""
    tissue = max(above, key=lambda peak: peak.share)
    faint = FAINT_HU[0] <= tissue.at <= FAINT_HU[1] and tissue.share >= _FAINT_SHARE
    faint = faint and tissue.height >= _LEAST_HEIGHT * max(air.height, tissue.height)
    if faint and sample.between(TISSUE_HU[0], np.inf) < _MOST_DENSE:
        return _describe_step(air, tissue)
    around = None if set(slopes) == {1.0} else layers.find_around(air, above)
    return None if around is None or around.at <= _STRETCHED_HU else _describe_step(air, around)


def _describe_step(air: Peak, tissue: Peak) -> _Doubt:
    """Give the likely reason for the places of air and soft tissue."""
    off = air.at + 1000.0
    if _CT_STEP_HU[0] <= tissue.at - air.at <= _CT_STEP_HU[1]:
        return _Doubt(
            air.at, tissue.at, f"the rescale intercept seems to be {abs(off):.0f} HU too {'high' if off > 0 else 'low'}"
        )
    return _Doubt(air.at, tissue.at, "the rescale slope seems to be wrong, or the scanner has a scale of its own")
