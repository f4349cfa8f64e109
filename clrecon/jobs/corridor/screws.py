"""Given screws: six numbers and a diameter in a text, or a file of them (JSON or CSV)."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry import frame_from_lps
from clrecon.spine.measures import Screw
from clrecon.system.paths import read_regular
from clrecon.system.text import escape_text

CSV_COLUMNS = ("entry_x", "entry_y", "entry_z", "tip_x", "tip_y", "tip_z", "diameter")
"""Columns of a CSV file, beside ``name`` and ``label``, which may be left out."""

MOST_SCREWS = 200
LARGEST_FILE = 1 << 20


def parse_screw(text: str, space: str, number: int = 1) -> Screw:
    """Read ``X,Y,Z,X,Y,Z,D``: entry, tip and diameter in mm."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7:
        raise UsageError(f"a screw is entry, tip and diameter in mm, X,Y,Z,X,Y,Z,D, not {escape_text(text, 80)!r}")
    return _make(numbers, space, f"screw {number}", None)


def _make(numbers: list[float], space: str, name: str, label: str | None) -> Screw:
    turn = frame_from_lps(space).T
    entry, tip = turn @ np.array(numbers[:3]), turn @ np.array(numbers[3:6])
    return Screw(entry, tip, numbers[6], name, label)


def read_screws(path: str | Path, space: str) -> tuple[Screw, ...]:
    """Read screws from a file; its first character tells JSON from CSV.

    JSON is a list of objects with ``entry`` and ``tip`` (three numbers each, mm of `space`), ``diameter`` and, if
    wanted, ``name`` and ``label``; or an object with such a list as ``screws``.  CSV has a header with `CSV_COLUMNS`.
    """
    shown = escape_text(Path(path).name)
    try:
        text = read_regular(path, LARGEST_FILE).decode("utf-8-sig")
    except OSError as error:
        raise UsageError(f"the screws in {shown} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{shown} is no text: screws are JSON or CSV") from error
    rows = _json_rows(text, shown) if text.lstrip()[:1] in ("[", "{") else _csv_rows(text, shown)
    if not 0 < len(rows) <= MOST_SCREWS:
        raise UsageError(f"{shown} has {len(rows):,} screws: 1 to {MOST_SCREWS} can be graded")
    screws = []
    for number, row in enumerate(rows, start=1):
        try:
            numbers = [float(value) for value in row["numbers"]]
        except (TypeError, ValueError, OverflowError):
            numbers = []
        if len(numbers) != 7:
            raise UsageError(f"screw {number} of {shown} has no three numbers of entry and of tip, and a diameter")
        name = escape_text(str(row["name"] or f"screw {number}"), 40)
        screws.append(_make(numbers, space, name, None if row["label"] in (None, "") else str(row["label"])))
    return tuple(screws)


def _json_rows(text: str, shown: str) -> list[dict[str, Any]]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{shown} is no JSON: {str(error)[:80]}") from error
    if isinstance(content, dict):
        content = content.get("screws")
    if not isinstance(content, list) or not all(isinstance(entry, dict) for entry in content):
        raise UsageError(f"{shown} is no list of screws: objects with entry, tip and diameter")
    rows = []
    for entry in content:
        ends = [entry.get("entry"), entry.get("tip")]
        whole = all(isinstance(end, list) and len(end) == 3 for end in ends)
        numbers = [*ends[0], *ends[1], entry.get("diameter")] if whole else []  # type: ignore[misc]
        rows.append({"numbers": numbers, "name": entry.get("name"), "label": entry.get("label")})
    return rows


def _csv_rows(text: str, shown: str) -> list[dict[str, Any]]:
    reader = csv.DictReader(io.StringIO(text))
    missing = [name for name in CSV_COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise UsageError(f"{shown} has no column {missing[0]}: screws have {', '.join(CSV_COLUMNS)}")
    return [
        {"numbers": [row[name] for name in CSV_COLUMNS], "name": row.get("name"), "label": row.get("label")}
        for row in reader
    ]
