"""The spinal canal of an adult: a centre line for curved reformations, and the ends of the canal (docs/slices.md).

The path is the canal where it agrees over enough height.  Beyond these slices the place of the canal is known, so less
is needed of the next slice: left and right may differ, as in a scan that is cropped at one side.  All other traits
stay: without the vertebral body in front the way would go on in the soft tissue before the sacrum.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.spine_cells import (
    BODY_RADIUS,
    CANAL_RADIUS,
    CELL_MM,
    SOFT_HU,
    STILL,
    SURE,
    WORTH,
    Field,
    Likeness,
    SpineCells,
    average_cells,
    disc_mean,
    grow_cortex,
    measure_likeness,
    plan_cells,
    traits_of,
)
from clrecon.errors import RefusedInputError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.volume import Volume
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, Steps

GAP_MM = 12.0
"""Largest gap between slices that show the canal, due to an artefact or a vertebra that looks different."""
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
    """An end of the line: its height, and that at which it is lost, LPS mm, because of what; empty at a scan's end."""

    z_mm: float
    lost_mm: float | None = None
    because: str = ""


def follow(likeness: Likeness, path: NDArray[np.int64]) -> NDArray[np.int64]:
    """Follow the canal beyond both ends of a path (n, 3) of cells (k, j, i) by the traits of `STILL`, over `GAP_MM`."""
    below = _beyond(likeness, path[0], -1)[::-1]
    return np.concatenate([below, path, _beyond(likeness, path[-1], 1)])


def _beyond(likeness: Likeness, last: NDArray[np.int64], step: int, *, stop: bool = True) -> NDArray[np.int64]:
    """Return the cells from the last one on, one a slice; with `stop` only as far as the canal goes on."""
    k, j, i = (int(n) for n in last)
    cells: list[tuple[int, int, int]] = []
    sure = 0
    while 0 <= k + step < len(likeness.worth):
        k += step
        rows, columns = slice(max(j - REACH, 0), j + REACH + 1), slice(max(i - REACH, 0), i + REACH + 1)
        near = np.where(likeness.goes_on[k, rows, columns], 100.0, 0.0) + likeness.worth[k, rows, columns]
        peak = np.unravel_index(int(near.argmax()), near.shape)
        j, i = rows.start + int(peak[0]), columns.start + int(peak[1])
        cells.append((k, j, i))
        if likeness.goes_on[k, j, i]:
            sure = len(cells)
        elif (len(cells) - sure) * CELL_MM[2] > GAP_MM:
            break
    path = np.array(cells, np.int64).reshape(-1, 3)
    return path[:sure] if stop else path


def look_beyond(cells: SpineCells, likeness: Likeness, last: NDArray[np.int64], step: int) -> SpineEnd:
    """Return a path's end at its last cell (k, j, i), downwards (step -1) or upwards (1), and what was found there."""
    z_mm = float(cells.origin[2] + last[0] * CELL_MM[2])
    left = len(likeness.worth) - 1 - int(last[0]) if step > 0 else int(last[0])
    if left * CELL_MM[2] <= GAP_MM:
        return SpineEnd(z_mm)
    cell = _beyond(likeness, last, step, stop=False)[0]
    return SpineEnd(z_mm, float(cells.origin[2] + cell[0] * CELL_MM[2]), _lacking(likeness.box_of(cells), cell))


