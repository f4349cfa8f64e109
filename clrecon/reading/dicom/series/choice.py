"""The choice of the series to read: the one that is named, or the best of the usable CT stacks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from clrecon.errors import NoDicomError, RefusedInputError, UsageError
from clrecon.reading.dicom.headers.slice_header import SliceHeader
from clrecon.reading.dicom.parse.values import OTHER_TERM
from clrecon.reading.dicom.series.series import Series
from clrecon.reading.dicom.stack.fit import median_thickness
from clrecon.system.arguments import name_parameter
from clrecon.system.text import count_of, hash_uid, join_names

_DIRECTIONS = ("sagittal", "coronal", "axial")
"""Names of slices whose normal lies nearest to x, y, z of the patient."""
_NOT_ORIGINAL = ("DERIVED", "SECONDARY")
"""Words of ImageType: computed from other images, or made after the examination (DICOM PS3.3 C.7.6.1.1.2)."""


class Rank(NamedTuple):
    """What a series is chosen by.

    original: False where ImageType says that the images are derived or secondary; True where it says nothing.
    direction: "axial", "coronal" or "sagittal", the nearest.
    thickness_mm: As stated, to a hundredth of a millimetre; None where no slice states it.
    """

    original: bool
    direction: str
    thickness_mm: float | None


def rank_series(series: Series) -> Rank:
    """Return the rank of a stack by the header of its first slice, and by the thickness of all."""
    if not series.headers:
        return Rank(True, "axial", None)
    first = series.headers[0]
    words = dict(first.phase).get("ImageType", "").upper().replace("\\", " ").split()
    thickness = median_thickness(series.headers)
    normal = [
        abs(first.row_cosines[a] * first.column_cosines[b] - first.row_cosines[b] * first.column_cosines[a])
        for a, b in ((1, 2), (2, 0), (0, 1))
    ]
    return Rank(
        not any(word in _NOT_ORIGINAL for word in words),
        _DIRECTIONS[normal.index(max(normal))],
        None if thickness is None else round(thickness, 2),
    )


_SHORTEST_START = 4
"""Fewest characters of a hash or UID that name a series by its start."""
_SIMILAR = 0.5
"""Series with at least this share of the slices of the largest one are compared by more than their number of slices."""
_SAME_PLANE = 0.1
"""Directions of a localizer that lie no further apart from those of the slices, as unit vectors, are theirs."""


class Choice(NamedTuple):
    """The series to read, and why it is this one: empty where nothing was left to choose."""

    series: Series
    why: str


def choose_series(listed: Sequence[Series], wanted: int | str | None = None) -> Choice:
    """Choose the series to read.

    wanted: Number in the listing, SeriesInstanceUID, its hash, the start of one of these (`_SHORTEST_START`
        characters), or the description (whole, or a part that only one series has).  None takes the CT stack with most
        slices.  Of those with a similar number (`_SIMILAR`) original images come before derived ones, then the
        thinnest slices, then most slices; of equal ones the usable one.  Several patients, or similar stacks in
        different directions, leave no choice.
    """
    if wanted is None:
        ct = [series for series in listed if series.kind != "other"]
        if not ct:
            counts = Counter(series.identity.modality for series in listed)
            kinds = ", ".join(f"{count} series of modality {modality}" for modality, count in sorted(counts.items()))
            raise NoDicomError(f"found {kinds}, no CT series")
        _check_one_patient(ct)
        return _take_best(ct)
    matches = _match_series(listed, wanted)
    if not matches:
        raise UsageError(f"no series matches {name_parameter('series')} {wanted!r}; there are {_list_lines(listed)}")
    if len({series.identity for series in matches}) != 1:
        raise UsageError(f"{len(matches)} series match {name_parameter('series')} {wanted!r}: {_list_lines(matches)}")
    chosen, why = Choice(matches[0], "") if len(matches) == 1 else _take_best(matches)
    if chosen.kind == "other":
        raise NoDicomError(f"series {chosen.number} is of modality {chosen.identity.modality}, not CT")
    return Choice(chosen, why)


def _check_one_patient(ct: Sequence[Series]) -> None:
    """Refuse to choose among several patients: having more slices does not make a patient the right one."""
    stacks = [series for series in ct if series.kind == "stack" and series.count > 1]
    patients = {series.patient for series in stacks if series.patient}
    if len(patients) > 1:
        lines = [f"[patient {series.patient or '?'}, series {series.describe()}]" for series in stacks]
        raise RefusedInputError(
            f"CT series of {len(patients)} patients, choose one with {name_parameter('series')}: {join_names(lines)}"
        )


def _match_series(listed: Sequence[Series], wanted: int | str) -> list[Series]:
    text = str(wanted).strip()
    if not text:
        return []
    by_id = [series for series in listed if text in _ids_of(series)]
    if by_id:
        return by_id
    if text.isascii() and text.isdigit():
        by_number = [series for series in listed if series.number == int(text)]
        if by_number or len(text) < _SHORTEST_START:
            return by_number
    folded = text.casefold()
    exact = [series for series in listed if series.identity.description.casefold() == folded]
    if exact:
        return exact
    begins = [
        len(text) >= _SHORTEST_START and any(own.startswith(folded) for own in _ids_of(series)) for series in listed
    ]
    parts = [folded in series.identity.description.casefold() for series in listed]
    return [one for one, begun, part in zip(listed, begins, parts, strict=True) if begun or part]


def _ids_of(series: Series) -> list[str]:
    """Return the UID of a series and its hash, none for a series without a UID."""
    uid = series.identity.uid
    return [uid, hash_uid(uid) or ""] if uid else []


def _take_best(candidates: Sequence[Series]) -> Choice:
    """Choose among the stacks: of those with a similar number of slices the best by rank, and say by what it won."""
    stacks = [series for series in candidates if series.kind == "stack"]
    if not stacks:
        if len(candidates) == 1:
            return Choice(candidates[0], "")  # read_volume refuses it with its own problem
        raise RefusedInputError(f"no CT stack among {_list_lines(candidates)}")
    if len(stacks) == 1:
        return Choice(stacks[0], "")
    most = max(series.count for series in stacks)
    near = [(series, rank_series(series)) for series in stacks if series.count >= _SIMILAR * most and series.count > 1]
    if not near:
        raise RefusedInputError(f"a single slice cannot make a volume: {len(stacks)} series of one slice each")
    best, why = _sift(near)
    if len(best) == 1:
        return Choice(best[0], why)  # a fault does not exclude the series: read_volume refuses it
    usable = [series for series in best if not series.problems]
    if len(usable) == 1:
        return Choice(usable[0], "the only one of its size that can be used")
    if not usable:
        reasons = join_names(f"[series {series.number}: {series.problems[0]}]" for series in best)
        raise RefusedInputError(
            f"{len(best)} CT series have {best[0].count} slices each and none can be used: {reasons}"
        )
    raise RefusedInputError(
        f"{len(usable)} CT series have {usable[0].count} slices each, choose one with {name_parameter('series')}:"
        f" {_list_lines(usable)}"
    )


def _sift(near: Sequence[tuple[Series, Rank]]) -> tuple[list[Series], str]:
    """Keep the best of similar series, step by step; returns those that are equally good and the last reason."""
    why = "with the most slices"
    candidates = [each for each in near if each[1].original]
    if candidates and len(candidates) < len(near):
        why = "original images before derived ones"
        kept_axes = {rank.direction for _, rank in candidates}
        if kept_axes == {"axial"} and any(rank.direction != "axial" for _, rank in near):
            why = "original axial images before derived ones in other directions"
    candidates = candidates or list(near)
    if len({rank.direction for _, rank in candidates}) > 1:
        lines = join_names(f"[{series.describe()}, {rank.direction}]" for series, rank in candidates)
        raise RefusedInputError(
            f"{len(candidates)} CT series of similar size run in different directions, choose one with"
            f" {name_parameter('series')}: {lines}"
        )
    known = [rank.thickness_mm for _, rank in candidates if rank.thickness_mm is not None]
    if len(known) == len(candidates) and max(known) > min(known):
        candidates = [each for each in candidates if each[1].thickness_mm == min(known)]
        why = f"with the thinnest slices, {min(known):g} mm"
    most = max(series.count for series, _ in candidates)
    return [series for series, _ in candidates if series.count == most], why


def describe_left(listed: Sequence[Series], choice: Choice, wanted: int | str | None = None) -> list[str]:
    """Say which CT series are not used and why, where the choice was not the caller's; warn of what may be slices."""
    chosen = choice.series
    left = [series for series in listed if series is not chosen]
    stacks = [series for series in left if series.kind == "stack"] if wanted is None else []
    lines = []
    for series in stacks:
        unusable = series.count >= chosen.count and series.problems
        lines.append(f"[{series.describe()}{', cannot be used' if unusable else ''}]")
    sentences = []
    if lines:
        read = f"; series {chosen.number} is read, {choice.why}" if choice.why else ""
        noun = "other CT series"
        sentences = [f"{count_of(len(lines), noun, noun)} not used: {join_names(lines)}{read}"]
    return [*sentences, *_describe_doubtful(left, chosen), *_describe_other_planes(left, chosen)]


