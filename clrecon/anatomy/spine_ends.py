"""The ends of the spinal canal: how far it goes on beyond the slices that surely show it, and what ends it.

Beyond the sure slices the place of the canal is known, so less is needed of the next slice: left and right may differ,
as in a scan that is cropped at one side.  All other traits stay: without the vertebral body in front the way would go
on in the soft tissue before the sacrum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.spine_cells import CELL_MM, SpineCells
from clrecon.anatomy.spine_traits import CANAL_RADIUS, SOFT_HU, STILL, SURE, Likeness, traits_of

GAP_MM = 12.0
"""Largest gap between slices of the canal: an artefact, or a vertebra that looks different."""
REACH = 2
"""Cells by which the canal may move aside from slice to slice."""


MISSING = {
    "wall": "bone around it on all sides",
    "body": "a vertebral body in front of it",
    "soft": "soft tissue in its middle",
    "mirror": "left and right that are alike",
}
LOOKED_AT = 9
"""Slices of a path on which traits are compared."""


@dataclass(frozen=True)
class SpineEnd:
    """An end of the line that was found.

    z_mm: Height of the last slice of the line, LPS mm.
    lost_mm: Height of the first slice in which it was not found again; None where the scan ends there.
    because: What was found there instead; empty where the scan ends.
    """

    z_mm: float
    lost_mm: float | None = None
    because: str = ""


def follow(likeness: Likeness, path: NDArray[np.int64]) -> NDArray[np.int64]:
    """Follow the canal beyond both ends of a path.

    path: ndarray, shape (n, 3). Cells (k, j, i) of the likeness, one a slice, k ascending.

    Returns: ndarray, shape (m, 3). The longer path; its new slices have the traits of `STILL`, but for gaps up to
        `GAP_MM` between them.
    """
    below = _beyond(likeness, path[0], -1)[::-1]
    above = _beyond(likeness, path[-1], 1)
    return np.concatenate([below, path, above])


def _beyond(likeness: Likeness, last: NDArray[np.int64], step: int, stop: bool = True) -> NDArray[np.int64]:
    """Return the cells from the last one on, one a slice; with `stop` only as far as the canal goes on."""
    k, j, i = (int(n) for n in last)
    cells: list[tuple[int, int, int]] = []
    sure = 0
    while 0 <= k + step < len(likeness.worth):
        k += step
        rows, columns = slice(max(j - REACH, 0), j + REACH + 1), slice(max(i - REACH, 0), i + REACH + 1)
        near = np.where(likeness.goes_on[k, rows, columns], 100.0, 0.0) + likeness.worth[k, rows, columns]
        at = np.unravel_index(int(near.argmax()), near.shape)
        j, i = rows.start + int(at[0]), columns.start + int(at[1])
        cells.append((k, j, i))
        if likeness.goes_on[k, j, i]:
            sure = len(cells)
        elif (len(cells) - sure) * CELL_MM[2] > GAP_MM:
            break
    found = np.array(cells, np.int64).reshape(-1, 3)
    return found[:sure] if stop else found


def look_beyond(cells: SpineCells, likeness: Likeness, last: NDArray[np.int64], step: int) -> SpineEnd:
    """Return the end of a path at its last cell: whether the scan ends there, or what was found instead of the canal.

    last: ndarray, shape (3,). Cell (k, j, i) of the likeness.
    step: {-1, 1}. Downwards or upwards.
    """
    z_mm = float(cells.origin[2] + last[0] * CELL_MM[2])
    left = len(likeness.worth) - 1 - int(last[0]) if step > 0 else int(last[0])
    if left * CELL_MM[2] <= GAP_MM:
        return SpineEnd(z_mm)
    found = _beyond(likeness, last, step, stop=False)[0]
    return SpineEnd(z_mm, float(cells.origin[2] + found[0] * CELL_MM[2]), _lacking(likeness.box_of(cells), found))


def _lacking(cells: SpineCells, place: NDArray[np.int64]) -> str:
    """Say in words what the place that is most like a canal lacks of one."""
    k, j, i = (int(n) for n in place)
    traits = {name: float(field[j, i]) for name, field in traits_of(cells, k).items()}
    parts = []
    if traits["soft"] < STILL["soft"]:
        reach = round(CANAL_RADIUS / CELL_MM[0])
        around = cells.values[k, max(j - reach, 0) : j + reach + 1, max(i - reach, 0) : i + reach + 1]
        hu = float(around.mean())
        what = "bone" if hu >= SOFT_HU[1] else "air or fat" if hu <= SOFT_HU[0] else "bone beside soft tissue"
        parts.append(f"{what} in its place ({hu:.0f} HU)")
    if traits["wall"] < STILL["wall"]:
        parts.append(
            f"bone in {100.0 * traits['wall']:.0f} % of the directions around it (at least"
            f" {100.0 * STILL['wall']:.0f} % are needed)"
        )
    if traits["body"] < STILL["body"]:
        parts.append("no vertebral body in front of it")
    return " and ".join(filter(None, (", ".join(parts[:-1]), *parts[-1:])))


def missing_traits(cells: SpineCells, likeness: Likeness, path: NDArray[np.int64]) -> str:
    """Say in words which traits most slices lack on a path that is no canal; empty where there is no path."""
    box = likeness.box_of(cells)
    chosen = path[np.unique(np.linspace(0, len(path) - 1, LOOKED_AT).astype(int))] if len(path) else path
    found = [({name: field[j, i] for name, field in traits_of(box, int(k)).items()}) for k, j, i in chosen]
    lacking = [
        text for name, text in MISSING.items() if 2 * sum(traits[name] < SURE[name] for traits in found) > len(found)
    ]
    return " and ".join(filter(None, (", ".join(lacking[:-1]), *lacking[-1:])))
