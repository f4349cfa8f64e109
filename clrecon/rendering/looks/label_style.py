"""`LabelStyle`: the colour and opacity that each label has in a picture."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.labels import LabelMap
from clrecon.rendering.looks.colors import find_color
from clrecon.system.base_classes import Message

NO_COLOR = (-1.0, -1.0, -1.0)
"""Colour in the table that means: keep the colour of the picture without labels."""

NO_LABEL = 0
"""Number of the voxels without a label: they can be made translucent or hidden, as labels can."""

GOLDEN_SHARE = 0.618034
"""Step from one hue to the next, as a share of the circle: any number of colours made with it stay distinct."""


@dataclass(frozen=True)
class LabelStyle(Message):
    """The look of the labels of a map; what is not named keeps its look, voxels without a label (0) too.

    table: ndarray, shape (largest number + 1, 4), float32. Red, green, blue and opacity by number, 0 to 1; red below 0
        keeps the colour of the picture without labels.
    """

    labels: LabelMap
    table: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        labels: LabelMap,
        colors: Mapping[int | str, str | Sequence[float]] | None = None,
        opacity: Mapping[int | str, float] | None = None,
    ) -> LabelStyle:
        """Choose colours and opacities.

        >>> LabelStyle.of(labels, colors={"L1": "orange"}, opacity={"L2": 0.2})

        colors: Labels by number or name as `LabelMap.find` takes them, colours as `find_color` does.  Labels that are
            not named keep the colour of the picture; without a mapping every label gets its own colour, see
            `distinct_colors`.
        opacity: 0 to 1: a factor on the opacity; labels that are not named keep theirs.  0 stands for all that has no
            label.
        """
        if not isinstance(labels, LabelMap):
            raise UsageError(f"labels are a LabelMap, see clrecon.read_labels, not {type(labels).__name__}")
        table = np.tile(np.array([*NO_COLOR, 1.0], dtype=np.float32), (int(labels.voxels.max()) + 1, 1))
        if colors is None:
            numbers = labels.numbers
            table[list(numbers), :3] = distinct_colors(len(numbers))
        for number, color in _by_number(labels, _COLORS, colors).items():
            table[number, :3] = find_color(color)
        for number, factor in _by_number(labels, "opacities", opacity).items():
            table[number, 3] = _check_opacity(_name(labels, number), factor)
        table.flags.writeable = False
        return cls(labels, table)

    @property
    def is_opaque(self) -> bool:
        """True when all labels have full opacity."""
        return bool((self.table[:, 3] >= 1.0).all())


_COLORS = "colours"


def find_shown(labels: LabelMap, label: int | str) -> int:
    """Return the number of a label, or 0 for what has no label."""
    return NO_LABEL if str(label).strip() == "0" else labels.find(label)


def _name(labels: LabelMap, number: int) -> str:
    return "0" if number == NO_LABEL else labels.name(number)


def _named(labels: LabelMap, number: int) -> str:
    return "0" if number == NO_LABEL else f"{number} {labels.name(number)}"


def _by_number(labels: LabelMap, what: str, mapping: Mapping | None) -> dict:
    if mapping is None:
        return {}
    if not isinstance(mapping, Mapping):
        raise UsageError(f"{what} of labels are a mapping such as {{'L2': ...}}, not {type(mapping).__name__}")
    found: dict = {}
    for label, value in mapping.items():
        number = find_shown(labels, label)
        if number == NO_LABEL and what == _COLORS:
            raise UsageError("what has no label (0) keeps the colours of the picture: it gets an opacity alone")
        if number in found:
            raise UsageError(f"{what} of labels: label {_named(labels, number)} is named twice")
        found[number] = value
    return found


def _check_opacity(name: str, factor: float) -> float:
    try:
        number = float(factor)
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if not 0.0 <= number <= 1.0:
        raise UsageError(f"the opacity of label {name} is a number from 0 to 1, not {factor!r}")
    return number


def distinct_colors(count: int) -> NDArray[np.float64]:
    """Return colours (count, 3) from 0 to 1 with distinct hues; the first ones are the same for every `count`."""
    hues = (0.08 + GOLDEN_SHARE * np.arange(count)) % 1.0
    bright = (0.95, 0.8)
    colors = [colorsys.hsv_to_rgb(hue, 0.55 + 0.2 * (n % 3 == 1), bright[n % 2]) for n, hue in enumerate(hues)]
    return np.array(colors, dtype=np.float64).reshape(count, 3)
