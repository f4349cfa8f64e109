"""Plots of the page as SVG inside it: text stays text, colours of text and axes are those of the page."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

from clrecon.jobs.compare.records import ALL_PARTS
from clrecon.jobs.compare.report import CompareReport, MethodRecord
from clrecon.jobs.compare.words import seconds

PART_COLORS = {
    "read": "#9aa5b1",
    "build": "#f2b134",
    "upload": "#4d9de0",
    "kernels": "#3bb273",
    "host": "#b4436c",
    "download": "#00a7a7",
    "draw": "#7768ae",
}

PART_WORDS = {
    "read": "read the input",
    "build": "open the device, build kernels",
    "upload": "upload",
    "kernels": "kernels",
    "host": "CPU",
    "download": "download",
    "draw": "draw the picture",
}

INK = "#010203"
"""Stands for the colour of the page's text, which matplotlib does not know."""

CUT = 2.2
"""Bars end at so many times the length that three quarters of them have; longer ones say their number."""


def plot_times(report: CompareReport, which: str) -> str:
    """Return stacked bars of the parts of each method's time.

    which: {"first", "warm"}
    """
    done = [record for record in report.methods if record.is_done]
    parts = {record.name: getattr(record, f"{which}_parts_s") for record in done}
    totals = {name: sum(own.values()) for name, own in parts.items()}
    ranked = sorted(totals.values())
    end = min(ranked[-1], CUT * ranked[(3 * len(ranked) - 1) // 4])
    figure, axes = _start(7.2, 0.9 + 0.34 * len(done))
    for row, record in enumerate(done):
        left = 0.0
        for part in ALL_PARTS:
            width = min(parts[record.name].get(part, 0.0), end - left)
            if width > 0.0:
                axes.barh(row, width, left=left, height=0.66, color=PART_COLORS[part], linewidth=0)
            left += max(width, 0.0)
        is_cut = totals[record.name] > end * 1.001
        said = f"{seconds(totals[record.name])}{' (cut)' if is_cut else ''}"
        axes.text(left + 0.012 * end, row, said, va="center", ha="left", fontsize=9, color=INK)
    axes.set_yticks(range(len(done)), [record.title for record in done])
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.16 * end)
    axes.set_xlabel(f"seconds, {'first run' if which == 'first' else 'warm (median)'}")
    axes.tick_params(axis="y", length=0)
    return _finish(figure, f"times-{which}")


def plot_accuracy(report: CompareReport, colors: Mapping[str, str]) -> tuple[str, str]:
    """Return triangles against scatter, or without truth against the share that sub-voxel Dice lacks; and its name."""
    measure = "scatter" if report.with_truth and any(record.truth for record in report.methods) else "Dice"
    points = []
    for record in report.methods:
        value = _error_of(record, measure)
        if record.triangles and value is not None:
            points.append((record, record.triangles, value))
    if not points:
        return "", measure
    figure, axes = _start(7.2, 4.6)
    for record, triangles, value in points:
        axes.plot(
            triangles, value, "o", markersize=9, color=colors[record.name], markeredgecolor=INK, markeredgewidth=0.7
        )
    axes.set_xscale("log")
    _set_ranges(axes, [p[1] for p in points], [p[2] for p in points])
    axes.set_xlabel("triangles")
    unit = "scatter about the true surface, mm" if measure == "scatter" else "1 - sub-voxel Dice of slices"
    axes.set_ylabel(unit)
    _label(axes, points)
    axes.text(
        0.015, 0.02, "good corner: few triangles, small error", transform=axes.transAxes, fontsize=9, color=INK,
        style="italic", alpha=0.75,
    )  # fmt: skip
    return _finish(figure, "accuracy"), measure


def _error_of(record: MethodRecord, measure: str) -> float | None:
    if measure == "scatter":
        return None if record.truth is None else float(record.truth["scatter_mm"])
    return None if record.slices is None else 1.0 - float(record.slices["dice"])


def _set_ranges(axes: Any, across: Sequence[float], up: Sequence[float]) -> None:
    low, high = min(across) / 1.6, max(across) * 2.8
    axes.set_xlim(low, high)
    room = max(max(up) - min(up), 0.02 * max(up), 1e-6)
    axes.set_ylim(max(0.0, min(up) - 0.35 * room), max(up) + 0.2 * room)
    steps = [step * 10**power for power in range(12) for step in (1, 2, 5)]
    shown = [step for step in steps if low <= step <= high]
    axes.set_xticks(shown, [f"{step:,}" for step in shown])
    axes.set_xticks([], minor=True)


LINE, WIDE, ASIDE = 11.5, 60.0, 12.0
"""Points between lines of names; how far apart points share no column of names; and how far names are beside them."""


def _label(axes: Any, points: Sequence[tuple[MethodRecord, int, float]]) -> None:
    """Write the names beside the points: those of points that are near each other in a column, without overlap."""
    figure = axes.figure
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # places are those of the final picture from here on
    scale = 72.0 / figure.dpi
    placed = []
    for record, across, up in points:
        x, y = axes.transData.transform((across, up)) * scale
        placed.append((x, y, across, up, record.title))
    columns: list[list[tuple[float, float, int, float, str]]] = []
    for each in sorted(placed):
        if columns and each[0] - columns[-1][-1][0] < WIDE:
            columns[-1].append(each)
        else:
            columns.append([each])
    for column in columns:
        beside, last = column[-1][0] + ASIDE, float("inf")
        for x, y, across, up, title in sorted(column, key=lambda each: (-each[1], each[0])):
            down = min(y, last - LINE)
            last = down
            line = {"arrowstyle": "-", "color": INK, "alpha": 0.35, "linewidth": 0.6, "shrinkB": 4.0}
            axes.annotate(
                title, (across, up), xytext=(beside - x, down - y), textcoords="offset points", fontsize=9, color=INK,
                va="center", arrowprops=line if abs(y - down) > 0.5 * LINE or beside - x > 2.0 * ASIDE else None,
            )  # fmt: skip


def _start(width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    figure.patch.set_alpha(0.0)
    axes.patch.set_alpha(0.0)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(INK)
        spine.set_alpha(0.5)
    axes.tick_params(colors=INK, labelsize=9)
    axes.grid(axis="x", color=INK, alpha=0.12, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
    axes.xaxis.label.set_fontsize(10)
    axes.yaxis.label.set_fontsize(10)
    return figure, axes


_ID = re.compile(r'(?<= id=")|(?<=url\(#)|(?<=href="#)')


def _finish(figure: Any, name: str) -> str:
    """Return a figure as SVG for a page: no metadata, no addresses, identities of its own, colours of the page."""
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(stream, format="svg", transparent=True)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"\s*<(metadata|style).*?</\1>", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns(?::\w+)?="[^"]*"', "", text).replace("xlink:href", "href")
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"font: (\S+ )*?([\d.]+)px [^;\"]*", r"font-size: \2px", text)
    text = re.sub(r"font-size: ([\d.]+)px(?= |$)", r"font-size: \1px", text)
    text = _ID.sub(f"{name}-", text.replace(INK, "currentColor"))
    return text.replace("<svg ", f'<svg role="img" aria-label="{name}" ', 1).strip()
