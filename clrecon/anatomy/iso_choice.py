"""The iso value half way between bone and the tissue beside it, measured at edges of bone in the scan itself.

A scanner blurs every edge.  Only the level half way between the two plateaus leaves the edge in its place: a level that
is off by 20 % of the step moves the surface by about half a voxel, at a blur of 0.8 voxel.  Bone has no peak of its own
in the histogram of a body, because marrow, thin cortex and contrast medium have the same values.  So the plateaus are
measured at the edges:

1. The histogram of evenly spread slices gives the soft-tissue mode and its noise.  Padding, air, table and fat lie
   elsewhere and do not move it.
2. Seeds are crossings of a value safely above that mode, along the rows and columns of those slices, where the edge
   runs more across this axis than along it.
3. From each seed a walk uphill to the first maximum gives the bone's plateau, one downhill the tissue's.  Edges that
   start from air (table, lung, clothes), end in metal, or end in a flat and faint plateau (vessels and organs with
   contrast medium) do not count.
4. The medians of both plateaus, every edge weighted by its contrast, are "bone" and "tissue"; the iso value is half
   way between them.

Noise lifts a maximum as much as it lowers a minimum, which leaves the middle in place."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import METAL_HU
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import AIR_HU
from clrecon.geometry.volume import Volume
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import count_of, format_share

FloatArray = NDArray[Any]
Slices = Iterable[tuple[int, FloatArray]]
"""Slices with their places in the volume."""

CONTRAST_MEDIUM_HU = 600
"""Vessels and organs with contrast medium stay below this value."""

REACH = 8
"""Longest walk in steps: at a blur of 2 voxels it reaches the plateau."""
FLAT = 4
"""A plateau is flat when values stay level for so many steps beyond the maximum, as vessels do; cortex falls off."""
FLAT_SIGMAS = 3.5
LARGEST_FLAT_SHARE = 0.75
"""When more than this share of the contrast ends in flat plateaus, these are bone (a homogeneous body)."""
MOST_EDGES = 200_000
"""Largest number of edges taken from one slice and axis, so that noise cannot use up the memory."""
LEAST_BONE_SHARE = 0.2
"""Least share of the edges that must end below metal.  A lone implant has some of these: its rim is blurred."""


@dataclass(frozen=True)
class Background:
    """The material that bone lies in: its mode and width, where bone begins, and the range of the low side, HU."""

    name: str
    mode: float
    noise: float
    seed: int
    lowest: float
    highest: float


@dataclass(frozen=True)
class BoneEdges:
    """Plateaus, steepest steps and flatness of many edges, shapes (n,), and their places (k, j, i), shape (n, 3)."""

    bone: FloatArray
    tissue: FloatArray
    step: FloatArray
    flat: NDArray[np.bool_]
    places: NDArray[np.int32]

    def where(self, mask: NDArray[np.bool_]) -> BoneEdges:
        return BoneEdges(self.bone[mask], self.tissue[mask], self.step[mask], self.flat[mask], self.places[mask])

    @property
    def contrast(self) -> FloatArray:
        return self.bone - self.tissue


def measure_edges(slices: Slices, background: Background) -> BoneEdges:
    """Measure the plateaus on both sides of the edges of bone in slices, along rows and along columns."""
    found = []
    for k, values in slices:
        padded = np.pad(values, REACH + FLAT, mode="edge")
        with np.errstate(invalid="ignore"):  # two infinite neighbours
            found += [_measure_slice(padded, axis, background, k) for axis in (0, 1)]
    every = BoneEdges(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    edges = every.where((every.tissue >= background.lowest) & (every.tissue <= background.highest))
    bone = edges.where(edges.bone <= METAL_HU)
    # These edges are the blurred rim of metal, not bone.
    return bone if len(bone.bone) >= LEAST_BONE_SHARE * len(edges.bone) else bone.where(bone.bone < -math.inf)


def _measure_slice(padded: NDArray[Any], axis: int, background: Background, k: int) -> tuple[NDArray[Any], ...]:
    """Measure bone, tissue, steepest step, flatness and place of the edges of a slice along its columns (axis 0) or
    rows (1).

    It is continued by its border values, p = `REACH` + `FLAT` voxels each way: every walk ends where values are
    constant.
    """
    border = REACH + FLAT
    inside = padded >= background.seed
    inner = (slice(border, -border),) * 2
    along, across = (padded.shape[1], 1) if axis == 0 else (1, padded.shape[1])
    first = inside[inner]
    last = np.roll(inside, -1, axis)[inner]
    crossing = np.flatnonzero(first != last)  # border values are continued: no crossing
    crossing = crossing[:: max(1, -(-len(crossing) // MOST_EDGES))]
    places = np.column_stack((np.full(len(crossing), k), *np.divmod(crossing, first.shape[1]))).astype(np.int32)
    low = (places[:, 1].astype(np.intp) + border) * padded.shape[1] + places[:, 2] + border
    flat_values, flat_inside = padded.ravel(), inside.ravel()

    def values(at: NDArray[np.intp]) -> NDArray[np.float32]:
        return flat_values[at].astype(np.float32)

    falls = flat_inside[low]
    high = np.where(falls, low, low + along)
    low = np.where(falls, low + along, low)
    uphill = high - low
    step = values(high) - values(low)
    sideways = values(high + across) + values(low + across) - values(high - across) - values(low - across)
    # A lone voxel of noise has no neighbour beside or behind it that is also bone.
    borne_out = flat_inside[high + across] | flat_inside[high - across] | flat_inside[high + uphill]
    kept = borne_out & (step >= 0.25 * np.abs(sideways))
    high, low, uphill, step = high[kept], low[kept], uphill[kept], step[kept]

    top, steep_up = _walk(flat_values, high, uphill)
    bottom, steep_down = _walk(flat_values, low, -uphill, falling=True)
    bone = values(top)
    flat = bone < CONTRAST_MEDIUM_HU
    for beyond in range(1, FLAT + 1):
        flat &= np.abs(values(top + beyond * uphill) - bone) <= FLAT_SIGMAS * background.noise
    return bone, values(bottom), np.maximum(step, np.maximum(steep_up, steep_down)), flat, places[kept]


def _walk(
    values: NDArray[Any], start: NDArray[np.intp], step: NDArray[np.intp], falling: bool = False
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Walk from each start by `step` while the values rise (or fall); return the end and the steepest step."""
    end, steepest = start.copy(), np.zeros(len(start), dtype=np.float32)
    walking = np.arange(len(start))
    for _ in range(REACH):
        here = end[walking]
        beyond = here + step[walking]
        change = values[beyond].astype(np.float32) - values[here].astype(np.float32)
        if falling:
            change = -change
        goes_on = change > 0
        walking, change = walking[goes_on], change[goes_on]
        end[walking] = beyond[goes_on]
        steepest[walking] = np.maximum(steepest[walking], change)
    return end, steepest


