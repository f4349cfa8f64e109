"""The listing of an input: its series, the one that a job would use, and whether that one can be trusted."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from clrecon.errors import ClreconError, NoDicomError, RefusedInputError
from clrecon.jobs.settings import InfoSettings
from clrecon.reading import list_selected
from clrecon.system.progress import Progress
from clrecon.system.records import name_schema


class InputListing(NamedTuple):
    """The listing of an input, as docs/contract.md has it.

    notes: Files that were passed over, series that were not chosen, and why none is chosen.
    problem: Why the command fails: no series can be used, the requested one cannot, or a gate failed.
    refused: Number of the series that was judged and cannot be used.
    """

    listing: dict[str, Any]
    notes: list[str]
    problem: ClreconError | None
    refused: int | None = None


def describe_input(
    source: str | Path, settings: InfoSettings | None = None, *, progress: Progress | None = None
) -> InputListing:
    """List the series of an input, a DICOM folder or file or a file of another format, and certify one."""
    settings = settings or InfoSettings()
    selected = list_selected(source, settings, pixels=settings.pixels, progress=progress)
    entries = [entry.as_dict() for entry in selected.series]
    listing = {"series": entries, "chosen": selected.chosen, "certificate": selected.certificate}
    listing = name_schema("info", listing)
    notes = list(selected.warnings)
    problem = selected.refusal
    refused = None
    if selected.chosen is not None:
        problem = _judge_entry(next(entry for entry in entries if entry["number"] == selected.chosen))
        if problem is None:
            return InputListing(listing, notes, _judge_gates(listing) if settings.strict else None)
        refused, listing["chosen"] = selected.chosen, None
        notes.append(str(problem))
    if settings.series is None and not settings.strict and any(not entry["problems"] for entry in entries):
        return InputListing(listing, notes, None, refused)
    notes.pop()  # the command ends with this problem
    return InputListing(listing, notes, problem, refused)


def _judge_entry(entry: dict[str, Any]) -> ClreconError | None:
    if not entry["problems"]:
        return None
    kind = RefusedInputError if entry["modality"] == "CT" else NoDicomError
    return kind(f"series {entry['number']} cannot be used: {'; '.join(map(str, entry['problems']))}")


def _judge_gates(listing: dict[str, Any]) -> ClreconError | None:
    failed = [f"{gate['name']}: {gate['text']}" for gate in listing["certificate"]["gates"] if gate["ok"] is False]
    if not failed:
        return None
    count = f"{len(failed)} gate{'s' * (len(failed) > 1)}"
    return RefusedInputError(f"series {listing['chosen']} fails {count}: {'; '.join(failed)}")
