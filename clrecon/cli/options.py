"""Options that several commands have: points, ``--hu``, reading an input, cropping and masking the scan."""

from __future__ import annotations

import argparse
import math
from typing import Any

from clrecon.jobs.options import PREPROCESS_FORMS, REGION_FORMS


def parse_point(text: str) -> tuple[float, ...]:
    """Read ``X,Y,Z``, three numbers in mm."""
    try:
        point = tuple(float(part) for part in text.split(","))
    except ValueError:
        point = ()
    if len(point) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} is no point: three numbers in mm with commas, X,Y,Z")
    return point


LEVELS_HELP = (
    "iso value in HU, inside is N and above; A:B is a range, inside is from A to B; several with commas make one mesh"
    " each;"
    " auto: half way between bone and the tissue beside it, measured in the scan;"
    " half:BONE,TISSUE: half way between these two"
)
_HALF = "half:"


def parse_hu(text: str) -> dict[str, Any]:
    """Read the value of ``--hu``: numbers, ranges, ``auto`` or ``half:BONE,TISSUE`` as entries of `MeshSettings`."""
    if text == "auto":
        return {"half_way": "auto"}
    if not text.startswith(_HALF):
        return {"iso_value": tuple(_parse_level(part, text) for part in text.split(","))}
    materials = parse_levels(text.removeprefix(_HALF))
    if len(materials) != 2:
        raise argparse.ArgumentTypeError(f"{text!r} does not name two materials in HU, as half:1200,40 does")
    return {"half_way": materials}


def _parse_level(part: str, text: str) -> float | tuple[float, float]:
    """Read a number, or the two ends of a range A:B."""
    if ":" not in part:
        return parse_levels(part, text)[0]
    ends = part.split(":")
    if len(ends) != 2 or not all(ends):
        where = f" in {text!r}" if part != text else ""
        raise argparse.ArgumentTypeError(
            f"{part!r}{where} is no range A:B of two numbers of HU; from A on is --hu A, below B is --below B"
        )
    low, high = (parse_levels(end, text)[0] for end in ends)
    return low, high


def parse_levels(text: str, whole: str | None = None) -> tuple[float, ...]:
    """Read one number, or several with commas between them; `whole` is the full text of which `text` is a part."""
    levels = []
    for part in text.split(","):
        try:
            levels.append(float(part))
        except ValueError:
            where = f" in {whole or text!r}" if part != (whole or text) else ""
            raise argparse.ArgumentTypeError(f"{part!r}{where} is no number of HU") from None
    return tuple(levels)


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add --series, --phase, --allow-gaps, --force, --follow-links and --rescale."""
    group = parser.add_argument_group("reading")
    group.add_argument(
        "--series",
        metavar="S",
        help='number, hash, UID (or the start of one) or description of the series, see "clrecon info" (default: the CT'
        " series with most slices; of similar ones original before derived, then the thinnest)",
        first=True,
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
    return _parse_box_numbers(
        text, 6, "is no box: X0,X1,Y0,Y1,Z0,Z1 in mm, a side that stays open empty, such as ,,-50,20,,", ends=True
    )


def _parse_between(text: str) -> tuple[float, ...]:
    return _parse_box_numbers(
        text, 2, "are no two heights: Z0,Z1 in mm, one of them may be empty, such as -450,-400", ends=True
    )


def _parse_around(text: str) -> tuple[float, ...]:
    return _parse_box_numbers(text, 4, "is no point and length: X,Y,Z,R in mm, such as 10,-124,-424,30", ends=False)


def _parse_box_numbers(text: str, count: int, fault: str, *, ends: bool) -> tuple[float, ...]:
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


def add_masking(parser: argparse.ArgumentParser) -> None:
    """Declare ``--remove-table``, ``--allow-bone-loss``, ``--fov``, ``--region`` and ``--preprocess``."""
    group = parser.add_argument_group("masking")
    group.add_argument(
        "--remove-table",
        action="store_true",
        help="turn what is not the patient's body into air first: table, blankets, cables",
        first=True,
    )
    group.add_argument(
        "--allow-bone-loss",
        action="store_true",
        help="go on where --remove-table takes more than 2 %% of the bone, or a step of --preprocess more than half of"
        " what is at the level and above, which else is refused",
    )
    group.add_argument(
        "--fov",
        dest="field_of_view",
        nargs="?",
        const="auto",
        default=None,
        type=_parse_radius,
        metavar="RADIUS_MM",
        help="turn what lies further from the centre of the slices into air first (without a number: the largest circle"
        " that fits the slice)",
    )
    group.add_argument(
        "--region",
        action="append",
        metavar="RULE",
        help=f"turn what lies outside of the region of interest into air first: {REGION_FORMS}; several of one kind add"
        " up, of different kinds cut each other; a seed grows within the others; a tube without a file goes along the"
        " spinal canal",
    )
    group.add_argument(
        "--preprocess",
        metavar="STEP[,STEP...]",
        help=f"steps before the surface, in this order: {PREPROCESS_FORMS}; morphology works on what is at the iso"
        " value and above, or at level:HU; region is the place of --region, which else comes first",
    )


def _parse_radius(text: str) -> float | str:
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no radius in mm") from None
