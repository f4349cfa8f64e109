"""``clrecon render``: from a CT series to pictures."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from functools import partial
from itertools import chain
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.cli.view import draw_view
from clrecon.errors import UsageError
from clrecon.jobs.inputs import CLOUD_INPUTS, MESH_INPUTS, holds_triangles, is_cloud_file
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.options import InputSettings, preset_option
from clrecon.jobs.render.settings import (
    ALL_PRESETS,
    COLORS,
    CURVED_KINDS,
    MESH_COLORS,
    POINT_COLORS,
    SHEET_SLICES,
    WINDOWS,
    LabelLook,
    MeshFile,
    RenderSettings,
    Turntable,
    color_apart,
    describe_modes,
    describe_presets,
    parse_direction,
)
from clrecon.jobs.view import ViewSettings
from clrecon.system.light_dataclass import dataclass
from clrecon.system.options import make_part, numbers_reader, option, options_of
from clrecon.system.records import describe_volume
from clrecon.system.text import count_of, format_bytes, to_hexadecimal, unknown_name

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
  clrecon render CT_FOLDER --state shown.view.json -o shown.png
  clrecon render cloud.ply -o cloud.png --color label --point-radius 0.5
  clrecon render bone.stl -o bone.png --color orange --view left
  clrecon render --mesh l3.stl=orange --mesh l4.3mf -o both.png
  clrecon render CT_FOLDER -o both.png --preset muscle --mesh l3.stl=orange --mesh l4.stl=,0.4"""


_parse_ends = numbers_reader(2, "is not a window: the HU that are black and white, LOW,HIGH, such as -450,1050")


def _parse_window(text: str) -> str | tuple[float, ...]:
    """Read ``LOW,HIGH`` in HU, or the name of a window."""
    return text if text[:1].isalpha() and "," not in text else _parse_ends(text)


def _parse_slices(text: str) -> int | tuple[int, ...]:
    """Read ``N`` (every N-th slice) or ``K,K,...`` (the slices of these numbers); ``K,`` is a single slice."""
    try:
        numbers = tuple(int(part) for part in text.split(",") if part.strip())
    except ValueError:
        numbers = ()
    if not numbers:
        raise ValueError(f"{text!r} is no number N (every N-th slice) and no list of slices K,K,...")
    return numbers if "," in text else numbers[0]


def parse_mesh(text: str) -> tuple[str, str | None, float]:
    """Read ``FILE``, ``FILE=COLOUR`` or ``FILE=COLOUR,OPACITY``; a colour left empty is the default."""
    if "=" not in text or os.path.exists(text):
        return text, None, 1.0
    path, _, look = text.rpartition("=")
    color, comma, share = look.partition(",")
    try:
        opacity = float(share) if comma else 1.0
    except ValueError:
        opacity = math.nan
    if not path or not (color or comma) or math.isnan(opacity):
        raise ValueError(f"{text!r} is not FILE[=COLOUR[,OPACITY]], such as l3.stl=orange,0.4 or l3.stl=,0.4")
    return path, color or None, opacity


_slices_option = partial(option, group="slices")


