"""The report of the corridor job."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import frame_from_lps
from clrecon.spine.corridors import Corridor, VertebraCorridors, screw_diameter
from clrecon.spine.measures import SCALE, Bias, Screw, ScrewGrade
from clrecon.system.records import Record

NOT_FOR_PLANNING = "not for planning an operation: a measurement on one surface at one level, checked on phantoms alone"

KNOWN_BIAS = (
    "on phantoms with slices up to 2 mm the radius along a line is 0.5 mm too small to 0.2 too large at the half level"
    " and 0.4 to 0.7 mm too large at 226 HU; with 2 x 2 x 3 mm 0.3 mm too small to 0.6 mm too large, and 0.5 to 1.2 mm"
    " too large; with 3 mm up to 1.4 and 1.9 mm too large"
)
"""What is known of the surface at a level; docs/corridor.md has the table."""


@dataclass(frozen=True, eq=False)
class CorridorReport(Record):
    """The report of the corridor job; the fields are the entries of its JSON.

    notice: What the figures are not for.
    level_bias: What is known of how far the surface at the level lies from that of the bone.
    iso_value_choice: As in the report of a mesh.
    space: Patient frame of all points.
    grade_scale: The scale of `screws`, None without any.
    outputs: Files with what they hold.
    affine_ijk_to_lps_mm: nested list (4, 4)
    volume: The certificate of the volume without its warnings.
    """

    notice: str
    level_bias: str
    iso_value_hu: float
    iso_value_reason: str
    iso_value_choice: Mapping[str, Any] | None
    space: str
    margin_mm: float
    grade_scale: str | None
    vertebrae: list[dict[str, Any]]
    outputs: list[dict[str, Any]]
    affine_ijk_to_lps_mm: list[list[float]]
    version: str
    platform: str
    warnings: list[str]
    volume: Mapping[str, Any]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None


def _placer(space: str) -> Callable[[NDArray[Any] | None], list[float] | None]:
    turn = frame_from_lps(space)

    def place(point: NDArray[Any] | None) -> list[float] | None:
        return None if point is None else [round(float(value), 3) for value in turn @ point]

    return place


def _rounded(value: Any, digits: int = 3) -> Any:
    """Round the numbers of a value; None stays."""
    if value is None:
        return None
    if isinstance(value, dict):
        return {name: _rounded(own, digits) for name, own in value.items()}
    return [_rounded(own, digits) for own in value] if isinstance(value, tuple) else round(float(value), digits)


def describe_vertebra(
    found: VertebraCorridors,
    label: int,
    margin: float,
    space: str,
    screws: list[tuple[Screw, ScrewGrade]],
) -> dict[str, Any]:
    """Return the entries of a vertebra."""
    place, frame, turn = _placer(space), found.frame, frame_from_lps(space)
    return {
        "name": found.name,
        "label": label,
        "frame": {
            "origin_mm": place(frame.origin),
            "axes": {
                name: [round(float(value), 5) for value in turn @ axis]
                for name, axis in zip(("left", "posterior", "cranial"), frame.axes, strict=True)
            },
            "body_height_mm": round(frame.body_height, 2),
            "body_depth_mm": round(frame.body_y[1] - frame.body_y[0], 2),
            "canal_radius_mm": round(frame.canal_radius, 2),
        },
        "corridors": [describe_corridor(corridor, margin, space) for corridor in found.corridors],
        "screws": [describe_grade(screw, grade, space) for screw, grade in screws],
    }


def describe_corridor(corridor: Corridor, margin: float, space: str) -> dict[str, Any]:
    """Return the entries of one side; all but `side` and `refused` are None where there is no corridor."""
    place, radius = _placer(space), corridor.radius
    return {
        "side": corridor.side,
        "refused": corridor.refused,
        "radius_mm": _rounded(radius),
        "screw_diameter_mm": None if radius is None else screw_diameter(radius, margin),
        "length_mm": _rounded(corridor.length, 2),
        "medial_angle_deg": _rounded(corridor.medial_deg, 1),
        "sagittal_angle_deg": _rounded(corridor.sagittal_deg, 1),
        "medial_angle_range_deg": _rounded(corridor.medial_range_deg, 1),
        "sagittal_angle_range_deg": _rounded(corridor.sagittal_range_deg, 1),
        "medial_angle_lps_deg": _rounded(corridor.medial_lps_deg, 1),
        "sagittal_angle_lps_deg": _rounded(corridor.sagittal_lps_deg, 1),
        "entry_mm": place(corridor.entry),
        "tip_mm": place(corridor.tip),
        "counted_from_mm": place(corridor.back),
        "pedicle_mm": place(corridor.pass_point),
        "margins_mm": _rounded(corridor.margins),
        "canal_mm": _rounded(corridor.canal),
        "level_bias_mm": _describe_bias(corridor.bias),
        "placed_by_hu_share": _rounded(corridor.by_hu_share),
        "width_voxels": _rounded(corridor.width_voxels, 2),
        "lines_tried": corridor.tried,
    }


def _describe_bias(bias: Bias | None) -> dict[str, Any] | None:
    if bias is None:
        return None
    return {
        "median": round(bias.median_mm, 2),
        "quartiles": [round(bias.low_mm, 2), round(bias.high_mm, 2)],
        "half_level_hu": round(bias.half_hu, 1),
        "rays": bias.rays,
    }


def describe_grade(screw: Screw, grade: ScrewGrade, space: str) -> dict[str, Any]:
    """Return the entries of a given screw."""
    place = _placer(space)
    return {
        "name": screw.name,
        "side": grade.side,
        "entry_mm": place(screw.entry),
        "tip_mm": place(screw.tip),
        "diameter_mm": float(screw.diameter),
        "length_mm": round(float(np.linalg.norm(screw.tip - screw.entry)), 2),
        "grade": grade.grade,
        "scale": SCALE,
        "breach_mm": _rounded(grade.breach_mm, 2),
        "direction": grade.direction,
        "breaches_mm": _rounded(grade.breaches_mm, 2),
        "margins_mm": _rounded(grade.margins_mm, 2),
        "front_mm": _rounded(grade.front_mm, 2),
    }
