"""Options for reading an input: which part of it, and what is tolerated."""

from __future__ import annotations

import argparse


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add --series, --phase, --allow-gaps, --force, --follow-links and --rescale."""
    group = parser.add_argument_group("reading")
    group.add_argument(
        "--series",
        metavar="S",
        help='number, hash, UID (or the start of one) or description of the series, see "clrecon info" (default: the CT'
        " series with most slices; of similar ones original before derived, then the thinnest)",
    )
    group.add_argument(
        "--phase", type=int, metavar="N", help="number of the phase, of a series with several volumes at one place"
    )
    group.add_argument(
        "--allow-gaps",
        action="store_true",
        help="read a stack with missing slices: what is there is placed exactly, surfaces bridge the gap",
    )
    group.add_argument(
        "--force",
        action="store_true",
        help="read data sets without preamble or meta header too, their encoding guessed; leave out what is left"
        " over behind the pixels",
    )
    group.add_argument(
        "--follow-links",
        action="store_true",
        help="read the files and folders that symbolic links out of the folder lead to (git-annex, DataLad)",
    )
    group.add_argument(
        "--rescale",
        type=_parse_rescale,
        metavar="SLOPE,INTERCEPT",
        help="compute HU as SLOPE x stored value + INTERCEPT, regardless of the files, like 1,-1024",
    )


def _parse_rescale(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 2:
        raise argparse.ArgumentTypeError(f"{text!r} is no slope and intercept: SLOPE,INTERCEPT, such as 1,-1024")
    return numbers