@dataclass(frozen=True, kw_only=True)
class Looks:
    """Keywords of `RenderSettings.of` that make the style, as options."""

    mode: str | None = option(
        "--mode M",
        f"one of: {', '.join(describe_modes())} (default: as the other options require)",
        parse=str.lower,
        first=True,
        words=describe_modes(),
    )
    preset: str | None = preset_option(
        "colours, opacities, light and mode by tissue (default: bone); all: a contact sheet of them",
        first=True,
        words=(*describe_presets(), ALL_PRESETS),
    )
    transfer_function: str | None = option(
        "--transfer-function FILE[:NAME]",
        "colours and opacities by HU from a file of clrecon, 3D Slicer or ParaView, see docs/rendering.md",
    )
    iso_value: float | None = option(
        "--iso --hu HU", "iso value of mode surface, inside is HU and above (default: 200)", first=True
    )
    color: str | None = option(
        "--color C",
        "colour of a surface or of points, such as orange or #ff8000 (default: bone); of points also"
        f" {', '.join(POINT_COLORS)} (default: label, otherwise hu, if points have them); of a mesh with numbers at its"
        f" vertices {', '.join(MESH_COLORS)}, with a scale in mm",
        words=(*COLORS, *MESH_COLORS),
    )
    radius_mm: float | None = option("--point-radius MM", "radius of points (default: their mean spacing)")
    opacity: float | None = option("--opacity SHARE", "opacity of the mesh in mode mesh (default: 1)")
    flat: bool = option("--flat", "light each triangle of a mesh by its own normal")
    window: str | Sequence[float] | None = option(
        "--window LOW,HIGH|NAME",
        f"HU shown as black and white, in modes that show HU, or one of {', '.join(WINDOWS)}; mm of water in mode drr",
        parse=_parse_window,
        first=True,
    )
    keep_air: bool = option("--keep-air", "in mode minip: include the air outside the body and outside masks")
    ray_step: float | None = option("--ray-step MM", "step along rays (default: half the smallest spacing)")
    light: str | Sequence[float] | None = option(
        "--light L",
        "head: a headlight; a side of the patient, or X,Y,Z in LPS: a light from this fixed direction; none: no shading"
        " (default: that of the preset)",
        parse=parse_direction,
    )
    depth_cue: float | None = option(
        "--depth-cue SHARE", "share of its brightness that a surface loses from its nearest to its farthest point"
    )
    shadows: bool = option("--shadows", "draw shadows on a surface; needs a light away from the camera")
    ambient_occlusion: float | None = option(
        "--ambient-occlusion SHARE",
        "darken hollows of volume rendering and surfaces by up to this share of the light (1 without a number;"
        " default: 0)",
        nargs="?",
        const=1.0,
    )
    jitter: bool = option("--jitter", "start each ray at an offset of its own: grain instead of rings")
    smooth_light: float | None = option(
        "--smooth-light MM",
        "smooth the gradients that light a volume, without its colours and opacities (default: about a voxel, more for"
        " noise; 0: none)",
    )
    clip_planes: Sequence[Sequence[float]] = option(
        "--clip PX,PY,PZ,NX,NY,NZ",
        "keep the side of a plane to which its normal points; may be given again",
        group="clipping",
        default=(),
        parse=numbers_reader(
            6, "is not a plane: a point in LPS mm and the direction of the side that stays, PX,PY,PZ,NX,NY,NZ"
        ),
        action="append",
    )
    thickness: float | None = _slices_option("--thickness MM", "thickness of a slice (default: 0, a plane)")
    combine: str | None = _slices_option(
        "--combine HOW",
        "show the mean, max or min of a thick slice (default: mean)",
        parse=str.lower,
        words=("mean", "max", "min"),
    )
    offset_mm: float | None = _slices_option("--offset MM", "move the slice away from the camera by this distance")
    slices: int | Sequence[int] | None = _slices_option(
        "--slices N|K,K,...",
        "in mode slices and on a sheet: every N-th slice, or slices by number from 0 (default: about twelve)",
        parse=_parse_slices,
    )
    sheet: int | str | None = _slices_option(
        "--sheet N|MMmm",
        f"draw a contact sheet of N slices (default: {SHEET_SLICES}), or of one slice every so many mm, such as 5mm;"
        " --view chooses the plane, --slices the planes of voxels",
        nargs="?",
        const=SHEET_SLICES,
    )
    slice_opacity: float | None = _slices_option("--slice-opacity SHARE", "opacity in mode slices (default: 0.5)")
    curve: str | None = _slices_option(
        "--curve FILE|auto",
        "centre line: a text, CSV or JSON file of points in LPS mm, or markups of 3D Slicer; auto: the spinal canal,"
        " found in the scan",
    )
    cpr: str | None = _slices_option(
        "--cpr KIND", "kind of curved slice: straightened (default) or stretched", parse=str.lower, words=CURVED_KINDS
    )