def leave_contrast_medium(edges: BoneEdges) -> tuple[BoneEdges, float, float]:
    """Leave out edges that end in flat, faint plateaus (contrast medium), unless most do.

    Returns also the shares of the contrast that were left out, and that are flat and faint.
    """
    total = edges.contrast.sum()
    share = float(edges.contrast[edges.flat].sum() / total) if total else 0.0
    if share > LARGEST_FLAT_SHARE:
        return edges, 0.0, share
    return edges.where(~edges.flat), share, share


SAMPLED_VOXELS = 8_400_000
"""Approximate number of voxels that are examined: 32 slices of 512 x 512."""
FEWEST_SLICES = 8

LOWEST_HU, HIGHEST_HU = AIR_HU + 1, 3071
"""The values that the histogram counts: from just above the padding to the end of the 12-bit scale."""
SMOOTHING_HU = 8.0
SOFT_TISSUE_HU = (-30, 150)
"""Range in which muscle, organs, blood and water have their mode."""
FAT_HU = (-150, -31)
"""Range in which fat has its mode: the background of scans that show no other soft tissue."""
AIR, SOFT_TISSUE = -1000.0, 40.0
"""HU of the two materials by which a scan with a scale of its own is read."""
DENSE = 1240.0
"""HU that the denser of two materials is read as, where nothing is known of the values."""
MATERIAL_BINS, MATERIAL_TAILS, TAIL_SHARE = 400, (0.0005, 0.9995), 0.35
"""Bins of a histogram of any values, the shares left out at its ends, and how far above its last peak what is denser
reaches, as a share of the range."""
STREAKS_HU, FEWEST_METAL, METAL_SLICES = 3000, 20, 3
"""A slice with so many voxels above this shows metal, whose streaks, and whose rim so many slices away, have the values
of bone."""
AIR_MODE_HU = -700
"""Modes below this are air."""

