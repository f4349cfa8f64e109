"""Names of directions in the patient, the views that are taken from them, and the sizes that pictures may have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.system.arguments import DirectionName, array_or_empty, name_parameter
from clrecon.system.text import unknown_name

DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "anterior": (0.0, -1.0, 0.0),
    "posterior": (0.0, 1.0, 0.0),
    "left": (1.0, 0.0, 0.0),
    "right": (-1.0, 0.0, 0.0),
    "superior": (0.0, 0.0, 1.0),
    "inferior": (0.0, 0.0, -1.0),
}
"""Unit vectors in LPS, from the middle of the patient to each side; the view of that name is taken from there."""

DEFAULT_SIZE = (1024, 1024)

LARGEST_SIDE = 16384
"""Largest number of pixels along a side of a picture; more is a typing error."""


def as_point(vector: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z


def checked_vector(subject: str, value: ArrayLike) -> tuple[float, float, float]:
    """Return three finite numbers as floats."""
    array = array_or_empty(value)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise UsageError(f"{subject} is three finite numbers in LPS mm, not {value!r}")
    return float(array[0]), float(array[1]), float(array[2])


def checked_size(size: Sequence[int]) -> tuple[int, int]:
    try:
        width, height = size
        if int(width) == width and int(height) == height:
            if 1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE:
                return int(width), int(height)
    except (TypeError, ValueError, OverflowError):
        pass
    raise UsageError(f"the size of a picture is (width, height) in pixels, each from 1 to {LARGEST_SIDE}, not {size!r}")


def find_view(view: str | Sequence[float]) -> tuple[Float64Array, Float64Array]:
    """Return the unit vectors in LPS from the patient to the camera of a view, and to the top of its picture.

    The top is the head; for a view along the body, the side of the azimuth, which is anterior for the views by name.

    view: A name of `DIRECTIONS`, or azimuth and elevation in degrees: azimuth turns the camera from anterior towards
        the patient's left, elevation (-90 to 90) lifts it to the head.
    """
    named = DIRECTIONS.get(view.strip().lower()) if isinstance(view, str) else None
    if named is not None:
        up = DIRECTIONS["superior"] if named[2] == 0.0 else DIRECTIONS["anterior"]
        return np.array(named), np.array(up)
    azimuth, elevation = _find_angles(view)
    # anterior, turned by the azimuth to the left; exact at quarter turns
    quarters, rest = divmod(azimuth, 90.0)
    sine, cosine = np.sin(np.radians(rest)), np.cos(np.radians(rest))
    for _ in range(int(quarters) % 4):
        sine, cosine = cosine, -sine
    around = np.array([sine, -cosine, 0.0])
    if abs(elevation) == 90.0:
        return np.array([0.0, 0.0, np.sign(elevation)]), around
    radians = np.radians(elevation)
    return np.cos(radians) * around + [0.0, 0.0, np.sin(radians)], np.array(DIRECTIONS["superior"])


def find_up(up: str | ArrayLike) -> Float64Array:
    """Return the direction in LPS for the top of a picture, from a name of `DIRECTIONS` or three numbers."""
    if isinstance(up, str):
        named = DIRECTIONS.get(up.strip().lower())
        if named is None:
            raise UsageError(f"unknown direction {up!r} for the top of a picture: use one of {', '.join(DIRECTIONS)}")
        return np.array(named)
    return np.array(checked_vector("the up direction of a picture", up))


def hint_at_sheet(word: object) -> str:
    """Return the end of a message about a view or a mode that means a contact sheet; empty for others."""
    if not isinstance(word, str) or word.strip().lower() not in ("sheet", "sheets", "contact-sheet"):
        return ""
    return f"; a contact sheet of slices is asked for with {name_parameter('sheet')}"


def read_view(text: str) -> DirectionName | tuple[float, float]:
    """Return the view that an option says: a name, or the pair of angles of ``AZ,EL``."""
    return _find_angles(text.split(","), text) if "," in text else cast("DirectionName", text)


def say_view(view: str | tuple[float, float]) -> str:
    """Return the text that `read_view` takes."""
    return view if isinstance(view, str) else f"{view[0]:g},{view[1]:g}"


def _find_angles(view: str | Sequence[str | float], typed: str | None = None) -> tuple[float, float]:
    try:
        azimuth, elevation = (float(part) for part in (() if isinstance(view, str) else view))
    except (TypeError, ValueError, OverflowError):
        azimuth = elevation = float("nan")
    if not (np.isfinite(azimuth) and abs(elevation) <= 90.0):
        form, example = ("(azimuth, elevation)", "(30, 15)") if typed is None else ("AZIMUTH,ELEVATION", "30,15")
        raise UsageError(
            f"{unknown_name('view', typed or view, DIRECTIONS)}, or {form} in degrees,"
            f" elevation from -90 to 90, such as {example}{hint_at_sheet(view)}"
        )
    return azimuth, elevation


ANTERIOR: DirectionName = "anterior"

SLICES_VIEWS = ((30.0, 30.0), (-60.0, 30.0), (75.0, -30.0))
"""Views of slices in space, the first for any axis.  Slices that are edge-on in one of them show in another."""

LEAST_COSINE = 0.25
"""Slices are shown by a view where its cosine to their normal is at least this: a quarter of their height is seen."""


def shows_slices(direction: Float64Array, grid: Grid) -> bool:
    """Tell whether slices of a grid are seen, and not edge-on, along a direction: a unit vector, LPS."""
    return _cosine_to_normal(direction, grid) >= LEAST_COSINE


def _cosine_to_normal(direction: Float64Array, grid: Grid) -> float:
    normal = np.cross(grid.affine[:3, 0], grid.affine[:3, 1])
    return abs(float(direction @ normal)) / float(np.linalg.norm(normal))


def default_view(mode: str, grid: Grid) -> DirectionName | tuple[float, float]:
    """Return the view of a mode in `render`: anterior, and for slices in space one from which they show."""
    if mode != "slices":
        return ANTERIOR
    directions = {view: find_view(view)[0] for view in SLICES_VIEWS}
    for view, direction in directions.items():
        if shows_slices(direction, grid):
            return view
    return max(directions, key=lambda view: _cosine_to_normal(directions[view], grid))
