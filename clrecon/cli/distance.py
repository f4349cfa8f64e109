"""``clrecon distance``: how far two meshes lie apart, or a mesh and the bone of a scan."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.jobs.inputs import MESH_INPUTS
from clrecon.jobs.settings import DistanceSettings
from clrecon.system.text import format_bytes, format_volume

_EPILOG = """\
Distances are measured from points spread evenly over each mesh to the nearest triangle of the other, in mm. If
the other mesh is closed, distances have a sign: + is outside of it. See docs/distance.md. To compare methods on a scan,
use clrecon compare.

examples:
  clrecon distance printed.stl bone.stl
  clrecon distance bone.3mf bone.glb
  clrecon distance printed.stl CT_FOLDER --surface cortex
  clrecon distance a.ply b.ply -o a_to_b.ply --picture a_to_b.png --range 2 --report a_to_b.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("mesh", metavar="A", help=f"mesh: {', '.join(MESH_INPUTS)}")
    parser.add_argument("reference", metavar="B", help="mesh to compare with; with --surface a scan")
    common.add_fields(parser, DistanceSettings)
    common.add_fields(parser.add_argument_group("scan"), DistanceSettings, "scan")
    output = parser.add_argument_group("files")
    common.add_output(output, "write A coloured by its distance from B: .ply", metavar="PLY", required=False)
    common.add_picture(output, "draw the coloured mesh with its scale: .png, .jpg or .tif")
    common.add_fields(output, DistanceSettings, "picture")
    common.add_report(output, "all figures")
    common.add_no_clobber(output)
    common.add_reading(parser)
    common.add_device(parser.add_argument_group("device, for pictures and the surface of a scan"))


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.distance import measure_meshes
    from clrecon.jobs.outputs import MeshFiles

    report = measure_meshes(
        options.mesh,
        options.reference,
        MeshFiles(options.output, options.picture, options.report),
        common.make_settings(DistanceSettings, options),
        **common.run_options(options, console),
    )
    common.show_report(report, _describe_distance(report), options, console)
    return 0


def _describe_distance(report: dict[str, Any]) -> list[str]:
    lines = []
    for name in ("a", "b"):
        lines += _describe_mesh(name.upper(), report[name])
    sides = {"A to B": "a_to_b", "B to A": "b_to_a"}
    figures = [["mm", "mean", "rms", "95 %", "largest"]]
    for words, side in sides.items():
        figures.append([words, *(_mm(report[f"{side}_mm"][name]) for name in ("mean", "rms", "p95", "max"))])
    figures.append(["both", _mm(report["assd_mm"]), "", _mm(report["hd95_mm"]), _mm(report["hausdorff_mm"])])
    lines += ["", *common.table(figures, right=range(1, 5))]
    signed = {words: report[f"{side}_signed_mm"] for words, side in sides.items()}
    if any(signed.values()):
        figures = [["signed mm", "mean", "5 %", "50 %", "95 %", "outside"]]
        for words, side_figures in signed.items():
            if side_figures is not None:
                cells = [_mm(side_figures[name], "+") for name in ("mean", "p5", "median", "p95")]
                figures.append([words, *cells, f"{100.0 * side_figures['outside_share']:.0f} %"])
        lines += ["", *common.table(figures, right=range(1, 6))]
    lines.append("")
    if report["colors"] is not None:
        end = f"{report['colors']['range_mm']:g}"
        span = f"-{end} to +{end}" if report["colors"]["signed"] else f"0 to {end}"
        lines.append(
            f"colours  {span} mm, beyond them {100.0 * report['colors']['beyond_share']:.1f} % of A's vertices"
        )
    lines.append(f"time     {report['seconds']['total']:.2f} s")
    for output in report["outputs"]:
        lines.append(f"wrote    {output['kind']} {printable(output['name'])}, {format_bytes(output['bytes'])}")
    return lines


def _describe_mesh(letter: str, entry: dict[str, Any]) -> list[str]:
    lines = []
    if entry["iso_value_hu"] is not None:
        lines = [f"         bone {'fitted from' if entry['cortex'] else 'at'} {entry['iso_value_hu']:g} HU"]
    if entry["cortex"]:
        lines[0] += f", {common.describe_fit(entry['cortex'])}"
    size = f"{entry['triangles']:,} triangles, "
    size += "not closed" if entry["volume_ml"] is None else f"closed, {format_volume(entry['volume_ml'])}"
    file = f"{letter:<9}{printable(entry['name'])}"
    return [file, *lines, f"         {size}", f"         {common.describe_frame(entry)}"]


def _mm(value: float, sign: str = "") -> str:
    return f"{round(value, 3) + 0.0:{sign}.3f}"
