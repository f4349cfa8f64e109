"""What ``--hu`` may say."""

from __future__ import annotations

import argparse

__all__ = ["LEVELS_HELP", "parse_levels"]

LEVELS_HELP = "iso value in HU, inside is N and above; several with commas make one mesh each"


def parse_levels(text: str) -> tuple[float, ...]:
    """Read the value of ``--hu``: one number, or several with commas between them.

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