SEED_ABOVE_TISSUE_HU = 100
"""Least distance of bone from the soft-tissue mode: discs, clots and organs end below."""
SEED_SIGMAS = 4.0
WIDEST_MODE_HU = 150.0
"""Widest accepted mode: more noise than this hides the tissues, and a ramp between two materials looks wider still."""
SPECIMEN_SEED_HU = 150
"""Lowest value of bone in a specimen that lies in air."""
FAT_BELOW_TISSUE_HU = 250
"""The low side of an edge is soft tissue or fat: at most this far below the mode."""

CONTRAST_SAID = 0.05
"""Least share of the contrast in flat plateaus that is reported; scans without contrast medium have up to 0.02."""
FEWEST_EDGES = 64
LEAST_CONTRAST_SIGMAS = 6.0


def _describe_way_out() -> str:
    two = name_parameter("half_way", "(BONE, TISSUE)")
    return f"give the iso value ({name_parameter('iso_value', 'N')}) or the two materials ({two})"


@dataclass(frozen=True)
class IsoChoice:
    """An iso value half way between two materials, with the measurements behind it.

    iso_value: HU, half way between `bone_hu` and `tissue_hu`; a whole number where it was measured.
    bone_hu, tissue_hu: The plateaus on both sides of the edge of bone, HU.
    method: "auto": measured.  "half": computed from given plateaus; then `background` and all that follows is None.
    reason: The choice in words, one line.
    background: {"soft tissue", "air"}. The material that the bone lies in.
    background_mode_hu, noise_hu: The mode of the background in the histogram and its width, HU.
    spread_hu: Half the interquartile range of the half-way levels of single edges.
    steepness_hu_per_voxel: Median of the steepest step of an edge along a row or column: `spread_hu` / this is what the
        spread means in voxels, at most.
    faint_share: Share of the edges whose bone stays below the iso value.  That bone, thin, poor in mineral or touched
        in passing by a slice, is lost.
    contrast_medium_share: Share of the contrast left out because it ends in a flat plateau below `CONTRAST_MEDIUM_HU`.
    flat_share: The same before that decision: where it is above three quarters, flat plateaus are taken for bone.
    slices, slice_step: Number of slices examined, and the distance from one to the next in slices.
    seen_at_lps_mm: A place where an edge has both materials.
    """

    iso_value: float
    bone_hu: float
    tissue_hu: float
    method: str
    reason: str
    background: str | None = None
    background_mode_hu: float | None = None
    noise_hu: float | None = None
    edges: int | None = None
    spread_hu: float | None = None
    steepness_hu_per_voxel: float | None = None
    faint_share: float | None = None
    contrast_medium_share: float | None = None
    flat_share: float | None = None
    slices: int | None = None
    slice_step: int | None = None
    seen_at_lps_mm: list[float] | None = None

    def as_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    def measurements(self) -> dict[str, Any]:
        """Return what is behind the choice, for reports that have iso value and reason beside it."""
        return {name: value for name, value in self.as_dict().items() if name not in ("iso_value", "reason")}


