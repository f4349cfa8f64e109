"""``clrecon bench``: the speed of clrecon on this computer, stage by stage."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.errors import PARTLY_DONE
from clrecon.jobs.options import hu_option, series_option
from clrecon.system.text import format_digits

_RUNS = 7


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "Times the stages from the scan to its surface, and VTK's flying edges (all cores, normals on) on the same\n"
        'voxels at the same level, in turn. "--device all" takes every device one after the other. Ratios are medians\n'
        "of pairs with their quartiles: above 1 clrecon is faster. The report holds no patient data.\n\n"
        "examples:\n"
        "  clrecon bench\n"
        "  clrecon bench CT_FOLDER --hu 250 --device all --report bench.json"
    )
    parser.add_argument("input", metavar="INPUT", nargs="?", help="DICOM folder or file (default: a synthetic spine)")
    level = hu_option("iso value in HU (default: the preset bone)", parse=float, first=True)
    common.add_option(parser, "hu", level)
    common.add_option(parser, "series", series_option('number or hash of the series, see "clrecon info"'))
    common.add_device(parser, memory=False)
    parser.add_argument(
        "--runs", type=int, default=_RUNS, metavar="N", help=f"timed pairs (default: {_RUNS})", first=True
    )
    common.add_report(parser, "the figures")
    common.add_no_clobber(parser, with_ids=False)


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.proof.bench import run_bench

    result = run_bench(
        options.input,
        iso_value=options.hu,
        device=options.device,
        runs=options.runs,
        series=options.series,
        report_path=options.report,
        **common.run_options(options, console),
    )
    lines = _describe_bench(result)
    common.show_report(result, [*lines, ""] if options.report else lines, options, console)
    return PARTLY_DONE if any(entry["error"] for entry in result["devices"]) else 0


def _describe_bench(result: dict[str, Any]) -> list[str]:
    given = result["input"]
    ni, nj, nk = given["shape_ijk"]
    spacing = " x ".join(f"{step:.4g}" for step in given["spacing_mm"])
    name, read = ("phantom", "make") if given["kind"] == "phantom" else ("series", "read")
    rate = 1e-6 * given["voxels"] / result["seconds"][read]
    lines = [
        f"input    {name}, {nk} slices of {ni} x {nj}, spacing {spacing} mm",
        f"surface  {result['iso_value_hu']:g} HU, open at the border of the volume",
        f"system   {printable(result['processor'])}, {result['cores']} cores ({result['free_cores']:.1f} free),"
        f" {result['platform']}",
        f"{read:<8} {_seconds(result['seconds'][read])} ({format_digits(rate, 2)} Mvoxel/s)",
    ]
    for entry in result["devices"]:
        lines += ["", *_describe_device(entry)]
    return lines


def _describe_device(entry: dict[str, Any]) -> list[str]:
    head = f"device {entry['device']['index']} {common.name_device(entry['device'])}"
    if entry["error"]:
        return [head, f"  failed: {printable(entry['error'])}"]
    first, warm = entry["first_seconds"], entry["warm_seconds"]
    peer = entry["peer"]
    opening = ", ".join(
        f"{part} {_seconds(first.get(part, 0.0))}" for part in ("open", "build", "upload", "kernels", "download")
    )
    rows = [
        ("first surface", _seconds(first["total"]), opening),
        ("later ones", _seconds(warm["median"]), _range(warm)),
        *((f"  {part}", _seconds(value), "") for part, value in entry["part_seconds"].items()),
        *((f"    {kernel}", _seconds(value), "") for kernel, value in entry["kernel_seconds"].items()),
    ]
    if entry["resident_seconds"] is not None:
        resident = entry["resident_seconds"]
        rows.append(("new iso value", _seconds(resident["median"]), f"{_range(resident)}, volume on the device"))
    if peer is not None:
        threads = f"{peer['threads']} thread{'s' * (peer['threads'] != 1)}"
        rows.append(("flying edges", _seconds(peer["seconds"]["median"]), f"{_range(peer['seconds'])}, {threads}"))
        ratio = entry["ratio"]
        spread = f"quartiles {ratio['q1']:.2f} to {ratio['q3']:.2f}, above 1 clrecon is faster"
        rows.append(("ratio", f"{ratio['median']:.2f}", spread))
    voxels, triangles = (format_digits(entry[name], 2) for name in ("mvoxels_per_s", "mtriangles_per_s"))
    rates = f"{voxels} Mvoxel/s, {triangles} Mtriangle/s"
    counts = f"{entry['vertices']:,} vertices, {entry['triangles']:,} triangles"
    return [head, *(f"  {line}" for line in common.table(rows, right=(1,))), f"  {counts}, {rates}"]


def _seconds(value: float) -> str:
    return f"{value:.2f} s" if value >= 1.0 else f"{1e3 * value:.2f} ms"


def _range(spread: dict[str, float]) -> str:
    return f"quartiles {_seconds(spread['q1'])} to {_seconds(spread['q3'])}"
