"""The main table of the page, and that of the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from clrecon.proof.compare.figures import CONTROLS, PAPER
from clrecon.proof.compare.findings import (
    CompareReport,
    MethodRecord,
    count,
    find_worse,
    megabytes,
    milliseconds,
    seconds,
    share,
    signed,
)

NOTHING = "&ndash;"

_AGAINST = ("cells", "HD95", "ASSD", "picture")
"""Columns of likeness to the reference, which has none to itself."""

GROUPS = {"mesh": "surfaces", "cloud": "clouds", "picture": "pictures of the voxels themselves"}


@dataclass(frozen=True)
class Column:
    """A column of the main table: `take` gives the number of a row, or None, `write` its text; one may need the
    `truth`.

    The "low" or "high" end of the numbers of meshes is set in bold, or none.
    """

    head: str
    unit: str
    take: Callable[[MethodRecord], Any]
    write: Callable[[Any], str]
    best: str
    meaning: str
    truth: bool = False


def _in(name: str, entry: str) -> Callable[[MethodRecord], Any]:
    def take_measure(record: MethodRecord) -> Any:
        measures = getattr(record, name)
        return None if measures is None else measures.get(entry)

    return take_measure


def _distance(entry: str, of_points: str) -> Callable[[MethodRecord], Any]:
    """Take a distance of surfaces, or of points where the method made a cloud."""

    def take_distance(record: MethodRecord) -> Any:
        if record.points_mm is not None and record.points_mm["to_reference_mm"]:
            return record.points_mm["to_reference_mm"][of_points]
        return None if record.surfaces is None else record.surfaces[entry]

    return take_distance


def _truth(entry: str) -> Callable[[MethodRecord], Any]:
    def take_scatter(record: MethodRecord) -> Any:
        if record.points_mm is not None:
            return record.points_mm.get(entry)
        return None if record.truth is None else record.truth[entry]

    return take_scatter


def _millimetres(value: float) -> str:
    return f"{value:.3f}"


def _yes(value: bool) -> str:
    return "yes" if value else "no"


COLUMNS = (
    Column("triangles", "", lambda r: r.triangles, count, "", "Triangles of the mesh."),
    Column("vertices", "or points", lambda r: r.vertices if r.points is None else r.points, count, "",
           "Vertices of the mesh; points of the cloud."),
    Column("first", "s", lambda r: r.first_s, seconds, "low",
           "From voxels in memory to the result in memory, the first time in a new process: its library is loaded, the"
           " device opened, kernels are built or taken from a cache. No reading, no drawing."),
    Column("warm", "s", lambda r: r.warm_s, seconds, "low", "The same again in that process, median."),
    Column("kernels", "ms", lambda r: r.kernels_ms, milliseconds, "",
           "Of the warm run, the time of kernels as the device tells it."),
    Column("memory", "MB", lambda r: r.memory_bytes, megabytes, "low",
           "Most memory of the process, interpreter, libraries and scan included; each method has one of its own."),
    Column("visited", "cells", lambda r: r.cells_visited, count, "",
           "Cells of eight voxels that the method looks at one by one."),
    Column("cells", "Dice", _in("cells", "dice"), share, "high",
           "Overlap of the grid cells that triangles pass through with those of the reference. It cannot see where in"
           " a cell the surface lies."),
    Column("slices", "sub-voxel Dice", _in("slices", "dice"), share, "high",
           "Overlap of the filled mesh with the voxels at the level and above, trilinear between them, on points three"
           " times finer than the voxels and off their planes. What a method leaves out lowers it."),
    Column("HD95", "mm", _distance("hd95_mm", "p95"), _millimetres, "low",
           "The larger 95th percentile of the distances from points of either surface, even by area, to the triangles"
           " of the other, the reference. Of clouds: from their points alone."),
    Column("ASSD", "mm", _distance("assd_mm", "mean"), _millimetres, "low",
           "Mean of the same distances of both sides."),
    Column("volume", "%", _in("surfaces", "volume_change_percent"), lambda v: signed(v, 2), "",
           "Enclosed volume against that of the reference."),
    Column("closed", "", _in("quality", "closed"), _yes, "", "Every edge has two triangles."),
    Column("bias", "mm", _truth("bias_mm"), signed, "",
           "Mean signed distance of the outer side from the true surface, positive outside: mostly a matter of the"
           " level.", truth=True),
    Column("scatter", "mm", _truth("scatter_mm"), _millimetres, "low",
           "Standard deviation of these distances about their mean: a matter of the method.", truth=True),
    Column("picture", "SSIM", _in("pictures", "ssim"), share, "high",
           "Likeness of the picture below to that of the reference (window of 7 pixels, over the box of what is drawn"
           " in either); 1 for equal pictures."),
)  # fmt: skip
"""The columns after the name of the method."""


def shown_columns(report: CompareReport) -> list[Column]:
    return [column for column in COLUMNS if report.with_truth or not column.truth]


def main_table(report: CompareReport, colors: Mapping[str, str]) -> str:
    columns = shown_columns(report)
    head = "".join(_head(column) for column in columns)
    reference = next((r for r in report.methods if r.name == report.reference and r.is_done), None)
    worse = f"worse than {escape(reference.title)} in" if reference else "worse than the reference in"
    rows, makes = [], ""
    bests = [_find_best(column, report.methods, report.reference) for column in columns]
    for record in report.methods:
        if record.makes != makes:
            makes = record.makes
            rows.append(
                f'<tr class="group"><th colspan="{len(columns) + 2}" scope="colgroup">{GROUPS[makes]}</th></tr>'
            )
        rows.append(_row(record, columns, bests, reference, colors))
    return (
        f'<div class="scroll"><table>\n<thead><tr><th scope="col">method</th>{head}<th scope="col"'
        f' class="words">{worse}</th></tr>'
        f"</thead>\n<tbody>\n" + "\n".join(rows) + "\n</tbody></table></div>"
    )


def _head(column: Column) -> str:
    unit = f"<small>{escape(column.unit)}</small>" if column.unit else ""
    return f'<th scope="col">{escape(column.head)}{unit}</th>'


def _find_best(column: Column, records: Sequence[MethodRecord], reference: str) -> str | None:
    """Return the text of the best number of a column; of measures against the reference, that has none itself."""
    against = column.head in _AGAINST
    values = [
        value
        for record in records
        if record.makes == "mesh" and not (against and record.name == reference)
        if (value := column.take(record)) is not None
    ]
    if not column.best or len(values) < 2:
        return None
    return column.write(min(values) if column.best == "low" else max(values))


def _row(
    record: MethodRecord,
    columns: Sequence[Column],
    bests: Sequence[str | None],
    reference: MethodRecord | None,
    colors: Mapping[str, str],
) -> str:
    kind = ' class="peer"' if record.peer else ""
    swatch = f'<span class="swatch" style="background:{colors[record.name]}"></span>'
    name = f'<th scope="row">{swatch}{escape(record.title)}<small>{escape(record.what)}</small></th>'
    if not record.is_done:
        words = f"{record.state}: {escape(record.error or '')}"
        return f'<tr class="failed">{name}<td colspan="{len(columns) + 1}">{words}</td></tr>'
    is_reference = reference is not None and record.name == reference.name
    cells = []
    for column, best in zip(columns, bests, strict=True):
        value = column.take(record)
        if value is None:
            cells.append(f'<td class="none">{NOTHING}</td>')
            continue
        text = column.write(value)
        more = _more(column, record)
        is_own = column.head in _AGAINST and is_reference
        is_best = record.makes == "mesh" and best is not None and text == best and not is_own
        mark = ' class="best"' if is_best else ""
        cells.append(f"<td{mark}>{text}{more}</td>")
    words = "the reference" if is_reference else "; ".join(find_worse(record, reference))
    missing = "; ".join(f"{name}: {reason}" for name, reason in record.reasons.items())
    words += f"<small>{escape(missing)}</small>" if missing else ""
    return f'<tr{kind}>{name}{"".join(cells)}<td class="words">{words or "nothing"}</td></tr>'


def _more(column: Column, record: MethodRecord) -> str:
    """Return what stands below a number: the share of visited cells."""
    if column.head != "visited" or not record.cells_all or not record.cells_visited:
        return ""
    part = record.cells_visited / record.cells_all
    return f"<small>{'all' if part == 1.0 else f'1 in {1.0 / part:,.0f}'}</small>"


def small_table(report: CompareReport) -> str:
    """Return the table of ray casting at the size of the twin; empty without it."""
    rows = [record for record in report.methods if record.small]
    if not rows:
        return ""
    width, height = rows[0].small["size"] if rows[0].small else (0, 0)
    full = f"{report.size[0]} &times; {report.size[1]}"
    body = []
    for record in rows:
        small = record.small or {}
        scaled = small.get("scaled_s")
        whole = f"{seconds(scaled)} <small>scaled</small>" if scaled else seconds(record.warm_s or 0.0)
        body.append(
            f'<tr><th scope="row">{escape(record.title)}</th><td>{seconds(small["first_s"])}</td>'
            f"<td>{seconds(small['warm_s'])}</td><td>{whole}</td></tr>"
        )
    return (
        '<div class="scroll"><table><thead><tr><th scope="col">ray casting</th><th scope="col">first<small>s,'
        f' {width} &times; {height}</small></th><th scope="col">warm<small>s, {width} &times;'
        f' {height}</small></th><th scope="col">warm<small>s,'
        f" {full}</small></th></tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )


def paper_table(report: CompareReport) -> str:
    if report.paper is None:
        return ""
    rows = []
    for record in report.methods:
        like = report.paper["methods"].get(record.name)
        if not record.is_done:
            continue
        printed = PAPER.get(record.name)
        printed_text = "" if printed is None else f"{printed['method']}: {printed['seconds']:g}"
        printed_text += f", later {printed['later_s']:g}" if printed and "later_s" in printed else ""
        first = report.read_s["first"] + (record.first_s or 0.0)
        later = report.read_s["warm"] + (record.warm_s or 0.0)
        rows.append(
            f'<tr><th scope="row">{escape(record.title)}</th><td>{seconds(first)}</td><td>{seconds(later)}</td>'
            f'{_likeness(like)}<td class="words">{escape(printed_text)}</td></tr>'
        )
    rows.append('<tr class="group"><th colspan="6" scope="colgroup">controls: pictures of nothing</th></tr>')
    for name, like in report.paper["controls"].items():
        rows.append(
            f'<tr><th scope="row">{escape(CONTROLS[name])}</th><td class="none">{NOTHING}</td><td'
            f' class="none">{NOTHING}</td>{_likeness(like)}<td class="words"></td></tr>'
        )
    return (
        '<div class="scroll"><table><thead><tr><th scope="col">picture</th><th scope="col">first<small>s, with'
        ' reading</small></th><th scope="col">later<small>s, with'
        " reading</small></th>"
        '<th scope="col">SSIM</th><th scope="col">MSE</th><th scope="col" class="words">printed in the'
        f" paper<small>s</small></th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _likeness(like: Mapping[str, float] | None) -> str:
    if like is None:
        return f'<td class="none">{NOTHING}</td><td class="none">{NOTHING}</td>'
    return f"<td>{like['ssim']:.3f}</td><td>{like['mse']:,.0f}</td>"
