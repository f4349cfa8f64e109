"""The options of ``clrecon render`` by subject, and the settings made from them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from clrecon.cli.common import pick
from clrecon.cli.render_values import (
    parse_center,
    parse_clip_plane,
    parse_direction,
    parse_label_color,
    parse_label_opacity,
    parse_light,
    parse_mesh,
    parse_picture_size,
    parse_slices,
    parse_views,
    parse_window,
)
from clrecon.errors import UsageError
from clrecon.jobs.inputs import MESH_INPUTS
from clrecon.jobs.render.settings import (
    POINT_COLORS,
    SHEET_SLICES,
    VIEWS,
    WINDOWS,
    LabelLook,
    MeshFile,
    RenderSettings,
    Turntable,
    describe_modes,
)

_FRAMES, _FPS, _DEGREES, _ANGLE = 100, 25.0, 360.0, 30.0


def _add_repeated(
    group: argparse._ArgumentGroup,
    option: str,
    parse: Callable[[str], Any],
    metavar: str,
    text: str,
    dest: str | None = None,
) -> None:
    """Add an option that can be repeated; its values make a list."""
    dest = dest or option.removeprefix("--").replace("-", "_")
    group.add_argument(
        option, dest=dest, type=parse, metavar=metavar, action="append", default=[], help=f"{text}; may be given again"
    )


def add_looks(parser: argparse.ArgumentParser) -> None:
    """Add the options for the content of a picture and its colours."""
    group = parser.add_argument_group("what is shown")
    group.add_argument(
        "--mode",
        type=str.lower,
        metavar="M",
        help=f"one of: {', '.join(describe_modes())} (default: what the other options ask)",
    )
    group.add_argument(
        "--preset", type=str.lower, metavar="NAME", help="colours, opacities, light and mode by tissue (default: bone)"
    )
    group.add_argument(
        "--transfer-function",
        metavar="FILE[:NAME]",
        help="colours and opacities by HU from a file of clrecon, 3D Slicer or ParaView, see docs/rendering.md",
    )
    group.add_argument(
        "--iso",
        "--hu",
        dest="iso_value",
        type=float,
        metavar="HU",
        help="iso value of mode surface, inside is HU and above (default: 200)",
    )
    group.add_argument(
        "--color",
        metavar="C",
        help="colour of a surface or of points, such as orange or #ff8000 (default: bone); of points also"
        f" {', '.join(POINT_COLORS)} (default: label, else hu, where points have them)",
    )
    group.add_argument(
        "--point-radius",
        dest="radius_mm",
        type=float,
        metavar="MM",
        help="of points, which are discs (default: their mean spacing)",
    )
    group.add_argument("--opacity", type=float, metavar="SHARE", help="of the mesh in mode mesh (default: 1)")
    group.add_argument("--flat", action="store_true", help="light each triangle of a mesh by its own normal")
    group.add_argument(
        "--window",
        type=parse_window,
        metavar="LOW,HIGH|NAME",
        help=f"HU that are black and white, of modes that show HU, or one of {', '.join(WINDOWS)}; mm of water in mode"
        " drr",
    )
    group.add_argument(
        "--keep-air", action="store_true", help="of mode minip: count what lies outside of the body and of masks too"
    )
    group.add_argument(
        "--ray-step", type=float, metavar="MM", help="mm between samples (default: half the smallest spacing)"
    )
    group.add_argument(
        "--light",
        type=parse_light,
        metavar="L",
        help="head: a light at the camera; a side of the patient, or X,Y,Z in LPS: a light that stays where it is;"
        " none: colours as they are (default: what the preset says)",
    )
    group.add_argument(
        "--depth-cue",
        type=float,
        metavar="SHARE",
        help="share of its brightness that a surface loses from its nearest to its farthest point",
    )
    group.add_argument("--shadows", action="store_true", help="shadows on a surface; wants a light beside the camera")
    group.add_argument(
        "--jitter", action="store_true", help="begin each ray at a place of its own: grain in place of rings"
    )


def add_camera(parser: argparse.ArgumentParser) -> None:
    """Add the options for camera, size, background and annotations."""
    group = parser.add_argument_group("camera and picture")
    _add_repeated(
        group, "--view", parse_views, "V[,V...]|AZ,EL",
        f"where the camera stands: {', '.join(VIEWS)}; or degrees from anterior to the patient's left and to the head;"
        " of slices also axial, coronal, sagittal (default: anterior; of mode slice axial, of slices 30,30, of cpr"
        " left); several make a picture each: out_left.png",
    )  # fmt: skip
    group.add_argument(
        "--up", type=parse_direction, metavar="SIDE|X,Y,Z", help="what is at the top (default: superior, else anterior)"
    )
    group.add_argument("--zoom", type=float, default=1.0, metavar="F", help="2 shows everything twice as large")
    group.add_argument(
        "--center",
        type=parse_center,
        metavar="X,Y,Z",
        help="LPS mm in the middle of the picture, of a slice too (default: the middle of what is shown)",
    )
    group.add_argument(
        "--size", type=parse_picture_size, metavar="W[xH]", help="pixels of the picture (default: 1024x1024)"
    )
    group.add_argument(
        "--perspective",
        dest="view_angle",
        type=float,
        nargs="?",
        const=_ANGLE,
        metavar="DEGREES",
        help=f"perspective of so many degrees from bottom to top ({_ANGLE:g} without a number; default: parallel)",
    )
    group.add_argument(
        "--background", default="black", metavar="C", help="colour, such as white or #102030, or transparent"
    )
    group.add_argument("--letters", action="store_true", help="draw the sides of the patient: L, R, A, P, S, I")
    group.add_argument("--scale-bar", action="store_true", help="draw a bar of a round length in mm")
    group.add_argument("--caption", metavar="TEXT", help="draw a line of text at the top left")
    group.add_argument("--depth", metavar="FILE", help="write mm along the ray to the first hit: .npy or .tif, float32")
    group.add_argument("--values", metavar="FILE", help="write the HU of modes that show HU: .npy or .tif, float32")


def add_clipping(parser: argparse.ArgumentParser) -> None:
    """Add the planes that limit the part of space that is shown."""
    group = parser.add_argument_group("clipping, in mm of the patient (LPS)")
    _add_repeated(
        group, "--clip", parse_clip_plane, "PX,PY,PZ,NX,NY,NZ",
        "keep the side of a plane through a point that a normal points to", dest="clip_planes",
    )  # fmt: skip


def add_curve(parser: argparse.ArgumentParser) -> None:
    """Add the options of slices (in space or single) and of curved reformations."""
    group = parser.add_argument_group("slices and curved reformations")
    group.add_argument("--thickness", type=float, metavar="MM", help="of a thick slice (default: 0, a plane)")
    group.add_argument(
        "--combine", type=str.lower, metavar="HOW", help="mean, max or min of a thick slice (default: mean)"
    )
    group.add_argument(
        "--offset", dest="offset_mm", type=float, metavar="MM", help="move the slice away from the camera by so much"
    )
    group.add_argument(
        "--slices",
        type=parse_slices,
        metavar="N|K,K,...",
        help="of mode slices and of a sheet: every N-th, or with a comma those numbers, from 0 (default: about twelve)",
    )
    group.add_argument(
        "--sheet",
        nargs="?",
        const=SHEET_SLICES,
        metavar="N|MMmm",
        help=f"contact sheet of mode slice: N slices side by side (default: {SHEET_SLICES}), or one every so many mm,"
        " such as 5mm; --view says in which plane, --slices which planes of voxels",
    )
    group.add_argument(
        "--slice-opacity", type=float, metavar="SHARE", help="of each slice of mode slices (default: 0.5)"
    )
    group.add_argument(
        "--curve",
        metavar="FILE|auto",
        help="centre line: a text, CSV or JSON file of points in LPS mm, or markups of 3D Slicer; auto: the spinal"
        " canal, found in the scan",
    )
    group.add_argument(
        "--cpr", type=str.lower, metavar="KIND", help="straightened or stretched (default: straightened)"
    )


def add_labels(parser: argparse.ArgumentParser) -> None:
    """Add the options for labels with a look of their own."""
    group = parser.add_argument_group("labels")
    group.add_argument(
        "--labels",
        metavar="FILE|FOLDER",
        help="label map: NIfTI, NRRD (.seg.nrrd too), MetaImage, DICOM SEG, RTSTRUCT, or a folder of masks",
    )
    _add_repeated(group, "--label-color", parse_label_color, "LABEL=COLOUR", "colour of a label, by name or number")
    _add_repeated(
        group,
        "--label-opacity",
        parse_label_opacity,
        "LABEL=SHARE",
        "factor on the opacity of a label, 0 to 1, label 0 is all without a label; over slices the share of its colour"
        " (default: 0.3)",
    )


def add_meshes(parser: argparse.ArgumentParser) -> None:
    """Add the options for meshes that are shown with the input."""
    group = parser.add_argument_group("meshes with the input")
    _add_repeated(
        group, "--mesh", parse_mesh, "FILE[=COLOUR[,OPACITY]]",
        f"show a mesh too ({', '.join(MESH_INPUTS)}), in modes dvr, surface, slices, points and mesh", dest="meshes",
    )  # fmt: skip
    group.add_argument(
        "--mesh-space",
        metavar="lps|ras",
        help="patient frame of meshes whose files do not name theirs (default: lps, with a warning)",
    )


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Add the options of the turntable."""
    group = parser.add_argument_group("motion")
    group.add_argument(
        "--turntable", metavar="OUT", help="turn round the patient: .mp4, .gif, .apng, or a folder of PNG files"
    )
    group.add_argument("--frames", type=int, metavar="N", help=f"frames of the turn (default: {_FRAMES})")
    group.add_argument("--fps", type=float, metavar="N", help=f"frames a second (default: {_FPS:g})")
    group.add_argument(
        "--degrees", type=float, metavar="D", help=f"how far it turns, to the patient's left (default: {_DEGREES:g})"
    )


