"""Signed distances to simple shapes, for the spine phantom, and the nearest points of such surfaces.

Distances are arrays of the type of the coordinates in mm, positive inside.  Ellipses and stretched capsules give
first-order distances (exact on the surface, approximate away from it), which is what a partial-volume ramp of about one
voxel needs.  Smooth union after I. Quilez' polynomial smooth minimum."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array

Field = NDArray[np.float32]
Point = tuple[float, float, float]


def coverage(distance: Field, ramp_mm: float) -> Field:
    """Return the share of a voxel that lies inside: a linear ramp `ramp_mm` wide, centred on the surface."""
    share = distance * np.float32(1.0 / ramp_mm)
    share += np.float32(0.5)
    return np.clip(share, 0.0, 1.0, out=share)


def smooth_union(a: Field, b: Field, blend_mm: float) -> Field:
    """Union of two distances with a fillet of about `blend_mm`."""
    mixed = np.abs(a - b)
    mixed *= np.float32(-1.0 / blend_mm)
    mixed += np.float32(1.0)
    np.maximum(mixed, 0.0, out=mixed)
    mixed *= mixed
    mixed *= np.float32(blend_mm / 4.0)
    mixed += np.maximum(a, b)
    return mixed


def ellipse(x: Field, y: Field, half_x: float | Field, half_y: float | Field) -> Field:
    """Distance to an ellipse (or an elliptic cylinder) about the origin."""
    u, v = x / half_x, y / half_y
    radius = np.sqrt(u * u + v * v)
    slope = np.sqrt((u / half_x) ** 2 + (v / half_y) ** 2)
    # At the very centre radius / slope is 0 / 0; the distance there is about the smaller half axis.
    return np.asarray((1.0 - radius) * (radius + 1e-3) / (slope + 1e-3 / np.minimum(half_x, half_y)), dtype=x.dtype)


def ellipsoid(x: Field, y: Field, z: Field, half: Point) -> Field:
    u, v = x / half[0], y / half[1]
    w = z / half[2]
    radius = np.sqrt(u * u + v * v + w * w)
    slope = np.sqrt((u / half[0]) ** 2 + (v / half[1]) ** 2 + (w / half[2]) ** 2)
    return np.asarray((1.0 - radius) * (radius + 1e-3) / (slope + 1e-3 / min(half)), dtype=x.dtype)


def capsule(
    points: tuple[Field, Field, Field], a: Point, b: Point, radius_a: float, radius_b: float, flatten: float = 1.0
) -> Field:
    """Distance to a rod from `a` to `b`, its radii `radius_a` and `radius_b`, its height its width / `flatten`."""
    x, y, z = points
    ax, ay = a[0], a[1]
    az = a[2] * flatten
    dx, dy = b[0] - ax, b[1] - ay
    dz = b[2] * flatten - az
    length2 = dx * dx + dy * dy + dz * dz
    px, py = x - np.float32(ax), y - np.float32(ay)
    pz = z * np.float32(flatten) - np.float32(az)
    along = px * np.float32(dx / length2)
    along += py * np.float32(dy / length2)
    along += pz * np.float32(dz / length2)
    np.clip(along, 0.0, 1.0, out=along)
    px -= along * np.float32(dx)
    py -= along * np.float32(dy)
    pz -= along * np.float32(dz)
    px *= px
    py *= py
    pz *= pz
    px += py
    px += pz
    np.sqrt(px, out=px)
    along *= np.float32(radius_b - radius_a)
    along += np.float32(radius_a)
    along -= px
    return along


def waves_at(x: Field, y: Field, z: Field, waves: NDArray[np.float64]) -> Field:
    """Sum of plane waves: rows of `waves` are (wave vector x, y, z in rad/mm, phase, amplitude)."""
    total = np.zeros(np.broadcast(x, y, z).shape, dtype=np.float32)
    for kx, ky, kz, phase, amplitude in waves:
        if math.isclose(amplitude, 0.0, abs_tol=1e-3):
            continue
        total += np.float32(amplitude) * np.cos(
            x * np.float32(kx) + (y * np.float32(ky) + (z * np.float32(kz) + np.float32(phase)))
        )
    return total


Function = Callable[[Float64Array], Float64Array]

_DELTA_MM = 1e-5


def gradient_of(function: Function, points: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return values (n,) and gradients (n, 3) of a function at points (n, 3), by forward differences."""
    shifts = np.concatenate((np.zeros((1, 3)), _DELTA_MM * np.eye(3)))
    values = function((points + shifts[:, None]).reshape(-1, 3)).reshape(4, -1)
    return values[0], (values[1:] - values[0]).T / _DELTA_MM


def nearest_on_surface(
    function: Function, points: Float64Array, starts: Float64Array, rounds: int, damping: float = 0.5
) -> Float64Array:
    """Move `starts`, (n, 3), over the surface towards `points`; return the distances of the nearest points on the way,
    (n,) mm, infinite where the surface was not reached.

    function: Zero on the surface; its gradient is no zero near it.
    damping: Share of the way along the tangent plane that a round goes.
    """
    best = np.full(len(points), np.inf)
    foot = starts
    for _ in range(rounds):
        value, gradient = gradient_of(function, foot)
        square = np.maximum(np.einsum("ij,ij->i", gradient, gradient), 1e-6)
        off = np.abs(value) / np.sqrt(square)
        reached = off < 1e-3
        np.minimum(best, np.where(reached, np.linalg.norm(points - foot, axis=1) + off, np.inf), out=best)
        offset = points - foot
        along = np.einsum("ij,ij->i", offset, gradient) / square
        tangent = offset - along[:, None] * gradient
        foot = foot + damping * tangent - (value / square)[:, None] * gradient
    return best
