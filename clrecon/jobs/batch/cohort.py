"""The cohort in one view: a table with a row for each case of the manifest, one of all labels, and a page.

All are made from the reports of the cases, one after another, so that a hundred thousand need no more memory than ten.
No name of a file, no description and no message is in them: such words can name a patient.
"""

from __future__ import annotations

import csv
import io
import re
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, BinaryIO

from clrecon.jobs.batch.case import DONE, GATE, LABELS, PICTURE, read_report
from clrecon.jobs.batch.plan import PAGE, REPORT, TABLE, TABLE_COLUMNS, Case, Plan
from clrecon.system.files import replace_file
from clrecon.version import package_version

MISSING = "missing"
"""Status of a case that nobody has made."""

_ALL_LABELS = "cohort_labels.csv"

_JUDGED = ("spacing_k_mm", "iso_value_hu", "triangles", "components", "area_mm2", "volume_ml")
"""Columns in which a case can lie far from the others."""

_FAR, _FEWEST = 3.5, 8
"""A figure is an outlier if it lies so many robust standard deviations from the median (1.4826 times the median
absolute deviation; Iglewicz and Hoaglin 1993), among so many cases at least."""


_NAMED = 20
"""Missing cases that are named; the table has all."""


def write_cohort(cases: Sequence[Case], plan: Plan) -> tuple[Counter[str], list[str]]:
    """Write the tables and the page from the reports that are there.

    Returns: How many cases have each status, and the names of the first that are missing.
    """
    root = Path(plan.output)
    figures: dict[str, list[float]] = {column: [] for column in _JUDGED}
    counts: Counter[str] = Counter()
    missing: list[str] = []
    for row in _find_rows(cases, plan):
        counts[row["status"]] += 1
        if row["status"] == MISSING and len(missing) < _NAMED:
            missing.append(row["case"])
        for column, values in figures.items():
            if isinstance(row[column], int | float):
                values.append(row[column])
    bounds = {column: _find_bounds(values) for column, values in figures.items()}
    carried = [*cases[0].carried] if cases else []
    rows = _judge_rows(_find_rows(cases, plan), bounds)
    replace_file(root / TABLE, lambda stream: _write_rows(stream, rows, carried))
    replace_file(root / PAGE, lambda stream: _write_page(stream, root, counts, carried))
    if any(case.labels is not None for case in cases):
        replace_file(root / _ALL_LABELS, lambda stream: _join_labels(stream, cases, plan))
    return counts, missing


def _find_rows(cases: Iterable[Case], plan: Plan) -> Iterator[dict[str, Any]]:
    for case in cases:
        report = read_report(plan.folder_of(case))
        if report is None:
            yield dict.fromkeys(TABLE_COLUMNS) | {"case": case.name, "status": MISSING, **case.carried}
        else:
            yield {**_make_row(report), **case.carried}


def _make_row(report: Mapping[str, Any]) -> dict[str, Any]:
    mesh, volume = report["mesh"] or {}, report["volume"] or {}
    spacing = volume.get("spacing_mm") or (None, None, None)
    gates = [gate["name"] for gate in (*volume.get("gates", ()), *mesh.get("gates", ())) if gate["ok"] is False]
    of_mesh = {name: mesh.get(name) for name in TABLE_COLUMNS if name in mesh and name != "meshes"}
    return dict.fromkeys(TABLE_COLUMNS) | of_mesh | {
        "case": report["case"],
        "status": report["status"],
        "error": (report["error"] or {}).get("kind"),
        "slices": volume.get("slices"),
        **dict(zip(("spacing_i_mm", "spacing_j_mm", "spacing_k_mm"), spacing, strict=True)),
        "tilt_deg": volume.get("tilt_deg"),
        "meshes": len(mesh["meshes"]) if mesh else None,
        "gates_failed": " ".join(dict.fromkeys(gates)),
        "warnings": len(report["warnings"]),
        "seconds": report["seconds"]["total"],
        "peak_memory_bytes": report["peak_memory_bytes"],
        "device": report["device"],
    }  # fmt: skip


def _find_bounds(values: Sequence[float]) -> tuple[float, float] | None:
    """Return the ends between which figures are no outliers; None where there are too few, or most are equal."""
    if len(values) < _FEWEST:
        return None
    median = statistics.median(values)
    deviation = 1.4826 * statistics.median(abs(value - median) for value in values)
    return (median - _FAR * deviation, median + _FAR * deviation) if deviation else None


def _judge_rows(
    rows: Iterable[dict[str, Any]], bounds: Mapping[str, tuple[float, float] | None]
) -> Iterator[dict[str, Any]]:
    for row in rows:
        far = [
            column
            for column, ends in bounds.items()
            if ends and row[column] is not None and not ends[0] <= row[column] <= ends[1]
        ]
        yield row | {"outliers": " ".join(far)}