def _describe_doubtful(left: Sequence[Series], chosen: Series) -> list[str]:
    """Warn about files that may be harmed slices of the chosen series: missing at its end they leave no hole."""
    doubtful = [series for series in left if _may_be_slices(series, chosen)]
    if not doubtful:
        return []
    lines = join_names(f"[{series.describe()}]" for series in doubtful)
    return [f"not used, though they may be harmed slices of series {chosen.number}: {lines}"]


def _may_be_slices(series: Series, chosen: Series) -> bool:
    """Return whether a series that is no stack may be slices that lost what they are; true scouts run across them."""
    if series.kind == "other" and series.identity.modality in ("unknown", OTHER_TERM):
        return True
    if series.kind == "stack" or series.key != chosen.key:
        return False
    if series.kind != "localizer" or not series.headers or not chosen.headers:
        return True
    return _chord(series.headers[0], chosen.headers[0]) < _SAME_PLANE


def _chord(first: SliceHeader, second: SliceHeader) -> float:
    """Return how far the directions of two slices lie apart, as unit vectors."""
    return max(math.dist(first.row_cosines, second.row_cosines), math.dist(first.column_cosines, second.column_cosines))


def _describe_other_planes(left: Sequence[Series], chosen: Series) -> list[str]:
    """Warn about slices that were split off the chosen stack: missing at its end they leave no hole."""
    parts = [one for one in left if one.kind == "stack" and one.headers and one.key == chosen.key]
    if not parts or not chosen.headers:
        return []
    chords = [_chord(part.headers[0], chosen.headers[0]) for part in parts]
    low, high = (math.degrees(2.0 * math.asin(min(chord / 2.0, 1.0))) for chord in (min(chords), max(chords)))
    count = sum(len(part.headers) for part in parts)
    angles = f"{low:.1f}" if len(parts) == 1 else f"{low:.1f} to {high:.1f}"
    return [f"{count} slice{'s' * (count > 1)} of the series that is read left: in another plane, {angles} degrees off"]


def _list_lines(listed: Sequence[Series]) -> str:
    """List series for an error; what people typed into their headers is left to the listing."""
    return join_names(f"[{series.describe()}]" for series in listed) + ' ("clrecon info" describes them)'
