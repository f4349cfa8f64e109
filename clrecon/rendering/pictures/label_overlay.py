"""Labels over grey slices: an outline in the colour of each label, and a share of it within."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.labels import LabelMap, file_suffixes
from clrecon.rendering.looks.label_style import LabelStyle, find_shown
from clrecon.rendering.views.plane import Sheet

ROWS_AT_ONCE = 128
TIES = 1e-6
"""Tolerance in index steps: half-way between two labels the lower index wins, independent of rounding."""

FILL = 0.3
"""Share of its colour within a label for which none is given: the scan stays to be read under it."""

OUTLINE_SHARE = 1 / 400
"""Width of outlines as a share of the shorter side of a picture; a pixel at least."""


def labels_on_sheet(labels: LabelMap, sheet: Sheet) -> NDArray[Any]:
    """Return the label in which the centre of each pixel of a sheet lies.

    The place of a pixel in mm is looked up in the map itself, whatever slices the scan has: neither tilted nor uneven
    ones move a label.

    Returns: ndarray, shape (h, w), of the type of the map. 0 where no label is, and beyond the map.
    """
    size = np.array(labels.shape_ijk)
    found = np.zeros((sheet.height, sheet.width), labels.voxels.dtype)
    for first in range(0, sheet.height, ROWS_AT_ONCE):
        points = sheet.points(slice(first, first + ROWS_AT_ONCE))
        at = np.floor(labels.lps_to_ijk(points.reshape(-1, 3)) + (0.5 - TIES)).astype(np.int64)
        inside = ((at >= 0) & (at < size)).all(axis=1)
        i, j, k = at[inside].T
        part = found[first : first + ROWS_AT_ONCE].reshape(-1)
        part[inside] = labels.voxels[k, j, i]
    return found


def draw_labels(
    image: NDArray[np.uint8],
    numbers: NDArray[Any],
    look: LabelStyle,
    tints: Mapping[int | str, float] | None = None,
    width: int | None = None,
) -> NDArray[np.uint8]:
    """Draw labels over a copy of a picture.

    image: ndarray, shape (h, w, 4), uint8. Pixels with opacity 0 show nothing of the scan and stay as they are.
    numbers: ndarray, shape (h, w). Label of each pixel, 0 for none.
    look: Labels without a colour, and those with opacity 0, are not drawn.  What has no label keeps its look.
    tints: Share of its colour that the inside of a label gets; others get `FILL`.
    width: Of outlines, in pixels inwards; default: a 400th of the shorter side, a pixel at least.

    Returns: ndarray, shape (h, w, 4), uint8
    """
    table = look.table
    drawn = (table[:, 0] >= 0.0) & (table[:, 3] > 0.0)
    drawn[0] = False
    shares = np.full(len(table), FILL, np.float32)
    for label, share in (tints or {}).items():
        shares[find_shown(look.labels, label)] = share
    own = drawn[numbers] & (image[..., 3] > 0)
    wide = max(1, round(OUTLINE_SHARE * min(numbers.shape))) if width is None else width
    amount = np.where(_edges(numbers, wide), np.float32(1.0), shares[numbers])[..., None]
    colors = 255.0 * table[numbers][..., :3]
    made = image.copy()
    mixed = amount * colors + (1.0 - amount) * image[..., :3]
    made[..., :3] = np.where(own[..., None], np.rint(mixed).astype(np.uint8), image[..., :3])
    return made


def describe_overlay(numbers: NDArray[Any], look: LabelStyle) -> list[dict[str, Any]]:
    """Return number, name (one that files can have), colour and pixels of each label that is drawn."""
    counts = np.bincount(numbers.ravel(), minlength=len(look.table))
    shown = [n for n in np.flatnonzero(counts) if n and look.table[n, 0] >= 0.0 and look.table[n, 3] > 0.0]
    names = file_suffixes({int(n): look.labels.name(int(n)) for n in shown})
    return [
        {
            "label_number": int(n),
            "label": names[int(n)],
            "color": "#" + "".join(f"{round(255 * float(share)):02x}" for share in look.table[n, :3]),
            "pixels": int(counts[n]),
        }
        for n in shown
    ]


def _edges(numbers: NDArray[Any], wide: int) -> NDArray[np.bool_]:
    """Return the pixels from which another label, or none, is at most `wide` steps away along rows and columns."""
    edges = np.zeros(numbers.shape, dtype=bool)
    for step in range(1, wide + 1):
        for axis in (0, 1):
            if step < numbers.shape[axis]:
                here, there = [slice(None)] * 2, [slice(None)] * 2
                here[axis], there[axis] = slice(None, -step), slice(step, None)
                differ = numbers[tuple(here)] != numbers[tuple(there)]
                edges[tuple(here)] |= differ
                edges[tuple(there)] |= differ
    return edges
