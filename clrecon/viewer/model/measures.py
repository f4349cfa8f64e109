"""Measures between places that were picked: names, files, and which pieces of their lines a picture does not hide."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, frame_from_lps
from clrecon.rendering import Rendering
from clrecon.system.arguments import Space
from clrecon.system.light_dataclass import dataclass

Point = tuple[float, float, float]

POINTS_OF = {"distance": 2, "angle": 3, "curve": None, "seed": 1, "circle": 2, "box": 2}
"""Tools, and the clicks that make a measure of each; a curve has as many as it gets."""

TOOLS = tuple(POINTS_OF)


@dataclass(frozen=True, kw_only=True)
class Measure:
    """What was measured between points in LPS mm.

    kind: "distance", "angle", "curve" (its length), "seed", which has no value, "circle" or "box" (its mean HU).
    unit: "mm", "degrees", "HU" or "".
    text: As it is written beside the picture, behind the name.
    sd, voxels, area_mm2: Of a circle or box: deviation of the HU of its voxels, how many there are, and its area.
    thickness_mm: Of the slice that a circle or box was drawn on; 0: one layer of voxels.
    """

    kind: str
    points: tuple[Point, ...]
    value: float | None
    unit: str
    text: str
    name: str = ""
    sd: float | None = None
    voxels: int | None = None
    area_mm2: float | None = None
    thickness_mm: float = 0.0

    @property
    def outline(self) -> tuple[Point, ...]:
        """Its line in the patient, closed around a region; of other measures their points."""
        if self.kind not in REGIONS:
            return self.points
        corner, *ends = np.array(self.points)
        if self.kind == "circle":
            angles = np.linspace(0.0, 2.0 * np.pi, _OUTLINE + 1)
            places = corner + np.stack([np.cos(angles), np.sin(angles)], axis=1) @ (np.array(ends) - corner)
        else:
            corners = np.array([*self.points, self.points[0]])
            shares = np.linspace(0.0, 4.0, _OUTLINE + 1)
            places = np.stack([np.interp(shares, np.arange(5), column) for column in corners.T], axis=1)
        return tuple((x, y, z) for x, y, z in places.tolist())

    def describe(self) -> dict[str, Any]:
        points = [[round(value, 3) for value in point] for point in self.points]
        fields: dict[str, Any] = {"name": self.name, "kind": self.kind, "points": points}
        fields |= {"value": self.value, "unit": self.unit, "text": self.text}
        return fields if self.voxels is None else {**fields, **{name: getattr(self, name) for name in _OF_REGIONS}}


_OF_REGIONS = ("sd", "voxels", "area_mm2", "thickness_mm")


def measure_points(kind: str, points: Sequence[Point], name: str = "") -> Measure:
    """Measure points in LPS mm by one of `TOOLS`; the angle is that at the second of three."""
    places = np.array(points, dtype=np.float64).reshape(-1, 3)
    value: float | None = None
    if kind == "seed":
        unit, text = "", ", ".join(f"{x:.1f}" for x in places[0])
    elif kind == "angle":
        value = round(_angle_degrees(places), 3)
        unit, text = "degrees", f"{value:.1f}°"
    else:
        if len(places) < 2:
            raise UsageError(
                f"a {kind} is made of at least 2 points, there {'is' if len(places) == 1 else 'are'} {len(places)}"
            )
        value = round(float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()), 4)
        unit, text = "mm", f"{value:.1f} mm"
    return Measure(kind=kind, points=tuple(points), value=value, unit=unit, text=text, name=name)


def _angle_degrees(places: Float64Array) -> float:
    if len(places) != 3:
        raise UsageError(f"an angle is made of 3 points, not of {len(places)}")
    sides = places[[0, 2]] - places[1]
    lengths = np.linalg.norm(sides, axis=1)
    if lengths.min() < 1e-6:
        raise UsageError("two points of the angle lie in one place: pick them anew")
    cosine = float(sides[0] @ sides[1] / (lengths[0] * lengths[1]))
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))


def free_measure_name(kind: str, measures: Sequence[Measure]) -> str:
    """Return the first name of a kind that no measure has: "distance 1"; a seed is a "place"."""
    names = {each.name for each in measures}
    word = "place" if kind == "seed" else kind
    return next(name for number in count(1) if (name := f"{word} {number}") not in names)


_MOST_NAME = 80


def checked_measure_name(name: Any) -> str:
    """Return a name without spaces around it: one line of characters that can be seen."""
    short = name.strip() if isinstance(name, str) else ""
    if not (0 < len(short) <= _MOST_NAME and short.isprintable()):
        raise UsageError(f"the name of a measure is 1 to {_MOST_NAME} visible characters, not {name!r:.60}")
    return short


MEASURE_FORMATS = (".mrk.json", ".json", ".csv")

_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
"""The name by which 3D Slicer knows its files; nothing is fetched from there."""

_MARKUPS = {
    "distance": "Line", "angle": "Angle", "curve": "Curve", "seed": "Fiducial", "circle": "ClosedCurve",
    "box": "ClosedCurve",
}  # fmt: skip

REGIONS = {"circle": 3, "box": 4}
"""Measures on slices, and the points of each: a middle and two a quarter apart, or corners one after the other."""

_OUTLINE = 48
"""Points of the outline of a region."""


def encode_measures(measures: Sequence[Measure], name: str, space: Space) -> bytes:
    """Return the content of a file of `MEASURE_FORMATS` by its name: markups are in LPS, the others in `space`."""
    if name.lower().endswith(".mrk.json"):
        markups = [_describe_markup(each) for each in measures]
        return _encode_json({"@schema": _SCHEMA, "markups": markups})
    signs = np.diag(frame_from_lps(space))
    rows = [each.describe() for each in measures]
    for row, measure in zip(rows, measures, strict=True):
        row["points"] = [[round(float(value), 3) + 0.0 for value in signs * point] for point in measure.points]
        del row["text"]
    if name.lower().endswith(".json"):
        return _encode_json({"space": space.upper(), "points_unit": "mm", "measures": rows})
    stream = io.StringIO()
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(["name", "kind", "value", "unit", *_OF_REGIONS, "space", "points_mm"])
    for row in rows:
        points = "; ".join(" ".join(f"{value:.3f}" for value in point) for point in row["points"])
        region = [row.get(name) for name in _OF_REGIONS]
        table.writerow([row["name"], row["kind"], row["value"], row["unit"], *region, space.upper(), points])
    return stream.getvalue().encode()


def _describe_markup(measure: Measure) -> dict[str, Any]:
    places = measure.outline[:-1] if measure.kind in REGIONS else measure.points
    points = [
        {"id": str(number), "label": measure.name if len(places) == 1 else f"{measure.name}-{number}",
         "position": [round(value, 3) for value in point]}
        for number, point in enumerate(places, 1)
    ]  # fmt: skip
    if measure.kind in REGIONS:
        points[0]["description"] = f"{measure.text}, {measure.voxels} voxels, {measure.area_mm2} mm2"
    return {
        "type": _MARKUPS[measure.kind],
        "name": measure.name,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "controlPoints": points,
    }


def _encode_json(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()


_STEPS = 64
"""Places on each line that are compared with the picture's depth."""

