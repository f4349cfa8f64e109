"""``clrecon inside``: the parts of a vertebra as meshes, with their volumes."""

from __future__ import annotations

import argparse
import math
from typing import Any

from clrecon.cli.common import (
    add_device,
    add_keep_ids,
    add_memory,
    add_no_clobber,
    add_reading,
    describe_space,
    megabytes,
    pick,
)
from clrecon.cli.console import Console, printable
from clrecon.cli.mesh import describe_volume
from clrecon.jobs.inside import DEFAULT_VIEW
from clrecon.jobs.outputs import MESH_FILES
from clrecon.system.text import format_volume

_EPILOG = """\
parts, each a mesh of its own:
  solid       all bone: the label, or what is at --hu and above in it, closed and filled, without the canal
  dense       what of it lies in the band --dense: no measure of cortex, which looks thicker than it is
  trabecular  the rest of the solid bone
  canal       the hole of the arch, at the height of the pedicles; left out, with a warning, where no arch is closed

The files are named by their parts: inside_solid.stl, inside_dense.stl; of several vertebrae inside_L3_solid.stl.

examples:
  clrecon inside CT_FOLDER --labels spine.nii.gz --label L3 -o inside.stl --picture inside.png
  clrecon inside CT_FOLDER --labels spine.nii.gz --label L3 --label L4 --hu 300 -o spine.ply --report inside.json
  clrecon inside CT_FOLDER --labels spine.nii.gz --label T12 --dense 350:900 -o t12.glb"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = _EPILOG
    parser.add_argument("input", metavar="INPUT", help="DICOM folder or file; or a NIfTI, NRRD or MetaImage file")
    parser.add_argument("-o", "--output", metavar="OUT", required=True, help=f"mesh files: {MESH_FILES}", first=True)
    parser.add_argument(
        "--labels",
        metavar="FILE|FOLDER",
        required=True,
        help="label map: NIfTI, NRRD (.seg.nrrd too), MetaImage, DICOM SEG, RTSTRUCT, or a folder of masks",
        first=True,
    )
    parser.add_argument(
        "--label",
        dest="only",
        metavar="NAME|N",
        action="append",
        required=True,
        help="label of a vertebra; may be given again",
        first=True,
    )
    pictures = parser.add_argument_group("pictures")
    pictures.add_argument(
        "--picture",
        metavar="FILE",
        help="a picture of each part, opaque, with others faded: .png, .jpg or .tif; inside.png becomes"
        " inside_canal.png and so on",
        first=True,
    )
    pictures.add_argument(
        "--view",
        default=DEFAULT_VIEW,
        metavar="V",
        help=f"anterior, posterior, left, right, superior, inferior, or AZ,EL in degrees (default: {DEFAULT_VIEW})",
    )
    parts = parser.add_argument_group("parts")
    parts.add_argument(
        "--hu",
        dest="iso_value",
        type=float,
        metavar="N",
        help="level of the solid bone, within one voxel of the label (default: the label's own voxels)",
        first=True,
    )
    parts.add_argument(
        "--dense", type=_parse_band, metavar="A[:B]", help="HU of dense bone, from A on or from A to B (default: 450)"
    )
    parts.add_argument(
        "--close", dest="close_mm", type=float, metavar="MM", help="pores that close by balls (default: 1.5)"
    )
    parts.add_argument(
        "--grow",
        dest="grow_mm",
        type=float,
        metavar="MM",
        help="with --hu: dense voxels this near to the label are its own (default: one voxel each way)",
    )
    parts.add_argument(
        "--space", type=str.lower, default="lps", metavar="lps|ras", help="patient frame of the meshes (default: lps)"
    )
    add_reading(parser)
    device = parser.add_argument_group("device")
    add_device(device)
    add_memory(device)
    add_no_clobber(device)
    add_keep_ids(device)
    device.add_argument(
        "--report", metavar="FILE", help="write volumes, thickness, certificate, device, times as JSON", first=True
    )


def _parse_band(text: str) -> tuple[float | None, float | None]:
    """Read ``A``, ``A:`` or ``A:B``, numbers of HU; ``:B`` leaves the lower end open."""
    low, colon, high = text.partition(":")
    try:
        ends = [float(end) if end else None for end in (low, high)]
    except ValueError:
        ends = [None, None]
    if ends == [None, None] or any(end is not None and not math.isfinite(end) for end in ends):
        raise argparse.ArgumentTypeError(f"{text!r} is no band of HU: write A for A and above, or A:B")
    return ends[0], ends[1]


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from dataclasses import fields

    from clrecon.jobs.inside import InsideSettings, make_inside

    settings = InsideSettings(**pick(options, {own.name for own in fields(InsideSettings)}))
    report = make_inside(
        options.input,
        options.output,
        settings,
        picture=options.picture,
        report_path=options.report,
        no_clobber=options.no_clobber,
        progress=console.progress,
    )
    console.result(report)
    for line in describe_inside(report):
        console.say(line)
    files = [mesh for vertebra in report["vertebrae"] for mesh in vertebra["meshes"]]
    size = megabytes(sum(mesh["bytes"] for mesh in files))
    space = describe_space(options.output, report["space"])
    console.say(f"wrote    {_name_files(options.output, report, 'meshes')}, {size}, {space}")
    if options.picture:
        console.say(f"picture  {_name_files(options.picture, report, 'pictures')}")
    if options.report:
        console.say(f"report   {printable(options.report)}")
    for warning in report["warnings"]:
        console.warn(warning)
    return 0


def describe_inside(report: dict[str, Any]) -> list[str]:
    """Describe a report for people."""
    lines = [f"input    {describe_volume(report['volume'])}"]
    for vertebra in report["vertebrae"]:
        lines += _describe_vertebra(vertebra)
    seconds = report["seconds"]
    times = ", ".join(
        f"{part} {seconds[part]:.2f}" for part in ("read", "inside", "render", "write") if part in seconds
    )
    return [*lines, f"device   {printable(report['device'])}", f"time     {seconds['total']:.2f} s ({times})"]


def _name_files(path: str, report: dict[str, Any], kind: str) -> str:
    """Name the files of a kind, ``meshes`` or ``pictures``: all of one vertebra, the first and the last of several."""
    from clrecon.jobs.inside import name_part
    from clrecon.jobs.outputs import name_outputs

    several = len(report["vertebrae"]) > 1
    names = [
        name_part(vertebra["name"], each["part"], several=several)
        for vertebra in report["vertebrae"]
        for each in vertebra[kind]
    ]
    paths = [printable(str(path)) for path in name_outputs(path, names)]
    return f"{paths[0]} to {paths[-1]}, {len(paths)} files" if several else ", ".join(paths)


def _describe_vertebra(vertebra: dict[str, Any]) -> list[str]:
    volumes, (low, high) = vertebra["volumes_ml"], vertebra["dense_hu"]
    level = vertebra["iso_value_hu"]
    of = "label" if level is None else f"{level:g} HU"
    band = (
        f"{low:g} HU and above" if high is None else f"up to {high:g} HU" if low is None else f"{low:g} to {high:g} HU"
    )
    canal, height = volumes["canal"], vertebra["canal_height_mm"]
    told = "no canal: arch not closed" if canal is None else f"canal {format_volume(canal)}, {height:.3g} mm high"
    return [
        f"{printable(vertebra['name'])}",
        f"         solid {format_volume(volumes['solid'])} ({of}), {told}",
        f"         dense {format_volume(volumes['dense'])} ({band}), trabecular"
        f" {format_volume(volumes['trabecular'] or 0.0)}",
        f"         {_describe_thickness(vertebra['dense_thickness'])}",
    ]


def _describe_thickness(found: dict[str, Any]) -> str:
    limit = f"{found['limit_mm']:.3g} mm (two voxels)"
    if found["median_mm"] is None:
        return f"thickness of dense bone: not resolved, nothing is thicker than {limit}"
    share = 100.0 * found["resolved_share"]
    return (
        f"thickness of dense bone: {share:.0f} % of it thicker than {limit}, median there {found['median_mm']:.2g} mm;"
        " the rest is not resolved"
    )
