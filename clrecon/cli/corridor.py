"""``clrecon corridor``: the widest straight lines through the pedicles of labelled vertebrae, and grades of screws."""

from __future__ import annotations

import argparse
from itertools import chain
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.errors import PARTLY_DONE
from clrecon.jobs.outputs import MESH_FILES, MeshFiles, name_outputs
from clrecon.jobs.settings import CorridorSettings
from clrecon.system.records import describe_volume
from clrecon.system.text import format_bytes

_EPILOG = """\
For each side of a vertebra: the straight line whose least distance to the outside of the solid bone is largest, from
the coronal plane through the vertebral canal to 80 % of the body's depth; see docs/corridor.md. Not for planning an
operation. Exit code 8 where a side has no corridor, with the reason.

examples:
  clrecon corridor CT_FOLDER --labels spine.seg.nrrd --label L3
  clrecon corridor CT_FOLDER --labels spine.nii.gz --label L1 --label L2 --margin 1.5 --picture l.png --report l.json
  clrecon corridor CT_FOLDER --labels spine.nii.gz --label L3 --surface cortex --report l3.json
  clrecon corridor CT_FOLDER --labels spine.nii.gz --label L3 --screw 15,-123,-448,7,-166,-446,4.5
  clrecon corridor CT_FOLDER --labels spine.nii.gz --label L3 --screws screws.csv -o l3.glb"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    common.add_input(parser)
    common.add_fields(parser, CorridorSettings)
    screws = parser.add_argument_group("given screws, which are graded (Gertzbein-Robbins, A to E)")
    screws.add_argument(
        "--screw",
        metavar="X,Y,Z,X,Y,Z,D",
        action="append",
        default=[],
        help="entry, tip and diameter in mm of the frame of --space; may be given again",
        first=True,
    )
    screws.add_argument("--screws", dest="file", metavar="FILE", help="screws as JSON or CSV, see docs/corridor.md")
    output = parser.add_argument_group("files")
    common.add_output(output, f"meshes: OUT_L3, OUT_L3_left and OUT_L3_right; {MESH_FILES}", required=False)
    common.add_picture(output, "slices through each corridor: .png, .jpg or .tif")
    common.add_report(output, "all figures")
    common.add_fields(output, CorridorSettings, "space")
    common.add_no_clobber(output)
    common.add_reading(parser)
    common.add_device(parser.add_argument_group("device, for --surface cortex and the mesh of the vertebra alone"))


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.corridor import make_corridors, parse_screw, read_screws

    space = options.space or "lps"
    screws = tuple(parse_screw(text, space, number) for number, text in enumerate(options.screw, start=1))
    if options.file is not None:
        screws += read_screws(options.file, space)
    report = make_corridors(
        options.input,
        common.make_settings(CorridorSettings, options, screws=screws),
        MeshFiles(options.output, options.picture, options.report),
        **common.run_options(options, console),
    )
    files = _name_files(report, options.output, options.picture)
    written = [f"wrote    {printable(path)}, {format_bytes(size)}" for path, size in files]
    common.show_report(report, describe_report(report) + written, options, console)
    refused = [side for side in chain(*(each["corridors"] for each in report["vertebrae"])) if side["refused"]]
    return PARTLY_DONE if refused else 0


def describe_report(report: dict[str, Any]) -> list[str]:
    lines = [
        f"input    {describe_volume(report['volume'])}",
        f"surface  {'fitted to the bone from ' if report['surface'] == 'cortex' else ''}{report['iso_value_hu']:g} HU,"
        f" {report['iso_value_reason']}",
    ]
    for vertebra in report["vertebrae"]:
        for side in vertebra["corridors"]:
            lines += _describe_side(vertebra["name"], side, report)
        for screw in vertebra["screws"]:
            lines += _describe_screw(vertebra["name"], screw)
    if report["grade_scale"]:
        lines.append(f"scale    {report['grade_scale']}")
    return [
        *lines,
        f"level    {report['level_bias']}",
        f"notice   {report['notice']}",
        f"time     {report['seconds']['total']:.2f} s",
    ]


def _name_files(report: dict[str, Any], output: str | None, picture: str | None) -> list[tuple[str, int]]:
    files = []
    for kind, path in (("picture", picture), ("mesh", output)):
        outputs = [each for each in report["outputs"] if each["kind"] == kind]
        if path is not None and outputs:
            names = [each["name"] for each in outputs] if kind == "mesh" or len(outputs) > 1 else [""]
            files += [(str(own), each["bytes"]) for own, each in zip(name_outputs(path, names), outputs, strict=True)]
    return files


def _point(values: list[float], space: str) -> str:
    return f"({values[0]:.1f}, {values[1]:.1f}, {values[2]:.1f}) {space.upper()}"


def _format_number(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"


def _describe_side(name: str, side: dict[str, Any], report: dict[str, Any]) -> list[str]:
    head = f"{printable(name):<8} {side['side']}: "
    if side["refused"]:
        return [f"{head}no corridor, {side['refused']}"]
    bias, low_high = side["level_bias_mm"], side["sagittal_angle_range_deg"]
    margins = ", ".join(f"{place} {_format_number(value)}" for place, value in side["margins_mm"].items())
    if report["surface"] == "cortex":
        of_level = "none: the surface is fitted"
    elif bias is None:
        of_level = "not measured: too few walls beside the line stand out"
    else:
        side_word = "outside" if bias["median"] >= 0.0 else "inside"
        of_level = (
            f"{abs(bias['median']):.2f} mm {side_word} of this pedicle's own half level ({bias['half_level_hu']:.0f}"
            f" HU), quartiles {bias['quartiles'][0]:.2f} to {bias['quartiles'][1]:.2f}"
        )
    angles, space = side["medial_angle_range_deg"], report["space"]
    return [
        f"{head}radius {side['radius_mm']:.1f} mm, screw to {side['screw_diameter_mm']:.1f} mm with a margin of"
        f" {report['margin_mm']:g} mm, length {side['length_mm']:.0f} mm",
        f"         medial {side['medial_angle_deg']:.0f} degrees ({angles[0]:.0f} to {angles[1]:.0f} within 0.1 mm; LPS"
        f" {side['medial_angle_lps_deg']:.0f}), sagittal not determined: {low_high[0]:.0f} to {low_high[1]:.0f} within"
        f" 0.1 mm, line at {side['sagittal_angle_deg']:.0f} (LPS {side['sagittal_angle_lps_deg']:.0f})",
        f"         entry {_point(side['entry_mm'], space)}, tip {_point(side['tip_mm'], space)}",
        f"         distance to {margins}; to the canal {_format_number(side['canal_mm'])} mm",
        f"         level {of_level}",
    ]


def _describe_screw(name: str, screw: dict[str, Any]) -> list[str]:
    breach = "no breach" if not screw["direction"] else f"breach {screw['breach_mm']:.1f} mm, {screw['direction']}"
    front = f"; {screw['front_mm']:.1f} mm outside in the body's front half" if screw["front_mm"] else ""
    margins = ", ".join(f"{place} {_format_number(value)}" for place, value in screw["margins_mm"].items())
    return [
        f"{printable(name):<8} {printable(screw['name'])}, {screw['side']}, {screw['diameter_mm']:g} x"
        f" {screw['length_mm']:.0f} mm: grade {screw['grade']}, {breach}{front}",
        f"         margins {margins} mm",
    ]
