"""Series: slices are grouped into series, which are numbered, and into planes of nearly equal directions."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path

from clrecon.errors import RefusedInputError
from clrecon.reading.common.likeness import judge_slices
from clrecon.reading.dicom.headers.slice_header import Concatenation, OtherImage, SeriesIdentity, SliceHeader
from clrecon.reading.dicom.pixels.stored import StoredPixels
from clrecon.reading.dicom.pixels.voxels import read_voxels
from clrecon.reading.dicom.series.census import Census, take_census
from clrecon.reading.dicom.series.phases import (
    Places,
    choose_phase,
    describe_phases,
    have_same_pixels,
    part_alternating,
    sort_places,
)
from clrecon.reading.dicom.series.scan import LINK_OUT, CorruptFile, Scan, advise_on_links
from clrecon.reading.dicom.stack.fit import Stack, group_places, measure_stack
from clrecon.reading.dicom.stack.mixtures import alternate_places, find_alternation
from clrecon.system.light_dataclass import dataclass, field, replace
from clrecon.system.text import count_of, join_names

SPLIT_ANGLE_RAD = math.radians(1.0)
"""Slices of one SeriesInstanceUID whose directions differ by more are separate stacks (a localizer, another plane).
With smaller differences they are one stack, and the gate reports the difference."""


class Planes:
    """Pairs of directions, numbered as they come; a grid of cells finds pairs within `SPLIT_ANGLE_RAD` of a new one."""

    FEW = 4

    def __init__(self) -> None:
        self._planes: list[tuple[float, ...]] = []
        self._cells: dict[tuple[int, ...], list[int]] = defaultdict(list)

    def find(self, plane: tuple[float, ...]) -> int:
        """Return the number of the first plane near `plane`, which is added if there is none."""
        for number, known in enumerate(self._planes[: self.FEW]):
            if _are_near(known, plane):
                return number
        cell = tuple(int(value // SPLIT_ANGLE_RAD) for value in plane)
        if len(self._planes) > self.FEW:
            around = itertools.product(*((value - 1, value, value + 1) for value in cell))
            near = (n for key in around for n in self._cells.get(key, ()) if _are_near(self._planes[n], plane))
            number = min(near, default=-1)
            if number >= 0:
                return number
        self._planes.append(plane)
        self._cells[cell].append(len(self._planes) - 1)
        return len(self._planes) - 1


def _are_near(first: tuple[float, ...], second: tuple[float, ...]) -> bool:
    return math.dist(first[:3], second[:3]) < SPLIT_ANGLE_RAD and math.dist(first[3:], second[3:]) < SPLIT_ANGLE_RAD


def describe_missing_parts(slices: Iterable[SliceHeader]) -> list[str]:
    """Describe missing files of concatenations of a series: at an end of the stack they would leave no hole."""
    parts_of: dict[str, set[Concatenation]] = defaultdict(set)
    for header in slices:
        if header.concatenation is not None:
            parts_of[header.concatenation.uid].add(header.concatenation)
    problems = []
    for parts in parts_of.values():
        there = {part.part for part in parts}
        last = max(max(part.parts or 0, part.part) for part in parts)
        missing = [str(number) for number in range(1, last + 1) if number not in there]
        if missing:
            files = f"file {missing[0]}" if len(missing) == 1 else f"files {join_names(missing)}"
            problems.append(
                f"{files} of the {last} of a concatenation {'is' if len(missing) == 1 else 'are'} missing "
                "(InConcatenationNumber (0020,9162))"
            )
            continue
        ends = {part.part: part.first_frame + part.frames for part in parts if part.first_frame is not None}
        if len(ends) < last:
            continue
        for part in sorted(parts, key=lambda part: part.part):
            before = ends.get(part.part - 1, 0)
            if part.first_frame is not None and part.first_frame != before:
                problems.append(
                    f"file {part.part} of a concatenation starts at frame {part.first_frame}, the one before it ends "
                    f"at frame {before} (ConcatenationFrameOffsetNumber (0020,9228))"
                )
    return problems


PROBLEMS_SHOWN = 3
_SLICE_MODALITIES = ("MR", "NM", "PT")
"""Other modalities whose files are slices: a corrupt file among them probably is one too."""


@dataclass
class Series:
    """One stack of a series, or a series that cannot be one.

    kind: {"stack", "localizer", "capture", "other"}. Only stacks are ever chosen; "other" is not CT.
    headers: Valid slices, unsorted.
    others: Its files that cannot be slices.
    corrupt: Files and folders that cannot be read and may be or contain slices of it.
    lost: Descriptions of missing files that leave no hole: parts of concatenations.
    census: Of all parts of the series.
    patient, study: Numbers among those scanned, from 1; 0 where the files do not tell.
    allow_gaps: Missing slices give a warning and are not a problem.
    is_file: One file was named, and not the folder of the series.
    """

    identity: SeriesIdentity
    kind: str
    headers: list[SliceHeader] = field(default_factory=list)
    others: list[OtherImage] = field(default_factory=list)
    corrupt: list[CorruptFile] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    census: Census = Census()
    number: int = 0
    patient: int = 0
    study: int = 0
    phase: int | None = None
    allow_gaps: bool = False
    is_file: bool = False

    @property
    def count(self) -> int:
        return len(self.headers) + sum(image.frames for image in self.others)

    @property
    def key(self) -> str:
        return _group_key((self.headers or self.others)[0])

    @cached_property
    def places(self) -> Places:
        """The slices without copies, and the phases among them; pixels are compared where slices share a place."""
        if self.kind != "stack" or len(self.headers) < 2:
            return Places(tuple(self.headers))
        places = group_places(self.headers)
        if len(places) == len(self.headers):
            return sort_places(places, have_same_pixels)
        with StoredPixels(self.headers) as source:
            return sort_places(places, partial(have_same_pixels, source=source))

    @cached_property
    def stack(self) -> Stack | None:
        """The measured geometry, of the wanted phase if there are several; None without a valid slice."""
        if not self.headers:
            return None
        if self.kind != "stack":
            return measure_stack(self.headers[:1])
        try:
            places = self.places
        except RefusedInputError:
            return measure_stack(self.headers[:1])  # `problems` tells why
        headers = places.headers
        if places.phases:
            headers = choose_phase(places, self.phase or 1).headers
        elif places.problem:
            headers = headers[:1]
        return measure_stack(headers, allow_gaps=self.allow_gaps)

    def find_doubt(self) -> str:
        """Describe an alternation along the stack that may still be one volume; empty if there is none."""
        try:
            return self.places.doubt
        except RefusedInputError:
            return ""

    @property
    def dropped(self) -> dict[str, int]:
        """Map a reason to the number of slices that are not in the stack although their headers are valid."""
        try:
            places = self.places
        except RefusedInputError:
            return {}
        phases = sum(len(phase.headers) for phase in places.phases)
        left = phases - len(choose_phase(places, self.phase).headers) if phases and self.phase else 0
        counts = {"copy of another slice": places.copies, "other phase": left}
        return {reason: count for reason, count in counts.items() if count}

    def choose(self, phase: int | None = None, *, allow_gaps: bool = False) -> Series:
        """Return the series with a phase chosen and gaps allowed, after a closer examination.

        Interleaved volumes are found by any element that alternates in the headers, which are read again for this;
        where it may within one volume, or a phase is wanted that no header distinguishes, by the pixels as well.
        """
        chosen = replace(self, phase=phase, allow_gaps=allow_gaps)
        try:
            chosen.__dict__["places"] = self._part_further(self.places, phase)
        except RefusedInputError:
            return chosen  # its `problems` tell why
        if phase is not None and (phase != 1 or chosen.places.phases):
            choose_phase(chosen.places, phase)
        return chosen

    def _part_further(self, places: Places, phase: int | None) -> Places:
        """Return phases by an alternation along a stack with one slice at each place."""
        if self.kind != "stack" or self.others or places.phases or places.problem or len(places.headers) < 2:
            return places
        stack = measure_stack(places.headers, allow_gaps=True)
        if stack.problems:
            return places
        places = replace(places, headers=stack.slices)
        alternation = find_alternation(stack.slices, not stack.line.uneven)
        if alternation is not None and alternation.certain:
            return part_alternating(places, alternation)
        if alternation is None and phase is None:
            return places
        likeness = judge_slices(read_voxels(stack.slices)[0], stack.tilt_deg, uneven=stack.line.uneven)
        if likeness is not None and likeness.is_mixed:
            return part_alternating(places, alternation or alternate_places(len(stack.slices), likeness.period))
        if alternation is None:
            return places
        doubt = f"{alternation.name} alternates along the stack: maybe several volumes between each other"
        return replace(places, doubt=doubt)

    @cached_property
    def problems(self) -> list[str]:
        """Reasons why this series is refused; empty if it is usable."""
        if self.kind == "other":
            return [f"modality {self.identity.modality} is not CT"]
        texts = [image.problem for image in self.others]
        problems = texts[:PROBLEMS_SHOWN]
        if len(texts) > PROBLEMS_SHOWN:
            problems.append(f"and {count_of(len(texts) - PROBLEMS_SHOWN, 'more file')} with a problem")
        if self.kind == "localizer":
            problems.append("localizer images, not a stack")
        if self.corrupt:
            linked = any(entry.reason == LINK_OUT for entry in self.corrupt)
            ways = "restore or remove them" + (f"; {advise_on_links()}" if linked else "")
            problems.append(
                f"files or folders that are cut, corrupt or not readable may belong to it ({ways}): "
                + join_names(self.corrupt)
            )
        if not texts:
            problems += self.lost
        # Bad files leave holes, whose message would only hide the cause.
        if self.kind == "stack" and not texts:
            problems += self._find_stack_problems()
        if self.kind == "stack" and self.is_file and len(self.headers) == 1:
            problems.append("the path names one file of a series: name the folder that holds them all")
        return problems

    def _find_stack_problems(self) -> list[str]:
        try:
            places = self.places
        except RefusedInputError as error:
            return [f"slices at one place cannot be compared: {error}"]
        if places.problem:
            return [places.problem]
        if places.phases and self.phase is None:
            return [describe_phases(places)]
        return list(self.stack.problems) if self.stack is not None else []

    def describe(self) -> str:
        """Describe the series in one line for a message, without its description, since people type names into it."""
        kind = "" if self.kind in ("stack", "other") else f", {self.kind}"
        return f"{self.number}: {self.identity.modality}, {self.count} slice{'s' * (self.count != 1)}{kind}"


def group_series(scan: Scan) -> list[Series]:
    """Group scanned files into numbered series.

    One SeriesInstanceUID (where it was removed: one folder) gives one `Series`, or several where it mixes planes,
    localizers or secondary captures with a stack.  Numbers follow (patient, study, SeriesNumber, SeriesInstanceUID,
    larger part first), not file names; patients and studies come in the order of their first series, unknown ones last.
    """
    slices: dict[str, list[SliceHeader]] = defaultdict(list)
    others: dict[str, list[OtherImage]] = defaultdict(list)
    for header in scan.slices:
        slices[_group_key(header)].append(header)
    for image in scan.others:
        others[_group_key(image)].append(image)
    censuses = take_census(slices, others)
    listed = []
    for uid, census in censuses.items():
        parts = _split_slices(slices[uid])
        lost = describe_missing_parts(slices[uid])
        for part in parts:
            part.lost = lost if part.kind == "stack" else []
        for kind in ("capture", "other", "broken"):
            images = [image for image in others[uid] if image.kind == kind]
            if not images:
                continue
            stacks = [part for part in parts if part.kind == "stack"]
            if kind == "broken" and stacks:
                max(stacks, key=lambda part: len(part.headers)).others = images
            else:
                parts.append(Series(images[0].series, "stack" if kind == "broken" else kind, others=images))
        for part in parts:
            part.census = census
        parts.sort(key=lambda part: (part.kind != "stack", -part.count))
        listed += parts
    listed.sort(key=lambda one: (one.identity.number is None, one.identity.number or 0, one.identity.uid))
    _number_patients_and_studies(listed)
    listed.sort(key=_owner_key(listed))
    for number, series in enumerate(listed, start=1):
        series.number, series.is_file = number, scan.is_file
    if scan.corrupt or scan.suspects:
        _blame_corrupt_files(listed, scan)
    return listed


def _number_patients_and_studies(listed: Sequence[Series]) -> None:
    """Number patients and studies in the order of the listing: a hash of a short ID could be reversed."""
    patients: dict[str, int] = {}
    studies: dict[str, int] = {}
    for series in listed:
        patient = next((header.patient_hash for header in series.headers if header.patient_hash), None)
        if patient is not None:
            series.patient = patients.setdefault(patient, len(patients) + 1)
        if series.identity.study:
            series.study = studies.setdefault(series.identity.study, len(studies) + 1)


def _owner_key(listed: Sequence[Series]) -> Callable[[Series], tuple[float, float]]:
    """Return a sort key by patient and by study, where there are several; unknown ones come last."""
    owners = {series.study: series.patient for series in listed if series.study and series.patient}
    for series in listed:
        series.patient = series.patient or owners.get(series.study, 0)
    patients = len({series.patient for series in listed} - {0}) > 1
    studies = len({series.study for series in listed} - {0}) > 1
    return lambda series: (
        (series.patient or math.inf) if patients else 0,
        (series.study or math.inf) if studies else 0,
    )


def _blame_corrupt_files(listed: Sequence[Series], scan: Scan) -> None:
    """Give every stack the unreadable files that may belong to it: a lost slice at its end would leave no hole.

    A corrupt file may belong to any stack, unless its folder holds slices of other series only; a suspect to a stack
    with slices in its folder, or in several folders where its own holds none.
    """
    holders: dict[Path, set[str]] = defaultdict(set)  # from folder to the series, by UID, with slices in it
    for series in listed:
        if series.kind == "capture" or series.kind == "other" and series.identity.modality not in _SLICE_MODALITIES:
            continue
        images: list[SliceHeader | OtherImage] = [*series.headers, *series.others]
        for image in images:
            holders[image.file.parent].add(_group_key(image))
    folders: dict[str, list[Path]] = defaultdict(list)  # from series to the folders with its slices
    for folder, keys in holders.items():
        for key in keys:
            folders[key].append(folder)
    # Every file is handled once and lists are shared, because 10,000 series may come with as many bad files.
    corrupt, loose_corrupt = _sort_by_holder(scan.corrupt, holders)
    suspects, loose_suspects = _sort_by_holder(scan.suspects, holders)
    for series in listed:
        if series.kind == "stack":
            paths = folders[series.key]
            spread = len(paths) > 1
            near = [files[folder] for files, folder in itertools.product((corrupt, suspects), paths) if folder in files]
            blamed = [part for part in (*near, loose_corrupt, loose_suspects if spread else []) if part]
            series.corrupt = blamed[0] if len(blamed) == 1 else list(itertools.chain(*blamed))


def _sort_by_holder(
    files: Sequence[CorruptFile], holders: Mapping[Path, object]
) -> tuple[dict[Path, list[CorruptFile]], list[CorruptFile]]:
    """Divide files by whether their folder holds slices; the second list is of files in other folders."""
    held_by: dict[Path, list[CorruptFile]] = defaultdict(list)
    loose: list[CorruptFile] = []
    for file in files:
        folder = file.file.parent
        (held_by[folder] if folder in holders else loose).append(file)
    return held_by, loose


def _group_key(image: SliceHeader | OtherImage) -> str:
    """Return the key that images of one series share: the UID, else the folder with the number if there is one."""
    return image.series.uid or f"{image.series.number} {image.file.parent}"


def _split_slices(headers: Sequence[SliceHeader]) -> list[Series]:
    """Divide the slices of one SeriesInstanceUID by plane, localizers first."""
    planes = Planes()
    parts: list[Series] = []
    known: dict[tuple[float, ...], Series] = {}
    localizers = [header for header in headers if header.localizer]
    for header in headers:
        if header.localizer:
            continue
        key = (*header.row_cosines, *header.column_cosines)
        if key not in known:
            number = planes.find(key)
            if number == len(parts):
                parts.append(Series(header.series, "stack"))
            known[key] = parts[number]
        known[key].headers.append(header)
    if localizers:
        parts.append(Series(headers[0].series, "localizer", localizers))
    return parts
