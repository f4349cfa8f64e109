"""What the corridor job writes: entries of its report, the sheet of a vertebra, and meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume, frame_from_lps
from clrecon.geometry.affine import Float64Array
from clrecon.jobs.run import ScanReport
from clrecon.mesh import Mesh
from clrecon.rendering.pictures.annotations import PictureData, orientation_letters
from clrecon.rendering.pictures.sheets import Panel, Stroke, draw_sheet
from clrecon.spine.corridors import SIDES, Corridor, VertebraCorridors, screw_diameter
from clrecon.spine.measures import SCALE, Bias, Screw, ScrewGrade
from clrecon.spine.solid_bone import sample_volume
from clrecon.system.light_dataclass import dataclass

NOT_FOR_PLANNING = "not for planning an operation: a measurement on one surface, checked on phantoms alone"

KNOWN_BIAS = (
    "on phantoms with slices up to 2 mm the radius along a line is 0.5 mm too small to 0.2 too large at the half level"
    " and 0.4 to 0.7 mm too large at 226 HU; with 2 x 2 x 3 mm 0.3 mm too small to 0.6 mm too large, and 0.5 to 1.2 mm"
    " too large; with 3 mm up to 1.4 and 1.9 mm too large"
)
KNOWN_CORTEX_BIAS = (
    "on phantoms the radius along a line is at most 0.1 mm too large with slices of 1.25 mm, 0.3 with 1.4 x 1.4 x 2 mm"
    " and 0.5 with 2 x 2 x 3 mm"
)
"""What is known of the surface at a level, and of the one fitted to the bone; docs/corridor.md has the table."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CorridorReport(ScanReport):
    SCHEMA = "corridor"

    notice: str
    level_bias: str
    surface: str
    iso_value_hu: float
    iso_value_reason: str
    iso_value_choice: Mapping[str, Any] | None
    space: str
    margin_mm: float
    grade_scale: str | None
    vertebrae: list[dict[str, Any]]
    outputs: list[dict[str, Any]]
    affine_ijk_to_lps_mm: list[list[float]]


def _point_placer(space: str) -> Callable[[NDArray[Any] | None], list[float] | None]:
    turn = frame_from_lps(space)

    def place_point(point: NDArray[Any] | None) -> list[float] | None:
        return None if point is None else [round(float(value), 3) for value in turn @ point]

    return place_point


def _round_numbers(value: Any, digits: int = 3) -> Any:
    if value is None:
        return None
    if isinstance(value, dict):
        return {name: _round_numbers(own, digits) for name, own in value.items()}
    return [_round_numbers(own, digits) for own in value] if isinstance(value, tuple) else round(float(value), digits)


def describe_vertebra(
    vertebra: VertebraCorridors, label: int, margin: float, space: str, screws: list[tuple[Screw, ScrewGrade]]
) -> dict[str, Any]:
    to_space = _point_placer(space)
    frame = vertebra.frame
    turn = frame_from_lps(space)
    return {
        "name": vertebra.name,
        "label": label,
        "frame": {
            "origin_mm": to_space(frame.origin),
            "axes": {
                name: [round(float(value), 5) for value in turn @ axis]
                for name, axis in zip(("left", "posterior", "cranial"), frame.axes, strict=True)
            },
            "body_height_mm": round(frame.body_height, 2),
            "body_depth_mm": round(frame.body_y[1] - frame.body_y[0], 2),
            "canal_radius_mm": round(frame.canal_radius, 2),
        },
        "corridors": [describe_corridor(corridor, margin, space) for corridor in vertebra.corridors],
        "screws": [describe_grade(screw, grade, space) for screw, grade in screws],
    }


