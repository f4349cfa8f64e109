"""The materials of a scan by its histogram: what bone lies in, and two of any scale, for values that are not HU."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import AIR_HU
from clrecon.geometry.volume import Volume
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass

FloatArray = NDArray[Any]
Slices = Iterable[tuple[int, FloatArray]]
"""Slices with their places in the volume."""
SAMPLED_VOXELS = 8_400_000
"""Approximate number of voxels that are examined: 32 slices of 512 x 512."""
FEWEST_SLICES = 8
LOWEST_HU, HIGHEST_HU = AIR_HU + 1, 3071
"""Range of the histogram: from just above the padding (-1024 HU) to the end of the 12-bit scale."""
SMOOTHING_HU = 8.0
"""Standard deviation of the Gaussian that smooths the histogram."""
SOFT_TISSUE_HU = (-30, 150)
"""The modes of muscle, organs, blood and water lie in this range."""
FAT_HU = (-150, -31)
"""The mode of fat lies in this range; fat is the background of scans that show no other soft tissue."""
AIR, _SOFT_TISSUE = -1000.0, 40.0
"""HU of the two materials by which a scan with a scale of its own is read."""
DENSE = 1240.0
"""HU that the denser of two materials is read as, where nothing is known of the values."""
_MATERIAL_BINS = 400
_MATERIAL_TAILS = (0.0005, 0.9995)
_TAIL_SHARE = 0.35
"""Bins of a histogram of any values, the shares left out at its ends, and how far above its last peak what is denser
reaches, as a share of the range."""
_LEAST_OF_PEAK = 0.003
"""Least height of a peak, as a share of the highest: a bone in a wide field of air has marrow of 0.5 % and more."""
AIR_MODE_HU = -700
"""A mode of the histogram below this value is air."""
SEED_ABOVE_TISSUE_HU = 100
"""Bone lies at least this far above the mode of soft tissue; discs, clots and organs lie below."""
_SEED_SIGMAS = 4.0
WIDEST_MODE_HU = 150.0
"""Widest accepted mode: stronger noise hides the tissues, and a ramp between two materials looks even wider."""
SPECIMEN_SEED_HU = 150
"""Lowest value of bone in a specimen that is surrounded by air."""
FAT_BELOW_TISSUE_HU = 250
"""The low side of an edge is soft tissue or fat if it is at most this far below the mode."""


def describe_way_out() -> str:
    two = name_parameter("half_way", "(BONE, TISSUE)")
    return f"give the iso value ({name_parameter('iso_value', 'N')}) or the two materials ({two})"


@dataclass(frozen=True)
class Background:
    """The material that bone lies in: its mode and width, where bone begins, and the range of the low side, HU."""

    name: str
    mode: float
    noise: float
    seed: int
    lowest: float
    highest: float


def count_values(slices: Slices) -> Float64Array:
    """Count the voxels of each whole HU from `LOWEST_HU`, below which is padding, to `HIGHEST_HU` and more."""
    low = LOWEST_HU - 1
    counts = np.zeros(HIGHEST_HU - low + 1, dtype=np.int64)
    for k, image in slices:
        values = np.asarray(image).ravel()
        if values.dtype.kind == "f":
            if np.isnan(values).any():
                raise NoSurfaceError(f"the volume holds NaN (slice {k}): it has no iso surface")
            values = np.rint(np.clip(values, low, HIGHEST_HU))
        counts += np.bincount(np.clip(values.astype(np.int32), low, HIGHEST_HU) - low, minlength=len(counts))
    return counts[1:].astype(np.float64)


def leave_padding(histogram: Float64Array, counted: int, report: dict[str, Any]) -> Float64Array:
    """Remove padding that was filled with air from the histogram: its single value would hide the noise of the air."""
    value, share = report.get("padding_hu"), report.get("padding_share")
    if value is not None and share is not None and LOWEST_HU <= value <= HIGHEST_HU:
        bin_number = int(np.rint(value)) - LOWEST_HU
        histogram[bin_number] = max(histogram[bin_number] - share * counted, 0.0)
    return histogram


def smooth_counts(histogram: Float64Array) -> Float64Array:
    reach = int(4 * SMOOTHING_HU)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SMOOTHING_HU) ** 2)
    return np.convolve(np.pad(histogram, reach), weights / weights.sum(), mode="valid")


def _find_mode(smooth: Float64Array, low: int, high: int) -> tuple[float, float] | None:
    """Find the highest peak of the smoothed histogram between two HU; return its mode and its width (sigma), HU.

    None where no peak is twice as high as the medians of the values 250 to 500 HU below, where another material may
    have its peak, and 200 to 400 HU above it: the ramp of an edge between air and bone has all values alike.  None too
    where the peak is wider than `WIDEST_MODE_HU`.  The width is measured on the upper side, where there is no fat, at
    61 % of the height (one sigma), less the smoothing.
    """
    bins = np.arange(max(low - LOWEST_HU, 1), min(high - LOWEST_HU, len(smooth) - 2) + 1)
    peaks = bins[(smooth[bins] > smooth[bins - 1]) & (smooth[bins] >= smooth[bins + 1])]
    if not len(peaks):
        return None
    peak = int(peaks[np.argmax(smooth[peaks])])
    height = smooth[peak]
    below, above = smooth[max(peak - 500, 0) : max(peak - 250, 0)], smooth[peak + 200 : peak + 400]
    if height < 2.0 * max(np.median(side) for side in (below, above) if len(side)):
        return None
    fallen = smooth[peak:] < math.exp(-0.5) * height
    width = float(np.argmax(fallen)) if fallen.any() else float(len(fallen))
    width = math.sqrt(max(width**2 - SMOOTHING_HU**2, 1.0))
    return (float(peak + LOWEST_HU), width) if width <= WIDEST_MODE_HU else None


def find_background(histogram: Float64Array) -> Background:
    """Find the background: soft tissue, or the air around a specimen."""
    smooth = smooth_counts(histogram)
    tissue = _find_mode(smooth, *SOFT_TISSUE_HU) or _find_mode(smooth, *FAT_HU)
    if tissue is not None:
        mode, noise = tissue
        seed = math.ceil(mode + max(SEED_ABOVE_TISSUE_HU, _SEED_SIGMAS * noise))
        return Background("soft tissue", mode, noise, seed, mode - FAT_BELOW_TISSUE_HU, mode + 2.0 * noise)
    air = _find_mode(smooth, LOWEST_HU, AIR_MODE_HU)
    if air is not None:
        mode, noise = air
        return Background("air", mode, noise, SPECIMEN_SEED_HU, -math.inf, mode + max(50.0, 2.0 * noise))
    total = histogram.sum()
    if not total:
        raise NoSurfaceError(
            f"nothing but padding (up to {AIR_HU} HU) to choose the iso value by; {describe_way_out()}"
        )
    raise NoSurfaceError(
        f"no two materials to choose the iso value by: no mode between {FAT_HU[0]} and {SOFT_TISSUE_HU[1]} HU "
        f"(soft tissue) nor below {AIR_MODE_HU} HU (air), most voxels are {_describe_mode(smooth)} HU;"
        f" {describe_way_out()}"
    )


def _describe_mode(smooth: Float64Array) -> str:
    """Describe where most voxels lie; those above the range of the histogram are counted at its end."""
    mode = int(np.argmax(smooth)) + LOWEST_HU
    return f"near {mode}" if mode < HIGHEST_HU - SMOOTHING_HU else f"at {HIGHEST_HU} or above, so values may not be"


def sample_slices(volume: Volume) -> range:
    _, nj, ni = volume.shape
    step = -(-len(volume.voxels) // max(FEWEST_SLICES, SAMPLED_VOXELS // (nj * ni)))
    return range((len(volume.voxels) - 1) % step // 2, len(volume.voxels), step)


def lies_in_air(volume: Volume) -> bool:
    """Tell whether the histogram of a scan has a mode of air and none of soft tissue, as of a dry specimen."""
    sampled = sample_slices(volume)
    counted = count_values((k, volume.voxels[k]) for k in sampled)
    try:
        background = find_background(leave_padding(counted, volume.voxels[0].size * len(sampled), volume.report))
    except NoSurfaceError:
        return False
    return background.name == "air"


class OwnScale(NamedTuple):
    """A scale of values that are not HU, by two values and the HU that they stand for; `said`: where these are from."""

    low: float
    high: float
    low_hu: float
    high_hu: float
    said: str

    @classmethod
    def of(cls, volume: Volume) -> OwnScale | None:
        """Take air and soft tissue from a certificate whose gate ``hu_scale`` failed, else two materials from the
        histogram of values that nothing says are HU; None where they are, or where no two were found.
        """
        rescale = volume.report.get("rescale") or {}
        air, tissue = rescale.get("air"), rescale.get("soft_tissue")
        if air is not None and tissue is not None:
            words = f"on the scan's own scale, with air near {air:.0f} and soft tissue near {tissue:.0f}"
            return cls(air, tissue, AIR, _SOFT_TISSUE, words)
        known = {gate["name"]: gate["ok"] for gate in volume.report.get("gates", ())}.get("hu_known")
        if known or (known is None and _shows_hu(volume)):
            return None
        materials = find_two_materials(volume)
        if materials is None:
            return None
        words = f"on the scan's own scale, with two materials near {materials[0]:.4g} and {materials[1]:.4g}"
        return cls(*materials, _SOFT_TISSUE, DENSE, words)

    @property
    def slope(self) -> float:
        """HU for one unit of the scan."""
        return (self.high_hu - self.low_hu) / (self.high - self.low)

    def to_hu(self, values: NDArray[Any]) -> NDArray[np.float32]:
        return (np.asarray(values, np.float32) - np.float32(self.low)) * np.float32(self.slope) + np.float32(
            self.low_hu
        )

    def from_hu(self, hu: Any) -> Any:
        """Return HU in the units of the scan."""
        return self.low + (hu - self.low_hu) / self.slope


def _shows_hu(volume: Volume) -> bool:
    """Tell whether the histogram has soft tissue or air where HU have them."""
    try:
        find_background(count_values((k, volume.voxels[k]) for k in sample_slices(volume)))
    except NoSurfaceError:
        return False
    return True


def find_two_materials(volume: Volume) -> tuple[float, float] | None:
    """Return the values of what is densest and of what lies around it, on any scale; None where there is no such pair.

    The histogram of every fourth value is smoothed over `_MATERIAL_BINS` and its peaks are found, with a valley of half
    their height on either side, however wide noise makes them.  What rises far above the last peak is the dense
    material, else the last peak itself.
    """
    sampled = sample_slices(volume)
    values = np.concatenate([np.asarray(volume.voxels[k])[::2, ::2].ravel() for k in sampled]).astype(np.float64)
    padding = volume.report.get("padding_hu")
    values = values[np.isfinite(values) & (values != padding)] if padding is not None else values[np.isfinite(values)]
    if not len(values):
        return None
    low, high = np.quantile(values, _MATERIAL_TAILS)
    if high <= low:
        return None
    counts, ends = np.histogram(values, _MATERIAL_BINS, (float(low), float(high)))
    weights = np.exp(-0.5 * (np.arange(-12, 13) / 4.0) ** 2)
    smooth = np.convolve(np.pad(counts, 12), weights / weights.sum(), mode="valid")
    peaks = [k for k in _find_peaks(smooth) if smooth[k] >= _LEAST_OF_PEAK * smooth.max()]
    if not peaks:
        return None
    places = [float((ends[k] + ends[k + 1]) / 2.0) for k in peaks]
    if high - places[-1] > _TAIL_SHARE * (high - low):
        dense = float(np.median(values[values > (places[-1] + high) / 2.0]))
        return places[-1], dense
    return (places[-2], places[-1]) if len(places) > 1 else None


def _find_peaks(counts: Float64Array) -> list[int]:
    """Return the places of peaks that fall to half on both sides, to the ends or before anything is higher."""
    peaks = []
    padded = np.concatenate([[0.0], counts, [0.0]])
    for k in np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:])) + 1:
        sides = padded[k::-1], padded[k:]
        ways = (side[: int(np.argmax(side > padded[k]))] if (side > padded[k]).any() else side for side in sides)
        if all(way.min() <= 0.5 * padded[k] for way in ways):
            peaks.append(int(k) - 1)
    return peaks
