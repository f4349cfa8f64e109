"""Measures between places that were picked, and which pieces of their lines a picture does not hide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.rendering import Rendering
from clrecon.system.light_dataclass import dataclass

Point = tuple[float, float, float]

POINTS_OF = {"distance": 2, "angle": 3, "curve": None, "seed": 1}
"""Tools, and the points that make a measure of each; a curve has as many as it gets."""

TOOLS = tuple(POINTS_OF)


@dataclass(frozen=True, kw_only=True)
class Measure:
    """What was measured between points in LPS mm.

    kind: "distance", "angle", "curve" (its length) or "seed", which has no value.
    unit: "mm", "degrees" or "".
    text: As it is written beside the picture.
    """

    kind: str
    points: tuple[Point, ...]
    value: float | None
    unit: str
    text: str

    def describe(self) -> dict[str, Any]:
        points = [[round(value, 3) for value in point] for point in self.points]
        return {"kind": self.kind, "points": points, "value": self.value, "unit": self.unit, "text": self.text}


def measure_points(kind: str, points: Sequence[Point]) -> Measure:
    """Measure points in LPS mm by one of `TOOLS`; the angle is that at the second of three."""
    places = np.array(points, dtype=np.float64).reshape(-1, 3)
    if kind == "seed":
        (point,) = points
        return Measure(kind=kind, points=(point,), value=None, unit="", text=", ".join(f"{x:.1f}" for x in point))
    if kind == "angle":
        if len(places) != 3:
            raise UsageError(f"an angle is made of 3 points, not of {len(places)}")
        sides = places[[0, 2]] - places[1]
        lengths = np.linalg.norm(sides, axis=1)
        if lengths.min() < 1e-6:
            raise UsageError("two points of the angle lie in one place: pick them anew")
        cosine = float(sides[0] @ sides[1] / (lengths[0] * lengths[1]))
        value = math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
        return Measure(kind=kind, points=tuple(points), value=round(value, 3), unit="degrees", text=f"{value:.1f}°")
    if len(places) < 2:
        raise UsageError(
            f"a {kind} is made of at least 2 points, there {'is' if len(places) == 1 else 'are'} {len(places)}"
        )
    value = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    return Measure(kind=kind, points=tuple(points), value=round(value, 4), unit="mm", text=f"{value:.1f} mm")


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
