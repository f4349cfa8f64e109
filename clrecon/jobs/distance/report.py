"""`DistanceReport`: how far two meshes lie apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from clrecon.system.records import Record


@dataclass(frozen=True, eq=False, kw_only=True)
class DistanceReport(Record):
    """Report of `measure_meshes`; distances are mm.

    a, b: Each mesh: ``name``, ``kind``, ``space`` and ``space_from`` of its file, ``vertices``, ``triangles``,
        ``closed``, ``area_mm2``, ``volume_ml``, ``bounds_mm`` (LPS).
    a_to_b_mm, b_to_a_mm: ``mean``, ``rms``, ``p95`` and ``max`` of the distances without sign.
    a_to_b_signed_mm, b_to_a_signed_mm: See `clrecon.mesh.compare.signed.SideDistance`; None where the other mesh is not
        closed.
    colors: ``range_mm``, ``signed`` and ``beyond_share`` of vertices of A: how distances became colours.
    outputs: ``kind``, ``name`` and ``bytes`` of each file.
    device: Where a picture was drawn.
    """

    a: Mapping[str, Any]
    b: Mapping[str, Any]
    hausdorff_mm: float
    hd95_mm: float
    assd_mm: float
    a_to_b_mm: Mapping[str, float]
    b_to_a_mm: Mapping[str, float]
    a_to_b_signed_mm: Mapping[str, float] | None
    b_to_a_signed_mm: Mapping[str, float] | None
    samples: int
    colors: Mapping[str, Any] | None
    outputs: list[dict[str, Any]]
    device: str | None
    version: str
    platform: str
    warnings: list[str]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None
