"""`read_series` and `list_scan` for DICOM, and what a listing says of each series."""

from __future__ import annotations

import os
import warnings as python_warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from clrecon.errors import NoDicomError, RefusedInputError, UsageError
from clrecon.geometry import Volume, column_spacing
from clrecon.geometry.certificate import Certificate
from clrecon.reading.common.likeness import judge_slices
from clrecon.reading.common.plausibility import examine_voxels
from clrecon.reading.common.selection import Selection, check_rescale
from clrecon.reading.common.source_facts import SeriesEntry, SeriesListing
from clrecon.reading.dicom.parse.elements import describe_way_out
from clrecon.reading.dicom.pixels.voxels import read_voxels
from clrecon.reading.dicom.series.certificate import (
    SeriesPixels,
    certify,
    collect_scan_warnings,
    collect_series_warnings,
    count_unknown,
)
from clrecon.reading.dicom.series.choice import choose_series, describe_left
from clrecon.reading.dicom.series.scan import (
    BARE_DATA_SET,
    LINK_OUT,
    Scan,
    advise_on,
    advise_on_links,
    is_text,
    scan_path,
)
from clrecon.reading.dicom.series.series import Series, group_series
from clrecon.reading.dicom.stack.fit import Stack, measure_extent, median_thickness
from clrecon.system.arguments import name_parameter
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import open_regular
from clrecon.system.pieces import side_by_side
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text, hash_uid, join_names


def make_entry(series: Series, warnings: Iterable[str] = ()) -> SeriesEntry:
    stack = series.stack
    affine = stack.affine if stack is not None and not series.problems else None
    first = stack.slices[0] if stack is not None else None
    headers = series.headers if stack is None or series.problems else stack.slices  # of a refused series all
    return SeriesEntry(
        number=series.number,
        uid_hash=hash_uid(series.identity.uid),
        description=series.identity.description,
        modality=series.identity.modality,
        slices=series.count,
        shape_ijk=None if first is None else [first.columns, first.rows, len(headers)],
        spacing_mm=None if affine is None else list(column_spacing(affine)),
        affine_ijk_to_lps_mm=None if affine is None else affine.tolist(),
        tilt_deg=None if stack is None or affine is None else stack.tilt_deg,
        grid_residual_max_mm=None if stack is None else stack.line.residual_max_mm,
        gap_mm={
            "min": stack.line.gap_min_mm if stack else None,
            "max": stack.line.gap_max_mm if stack else None,
            "median": stack.line.gap_median_mm if stack else None,
        },
        uneven=None if stack is None else stack.line.uneven,
        warnings=list(warnings),
        problems=list(series.problems),
        patient=series.patient or None,
        study=series.study or None,
        kind=series.kind,
        phases=_list_phases(series),
        extent_mm=None if stack is None or affine is None else measure_extent(stack),
        slice_thickness_mm=median_thickness(series.headers),
        dropped=series.dropped,
    )


def _list_phases(series: Series) -> list[dict[str, Any]]:
    try:
        phases = series.places.phases
    except RefusedInputError:
        return []
    return [
        {"number": phase.number, "keyword": phase.keyword, "value": phase.value, "slices": len(phase.headers)}
        for phase in phases
    ]


log = get_logger(__name__)

_START_BYTES = 512
_UNKNOWN = {"not DICOM", "NumPy array"}


def read_series(path: str | os.PathLike[str], selection: Selection, progress: Progress | None = None) -> Volume:
    """Read one CT series as a volume in HU and LPS mm, see `clrecon.read_volume`; slices rise along their normal.

    Source: DICOM PS3.3 C.7.6.2 (Image Plane), C.7.5.1 (padding), C.8.2.1 (CT image, rescale).
    """
    with _quiet_warnings():
        scan, listed = _scan_and_group(path, selection, progress)
        choice = choose_series(listed, selection.series)
        left = describe_left(listed, choice, selection.series)
        chosen = choice.series.choose(_checked_phase(selection), allow_gaps=selection.allow_gaps)
        stack = chosen.stack
        if chosen.problems or stack is None or stack.affine is None:
            raise RefusedInputError(_describe_refusal(chosen))
        pixels = _read_pixels(stack, progress)
    voxels, facts = pixels.voxels, pixels.facts
    warnings = [*collect_series_warnings(chosen), *_warn_of_pixels(pixels), *collect_scan_warnings(scan), *left]
    report = certify(chosen, stack, pixels, scan, stack.affine, warnings)
    log.info("series %d of %d read: %s voxels %s", chosen.number, len(listed), voxels.shape[::-1], voxels.dtype)
    log_warnings(log, report.warnings)
    return Volume(voxels, stack.affine, report, stack.slice_positions, hu_range=(facts.hu_min, facts.hu_max))


