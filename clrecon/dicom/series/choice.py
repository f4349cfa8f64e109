"""The choice of the series to read: the one that is named, or the usable CT stack with the most slices."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence

from clrecon.dicom.series.series import Series
from clrecon.errors import NoDicomError, RefusedInputError, UsageError
from clrecon.system.text import hash_uid, join_names
from clrecon.system.wording import name_parameter

__all__ = ["choose_series", "describe_left"]


def choose_series(found: Sequence[Series], wanted: int | str | None = None) -> Series:
    """Choose the series to read.

    Parameters
    ----------
    found : sequence of Series
    wanted : int or str, optional
        Number in the listing, SeriesInstanceUID, its hash, or the description (whole, or a part that only one
        series has).  None takes the one CT stack with most slices; of several with as many, the one that is
        usable.  With CT stacks of several patients there is no such choice.

    Raises
    ------
    UsageError
        `wanted` matches no series or several; the message lists the series.
    NoDicomError
        There is no CT series, or the one that is named is not CT.
    RefusedInputError
        Several usable CT stacks, or only unusable ones, have the same, largest number of slices; there is no
        stack; or there are stacks of several patients.
    """
    if wanted is None:
        ct = [series for series in found if series.kind != "other"]
        if not ct:
            raise NoDicomError(_describe_modalities(found))
        _check_one_patient(ct)
        return _take_largest(ct)
    matches = _match_series(found, wanted)
    if len({series.identity for series in matches}) != 1:
        count = "no series matches" if not matches else f"{len(matches)} series match"
        raise UsageError(f"{count} series={wanted!r}; there are {_list_lines(found)}")
    chosen = matches[0] if len(matches) == 1 else _take_largest(matches)
    if chosen.kind == "other":
        raise NoDicomError(f"series {chosen.number} is of modality {chosen.identity.modality}, not CT")
    return chosen


def _check_one_patient(ct: Sequence[Series]) -> None:
    """Refuse to choose among several patients: having more slices does not make a patient the right one."""
    stacks = [series for series in ct if series.kind == "stack" and series.count > 1]
    patients = {series.patient for series in stacks if series.patient}
    if len(patients) > 1:
        lines = [f"[patient {series.patient or '?'}, series {series.describe()}]" for series in stacks]
        raise RefusedInputError(
            f"CT series of {len(patients)} patients, choose one with {name_parameter('series')}: {join_names(lines)}"
        )


def _match_series(found: Sequence[Series], wanted: int | str) -> list[Series]:
    text = str(wanted).strip()
    by_id = [series for series in found if text in (series.identity.uid, hash_uid(series.identity.uid)) and text]
    if by_id:
        return by_id
    if text.isascii() and text.isdigit():
        return [series for series in found if series.number == int(text)]
    folded = text.casefold()
    exact = [series for series in found if series.identity.description.casefold() == folded]
    return exact or [series for series in found if folded and folded in series.identity.description.casefold()]


def _take_largest(candidates: Sequence[Series]) -> Series:
    stacks = [series for series in candidates if series.kind == "stack"]
    if not stacks:
        if len(candidates) == 1:
            return candidates[0]  # read_volume refuses it with its own problem
        raise RefusedInputError(f"no CT stack among {_list_lines(candidates)}")
    counts = [series.count for series in stacks]
    most = max(counts)
    largest = [series for series, count in zip(stacks, counts, strict=True) if count == most]
    if len(largest) == 1:
        return largest[0]  # a fault does not exclude the series: read_volume refuses it
    usable = [series for series in largest if not series.problems]
    if len(usable) == 1:
        return usable[0]
    if most == 1:
        raise RefusedInputError(f"a single slice cannot make a surface: {len(largest)} series of one slice each")
    if not usable:
        reasons = join_names(f"[series {series.number}: {series.problems[0]}]" for series in largest)
        raise RefusedInputError(f"{len(largest)} CT series have {most} slices each and none can be used: {reasons}")
    raise RefusedInputError(
        f"{len(usable)} CT series have {most} slices each, choose one with {name_parameter('series')}:"
        f" {_list_lines(usable)}"
    )


def describe_left(found: Sequence[Series], chosen: Series) -> list[str]:
    """Warn about the series that were not chosen, and about larger ones that cannot be used."""
    left = [series for series in found if series is not chosen]
    if not left:
        return []
    lines = []
    for series in left:
        unusable = series.kind == "stack" and series.count >= chosen.count and series.problems
        lines.append(f"[{series.describe()}{', cannot be used' if unusable else ''}]")
    return [f"{len(left)} other series left: {join_names(lines)}", *_describe_other_planes(left, chosen)]


def _describe_other_planes(left: Sequence[Series], chosen: Series) -> list[str]:
    """Warn about slices that were split off the chosen stack: missing at its end they leave no hole."""
    parts = [one for one in left if one.kind == "stack" and one.headers and one.key == chosen.key]
    if not parts or not chosen.headers:
        return []
    first = chosen.headers[0]
    chords = [
        max(math.dist(first.row_cosines, h.row_cosines), math.dist(first.column_cosines, h.column_cosines))
        for h in (part.headers[0] for part in parts)
    ]
    low, high = (math.degrees(2.0 * math.asin(min(chord / 2.0, 1.0))) for chord in (min(chords), max(chords)))
    count = sum(len(part.headers) for part in parts)
    angles = f"{low:.1f}" if len(parts) == 1 else f"{low:.1f} to {high:.1f}"
    return [f"{count} slice{'s' * (count > 1)} of the series that is read left: in another plane, {angles} degrees off"]


def _describe_modalities(found: Sequence[Series]) -> str:
    counts: dict[str, int] = defaultdict(int)
    for series in found:
        counts[series.identity.modality] += 1
    what = ", ".join(f"{count} series of modality {modality}" for modality, count in sorted(counts.items()))
    return f"found {what}, no CT series"


def _list_lines(found: Sequence[Series]) -> str:
    """List series for an error; what people typed into their headers is left to the listing."""
    return join_names(f"[{series.describe()}]" for series in found) + ' ("clrecon info" describes them)'
