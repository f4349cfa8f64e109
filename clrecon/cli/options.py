"""Options that several commands have: points, ``--hu``, reading an input, cropping and masking the scan."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli.common import add_fields
from clrecon.jobs.options import InputSettings


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
    """Add the options that say which part of an input is read."""
    add_fields(parser.add_argument_group("reading"), InputSettings, "reading")


_RULES = """\
Whole voxels outside of the box are left out, after --remove-table and --fov and before --region.
Surfaces end there as at the ends of a scan. Of several boxes, what is in all of them stays."""


def add_cropping(parser: argparse.ArgumentParser, frame: str = "of the frame of --space") -> None:
    """Declare ``--clip-box``, ``--between`` and ``--around``.

    frame: The frame of the numbers, for the help.
    """
    add_fields(parser.add_argument_group(f"crop, in mm {frame}", _RULES), InputSettings, "crop")


def add_masking(parser: argparse.ArgumentParser) -> None:
    """Declare the options that turn parts of the scan into air or work on its voxels."""
    add_fields(parser.add_argument_group("masking"), InputSettings, "masking")
