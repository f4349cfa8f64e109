"""``clrecon render``: from a CT series to pictures."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli.common import (
    GRID_FILE,
    SCAN_FOLDER,
    add_cropping,
    add_device,
    add_fields,
    add_input,
    add_masking,
    add_no_clobber,
    add_output,
    add_reading,
    add_report,
    describe_times,
    megabytes,
    show_report,
)
from clrecon.cli.console import Console, printable
from clrecon.cli.mesh import describe_volume
from clrecon.cli.render_options import (
    add_camera,
    add_clipping,
    add_curve,
    add_looks,
    add_meshes,
    add_motion,
    render_settings,
)
from clrecon.errors import UsageError
from clrecon.jobs.inputs import CLOUD_INPUTS, MESH_INPUTS, is_cloud_file, is_only_mesh
from clrecon.jobs.render.settings import LabelLook, MeshFile, color_apart, describe_modes, describe_presets
from clrecon.system.text import count_of

_LABELS_LISTED = 24
_PARTS = ("read", "mask", "render", "turntable", "write")
_EXAMPLES = """\
examples:
  clrecon render CT_FOLDER -o bone.png
  clrecon render CT_FOLDER -o spine.png --preset spine --view 30,15 --letters --scale-bar
  clrecon render CT_FOLDER -o xray.png --preset x-ray --view left
  clrecon render CT_FOLDER -o skull.png --iso 300 --light 1,-1,1 --shadows --background white
  clrecon render CT_FOLDER -o slice.png --mode slice --view axial,coronal,sagittal --window -450,1050
  clrecon render CT_FOLDER -o sheet.png --sheet 20 --window soft
  clrecon render CT_FOLDER -o slices.png --sheet --view sagittal --labels map.nii.gz
  clrecon render CT_FOLDER -o spine.png --curve auto
  clrecon render CT_FOLDER --turntable bone.mp4
  clrecon render cloud.ply -o cloud.png --color label --point-radius 0.5
  clrecon render bone.stl -o bone.png --color orange --view left
  clrecon render --mesh l3.stl=orange --mesh l4.3mf -o both.png
  clrecon render CT_FOLDER -o both.png --preset muscle --mesh l3.stl=orange --mesh l4.stl=,0.4"""


def _epilog() -> str:
    modes, presets = describe_modes(), describe_presets()
    width = max(map(len, (*modes, *presets)))
    return "\n".join(
        (
            "modes:",
            *(f"  {name:<{width}}  {text}" for name, text in modes.items()),
            "",
            "presets:",
            *(f"  {name:<{width}}  {text}" for name, text in presets.items()),
            "",
            "The patient's left is at the right of an anterior view. Every file is written as a whole or not at all.",
            "",
            _EXAMPLES,
        )
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = _epilog()
    kinds = f"a cloud of points ({', '.join(CLOUD_INPUTS)}); or a mesh ({', '.join(MESH_INPUTS)}; of .ply and .vtp say"
    more = f"{kinds} --mode mesh); may be left out with --mesh"
    add_input(parser, f"{SCAN_FOLDER}; {GRID_FILE}; {more}", nargs="?")
    add_output(parser, "picture: .png, .jpg or .tif; may be left out with --turntable", required=False)
    add_looks(parser)
    add_camera(parser)
    add_cropping(parser, "of the patient (LPS)")
    add_clipping(parser)
    add_curve(parser)
    add_fields(parser.add_argument_group("labels"), LabelLook)
    add_meshes(parser)
    add_motion(parser)
    add_reading(parser)
    add_masking(parser)
    device = parser.add_argument_group("device")
    add_device(device)
    add_no_clobber(device)
    add_report(device, "camera, settings, certificate, device, times", first=False)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.jobs.render.job import PictureFiles, make_pictures

    if options.input is None:
        _show_meshes_alone(options)
    files = PictureFiles(options.output, options.depth, options.values, options.turntable, options.report)
    if options.mode is None and is_cloud_file(options.input):
        options.mode = "points"
    if options.mode is None and is_only_mesh(options.input):
        options.mode = "mesh"
    report = make_pictures(
        options.input, files, render_settings(options), no_clobber=options.no_clobber, progress=console.progress
    )
    show_report(report, describe_report(report) + _describe_files(report, files), options, console)
    return 0


def _show_meshes_alone(options: argparse.Namespace) -> None:
    """Make the first of the meshes the input; of several without a colour each gets one of its own."""
    if not options.meshes:
        raise UsageError("there is nothing to show: name a scan, a cloud or a mesh as INPUT, or meshes with --mesh")
    if options.mode not in (None, "mesh") or options.preset is not None:
        raise UsageError("without INPUT there are only meshes, which mode mesh shows: name a scan for other modes")
    first, *options.meshes = [
        (mesh.path, mesh.color, mesh.opacity) for mesh in color_apart([MeshFile(*given) for given in options.meshes])
    ]
    options.input, color, opacity = first
    options.mode = "mesh"
    options.color = options.color or color
    options.opacity = opacity if options.opacity is None else options.opacity


def describe_report(report: dict[str, Any]) -> list[str]:
    """Describe a report for people: the input, the pictures, the device, the time."""
    return [
        f"input    {_describe_input(report)}",
        f"picture  {_describe_look(report)}",
        *(f"         {line}" for line in map(_describe_picture, report["pictures"])),
        *(f"         {line}" for line in _describe_legend(report["pictures"])),
        *(f"         {line}" for line in _describe_labels(report["pictures"])),
        *(f"mesh     {line}" for line in map(_describe_mesh, report["meshes"][report["mode"] == "mesh" :])),
        f"device   {printable(report['device'])}",
        f"time     {describe_times(report['seconds'], _PARTS)}",
    ]


def _describe_input(report: dict[str, Any]) -> str:
    cloud = report["cloud"]
    if report["mode"] == "mesh":
        return f"mesh of {report['meshes'][0]['triangles']:,} triangles"
    if cloud is None:
        return describe_volume(report["volume"])
    known = [word for word, name in (("normals", "normals"), ("HU", "hu"), ("labels", "labels")) if cloud[name]]
    return f"{count_of(cloud['points'], 'point')}" + (f" with {', '.join(known)}" if known else "")


def _describe_mesh(mesh: dict[str, Any]) -> str:
    color = "#" + "".join(f"{round(255 * share):02x}" for share in mesh["color"])
    return f"{count_of(mesh['triangles'], 'triangle')}, {color}, opacity {mesh['opacity']:g}, {mesh['file']['space']}"


def _describe_legend(pictures: list[dict[str, Any]]) -> list[str]:
    """Name the colours of the points in a line each; those of the first picture are those of all."""
    points = pictures[0]["points"] if pictures else None
    if points is None or points["color_by"] not in ("label", "removed"):
        return []
    lines = []
    for entry in points["legend"]:
        name = printable(entry["name"]) if entry["name"] else f"{points['color_by']} {entry['label']}"
        lines.append(f"{entry['color']} {name}: {count_of(entry['points'], 'point')}")
    if points["legend_left_out"]:
        lines.append(f"and {points['legend_left_out']:,} more")
    return lines


def _describe_labels(pictures: list[dict[str, Any]]) -> list[str]:
    """Name the labels that are drawn over the slices of any picture, and their colours, in a line each."""
    drawn = {
        (entry["color"], entry["label"]): entry["label_number"] for each in pictures for entry in each["labels"] or ()
    }
    lines = [f"{color} {printable(label)} ({number})" for (color, label), number in drawn.items()]
    more = len(lines) - _LABELS_LISTED
    return lines if more <= 0 else [*lines[:_LABELS_LISTED], f"and {more} more labels, see the report"]


def _describe_look(report: dict[str, Any]) -> str:
    parts = [f"mode {report['mode']}"]
    if report["preset"]:
        parts.append(f"preset {report['preset']}")
    elif report["transfer_function"]:
        parts.append("transfer function as given")
    if report["iso_value_hu"] is not None:
        parts.append(f"{report['iso_value_hu']:g} HU")
    if report["thickness_mm"]:
        parts.append(f"{report['combine']} of {report['thickness_mm']:g} mm")
    if report["turntable"]:
        turn = report["turntable"]
        parts.append(
            f"{count_of(turn['frames'], 'frame')} over {turn['degrees']:g} degrees,"
            f" {turn['seconds_a_frame']:.3f} s each"
        )
    return ", ".join(parts)


def _describe_picture(picture: dict[str, Any]) -> str:
    width, height = picture["size"]
    scale = f"{picture['pixel_mm']:.4g} mm a pixel" if picture["pixel_mm"] else "perspective"
    window = picture["window_hu"]
    shown = f", {window[0]:.4g} to {window[1]:.4g} HU" if window else ""
    if picture["window_mm_water"]:
        low, high = picture["window_mm_water"]
        shown = f", {low:.4g} to {high:.4g} mm of water"
    left_out = picture["left_out"]
    if left_out and left_out["voxels"]:
        where = "the body or the region" if left_out["region"] else "the body"
        shown += f", without the {100.0 * left_out['share']:.3g} % of the voxels outside of {where}"
    if picture["tiles"]:
        many = len(picture["tiles"])
        wide, high = picture["tile_size"]
        shown += f", {count_of(many, 'slice')} of {wide} x {high} pixels"
    return f"{picture['view']}: {width} x {height}, {scale}{shown}"


def _describe_files(report: dict[str, Any], files: Any) -> list[str]:
    from clrecon.jobs.render.job import path_of

    lines = []
    for what, path in (("output", files.picture), ("depth_output", files.depth), ("values_output", files.values)):
        for picture in report["pictures"]:
            if path is not None and what in picture:
                named = path_of(path, picture["name"] or "")
                lines.append(f"wrote    {printable(named)}, {megabytes(picture[what]['bytes'])}")
    if report["turntable"]:
        lines.append(f"wrote    {printable(files.turntable)}, {megabytes(report['turntable']['output']['bytes'])}")
    return lines
