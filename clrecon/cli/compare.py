"""``clrecon compare``: all methods on one scan, side by side, as a page."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import product
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.errors import PARTLY_DONE, UsageError
from clrecon.proof.compare.methods import COMPARED, CompareSettings
from clrecon.system.records import describe_volume


def add_arguments(parser: argparse.ArgumentParser) -> None:
    width = max(map(len, COMPARED))
    parser.epilog = "\n".join(
        (
            "methods:",
            *(f"  {name:<{width}}  {method.what}" for name, method in COMPARED.items()),
            "",
            "Each method runs in a separate process, one after another: first, then warm. OUT/index.html is one page",
            "without script or network, OUT/report.json has its numbers, and the pictures lie beside it as PNG.",
            "A method that declines the scan has a row that says so; one whose package is not installed is left out.",
            "Exit code 8: one that --methods names did not run, or one failed. The folder appears as a whole or not",
            "at all; that of an earlier comparison is replaced. No name, ID or path of the scan is in it.",
            "clrecon distance measures the distance between two meshes.",
            "",
            "examples:",
            "  clrecon compare CT_FOLDER -o report",
            "  clrecon compare CT_FOLDER -o report --hu 200 --methods t-mc,vtk-fe,s-mc --repeat 7",
            "  clrecon phantom phantom && clrecon compare phantom -o report --hu 226 --truth phantom/truth.json",
            "  clrecon compare CT_FOLDER -o report --paper --region tube:40",
        )
    )
    common.add_input(parser, f"{common.SCAN_FOLDER}; or {common.GRID_FILE}")
    common.add_output(parser, "folder for the page: new, empty, or of a comparison")
    common.add_fields(parser.add_argument_group("comparison"), CompareSettings, "comparison")
    common.add_reading(parser)
    common.add_masking(parser)
    surface = parser.add_argument_group("surface")
    common.add_fields(surface.add_mutually_exclusive_group(), CompareSettings, "level")
    common.add_fields(surface, CompareSettings, "surface")
    common.add_device(parser.add_argument_group("device"))
    common.add_no_clobber(parser.add_argument_group("files and checks"))


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.proof.compare.job import make_comparison

    given = common.pick(options, CompareSettings)
    given |= given.pop("iso_value", {})  # one of two fields
    levels = given.get("iso_value")
    if levels is not None:
        if len(levels) != 1 or isinstance(levels[0], tuple):
            raise UsageError("methods are compared at one iso value: give --hu one number, auto or half:B,T")
        given["iso_value"] = levels[0]
    settings = CompareSettings(**given)
    report = make_comparison(options.input, options.output, settings, **common.run_options(options, console))
    named = [method[which] for method, which in product(report["methods"], ("picture", "difference"))]
    pictures = sum(name is not None for name in named) + 2 * len(report["slices"])
    written = f"wrote    {printable(options.output)}: index.html, report.json and {pictures} pictures"
    common.show_report(report, [*_describe_comparison(report), written], options, console)
    return PARTLY_DONE if any(_is_missed(method, settings.methods) for method in report["methods"]) else 0


def _is_missed(method: dict[str, Any], asked: Sequence[str]) -> bool:
    """True for a method that failed, or that was asked for by name and did not run."""
    return method["state"] == "failed" or (method["state"] != "done" and method["name"] in asked)


def _describe_comparison(report: dict[str, Any]) -> list[str]:
    rows = [("method", "triangles", "first s", "warm s", "memory MB", "slices Dice", "HD95 mm", "scatter mm")]
    for method in report["methods"]:
        if method["state"] != "done":
            rows.append((method["name"], f"{method['state']}: {method['error']}", *([""] * 6)))
            continue
        rows.append(
            (
                method["name"],
                _format_number(method["triangles"], ",.0f"),
                _format_number(method["first_s"], ".3f"),
                _format_number(method["warm_s"], ".3f"),
                _format_number(method["memory_bytes"] and 1e-6 * method["memory_bytes"], ",.0f"),
                _format_number(method["slices"] and method["slices"]["dice"], ".4f"),
                _format_number(method["surfaces"] and method["surfaces"]["hd95_mm"], ".3f"),
                _format_number(method["truth"] and method["truth"]["scatter_mm"], ".3f"),
            )
        )
    return [
        f"input    {describe_volume(report['volume'])}",
        f"level    {report['iso_value_hu']:g} HU: {report['iso_value_reason']}",
        f"device   {printable(report['device'])}",
        "",
        *common.table(rows, right=range(1, 8)),
        "",
        *report["findings"],
        f"time     {report['seconds']['total']:.1f} s",
    ]


def _format_number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