def describe_corridor(corridor: Corridor, margin: float, space: str) -> dict[str, Any]:
    """Return the entries of one side; all but `side` and `refused` are None where there is no corridor."""
    to_space, radius = _point_placer(space), corridor.radius
    return {
        "side": corridor.side,
        "refused": corridor.refused,
        "radius_mm": _round_numbers(radius),
        "screw_diameter_mm": None if radius is None else screw_diameter(radius, margin),
        "length_mm": _round_numbers(corridor.length, 2),
        "medial_angle_deg": _round_numbers(corridor.medial_deg, 1),
        "sagittal_angle_deg": _round_numbers(corridor.sagittal_deg, 1),
        "medial_angle_range_deg": _round_numbers(corridor.medial_range_deg, 1),
        "sagittal_angle_range_deg": _round_numbers(corridor.sagittal_range_deg, 1),
        "medial_angle_lps_deg": _round_numbers(corridor.medial_lps_deg, 1),
        "sagittal_angle_lps_deg": _round_numbers(corridor.sagittal_lps_deg, 1),
        "entry_mm": to_space(corridor.entry),
        "tip_mm": to_space(corridor.tip),
        "counted_from_mm": to_space(corridor.back),
        "pedicle_mm": to_space(corridor.pass_point),
        "margins_mm": _round_numbers(corridor.margins),
        "canal_mm": _round_numbers(corridor.canal),
        "level_bias_mm": _describe_bias(corridor.bias),
        "placed_by_hu_share": _round_numbers(corridor.by_hu_share),
        "width_voxels": _round_numbers(corridor.width_voxels, 2),
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
    to_space = _point_placer(space)
    return {
        "name": screw.name,
        "side": grade.side,
        "entry_mm": to_space(screw.entry),
        "tip_mm": to_space(screw.tip),
        "diameter_mm": float(screw.diameter),
        "length_mm": round(float(np.linalg.norm(screw.tip - screw.entry)), 2),
        "grade": grade.grade,
        "scale": SCALE,
        "breach_mm": _round_numbers(grade.breach_mm, 2),
        "direction": grade.direction,
        "breaches_mm": _round_numbers(grade.breaches_mm, 2),
        "margins_mm": _round_numbers(grade.margins_mm, 2),
        "front_mm": _round_numbers(grade.front_mm, 2),
    }


_WIDTH_MM = 96.0
PIXELS = 400
_CORRIDOR = (90, 230, 120)
LIMIT = (255, 190, 60)
GIVEN = (255, 90, 90)
"""Colours of corridor, largest screw and given screws."""

_LEAST_RISE = 1e-6
"""Rise of an axis over a plane, as a share of its length, below which the axis lies in the plane."""


@dataclass(frozen=True, eq=False)
class _Plane:
    centre: Float64Array
    right: Float64Array
    down: Float64Array

    def sample(self, volume: Volume) -> NDArray[np.float32]:
        """Return HU (trilinear) of a square of `_WIDTH_MM`, shape (`PIXELS`, `PIXELS`); air beyond the scan."""
        steps = (np.arange(PIXELS) - (PIXELS - 1) / 2.0) * (_WIDTH_MM / PIXELS)
        points = self.centre + steps[:, None, None] * self.down + steps[None, :, None] * self.right
        return sample_volume(volume, points.reshape(-1, 3)).reshape(PIXELS, PIXELS)

    def flatten(self, points: Float64Array) -> Float64Array:
        return np.stack(((points - self.centre) @ self.right, (points - self.centre) @ self.down), axis=1)

    def along(self, ends: Float64Array, radius: float, color: Any) -> list[Stroke]:
        """Return the two sides of a cylinder that lies in the plane, and its axis."""
        flat = self.flatten(ends)
        along = (flat[1] - flat[0]) / max(float(np.linalg.norm(flat[1] - flat[0])), 1e-9)
        across = radius * np.array((-along[1], along[0]))
        frame = np.stack((flat[0] + across, flat[1] + across, flat[1] - across, flat[0] - across, flat[0] + across))
        return [Stroke(frame, color), Stroke(flat, color)]

    def across(self, ends: Float64Array, radius: float, color: Any) -> list[Stroke]:
        """Return the circle where a cylinder's axis meets the plane; of one that lies in the plane, its section."""
        height, far_height = (ends - self.centre) @ np.cross(self.right, self.down)
        if abs(far_height - height) > _LEAST_RISE * float(np.linalg.norm(ends[1] - ends[0])):
            crossing = ends[0] + height / (height - far_height) * (ends[1] - ends[0])
            return [Stroke(self.flatten(crossing[None]), color, radius)]
        half_width = np.sqrt(max(radius**2 - height**2, 0.0))
        return self.along(ends, float(half_width), color) if half_width > 0.0 else []


def draw_corridors(
    volume: Volume, vertebra: VertebraCorridors, screws: Sequence[Screw], margin: float, footer: Sequence[str]
) -> PictureData:
    """Draw a row for each side: two slices through the line, and one square to it at its narrowest section."""
    rows = [
        _draw_row(
            volume,
            vertebra,
            corridor,
            [screw for screw in screws if _side_of(vertebra, screw) == corridor.side],
            margin,
        )
        for corridor in vertebra.corridors
    ]
    return draw_sheet(rows, footer)


def _side_of(vertebra: VertebraCorridors, screw: Screw) -> str:
    first, last = vertebra.frame.to_frame(np.stack((screw.entry, screw.tip)))
    share = np.clip((vertebra.frame.body_y[1] - first[1]) / min(last[1] - first[1], -1e-9), 0.0, 1.0)
    return "left" if (first + share * (last - first))[0] > vertebra.frame.canal[0] else "right"


def _draw_row(
    volume: Volume, vertebra: VertebraCorridors, corridor: Corridor, screws: Sequence[Screw], margin: float
) -> list[Panel]:
    axes, name = vertebra.frame.axes, f"{vertebra.name}, {corridor.side}"
    ends: Float64Array
    if corridor.tip is not None and corridor.entry is not None and corridor.pass_point is not None:
        ends, centre = np.stack((corridor.entry, corridor.tip)), corridor.pass_point
        lines = [
            f"{name}: radius {corridor.radius:.1f} mm",
            f"screw to {screw_diameter(corridor.radius or 0.0, margin):.1f} mm, margin {margin:g} mm",
        ]
    else:
        side = SIDES[corridor.side]
        centre = vertebra.frame.to_lps(
            np.array([[vertebra.frame.canal[0] + 14.0 * side, vertebra.frame.body_y[1], 0.0]])
        )[0]
        ends, lines = np.stack((centre + 20.0 * axes[1], centre - 25.0 * axes[1])), [name, "no corridor"]
    back = ends[0] - ends[1]
    back /= np.linalg.norm(back)
    left = axes[0] - (axes[0] @ back) * back
    left /= np.linalg.norm(left)
    up = np.cross(back, left)
    up = up if up @ axes[2] > 0.0 else -up
    # seen from the patient's feet, from the patient's left, and from behind
    planes = ((left, back, "in the plane of line and left"), (back, -up, "of line and cranial"), (-left, -up, "across"))
    panels = []
    for number, (right, down, caption) in enumerate(planes):
        plane = _Plane(centre, right, down)
        draw = plane.along if number < 2 else plane.across
        strokes = list(chain(*(draw(*cylinder) for cylinder in _cylinders(corridor, ends, screws, margin))))
        edges = tuple(orientation_letters(way)[:1] for way in (-right, right, -down, down))
        words = [*lines, caption] if number == 0 else [caption]
        panels.append(Panel(plane.sample(volume), _WIDTH_MM / PIXELS, words, strokes, edges))  # type: ignore[arg-type]
    return panels


def _cylinders(
    corridor: Corridor, ends: Float64Array, screws: Sequence[Screw], margin: float
) -> list[tuple[Float64Array, float, tuple[int, int, int]]]:
    """Return ends, radius and colour of what is drawn: corridor, largest screw, given screws."""
    drawn = []
    if corridor.radius is not None:
        drawn.append((ends, corridor.radius, _CORRIDOR))
        if corridor.radius > margin:
            drawn.append((ends, corridor.radius - margin, LIMIT))
    drawn += [(np.stack((screw.entry, screw.tip)), screw.diameter / 2.0, GIVEN) for screw in screws]
    return drawn


FACES = 48
"""Sides of a cylinder: its walls lie at most 0.2 % of the radius inside of the true one."""


def cylinder_mesh(first: NDArray[np.float64], last: NDArray[np.float64], radius: float) -> Mesh:
    """Return a closed cylinder between two points, LPS mm, with its normals outwards."""
    axis = np.asarray(last, dtype=np.float64) - first
    unit = axis / np.linalg.norm(axis)
    across = np.cross(unit, np.eye(3)[int(np.abs(unit).argmin())])
    across /= np.linalg.norm(across)
    turns = np.linspace(0.0, 2.0 * np.pi, FACES, endpoint=False)
    ring = radius * (np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * np.cross(unit, across))
    vertices = np.concatenate((first + ring, last + ring, [first, last]))
    here = np.arange(FACES)
    after = (here + 1) % FACES
    below, above = np.full(FACES, 2 * FACES), np.full(FACES, 2 * FACES + 1)
    triangles = np.concatenate(
        [
            np.stack(corners, axis=1)
            for corners in (
                (here, after, after + FACES),
                (here, after + FACES, here + FACES),
                (below, after, here),
                (above, here + FACES, after + FACES),
            )
        ]
    )
    return Mesh(vertices, triangles)


def cylinder_meshes(vertebra: VertebraCorridors, screws: list[Screw]) -> dict[str, Mesh]:
    """Return the cylinders of a vertebra by name: ``left``, ``right``, ``screw_1`` and so on."""
    meshes = {}
    for corridor in vertebra.corridors:
        if corridor.radius is not None and corridor.entry is not None and corridor.tip is not None:
            meshes[corridor.side] = cylinder_mesh(corridor.entry, corridor.tip, corridor.radius)
    for number, screw in enumerate(screws, start=1):
        meshes[f"screw_{number}"] = cylinder_mesh(screw.entry, screw.tip, screw.diameter / 2.0)
    return meshes