def _lacking(cells: SpineCells, cell: NDArray[np.int64]) -> str:
    """Say in words what the place that is most like a canal lacks of one."""
    k, j, i = (int(n) for n in cell)
    traits = {name: float(field[j, i]) for name, field in traits_of(cells, k).items()}
    parts = []
    if traits["soft"] < STILL["soft"]:
        reach = round(CANAL_RADIUS / CELL_MM[0])
        around = cells.values[k, max(j - reach, 0) : j + reach + 1, max(i - reach, 0) : i + reach + 1]
        hu = float(around.mean())
        tissue = "bone" if hu >= SOFT_HU[1] else "bone beside soft tissue"
        if hu <= SOFT_HU[0]:
            tissue = "air or fat"
        parts.append(f"{tissue} in its place ({hu:.0f} HU)")
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
    seen = [({name: field[j, i] for name, field in traits_of(box, int(k)).items()}) for k, j, i in chosen]
    lacking = [
        text for name, text in MISSING.items() if 2 * sum(traits[name] < SURE[name] for traits in seen) > len(seen)
    ]
    return " and ".join(filter(None, (", ".join(lacking[:-1]), *lacking[-1:])))


_WORST = 0.6
"""Most that a slice counts against the path, so that one slice with an artefact does not end it."""
_BEND_COST = 0.05
_DEEPER_AHEAD = 1.2
"""A trunk is at least this many times deeper in front of the canal than behind it; a neck need not be."""
_FORWARD = 0.12
"""A spine is worth at least so much more than the same scan with front and back exchanged; necks 0.2 to 0.3, trunks 0.4
to 0.5, lower legs less than 0.08."""
SHORTEST_MM = 35.0
"""A spine is accepted from this height on."""
SMOOTH_MM = 12.0
"""Standard deviation of the Gaussian that smooths the line."""
POINT_STEP_MM = 15.0
"""Distance of the points of the line in height."""
CANAL_WIDTH_MM = 11.0
"""Voxels farther than this from the middle of the canal do not belong to the canal."""


@dataclass(frozen=True)
class SpineLine:
    """The middle of the spinal canal.

    points: (n, 3). LPS mm, from the head downwards, about 15 mm apart.
    sure_share: Share of the slices of the line whose traits are all sure, see `clrecon.anatomy.spine_cells.SURE`.
    searched_mm: Height of the volume; the line may be shorter.
    sure_mm: Heights between which its slices are sure, but for gaps, z of the upper and the lower end.
    upper, lower: Its ends: those of the scan, or where it was lost; None where only the sure part was asked for.
    """

    _SHOWN = ("height_mm", "searched_mm", "sure_share", "sure_mm")
    points: Float64Array
    sure_share: float
    searched_mm: float
    sure_mm: tuple[float, float]
    upper: SpineEnd | None = None
    lower: SpineEnd | None = None

    @property
    def ends(self) -> dict[str, SpineEnd | None]:
        return {"upper": self.upper, "lower": self.lower}

    @property
    def height_mm(self) -> float:
        """Distance between the lower and the upper end along the body axis, mm."""
        return float(self.points[0, 2] - self.points[-1, 2])


@explains_arguments
def find_spine_line(volume: Volume, *, sure_only: bool = False, progress: Progress | None = None) -> SpineLine:
    """Find the middle of the spinal canal.

    Parameters
    ----------
    volume : Volume
        A scan in HU.
    sure_only : bool
        Only the longest part whose slices are sure, but for gaps; else the line goes on beyond it where left and
        right alone are not alike.
    progress : callable, optional
        Called as ``progress("curve", slices done, slices)``, over the slices of three passes.

    Raises
    ------
    RefusedInputError
        No part of the volume surely shows a spine; the message says how much was found.
    """
    lattice = plan_cells(volume)
    steps = Steps(progress, "curve", lattice.blocks(volume) + 2 * int(lattice.count[2]))
    cells = average_cells(volume, lattice, steps.take_slice)
    likeness = measure_likeness(cells, steps.take_slice)
    path = _best_path(np.clip(likeness.worth - WORTH, -_WORST, None))
    begin, end = _longest_run(likeness.sure[tuple(path.T)])
    searched, height = len(cells.values) * CELL_MM[2], (end - begin) * CELL_MM[2]
    if height < SHORTEST_MM:
        missing = missing_traits(cells, likeness, path)
        lack = f"; the place most like a canal lacks {missing}" if missing else ""
        raise RefusedInputError(
            f"no spine was found that one could be sure of ({_describe_run(cells, path[begin:end], searched)}{lack}):"
            " give points of the centre line"
        )
    path = path[begin:end]
    ahead, behind = _depths(cells, path + (0, *likeness.first))
    if behind is not None and ahead < _DEEPER_AHEAD * behind and not _faces_forward(cells, likeness, path):
        raise RefusedInputError(
            f"what looks like a spine has {ahead:.0f} mm of the body in front and {behind:.0f} mm behind, and it looks"
            " as much like one with front and back exchanged: it is none, or the affine of the scan has front and back"
            " the wrong way round; give points of the centre line"
        )
    lowest, highest = (float(cells.origin[2] + k * CELL_MM[2]) for k in (path[0, 0], path[-1, 0]))
    ends: list[SpineEnd | None] = [None, None]
    if not sure_only:
        path = follow(likeness, path)
        ends = [look_beyond(cells, likeness, path[place], step) for place, step in ((-1, 1), (0, -1))]
    share = float(likeness.sure[tuple(path.T)].mean())
    return SpineLine(_centre_points(cells, path + (0, *likeness.first)), share, searched, (highest, lowest), *ends)