def add_meshes(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("meshes with the input")
    group.add_argument(
        "--mesh",
        dest="meshes",
        type=parse_mesh,
        metavar="FILE[=COLOUR[,OPACITY]]",
        action="append",
        default=[],
        help=f"also show a mesh ({', '.join(MESH_INPUTS)}), in modes dvr, surface, slices, points and mesh; may be"
        " given again",
    )
    common.add_fields(group, RenderSettings, "meshes")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    modes, presets = describe_modes(), describe_presets()
    width = max(map(len, (*modes, *presets)))
    parser.epilog = "\n".join(
        (
            "modes:",
            *(f"  {name:<{width}}  {text}" for name, text in modes.items()),
            "",
            "presets:",
            *(f"  {name:<{width}}  {text}" for name, text in presets.items()),
            "",
            "The patient's left is at the right of an anterior view. Every file is written completely or not at all.",
            "",
            _EXAMPLES,
        )
    )
    others = f"a cloud of points ({', '.join(CLOUD_INPUTS)}); or a mesh ({', '.join(MESH_INPUTS)})"
    text = f"{common.SCAN_FOLDER}; {common.GRID_FILE}; {others}; may be left out with --mesh"
    common.add_input(parser, text, nargs="?")
    common.add_output(
        parser, "picture: .png, .jpg, .tif, .svg (letters as text); may be left out with --turntable", required=False
    )
    shown = parser.add_argument_group("what is shown")
    common.add_fields(shown, Looks)
    common.add_fields(shown, ViewSettings, "state")
    camera = parser.add_argument_group("camera and picture")
    common.add_fields(camera, RenderSettings, "camera")
    kinds = ".npy or .tif, float32"
    camera.add_argument("--depth", metavar="FILE", help=f"write mm along the ray to the first hit: {kinds}")
    camera.add_argument("--values", metavar="FILE", help=f"write the HU of modes that show HU: {kinds}")
    common.add_cropping(parser, "of the patient (LPS)")
    common.add_fields(parser.add_argument_group("clipping, in mm of the patient (LPS)"), Looks, "clipping")
    common.add_fields(parser.add_argument_group("slices and curved reformations"), Looks, "slices")
    common.add_fields(parser.add_argument_group("labels"), LabelLook)
    add_meshes(parser)
    group = parser.add_argument_group("motion")
    group.add_argument(
        "--turntable",
        metavar="OUT",
        help="write an animation that turns around the patient: .mp4, .webm, .gif, .apng, or a folder of PNG files",
        first=True,
    )
    common.add_fields(group, Turntable)
    common.add_reading(parser)
    common.add_masking(parser)
    device = parser.add_argument_group("device")
    common.add_device(device)
    common.add_no_clobber(device)
    common.add_report(device, "camera, settings, certificate, device, times", first=False)


def render_settings(options: argparse.Namespace) -> RenderSettings:
    values = (*POINT_COLORS, *MESH_COLORS)
    named = options.color in values
    word = str(options.color or "").lower().replace("grey", "gray")
    if word.isalpha() and not named and word not in COLORS:
        raise UsageError(f"{unknown_name('colour', options.color, (*COLORS, *values))}, or #rrggbb")
    look = "says how a label looks: give the label map with --labels FILE"
    turn = "says how a picture moves: name it with --turntable OUT"
    given = {name: getattr(options, name, None) for name in RenderSettings.keywords()} | {
        "color": None if named else options.color,
        "color_by": options.color if named else None,
        "views": tuple(chain(*options.views or ())),
        "thickness": options.thickness or None,  # 0 is the same as no thickness
        "offset_mm": options.offset_mm or None,
        "labels": make_part(LabelLook, vars(options), options.path, look),
        "meshes": tuple(MeshFile(*given) for given in options.meshes),
        "turntable": make_part(Turntable, vars(options), options.turntable, turn),
    }
    return RenderSettings.of(**{name: value for name, value in given.items() if value is not None})


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.render.job import PictureFiles, make_pictures, path_of

    if options.state is not None:
        return _draw_saved(options, console)
    if options.input is None:
        _show_meshes_alone(options)
    files = PictureFiles(options.output, options.depth, options.values, options.turntable, options.report)
    if options.mode is None and is_cloud_file(options.input):
        asks_points = options.color in POINT_COLORS or options.radius_mm is not None
        options.mode = "mesh" if holds_triangles(options.input) and not asks_points else "points"
    if options.mode is None and (options.color in MESH_COLORS or holds_triangles(options.input)):
        options.mode = "mesh"
    report = make_pictures(options.input, files, render_settings(options), **common.run_options(options, console))
    lines = []
    for entry, path in (("output", files.picture), ("depth_output", files.depth), ("values_output", files.values)):
        for picture in report["pictures"]:
            if path is not None and entry in picture:
                named = path_of(path, picture["name"] or "")
                lines.append(f"wrote    {printable(named)}, {format_bytes(picture[entry]['bytes'])}")
    if report["turntable"]:
        size = format_bytes(report["turntable"]["output"]["bytes"])
        lines.append(f"wrote    {printable(files.turntable)}, {size}")
    common.show_report(report, describe_report(report) + lines, options, console)
    return 0


def _draw_saved(options: argparse.Namespace, console: Console) -> int:
    """Draw a saved view of the input and the meshes with it; the saved view says all that is shown."""
    looks = chain(*(options_of(Looks, group) for group in ("", "clipping", "slices")), options_of(LabelLook))
    options_said = [*looks, *options_of(RenderSettings, "camera"), *options_of(Turntable)]
    flags = {own.name: own.flags[0] for own in options_said if own.name not in ("size", "path")}
    flags |= {name: f"--{name}" for name in ("depth", "values", "turntable", "report")}
    refused = next((flag for name, flag in flags.items() if getattr(options, name) not in (None, False)), None)
    if refused is None and any(color is not None or opacity < 1.0 for _, color, opacity in options.meshes):
        refused = "a colour or opacity of --mesh"
    if refused is not None:
        raise UsageError(
            f"{refused} does not go with --state: the saved view says what is shown, and one picture is drawn"
        )
    if options.output is None:
        raise UsageError("--state draws a picture: name its file with -o")
    inputs = [*filter(None, (options.input,)), *(path for path, _, _ in options.meshes)]
    if not inputs:
        raise UsageError("there is nothing to show: name the inputs of the saved view, meshes with --mesh")
    labels = None if options.path is None else LabelChoice(options.path)
    settings = ViewSettings(
        scan=common.make_settings(
            MeshSettings, argparse.Namespace(**common.pick(options, InputSettings)), labels=labels
        ),
        mesh_space=options.mesh_space,
        state=options.state,
    )
    return draw_view(inputs, settings, options.output, console, size=options.size, no_clobber=options.no_clobber)


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
    return [
        f"input    {_describe_input(report)}",
        f"picture  {_describe_look(report)}",
        *(f"         {line}" for line in map(_describe_picture, report["pictures"])),
        *(f"         {line}" for line in _describe_legend(report["pictures"])),
        *(f"         {line}" for line in _describe_labels(report["pictures"])),
        *(f"mesh     {line}" for line in map(_describe_mesh, report["meshes"][report["mode"] == "mesh" :])),
        f"device   {printable(report['device'])}",
        f"time     {common.describe_times(report['seconds'], _PARTS)}",
    ]


def _describe_input(report: dict[str, Any]) -> str:
    cloud = report["cloud"]
    if report["mode"] == "mesh":
        return f"mesh of {report['meshes'][0]['triangles']:,} triangles"
    if cloud is None:
        return describe_volume(report["volume"])
    known = common.describe_known(normals=cloud["normals"], hu=cloud["hu"], labels=cloud["labels"])
    return f"{count_of(cloud['points'], 'point')}{known}"


def _describe_mesh(mesh: dict[str, Any]) -> str:
    color = to_hexadecimal(mesh["color"])
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
    entries = chain(*(picture["labels"] or () for picture in pictures))
    drawn = {(entry["color"], entry["label"]): entry["label_number"] for entry in entries}
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
        region = "the body or the region" if left_out["region"] else "the body"
        shown += f", without the {100.0 * left_out['share']:.3g} % of the voxels outside of {region}"
    if picture["tiles"]:
        many = len(picture["tiles"])
        wide, high = picture["tile_size"]
        noun = "preset" if "preset" in picture["tiles"][0] else "slice"
        shown += f", {count_of(many, noun)} of {wide} x {high} pixels"
    return f"{picture['view']}: {width} x {height}, {scale}{shown}"