def list_slices(path: str | os.PathLike[str], selection: Selection) -> list[tuple[Path, int, int]]:
    """List the slices of the volume of `read_series`: file, frame there from 0, and number of frames of the file."""
    with _quiet_warnings():
        _, listed = _scan_and_group(path, selection, None)
        choice = choose_series(listed, selection.series)
        chosen = choice.series.choose(_checked_phase(selection), allow_gaps=selection.allow_gaps)
        if chosen.problems or chosen.stack is None:
            raise RefusedInputError(_describe_refusal(chosen))
        return [(header.file, header.frame, header.frames) for header in chosen.stack.slices]


class StackPlace(NamedTuple):
    """A stack of CT slices: its number, the nearest folder that holds it, and the words that name its series there."""

    number: int
    folder: Path
    series: str


def list_stacks(path: str | os.PathLike[str], selection: Selection) -> list[StackPlace]:
    """List the CT stacks at a path, refused ones too, by the smallest folders from which they can be read alone."""
    with _quiet_warnings():
        _, listed = _scan_and_group(path, selection, None)
    counts = Counter(hash_uid(series.identity.uid) for series in listed)
    stacks = []
    for series in listed:
        uid_hash = hash_uid(series.identity.uid)
        if series.kind != "stack":
            continue
        if uid_hash is None or counts[uid_hash] > 1 or not series.headers:
            stacks.append(StackPlace(series.number, Path(path), str(series.number)))
        else:
            folder = os.path.commonpath({header.file.parent for header in series.headers})
            stacks.append(StackPlace(series.number, Path(folder), uid_hash))
    return stacks


def _checked_phase(selection: Selection) -> int | None:
    phase = selection.phase
    if phase is None or isinstance(phase, int) and not isinstance(phase, bool) and phase >= 1:
        return phase
    raise UsageError(f"a phase is a number from 1, not {phase!r}")


def list_scan(
    path: str | os.PathLike[str], selection: Selection, *, pixels: bool = False, progress: Progress | None = None
) -> SeriesListing:
    """List the series at a path with their problems, and the certificate of the chosen one, for `pixels` read too."""
    phase = _checked_phase(selection)
    with _quiet_warnings():
        scan, listed = _scan_and_group(path, selection, progress)
        warnings = collect_scan_warnings(scan)
        number = certificate = refusal = None
        try:
            choice = choose_series(listed, selection.series)
        except (NoDicomError, RefusedInputError) as error:
            refusal = error
            warnings.append(str(error))
        else:
            chosen = choice.series
            number = chosen.number
            warnings += describe_left(listed, choice, selection.series)
            judged = chosen.choose(phase, allow_gaps=selection.allow_gaps)
            listed = [judged if one is chosen else one for one in listed]
            certificate = _certify_chosen(judged, scan, warnings, pixels, progress)
        entries = [make_entry(one, collect_series_warnings(one)) for one in listed]
        if certificate is not None:  # its pixels may show more than its headers
            new_warnings = [text for text in certificate.warnings if text not in warnings]
            entries = [replace(entry, warnings=new_warnings) if entry.number == number else entry for entry in entries]
    return SeriesListing(entries, number, dict(scan.skipped), warnings, certificate, refusal)


