"""The page of a comparison: one HTML file with style, plots and pictures inside, without script and addresses.

Plots are SVG: text stays text, colours of text and axes are those of the page."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from itertools import chain, product
from string import Template
from typing import Any

from clrecon.proof.compare.child import LONG_SECONDS
from clrecon.proof.compare.figures import COLORS, Figures, embed
from clrecon.proof.compare.findings import CompareReport, MethodRecord, seconds, share
from clrecon.proof.compare.records import ALL_PARTS
from clrecon.proof.compare.table import main_table, paper_table, shown_columns, small_table
from clrecon.system.packages import is_installed
from clrecon.system.text import list_names


def _read_text(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8")


_PART_COLORS = {
    "read": "#9aa5b1",
    "build": "#f2b134",
    "upload": "#4d9de0",
    "kernels": "#3bb273",
    "host": "#b4436c",
    "download": "#00a7a7",
    "draw": "#7768ae",
}

_PART_WORDS = {
    "read": "read the input",
    "build": "open the device, build kernels",
    "upload": "upload",
    "kernels": "kernels",
    "host": "CPU",
    "download": "download",
    "draw": "draw the picture",
}

_INK = "#010203"
"""Stands for the colour of the page's text, which matplotlib does not know."""

_CUT = 2.2
"""Bars end at so many times the length that three quarters of them have; longer ones say their number."""


