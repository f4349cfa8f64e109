"""Points on the command line."""

from __future__ import annotations

import argparse


def parse_point(text: str) -> tuple[float, ...]:
    """Read ``X,Y,Z``, three numbers in mm."""
    try:
        point = tuple(float(part) for part in text.split(","))
    except ValueError:
        point = ()
    if len(point) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} is no point: three numbers in mm with commas, X,Y,Z")
    return point