def half_iso_value(bone_hu: float, tissue_hu: float) -> IsoChoice:
    """Return the iso value half way between two materials of known HU."""
    bone, tissue = float(bone_hu), float(tissue_hu)
    if not (math.isfinite(bone) and math.isfinite(tissue)):
        raise UsageError(f"bone and tissue must be finite numbers of HU, not {bone_hu} and {tissue_hu}")
    if bone <= tissue:
        raise UsageError(f"bone must be above tissue: {bone:g} HU is not above {tissue:g} HU")
    reason = f"half way between tissue {tissue:g} and bone {bone:g} HU, as given"
    return IsoChoice(tissue + (bone - tissue) / 2.0, bone, tissue, "half", reason)


@explains_arguments
def choose_iso_value(volume: Volume, *, progress: Progress | None = None) -> IsoChoice:
    """Measure bone and the tissue beside it, and choose the iso value half way between them.

    Measures bone in soft tissue; where the scan shows no soft tissue, a specimen in air.  Deterministic.  Examines
    about 8 million voxels in evenly spread slices, with one slice in memory at a time (a memory-mapped volume stays on
    the disk).  The measured errors, against other methods, are in ``docs/iso_value.md``.

    Parameters
    ----------
    volume : Volume
        Voxels in HU.
    progress : callable, optional
        Called as ``progress("choose", steps done, 3)``.

    Raises
    ------
    NoSurfaceError
        Two materials were not found: neither soft tissue nor air has a mode, or no bone rises from it.
    """
    progress = progress or ignore_progress
    progress("choose", 0, 3)
    every, scale = _sample_slices(volume), _OwnScale.of(volume)
    for sampled in ((_leave_metal(volume.voxels, every),) if scale is None else ()) + (every,):

        def slices(sampled: Sequence[int] = sampled) -> Slices:
            return ((k, volume.voxels[k] if scale is None else scale.to_hu(volume.voxels[k])) for k in sampled)

        histogram = _leave_padding(_count_values(slices()), volume.voxels[0].size * len(sampled), volume.report)
        background = _find_background(histogram)
        progress("choose", 1, 3)
        edges = measure_edges(slices(), background)
        if len(edges.bone) >= FEWEST_EDGES:
            break
    progress("choose", 2, 3)
    edges, left_out, flat_share = leave_contrast_medium(edges)
    progress("choose", 3, 3)
    bone, tissue = _median(edges.bone, edges.contrast), _median(edges.tissue, edges.contrast)
    least = max(SEED_ABOVE_TISSUE_HU, LEAST_CONTRAST_SIGMAS * background.noise)
    if len(edges.bone) < FEWEST_EDGES or bone - tissue < least:
        raise NoSurfaceError(_no_bone(background, edges, histogram, len(sampled)))
    if scale is not None:
        background, edges = scale.from_hu(background, edges)
    choice = _describe(background, edges, (left_out, flat_share), len(sampled), every.step)
    reason = choice.reason if scale is None else f"{choice.reason}; {scale}"
    if len(sampled) < len(every):
        reason += f"; {count_of(len(every) - len(sampled), 'slice')} with metal left out"
    kji = edges.places[np.argmin(np.abs(edges.bone - choice.bone_hu) + np.abs(edges.tissue - choice.tissue_hu))]
    place = [round(float(mm), 3) for mm in volume.ijk_to_lps(kji[None, ::-1].astype(np.float64))[0]]
    reason += f"; both are seen at ({', '.join(f'{mm:.4g}' for mm in place)}) mm, in slice {kji[0] + 1}"
    return dataclasses.replace(choice, reason=reason, seen_at_lps_mm=place)


def lies_in_air(volume: Volume) -> bool:
    """Tell whether the histogram of a scan has a mode of air and none of soft tissue, as of a dry specimen."""
    sampled = _sample_slices(volume)
    counted = _count_values((k, volume.voxels[k]) for k in sampled)
    try:
        background = _find_background(_leave_padding(counted, volume.voxels[0].size * len(sampled), volume.report))
    except NoSurfaceError:
        return False
    return background.name == "air"


