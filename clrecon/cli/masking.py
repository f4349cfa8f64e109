"""Options that remove the table and other things around the patient."""

from __future__ import annotations

import argparse

from clrecon.jobs.options import PREPROCESS_FORMS, REGION_FORMS


def add_masking(parser: argparse.ArgumentParser) -> None:
    """Declare ``--remove-table``, ``--allow-bone-loss``, ``--fov``, ``--region`` and ``--preprocess``."""
    group = parser.add_argument_group("masking")
    group.add_argument(
        "--remove-table",
        action="store_true",
        help="turn what is not the patient's body into air first: table, blankets, cables",
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
