"""``clrecon view``: look at scans and meshes."""

from __future__ import annotations

import argparse
from dataclasses import fields
from typing import Any

from clrecon.cli.common import add_device, add_keep_ids, add_memory, add_no_clobber, megabytes, pick, table
from clrecon.cli.console import Console, printable
from clrecon.cli.cropping import add_cropping
from clrecon.cli.labels import add_label_arguments, label_choice
from clrecon.cli.masking import add_masking
from clrecon.cli.mesh import add_levels, add_selection, add_solid, describe_volume
from clrecon.cli.reading import add_reading
from clrecon.errors import UsageError

__all__ = ["add_arguments", "run"]

_EPILOG = """\
The page is one file: any browser from 2023 on shows it, without a server and offline. It asks for nothing from outside
and holds no patient data: files are numbered, not named, unless --name is given. It turns, clips and measures; parts
(components, labels, files) are switched one by one. See docs/view.md. A window is not there yet.

examples:
  clrecon view CT_FOLDER --html page.html
  clrecon view CT_FOLDER --html spine.html --labels spine.nii.gz
  clrecon view bone.stl implant.ply --html both.html --name bone --name implant"""
_SHOWN_PARTS = 12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "inputs",
        metavar="INPUT",
        nargs="+",
        help="mesh file (.stl, .ply), or a scan: DICOM folder or file, NIfTI, NRRD or MetaImage file",
    )
    shown = parser.add_argument_group("what is shown")
    shown.add_argument("--html", metavar="FILE", help="write a page that shows the inputs: .html")
    shown.add_argument(
        "--name",
        dest="names",
        action="append",
        default=[],
        metavar="TEXT",
        help="name of an input on the page, in the order of the inputs; repeat it for several (default: surface 1 ...)",
    )
    shown.add_argument(
        "--mesh-space",
        type=str.lower,
        metavar="lps|ras",
        help="patient frame of mesh files that do not name theirs (default: lps, with a warning)",
    )
    shown.add_argument(
        "--space", type=str.lower, default="lps", metavar="lps|ras", help="frame of picked points (default: lps)"
    )
    add_no_clobber(shown)
    add_keep_ids(shown)
    add_reading(parser)
    add_masking(parser)
    add_cropping(parser)
    surface = parser.add_argument_group("surface of a scan")
    add_levels(surface)
    add_solid(surface)
    add_selection(parser.add_argument_group("components of a scan"))
    add_label_arguments(parser)
    device = parser.add_argument_group("device, for scans")
    add_device(device)
    add_memory(device)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    if options.html is None:
        raise UsageError("the page is all that view makes so far, there is no window: name it with --html page.html")
    from clrecon.jobs.mesh.settings import MeshSettings
    from clrecon.jobs.view.job import write_view
    from clrecon.jobs.view.settings import ViewSettings

    given = {**pick(options, {own.name for own in fields(MeshSettings)}), **options.hu, "labels": label_choice(options)}
    if options.labels is not None:
        given.pop("solid", None)  # it says how each label becomes a mesh
    scan = MeshSettings(**{name: value for name, value in given.items() if value is not None})
    settings = ViewSettings(scan=scan, mesh_space=options.mesh_space, names=options.names)
    report = write_view(
        options.inputs, options.html, settings, no_clobber=options.no_clobber, progress=console.progress
    )
    console.result(report)
    for line in _describe(report, options.html):
        console.say(line)
    for warning in report["warnings"]:
        console.warn(warning)
    return 0


def _describe(report: dict[str, Any], output: str) -> list[str]:
    lines = [f"input    {_describe_input(entry)}" for entry in report["inputs"]]
    lines.append(f"mesh     {report['vertices']:,} vertices, {report['triangles']:,} triangles")
    rows = [
        [part["name"], f"{part['triangles']:,} triangles", "" if part["ml"] is None else f"{part['ml']:,.2f} ml"]
        for part in report["parts"][:_SHOWN_PARTS]
    ]
    if len(report["parts"]) > 1:
        lines += [f"         {printable(row)}" for row in table(rows, right=(1, 2))]
    if len(report["parts"]) > _SHOWN_PARTS:
        lines.append(f"         and {len(report['parts']) - _SHOWN_PARTS:,} more")
    if report["device"]:
        lines.append(f"device   {printable(report['device'])}")
    size = f"{megabytes(report['output']['bytes'])}, vertices moved by at most {report['half_step_mm']:.2g} mm"
    return [*lines, f"wrote    {printable(output)}, {size}", f"time     {report['seconds']['total']:.2f} s"]


def _describe_input(entry: dict[str, Any]) -> str:
    if entry["kind"] == "scan":
        return f"{describe_volume(entry['volume']) or printable(entry['name'])}, surface of {entry['surface']}"
    turned = ", turned to LPS" if entry["space"] != "LPS" else ""
    source = {"file": "named by the file", "argument": "as you say", "assumed": "assumed"}[entry["space_from"]]
    return f"{printable(entry['name'])}, {entry['triangles']:,} triangles, {entry['space']}, {source}{turned}"