def render_settings(options: argparse.Namespace) -> RenderSettings:
    """Make settings from the options of the command."""
    named = options.color in POINT_COLORS
    given = pick(options, RenderSettings.keywords()) | {
        "color": None if named else options.color,
        "color_by": options.color if named else None,
        "views": tuple(view for views in options.view for view in views),
        "thickness": options.thickness or None,  # 0 is the same as no thickness
        "offset_mm": options.offset_mm or None,
        "labels": label_look(options),
        "meshes": tuple(MeshFile(*given) for given in options.meshes),
        "turntable": turntable(options),
    }
    return RenderSettings.of(**given)


def label_look(options: argparse.Namespace) -> LabelLook | None:
    """Make the settings of labels from the options, None without a label map."""
    if options.labels is not None:
        return LabelLook(options.labels, dict(options.label_color), dict(options.label_opacity))
    for option, given in (("--label-color", options.label_color), ("--label-opacity", options.label_opacity)):
        if given:
            raise UsageError(f"{option} says how a label looks: give the label map with --labels FILE")
    return None


def turntable(options: argparse.Namespace) -> Turntable | None:
    """Make the settings of the turntable from the options, None without a turntable."""
    given = {name: getattr(options, name) for name in ("frames", "fps", "degrees")}
    given = {name: value for name, value in given.items() if value is not None}
    if options.turntable is not None:
        return Turntable(**given)
    if given:
        raise UsageError(f"--{next(iter(given))} says how a picture moves: name it with --turntable OUT")
    return None