_BEFORE_MM, _BEFORE_PIXELS = 0.5, 2.0
"""By which a place may lie behind what is seen at its pixel: measures begin on the surface."""


def seen_pieces(rendering: Rendering, lines: Sequence[Float64Array], *, expected: bool) -> list[list[list[float]]]:
    """Return the ends of the pieces of lines (n, 3) that nothing in a picture hides, by its depths or expected ones."""
    camera, size = rendering.camera, rendering.size
    assert camera is not None
    depth = rendering.expected_depth if expected else rendering.depth
    slack = _BEFORE_MM + _BEFORE_PIXELS * camera.pixel_mm(size)
    pieces: list[list[list[float]]] = []
    for line in lines:
        for start, end in zip(line[:-1], line[1:], strict=True):
            places = start + np.linspace(0.0, 1.0, _STEPS)[:, None] * (end - start)
            pixels, depths = camera.project(places, size)
            known = np.isfinite(pixels).all(axis=1)
            column, row = np.where(known[:, None], np.floor(pixels), 0).astype(np.int64).T
            inside = known & (column >= 0) & (row >= 0) & (column < size[0]) & (row < size[1])
            surface = depth[np.where(inside, row, 0), np.where(inside, column, 0)]
            seen = ~(inside & (depths > surface + slack))  # beside NaN, where nothing is hit, all is seen
            ends = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(np.int8), [0]])))
            pieces += [np.round(places[[a, b - 1]], 3).tolist() for a, b in ends.reshape(-1, 2) if b - a > 1]
    return pieces
