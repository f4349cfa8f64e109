"""The layout of a stack as plain figures for the certificate and the listing: directions, extent, gaps, thickness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.headers.slice_header import SliceHeader
from clrecon.dicom.stack.fit import Stack
from clrecon.dicom.stack.numbers import median
from clrecon.geometry.uneven import position_tolerance

Float64Array = NDArray[np.float64]


def measure_extent(stack: Stack) -> list[float] | None:
    """Return the size in mm of the box of whole voxels along rows, columns and normal; None for an unknown gap."""
    first, usual = stack.slices[0], stack.line.gap_median_mm
    if usual is None:
        return None
    along_normal = float(stack.distances_mm[-1] - stack.distances_mm[0]) + usual
    return [first.columns * first.di_mm, first.rows * first.dj_mm, along_normal]


def summarise_gaps(distances: Float64Array) -> list[dict[str, Any]]:
    """Return the runs of equal gaps between sorted positions (mm along the normal), in order.

    Returns: ``count`` gaps of ``gap_mm``, their mean; a gap belongs to a run as long as it equals the first of it
        within the tolerance of an even stack.
    """
    runs: list[list[float]] = []
    for gap in np.diff(distances).tolist():
        if runs and abs(gap - runs[-1][0]) <= position_tolerance(runs[-1][0]):
            runs[-1].append(gap)
        else:
            runs.append([gap])
    return [{"count": len(run), "gap_mm": sum(run) / len(run)} for run in runs]


def median_thickness(headers: Sequence[SliceHeader]) -> float | None:
    """Return the median of the SliceThickness values above zero, mm; None if there are none."""
    known = sorted(_thicknesses(headers))
    return known[len(known) // 2] if known else None


def _thicknesses(headers: Sequence[SliceHeader]) -> list[float]:
    return [h.slice_thickness_mm for h in headers if h.slice_thickness_mm is not None and h.slice_thickness_mm > 0.0]


def describe_thickness(headers: Sequence[SliceHeader], distances: Float64Array) -> dict[str, Any] | None:
    """Compare SliceThickness with the distances of the slices along the normal.

    Returns: ``min_mm``, ``max_mm``, ``median_mm`` of the thickness; ``overlap_mm``: ``min``, ``max`` and ``median`` of
        what neighbouring slices share, (t_k + t_k+1) / 2 less their distance, below zero where tissue between them was
        not measured; ``overlap_percent``: its median in percent of the median distance.  None unless every slice states
        a thickness and there are two slices.
    """
    thickness = np.array(_thicknesses(headers))
    if len(thickness) != len(headers) or len(headers) < 2:
        return None
    gaps = np.diff(distances)
    overlap = (thickness[1:] + thickness[:-1]) / 2.0 - gaps
    middle, usual = median(overlap), median(gaps)
    return {
        "min_mm": float(thickness.min()),
        "max_mm": float(thickness.max()),
        "median_mm": median(thickness),
        "overlap_mm": {"min": float(overlap.min()), "max": float(overlap.max()), "median": middle},
        "overlap_percent": 100.0 * middle / usual if usual > 0.0 else None,
    }
