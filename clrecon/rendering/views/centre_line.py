"""Centre lines: a smooth curve through points in mm, parametrised by arc length, with frames that do not twist."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.volume import Volume
from clrecon.system.base_classes import Message

SAME_PLACE_MM = 1e-6
"""Distance up to which a point counts as the same as the one before."""

PIECES = 64
"""Number of parts of each span between two points over which the length is integrated."""

FARTHEST_MM = 1e6
"""Largest coordinate; more than a kilometre is a mistake."""


def _gauss_nodes() -> tuple[Float64Array, Float64Array]:
    nodes, weights = np.polynomial.legendre.leggauss(5)
    return 0.5 + 0.5 * nodes, 0.5 * weights


class Curve(Message):
    """A smooth curve through points, parametrised by arc length.

    A cubic spline (not-a-knot; a parabola through three points, a straight line through two) with the distances
    between the points as its parameter.  Its length is integrated (Gauss and Legendre, 5 nodes in each of 64 parts of
    a span), and places are found by their arc length.

    points: array_like, shape (n, 3). LPS mm, in order along the curve; repeated points count once.
    """

    _UNSENT = ("_spline", "_lengths")

    def __init__(self, points: ArrayLike):
        try:
            given = np.array(points, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise UsageError(f"a centre line is an array of points (n, 3) in LPS mm: {error}") from error
        if given.ndim != 2 or given.shape[1] != 3:
            raise UsageError(f"a centre line is an array of points (n, 3) in LPS mm, not of shape {given.shape}")
        wrong = np.flatnonzero(~(np.abs(given) <= FARTHEST_MM).all(axis=1))
        if len(wrong):
            at = int(wrong[0])
            raise UsageError(f"point {at} of the centre line is no place in mm: {_describe(given[at])}")
        apart = np.ones(len(given), bool)
        apart[1:] = np.linalg.norm(np.diff(given, axis=0), axis=1) > SAME_PLACE_MM
        self.points: Float64Array = given[apart]
        if len(self.points) < 2:
            raise UsageError(f"a centre line needs at least two different points, these are {len(self.points)}")

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicSpline

        knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])
        return CubicSpline(knots, self.points, bc_type="not-a-knot")

    @cached_property
    def _lengths(self) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Compute the parameters of the ends of all parts, their arc lengths, and the derivatives of length there."""
        knots = self._spline.x
        shares = np.arange(PIECES) / PIECES
        ends = np.append((knots[:-1, None] + shares * np.diff(knots)[:, None]).ravel(), knots[-1])
        nodes, weights = _gauss_nodes()
        steps = np.diff(ends)
        speeds = np.linalg.norm(self._spline(ends[:-1, None] + steps[:, None] * nodes, 1), axis=-1)
        lengths = np.concatenate([[0.0], np.cumsum(steps * (speeds @ weights))])
        return ends, lengths, np.linalg.norm(self._spline(ends, 1), axis=-1)

    @property
    def length(self) -> float:
        """Arc length from the first point to the last, mm."""
        return float(self._lengths[1][-1])

    def parameters(self, arc: ArrayLike) -> Float64Array:
        """Return the parameters of the spline at arc lengths (n,) in mm, from 0 to `length`."""
        ends, lengths, speeds = self._lengths
        wanted = np.clip(np.asarray(arc, dtype=np.float64), 0.0, lengths[-1])
        part = np.clip(np.searchsorted(lengths, wanted, side="right") - 1, 0, len(ends) - 2)
        found = ends[part] + (wanted - lengths[part]) / speeds[part]
        nodes, weights = _gauss_nodes()
        for _ in range(3):  # Newton's method on the integral from the start of the part
            way = found - ends[part]
            passed = np.linalg.norm(self._spline(ends[part][:, None] + way[:, None] * nodes, 1), axis=-1) @ weights
            speed = np.linalg.norm(self._spline(found, 1), axis=-1)
            found = found - (lengths[part] + way * passed - wanted) / speed
        return np.asarray(np.clip(found, ends[0], ends[-1]))

    def at(self, arc: ArrayLike) -> Float64Array:
        """Return places (n, 3) in LPS mm at arc lengths (n,) in mm."""
        return np.asarray(self._spline(self.parameters(arc)))

    def tangents(self, arc: ArrayLike) -> Float64Array:
        """Return unit tangents (n, 3) at arc lengths (n,)."""
        along = self._spline(self.parameters(arc), 1)
        return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))

    def smallest_radius(self) -> float:
        """Return the smallest radius of curvature in mm, infinite for a straight line."""
        ends = self._lengths[0]
        first, second = self._spline(ends, 1), self._spline(ends, 2)
        bend = np.linalg.norm(np.cross(first, second), axis=1)
        speed = np.linalg.norm(first, axis=1)
        with np.errstate(divide="ignore"):
            return float((speed**3 / np.where(bend > 1e-12 * speed**3, bend, 0.0)).min())

    def reversed(self) -> Curve:
        """Return the same curve from its last point to its first."""
        return Curve(self.points[::-1])

    def check_within(self, volume: Volume) -> None:
        """Check that all points lie within the box of a volume."""
        ijk = volume.lps_to_ijk(self.points)
        outside = np.flatnonzero(((ijk < -0.5 - 1e-6) | (ijk > np.array(volume.shape_ijk) - 0.5 + 1e-6)).any(axis=1))
        if len(outside) == 0:
            return
        corners = volume.ijk_to_lps([tuple(n - 0.5 if b else -0.5 for n, b in zip(volume.shape_ijk, bits, strict=True))
                                     for bits in np.ndindex(2, 2, 2)])  # fmt: skip
        at = int(outside[0])
        raise UsageError(
            f"{len(outside)} of {len(self.points)} points of the centre line lie outside of the volume, the first is"
            f" point {at} at {_describe(self.points[at])} LPS mm: the volume runs from {_describe(corners.min(axis=0))}"
            f" to {_describe(corners.max(axis=0))} (are the points RAS?)"
        )


