"""``clrecon vertebrae``: a first guess of a label map of the vertebrae."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.jobs.settings import VertebraeSettings
from clrecon.system.records import describe_volume
from clrecon.system.text import count_of, format_bytes

_PARTLY = 8
_NAMING = "numbers, counted from the head: name the levels with --first T1 or --name-at X,Y,Z=L3"

_EPILOG = """\
A first guess for the spine of an adult from C3 down: look at the picture, and correct the map before it is used, for
example in 3D Slicer. A trained segmentation (TotalSegmentator, TotalSpineSeg) is better where there is one. Vertebrae
of low confidence are left out of the map, each with a warning, and the exit code is 8. No OpenCL device is needed.

examples:
  clrecon vertebrae CT_FOLDER -o spine.nii.gz
  clrecon vertebrae CT_FOLDER -o spine.nii.gz --first T12
  clrecon vertebrae CT_FOLDER -o spine.dcm --name-at -2,-156,-449=L3
  clrecon vertebrae CT_FOLDER -o spine.nii.gz --seed -2,-156,-449 --seed -2,-154,-412 --keep-unsure
  clrecon mesh CT_FOLDER -o l3.stl --labels spine.nii.gz --label L3
  (a label has the name of a level after --first or --name-at; without them it is --label vertebra_4)"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    common.add_input(parser)
    common.add_output(parser, "label map: .nii.gz, .nii, or .dcm (DICOM SEG)")
    common.add_picture(parser, "picture of discs and labels (default: beside the map, with its name)", "PNG")
    common.add_reading(parser)
    common.add_fields(parser.add_argument_group("vertebrae"), VertebraeSettings, "vertebrae")
    checks = parser.add_argument_group("checks")
    common.add_no_clobber(checks)
    common.add_report(checks, "vertebrae, confidence, discs and times")
    common.add_store(checks, "label map", "DICOM SEG")


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.vertebrae import make_vertebrae, picture_beside

    settings = common.make_settings(VertebraeSettings, options)
    with_picture = options.picture is not None or not getattr(options, "streams_output", False)  # beside what?
    report = make_vertebrae(
        options.input,
        options.output,
        settings,
        picture_path=options.picture,
        with_picture=with_picture,
        report_path=options.report,
        store=options.store,
        **common.run_options(options, console),
    )
    lines = _describe_split(report)
    if settings.name_at is None and settings.first is None:
        lines.append(f"names    {_NAMING}")
    lines.append(f"wrote    {printable(options.output)}, {format_bytes(report['output']['bytes'])}")
    lines += common.describe_stored(report)
    if with_picture:
        lines.append(f"picture  {printable(options.picture or picture_beside(options.output))}: look at it")
    common.show_report(report, lines, options, console)
    return _PARTLY if report["low_confidence"] else 0


def _describe_split(report: dict[str, Any]) -> list[str]:
    rows = [("", "number", "confidence", "height mm", "ml", "")]
    for entry in report["vertebrae"]:
        remarks = ("" if entry["is_confident"] else "low confidence ") + ("" if entry["whole"] else "cut by the scan")
        figures = f"{entry['confidence']:.2f}", f"{entry['height_mm']:.0f}", f"{entry['volume_ml']:.1f}"
        rows.append((entry["name"], str(entry["number"]), *figures, remarks.strip()))
    count = len(report["vertebrae"])
    return [
        f"input    {describe_volume(report['volume'])}",
        f"found    {count} vertebra{'e' * (count != 1)}, {report['low_confidence']} of low confidence,"
        f" {count_of(len(report['discs']), 'disc')};"
        f" bone is {report['level_hu']:.0f} HU and more",
        *(f"         {line}" for line in common.table(rows, right=(1, 2, 3, 4))),
        *(f"         {text}" for text in report["left_out"]),
        f"time     {report['seconds']['total']:.2f} s",
    ]
