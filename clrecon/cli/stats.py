"""``clrecon stats``: volume and HU of each label of a label map."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, is_terminal, printable
from clrecon.jobs.settings import StatsSettings
from clrecon.system.records import describe_volume

_EPILOG = """\
Each voxel counts with its own volume, also in unevenly spaced slices. A label map on another grid is resampled to the
grid of the scan: each voxel gets the nearest label. Only --surface needs an OpenCL device. See docs/statistics.md.

examples:
  clrecon stats CT_FOLDER --labels spine.nii.gz
  clrecon stats CT_FOLDER --labels spine.nii.gz --surface cortex --csv walls.csv
  clrecon stats CT_FOLDER --labels organs.seg.nrrd --label liver --csv liver.csv --report liver.json
  clrecon stats ct.nii.gz --labels organs.nii.gz --percentiles 2.5,50,97.5"""

_LEAST_NAME = 8
"""Characters of a name that are shown in the narrowest window."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    common.add_input(parser)
    common.add_fields(parser, StatsSettings)
    surface = parser.add_argument_group("surface of each label, filled")
    common.add_fields(surface, StatsSettings, "surface")
    common.add_device(surface)
    output = parser.add_argument_group("files")
    output.add_argument("--csv", metavar="FILE", help="write the figures as a table, a line for each label", first=True)
    common.add_report(output, "figures, certificate of the scan and warnings")
    common.add_no_clobber(output)
    common.add_reading(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.stats import measure_stats

    report = measure_stats(
        options.input,
        common.make_settings(StatsSettings, options),
        report_path=options.report,
        csv_path=options.csv,
        **common.run_options(options, console),
    )
    width = shutil.get_terminal_size().columns if is_terminal(sys.stdout) else None
    lines = [
        f"input    {describe_volume(report['volume'])}",
        *(["labels   brought to the grid of the scan: the nearest label in mm"] if report["resampled"] else []),
        "figures  volume in ml, the rest in HU: mean, standard deviation, least, percentiles, largest",
        *_lay_out(report, width),
        *_lay_out_surfaces(report["labels"]),
        f"time     {report['seconds']['total']:.2f} s",
        *([f"wrote    {printable(options.csv)}"] if options.csv is not None else []),
    ]
    common.show_report(report, lines, options, console)
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
            [_format_hu(hu) for hu in (one["min_hu"], *map(one["percentiles_hu"].get, percents), one["max_hu"])]
            for one in report["labels"]
        ),
    ]
    whole = _name_rows(names, [a + b for a, b in zip(volumes, spread, strict=True)])
    if width is None or max(map(len, whole)) <= width:
        return whole
    return [*_fit_names(names, volumes, width), "", *_fit_names(names, spread, width)]


def _lay_out_surfaces(labels: Sequence[dict[str, Any]]) -> list[str]:
    from clrecon.jobs.stats import surface_cells

    of = [one["surface"] for one in labels if one["surface"]]
    if not of:
        return []
    fitted = of[0]["kind"] == "cortex"
    head = ["surface", "cm2", "ml", *(["walls 5 %", "50 %", "95 %", "error", "fitted"] if fitted else [])]
    rows = []
    for label in labels:
        area, ml, *walls, share = surface_cells(label["surface"])
        cells = ["none" if area is None else f"{area / 100.0:,.1f}", "none" if ml is None else _ml(ml)]
        if fitted:
            cells += ["none" if value is None else f"{value:.2f}" for value in walls]
            cells.append("none" if share is None else f"{100.0 * share:.0f} %")
        rows.append([printable(label["name"]), *cells])
    kind = "moved onto the bone from" if fitted else "at"
    units = "; walls and their error in mm, share of the vertices fitted to the bone" if fitted else ""
    text = f"surface  {kind} {of[0]['iso_value_hu']:g} HU, filled{units}"
    return ["", text, *common.table([head, *rows], range(1, 8))]


def _fit_names(names: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """Shorten the names until the table fits into the width, or few characters of them are left."""
    beside = max(len(line) for line in _name_rows([""] * len(names), rows))
    most = max(_LEAST_NAME, width - beside)
    return _name_rows([name if len(name) <= most else f"{name[: most - 3]}..." for name in names], rows)


def _name_rows(names: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return common.table([(name, *row) for name, row in zip(names, rows, strict=True)], right=range(1, 1 + len(rows[0])))


def _ml(value: float) -> str:
    return f"{value:,.2f}" if value < 1000.0 else f"{value:,.0f}"


def _mean(value: float | None) -> str:
    return "none" if value is None else f"{round(value, 1) + 0.0:.1f}"


def _format_hu(value: float | None) -> str:
    """Return HU with a decimal only where there is one, and zero without a sign."""
    if value is None:
        return "none"
    return f"{round(value, 1) + 0.0:g}" if abs(value) < 1e5 else f"{value:.4g}"