def _sample_slices(volume: Volume) -> range:
    _, nj, ni = volume.shape
    step = -(-len(volume.voxels) // max(FEWEST_SLICES, SAMPLED_VOXELS // (nj * ni)))
    return range((len(volume.voxels) - 1) % step // 2, len(volume.voxels), step)


def _leave_metal(voxels: NDArray[Any], sampled: Sequence[int]) -> Sequence[int]:
    """Leave out the slices that show metal, for its streaks, and those beside, unless too few are left."""
    metal = np.array([k for k in sampled if np.count_nonzero(voxels[k] >= STREAKS_HU) >= FEWEST_METAL])
    free = [k for k in sampled if not (np.abs(metal - k) <= METAL_SLICES).any()]
    return free if len(free) >= FEWEST_SLICES else sampled


class _OwnScale(NamedTuple):
    """A scale of values that are not HU, by two values and the HU that they stand for.

    said: Where the two values come from.
    """

    low: float
    high: float
    low_hu: float
    high_hu: float
    said: str

    @classmethod
    def of(cls, volume: Volume) -> _OwnScale | None:
        """Take air and soft tissue from a certificate whose gate ``hu_scale`` failed, else two materials from the
        histogram of values that nothing says are HU; None where they are, or where no two were found.
        """
        rescale = volume.report.get("rescale") or {}
        air, tissue = rescale.get("air"), rescale.get("soft_tissue")
        if air is not None and tissue is not None:
            said = f"on the scan's own scale, with air near {air:.0f} and soft tissue near {tissue:.0f}"
            return cls(air, tissue, AIR, SOFT_TISSUE, said)
        known = {gate["name"]: gate["ok"] for gate in volume.report.get("gates", ())}.get("hu_known")
        if known or (known is None and _shows_hu(volume)):
            return None
        found = find_two_materials(volume)
        if found is None:
            return None
        said = f"on the scan's own scale, with two materials near {found[0]:.4g} and {found[1]:.4g}"
        return cls(*found, SOFT_TISSUE, DENSE, said)

    def __str__(self) -> str:
        """What is said of it beside the reason of a choice."""
        return self.said

    @property
    def slope(self) -> float:
        """HU for one unit of the scan."""
        return (self.high_hu - self.low_hu) / (self.high - self.low)

    def to_hu(self, values: NDArray[Any]) -> NDArray[np.float32]:
        """Return a slice in HU."""
        return (np.asarray(values, np.float32) - np.float32(self.low)) * np.float32(self.slope) + np.float32(
            self.low_hu
        )

    def from_hu(self, background: Background, edges: BoneEdges) -> tuple[Background, BoneEdges]:
        """Return what was measured in HU in the units of the scan."""
        mode = self.low + (background.mode - self.low_hu) / self.slope
        bone, tissue = (self.low + (hu - self.low_hu) / self.slope for hu in (edges.bone, edges.tissue))
        return (
            dataclasses.replace(background, mode=mode, noise=background.noise / self.slope),
            BoneEdges(bone, tissue, edges.step / self.slope, edges.flat, edges.places),
        )


def _shows_hu(volume: Volume) -> bool:
    """Tell whether the histogram has soft tissue or air where HU have them."""
    try:
        _find_background(_count_values((k, volume.voxels[k]) for k in _sample_slices(volume)))
    except NoSurfaceError:
        return False
    return True


def find_two_materials(volume: Volume) -> tuple[float, float] | None:
    """Return the values of what is densest and of what lies around it, on any scale; None where there is no such pair.

    The histogram of every fourth value is smoothed over `MATERIAL_BINS` and its peaks are found, a valley between each
    two.  What rises far above the last peak is the dense material, else the last peak itself.
    """
    sampled = _sample_slices(volume)
    values = np.concatenate([np.asarray(volume.voxels[k])[::2, ::2].ravel() for k in sampled]).astype(np.float64)
    padding = volume.report.get("padding_hu")
    values = values[np.isfinite(values) & (values != padding)] if padding is not None else values[np.isfinite(values)]
    if not len(values):
        return None
    low, high = np.quantile(values, MATERIAL_TAILS)
    if high <= low:
        return None
    counts, ends = np.histogram(values, MATERIAL_BINS, (float(low), float(high)))
    weights = np.exp(-0.5 * (np.arange(-12, 13) / 4.0) ** 2)
    smooth = np.convolve(np.pad(counts, 12), weights / weights.sum(), mode="valid")
    peaks = [
        k
        for k in np.flatnonzero((smooth >= np.pad(smooth, (1, 0))[:-1]) & (smooth > np.pad(smooth, (0, 1))[1:]))
        if smooth[k] >= 0.02 * smooth.max() and smooth[k] > 2.0 * np.median(smooth[max(k - 40, 0) : k + 40])
    ]
    if not peaks:
        return None
    places = [float((ends[k] + ends[k + 1]) / 2.0) for k in peaks]
    if high - places[-1] > TAIL_SHARE * (high - low):
        dense = float(np.median(values[values > (places[-1] + high) / 2.0]))
        return places[-1], dense
    return (places[-2], places[-1]) if len(places) > 1 else None


def _describe(
    background: Background, edges: BoneEdges, flat: tuple[float, float], slices: int, slice_step: int
) -> IsoChoice:
    """Make the choice that follows from the edges; `flat` are the shares of contrast left out, and flat at all."""
    left_out, flat_share = flat
    bone, tissue = _median(edges.bone, edges.contrast), _median(edges.tissue, edges.contrast)
    digits = max(0, 3 - math.floor(math.log10(bone - tissue)))  # of values that are not HU
    digits = digits if digits > 1 else 0
    iso_value = math.floor((bone + tissue) / 2.0 * 10**digits + 0.5) / 10**digits
    half = (edges.bone + edges.tissue) / 2.0
    spread = (_median(half, edges.contrast, 0.75) - _median(half, edges.contrast, 0.25)) / 2.0
    steepness = _median(edges.step, edges.contrast)
    below = "air" if background.name == "air" else "tissue"
    reason = (
        f"half way between {below} {tissue:.{digits}f} and bone {bone:.{digits}f} HU, "
        f"medians of {count_of(len(half), 'edge')} in {count_of(slices, 'slice')}; single"
        f" edges spread by {spread:.{digits}f} HU, "
        f"{spread / steepness:.2f} voxel"
    )
    if flat_share >= CONTRAST_SAID:
        done = "left out" if left_out else "taken for bone, as nearly all is of this kind"
        reason += f"; {format_share(flat_share)} of the contrast ends in flat plateaus, as of contrast medium: {done}"
    return IsoChoice(
        iso_value,
        round(bone, 1 + digits),
        round(tissue, 1 + digits),
        "auto",
        reason,
        background=background.name,
        background_mode_hu=background.mode,
        noise_hu=round(background.noise, 1 + digits),
        edges=len(half),
        spread_hu=round(spread, 1 + digits),
        steepness_hu_per_voxel=round(steepness, 1 + digits),
        faint_share=round(float(np.mean(edges.bone < iso_value)), 4),
        contrast_medium_share=round(left_out, 4),
        flat_share=round(flat_share, 4),
        slices=slices,
        slice_step=slice_step,
    )


def _no_bone(background: Background, edges: BoneEdges, histogram: Float64Array, slices: int) -> str:
    above = histogram[background.seed - LOWEST_HU :].sum() / max(histogram.sum(), 1.0)
    return (
        f"no bone found to choose the iso value by: {background.name} has its mode at {background.mode:.0f} HU with a "
        f"noise of {background.noise:.0f} HU, {format_share(above, 2)} of the voxels of {slices} slices lie above "
        f"{background.seed} HU and {len(edges.bone)} edges of bone rise from it; {_describe_way_out()}"
    )


def _count_values(slices: Slices) -> Float64Array:
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


def _leave_padding(histogram: Float64Array, counted: int, report: dict[str, Any]) -> Float64Array:
    """Remove padding that was filled with air from the histogram: its single value would hide the noise of the air."""
    value, share = report.get("padding_hu"), report.get("padding_share")
    if value is not None and share is not None and LOWEST_HU <= value <= HIGHEST_HU:
        place = int(np.rint(value)) - LOWEST_HU
        histogram[place] = max(histogram[place] - share * counted, 0.0)
    return histogram


def _smooth(histogram: Float64Array) -> Float64Array:
    reach = int(4 * SMOOTHING_HU)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SMOOTHING_HU) ** 2)
    padded = np.pad(histogram, reach)
    return np.convolve(padded, weights / weights.sum(), mode="valid")