def _faces_forward(cells: SpineCells, likeness: Likeness, path: NDArray[np.int64]) -> bool:
    """Return whether the slices of a path look less like a spine where front and back of the scan are exchanged."""
    slices = slice(int(path[0, 0]), int(path[-1, 0]) + 1)
    exchanged = measure_likeness(SpineCells(np.ascontiguousarray(cells.values[:, ::-1]), cells.origin), lambda _: None)
    usual, swapped = (one.worth[slices].max(axis=(1, 2)) for one in (likeness, exchanged))
    return bool(np.median(usual - swapped) >= _FORWARD)


def _describe_run(cells: SpineCells, run: NDArray[np.int64], searched: float) -> str:
    """Say how much of a scan looks like a spine, and where."""
    if not len(run):
        return f"none of its {searched:.0f} mm look like one"
    low, high = (float(cells.origin[2] + k * CELL_MM[2]) for k in (run[0, 0], run[-1, 0]))
    range_text = f"z {low:.0f} mm" if len(run) == 1 else f"z {low:.0f} to {high:.0f} mm"
    return (
        f"{len(run) * CELL_MM[2]:.0f} of {searched:.0f} mm look like one, at {range_text}, and at least"
        f" {SHORTEST_MM:.0f} mm are needed"
    )


def _depths(cells: SpineCells, path: NDArray[np.int64]) -> tuple[float, float | None]:
    """Return the median depth of tissue before and behind a path, mm; None behind where the volume ends within it."""
    k, j, i = path.T
    layers = ((cells.values[n : n + 1] > -300.0).astype(np.float32) for n in k)
    thick = (disc_mean(layer, BODY_RADIUS)[0] > 0.6 for layer in layers)  # the table is thinner
    rows = np.stack([layer[:, column] for layer, column in zip(thick, i, strict=True)])
    ends = rows.shape[1] - 1 - rows[:, ::-1].argmax(axis=1)
    ahead = float(np.median(j - rows.argmax(axis=1)) * CELL_MM[1])
    behind = float(np.median(ends - j) * CELL_MM[1])
    outside = rows.shape[1] - 1 - ends <= BODY_RADIUS / CELL_MM[1]
    return ahead, None if np.median(outside) else behind


def _longest_run(sure: NDArray[np.bool_]) -> tuple[int, int]:
    """Return the first and the end of the longest run of sure slices; gaps up to `GAP_MM` do not divide a run."""
    best = (0, 0)
    begin = None
    last = 0
    for k in np.flatnonzero(sure):
        if begin is None or (k - last - 1) * CELL_MM[2] > GAP_MM:
            begin = int(k)
        last = int(k)
        if last + 1 - begin > best[1] - best[0]:
            best = begin, last + 1
    return best


