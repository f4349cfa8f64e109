"""Which series an input holds, and which one a job would use."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from clrecon.errors import ClreconError, NoDicomError, RefusedInputError, UsageError
from clrecon.pipeline.progress import Progress

__all__ = ["InputListing", "describe_input"]


class InputListing(NamedTuple):
    """What an input holds.

    Attributes
    ----------
    listing : dict
        ``{"series": [...], "chosen": number or None}``; each entry is ``{"number", "uid_hash", "description",
        "modality", "slices", "shape_ijk", "spacing_mm", "affine_ijk_to_lps_mm", "tilt_deg",
        "grid_residual_max_mm", "gap_mm": {"min", "max"}, "uneven", "warnings", "problems"}``.  ``chosen`` is what
        a job would use, None where it would refuse.
    notes : list of str
        Files that were passed over, series that were left, why none is chosen.
    problem : ClreconError or None
        Why no series at all can be used.
    """

    listing: dict[str, Any]
    notes: list[str]
    problem: ClreconError | None


def describe_input(source: str | Path, series: str | None = None, *, progress: Progress | None = None) -> InputListing:
    """List the series of an input.

    Parameters
    ----------
    source : path
        DICOM folder or file.
    series : str, optional
        Number, hash or description of the series to judge; None leaves the choice to the reader, and any usable
        series is enough then.
    progress : callable, optional

    Returns
    -------
    InputListing

    Raises
    ------
    NoDicomError, RefusedInputError, UsageError
        Nothing to list, all files corrupt, or not exactly one series answers to `series`.
    """
    from clrecon.dicom import list_series

    found = list_series(source, progress=progress)
    entries = [entry.as_dict() for entry in found.series]
    notes = list(found.warnings)
    chosen = found.chosen if series is None else _find(entries, series)["number"]
    listing: dict[str, Any] = {"series": entries, "chosen": chosen}
    if chosen is not None:
        problem = _judge(next(entry for entry in entries if entry["number"] == chosen))
        if problem is None:
            return InputListing(listing, notes, None)
        listing["chosen"] = None
        if series is not None:
            return InputListing(listing, notes, problem)
        notes.append(str(problem))
    if any(not entry["problems"] for entry in entries):
        return InputListing(listing, notes, None)
    kind = RefusedInputError if any(entry["modality"] == "CT" for entry in entries) else NoDicomError
    return InputListing(listing, notes[:-1], kind(notes[-1] if notes else "no series can be used"))


def _find(entries: list[dict[str, Any]], series: str) -> dict[str, Any]:
    wanted = series.strip()
    folded = wanted.casefold()
    matches = [entry for entry in entries if entry["uid_hash"] == wanted]
    matches = matches or [entry for entry in entries if str(entry["number"]) == wanted]
    matches = matches or [entry for entry in entries if str(entry["description"]).casefold() == folded]
    if len(matches) == 1:
        return matches[0]
    have = ", ".join(f"{entry['number']} ({entry['uid_hash']})" for entry in entries)
    what = "is not there" if not matches else f"names {len(matches)} series"
    raise UsageError(f"series {series!r} {what}; the input holds {have}")


def _judge(entry: dict[str, Any]) -> ClreconError | None:
    if not entry["problems"]:
        return None
    kind = RefusedInputError if entry["modality"] == "CT" else NoDicomError
    return kind(f"series {entry['number']} cannot be used: {'; '.join(map(str, entry['problems']))}")
