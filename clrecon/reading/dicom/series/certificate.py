"""The certificate of a DICOM series, without patient data: its origin and geometry, and the gates that it must meet.

Warnings and reports hold no file names and descriptions, into which people put names, only counts and positions.

A gate covers a fact that moves a surface in the patient or changes its level, without the user of the mesh seeing it.
Everything else that is unusual gives only a warning; docs/certificate.md lists both, with the reasons.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry import column_spacing
from clrecon.geometry.affine import facts_of_orientation
from clrecon.geometry.certificate import Certificate
from clrecon.reading.common import plausibility
from clrecon.reading.common.likeness import Likeness
from clrecon.reading.common.source_facts import PixelFacts
from clrecon.reading.dicom.headers.slice_header import SliceHeader
from clrecon.reading.dicom.parse.transfer_syntaxes import SYNTAX_NAMES
from clrecon.reading.dicom.series.census import facts_of_numbers, judge_numbers
from clrecon.reading.dicom.series.phases import choose_phase, describe_spacing
from clrecon.reading.dicom.series.scan import Scan
from clrecon.reading.dicom.series.series import Series
from clrecon.reading.dicom.stack import fit
from clrecon.reading.dicom.stack.mixtures import describe_differences
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.records import Gate, at_most, none_of, unmeasured
from clrecon.system.text import count_of, hash_uid

_LONG_VOXELS = 10.0
"""Gaps of so many pixels want a SliceThickness that says what lies between."""
_GAP_THICKNESSES = 1.95
"""Largest gap in slice thicknesses: 2 where every second slice of a gapless scan is lost, 10 in a scan of the lung."""
_SLOPES, _INTERCEPTS = (1e-3, 100.0), (-40_000.0, 40_000.0)
"""Ranges of slope and intercept.  Scanners write the slope 1, a fraction of 1 or a few; below 0 bone would be dark.
Stored 16-bit values in the middle of their range need an intercept of 32768."""
_FEWEST_LOCATIONS, _FOLLOWS = 3, 0.25
"""Fewest slices whose SliceLocation counts, and how far, in steps, a slice may be from a line through them."""
_LOCATION_PART, _LOCATION_MM = 0.05, 1.0
"""Largest difference of the length of the stack by SliceLocation: some writers round it to whole mm."""
_FIELD_WIDER = 1.5
"""Largest width of a picture in ReconstructionDiameters: the circle is in the square, or hardly beyond it."""
MOST_PIXELS, _FINEST_MM = 4096, 0.03
"""More pixels along the diameter no scanner has, of those that are not of a micro-CT."""
_CLEAR_DIRECTION = 0.8
_STRAY = "values beyond the stored bits"


def judge_series(
    series: Series,
    stack: fit.Stack | None,
    facts: PixelFacts | None = None,
    likeness: Likeness | None = None,
    value_gates: Sequence[Gate] | None = None,
) -> list[Gate]:
    """Judge a series by the gates, and the `value_gates` of `examine_voxels`; those on None are not measured."""
    refused = len(series.problems)
    gates = [
        none_of("usable", refused, "reasons to refuse the series"),
        none_of("readable", len(series.corrupt) + len(series.others), "files that may hold slices of it, unreadable"),
    ]
    if stack is None:
        return gates
    first = stack.slices[0]
    gates.append(plausibility.judge_steps((first.di_mm, first.dj_mm), stack.line.gap_median_mm))
    gates += _gates_of_places(stack)
    words = "slices at the place of another that differ from it and are no phases"
    gates.append(judge_numbers(series.census, stack, _count_copies(series)))
    gates.append(none_of("duplicate_slices", _count_doubled(series), words))
    gates.append(_judge_one_volume(series, likeness))
    gates += [
        none_of("hu_known", count_unknown(stack.slices), "slices whose values are not known to be HU"),
        none_of("lossless", sum(h.lossy for h in stack.slices), "slices with lossy compression"),
        none_of("measured_images", sum(bool(h.derived) for h in stack.slices), "slices that were computed from others"),
    ]
    gates.append(_judge_hu(stack.slices, facts))
    gates += plausibility.leave_unexamined() if value_gates is None else value_gates
    share = "share of voxels without a measurement (padding)"
    if facts is None:
        gates.append(
            unmeasured("padding_share", plausibility.PADDING_SHARE, None, f"{share}: the pixels were not read")
        )
        gates.append(unmeasured("stored_bits", 0, None, f"{_STRAY}: the pixels were not read"))
    else:
        gates.append(none_of("stored_bits", facts.stray, facts.stray_text or _STRAY))
        gates.append(at_most("padding_share", facts.padding_share, plausibility.PADDING_SHARE, None, share))
    return gates


def _gates_of_places(stack: fit.Stack) -> Iterator[Gate]:
    directions = fit.measure_directions(stack.slices)
    words = "ImageOrientationPatient is off unit length or right angle by"
    yield at_most("orientation_exact", directions.deviation, fit.ORIENTATION_EXACT, None, words)
    words = "ImageOrientationPatient of a slice differs from the mean by"
    if directions.deviation > fit.ORIENTATION_LIMIT:
        yield unmeasured("orientation_same", fit.ORIENTATION_SPREAD_RAD, "rad", f"{words}: there is no mean")
    else:
        yield at_most("orientation_same", directions.spread_rad, directions.spread_allowed_rad, "rad", words)
    line = stack.line
    words = "largest distance of a slice from even positions"
    if line.residual_max_mm is None or line.tolerance_mm is None:
        yield unmeasured("grid_residual", 0.01, "mm", f"{words}: there is one slice")
        return
    yield at_most("grid_residual", line.residual_max_mm, line.tolerance_mm, "mm", words)
    yield none_of("missing_slices", stack.missing, "slices missing in between")
    yield _judge_thickness(stack)
    yield _judge_stated_gap(stack)
    yield _judge_stated_places(stack)


def _judge_thickness(stack: fit.Stack) -> Gate:
    """Compare gaps with SliceThickness: how much of the tissue was measured."""
    words = "largest gap between slices as a multiple of SliceThickness; above 1 the tissue between was not measured"
    thickness = np.array([header.slice_thickness_mm or 0.0 for header in stack.slices])
    if (thickness <= 0.0).any():
        return unmeasured("gap_thickness", _GAP_THICKNESSES, None, f"{words}: the thickness is not stated")
    gaps = np.diff(stack.distances_mm)
    worst = int(np.argmax(2.0 * gaps / (thickness[1:] + thickness[:-1])))
    ratio = float(2.0 * gaps[worst] / (thickness[worst] + thickness[worst + 1]))
    if ratio > _GAP_THICKNESSES:
        words += f" ({gaps[worst]:g} mm at a thickness of {thickness[worst]:g} mm)"
    return at_most("gap_thickness", ratio, _GAP_THICKNESSES, None, words)


def _judge_hu(headers: Sequence[SliceHeader], facts: PixelFacts | None) -> Gate:
    """Judge whether rescale, lowest and densest voxel are those of a CT; without pixels the rescale alone."""
    odd = []
    for name, values, (low, high) in (
        ("RescaleSlope", [header.slope for header in headers], _SLOPES),
        ("RescaleIntercept", [header.intercept for header in headers], _INTERCEPTS),
    ):
        odd += [f"{name} {value:g}" for value in (min(values), max(values)) if not low <= value <= high][:1]
    if facts is not None and facts.hu_min <= facts.hu_max and not count_unknown(headers):
        odd += plausibility.list_odd_values(facts)
    return plausibility.judge_figures(odd)


def _judge_one_volume(series: Series, likeness: Likeness | None) -> Gate:
    """Judge whether slices differ more from neighbours than from others, and whether an element alternates."""
    doubts = 0 if series.stack is None or series.find_doubt() == "" else 1
    words = "signs of several volumes between each other: a header that alternates, neighbours less alike than others"
    if likeness is None and not doubts:
        return unmeasured("one_volume", 0, None, f"{words}: the pixels were not read, or too few")
    return none_of("one_volume", doubts + (likeness is not None and likeness.is_mixed), words)


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
    return len(places.headers) - len(fit.group_places(places.headers)) if places.problem and not places.phases else 0


def _judge_stated_gap(stack: fit.Stack) -> Gate:
    """Compare SpacingBetweenSlices with the positions: a sign that every second slice is missing."""
    words, bound = "SpacingBetweenSlices differs from the positions by", 100.0 * fit.STATED_GAP_TOLERANCE
    stated_gap = fit.measure_stated_gap(stack.slices, stack.positions_mm, stack.line.gap_median_mm)
    if stated_gap is None:
        return unmeasured("stated_gap", bound, "%", f"{words}: it is not stated")
    return at_most("stated_gap", 100.0 * stated_gap[2], bound, "%", words)


def _judge_stated_places(stack: fit.Stack) -> Gate:
    """Compare position, orientation and pixel spacing with other elements that say the same."""
    words = "elements that contradict the places of the voxels"
    clashes = [
        text for text in (_compare_locations(stack), _compare_field(stack), _compare_letters(stack)) if text != ""
    ]
    wrong = [text for text in clashes if text is not None]
    if not any(text is None for text in clashes) and not wrong:
        return unmeasured("stated_places", 0, None, f"{words}: there are none")
    return none_of("stated_places", len(wrong), f"{words} ({'; '.join(wrong)})" if wrong else words)


def _compare_locations(stack: fit.Stack) -> str | None:
    """Compare SliceLocation with the positions: None where both move alike, "" where it cannot be compared.

    It is counted from anywhere in any direction, along the normal, the table or an axis of the patient.
    """
    places = [header.stated_location_mm for header in stack.slices]
    if len(places) < _FEWEST_LOCATIONS or any(place is None for place in places):
        return ""
    along = np.abs(np.array(places, np.float64) - (places[0] or 0.0))
    moved = np.abs(stack.positions_mm - stack.positions_mm[0])
    distances = np.linalg.norm(moved, axis=1)
    last = len(places) - 1
    if along[-1] <= 0.0 or (np.diff(along) == 1.0).all():  # all at one place, or numbers of the slices
        return ""
    if np.abs(along / along[-1] - distances / distances[-1]).max() * last > _FOLLOWS:
        return ""  # it does not follow the slices
    ways = [float(distances[-1]), float(stack.distances_mm[-1] - stack.distances_mm[0]), *moved[-1].tolist()]
    nearest = min(ways, key=lambda length: abs(length - along[-1]))
    if abs(nearest - along[-1]) <= max(_LOCATION_PART * nearest, _LOCATION_MM):
        return None
    return (
        f"SliceLocation moves by {along[-1] / last:.4g} mm from slice to slice, ImagePositionPatient by"
        f" {distances[-1] / last:.4g} mm"
    )


def _compare_field(stack: fit.Stack) -> str | None:
    """Compare ReconstructionDiameter with the picture, as `_compare_locations` does; pictures may be cut out of it."""
    first = stack.slices[0]
    diameter, pixel = first.stated_field_mm or 0.0, max(first.di_mm, first.dj_mm)
    widest = max(first.columns * first.di_mm, first.rows * first.dj_mm)
    if diameter <= 0.0:
        return ""
    if widest > _FIELD_WIDER * diameter:
        return f"ReconstructionDiameter says {diameter:g} mm, by PixelSpacing the picture is {widest:.4g} mm wide"
    if pixel < _FINEST_MM or diameter <= MOST_PIXELS * pixel:
        return None
    return f"ReconstructionDiameter says {diameter:g} mm, {diameter / pixel:,.0f} pixels of {pixel:g} mm"


def _compare_letters(stack: fit.Stack) -> str | None:
    """Compare PatientOrientation with the directions, as `_compare_locations` does."""
    first, directions = stack.slices[0], fit.measure_directions(stack.slices)
    if not first.stated_letters or first.quadruped or directions.deviation > fit.ORIENTATION_LIMIT:
        return ""
    letters_found = []
    for direction, letters in zip((directions.row, directions.column), first.stated_letters.split("\\"), strict=True):
        axis = int(np.argmax(np.abs(direction)))
        letter = ("LR", "PA", "HF")[axis][int(direction[axis] < 0.0)]
        letters_found.append(letters if letter in letters or abs(direction[axis]) < _CLEAR_DIRECTION else letter)
    shown = "\\".join(letters_found)
    if shown == first.stated_letters:
        return None
    return f"PatientOrientation says {first.stated_letters}, by ImageOrientationPatient it is {shown}"


def count_unknown(headers: Sequence[SliceHeader]) -> int:
    return sum(
        not (h.has_slope and h.has_intercept) or h.rescale_type not in ("", "HU") or h.modality_lut for h in headers
    )


_SAID_BY_GATES = (
    "complete_series",
    "stated_places",
    "shown_places",
    "padding_share",
    "stored_bits",
    "plausible_spacing",
    "gap_thickness",
    "plausible_hu",
    "hu_scale",
    "stored_sign",
)
"""Gates whose text becomes a warning when they fail; for the other gates a separate warning says more."""


def collect_scan_warnings(scan: Scan) -> list[str]:
    """Return warnings about files that claim to be DICOM but were passed over, or that could not be examined."""
    warnings = []
    if scan.skipped["corrupt"]:
        warnings.append(f"{scan.skipped['corrupt']} corrupt file{'s' * (scan.skipped['corrupt'] > 1)} skipped")
    warnings += [f"{count} skipped: {reason}" for reason, count in Counter(s.reason for s in scan.suspects).items()]
    for reason in ("not readable", "folder not readable"):
        if scan.skipped[reason]:
            warnings.append(f"{scan.skipped[reason]} skipped: {reason}")
    return warnings


def collect_series_warnings(series: Series) -> list[str]:
    if series.stack is None or series.kind == "other":
        return []
    headers = series.stack.slices
    warnings = [*_describe_what_was_left(series), *series.stack.warnings]
    for text in dict.fromkeys(chain(*(header.warnings for header in headers))):
        warnings.append(f"{text} ({_place_slices(series.stack, lambda h, text=text: text in h.warnings)})")  # type: ignore[misc]
    checks: tuple[tuple[Callable[[SliceHeader], bool], str], ...] = (
        (lambda h: not h.has_slope, "no RescaleSlope: slope 1, intercept {intercept} taken: maybe not HU"),
        (
            lambda h: h.has_slope and not h.has_intercept,
            "no RescaleIntercept: slope {slope}, intercept 0 taken: maybe not HU",
        ),
        (lambda h: h.rescale_type not in ("", "HU"), "RescaleType is '{type}': the values are not HU"),
        (
            lambda h: h.modality_lut,
            "the files have a Modality LUT Sequence (0028,3000), which is not applied: slope {slope}, intercept"
            f" {{intercept}} taken, the values are not HU; {name_parameter('rescale')} says how HU follow from them",
        ),
        (
            lambda h: h.quadruped,
            "AnatomicalOrientationType (0010,2210) is QUADRUPED, an animal: along its trunk x runs to its left, y to"
            " dorsal, z to cranial; read P as dorsal, A as ventral, S as cranial and I as caudal. In head and limbs the"
            " letters mean other directions, and rules for people (couch, front and back, vertebrae) may not fit",
        ),
        (lambda h: h.photometric == "MONOCHROME1", "MONOCHROME1: meant to be shown inverted; the values are kept"),
        (lambda h: h.lossy, "lossy compression: the values are not those that were measured"),
    )
    for is_so, text in checks:
        odd = next((header for header in headers if is_so(header)), None)
        if odd is not None:
            text = text.format(type=odd.rescale_type, intercept=f"{odd.intercept:g}", slope=f"{odd.slope:g}")
            warnings.append(f"{text} ({_place_slices(series.stack, is_so)})")
    warnings += [f"{text} ({_place_slices(series.stack, is_so)})" for text, is_so in describe_differences(headers)]
    warnings += _describe_long_voxels(series.stack)
    doubt = series.find_doubt()
    if doubt and not any(doubt in text for text in warnings):
        warnings.append(doubt)
    return warnings


def _describe_long_voxels(stack: fit.Stack) -> list[str]:
    """Describe gaps of many pixels where no thickness says whether the tissue between was measured."""
    gap, pixel = stack.line.gap_median_mm, max(stack.slices[0].di_mm, stack.slices[0].dj_mm)
    if gap is None or gap < _LONG_VOXELS * pixel or fit.median_thickness(stack.slices) is not None:
        return []
    return [
        f"slices lie {gap:.4g} mm apart, {gap / pixel:.3g} times the width of a pixel, and no SliceThickness says"
        " whether the tissue between them was measured"
    ]


def _describe_what_was_left(series: Series) -> list[str]:
    """Describe copies, the other phases of a series, and mixed reconstructions."""
    try:
        places = series.places
    except RefusedInputError:
        return []
    warnings = []
    if places.copies:
        some = "slices" if places.copies > 1 else "slice"
        warnings.append(f"{places.copies} duplicate {some} dropped: same place, same pixels as another")
    if places.phases and series.phase is not None:
        chosen = choose_phase(places, series.phase)
        left = sum(len(phase.headers) for phase in places.phases) - len(chosen.headers)
        which = f"phase {chosen.number} of {len(places.phases)} ({chosen.keyword} {chosen.value})"
        spacing = f": {describe_spacing(places.phases, chosen)}" if places.interleaved else ""
        warnings.append(f"{which} read, {count_of(left, 'slice')} of others left{spacing}")
        most = max(len(phase.headers) for phase in places.phases)
        if not places.interleaved and len(chosen.headers) < most:
            warnings.append(f"phase {chosen.number} has {count_of(len(chosen.headers), 'slice')}, another one {most}")
    kernels = (
        {dict(header.phase).get("ConvolutionKernel", "") for header in series.stack.slices} if series.stack else ()
    )
    if len(kernels) > 1:
        warnings.append(f"ConvolutionKernel differs between slices ({len(kernels)} kernels): sharp and soft are mixed")
    return warnings


def _facts_of_phase(series: Series) -> dict[str, Any] | None:
    if series.phase is None or not series.places.phases:
        return None
    chosen = choose_phase(series.places, series.phase)
    return {"number": chosen.number, "of": len(series.places.phases), "keyword": chosen.keyword, "value": chosen.value}


def _place_slices(stack: fit.Stack, is_so: Callable[[SliceHeader], bool]) -> str:
    """Describe slices by count and position along the normal; their file names may contain the patient's name."""
    positions = [place for header, place in zip(stack.slices, stack.distances_mm, strict=True) if is_so(header)]
    if len(positions) == len(stack.slices):
        return "all slices"
    first = "the first " * (len(positions) > 1)
    return f"{len(positions)} of {len(stack.slices)} slices, {first}at {positions[0]:.2f} mm"


