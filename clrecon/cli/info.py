"""``clrecon info``: the listing of an input, with its series."""

from __future__ import annotations

import argparse

from clrecon.cli.common import pick
from clrecon.cli.console import Console
from clrecon.cli.reading import add_reading


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = (
        'The series marked * is the one that "clrecon mesh" would use; beneath the table stands what is known of it,\n'
        "and the gates that it is held against. Only headers are read, unless --pixels is given. Exit code 0 when\n"
        "there is a series that can be used, 4 when the series found are refused (their problems are listed) or a\n"
        "gate failed with --strict, 2 when there is no CT series."
    )
    parser.add_argument("input", metavar="INPUT", help="DICOM folder or file, or a NIfTI, NRRD or MetaImage file")
    parser.add_argument(
        "--pixels",
        action="store_true",
        help="read the pixels of the series marked * too: share of padding, range of HU, saturated metal",
    )
    parser.add_argument(
        "--strict", action="store_true", help="exit with 4 when it fails a gate, see docs/certificate.md"
    )
    add_reading(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.jobs.info import describe_input

    found = describe_input(
        options.input,
        **pick(options, ("series", "phase", "allow_gaps", "force", "follow_links", "rescale", "pixels", "strict")),
        progress=console.progress,
    )
    console.result(found.listing)
    if not options.json and not options.quiet:
        from clrecon.cli.certificate import describe_certificate
        from clrecon.cli.series_table import render_listing

        lines = render_listing(found.listing, describe_certificate(found.listing["certificate"]), found.refused)
        for line in lines:
            console.say(line)
    for note in found.notes:
        console.warn(note, with_json=True)
    if found.problem is not None:
        raise found.problem
    return 0
