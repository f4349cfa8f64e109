"""``clrecon info``: the series of an input."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli.common import table
from clrecon.cli.console import Console, printable

__all__ = ["add_arguments", "run"]

_DESCRIPTION_WIDTH = 32


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = (
        'The series marked * is the one that "clrecon mesh" would use. Exit code 0 when there is one, 4 when the\n'
        "series found are refused (their problems are listed), 2 when there is no CT series."
    )
    parser.add_argument("input", metavar="INPUT", help="DICOM folder or file")
    parser.add_argument("--series", metavar="S", help="number or hash of the series to judge")


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.pipeline.info import describe_input

    found = describe_input(options.input, options.series, progress=console.progress)
    console.result(found.listing)
    for line in _describe_listing(found.listing):
        console.say(line)
    for note in found.notes:
        console.warn(note, with_json=True)
    if found.problem is not None:
        raise found.problem
    return 0


def _describe_listing(listing: dict[str, Any]) -> list[str]:
    rows: list[tuple[object, ...]] = [
        ("", "series", "hash", "kind", "slices", "columns x rows", "spacing mm", "tilt", "description")
    ]
    for entry in listing["series"]:
        ni_nj, spacing = "-", "-"
        if entry["shape_ijk"]:
            ni_nj = f"{entry['shape_ijk'][0]} x {entry['shape_ijk'][1]}"
        if entry["spacing_mm"]:
            spacing = " x ".join(f"{step:.4g}" for step in entry["spacing_mm"])
        tilt = "-" if entry["tilt_deg"] is None else f"{entry['tilt_deg']:.2f}"
        description = printable(entry["description"] or "")
        if len(description) > _DESCRIPTION_WIDTH:
            description = description[: _DESCRIPTION_WIDTH - 3] + "..."
        mark = "*" if entry["number"] == listing["chosen"] else " "
        rows.append(
            (
                mark,
                entry["number"],
                printable(entry["uid_hash"] or "-"),
                printable(entry["modality"]),
                entry["slices"],
                ni_nj,
                spacing,
                tilt,
                description,
            )
        )
    lines = table(rows, right=(1, 4))
    for entry in listing["series"]:
        lines += [f"series {entry['number']}: problem: {printable(text)}" for text in entry["problems"]]
        lines += [f"series {entry['number']}: warning: {printable(text)}" for text in entry["warnings"]]
    return lines