def _find_mode(smooth: Float64Array, low: int, high: int) -> tuple[float, float] | None:
    """Find the highest peak of the smoothed histogram between two HU; return its mode and its width (sigma), HU.

    None where no peak is twice as high as the mean of the values 250 to 500 HU below and 200 to 400 HU above it, or the
    peak is wider than `WIDEST_MODE_HU`: the ramp of an edge between air and bone has all values alike.  The width is
    measured on the upper side, where there is no fat, at 61 % of the height (one sigma), less the smoothing.
    """
    at = np.arange(max(low - LOWEST_HU, 1), min(high - LOWEST_HU, len(smooth) - 2) + 1)
    peaks = at[(smooth[at] > smooth[at - 1]) & (smooth[at] >= smooth[at + 1])]
    if not len(peaks):
        return None
    peak = int(peaks[np.argmax(smooth[peaks])])
    height = smooth[peak]
    beside = np.concatenate((smooth[max(peak - 500, 0) : max(peak - 250, 0)], smooth[peak + 200 : peak + 400]))
    if height < 2.0 * beside.mean():
        return None
    above = smooth[peak:] < math.exp(-0.5) * height
    width = float(np.argmax(above)) if above.any() else float(len(above))
    width = math.sqrt(max(width**2 - SMOOTHING_HU**2, 1.0))
    return (float(peak + LOWEST_HU), width) if width <= WIDEST_MODE_HU else None