def plot_times(report: CompareReport, which: str) -> str:
    """Return stacked bars of the parts of each method's time, "first" or "warm"."""
    done = [record for record in report.methods if record.is_done]
    parts = {record.name: getattr(record, f"{which}_parts_s") for record in done}
    totals = {name: sum(own.values()) for name, own in parts.items()}
    ranked = sorted(totals.values())
    end = min(ranked[-1], _CUT * ranked[(3 * len(ranked) - 1) // 4])
    figure, axes = _start_figure(7.2, 0.9 + 0.34 * len(done))
    for row, record in enumerate(done):
        left = 0.0
        for part in ALL_PARTS:
            width = min(parts[record.name].get(part, 0.0), end - left)
            if width > 0.0:
                axes.barh(row, width, left=left, height=0.66, color=_PART_COLORS[part], linewidth=0)
            left += max(width, 0.0)
        is_cut = totals[record.name] > end * 1.001
        label = f"{seconds(totals[record.name])}{' (cut)' if is_cut else ''}"
        axes.text(left + 0.012 * end, row, label, va="center", ha="left", fontsize=9, color=_INK)
    axes.set_yticks(range(len(done)), [record.title for record in done])
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.16 * end)
    axes.set_xlabel(f"seconds, {'first run' if which == 'first' else 'warm (median)'}")
    axes.tick_params(axis="y", length=0)
    return _finish_figure(figure, f"times-{which}")


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
    figure, axes = _start_figure(7.2, 4.6)
    for record, triangles, value in points:
        axes.plot(
            triangles, value, "o", markersize=9, color=colors[record.name], markeredgecolor=_INK, markeredgewidth=0.7
        )
    axes.set_xscale("log")
    _set_ranges(axes, [p[1] for p in points], [p[2] for p in points])
    axes.set_xlabel("triangles")
    unit = "scatter about the true surface, mm" if measure == "scatter" else "1 - sub-voxel Dice of slices"
    axes.set_ylabel(unit)
    _label(axes, points)
    axes.text(
        0.015, 0.02, "good corner: few triangles, small error", transform=axes.transAxes, fontsize=9, color=_INK,
        style="italic", alpha=0.75,
    )  # fmt: skip
    return _finish_figure(figure, "accuracy"), measure


def _error_of(record: MethodRecord, measure: str) -> float | None:
    if measure == "scatter":
        return None if record.truth is None else float(record.truth["scatter_mm"])
    return None if record.slices is None else 1.0 - float(record.slices["dice"])


def _set_ranges(axes: Any, across: Sequence[float], up: Sequence[float]) -> None:
    low, high = min(across) / 1.6, max(across) * 2.8
    axes.set_xlim(low, high)
    room = max(max(up) - min(up), 0.02 * max(up), 1e-6)
    axes.set_ylim(max(0.0, min(up) - 0.35 * room), max(up) + 0.2 * room)
    steps = [step * 10**power for power, step in product(range(12), (1, 2, 5))]
    shown = [step for step in steps if low <= step <= high]
    axes.set_xticks(shown, [f"{step:,}" for step in shown])
    axes.set_xticks([], minor=True)


LINE = 11.5
WIDE = 60.0
ASIDE = 12.0
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
    for entry in sorted(placed):
        if columns and entry[0] - columns[-1][-1][0] < WIDE:
            columns[-1].append(entry)
        else:
            columns.append([entry])
    for column in columns:
        beside, last = column[-1][0] + ASIDE, float("inf")
        for x, y, across, up, title in sorted(column, key=lambda each: (-each[1], each[0])):
            down = min(y, last - LINE)
            last = down
            line = {"arrowstyle": "-", "color": _INK, "alpha": 0.35, "linewidth": 0.6, "shrinkB": 4.0}
            axes.annotate(
                title, (across, up), xytext=(beside - x, down - y), textcoords="offset points", fontsize=9, color=_INK,
                va="center", arrowprops=line if abs(y - down) > 0.5 * LINE or beside - x > 2.0 * ASIDE else None,
            )  # fmt: skip


def _start_figure(width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    for name, spine in axes.spines.items():
        spine.set(visible=name in ("left", "bottom"), color=_INK, alpha=0.5)
    axes.tick_params(colors=_INK, labelsize=9)
    axes.grid(axis="x", color=_INK, alpha=0.12, linewidth=0.6)
    axes.set_axisbelow(True)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(color=_INK, fontsize=10)
    return figure, axes


_ID = re.compile(r'(?<= id=")|(?<=url\(#)|(?<=href="#)')


def _finish_figure(figure: Any, name: str) -> str:
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
    text = _ID.sub(f"{name}-", text.replace(_INK, "currentColor"))
    return text.replace("<svg ", f'<svg role="img" aria-label="{name}" ', 1).strip()


def make_page(report: CompareReport, figures: Figures) -> str:
    note = (
        "Bold: the best of the surfaces. Grey: libraries of others. Contours and points of plots have the colour beside"
        " the name."
    )
    memory = "all of the device" if report.memory_allowed_bytes is None else f"{report.memory_allowed_bytes:,} bytes"
    rows = [
        ("level", f"{report.iso_value_hu:g} HU; the surface lies at {report.iso_level_hu:g} HU"),
        ("border", "closed with air" if report.closed_at_border else "open"),
        ("reference", _title_of(report, report.reference)),
        ("warm runs", f"{report.repeat} at most, none begins after {LONG_SECONDS:g} s of them"),
        ("memory on the device", memory),
        ("truth", "that of the phantom" if report.with_truth else "not known"),
        ("read the input", f"{report.read_s['first']:.2f} s first, {report.read_s['warm']:.2f} s again"),
        ("whole comparison", f"{report.seconds['total']:.0f} s"),
        ("platform", report.platform),
    ]
    items = "\n".join(f"<dt>{escape(name)}</dt><dd>{escape(said)}</dd>" for name, said in rows)
    parts = (
        _section("What the numbers say", _findings(report)),
        _section("All methods", f'{main_table(report, COLORS)}\n<p class="note">{note}</p>\n{small_table(report)}'),
        *(_sections_of_plots(report) if is_installed("matplotlib") else ()),
        _section("The same view", _views(report, figures)),
        _section("Slices with contours", _slices(report, figures)),
        _section("Against the middle slice, as a paper does", _paper(report)),
        _section("How each number is defined", _definitions(report)),
        _section("Settings", f'<dl class="definitions">\n{items}\n</dl>'),
    )
    done = sum(record.is_done for record in report.methods)
    ni, nj, nk = report.shape_ijk
    of = f"{done} of {len(report.methods)}" if done < len(report.methods) else f"{done}"
    return Template(_read_text("page.html")).substitute(
        version=escape(report.version),
        title="Surfaces and clouds of one scan, compared",
        style=_read_text("page.css").strip(),
        lead=escape(
            f"{of} methods on one scan of {ni} x {nj} x {nk} voxels at {report.iso_value_hu:g} HU, each in a process of"
            f" its own, compared with {_title_of(report, report.reference)}."
        ),
        facts="\n".join(f"<div><dt>{escape(name)}</dt><dd>{escape(said)}</dd></div>" for name, said in _facts(report)),
        body="\n".join(filter(None, parts)),
    )


def _sections_of_plots(report: CompareReport) -> tuple[str, str]:
    return _section("Where the time goes", _times(report)), _section("Triangles and error", _accuracy(report))


def _section(title: str, content: str) -> str:
    return f"<section>\n<h2>{escape(title)}</h2>\n{content}\n</section>" if content else ""


def _title_of(report: CompareReport, name: str) -> str:
    return next((record.title for record in report.methods if record.name == name), name)


def _facts(report: CompareReport) -> list[tuple[str, str]]:
    region = (report.volume.get("region") or {}).get("rules")
    spacing = " x ".join(f"{step:.4g}" for step in report.spacing_mm)
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    return [
        ("Voxels", f"{' x '.join(map(str, report.shape_ijk))}, spacing {spacing} mm"),
        ("Level", f"{report.iso_value_hu:g} HU: {report.iso_value_reason}"),
        ("Region", " and ".join(region) if region else "the whole scan"),
        ("Device", f"{report.device}; {report.driver}"),
        ("Processor", f"{report.processor}, {report.cores} cores, {report.free_cores:.1f} of them free"),
        ("Versions", versions),
        ("Date", report.date),
    ]


def _findings(report: CompareReport) -> str:
    items = "\n".join(f"<li>{escape(text)}</li>" for text in report.findings)
    warnings = "\n".join(f"<li>{escape(text)}</li>" for text in report.warnings)
    warning_list = f"<h3>Warnings</h3>\n<ul>\n{warnings}\n</ul>" if warnings else ""
    return f'<ul class="findings">\n{items}\n</ul>\n{warning_list}'


def _times(report: CompareReport) -> str:
    legend = _legend({words: _PART_COLORS[part] for part, words in _PART_WORDS.items()})
    plots = "\n".join(f"<figure>{plot_times(report, which)}</figure>" for which in ("first", "warm"))
    return (
        f'{legend}\n<div class="plots">\n{plots}\n</div>\n<p class="note">Beside each bar: all of its seconds, reading'
        " and drawing included. Bars that would squeeze the others are cut and say so.</p>"
    )


def _accuracy(report: CompareReport) -> str:
    plot, measure = plot_accuracy(report, COLORS)
    if not plot:
        return ""
    caption = (
        "Scatter about the true surface: what the method adds to the error of the level."
        if measure == "scatter"
        else "1 minus the sub-voxel Dice of slices: 0 is a mesh that encloses exactly what is at the level and above."
    )
    return f"<figure>{plot}<figcaption>{escape(caption)} One point a method.</figcaption></figure>"


def _legend(colors: Mapping[str, str]) -> str:
    items = "".join(
        f'<li><span class="swatch" style="background:{color}"></span>{escape(words)}</li>'
        for words, color in colors.items()
    )
    return f'<ul class="legend">{items}</ul>'


def _views(report: CompareReport, figures: Figures) -> str:
    tiles = []
    reference = _title_of(report, report.reference)
    for record in report.methods:
        if record.name not in figures.images:
            continue
        images = _image(figures.images[record.name], f"{record.title}, {report.view} view")
        difference = figures.images.get(f"{record.name}-difference")
        caption = "the reference" if record.name == report.reference else ""
        if difference is not None:
            images += _image(difference, f"difference of {record.title} to {reference}")
            like = record.pictures
            caption = "" if like is None else f"SSIM {share(like['ssim'])}, MSE {like['mse']:,.1f}"
        elif not caption:
            width, height = (record.small or {"size": report.size})["size"]
            caption = f"{width} x {height} pixels: not compared"
        tiles.append(
            f"<figure>{images}<figcaption><strong>{escape(record.title)}</strong> {caption}</figcaption></figure>"
        )
    note = (
        f'<p class="note">One camera ({escape(report.view)}), one light, {report.size[0]} x {report.size[1]} pixels,'
        f" drawn on the device. Below each picture its difference to {escape(reference)}: black where there is none,"
        " white from a quarter of the range on.</p>"
    )
    return f'{note}\n<div class="tiles">\n' + "\n".join(tiles) + "\n</div>" if tiles else ""


def _image(image: Any, alt: str) -> str:
    height, width = image.shape[:2] if hasattr(image, "shape") else (image.height, image.width)
    return f'<img src="{embed(image)}" width="{width}" height="{height}" alt="{escape(alt, quote=True)}">'


def _slices(report: CompareReport, figures: Figures) -> str:
    if not report.slices:
        return ""
    titles = {record.name: record.title for record in report.methods}
    drawn = set(chain(*(entry["lines"] for entry in report.slices)))
    colors = {titles[name]: COLORS[name] for name in titles if name in drawn and name not in figures.same}
    reference = titles[report.reference]
    if figures.same and reference in colors:
        also = list_names(titles[name] for name in titles if name in figures.same)
        colors = {f"{title} (and {also})" if title == reference else title: color for title, color in colors.items()}
    tiles = []
    for entry in report.slices:
        for which, extent in (("file", "the whole"), ("detail", "a detail of 24 mm")):
            image = figures.images[entry[which].removesuffix(".png")]
            first = int(entry["index"])
            words = f"{entry['name']}, between slices {first} and {first + 1} along {entry['axis']}: {extent}"
            tiles.append(f"<figure>{_image(image, words)}<figcaption>{escape(words)}</figcaption></figure>")
    return f'{_legend(colors)}\n<div class="planes">\n' + "\n".join(tiles) + "\n</div>"


def _paper(report: CompareReport) -> str:
    if report.paper is None:
        return ""
    low, high = report.paper["window_hu"]
    black = report.paper["controls"].get("black")
    caption = (
        f"Each method looks along the slices, pixel for pixel with slice {report.paper['slice']} at a window of"
        f" {low:g} to {high:g} HU, and is compared with it as a paper on rendering of CT compares a view with an"
        " image. The controls show what this is worth"
    )
    caption += (
        f": an all-black picture has an SSIM of {black['ssim']:.2f} here; the paper prints 0.38 to 0.56 for its"
        " methods."
        if black
        else "."
    )
    printed = "Seconds in the last column are those of the paper, on its own machine and scan."
    return f'<p>{escape(caption)}</p>\n{paper_table(report)}\n<p class="note">{printed}</p>'


def _definitions(report: CompareReport) -> str:
    rows = [
        (f"{column.head}, {column.unit}" if column.unit else column.head, column.meaning)
        for column in shown_columns(report)
    ]
    rows.append(
        (
            "read, draw",
            "Seconds of reading the input, which is the same for all, and of drawing the picture on the device; both"
            " are in the bars alone.",
        )
    )
    if any(record.small and record.small["scaled_s"] for record in report.methods):
        rows.append(("scaled", "Reckoned from the small picture by the number of pixels, not measured."))
    items = "\n".join(f"<dt>{escape(name)}</dt><dd>{escape(said)}</dd>" for name, said in rows)
    return f'<dl class="definitions">\n{items}\n</dl>'
