"""Solids that scenes are made of: balls, rods, columns, boxes, and parts cut from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from clrecon.phantom.fields import Field, capsule, ellipse, ellipsoid
from clrecon.phantom.scenes import Part, Point

Distance = Callable[[Field, Field, Field], Field]


def ball(material: str, hu: float, center: Point, half: Point) -> Part:
    """Make an ellipsoid with the half axes `half`."""
    low = (-half[0], -half[1], -half[2])
    return Part(material, hu, lambda x, y, z: ellipsoid(x, y, z, half), low, half, center)


def rod(material: str, hu: float, a: Point, b: Point, radius_a: float, radius_b: float | None = None) -> Part:
    """Make a rod with round ends from `a` to `b`."""
    end = radius_a if radius_b is None else radius_b
    wide = max(radius_a, end)
    low, high = np.minimum(a, b) - wide, np.maximum(a, b) + wide
    return Part(
        material,
        hu,
        lambda x, y, z: capsule(x, y, z, a, b, radius_a, end),
        (float(low[0]), float(low[1]), float(low[2])),
        (float(high[0]), float(high[1]), float(high[2])),
    )


def column(
    material: str,
    hu: float,
    center: tuple[float, float],
    half: tuple[float, float],
    z: tuple[float, float] = (-1e4, 1e4),
) -> Part:
    """Make an elliptic column along z between two heights; by default without ends."""

    def distance(x: Field, y: Field, height: Field) -> Field:
        ends = np.minimum(height - np.float32(z[0]), np.float32(z[1]) - height)
        return np.minimum(ellipse(x, y, *half), ends)

    return Part(material, hu, distance, (-half[0], -half[1], z[0]), (*half, z[1]), (*center, 0.0))


def box(material: str, hu: float, low: Point, high: Point) -> Part:
    """Make a box along the axes."""
    half = tuple((b - a) / 2.0 for a, b in zip(low, high, strict=True))
    middle = tuple((b + a) / 2.0 for a, b in zip(low, high, strict=True))

    def distance(x: Field, y: Field, z: Field) -> Field:
        sides = (np.float32(length) - np.abs(at) for length, at in zip(half, (x, y, z), strict=True))
        return np.minimum.reduce(list(sides))

    return Part(
        material, hu, distance, (-half[0], -half[1], -half[2]), (half[0], half[1], half[2]),
        (middle[0], middle[1], middle[2]),
    )  # fmt: skip


def cut(part: Part, keep: Distance) -> Part:
    """Cut a part: keep the points where `keep`, in the part's own frame, is above 0."""
    whole = part.distance
    return dataclasses.replace(part, distance=lambda x, y, z: np.minimum(whole(x, y, z), keep(x, y, z)))