def _certify_chosen(
    series: Series, scan: Scan, notes: Sequence[str], pixels: bool, progress: Progress | None
) -> Certificate | None:
    """Return the certificate of one series, None without a valid header; `notes` are warnings about the other files."""
    stack = series.stack
    if stack is None or series.kind == "other":
        return None
    read, warnings = None, collect_series_warnings(series)
    affine = None if series.problems else stack.affine
    if pixels and affine is not None:
        read = _read_pixels(stack, progress)
        warnings += _warn_of_pixels(read)
    return certify(series, stack, read, scan, affine, [*warnings, *notes])


def _read_pixels(stack: Stack, progress: Progress | None) -> SeriesPixels:
    voxels, facts = read_voxels(stack.slices, progress)
    likeness, findings = side_by_side(
        lambda: judge_slices(voxels, stack.tilt_deg, uneven=stack.line.uneven),
        lambda: examine_voxels(voxels, facts, stack.slices, known=not count_unknown(stack.slices)),
    )
    return SeriesPixels(voxels, facts, likeness, findings)


def _warn_of_pixels(pixels: SeriesPixels) -> list[str]:
    likeness = pixels.likeness
    mixed = [f"{likeness}, {name_parameter('phase')} takes one"] if likeness is not None and likeness.is_mixed else []
    return [*mixed, *pixels.findings.warnings]


@contextmanager
def _quiet_warnings() -> Iterator[None]:
    """Keep the parser's Python warnings off standard error: our own checks and report cover all that matters."""
    with python_warnings.catch_warnings():
        python_warnings.simplefilter("ignore")
        yield


def _describe_single(path: Path) -> str:
    """Say what a file is that was named as a scan, and what is read as one."""
    with open_regular(path) as file:
        kind = "it is text, not a scan; " if is_text(file.read(_START_BYTES)) else ""
    return f"{kind}scans are folders or files of DICOM, and NIfTI, NRRD and MetaImage files"


def _scan_and_group(
    path: str | os.PathLike[str], selection: Selection, progress: Progress | None
) -> tuple[Scan, list[Series]]:
    try:
        folder = Path(path)
        empty = not os.fspath(path).strip()  # Path("") is the current folder
    except TypeError as error:
        raise UsageError(f"a path is a string or a path object, not {type(path).__name__}") from error
    if empty:
        raise UsageError("the input path is empty")
    scan = scan_path(folder, progress, force=selection.force, follow_links=selection.follow_links)
    rescale = check_rescale(selection.rescale)
    if rescale is not None:
        scan.rescale = rescale
        scan.slices = [
            replace(
                header,
                slope=rescale.slope,
                intercept=rescale.intercept,
                has_slope=True,
                has_intercept=True,
                rescale_type="HU",
                modality_lut=False,
                warnings=(*header.warnings, str(rescale)),
            )
            for header in scan.slices
        ]
    if not scan.slices and not scan.others:
        shown = escape_text(str(path), 256)
        if scan.skipped["corrupt"]:
            raise RefusedInputError(f"no readable DICOM file in {shown}, corrupt: {join_names(map(str, scan.corrupt))}")
        reasons = ", ".join(f"{reason}: {count}" for reason, count in sorted(scan.skipped.items()))
        looked = f"{scan.files} file{'s' * (scan.files != 1)} looked at" + (f" ({reasons})" if reasons else "")
        hint = "; a DICOMDIR only lists files: name the folder that holds them" if scan.skipped["DICOMDIR"] else ""
        packed = advise_on(scan.skipped)
        hint += f"; {packed}" if packed else ""
        bare = sum(suspect.reason.startswith(BARE_DATA_SET) for suspect in scan.suspects)
        hint += f"; {bare} like {BARE_DATA_SET} ({describe_way_out()})" if bare else ""
        hint += f"; {advise_on_links()}" if scan.skipped[LINK_OUT] else ""
        hint += f"; {_describe_single(folder)}" if folder.is_file() and _UNKNOWN & set(scan.skipped) else ""
        raise NoDicomError(f"no DICOM images in {shown}: {looked}{hint}")
    listed = group_series(scan)
    log.debug("%d files: %d slices in %d series, skipped %s", scan.files, len(scan.slices), len(listed), scan.skipped)
    return scan, listed


def _describe_refusal(series: Series) -> str:
    return f"series {series.number}: " + "; ".join(series.problems)