def _write_rows(stream: BinaryIO, rows: Iterable[dict[str, Any]], carried: Sequence[str]) -> None:
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    table = csv.writer(text, lineterminator="\n")
    table.writerow((*TABLE_COLUMNS, *map(_defuse, carried)))
    for row in rows:
        figures = (row[column] for column in TABLE_COLUMNS)
        cells = (round(cell, 6) if isinstance(cell, float) else cell for cell in figures)
        table.writerow((*cells, *(_defuse(row[column]) for column in carried)))
    text.detach()


_FORMULA = re.compile(r"[=@\t\r]|[+-](?![\d.,]+(e[+-]?\d+)?$)", re.IGNORECASE)


def _defuse(cell: str) -> str:
    """Return a cell of a manifest that spreadsheets show as text, where they would run it as a formula."""
    return f"'{cell}" if _FORMULA.match(cell) else cell


def _join_labels(stream: BinaryIO, cases: Iterable[Case], plan: Plan) -> None:
    """Write the tables of labels below each other, with a column for the case in front."""
    head = ""
    for case in cases:
        path = plan.folder_of(case) / LABELS
        if path.is_file():
            first, *lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            if not head:
                head = first
                stream.write(f"case,{head}".encode())
            stream.writelines(f"{case.name},{line}".encode() for line in lines)


_SHOWN: tuple[tuple[str, str, Callable[[str], str]], ...] = (
    ("slices", "slices", str),
    ("spacing_k_mm", "step, mm", lambda cell: f"{float(cell):.4g}"),
    ("tilt_deg", "tilt, degrees", lambda cell: f"{float(cell):.1f}"),
    ("iso_value_hu", "level, HU", lambda cell: f"{float(cell):.0f}"),
    ("triangles", "triangles", lambda cell: f"{int(cell):,}"),
    ("components", "parts", lambda cell: f"{int(cell):,}"),
    ("area_mm2", "area, cm2", lambda cell: f"{float(cell) / 100.0:,.0f}"),
    ("volume_ml", "volume, ml", lambda cell: f"{float(cell):,.1f}"),
    ("warnings", "warnings", str),
    ("seconds", "seconds", lambda cell: f"{float(cell):.1f}"),
)
"""Columns of the page: that of the table, its heading, and how its cells are written."""


def _write_page(stream: BinaryIO, root: Path, counts: Counter[str], carried: Sequence[str]) -> None:
    """Write the page from the table, row by row; pictures are files beside it, loaded when they come into view."""
    text = (files(__package__) / PAGE).read_text(encoding="utf-8")
    total = sum(counts.values())
    counted = ", ".join(f"{count:,} {status}" for status, count in counts.most_common())
    page = Template(text).substitute(
        version=escape(package_version()),
        lead=escape(f"{total:,} case{'s' * (total != 1)}: {counted}"),
        heads="".join(f"<th>{escape(heading)}</th>" for heading in (*(shown for _, shown, _ in _SHOWN), *carried)),
        rows="\0",
    )
    head, _, end = page.partition("\0")
    stream.write(head.encode())
    with open(root / TABLE, newline="", encoding="utf-8") as table:
        for row in csv.DictReader(table):
            stream.write(_lay_out_row(row, root, carried).encode())
    stream.write(end.encode())


def _lay_out_row(row: Mapping[str, str], root: Path, carried: Iterable[str]) -> str:
    case, status = escape(row["case"]), escape(row["status"])
    folder, far = root / row["case"], row["outliers"].split()
    pictures = sorted(folder.glob(PICTURE.replace(".", "*.")))
    picture = "".join(f'<img src="{case}/{escape(path.name)}" alt="" loading="lazy">' for path in pictures)
    name = f'<a href="{case}/{REPORT}">{case}</a>' if row["status"] != MISSING else case
    reason = f"<small>{escape(row['error'])}</small>" if row["error"] else ""
    kind = "" if row["status"] == DONE else ' class="bad"'
    gates = escape(row["gates_failed"]) or "kept" * (row["status"] in (DONE, GATE))
    failed = ' class="bad"' if row["gates_failed"] else ""
    cells = [f"<td>{picture}</td><th>{name}</th><td{kind}>{status}{reason}</td><td{failed}>{gates}</td>"]
    for column, _, write in _SHOWN:
        mark = ' class="far" title="far from the other cases"' if column in far else ""
        cell = row[column]
        cells.append(f'<td data-value="{escape(cell)}"{mark}>{escape(write(cell)) if cell else ""}</td>')
    cells += (f"<td>{escape(row[_defuse(column)])}</td>" for column in carried)
    return f"<tr>{''.join(cells)}</tr>\n"
