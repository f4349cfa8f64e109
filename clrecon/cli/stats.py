"""``clrecon stats``: volume and HU of each label of a label map."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from typing import Any

from clrecon.cli.common import add_keep_ids, add_no_clobber, add_reading, table
from clrecon.cli.console import Console, is_terminal, printable
from clrecon.cli.mesh import describe_volume

_EPILOG = """\
Each voxel counts with its own volume: slices that lie unevenly are right. A label map on another grid is brought to
the scan's, voxel by voxel the nearest label in mm. No OpenCL device is needed. See docs/statistics.md.

examples:
  clrecon stats CT_FOLDER --labels spine.nii.gz
  clrecon stats CT_FOLDER --labels organs.seg.nrrd --label liver --csv liver.csv --report liver.json
  clrecon stats ct.nii.gz --labels organs.nii.gz --percentiles 2.5,50,97.5"""

_LEAST_NAME = 8
"""Characters of a name that are shown in the narrowest window."""


def _parse_numbers(text: str) -> tuple[float, ...]:
    """Read numbers with commas between them."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} are no percentiles: numbers with commas, 5,50,95") from None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = _EPILOG
    parser.add_argument("input", metavar="INPUT", help="DICOM folder or file; or a NIfTI, NRRD or MetaImage file")
    parser.add_argument(
        "--labels",
        metavar="FILE|FOLDER",
        required=True,
        help="label map: NIfTI, NRRD (.seg.nrrd too), MetaImage, DICOM SEG, RTSTRUCT, or a folder of masks",
        first=True,
    )
    parser.add_argument(
        "--label", metavar="NAME|N", action="append", default=[], help="this label only; may be given again", first=True
    )
    parser.add_argument(
        "--percentiles",
        type=_parse_numbers,
        metavar="P,P",
        help="percentiles of HU, from 0 to 100 (default: 5,25,50,75,95)",
        first=True,
    )
    output = parser.add_argument_group("files")
    output.add_argument("--csv", metavar="FILE", help="write the figures as a table, one line a label", first=True)
    output.add_argument(
        "--report", metavar="FILE", help="write figures, certificate of the scan and warnings as JSON", first=True
    )
    add_no_clobber(output)
    add_keep_ids(output)
    add_reading(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.jobs.stats import StatsSettings, measure_stats

    given = {} if options.percentiles is None else {"percentiles": options.percentiles}
    settings = StatsSettings(
        labels=options.labels,
        only=tuple(options.label),
        keep_ids=options.keep_ids,
        series=options.series,
        phase=options.phase,
        allow_gaps=options.allow_gaps,
        force=options.force,
        follow_links=options.follow_links,
        rescale=options.rescale,
        **given,
    )
    report = measure_stats(
        options.input,
        settings,
        report_path=options.report,
        csv_path=options.csv,
        no_clobber=options.no_clobber,
        progress=console.progress,
    )
    console.result(report)
    console.say(f"input    {describe_volume(report['volume'])}")
    if report["resampled"]:
        console.say("labels   brought to the grid of the scan: the nearest label in mm")
    console.say("figures  volume in ml, the rest in HU: mean, standard deviation, least, percentiles, largest")
    width = shutil.get_terminal_size().columns if is_terminal(sys.stdout) else None
    for line in _lay_out(report, width):
        console.say(line)
    console.say(f"time     {report['seconds']['total']:.2f} s")
    for what, path in (("wrote", options.csv), ("report", options.report)):
        if path is not None:
            console.say(f"{what:<8} {printable(path)}")
    for warning in report["warnings"]:
        console.warn(warning)
    return 0


def _lay_out(report: dict[str, Any], width: int | None) -> list[str]:
    """Lay out the figures as one table; where the window is too narrow, as two with the names in both."""
    percents = [f"{percent:g}" for percent in report["percentiles"]]
    names = ["label", *(printable(one["name"]) for one in report["labels"])]
    volumes = [
        ["ml", "mean", "sd"],
        *([_ml(one["ml"]), _mean(one["mean_hu"]), _mean(one["sd_hu"])] for one in report["labels"]),
    ]
    spread = [
        ["min", *(f"{name} %" for name in percents), "max"],
        *(
            [*_hu(one, "min_hu"), *(_number(one["percentiles_hu"][name]) for name in percents), *_hu(one, "max_hu")]
            for one in report["labels"]
        ),
    ]
    whole = _name_rows(names, [a + b for a, b in zip(volumes, spread, strict=True)])
    if width is None or max(map(len, whole)) <= width:
        return whole
    return [*_fit(names, volumes, width), "", *_fit(names, spread, width)]


def _fit(names: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """Shorten the names until the table fits into the width, or few characters of them are left."""
    beside = max(len(line) for line in _name_rows([""] * len(names), rows))
    most = max(_LEAST_NAME, width - beside)
    shown = [name if len(name) <= most else f"{name[: most - 3]}..." for name in names]
    return _name_rows(shown, rows)


def _name_rows(names: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return table(
        [(name, *row) for name, row in zip(names, rows, strict=True)], right=range(1, 1 + len(rows[0]))
    )  # fmt: skip


def _ml(value: float) -> str:
    return f"{value:,.2f}" if value < 1000.0 else f"{value:,.0f}"


def _mean(value: float | None) -> str:
    return "none" if value is None else f"{round(value, 1) + 0.0:.1f}"


def _hu(one: dict[str, Any], *fields: str) -> list[str]:
    return [_number(one[field]) for field in fields]


def _number(value: float | None) -> str:
    """Return HU with a decimal only where there is one, and zero without a sign."""
    if value is None:
        return "none"
    return f"{round(value, 1) + 0.0:g}" if abs(value) < 1e5 else f"{value:.4g}"
