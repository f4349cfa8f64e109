"""Listing of series, in JSON types."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

from clrecon.dicom.series.series import Series
from clrecon.dicom.stack.fit import Stack
from clrecon.dicom.stack.layout import measure_extent, median_thickness
from clrecon.errors import ClreconError, RefusedInputError
from clrecon.geometry import column_spacing
from clrecon.geometry.certificate import Certificate
from clrecon.system.text import hash_uid

__all__ = ["SeriesEntry", "SeriesListing", "describe_series"]


@dataclass(frozen=True)
class SeriesEntry:
    """One line of a listing; `as_dict` is the documented machine-readable form.

    Attributes
    ----------
    number : int
        From 1, the value that ``series=`` takes.
    patient, study : int or None
        Numbers of the patient and the study among those found, from 1; their identifiers are not given.  None where the
        files do not tell.
    kind : {"stack", "localizer", "capture", "other"}
        Only stacks are read.
    phases : list of dict
        ``{"number", "keyword", "value", "slices"}`` of each volume, where slices share places; else empty.
    slices : int
        Number of images, with copies and all phases.
    uid_hash : str or None
        First 16 hexadecimal digits of the SHA-256 of the SeriesInstanceUID, None where the files have none.
    shape_ijk, spacing_mm, affine_ijk_to_lps_mm, tilt_deg : list, list, nested list, float; or None
        None where the geometry is unknown or refused.
    grid_residual_max_mm : float or None
        Largest distance of a slice position from the affine.
    gap_mm : dict
        "min", "max" and "median" distance of neighbouring slices along the normal, None where unknown.
    extent_mm : list or None
        Size of the box of whole voxels along rows, columns and the slice normal.
    slice_thickness_mm : float or None
        As stated; not used for the geometry.
    dropped : dict of str to int
        Maps a reason to the number of slices left out of the stack.
    """

    number: int
    uid_hash: str | None
    description: str
    modality: str
    slices: int
    shape_ijk: list[int] | None
    spacing_mm: list[float] | None
    affine_ijk_to_lps_mm: list[list[float]] | None
    tilt_deg: float | None
    grid_residual_max_mm: float | None
    gap_mm: dict[str, float | None]
    uneven: bool | None
    warnings: list[str]
    problems: list[str]
    patient: int | None = None
    study: int | None = None
    kind: str = "stack"
    phases: list[dict[str, Any]] = field(default_factory=list)
    extent_mm: list[float] | None = None
    slice_thickness_mm: float | None = None
    dropped: dict[str, int] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """The entry as a dict of JSON types."""
        return asdict(self)


@dataclass(frozen=True)
class SeriesListing:
    """The series at a path.

    Attributes
    ----------
    series : list of SeriesEntry
    chosen : int or None
        Number of the series that `read_volume` reads for the same ``series``; None where it would not choose.
    skipped : dict of str to int
        Maps a reason to the number of files passed over.
    warnings : list of str
    certificate : Certificate or None
        Certificate of the chosen series, as in ``volume.report``, even if the series is refused; None where no series
        is chosen or none of its slices has a valid header.
    refusal : ClreconError or None
        The reason why no series is chosen; `warnings` contains its text too.
    """

    series: list[SeriesEntry]
    chosen: int | None
    skipped: dict[str, int]
    warnings: list[str]
    certificate: Certificate | None = None
    refusal: ClreconError | None = None


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
