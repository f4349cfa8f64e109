"""Checks of the fields of styles.  A check returns the value in its final form or refuses it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.looks.presets import find_preset
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.rendering.views.centre_line import Curve
from clrecon.system.arguments import number_or_nan

SPINE = "spine"
"""Value of a curve that stands for the spinal canal, which is found in the volume."""


def instance_of(noun: str, kind: type) -> Callable[[Any], Any]:

    def check_instance(value: Any) -> Any:
        if isinstance(value, kind):
            return value
        raise UsageError(f"the {noun} of a picture is a {kind.__name__} or None, not {type(value).__name__}")

    return check_instance


def one_of(names: Sequence[str], text: str) -> Callable[[Any], Any]:
    """Make a check of a name; the message is `text`, which lists the names, and the given value."""

    def check_name(value: Any) -> Any:
        if isinstance(value, str) and value in names:
            return value
        raise UsageError(f"{text}, not {value!r:.60}")

    return check_name


def number(text: str, is_fine: Callable[[float], bool]) -> Callable[[Any], float]:
    """Make a check of one number; the message is `text`, which describes it, and the given value."""

    def check_number(value: Any) -> float:
        checked = number_or_nan(value)
        if not math.isnan(checked) and is_fine(checked):
            return checked
        shown = f"{value:g}" if isinstance(value, float) else f"{value!r:.60}"
        raise UsageError(f"{text} {shown}")

    return check_number


def flag(name: str, value: Any) -> bool:
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    raise UsageError(f"{name} is True or False, not {value!r:.60}")


def color(value: Any) -> Any:
    """Check for a colour that `find_color` knows."""
    find_color(value)
    return value


def preset_or_function(value: Any) -> Any:
    """Check for the name of a preset, or a transfer function."""
    if isinstance(value, str):
        find_preset(value)
        return value
    return instance_of("transfer function", TransferFunction)(value)


def curve(value: Any) -> Any:
    """Check for a `Curve`, points that make one, or `SPINE`."""
    if isinstance(value, str):
        if value == SPINE:
            return value
        raise UsageError(f"a centre line is its points in LPS mm, or {SPINE!r} to look for it: not {value!r}")
    return value if isinstance(value, Curve) else Curve(value)


def slices(value: Any) -> int | tuple[int, ...]:
    """Check for an int above 0, or for different whole numbers; returns them in ascending order."""
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        if value < 1:
            raise UsageError(f"every {value}th slice cannot be shown: give 1 or more, or a list of slices")
        return int(value)
    try:
        numbers = np.asarray(value)
    except (TypeError, ValueError, OverflowError):
        numbers = np.empty(0)
    if numbers.ndim != 1 or not len(numbers) or numbers.dtype.kind not in "iu":
        raise UsageError(f"slices are a number (every n-th) or a list of whole numbers k, not {value!r:.60}")
    chosen = tuple(sorted(numbers.tolist()))
    if len(set(chosen)) < len(chosen):
        raise UsageError(f"slices are named twice: {value!r:.60}")
    return chosen


SHEET_SLICES = 20
"""Slices of a contact sheet for which no number is given."""


def sheet(value: Any) -> int | str:
    """Check for a number of slices, True for `SHEET_SLICES`, or for their distance as text; returns it as "5 mm"."""
    if value is True:
        return SHEET_SLICES
    if isinstance(value, int) and not isinstance(value, bool) and value >= 1:
        return value
    if isinstance(value, str):
        text = value.strip().lower()
        try:
            if not text.endswith("mm") and int(text) >= 1:
                return int(text)
            if text.endswith("mm") and 0.0 < float(text[:-2]) < math.inf:
                return f"{float(text[:-2]):g} mm"
        except ValueError:
            pass
    raise UsageError(f"a contact sheet has a number of slices, or their distance such as '5mm', not {value!r:.60}")


def mapping(subject: str) -> Callable[[Any], Any]:
    """Make a check for a mapping with labels as keys; `subject` names the values in the message."""

    def check_mapping(value: Any) -> Any:
        if isinstance(value, Mapping):
            return dict(value)
        raise UsageError(f"{subject} of labels are a mapping such as {{'L2': ...}}, not {type(value).__name__}")

    return check_mapping


smooth_light = number("the smoothing of light is a length in mm from 0 to 20, not", lambda mm: 0.0 <= mm <= 20.0)
ray_step = number("the ray step is a length in mm above 0, not", lambda mm: 0.0 < mm < math.inf)
