"""``clrecon corridor``: the widest straight lines through the pedicles of labelled vertebrae, and grades of screws."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli.common import (
    add_device,
    add_keep_ids,
    add_memory,
    add_no_clobber,
    add_reading,
    megabytes,
    parse_levels,
)
from clrecon.cli.console import Console, printable
from clrecon.cli.mesh import describe_volume
from clrecon.errors import UsageError
from clrecon.jobs.outputs import MESH_FILES

PARTLY_DONE = 8

_EPILOG = """\
For each side of a vertebra: the straight line whose least distance to the outside of the solid bone is largest, from
the coronal plane through the vertebral canal to 80 % of the body's depth; see docs/corridor.md. Not for planning an
operation. Exit code 8 where a side has no corridor, with the reason.

examples:
  clrecon corridor CT_FOLDER --labels spine.seg.nrrd --label L3
  clrecon corridor CT_FOLDER --labels spine.nii.gz --label L1 --label L2 --margin 1.5 --picture l.png --report l.json
  clrecon corridor CT_FOLDER --labels spine.nii.gz --label L3 --screw 15,-123,-448,7,-166,-446,4.5
  clrecon corridor CT_FOLDER --labels spine.nii.gz --label L3 --screws screws.csv -o l3.glb"""


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
        "--label",
        metavar="NAME|N",
        action="append",
        help="a vertebra of the map; may be given again",
        default=[],
        first=True,
    )
    parser.add_argument(
        "--hu",
        metavar="auto|N",
        default="auto",
        help="HU at which the bone's surface lies (default: auto, half way between bone and the tissue beside it)",
        first=True,
    )
    parser.add_argument(
        "--margin",
        type=float,
        default=1.0,
        metavar="MM",
        help="distance that a screw of the largest diameter keeps from the surface (default: 1)",
        first=True,
    )
    screws = parser.add_argument_group("given screws, which are graded (Gertzbein-Robbins, A to E)")
    screws.add_argument(
        "--screw",
        metavar="X,Y,Z,X,Y,Z,D",
        action="append",
        default=[],
        help="entry, tip and diameter in mm of the frame of --space; may be given again",
        first=True,
    )
    screws.add_argument("--screws", metavar="FILE", help="screws as JSON or CSV, see docs/corridor.md")
    output = parser.add_argument_group("files")
    output.add_argument(
        "-o", "--output", metavar="OUT", help=f"meshes: OUT_L3, OUT_L3_left and OUT_L3_right; {MESH_FILES}", first=True
    )
    output.add_argument(
        "--picture", metavar="FILE", help="slices through each corridor: .png, .jpg or .tif", first=True
    )
    output.add_argument("--report", metavar="FILE", help="write all figures as JSON", first=True)
    output.add_argument(
        "--space",
        type=str.lower,
        default="lps",
        metavar="lps|ras",
        help="patient frame of points and meshes (default: lps)",
    )
    add_no_clobber(output)
    add_keep_ids(output)
    add_reading(parser)
    device = parser.add_argument_group("device, for the mesh of the vertebra alone")
    add_device(device)
    add_memory(device)


def _settings(options: argparse.Namespace) -> Any:
    from clrecon.jobs.corridor import CorridorSettings, parse_screw, read_screws

    level = None
    if options.hu != "auto":
        try:
            levels = parse_levels(options.hu)
        except argparse.ArgumentTypeError as error:
            raise UsageError(f"--hu: {error}") from error
        if len(levels) != 1:
            raise UsageError(f"--hu is one level or auto, not {options.hu!r:.80}")
        level = levels[0]
    given = tuple(parse_screw(text, options.space, number) for number, text in enumerate(options.screw, start=1))
    if options.screws is not None:
        given += read_screws(options.screws, options.space)
    return CorridorSettings(
        labels=options.labels,
        only=tuple(options.label),
        iso_value=level,
        margin=options.margin,
        screws=given,
        space=options.space,
        keep_ids=options.keep_ids,
        device=options.device,
        memory=options.memory,
        series=options.series,
        phase=options.phase,
        allow_gaps=options.allow_gaps,
        force=options.force,
        follow_links=options.follow_links,
        rescale=options.rescale,
    )


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.jobs.corridor import CorridorFiles, make_corridors

    files = CorridorFiles(options.output, options.picture, options.report)
    report = make_corridors(
        options.input, _settings(options), files, no_clobber=options.no_clobber, progress=console.progress
    )
    console.result(report)
    for line in describe_report(report):
        console.say(line)
    for path, size in _name_files(report, options.output, options.picture):
        console.say(f"wrote    {printable(path)}, {megabytes(size)}")
    if options.report:
        console.say(f"report   {printable(options.report)}")
    for warning in report["warnings"]:
        console.warn(warning)
    refused = [side for each in report["vertebrae"] for side in each["corridors"] if side["refused"]]
    return PARTLY_DONE if refused else 0


def describe_report(report: dict[str, Any]) -> list[str]:
    """Describe a report for people."""
    lines = [
        f"input    {describe_volume(report['volume'])}",
        f"surface  {report['iso_value_hu']:g} HU, {report['iso_value_reason']}",
    ]
    for each in report["vertebrae"]:
        for side in each["corridors"]:
            lines += _describe_side(each["name"], side, report)
        for screw in each["screws"]:
            lines += _describe_screw(each["name"], screw)
    if report["grade_scale"]:
        lines.append(f"scale    {report['grade_scale']}")
    return [
        *lines,
        f"level    {report['level_bias']}",
        f"notice   {report['notice']}",
        f"time     {report['seconds']['total']:.2f} s",
    ]


def _name_files(report: dict[str, Any], output: str | None, picture: str | None) -> list[tuple[str, int]]:
    """Return the path and the size of each picture and mesh."""
    from clrecon.jobs.outputs import name_outputs

    files = []
    for kind, path in (("picture", picture), ("mesh", output)):
        made = [each for each in report["outputs"] if each["kind"] == kind]
        if path is not None and made:
            names = [each["name"] for each in made] if kind == "mesh" or len(made) > 1 else [""]
            files += [(str(own), each["bytes"]) for own, each in zip(name_outputs(path, names), made, strict=True)]
    return files


def _point(values: list[float], space: str) -> str:
    return f"({values[0]:.1f}, {values[1]:.1f}, {values[2]:.1f}) {space.upper()}"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"


def _describe_side(name: str, side: dict[str, Any], report: dict[str, Any]) -> list[str]:
    head = f"{printable(name):<8} {side['side']}: "
    if side["refused"]:
        return [f"{head}no corridor, {side['refused']}"]
    bias, low_high = side["level_bias_mm"], side["sagittal_angle_range_deg"]
    margins = ", ".join(f"{place} {_number(value)}" for place, value in side["margins_mm"].items())
    if bias is None:
        of_level = "not measured: too few walls beside the line stand out"
    else:
        way = "outside" if bias["median"] >= 0.0 else "inside"
        of_level = (
            f"{abs(bias['median']):.2f} mm {way} of this pedicle's own half level ({bias['half_level_hu']:.0f} HU),"
            f" quartiles {bias['quartiles'][0]:.2f} to {bias['quartiles'][1]:.2f}"
        )
    own, space = side["medial_angle_range_deg"], report["space"]
    return [
        f"{head}radius {side['radius_mm']:.1f} mm, screw to {side['screw_diameter_mm']:.1f} mm with a margin of"
        f" {report['margin_mm']:g} mm, length {side['length_mm']:.0f} mm",
        f"         medial {side['medial_angle_deg']:.0f} degrees ({own[0]:.0f} to {own[1]:.0f} within 0.1 mm; LPS"
        f" {side['medial_angle_lps_deg']:.0f}), sagittal not determined: {low_high[0]:.0f} to {low_high[1]:.0f} within"
        f" 0.1 mm, line at {side['sagittal_angle_deg']:.0f} (LPS {side['sagittal_angle_lps_deg']:.0f})",
        f"         entry {_point(side['entry_mm'], space)}, tip {_point(side['tip_mm'], space)}",
        f"         distance to {margins}; to the canal {_number(side['canal_mm'])} mm",
        f"         level {of_level}",
    ]


def _describe_screw(name: str, screw: dict[str, Any]) -> list[str]:
    breach = "no breach" if not screw["direction"] else f"breach {screw['breach_mm']:.1f} mm, {screw['direction']}"
    front = f"; {screw['front_mm']:.1f} mm outside in the body's front half" if screw["front_mm"] else ""
    margins = ", ".join(f"{place} {_number(value)}" for place, value in screw["margins_mm"].items())
    return [
        f"{printable(name):<8} {printable(screw['name'])}, {screw['side']}, {screw['diameter_mm']:g} x"
        f" {screw['length_mm']:.0f} mm: grade {screw['grade']}, {breach}{front}",
        f"         margins {margins} mm",
    ]
