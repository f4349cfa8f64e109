"""``clrecon export``: the volume of a CT series as NIfTI, NRRD or MetaImage."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.jobs.settings import ExportSettings
from clrecon.system.records import describe_volume
from clrecon.system.text import format_bytes

_PARTS = ("read", "mask", "resample", "write")
_EPILOG = """\
Values are HU as measured: int16 if they fit, otherwise int32,
and float32 for fractions. Each voxel keeps its position in the
scan: NIfTI in RAS mm, NRRD and MetaImage in LPS mm. None of
these formats can hold uneven slices, and .mha no gantry tilt:
both are refused without --resample. The file holds the
certificate of the scan, see docs/export.md.

examples:
  clrecon export CT_FOLDER -o ct.nii.gz
  clrecon export CT_FOLDER -o loin.nrrd --between -450,-400
  clrecon export CT_FOLDER -o l3.mha --around 10,-124,-424,40 --resample 0.5
  clrecon export CT_FOLDER -o bone.nii.gz --region hu:200,"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    common.add_input(parser)
    common.add_output(parser, "volume file: .nii.gz, .nii, .nrrd or .mha")
    common.add_fields(parser, ExportSettings)
    common.add_reading(parser)
    common.add_masking(parser, crop=True)
    common.add_device(parser.add_argument_group("device", "for --region and --preprocess only"))
    checks = parser.add_argument_group("checks")
    common.add_no_clobber(checks)
    common.add_report(checks, "affine, crop, certificate, values and times", first=False)


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.export import export_volume

    report = export_volume(
        options.input,
        options.output,
        common.make_settings(ExportSettings, options),
        report_path=options.report,
        **common.run_options(options, console),
    )
    output = report["output"]
    size, space = format_bytes(output["bytes"]), output["space"].upper()
    written = f"wrote    {printable(options.output)}, {size}, HU as {output['type']}, {space} mm"
    common.show_report(report, [*_describe_export(report), written], options, console)
    return 0


def _describe_export(report: dict[str, Any]) -> list[str]:
    output = report["output"]
    low, high = output["corners_lps_mm"]
    box = ", ".join(f"{name} {a:.1f} to {b:.1f}" for name, a, b in zip("xyz", low, high, strict=True))
    lines = [f"volume   {describe_volume(report['volume'])}", f"place    {box} mm (LPS)"]
    if output["outside_hu"] is not None:
        lines.append(f"region   what lies outside has {output['outside_hu']:g} HU")
    if report["device"] is not None:
        lines.append(f"device   {printable(report['device'])}")
    seconds = report["seconds"]
    parts = ", ".join(f"{part} {seconds[part]:.2f}" for part in _PARTS if part in seconds)
    return [*lines, f"time     {seconds['total']:.2f} s ({parts})"]
