"""The gates of a CT series: conditions that it must meet before it is used for measurements, as
`clrecon.system.records`.

A gate covers a fact that moves a surface in the patient or changes its level, without the user of the mesh seeing it.
Everything else that is unusual gives only a warning; docs/certificate.md lists both, with the reasons.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from clrecon.dicom.headers.slice_header import SliceHeader
from clrecon.dicom.series.census import judge_numbers
from clrecon.dicom.series.series import Series
from clrecon.dicom.stack.directions import (
    ORIENTATION_EXACT,
    ORIENTATION_LIMIT,
    ORIENTATION_SPREAD_RAD,
    measure_directions,
)
from clrecon.dicom.stack.fit import (
    STATED_GAP_TOLERANCE,
    Stack,
    group_places,
    measure_stated_gap,
)
from clrecon.errors import RefusedInputError
from clrecon.sources.facts import PixelFacts
from clrecon.sources.gates import PADDING_SHARE, judge_figures, judge_steps, list_odd_values
from clrecon.sources.likeness import Likeness
from clrecon.sources.plausibility import leave_unexamined
from clrecon.system.records import Gate, at_most, none_of, unmeasured

GAP_THICKNESSES = 2.0
"""Largest gap in units of the slice thickness.  Beyond it more is left out than measured: a high-resolution lung scan
has 10, and no usable surface."""
SLOPES, INTERCEPTS = (1e-3, 100.0), (-40_000.0, 40_000.0)
"""Ranges of slope and intercept.  Scanners write the slope 1, a fraction of 1 or a few; below 0 bone would be dark.
Stored 16-bit values in the middle of their range need an intercept of 32768."""
STRAY = "values beyond the stored bits"


def judge_series(
    series: Series,
    stack: Stack | None,
    facts: PixelFacts | None = None,
    likeness: Likeness | None = None,
    value_gates: Sequence[Gate] | None = None,
) -> list[Gate]:
    """Judge a series by the gates.

    stack: Its slices as they are or would be read.
    facts: Figures of its pixels; without them the gates on pixels are not measured.
    likeness: Likeness of its slices; also None where they are too few or too small.
    value_gates: Gates of the values of the voxels, see `clrecon.sources.plausibility.examine_voxels`.

    Returns: See `clrecon.system.records.Gate`.  The texts hold no file names.
    """
    refused = len(series.problems)
    gates = [
        none_of("usable", refused, "reasons to refuse the series"),
        none_of("readable", len(series.corrupt) + len(series.others), "files that may hold slices of it, unreadable"),
    ]
    if stack is None:
        return gates
    gates.append(_judge_spacing(stack))
    gates += _gates_of_places(stack)
    what = "slices at the place of another that differ from it and are no phases"
    gates.append(judge_numbers(series.census, stack, _count_copies(series)))
    gates.append(none_of("duplicate_slices", _count_doubled(series), what))
    gates.append(_judge_one_volume(series, likeness))
    gates += _gates_of_values(stack.slices)
    gates.append(_judge_hu(stack.slices, facts))
    gates += leave_unexamined() if value_gates is None else value_gates
    share = "share of voxels without a measurement (padding)"
    if facts is None:
        gates.append(unmeasured("padding_share", PADDING_SHARE, None, f"{share}: the pixels were not read"))
        gates.append(unmeasured("stored_bits", 0, None, f"{STRAY}: the pixels were not read"))
    else:
        gates.append(none_of("stored_bits", facts.stray, facts.stray_text or STRAY))
        gates.append(at_most("padding_share", facts.padding_share, PADDING_SHARE, None, share))
    return gates


def _gates_of_places(stack: Stack) -> Iterator[Gate]:
    directions = measure_directions(stack.slices)
    what = "ImageOrientationPatient is off unit length or right angle by"
    yield at_most("orientation_exact", directions.deviation, ORIENTATION_EXACT, None, what)
    what = "ImageOrientationPatient of a slice differs from the mean by"
    if directions.deviation > ORIENTATION_LIMIT:
        yield unmeasured("orientation_same", ORIENTATION_SPREAD_RAD, "rad", f"{what}: there is no mean")
    else:
        yield at_most("orientation_same", directions.spread_rad, directions.spread_allowed_rad, "rad", what)
    line = stack.line
    what = "largest distance of a slice from even positions"
    if line.residual_max_mm is None or line.tolerance_mm is None:
        yield unmeasured("grid_residual", 0.01, "mm", f"{what}: there is one slice")
        return
    yield at_most("grid_residual", line.residual_max_mm, line.tolerance_mm, "mm", what)
    yield none_of("missing_slices", stack.missing, "slices missing in between")
    yield _judge_thickness(stack)
    yield _judge_stated_gap(stack)


def _judge_spacing(stack: Stack) -> Gate:
    first = stack.slices[0]
    return judge_steps((first.di_mm, first.dj_mm), stack.line.gap_median_mm)


def _judge_thickness(stack: Stack) -> Gate:
    """Compare gaps with SliceThickness: how much of the tissue was measured."""
    what = "largest gap between slices as a multiple of SliceThickness; above 1 the tissue between was not measured"
    thickness = np.array([header.slice_thickness_mm or 0.0 for header in stack.slices])
    if (thickness <= 0.0).any():
        return unmeasured("gap_thickness", GAP_THICKNESSES, None, f"{what}: the thickness is not stated")
    gaps = np.diff(stack.distances_mm)
    worst = int(np.argmax(2.0 * gaps / (thickness[1:] + thickness[:-1])))
    ratio = float(2.0 * gaps[worst] / (thickness[worst] + thickness[worst + 1]))
    if ratio > GAP_THICKNESSES:
        what += f" ({gaps[worst]:g} mm at a thickness of {thickness[worst]:g} mm)"
    return at_most("gap_thickness", ratio, GAP_THICKNESSES, None, what)


def _judge_hu(headers: Sequence[SliceHeader], facts: PixelFacts | None) -> Gate:
    """Judge whether rescale, lowest and densest voxel are those of a CT; without pixels the rescale alone."""
    odd = []
    for name, values, (low, high) in (
        ("RescaleSlope", [header.slope for header in headers], SLOPES),
        ("RescaleIntercept", [header.intercept for header in headers], INTERCEPTS),
    ):
        odd += [f"{name} {value:g}" for value in (min(values), max(values)) if not low <= value <= high][:1]
    if facts is not None and facts.hu_min <= facts.hu_max and not count_unknown(headers):
        odd += list_odd_values(facts)
    return judge_figures(odd)


def _judge_one_volume(series: Series, likeness: Likeness | None) -> Gate:
    """Judge whether neighbours differ more than slices farther apart, and whether an element alternates from slice to
    slice.
    """
    doubts = 0 if series.stack is None or series.find_doubt() == "" else 1
    what = "signs of several volumes between each other: a header that alternates, neighbours less alike than others"
    if likeness is None and not doubts:
        return unmeasured("one_volume", 0, None, f"{what}: the pixels were not read, or too few")
    return none_of("one_volume", doubts + (likeness is not None and likeness.is_mixed), what)


def _count_copies(series: Series) -> int:
    try:
        return series.places.copies
    except RefusedInputError:
        return 0


def _count_doubled(series: Series) -> int:
    try:
        places = series.places
    except RefusedInputError:
        return 0  # the pixels cannot be compared: already counted as a reason for refusal
    return len(places.headers) - len(group_places(places.headers)) if places.problem and not places.phases else 0


def _judge_stated_gap(stack: Stack) -> Gate:
    """Compare SpacingBetweenSlices with the positions: a sign that every second slice is missing."""
    what, bound = "SpacingBetweenSlices differs from the positions by", 100.0 * STATED_GAP_TOLERANCE
    found = measure_stated_gap(stack.slices, stack.positions_mm, stack.line.gap_median_mm)
    if found is None:
        return unmeasured("stated_gap", bound, "%", f"{what}: it is not stated")
    return at_most("stated_gap", 100.0 * found[2], bound, "%", what)


def count_unknown(headers: Sequence[SliceHeader]) -> int:
    """Count slices whose values are not known to be HU."""
    return sum(
        not (h.has_slope and h.has_intercept) or h.rescale_type not in ("", "HU") or h.modality_lut for h in headers
    )


def _gates_of_values(headers: Sequence[SliceHeader]) -> Iterator[Gate]:
    yield none_of("hu_known", count_unknown(headers), "slices whose values are not known to be HU")
    yield none_of("lossless", sum(h.lossy for h in headers), "slices with lossy compression")
    yield none_of("measured_images", sum(bool(h.derived) for h in headers), "slices that were computed from others")