def _find_background(histogram: Float64Array) -> Background:
    """Find the background: soft tissue, or the air around a specimen."""
    smooth = _smooth(histogram)
    tissue = _find_mode(smooth, *SOFT_TISSUE_HU) or _find_mode(smooth, *FAT_HU)
    if tissue is not None:
        mode, noise = tissue
        seed = math.ceil(mode + max(SEED_ABOVE_TISSUE_HU, SEED_SIGMAS * noise))
        return Background("soft tissue", mode, noise, seed, mode - FAT_BELOW_TISSUE_HU, mode + 2.0 * noise)
    air = _find_mode(smooth, LOWEST_HU, AIR_MODE_HU)
    if air is not None:
        mode, noise = air
        return Background("air", mode, noise, SPECIMEN_SEED_HU, -math.inf, mode + max(50.0, 2.0 * noise))
    total = histogram.sum()
    if not total:
        raise NoSurfaceError(
            f"nothing but padding (up to {AIR_HU} HU) to choose the iso value by; {_describe_way_out()}"
        )
    raise NoSurfaceError(
        f"no two materials to choose the iso value by: no mode between {FAT_HU[0]} and {SOFT_TISSUE_HU[1]} HU "
        f"(soft tissue) nor below {AIR_MODE_HU} HU (air), most voxels are {_describe_mode(smooth)} HU;"
        f" {_describe_way_out()}"
    )


def _describe_mode(smooth: Float64Array) -> str:
    """Describe where most voxels lie; those above the range of the histogram are counted at its end."""
    mode = int(np.argmax(smooth)) + LOWEST_HU
    return f"near {mode}" if mode < HIGHEST_HU - SMOOTHING_HU else f"at {HIGHEST_HU} or above, so values may not be"


def _median(values: NDArray[Any], weights: NDArray[Any], share: float = 0.5) -> float:
    """Return the weighted median; 0 for an empty array."""
    if not len(values):
        return 0.0
    order = np.argsort(values, kind="stable")
    summed = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order[np.searchsorted(summed, share * summed[-1])]])
