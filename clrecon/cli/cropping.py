"""Options that crop the scan to a part of it."""

from __future__ import annotations

import argparse
import math

_RULES = """\
Whole voxels outside of the box are left out, after --remove-table and --fov and before --region.
Surfaces end there as at the ends of a scan. Of several boxes, what is in all of them stays."""


def add_cropping(parser: argparse.ArgumentParser, frame: str = "of the frame of --space") -> None:
    """Declare ``--clip-box``, ``--between`` and ``--around``.

    frame: The frame of the numbers, for the help.
    """
    group = parser.add_argument_group(f"crop, in mm {frame}", _RULES)
    group.add_argument(
        "--clip-box",
        type=parse_clip_box,
        metavar="X0,X1,Y0,Y1,Z0,Z1",
        help="keep a box; a side that is left empty is open",
    )
    group.add_argument("--between", type=_parse_between, metavar="Z0,Z1", help="keep what lies between two heights")
    group.add_argument(
        "--around", type=_parse_around, metavar="X,Y,Z,R", help="keep a cube: R mm from a point to each side"
    )


def parse_clip_box(text: str) -> tuple[float, ...]:
    """Read ``X0,X1,Y0,Y1,Z0,Z1`` in mm; an empty number leaves that side open."""
    return _read(
        text, 6, "is no box: X0,X1,Y0,Y1,Z0,Z1 in mm, a side that stays open empty, such as ,,-50,20,,", ends=True
    )


def _parse_between(text: str) -> tuple[float, ...]:
    return _read(text, 2, "are no two heights: Z0,Z1 in mm, one of them may be empty, such as -450,-400", ends=True)


def _parse_around(text: str) -> tuple[float, ...]:
    return _read(text, 4, "is no point and length: X,Y,Z,R in mm, such as 10,-124,-424,30", ends=False)


def _read(text: str, count: int, fault: str, *, ends: bool) -> tuple[float, ...]:
    """Read numbers between commas; with `ends` an empty one is an open side, downward and upward in turns."""
    try:
        values = tuple(
            math.copysign(math.inf, place % 2 - 0.5) if ends and not part.strip() else float(part)
            for place, part in enumerate(text.split(","))
        )
    except ValueError:
        values = ()
    if len(values) != count:
        raise argparse.ArgumentTypeError(f"{text!r} {fault}")
    return values