def _best_path(gain: Field) -> NDArray[np.int64]:
    """Return the path with the highest sum: cells (n, 3) as (k, j, i), one a slice, each at most one cell aside.

    It begins and ends where the sum is best: slices that count against it lie only between slices that count for it.
    """
    steps = list(product((-1, 0, 1), repeat=2))
    sums = gain[0].copy()
    came = np.full(gain.shape, -1, np.int8)
    best, end = float(sums.max()), (0, *np.unravel_index(sums.argmax(), sums.shape))
    for k in range(1, len(gain)):
        padded = np.pad(sums, 1, constant_values=-np.inf)
        # Where nothing before is worth more than 0, the path begins.
        before = np.zeros_like(sums)
        for n, (dy, dx) in enumerate(steps):
            cost = np.float32(_BEND_COST * np.hypot(dy, dx))
            reached = padded[1 + dy : 1 + dy + sums.shape[0], 1 + dx : 1 + dx + sums.shape[1]] - cost
            better = reached > before
            np.copyto(before, reached, where=better)
            np.copyto(came[k], np.int8(n), where=better)
        sums = gain[k] + before
        if sums.max() > best:
            best, end = float(sums.max()), (k, *np.unravel_index(sums.argmax(), sums.shape))
    path: list[Any] = []
    k, j, i = (int(n) for n in end)
    while best > 0.0:
        path.append((k, j, i))
        if came[k, j, i] < 0:
            break
        dy, dx = steps[came[k, j, i]]
        k, j = k - 1, j + dy
        i = i + dx
    return np.array(path[::-1], np.int64).reshape(-1, 3)


def _centre_points(cells: SpineCells, path: NDArray[np.int64]) -> Float64Array:
    """Return the middle of the space that bone encloses in each slice of a path, smoothed, from the upper end down."""
    from scipy.ndimage import gaussian_filter1d

    middles = path[:, 1:].astype(np.float64)
    # The middle moves by at most three cells.
    reach = int(np.ceil(CANAL_WIDTH_MM / min(CELL_MM[:2]))) + 4
    for n, (k, j, i) in enumerate(path):
        rows, columns = slice(max(j - reach, 0), j + reach + 1), slice(max(i - reach, 0), i + reach + 1)
        bone = grow_cortex(SpineCells(cells.values[:, rows, columns], cells.origin), k, k + 1, 16.0)[0]
        y, x = np.mgrid[: bone.shape[0], : bone.shape[1]] + np.array([rows.start, columns.start])[:, None, None]
        for _ in range(3):
            distance = np.hypot((y - middles[n, 0]) * CELL_MM[1], (x - middles[n, 1]) * CELL_MM[0])
            weight = np.clip((CANAL_WIDTH_MM - distance) / CELL_MM[0], 0.0, 1.0) * (1.0 - bone)
            if weight.sum() > 0.0:
                moved = np.array([(weight * y).sum(), (weight * x).sum()]) / weight.sum()
                middles[n] += np.clip(moved - middles[n], -1.0, 1.0)
    # The line continues beyond its ends by point symmetry, so that smoothing does not bend it there.
    beyond = min(len(middles) - 1, round(4.0 * SMOOTH_MM / CELL_MM[2]))
    longer = np.pad(middles, ((beyond, beyond), (0, 0)), mode="reflect", reflect_type="odd")
    smooth = gaussian_filter1d(longer, SMOOTH_MM / CELL_MM[2], axis=0, mode="nearest")[beyond:][: len(middles)]
    places = np.column_stack([smooth[:, 1], smooth[:, 0], path[:, 0]]) * CELL_MM + cells.origin
    count = max(2, round(len(path) * CELL_MM[2] / POINT_STEP_MM) + 1)
    return places[np.unique(np.rint(np.linspace(0, len(path) - 1, count)).astype(int))][::-1]
