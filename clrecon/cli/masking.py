"""Options that remove the table and other things around the patient."""

from __future__ import annotations

import argparse

__all__ = ["add_masking"]


def add_masking(parser: argparse.ArgumentParser) -> None:
    """Declare ``--remove-table``, ``--allow-bone-loss`` and ``--fov``."""
    group = parser.add_argument_group("masking")
    group.add_argument(
        "--remove-table",
        action="store_true",
        help="turn what is not the patient's body into air first: table, blankets, cables",
    )
    group.add_argument(
        "--allow-bone-loss",
        action="store_true",
        help="go on where --remove-table takes more than 2 %% of the bone, which else is refused",
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


def _parse_radius(text: str) -> float | str:
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no radius in mm") from None
