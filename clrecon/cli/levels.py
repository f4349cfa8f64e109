"""What ``--hu`` may say."""

from __future__ import annotations

import argparse
from typing import Any

__all__ = ["LEVELS_HELP", "parse_hu", "parse_levels"]

LEVELS_HELP = (
    "iso value in HU, inside is N and above; several with commas make one mesh each;"
    " auto: half way between bone and the tissue beside it, measured in the scan;"
    " half:BONE,TISSUE: half way between these two"
)
_HALF = "half:"


def parse_hu(text: str) -> dict[str, Any]:
    """Read the value of ``--hu``: numbers, ``auto`` or ``half:BONE,TISSUE``; returns entries of `MeshSettings`.

    Raises
    ------
    argparse.ArgumentTypeError
        It is none of them.
    """
    if text == "auto":
        return {"half_way": "auto"}
    if not text.startswith(_HALF):
        return {"iso_value": parse_levels(text)}
    materials = parse_levels(text.removeprefix(_HALF))
    if len(materials) != 2:
        raise argparse.ArgumentTypeError(f"{text!r} does not name two materials in HU, as half:1200,40 does")
    return {"half_way": materials}


def parse_levels(text: str) -> tuple[float, ...]:
    """Read one number, or several with commas between them.

    Raises
    ------
    argparse.ArgumentTypeError
        Something in it is no number; the message says which part.
    """
    levels = []
    for part in text.split(","):
        try:
            levels.append(float(part))
        except ValueError:
            where = f" in {text!r}" if part != text else ""
            raise argparse.ArgumentTypeError(f"{part!r}{where} is no number of HU") from None
    return tuple(levels)
