"""`Certificate`: the facts about a volume's origin and geometry, without patient data."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from typing import Any

from clrecon.system.light_dataclass import dataclass, field, fields
from clrecon.system.records import Gate, Record

_ELSEWHERE = {"slices_missing": ("dropped",), "rescale": ("padding_share", "padding_hu")}
"""In reports of files that are not DICOM these entries stand behind that one: as they always have, byte for byte."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Certificate(Record):
    """The facts about a volume that was read: its ``volume.report``; docs/contract.md explains the entries.

    Lengths are mm, angles degrees.  None means that the file does not tell, that it was refused, or that only
    pixels tell and they were not read.  Each of `masked`, what was done after reading, is an entry of its own.
    """

    _SHOWN = ("format", "shape_ijk", "spacing_mm")
    format: str
    series: Mapping[str, Any]
    phase: Mapping[str, Any] | None = None
    slices: int
    slices_missing: int = 0
    shape_ijk: list[int]
    spacing_mm: list[float] | None
    extent_mm: list[float] | None
    affine_ijk_to_lps_mm: list[list[float]] | None
    orientation: Mapping[str, Any] | None
    patient_position: str | None = None
    anatomical_orientation: str | None = None
    tilt_deg: float | None
    grid_residual_max_mm: float | None = None
    grid_residual_rms_mm: float | None = None
    grid_tolerance_mm: float | None = None
    gap_mm: Mapping[str, float | None]
    uneven: bool | None = False
    gap_runs: list[Any] | None = None
    slice_positions_mm: list[list[float]] | None = None
    slice_thickness_mm: float | None = None
    thickness: Mapping[str, Any] | None = None
    stated_gap_mm: float | None = None
    numbering: Mapping[str, Any] | None = None
    frame_of_reference_hash: str | None = None
    padding_share: float | None = None
    padding_hu: float | None = None
    transfer_syntaxes: list[str] = field(default_factory=list)
    transfer_syntax_names: list[str]
    lossy: bool = False
    rescale: Mapping[str, Any]
    hu_range: list[float] | None = None
    files: Mapping[str, Any]
    dropped: Mapping[str, int] = field(default_factory=dict)
    gates: list[Gate]
    warnings: list[str]
    problems: list[str] = field(default_factory=list)
    masked: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def _entries(self) -> dict[str, Any]:
        entries = super()._entries()
        masked = entries.pop("masked")
        if self.format != "DICOM":
            moved = {name: entries.pop(name) for name in chain(*_ELSEWHERE.values())}
            order = list(chain(*((name, *_ELSEWHERE.get(name, ())) for name in entries)))
            entries = {name: moved[name] if name in moved else entries[name] for name in order}
        return {**entries, **masked}


def without_ids(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a ``volume.report`` with None for the hashes of its identifiers, as files get them."""
    entries = dict(report)
    if isinstance(entries.get("series"), Mapping):
        entries["series"] = {**entries["series"], "uid_hash": None}
    if entries.get("frame_of_reference_hash") is not None:
        entries["frame_of_reference_hash"] = None
    return entries


def amend(report: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Return a report with entries changed or added; a certificate stays one, with others in `Certificate.masked`."""
    if not isinstance(report, Certificate):
        return {**report, **changes}
    known = {field.name for field in fields(report)}
    masked = {**report.masked, **{name: value for name, value in changes.items() if name not in known}}
    return report.changed(masked=masked, **{name: value for name, value in changes.items() if name in known})
