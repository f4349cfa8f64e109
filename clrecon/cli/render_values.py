"""Values of the options of ``clrecon render``, read from their texts."""

from __future__ import annotations

import argparse
import math
import os

from clrecon.jobs.render.settings import VIEWS


def _numbers(text: str, count: int, form: str) -> tuple[float, ...]:
    """Read a fixed number of numbers with commas between them."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count:
        raise argparse.ArgumentTypeError(f"{text!r} is not {form}")
    return values


def parse_center(text: str) -> tuple[float, ...]:
    """Read ``X,Y,Z`` in LPS mm."""
    return _numbers(text, 3, "a place X,Y,Z in LPS mm, such as -12,40,310")


def parse_picture_size(text: str) -> tuple[int, int]:
    """Read ``512`` or ``512x384`` as width and height."""
    parts = text.lower().split("x")
    try:
        width, height = (int(part) for part in (parts if len(parts) == 2 else (*parts, *parts)))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no size in pixels: write it as 1024 or 1024x768") from None
    return width, height


def parse_views(text: str) -> tuple[str, ...]:
    """Read ``left``, ``anterior,left,posterior`` or ``AZ,EL``: names or one pair of angles."""
    parts = tuple(part.strip().lower() for part in text.split(","))
    if all(part[:1].isalpha() for part in parts):
        return parts
    try:
        _azimuth, _elevation = (float(part) for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither names of views with commas between them ({', '.join(VIEWS)}; of slices axial,"
            " coronal, sagittal), nor one AZ,EL in degrees, such as 30,15: give --view again for further ones"
        ) from None
    return (",".join(parts),)


def parse_direction(text: str) -> str | tuple[float, ...]:
    """Read a name, or ``X,Y,Z``."""
    return _numbers(text, 3, "a side of the patient, nor a direction X,Y,Z in LPS") if "," in text else text.lower()


def parse_light(text: str) -> str | tuple[float, ...]:
    """Read ``head``, ``none``, a side of the patient, or ``X,Y,Z``."""
    return parse_direction(text)


def parse_window(text: str) -> str | tuple[float, ...]:
    """Read ``LOW,HIGH`` in HU, or the name of a window."""
    if text[:1].isalpha() and "," not in text:
        return text
    return _numbers(text, 2, "a window: the HU that are black and white, LOW,HIGH, such as -450,1050")


def parse_clip_plane(text: str) -> tuple[float, ...]:
    """Read ``PX,PY,PZ,NX,NY,NZ``: a point in LPS mm and a normal."""
    return _numbers(text, 6, "a plane: a point in LPS mm and the direction of the side that stays, PX,PY,PZ,NX,NY,NZ")


def parse_slices(text: str) -> int | tuple[int, ...]:
    """Read ``N`` (every N-th slice) or ``K,K,...`` (the slices of these numbers); ``K,`` is a single slice."""
    try:
        numbers = tuple(int(part) for part in text.split(",") if part.strip())
    except ValueError:
        numbers = ()
    if not numbers:
        raise argparse.ArgumentTypeError(f"{text!r} is no number N (every N-th slice) and no list of slices K,K,...")
    return numbers if "," in text else numbers[0]


def parse_label_color(text: str) -> tuple[str, str]:
    """Read ``LABEL=COLOUR``."""
    label, _, color = text.rpartition("=")
    if not label or not color:
        raise argparse.ArgumentTypeError(f"{text!r} is not LABEL=COLOUR, such as L2=red or 20=#ff8000")
    return label, color


def parse_label_opacity(text: str) -> tuple[str, float]:
    """Read ``LABEL=OPACITY``."""
    label, _, number = text.rpartition("=")
    try:
        opacity = float(number)
    except ValueError:
        opacity = math.nan
    if not label or math.isnan(opacity):
        raise argparse.ArgumentTypeError(f"{text!r} is not LABEL=OPACITY, such as L2=0.2")
    return label, opacity


def parse_mesh(text: str) -> tuple[str, str | None, float]:
    """Read ``FILE``, ``FILE=COLOUR`` or ``FILE=COLOUR,OPACITY``; a colour left empty is the default."""
    if "=" not in text or os.path.exists(text):
        return text, None, 1.0
    path, _, look = text.rpartition("=")
    color, comma, share = look.partition(",")
    try:
        opacity = float(share) if comma else 1.0
    except ValueError:
        opacity = math.nan
    if not path or not (color or comma) or math.isnan(opacity):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not FILE[=COLOUR[,OPACITY]], such as l3.stl=orange,0.4 or l3.stl=,0.4"
        )
    return path, color or None, opacity