def _describe(point: ArrayLike) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in np.asarray(point)) + ")"


def rotation_minimising_normals(places: Float64Array, tangents: Float64Array, first: ArrayLike) -> Float64Array:
    """Return normals along a curve that rotate around it as little as possible, so that frames do not twist.

    Method: double reflection (Wang, Juettler, Zheng and Liu 2008, "Computation of rotation minimizing frames"), of
    fourth order in the distance of the places.

    places: ndarray, shape (n, 3). Places along the curve.
    tangents: ndarray, shape (n, 3). Unit.
    first: array_like, shape (3,). Direction of the first normal; its component along the tangent is ignored.

    Returns: ndarray, shape (n, 3), float64. Unit, across the tangents.
    """
    normals = np.empty_like(places)
    start = np.asarray(first, dtype=np.float64)
    start = start - (start @ tangents[0]) * tangents[0]
    size = np.linalg.norm(start)
    if size < 1e-6:
        raise UsageError("the centre line begins along the direction that should run across it: take another view")
    normals[0] = start / size
    for n in range(len(places) - 1):
        normals[n + 1] = _reflect_twice(places[n : n + 2], tangents[n : n + 2], normals[n])
    return normals


def _reflect_twice(places: Float64Array, tangents: Float64Array, normal: Float64Array) -> Float64Array:
    chord = places[1] - places[0]
    c1 = float(chord @ chord)
    moved, tangent = normal, tangents[0]
    if c1 > 0.0:
        moved = normal - (2.0 / c1) * (chord @ normal) * chord
        tangent = tangent - (2.0 / c1) * (chord @ tangent) * chord
    turn = tangents[1] - tangent
    c2 = float(turn @ turn)
    if c2 > 0.0:
        moved = moved - (2.0 / c2) * (turn @ moved) * turn
    moved = moved - (moved @ tangents[1]) * tangents[1]
    return np.asarray(moved / np.linalg.norm(moved))
