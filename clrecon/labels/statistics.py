"""HU and volume of each label: every voxel counts with its own volume, so uneven slices are right."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.labels.label_levels import label_ml
from clrecon.labels.label_map import LabelMap
from clrecon.labels.resample import ResampledLabels, resample_labels
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record
from clrecon.system.text import format_digits

PERCENTILES = (5.0, 25.0, 50.0, 75.0, 95.0)

_MOST_LEVELS = 1 << 20
"""Whole numbers that span fewer levels are counted level by level; others are sorted."""

_ODD_VOLUME = 0.02
"""Share by which the volume on the two grids may differ before a warning; a coarse grid alone makes less."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelFigures(Record):
    """Figures of one label.

    voxels: Voxels of the scan that carry the label.
    ml: Their volume: each voxel reaches half way to the neighbouring slices.
    label_ml: Volume of the label on the map's own grid, which may go beyond the scan.
    inside_share: Share of the label's voxels that lie inside the scan, 0 to 1.
    unmeasured: Voxels without a finite value; the figures of HU leave them out.
    mean_hu, sd_hu: Over the volume (divided by the whole, not by one voxel less); None without voxels.
    percentiles_hu: ``{"5": ...}``: the least HU up to which at least this percentage of the volume lies.
    surface: Figures of its surface, if statistics of surfaces were asked for; see docs/statistics.md.
    """

    _SHOWN = ("number", "name", "ml", "mean_hu", "sd_hu")
    number: int
    name: str
    voxels: int
    ml: float
    label_ml: float
    inside_share: float
    unmeasured: int
    mean_hu: float | None
    sd_hu: float | None
    min_hu: float | None
    max_hu: float | None
    percentiles_hu: Mapping[str, float | None]
    surface: Mapping[str, Any] | None = None

    @property
    def warnings(self) -> list[str]:
        """What is doubtful about this label."""
        if not self.voxels:
            reason = "outside of the scan" if self.inside_share == 0.0 else "smaller than the voxels of the scan"
            return [f"{self.name} has no voxel in the scan: its {format_digits(self.label_ml)} ml are {reason}"]
        warnings = []
        if self.inside_share < 1.0:
            warnings.append(
                f"{100.0 * self.inside_share:.3g} % of {self.name} lie inside the scan, the rest is not measured"
            )
        wanted = self.label_ml * self.inside_share
        if abs(self.ml - wanted) > _ODD_VOLUME * wanted:
            warnings.append(
                f"{self.name} has {format_digits(self.ml, 4)} ml on the grid of the scan and"
                f" {format_digits(wanted, 4)} ml on its own: look at the slices of both"
            )
        if self.unmeasured:
            warnings.append(f"{self.name}: {self.unmeasured:,} of {self.voxels:,} voxels have no finite value")
        return warnings


def name_percentile(percent: float) -> str:
    """Return the key of a percentile: ``5`` for 5.0, ``2.5`` for 2.5."""
    return f"{percent:g}"


def check_percentiles(percentiles: Sequence[float]) -> tuple[float, ...]:
    """Return percentiles in ascending order, each once."""
    try:
        numbers = [float(percent) for percent in percentiles]
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"percentiles are numbers from 0 to 100, not {percentiles!r:.80}") from None
    wrong = [percent for percent in numbers if not (math.isfinite(percent) and 0.0 <= percent <= 100.0)]
    if wrong:
        raise UsageError(f"percentiles are numbers from 0 to 100, not {wrong[0]:g}")
    return tuple(sorted(set(numbers)))


@explains_arguments
def measure_labels(
    volume: Volume,
    labels: LabelMap,
    label: Sequence[str | int] | str | int | None = None,
    *,
    percentiles: Sequence[float] = PERCENTILES,
    progress: Progress | None = None,
) -> list[LabelFigures]:
    """Measure the volume and the HU of each label of a map.

    A map on another grid is brought to that of the scan as `resample_labels` does.  Every voxel counts with its own
    volume: where slices are uneven, those with more room around them count more in mean, deviation and percentiles.

    Parameters
    ----------
    volume : Volume
    labels : LabelMap
    label : int, str or sequence of them, optional
        The labels that are wanted, as `LabelMap.find` takes them; default: all that occur.
    percentiles : sequence of float
        From 0 to 100.
    progress : callable, optional
        Called as ``progress("measure labels", done, labels)``.

    Returns
    -------
    list of LabelFigures
        By ascending number.

    Raises
    ------
    RefusedInputError
        The map names another frame of reference, or less than 1 % of it lies inside the scan.
    UsageError
        A label does not exist, or a percentile is not one.
    """
    check_percentiles(percentiles)
    return measure_resampled(
        volume, labels, resample_labels(labels, volume), label, percentiles=percentiles, progress=progress
    )


