"""Files with points of a centre line: text, CSV, JSON, and the markups of 3D Slicer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.system.arguments import explains_arguments
from clrecon.system.paths import read_regular
from clrecon.system.text import escape_text

LARGEST_BYTES = 1 << 24
"""Largest file in bytes; a larger one is not a centre line."""

MARKUP_SPACES = {"LPS": "lps", "RAS": "ras", "1": "lps", "0": "ras"}
"""The values by which 3D Slicer names the frame of its points."""


@explains_arguments
def read_curve_points(path: str | Path, space: str | None = None) -> Float64Array:
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
        rows, said = _read_fcsv(shown, text)
    elif name.endswith(".json"):
        rows, said = _read_json(shown, text)
    else:
        rows, said = _read_lines(shown, text.splitlines()), None
    if said is not None and space is not None and said != space:
        raise UsageError(f"{shown} says that its points are {said.upper()}, not {space.upper()}")
    points = np.array(rows, dtype=np.float64).reshape(-1, 3)
    wrong = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(wrong):
        raise RefusedInputError(f"{shown}: point {int(wrong[0])} has a coordinate that is no finite number")
    if len(points) < 2:
        raise RefusedInputError(f"{shown} holds {len(points)} point{'s' * (len(points) != 1)}, a line needs two")
    if (said or space) == "ras":
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


def _numbers(where: str, parts: list[str]) -> list[float]:
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) != 3:
        raise RefusedInputError(f"{where} is not three numbers: {' '.join(parts)[:60]!r}")
    return values


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _split(line: str) -> list[str]:
    for separator in (";", ","):
        if separator in line:
            return [part.strip() for part in line.split(separator)]
    return line.split()


def _read_lines(name: str, lines: list[str]) -> list[list[float]]:
    rows: list[list[float]] = []
    columns: list[int] | None = None
    for number, line in enumerate(lines, start=1):
        parts = _split(line.partition("#")[0].strip())
        if not any(parts):
            continue
        if not rows and columns is None and not any(map(_is_number, parts)):
            columns = _find_columns(f"{name}, line {number}", parts)
            continue
        if columns is not None:
            parts = [parts[at] if at < len(parts) else "" for at in columns]
        rows.append(_numbers(f"{name}, line {number}", parts))
    return rows


def _find_columns(where: str, names: list[str]) -> list[int]:
    found = [name.strip("\"'").lower() for name in names]
    if any(found.count(axis) != 1 for axis in "xyz"):
        raise RefusedInputError(f"{where} names columns, but not x, y and z once each: {' '.join(names)[:60]!r}")
    return [found.index(axis) for axis in "xyz"]


def _read_fcsv(name: str, text: str) -> tuple[list[list[float]], str | None]:
    """Read comments, which name the frame, and then lines of ``id,x,y,z,...``."""
    said: str | None = None
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            if key.strip().lower() == "coordinatesystem":
                said = _markup_space(name, value.strip())
        elif line.strip():
            rows.append(_numbers(f"{name}, line {number}", line.split(",")[1:4]))
    return rows, said


def _markup_space(name: str, value: Any) -> str:
    said = MARKUP_SPACES.get(str(value).upper())
    if said is None:
        raise RefusedInputError(f"{name}: the coordinate system {value!r} is neither LPS nor RAS")
    return said


def _read_json(name: str, text: str) -> tuple[list[list[float]], str | None]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RefusedInputError(f"{name} is no JSON: {str(error)[:80]}") from error
    if isinstance(content, dict) and "markups" in content:
        return _read_markups(name, content["markups"])
    said = None
    if isinstance(content, dict):
        said = _markup_space(name, content["space"]) if "space" in content else None
        content = content.get("points")
    if not isinstance(content, list):
        raise RefusedInputError(f'{name} holds no points: a list of [x, y, z], or {{"points": [...], "space": "LPS"}}')
    return [_json_point(name, at, point) for at, point in enumerate(content)], said


def _json_point(name: str, at: int, point: Any) -> list[float]:
    numeric = isinstance(point, list) and all(type(value) in (int, float) for value in point)
    if not numeric or len(point) != 3:
        raise RefusedInputError(f"{name}: point {at} is not three numbers: {str(point)[:60]}")
    try:
        return [float(value) for value in point]
    except OverflowError as error:
        raise RefusedInputError(f"{name}: point {at} has a number that is too large") from error


def _read_markups(name: str, markups: Any) -> tuple[list[list[float]], str]:
    if not isinstance(markups, list) or len(markups) != 1 or not isinstance(markups[0], dict):
        count = len(markups) if isinstance(markups, list) else 0
        raise RefusedInputError(f"{name} holds {count} markups, a centre line is one: export that one alone")
    markup = markups[0]
    units = markup.get("coordinateUnits", "mm")
    if units not in ("mm", ["mm", "UCUM", "length"], ["mm", "UCUM", "millimeter"]):
        raise RefusedInputError(f"{name}: the unit of its coordinates is {str(units)[:40]!r}, not mm")
    said = _markup_space(name, markup.get("coordinateSystem", "LPS"))
    points = markup.get("controlPoints")
    if not isinstance(points, list) or not all(isinstance(point, dict) for point in points):
        raise RefusedInputError(f"{name} holds a markup without controlPoints")
    placed = [
        (at, point) for at, point in enumerate(points) if point.get("positionStatus", "defined") == "defined"
    ]  # points without position have not been placed yet
    return [_json_point(name, at, point.get("position")) for at, point in placed], said
