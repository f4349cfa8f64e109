"""The iso value half way between bone and the tissue beside it, measured at edges of bone: the steps are in
docs/iso_value.md.

A scanner blurs every edge.  Only the level half way between the two plateaus leaves the edge in its place.  Bone has no
peak of its own in the histogram of a body, because marrow, thin cortex and contrast medium have the same values.  Noise
lifts a maximum as much as it lowers a minimum, which leaves the middle in place.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.materials import (
    FEWEST_SLICES,
    LOWEST_HU,
    SEED_ABOVE_TISSUE_HU,
    Background,
    FloatArray,
    OwnScale,
    Slices,
    count_values,
    describe_way_out,
    find_background,
    leave_padding,
    sample_slices,
)
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import METAL_HU
from clrecon.geometry.iso_rule import Level
from clrecon.geometry.volume import Volume
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import count_of, format_share

CONTRAST_MEDIUM_HU = 600
"""Vessels and organs with contrast medium stay below this value."""

REACH = 8
"""Longest walk in steps: at a blur of 2 voxels it reaches the plateau."""
_FLAT = 4
"""A plateau is flat when values stay level for so many steps beyond the maximum, as vessels do; cortex falls off."""
_FLAT_SIGMAS = 3.5
_LARGEST_FLAT_SHARE = 0.75
"""When more than this share of the contrast ends in flat plateaus, these are bone (a homogeneous body)."""
_MOST_EDGES = 200_000
"""Largest number of edges taken from one slice and axis, so that noise cannot use up the memory."""
_LEAST_BONE_SHARE = 0.2
"""Least share of the edges that must end below metal.  A lone implant has some of these: its rim is blurred."""


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
    by_axis = []
    for k, values in slices:
        padded = np.pad(values, REACH + _FLAT, mode="edge")
        with np.errstate(invalid="ignore"):  # two infinite neighbours
            by_axis += [_measure_slice(padded, axis, background, k) for axis in (0, 1)]
    every = BoneEdges(*(np.concatenate(parts) for parts in zip(*by_axis, strict=True)))
    edges = every.where((every.tissue >= background.lowest) & (every.tissue <= background.highest))
    bone = edges.where(edges.bone <= METAL_HU)
    # These edges are the blurred rim of metal, not bone.
    return bone if len(bone.bone) >= _LEAST_BONE_SHARE * len(edges.bone) else bone.where(bone.bone < -math.inf)


def _measure_slice(padded: NDArray[Any], axis: int, background: Background, k: int) -> tuple[NDArray[Any], ...]:
    """Measure bone, tissue, steepest step, flatness and place of the edges of a slice along its columns (axis 0) or
    rows (1).

    It is continued by its border values, p = `REACH` + `_FLAT` voxels each way: every walk ends where values are
    constant.
    """
    border = REACH + _FLAT
    inside = padded >= background.seed
    inner = (slice(border, -border),) * 2
    along, across = (padded.shape[1], 1) if axis == 0 else (1, padded.shape[1])
    first = inside[inner]
    last = np.roll(inside, -1, axis)[inner]
    crossing = np.flatnonzero(first != last)  # border values are continued: no crossing
    crossing = crossing[:: max(1, -(-len(crossing) // _MOST_EDGES))]
    places = np.column_stack((np.full(len(crossing), k), *np.divmod(crossing, first.shape[1]))).astype(np.int32)
    low = (places[:, 1].astype(np.intp) + border) * padded.shape[1] + places[:, 2] + border
    flat_values, flat_inside = padded.ravel(), inside.ravel()

    def values(places: NDArray[np.intp]) -> NDArray[np.float32]:
        return flat_values[places].astype(np.float32)

    falls = flat_inside[low]
    high = np.where(falls, low, low + along)
    low = np.where(falls, low + along, low)
    uphill = high - low
    step = values(high) - values(low)
    sideways = values(high + across) + values(low + across) - values(high - across) - values(low - across)
    # A lone voxel of noise has no neighbour beside or behind it that is also bone.
    borne_out = flat_inside[high + across] | flat_inside[high - across] | flat_inside[high + uphill]
    is_sure = borne_out & (step >= 0.25 * np.abs(sideways))
    high, low = high[is_sure], low[is_sure]
    uphill, step = uphill[is_sure], step[is_sure]

    top, steep_up = _walk(flat_values, high, uphill)
    bottom, steep_down = _walk(flat_values, low, -uphill, falling=True)
    bone = values(top)
    flat = bone < CONTRAST_MEDIUM_HU
    for beyond in range(1, _FLAT + 1):
        flat &= np.abs(values(top + beyond * uphill) - bone) <= _FLAT_SIGMAS * background.noise
    return bone, values(bottom), np.maximum(step, np.maximum(steep_up, steep_down)), flat, places[is_sure]


def _walk(
    values: NDArray[Any], start: NDArray[np.intp], step: NDArray[np.intp], *, falling: bool = False
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
    """Leave out edges of contrast medium, unless most are; return also the shares left out, and flat and faint."""
    total = edges.contrast.sum()
    share = float(edges.contrast[edges.flat].sum() / total) if total else 0.0
    if share > _LARGEST_FLAT_SHARE:
        return edges, 0.0, share
    return edges.where(~edges.flat), share, share


STREAKS_HU, FEWEST_METAL, METAL_SLICES, STREAKS_SPREAD = 3000, 20, 3, 0.7
"""`FEWEST_METAL` voxels of at least `STREAKS_HU` in a slice are metal; its streaks reach `METAL_SLICES` slices further.
Streaks spread the levels of single edges: without metal slices the spread falls to `STREAKS_SPREAD` of it or less."""

CONTRAST_SAID = 0.05
"""Least share of the contrast in flat plateaus that is reported; scans without contrast medium have up to 0.02."""
_FEWEST_EDGES = 64
_LEAST_CONTRAST_SIGMAS = 6.0


@dataclass(frozen=True)
class IsoChoice:
    """An iso value half way between two materials, with the measurements behind it.

    iso_value: HU, half way between ``bone_hu`` and ``tissue_hu``; a whole number where it was measured.
    bone_hu, tissue_hu: The plateaus on both sides of the edge of bone, HU.
    method: "auto": measured.  "half": computed from given plateaus; then ``background`` and all that follows is None.
    reason: The choice in words, one line.
    background: {"soft tissue", "air"}. The material that the bone lies in.
    background_mode_hu, noise_hu: The mode of the background in the histogram and its width, HU.
    spread_hu: Half the interquartile range of the half-way levels of single edges.
    steepness_hu_per_voxel: Median steepest step of an edge along a row or column; the spread over it is in voxels.
    faint_share: Share of the edges whose bone, thin or poor in mineral, stays below the iso value and is lost.
    contrast_medium_share: Share of the contrast left out as it ends in a flat plateau below ``CONTRAST_MEDIUM_HU``.
    flat_share: The same before that decision: where it is above three quarters, flat plateaus are taken for bone.
    slices, slice_step: Number of slices examined, and the distance from one to the next in slices.
    seen_at_lps_mm: A place where an edge has both materials.
    """

    _SHOWN = ("iso_value", "bone_hu", "tissue_hu", "method")
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
    every, scale = sample_slices(volume), OwnScale.of(volume)
    look = _measure_look(volume, every, scale)
    progress("choose", 1, 3)
    free = every if scale is not None else _leave_metal(volume.voxels, every)
    if len(free) < len(every):
        free_look = _measure_look(volume, free, scale)
        if free_look.shows_bone and (not look.shows_bone or free_look.spread <= STREAKS_SPREAD * look.spread):
            look = free_look
    progress("choose", 2, 3)
    if not look.shows_bone:
        raise NoSurfaceError(_no_bone(look))
    if scale is not None:
        look = look.on(scale)
    choice = _describe_look(look, every.step)
    reason = choice.reason if scale is None else f"{choice.reason}; {scale.said}"
    if look.slices < len(every):
        reason += f"; {count_of(len(every) - look.slices, 'slice')} with metal left out"
    edges = look.edges
    kji = edges.places[np.argmin(np.abs(edges.bone - choice.bone_hu) + np.abs(edges.tissue - choice.tissue_hu))]
    seen_at = [round(float(mm), 3) for mm in volume.ijk_to_lps(kji[None, ::-1].astype(np.float64))[0]]
    reason += f"; both are seen at ({', '.join(f'{mm:.4g}' for mm in seen_at)}) mm, in slice {kji[0] + 1}"
    progress("choose", 3, 3)
    return dataclasses.replace(choice, reason=reason, seen_at_lps_mm=seen_at)


AutoLevel = Level | Literal["auto"]
"""An iso value or a range, or the word for the level that `choose_iso_value` measures."""


def settle_level(volume: Volume | None, level: Any, progress: Progress | None = None) -> tuple[Any, dict[str, Any]]:
    """Return a level of HU, measured where it is "auto", and the entries of a report that say so, else none."""
    if not isinstance(level, str) or level != "auto":
        return level, {}
    choice = choose_iso_value(volume, progress=progress)  # type: ignore[arg-type]
    return choice.iso_value, {"iso_value_reason": choice.reason, "iso_value_choice": choice.measurements()}


class _Look(NamedTuple):
    """What some slices of a scan show: the background, its edges of bone, the shares of contrast left out and flat."""

    background: Background
    edges: BoneEdges
    left_out: float
    flat_share: float
    dense_share: float
    slices: int

    @property
    def materials(self) -> tuple[float, float]:
        """Bone and tissue, the medians of the edges by their contrast."""
        edges = self.edges
        return _median(edges.bone, edges.contrast), _median(edges.tissue, edges.contrast)

    @property
    def shows_bone(self) -> bool:
        bone, tissue = self.materials
        least = max(SEED_ABOVE_TISSUE_HU, _LEAST_CONTRAST_SIGMAS * self.background.noise)
        return len(self.edges.bone) >= _FEWEST_EDGES and bone - tissue >= least

    @property
    def level(self) -> float:
        return sum(self.materials) / 2.0

    @property
    def spread(self) -> float:
        """Half the interquartile range of the half-way levels of single edges."""
        half, weights = (self.edges.bone + self.edges.tissue) / 2.0, self.edges.contrast
        return (_median(half, weights, 0.75) - _median(half, weights, 0.25)) / 2.0

    def on(self, scale: OwnScale) -> _Look:
        """Return the same, measured in HU, in the units of the scan."""
        edges, noise = self.edges, self.background.noise / scale.slope
        bone, tissue = scale.from_hu(edges.bone), scale.from_hu(edges.tissue)
        return self._replace(
            background=dataclasses.replace(self.background, mode=scale.from_hu(self.background.mode), noise=noise),
            edges=BoneEdges(bone, tissue, edges.step / scale.slope, edges.flat, edges.places),
        )


def _measure_look(volume: Volume, sampled: Sequence[int], scale: OwnScale | None) -> _Look:
    """Measure the edges of bone in some slices, in HU."""

    def slices() -> Slices:
        return ((k, volume.voxels[k] if scale is None else scale.to_hu(volume.voxels[k])) for k in sampled)

    histogram = leave_padding(count_values(slices()), volume.voxels[0].size * len(sampled), volume.report)
    background = find_background(histogram)
    edges, left_out, flat_share = leave_contrast_medium(measure_edges(slices(), background))
    dense = histogram[background.seed - LOWEST_HU :].sum() / max(histogram.sum(), 1.0)
    return _Look(background, edges, left_out, flat_share, float(dense), len(sampled))


def _leave_metal(voxels: NDArray[Any], sampled: Sequence[int]) -> Sequence[int]:
    """Leave out the slices that show metal, for its streaks, and those beside, unless too few are left."""
    metal = np.array([k for k in sampled if np.count_nonzero(voxels[k] >= STREAKS_HU) >= FEWEST_METAL])
    free = [k for k in sampled if not (np.abs(metal - k) <= METAL_SLICES).any()]
    return free if len(free) >= FEWEST_SLICES else sampled


def _describe_look(look: _Look, slice_step: int) -> IsoChoice:
    background, edges, left_out, flat_share, _, slices = look
    bone, tissue = look.materials
    digits = max(0, 3 - math.floor(math.log10(bone - tissue)))  # of values that are not HU
    digits = digits if digits > 1 else 0
    iso_value = math.floor((bone + tissue) / 2.0 * 10**digits + 0.5) / 10**digits
    spread, count = look.spread, len(edges.bone)
    steepness = _median(edges.step, edges.contrast)
    below = "air" if background.name == "air" else "tissue"
    reason = (
        f"half way between {below} {round(tissue, digits) + 0.0:.{digits}f} and bone {bone:.{digits}f} HU, "
        f"medians of {count_of(count, 'edge')} in {count_of(slices, 'slice')}; single"
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
        edges=count,
        spread_hu=round(spread, 1 + digits),
        steepness_hu_per_voxel=round(steepness, 1 + digits),
        faint_share=round(float(np.mean(edges.bone < iso_value)), 4),
        contrast_medium_share=round(left_out, 4),
        flat_share=round(flat_share, 4),
        slices=slices,
        slice_step=slice_step,
    )


def _no_bone(look: _Look) -> str:
    background = look.background
    return (
        f"no bone found to choose the iso value by: {background.name} has its mode at {background.mode:.0f} HU with a "
        f"noise of {background.noise:.0f} HU, {format_share(look.dense_share, 2)} of the voxels of {look.slices}"
        f" slices lie above {background.seed} HU and {len(look.edges.bone)} edges of bone rise from it;"
        f" {describe_way_out()}"
    )


def _median(values: NDArray[Any], weights: NDArray[Any], share: float = 0.5) -> float:
    if not len(values):
        return 0.0
    order = np.argsort(values, kind="stable")
    summed = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order[np.searchsorted(summed, share * summed[-1])]])
