"""The page of a comparison: one HTML file with style, plots and pictures inside, without script and addresses."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from clrecon.jobs.compare.child import LONG_SECONDS
from clrecon.jobs.compare.figures import COLORS, Figures
from clrecon.jobs.compare.paper import PAPER
from clrecon.jobs.compare.pictures import embed
from clrecon.jobs.compare.plots import PART_COLORS, PART_WORDS, plot_accuracy, plot_times
from clrecon.jobs.compare.report import CompareReport
from clrecon.jobs.compare.table import main_table, paper_table, shown_columns, small_table
from clrecon.jobs.compare.template import PAGE_TEMPLATE, read_style
from clrecon.jobs.compare.words import join, share


def make_page(report: CompareReport, figures: Figures) -> str:
    """Return the page.

    figures: The pictures of the report.
    """
    parts = (
        _section("What the numbers say", _findings(report)),
        _section("All methods", _main(report)),
        _section("Where the time goes", _times(report)),
        _section("Triangles and error", _accuracy(report)),
        _section("The same view", _views(report, figures)),
        _section("Slices with contours", _slices(report, figures)),
        _section("Against the middle slice, as a paper does", _paper(report)),
        _section("How each number is defined", _definitions(report)),
        _section("Settings", _settings(report)),
    )
    return PAGE_TEMPLATE.substitute(
        version=escape(report.version),
        title="Surfaces and clouds of one scan, compared",
        style=read_style(),
        lead=escape(_lead(report)),
        facts="\n".join(f"<div><dt>{escape(name)}</dt><dd>{escape(said)}</dd></div>" for name, said in _facts(report)),
        body="\n".join(filter(None, parts)),
    )


def _section(title: str, content: str) -> str:
    return f"<section>\n<h2>{escape(title)}</h2>\n{content}\n</section>" if content else ""


def _title_of(report: CompareReport, name: str) -> str:
    return next((record.title for record in report.methods if record.name == name), name)


def _lead(report: CompareReport) -> str:
    done = sum(record.is_done for record in report.methods)
    ni, nj, nk = report.shape_ijk
    of = f"{done} of {len(report.methods)}" if done < len(report.methods) else f"{done}"
    return (
        f"{of} methods on one scan of {ni} x {nj} x {nk} voxels at {report.iso_value_hu:g} HU, each in a process of"
        f" its own, compared with {_title_of(report, report.reference)}."
    )


def _facts(report: CompareReport) -> list[tuple[str, str]]:
    region = (report.volume.get("region") or {}).get("rules")
    spacing = " x ".join(f"{step:.4g}" for step in report.spacing_mm)
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    facts = [
        ("Voxels", f"{' x '.join(map(str, report.shape_ijk))}, spacing {spacing} mm"),
        ("Level", f"{report.iso_value_hu:g} HU: {report.iso_value_reason}"),
        ("Region", " and ".join(region) if region else "the whole scan"),
        ("Device", f"{report.device}; {report.driver}"),
        ("Processor", f"{report.processor}, {report.cores} cores, {report.free_cores:.1f} of them free"),
        ("Versions", versions),
        ("Date", report.date),
    ]
    return facts


def _findings(report: CompareReport) -> str:
    items = "\n".join(f"<li>{escape(text)}</li>" for text in report.findings)
    warnings = "\n".join(f"<li>{escape(text)}</li>" for text in report.warnings)
    said = f"<h3>Warnings</h3>\n<ul>\n{warnings}\n</ul>" if warnings else ""
    return f'<ul class="findings">\n{items}\n</ul>\n{said}'


def _main(report: CompareReport) -> str:
    note = (
        "Bold: the best of the surfaces. Grey: libraries of others. Bars, pictures and contours have the colour"
        " beside the name."
    )
    return f'{main_table(report, COLORS)}\n<p class="note">{note}</p>\n{small_table(report)}'


def _times(report: CompareReport) -> str:
    legend = _legend({words: PART_COLORS[part] for part, words in PART_WORDS.items()})
    plots = "\n".join(f"<figure>{plot_times(report, which)}</figure>" for which in ("first", "warm"))
    return (
        f'{legend}\n<div class="plots">\n{plots}\n</div>\n<p class="note">Beside each bar: all of its seconds, reading'
        " and drawing included. Bars that would squeeze the others are cut and say so.</p>"
    )


def _accuracy(report: CompareReport) -> str:
    plot, measure = plot_accuracy(report, COLORS)
    if not plot:
        return ""
    said = (
        "Scatter about the true surface: what the method adds to the error of the level."
        if measure == "scatter"
        else "1 minus the sub-voxel Dice of slices: 0 is a mesh that encloses exactly what is at the level and above."
    )
    return f"<figure>{plot}<figcaption>{escape(said)} One point a method.</figcaption></figure>"


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
        alt = f"{record.title}, {report.view} view"
        images = _image(figures.images[record.name], alt)
        difference = figures.images.get(f"{record.name}-difference")
        said = "the reference" if record.name == report.reference else ""
        if difference is not None:
            images += _image(difference, f"difference of {record.title} to {reference}")
            like = record.pictures
            said = "" if like is None else f"SSIM {share(like['ssim'])}, MSE {like['mse']:,.1f}"
        elif not said:
            width, height = (record.small or {"size": report.size})["size"]
            said = f"{width} x {height} pixels: not compared"
        tiles.append(
            f"<figure>{images}<figcaption><strong>{escape(record.title)}</strong> {said}</figcaption></figure>"
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
    drawn = {name for entry in report.slices for name in entry["lines"]}
    own = {titles[name]: COLORS[name] for name in titles if name in drawn and name not in figures.same}
    reference = titles[report.reference]
    if figures.same and reference in own:
        also = join([titles[name] for name in titles if name in figures.same])
        own = {f"{title} (and {also})" if title == reference else title: color for title, color in own.items()}
    tiles = []
    for entry in report.slices:
        for which, said in (("file", "the whole"), ("detail", "a detail of 24 mm")):
            image = figures.images[entry[which].removesuffix(".png")]
            first = int(entry["index"])
            words = f"{entry['name']}, between slices {first} and {first + 1} along {entry['axis']}: {said}"
            tiles.append(f"<figure>{_image(image, words)}<figcaption>{escape(words)}</figcaption></figure>")
    return f'{_legend(own)}\n<div class="planes">\n' + "\n".join(tiles) + "\n</div>"


def _paper(report: CompareReport) -> str:
    if report.paper is None:
        return ""
    low, high = report.paper["window_hu"]
    black = report.paper["controls"].get("black")
    said = (
        f"Each method looks along the slices, pixel for pixel with slice {report.paper['slice']} at a window of"
        f" {low:g} to {high:g} HU, and is compared with it as a paper on rendering of CT compares a view with an"
        " image. The controls show what this is worth"
    )
    said += (
        f": an all-black picture has an SSIM of {black['ssim']:.2f} here; the paper prints 0.38 to 0.56 for its"
        " methods."
        if black
        else "."
    )
    printed = "Seconds in the last column are those of the paper, on its own machine and scan." if PAPER else ""
    return f'<p>{escape(said)}</p>\n{paper_table(report)}\n<p class="note">{printed}</p>'


def _definitions(report: CompareReport) -> str:
    rows = [
        (f"{column.head}, {column.unit}" if column.unit else column.head, column.meaning)
        for column in shown_columns(report)
    ]
    rows.append(
        (
            "read, draw",
            "Seconds of reading the input, which is the same for all, and of drawing the picture on the device; both"
            " are"
            " in the bars alone.",
        )
    )
    if any(record.small and record.small["scaled_s"] for record in report.methods):
        rows.append(("scaled", "Reckoned from the small picture by the number of pixels, not measured."))
    items = "\n".join(f"<dt>{escape(name)}</dt><dd>{escape(said)}</dd>" for name, said in rows)
    return f'<dl class="definitions">\n{items}\n</dl>'


def _settings(report: CompareReport) -> str:
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
    return f'<dl class="definitions">\n{items}\n</dl>'
