"""Labels in pictures: the colour and opacity of each, and how they lie over grey slices."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.labels import LabelMap, file_suffixes
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.views.reformation import Sheet
from clrecon.system.arguments import number_or_nan
from clrecon.system.base_classes import Message
from clrecon.system.light_dataclass import dataclass
from clrecon.system.text import to_hexadecimal

NO_COLOR = (-1.0, -1.0, -1.0)
"""Colour in the table that means: keep the colour of the picture without labels."""

NO_LABEL = 0
"""Number of the voxels without a label: they can be made translucent or hidden, as labels can."""

_GOLDEN_SHARE = 0.618034
"""Step from one hue to the next, as a share of the circle: any number of colours made with it stay distinct."""


@dataclass(frozen=True)
class LabelStyle(Message):
    """The look of the labels of a map; what is not named keeps its look, voxels without a label (0) too.

    table: Shape (largest number + 1, 4). Red, green, blue and opacity by number, 0 to 1; red below 0 keeps the colour
        of the picture without labels.
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

        colors: Labels by number or name as `LabelMap.find` takes them.  Labels that are not named keep the colour of
            the picture; without a mapping every label gets its own, see `distinct_colors`.
        opacity: 0 to 1: a factor on the opacity; labels that are not named keep theirs.  0 is all that has no label.
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
            table[number, 3] = _check_opacity("0" if number == NO_LABEL else labels.name(number), factor)
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


def _by_number(labels: LabelMap, subject: str, mapping: Mapping | None) -> dict:
    if mapping is None:
        return {}
    if not isinstance(mapping, Mapping):
        raise UsageError(f"{subject} of labels are a mapping such as {{'L2': ...}}, not {type(mapping).__name__}")
    by_number: dict = {}
    for label, value in mapping.items():
        number = find_shown(labels, label)
        if number == NO_LABEL and subject == _COLORS:
            raise UsageError("what has no label (0) keeps the colours of the picture: it gets an opacity alone")
        if number in by_number:
            shown = "0" if number == NO_LABEL else f"{number} {labels.name(number)}"
            raise UsageError(f"{subject} of labels: label {shown} is named twice")
        by_number[number] = value
    return by_number


def _check_opacity(name: str, factor: float) -> float:
    number = number_or_nan(factor)
    if not 0.0 <= number <= 1.0:
        raise UsageError(f"the opacity of label {name} is a number from 0 to 1, not {factor!r}")
    return number


def distinct_colors(count: int) -> NDArray[np.float64]:
    """Return colours (count, 3) from 0 to 1 with distinct hues; the first ones are the same for every `count`."""
    hues = (0.08 + _GOLDEN_SHARE * np.arange(count)) % 1.0
    bright = (0.95, 0.8)
    colors = [colorsys.hsv_to_rgb(hue, 0.55 + 0.2 * (n % 3 == 1), bright[n % 2]) for n, hue in enumerate(hues)]
    return np.array(colors, dtype=np.float64).reshape(count, 3)


ROWS_AT_ONCE = 128
TIES = 1e-6
"""Tolerance in index steps: half-way between two labels the lower index wins, independent of rounding."""

FILL = 0.3
"""Share of its colour within a label for which none is given: the scan stays to be read under it."""

_OUTLINE_SHARE = 1 / 400
"""Width of outlines as a share of the shorter side of a picture; a pixel at least."""


def labels_on_sheet(labels: LabelMap, sheet: Sheet) -> NDArray[Any]:
    """Return the label at the centre of each pixel of a sheet, (h, w), looked up in the map in mm; 0: none."""
    size = np.array(labels.shape_ijk)
    numbers = np.zeros((sheet.height, sheet.width), labels.voxels.dtype)
    for first in range(0, sheet.height, ROWS_AT_ONCE):
        points = sheet.points(slice(first, first + ROWS_AT_ONCE))
        ijk = np.floor(labels.lps_to_ijk(points.reshape(-1, 3)) + (0.5 - TIES)).astype(np.int64)
        inside = ((ijk >= 0) & (ijk < size)).all(axis=1)
        i, j, k = ijk[inside].T
        part = numbers[first : first + ROWS_AT_ONCE].reshape(-1)
        part[inside] = labels.voxels[k, j, i]
    return numbers


def draw_labels(
    image: NDArray[np.uint8],
    numbers: NDArray[Any],
    look: LabelStyle,
    tints: Mapping[int | str, float] | None = None,
    width: int | None = None,
) -> NDArray[np.uint8]:
    """Draw labels over a copy of a picture (h, w, 4), an outline in the colour of each and a share of it within.

    image: Pixels with opacity 0 show nothing of the scan and stay as they are.
    numbers: Label of each pixel, 0 for none.
    look: Labels without a colour, and those with opacity 0, are not drawn.
    tints: Share of its colour that the inside of a label gets; others get `FILL`.
    width: Of outlines, in pixels inwards; default: a 400th of the shorter side, a pixel at least.
    """
    table = look.table
    drawn = (table[:, 0] >= 0.0) & (table[:, 3] > 0.0)
    drawn[0] = False
    shares = np.full(len(table), FILL, np.float32)
    for label, share in (tints or {}).items():
        shares[find_shown(look.labels, label)] = share
    is_labelled = drawn[numbers] & (image[..., 3] > 0)
    wide = max(1, round(_OUTLINE_SHARE * min(numbers.shape))) if width is None else width
    # pixels from which another label, or none, is at most `wide` steps away
    edges = np.zeros(numbers.shape, dtype=bool)
    for step in range(1, wide + 1):
        for axis in (0, 1):
            if step < numbers.shape[axis]:
                here, there = [slice(None)] * 2, [slice(None)] * 2
                here[axis], there[axis] = slice(None, -step), slice(step, None)
                differ = numbers[tuple(here)] != numbers[tuple(there)]
                edges[tuple(here)] |= differ
                edges[tuple(there)] |= differ
    amount = np.where(edges, np.float32(1.0), shares[numbers])[..., None]
    colors = 255.0 * table[numbers][..., :3]
    drawn_image = image.copy()
    mixed = amount * colors + (1.0 - amount) * image[..., :3]
    drawn_image[..., :3] = np.where(is_labelled[..., None], np.rint(mixed).astype(np.uint8), image[..., :3])
    return drawn_image


def list_legend(look: LabelStyle) -> list[tuple[str, str]]:
    """Return the colour (#rrggbb) and name, as files can have it, of each label that is coloured and not hidden."""
    numbers = [n for n in look.labels.numbers if look.table[n, 0] >= 0.0 and look.table[n, 3] > 0.0]
    names = file_suffixes({n: look.labels.name(n) for n in numbers})
    return [(to_hexadecimal(look.table[n, :3]), names[n]) for n in numbers]


def facts_of_overlay(numbers: NDArray[Any], look: LabelStyle) -> list[dict[str, Any]]:
    """Return number, name (one that files can have), colour and pixels of each label that is drawn."""
    counts = np.bincount(numbers.ravel(), minlength=len(look.table))
    shown = [n for n in np.flatnonzero(counts) if n and look.table[n, 0] >= 0.0 and look.table[n, 3] > 0.0]
    names = file_suffixes({int(n): look.labels.name(int(n)) for n in shown})
    return [
        {
            "label_number": int(n),
            "label": names[int(n)],
            "color": to_hexadecimal(look.table[n, :3]),
            "pixels": int(counts[n]),
        }
        for n in shown
    ]
