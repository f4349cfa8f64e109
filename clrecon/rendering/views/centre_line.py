"""Centre lines: a smooth curve through points in mm, and the files that hold such points."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.volume import Volume
from clrecon.system.arguments import Space, explains_arguments
from clrecon.system.base_classes import Message
from clrecon.system.paths import read_regular
from clrecon.system.text import escape_text, is_number

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
            index = int(wrong[0])
            raise UsageError(f"point {index} of the centre line is no place in mm: {_as_text(given[index])}")
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
        parameter = ends[part] + (wanted - lengths[part]) / speeds[part]
        nodes, weights = _gauss_nodes()
        for _ in range(3):  # Newton's method on the integral from the start of the part
            run = parameter - ends[part]
            passed = np.linalg.norm(self._spline(ends[part][:, None] + run[:, None] * nodes, 1), axis=-1) @ weights
            speed = np.linalg.norm(self._spline(parameter, 1), axis=-1)
            parameter = parameter - (lengths[part] + run * passed - wanted) / speed
        return np.asarray(np.clip(parameter, ends[0], ends[-1]))

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
        ijk = volume.lps_to_ijk(self.points)
        outside = np.flatnonzero(((ijk < -0.5 - 1e-6) | (ijk > np.array(volume.shape_ijk) - 0.5 + 1e-6)).any(axis=1))
        if len(outside) == 0:
            return
        corners = volume.ijk_to_lps([tuple(n - 0.5 if b else -0.5 for n, b in zip(volume.shape_ijk, bits, strict=True))
                                     for bits in np.ndindex(2, 2, 2)])  # fmt: skip
        index = int(outside[0])
        raise UsageError(
            f"{len(outside)} of {len(self.points)} points of the centre line lie outside of the volume, the first is"
            f" point {index} at {_as_text(self.points[index])} LPS mm: the volume runs from"
            f" {_as_text(corners.min(axis=0))} to {_as_text(corners.max(axis=0))} (are the points RAS?)"
        )


def _as_text(point: ArrayLike) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in np.asarray(point)) + ")"


def rotation_minimising_normals(places: Float64Array, tangents: Float64Array, first: ArrayLike) -> Float64Array:
    """Return normals (n, 3) along a curve that rotate around it as little as possible, so that frames do not twist.

    Method: double reflection (Wang, Juettler, Zheng and Liu 2008, "Computation of rotation minimizing frames"), of
    fourth order in the distance of the places.

    first: Direction of the first normal; its component along the tangent is ignored.
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


LARGEST_BYTES = 1 << 24
"""Largest file in bytes; a larger one is not a centre line."""

_MARKUP_SPACES = {"LPS": "lps", "RAS": "ras", "1": "lps", "0": "ras"}
"""The values by which 3D Slicer names the frame of its points."""


@explains_arguments
def read_curve_points(path: str | Path, space: Space | None = None) -> Float64Array:
    """Read the points of a centre line.

    Parameters
    ----------
    path : str or Path
        ``.mrk.json`` and ``.fcsv`` are markups of 3D Slicer, which name their frame; ``.json`` is a list of [x, y, z],
        or an object with "points" and "space"; any other file is text with one point on a line, numbers separated by
        blanks, commas or semicolons.  A text may begin with a line of column names, of which x, y and z are used; lines
        with # are comments.
    space : {"lps", "ras"}, optional
        Frame of the points if the file does not name it; default LPS.

    Returns
    -------
    ndarray, shape (n, 3), float64
        LPS mm.

    Raises
    ------
    UsageError
        The file does not exist, or the frame is unknown or differs from that of the file.
    RefusedInputError
        The file cannot be read, or its contents do not fit its extension; the message has the line or the point.
    """
    if space is not None and space not in ("lps", "ras"):
        raise UsageError(f"points are in the frame lps or ras, not {space!r}")
    file = Path(path)
    shown = escape_text(file.name)
    text = _read_text(file, shown)
    name = file.name.lower()
    if name.endswith(".fcsv"):
        rows, stated = _read_fcsv(shown, text)
    elif name.endswith(".json"):
        rows, stated = _read_json(shown, text)
    else:
        rows, stated = _read_lines(shown, text.splitlines()), None
    if stated is not None and space is not None and stated != space:
        raise UsageError(f"{shown} says that its points are {stated.upper()}, not {space.upper()}")
    points = np.array(rows, dtype=np.float64).reshape(-1, 3)
    wrong = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(wrong):
        raise RefusedInputError(f"{shown}: point {int(wrong[0])} has a coordinate that is no finite number")
    if len(points) < 2:
        raise RefusedInputError(f"{shown} holds {len(points)} point{'s' * (len(points) != 1)}, a line needs two")
    if (stated or space) == "ras":
        points[:, :2] *= -1.0
    return points


