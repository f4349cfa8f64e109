"""What a CT series must fulfil to be measured on: named gates, in the form of `clrecon.gates`.

A gate is a fact that moves a surface in the patient or changes its level, and that a user of the mesh could not see.
Everything else that is odd is a warning alone; docs/certificate.md says which is which, and why.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from clrecon.dicom.directions import (
    ORIENTATION_EXACT,
    ORIENTATION_LIMIT,
    ORIENTATION_SPREAD_RAD,
    measure_directions,
)
from clrecon.dicom.gate import (
    STATED_GAP_TOLERANCE,
    Stack,
    group_places,
    measure_stated_gap,
)
from clrecon.dicom.likeness import Likeness
from clrecon.dicom.pixels import PixelFacts
from clrecon.dicom.series import Series
from clrecon.dicom.slice_header import SliceHeader
from clrecon.errors import RefusedInputError
from clrecon.gates import Gate, at_most, none_of, unmeasured

__all__ = ["PADDING_SHARE", "judge_series"]

PADDING_SHARE = 0.75
"""A circle in its square leaves 0.21 as padding, a 500 mm circle in a field of 800 mm 0.69; above that most of what
was measured is likely to be masked by a wrong PixelPaddingValue."""


def judge_series(
    series: Series, stack: Stack | None, facts: PixelFacts | None = None, likeness: Likeness | None = None
) -> list[Gate]:
    """Hold a series against the gates.

    Parameters
    ----------
    series : Series
    stack : Stack or None
        Its slices as they are, or would be, read.
    facts : PixelFacts, optional
        Of its pixels; without them the gates on pixels are not measured.
    likeness : Likeness, optional
        Of its slices; None where they are too few, or too small, as well.

    Returns
    -------
    list of dict
        See `clrecon.gates.Gate`.  The texts hold no file names.
    """
    refused = len(series.problems)
    gates = [
        none_of("usable", refused, "reasons to refuse the series"),
        none_of("readable", len(series.corrupt) + len(series.others), "files that may hold slices of it, unreadable"),
    ]
    if stack is None:
        return gates
    gates += _gates_of_places(stack)
    what = "slices at the place of another that differ from it and are no phases"
    gates.append(none_of("duplicate_slices", _count_doubled(series), what))
    gates.append(_judge_one_volume(series, likeness))
    gates += _gates_of_values(stack.slices)
    share = "share of voxels without a measurement (padding)"
    if facts is None:
        gates.append(unmeasured("padding_share", PADDING_SHARE, None, f"{share}: the pixels were not read"))
    else:
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
    yield _judge_stated_gap(stack)


def _judge_one_volume(series: Series, likeness: Likeness | None) -> Gate:
    """Neighbours that are less alike than slices farther apart, and what alternates from slice to slice."""
    doubts = 0 if series.stack is None or series.find_doubt() == "" else 1
    what = "signs of several volumes between each other: a header that alternates, neighbours less alike than others"
    if likeness is None and not doubts:
        return unmeasured("one_volume", 0, None, f"{what}: the pixels were not read, or too few")
    return none_of("one_volume", doubts + (likeness is not None and likeness.is_mixed), what)


def _count_doubled(series: Series) -> int:
    try:
        places = series.places
    except RefusedInputError:
        return 0  # the pixels cannot be compared: a reason to refuse it, which is counted already
    return len(places.headers) - len(group_places(places.headers)) if places.problem else 0


def _judge_stated_gap(stack: Stack) -> Gate:
    """SpacingBetweenSlices against the positions: the one trace that is left when every second slice is gone."""
    what, bound = "SpacingBetweenSlices differs from the positions by", 100.0 * STATED_GAP_TOLERANCE
    found = measure_stated_gap(stack.slices, stack.positions_mm, stack.line.gap_median_mm)
    if found is None:
        return unmeasured("stated_gap", bound, "%", f"{what}: it is not stated")
    return at_most("stated_gap", 100.0 * found[2], bound, "%", what)


def _gates_of_values(headers: Sequence[SliceHeader]) -> Iterator[Gate]:
    unknown = sum(not (h.has_slope and h.has_intercept) or h.rescale_type not in ("", "HU") for h in headers)
    yield none_of("hu_known", unknown, "slices whose values are not known to be HU")
    yield none_of("lossless", sum(h.lossy for h in headers), "slices with lossy compression")
    yield none_of("measured_images", sum(bool(h.derived) for h in headers), "slices that were computed from others")
