"""`ViewReport`: what is shown, and in which file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from clrecon.system.records import Record


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewReport(Record):
    """Report of `write_view`.

    inputs: Each input: ``name`` of the file or folder without those above it, ``kind`` ("scan", "STL" ...), ``space``
        and ``space_from`` of a mesh (None for a scan), ``triangles``; of a scan ``volume``, its certificate, and
        ``surface``, the values that it encloses.
    parts: ``name``, ``triangles``, ``ml`` and ``color`` of each part that can be switched.
    half_step_mm: Largest distance along an axis that a vertex is moved by.
    output: ``format`` and ``bytes``.
    device: None where no input is a scan.
    """

    inputs: list[dict[str, Any]]
    parts: list[dict[str, Any]]
    vertices: int
    triangles: int
    half_step_mm: float
    space: str
    output: Mapping[str, Any]
    device: str | None
    version: str
    platform: str
    warnings: list[str]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None