def measure_resampled(
    volume: Volume,
    labels: LabelMap,
    placed: ResampledLabels,
    label: Sequence[str | int] | str | int | None = None,
    *,
    percentiles: Sequence[float] = PERCENTILES,
    progress: Progress | None = None,
) -> list[LabelFigures]:
    """As `measure_labels`, with the map on the grid of the scan already."""
    from scipy.ndimage import find_objects

    wanted = check_percentiles(percentiles)
    progress = progress or ignore_progress
    numbers = sorted(labels.choose(label))
    boxes = find_objects(placed.voxels)
    voxel_ml = slice_voxel_ml(volume)
    figures = []
    for row, number in enumerate(numbers):
        progress("measure labels", row, len(numbers))
        box = boxes[number - 1] if number <= len(boxes) else None
        values, ml = _take_values(volume, placed.voxels, number, box, voxel_ml)
        figures.append(
            LabelFigures(
                number=number,
                name=labels.name(number),
                voxels=len(values),
                ml=float(ml.sum()),
                label_ml=label_ml(labels, number),
                inside_share=placed.inside[number],
                **_measure_values(values, ml, wanted),
            )
        )
    progress("measure labels", len(numbers), len(numbers))
    return figures


def _take_values(
    volume: Volume, labels: NDArray[Any], number: int, box: tuple[slice, ...] | None, voxel_ml: NDArray[np.float64]
) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Return the values of a label's voxels and the volume of each in ml, both of shape (n,)."""
    if box is None:
        return volume.voxels[:0, 0, 0], np.zeros(0)
    mask = labels[box] == number
    return volume.voxels[box][mask], np.repeat(voxel_ml[box[0]], np.count_nonzero(mask, axis=(1, 2)))


def _measure_values(values: NDArray[Any], ml: NDArray[np.float64], percentiles: Sequence[float]) -> dict[str, Any]:
    finite = np.isfinite(values) if values.dtype.kind == "f" else np.ones(len(values), dtype=bool)
    unmeasured = len(values) - int(np.count_nonzero(finite))
    if unmeasured:
        values, ml = values[finite], ml[finite]
    if not len(values):
        nothing: dict[str, Any] = dict.fromkeys(("mean_hu", "sd_hu", "min_hu", "max_hu"))
        none_of_all = dict.fromkeys(map(name_percentile, percentiles))
        return {**nothing, "unmeasured": unmeasured, "percentiles_hu": none_of_all}
    levels, shares = _distribute(values, ml)
    mean = float(shares @ levels)
    deviation = math.sqrt(float(shares @ (levels - mean) ** 2))
    up_to = np.cumsum(shares)
    # The sum of many shares is 1 but for rounding: 100 % is the last level, and a share that is met exactly counts.
    places = [int(np.searchsorted(up_to, percent / 100.0 - 1e-9)) for percent in percentiles]
    at_percentiles = {
        name_percentile(percent): float(levels[min(place, len(levels) - 1)])
        for percent, place in zip(percentiles, places, strict=True)
    }
    return {
        "unmeasured": unmeasured,
        "mean_hu": mean,
        "sd_hu": deviation,
        "min_hu": float(levels[0]),
        "max_hu": float(levels[-1]),
        "percentiles_hu": at_percentiles,
    }


def _distribute(values: NDArray[Any], ml: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the levels that occur, ascending, and the share of the volume at each; levels may repeat."""
    low, high = values.min(), values.max()
    if values.dtype.kind in "iu" and int(high) - int(low) < _MOST_LEVELS:
        above = values.astype(np.int64) - int(low)
        counted = np.bincount(above, ml)
        there = np.flatnonzero(counted)
        return (there + int(low)).astype(np.float64), counted[there] / ml.sum()
    order = np.argsort(values, kind="stable")
    return values[order].astype(np.float64), ml[order] / ml.sum()