def _read_text(file: Path, shown: str) -> str:
    try:
        return read_regular(file, LARGEST_BYTES).decode("utf-8-sig")
    except FileNotFoundError as error:
        raise UsageError(f"there is no file {escape_text(str(file), 200)} with the points of a centre line") from error
    except OSError as error:
        raise RefusedInputError(f"the points cannot be read from {shown}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise RefusedInputError(f"{shown} is no text: byte {error.start} is not UTF-8") from error


def _parse_triple(context: str, parts: list[str]) -> list[float]:
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) != 3:
        raise RefusedInputError(f"{context} is not three numbers: {' '.join(parts)[:60]!r}")
    return values


def _split_line(line: str) -> list[str]:
    for separator in (";", ","):
        if separator in line:
            return [part.strip() for part in line.split(separator)]
    return line.split()


def _read_lines(name: str, lines: list[str]) -> list[list[float]]:
    rows: list[list[float]] = []
    columns: list[int] | None = None
    for number, line in enumerate(lines, start=1):
        parts = _split_line(line.partition("#")[0].strip())
        if not any(parts):
            continue
        if not rows and columns is None and not any(map(is_number, parts)):
            columns = _find_columns(f"{name}, line {number}", parts)
            continue
        if columns is not None:
            parts = [parts[at] if at < len(parts) else "" for at in columns]
        rows.append(_parse_triple(f"{name}, line {number}", parts))
    return rows


def _find_columns(context: str, names: list[str]) -> list[int]:
    lowered = [name.strip("\"'").lower() for name in names]
    if any(lowered.count(axis) != 1 for axis in "xyz"):
        raise RefusedInputError(f"{context} names columns, but not x, y and z once each: {' '.join(names)[:60]!r}")
    return [lowered.index(axis) for axis in "xyz"]


def _read_fcsv(name: str, text: str) -> tuple[list[list[float]], str | None]:
    """Read comments, which name the frame, and then lines of ``id,x,y,z,...``."""
    stated: str | None = None
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            if key.strip().lower() == "coordinatesystem":
                stated = _markup_space(name, value.strip())
        elif line.strip():
            rows.append(_parse_triple(f"{name}, line {number}", line.split(",")[1:4]))
    return rows, stated


def _markup_space(name: str, value: Any) -> str:
    stated = _MARKUP_SPACES.get(str(value).upper())
    if stated is None:
        raise RefusedInputError(f"{name}: the coordinate system {value!r} is neither LPS nor RAS")
    return stated


def _read_json(name: str, text: str) -> tuple[list[list[float]], str | None]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RefusedInputError(f"{name} is no JSON: {str(error)[:80]}") from error
    if isinstance(content, dict) and "markups" in content:
        return _read_markups(name, content["markups"])
    stated = None
    if isinstance(content, dict):
        stated = _markup_space(name, content["space"]) if "space" in content else None
        content = content.get("points")
    if not isinstance(content, list):
        raise RefusedInputError(f'{name} holds no points: a list of [x, y, z], or {{"points": [...], "space": "LPS"}}')
    return [_json_point(name, at, point) for at, point in enumerate(content)], stated


def _json_point(name: str, index: int, point: Any) -> list[float]:
    numeric = isinstance(point, list) and all(type(value) in (int, float) for value in point)
    if not numeric or len(point) != 3:
        raise RefusedInputError(f"{name}: point {index} is not three numbers: {str(point)[:60]}")
    try:
        return [float(value) for value in point]
    except OverflowError as error:
        raise RefusedInputError(f"{name}: point {index} has a number that is too large") from error


def _read_markups(name: str, markups: Any) -> tuple[list[list[float]], str]:
    if not isinstance(markups, list) or len(markups) != 1 or not isinstance(markups[0], dict):
        count = len(markups) if isinstance(markups, list) else 0
        raise RefusedInputError(f"{name} holds {count} markups, a centre line is one: export that one alone")
    markup = markups[0]
    units = markup.get("coordinateUnits", "mm")
    if units not in ("mm", ["mm", "UCUM", "length"], ["mm", "UCUM", "millimeter"]):
        raise RefusedInputError(f"{name}: the unit of its coordinates is {str(units)[:40]!r}, not mm")
    stated = _markup_space(name, markup.get("coordinateSystem", "LPS"))
    points = markup.get("controlPoints")
    if not isinstance(points, list) or not all(isinstance(point, dict) for point in points):
        raise RefusedInputError(f"{name} holds a markup without controlPoints")
    placed = [
        (at, point) for at, point in enumerate(points) if point.get("positionStatus", "defined") == "defined"
    ]  # points without position have not been placed yet
    return [_json_point(name, at, point.get("position")) for at, point in placed], stated
