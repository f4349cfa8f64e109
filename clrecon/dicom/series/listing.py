"""Listing of series, in JSON types."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from clrecon.dicom.series.series import Series
from clrecon.dicom.stack.fit import Stack
from clrecon.dicom.stack.layout import measure_extent, median_thickness
from clrecon.errors import RefusedInputError
from clrecon.geometry import column_spacing
from clrecon.sources.listing import SeriesEntry
from clrecon.system.text import hash_uid


def describe_series(series: Series, warnings: Iterable[str] = ()) -> SeriesEntry:
    """Make the listing entry of a series."""
    stack = series.stack
    affine = stack.affine if stack is not None and not series.problems else None
    first = stack.slices[0] if stack is not None else None
    return SeriesEntry(
        number=series.number,
        uid_hash=hash_uid(series.identity.uid),
        description=series.identity.description,
        modality=series.identity.modality,
        slices=series.count,
        shape_ijk=None if first is None or stack is None else [first.columns, first.rows, _count_slices(series, stack)],
        spacing_mm=None if affine is None else list(column_spacing(affine)),
        affine_ijk_to_lps_mm=None if affine is None else affine.tolist(),
        tilt_deg=None if stack is None or affine is None else stack.tilt_deg,
        grid_residual_max_mm=None if stack is None else stack.line.residual_max_mm,
        gap_mm={
            "min": stack.line.gap_min_mm if stack else None,
            "max": stack.line.gap_max_mm if stack else None,
            "median": stack.line.gap_median_mm if stack else None,
        },
        uneven=None if stack is None else stack.line.uneven,
        warnings=list(warnings),
        problems=list(series.problems),
        patient=series.patient or None,
        study=series.study or None,
        kind=series.kind,
        phases=_list_phases(series),
        extent_mm=None if stack is None or affine is None else measure_extent(stack),
        slice_thickness_mm=median_thickness(series.headers),
        dropped=series.dropped,
    )


def _count_slices(series: Series, stack: Stack) -> int:
    """Count the slices of the volume if it is known; of a refused series all slices found."""
    return len(series.headers) if series.problems else len(stack.slices)


def _list_phases(series: Series) -> list[dict[str, Any]]:
    try:
        phases = series.places.phases
    except RefusedInputError:
        return []
    return [
        {"number": phase.number, "keyword": phase.keyword, "value": phase.value, "slices": len(phase.headers)}
        for phase in phases
    ]
