"""``clrecon inside``: the parts of a vertebra as meshes, with their volumes."""

from __future__ import annotations

import argparse
from itertools import chain
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.jobs.outputs import MESH_FILES, MeshFiles, name_outputs
from clrecon.jobs.settings import InsideSettings
from clrecon.system.records import describe_volume
from clrecon.system.text import format_bytes, format_volume

_EPILOG = """\
parts, each a separate mesh:
  solid       all bone: the label, or its voxels at --hu and above, or within the surface fitted to the cortex
              (--surface cortex); closed and filled, without the canal
  dense       its voxels in the band --dense; not a measure of the cortex, which looks thicker than it is
  trabecular  the rest of the solid bone
  canal       the hole of the arch, at the height of the pedicles; left out, with a warning, if no arch is closed

The files are named by their parts: inside_solid.stl, inside_dense.stl; of several vertebrae inside_L3_solid.stl.

examples:
  clrecon inside CT_FOLDER --labels spine.nii.gz --label L3 -o inside.stl --picture inside.png
  clrecon inside CT_FOLDER --labels spine.nii.gz --label L3 --label L4 --hu 300 -o spine.ply --report inside.json
  clrecon inside CT_FOLDER --labels spine.nii.gz --label L3 --surface cortex -o inside.stl
  clrecon inside CT_FOLDER --labels spine.nii.gz --label T12 --dense 350:900 -o t12.glb"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    common.add_input(parser)
    common.add_output(parser, f"mesh files: {MESH_FILES}")
    common.add_fields(parser, InsideSettings)
    pictures = parser.add_argument_group("pictures")
    common.add_picture(
        pictures,
        "a picture of each part, opaque, with others faded: .png, .jpg or .tif; inside.png becomes"
        " inside_canal.png and so on",
    )
    common.add_fields(pictures, InsideSettings, "pictures")
    common.add_fields(parser.add_argument_group("parts"), InsideSettings, "parts")
    common.add_reading(parser)
    device = parser.add_argument_group("device")
    common.add_device(device)
    common.add_no_clobber(device)
    common.add_report(device, "volumes, thickness, certificate, device, times")


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.inside import make_inside

    report = make_inside(
        options.input,
        MeshFiles(options.output, options.picture, options.report),
        common.make_settings(InsideSettings, options),
        **common.run_options(options, console),
    )
    files = list(chain(*(vertebra["meshes"] for vertebra in report["vertebrae"])))
    size = format_bytes(sum(mesh["bytes"] for mesh in files))
    space = common.describe_space(options.output, report["space"])
    written = [f"wrote    {_name_files(options.output, report, 'meshes')}, {size}, {space}"]
    if options.picture:
        written.append(f"picture  {_name_files(options.picture, report, 'pictures')}")
    common.show_report(report, describe_inside(report) + written, options, console)
    return 0


def describe_inside(report: dict[str, Any]) -> list[str]:
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
    if vertebra["cortex"] is not None:
        of = f"fitted to the bone from {of}, {common.describe_fit(vertebra['cortex'])}"
    if low is None:
        band = f"up to {high:g} HU"
    else:
        band = f"{low:g} HU and above" if high is None else f"{low:g} to {high:g} HU"
    canal, height = volumes["canal"], vertebra["canal_height_mm"]
    of_canal = "no canal: arch not closed" if canal is None else f"canal {format_volume(canal)}, {height:.3g} mm high"
    return [
        f"{printable(vertebra['name'])}",
        f"         solid {format_volume(volumes['solid'])} ({of}), {of_canal}",
        f"         dense {format_volume(volumes['dense'])} ({band}), trabecular"
        f" {format_volume(volumes['trabecular'] or 0.0)}",
        f"         {_describe_thickness(vertebra['dense_thickness'])}",
    ]


def _describe_thickness(thickness: dict[str, Any]) -> str:
    limit = f"{thickness['limit_mm']:.3g} mm (two voxels)"
    if thickness["median_mm"] is None:
        return f"thickness of dense bone: not resolved, nothing is thicker than {limit}"
    share = 100.0 * thickness["resolved_share"]
    return (
        f"thickness of dense bone: {share:.0f} % of it thicker than {limit}, median there"
        f" {thickness['median_mm']:.2g} mm; the rest is not resolved"
    )