def _facts_of_rescale(
    headers: Sequence[SliceHeader], scan: Scan, findings: plausibility.VoxelFindings | None
) -> dict[str, Any]:
    slopes, intercepts = [h.slope for h in headers], [h.intercept for h in headers]
    return {
        "slope": [min(slopes), max(slopes)],
        "intercept": [min(intercepts), max(intercepts)],
        "type": headers[0].rescale_type or None,
        **({"given": True} if scan.rescale is not None else {}),
        **({} if findings is None else findings.materials),
    }


@dataclass(frozen=True)
class SeriesPixels:
    """Voxels of a series, and what they tell beside its headers."""

    voxels: NDArray[Any]
    facts: PixelFacts
    likeness: Likeness | None
    findings: plausibility.VoxelFindings


def certify(
    series: Series,
    stack: fit.Stack,
    pixels: SeriesPixels | None,
    scan: Scan,
    affine: NDArray[np.float64] | None,
    warnings: Sequence[str],
) -> Certificate:
    """Build the certificate of a series: the report of its volume, and what ``clrecon info`` shows.

    Without `pixels` the entries that depend on them are None; without an `affine` the series is refused.
    """
    facts = None if pixels is None else pixels.facts
    likeness = None if pixels is None else pixels.likeness
    findings = None if pixels is None else pixels.findings
    headers = stack.slices
    first = stack.slices[0]
    line, identity = stack.line, series.identity
    stated = next((h.stated_gap_mm for h in headers if h.stated_gap_mm is not None), None)
    lay = {h.patient_position for h in headers}
    gates = judge_series(series, stack, facts, likeness, None if findings is None else findings.gates)
    unsaid = [gate.text for gate in gates if gate.name in _SAID_BY_GATES and gate.ok is False]
    return Certificate(
        format="DICOM",
        series={"number": series.number, "uid_hash": hash_uid(identity.uid), "modality": identity.modality},
        phase=_facts_of_phase(series),
        slices=len(headers),
        slices_missing=stack.missing,
        shape_ijk=[first.columns, first.rows, len(headers)],
        spacing_mm=None if affine is None else list(column_spacing(affine)),
        extent_mm=None if affine is None else fit.measure_extent(stack),
        affine_ijk_to_lps_mm=None if affine is None else affine.tolist(),
        orientation=None if affine is None else facts_of_orientation(affine),
        patient_position=(lay.pop() or None) if len(lay) == 1 else None,
        anatomical_orientation="QUADRUPED" if any(h.quadruped for h in headers) else None,
        tilt_deg=stack.tilt_deg,
        grid_residual_max_mm=line.residual_max_mm,
        grid_residual_rms_mm=line.residual_rms_mm,
        grid_tolerance_mm=line.tolerance_mm,
        gap_mm={"min": line.gap_min_mm, "max": line.gap_max_mm, "median": line.gap_median_mm},
        uneven=line.uneven,
        gap_runs=fit.summarise_gaps(stack.distances_mm) if line.uneven else None,
        slice_positions_mm=stack.positions_mm.tolist() if line.uneven else None,
        slice_thickness_mm=fit.median_thickness(headers),
        thickness=fit.facts_of_thickness(headers, stack.distances_mm),
        stated_gap_mm=stated,
        numbering=facts_of_numbers(series.census, stack),
        frame_of_reference_hash=hash_uid(first.frame_of_reference),
        padding_share=None if facts is None else facts.padding_share,
        padding_hu=None if facts is None else facts.padding_hu,
        transfer_syntaxes=sorted({h.transfer_syntax for h in headers}),
        transfer_syntax_names=sorted({SYNTAX_NAMES[h.transfer_syntax] for h in headers}),
        lossy=any(h.lossy for h in headers),
        rescale=_facts_of_rescale(headers, scan, findings),
        hu_range=None if facts is None else [facts.hu_min, facts.hu_max],
        files={"found": scan.files, "used": len({h.file for h in headers}), "skipped": dict(scan.skipped)},
        dropped=series.dropped,
        gates=gates,
        warnings=[*warnings, *unsaid],
        problems=list(series.problems),
    )
