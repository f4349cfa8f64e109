"""``clrecon compare``: all methods on one scan, side by side, as a page."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from clrecon.cli.common import (
    add_device,
    add_keep_ids,
    add_masking,
    add_memory,
    add_no_clobber,
    add_reading,
    parse_hu,
    pick,
    table,
)
from clrecon.cli.console import Console, printable
from clrecon.cli.mesh import describe_volume
from clrecon.jobs.presets import DEFAULT_PRESET, PRESETS
from clrecon.proof.compare.methods import COMPARED

PARTLY_DONE = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    width = max(map(len, COMPARED))
    parser.epilog = "\n".join(
        (
            "methods:",
            *(f"  {name:<{width}}  {method.what}" for name, method in COMPARED.items()),
            "",
            "Each method runs in a process of its own, one after another: first, then warm. OUT/index.html is one page",
            "without script or network, OUT/report.json has its numbers, and the pictures lie beside it as PNG. A"
            " method",
            "that declines the scan, or whose library is not installed, is a row that says so. Exit code 8: one that",
            "--methods names did not run, or one failed. The folder appears as a whole or not at all; that of an",
            "earlier comparison is replaced. No name, ID or path of the scan is in it.",
            "How far two meshes lie apart is what clrecon distance measures.",
            "",
            "examples:",
            "  clrecon compare CT_FOLDER -o report",
            "  clrecon compare CT_FOLDER -o report --hu 200 --methods t-mc,vtk-fe,s-mc --repeat 7",
            "  clrecon phantom phantom && clrecon compare phantom -o report --hu 226 --truth phantom/truth.json",
            "  clrecon compare CT_FOLDER -o report --paper --region tube:40",
        )
    )
    parser.add_argument(
        "input",
        metavar="INPUT",
        help="DICOM folder (subfolders and any file names are fine) or file; or a NIfTI, NRRD or MetaImage file",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        required=True,
        help="folder for the page: new, empty, or of a comparison",
        first=True,
    )
    compared = parser.add_argument_group("comparison")
    compared.add_argument(
        "--methods",
        type=_parse_names,
        default=(),
        metavar="M[,M...]",
        help="methods to compare; see below (default: all)",
        first=True,
    )
    compared.add_argument(
        "--reference", type=str.lower, default="t-mc", metavar="M", help="method to compare with (default: t-mc)"
    )
    compared.add_argument(
        "--truth",
        metavar="FILE",
        help="truth.json of a phantom: errors against its true surface are measured too",
        first=True,
    )
    compared.add_argument(
        "--paper",
        action="store_true",
        help="also compare a picture of each method with the middle slice by SSIM and MSE, as a paper does, beside"
        " controls that show what this is worth",
        first=True,
    )
    compared.add_argument(
        "--repeat",
        type=int,
        default=3,
        metavar="N",
        help="warm runs of each method; the median counts (default: 3)",
        first=True,
    )
    add_reading(parser)
    add_masking(parser)
    _add_surface(parser)
    device = parser.add_argument_group("device")
    add_device(device)
    add_memory(device)
    checks = parser.add_argument_group("files and checks")
    add_no_clobber(checks)
    add_keep_ids(checks)


def _add_surface(parser: argparse.ArgumentParser) -> None:
    surface = parser.add_argument_group("surface")
    level = surface.add_mutually_exclusive_group()
    level.add_argument(
        "--hu",
        type=parse_hu,
        default={},
        metavar="N|auto|half:B,T",
        help="iso value in HU, inside is N and above; auto: half way between bone and the tissue beside it, measured in"
        " the scan; half:BONE,TISSUE: half way between these two",
        first=True,
    )
    level.add_argument(
        "--preset",
        type=str.lower,
        metavar="NAME",
        help=f"iso value by tissue, one of: {', '.join(PRESETS)} (default: {DEFAULT_PRESET})",
    )
    surface.add_argument(
        "--open", dest="closed", action="store_false", help="leave the surface open at the border of the volume"
    )


def _parse_names(text: str) -> tuple[str, ...]:
    """Read names with commas between them."""
    names = tuple(name.strip().lower() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"{text!r} has an empty name: write methods with single commas between them")
    return names


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.errors import UsageError
    from clrecon.proof.compare.job import make_comparison
    from clrecon.proof.compare.methods import CompareSettings

    given = {**pick(options, {own.name for own in fields(CompareSettings)}), **options.hu}
    levels = given.get("iso_value")
    if levels is not None:
        if len(levels) != 1 or isinstance(levels[0], tuple):
            raise UsageError("methods are compared at one iso value: give --hu one number, auto or half:B,T")
        given["iso_value"] = levels[0]
    report = make_comparison(
        options.input, options.output, CompareSettings(**given), no_clobber=options.no_clobber,
        progress=console.progress,
    )  # fmt: skip
    console.result(report)
    for line in _describe(report):
        console.say(line)
    named = [method[which] for method in report["methods"] for which in ("picture", "difference")]
    pictures = sum(name is not None for name in named) + 2 * len(report["slices"])
    console.say(f"wrote    {printable(options.output)}: index.html, report.json and {pictures} pictures")
    for warning in report["warnings"]:
        console.warn(warning)
    return PARTLY_DONE if any(_is_missed(method, options.methods) for method in report["methods"]) else 0


def _is_missed(method: dict[str, Any], asked: Sequence[str]) -> bool:
    """True for a method that failed, or that was asked for by name and did not run."""
    return method["state"] == "failed" or (method["state"] != "done" and method["name"] in asked)


def _describe(report: dict[str, Any]) -> list[str]:
    """Describe a comparison for people: the input, the table in short, what the numbers say."""
    rows = [("method", "triangles", "first s", "warm s", "memory MB", "slices Dice", "HD95 mm", "scatter mm")]
    for method in report["methods"]:
        if method["state"] != "done":
            rows.append((method["name"], f"{method['state']}: {method['error']}", *([""] * 6)))
            continue
        rows.append(
            (
                method["name"],
                _say(method["triangles"], ",.0f"),
                _say(method["first_s"], ".3f"),
                _say(method["warm_s"], ".3f"),
                _say(method["memory_bytes"] and 1e-6 * method["memory_bytes"], ",.0f"),
                _say(method["slices"] and method["slices"]["dice"], ".4f"),
                _say(method["surfaces"] and method["surfaces"]["hd95_mm"], ".3f"),
                _say(method["truth"] and method["truth"]["scatter_mm"], ".3f"),
            )
        )
    return [
        f"input    {describe_volume(report['volume'])}",
        f"level    {report['iso_value_hu']:g} HU: {report['iso_value_reason']}",
        f"device   {printable(report['device'])}",
        "",
        *table(rows, right=range(1, 8)),
        "",
        *report["findings"],
        f"time     {report['seconds']['total']:.1f} s",
    ]


def _say(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
