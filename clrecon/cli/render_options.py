"""The options of ``clrecon render`` by subject, their values, and the settings made from them."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from typing import Any

from clrecon.cli.common import pick
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


def _parse_numbers(text: str, count: int, form: str) -> tuple[float, ...]:
    """Read a fixed number of numbers with commas between them."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count:
        raise argparse.ArgumentTypeError(f"{text!r} is not {form}")
    return values


def parse_center(text: str) -> tuple[float, ...]:
    """Read ``X,Y,Z`` in LPS mm."""
    return _parse_numbers(text, 3, "a place X,Y,Z in LPS mm, such as -12,40,310")


def parse_picture_size(text: str) -> tuple[int, int]:
    """Read ``512`` or ``512x384`` as width and height."""
    parts = text.lower().split("x")
    try:
        width, height = (int(part) for part in (parts if len(parts) == 2 else (*parts, *parts)))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no size in pixels: write it as 1024 or 1024x768") from None
    return width, height


def parse_views(text: str) -> tuple[str, ...]:
    """Read ``left``, ``anterior,left,posterior`` or ``AZ,EL``: names or one pair of angles."""
    parts = tuple(part.strip().lower() for part in text.split(","))
    if all(part[:1].isalpha() for part in parts):
        return parts
    try:
        _azimuth, _elevation = (float(part) for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither names of views with commas between them ({', '.join(VIEWS)}; of slices axial,"
            " coronal, sagittal), nor one AZ,EL in degrees, such as 30,15: give --view again for further ones"
        ) from None
    return (",".join(parts),)


def parse_direction(text: str) -> str | tuple[float, ...]:
    """Read a name, or ``X,Y,Z``."""
    return (
        _parse_numbers(text, 3, "a side of the patient, nor a direction X,Y,Z in LPS") if "," in text else text.lower()
    )


def parse_light(text: str) -> str | tuple[float, ...]:
    """Read ``head``, ``none``, a side of the patient, or ``X,Y,Z``."""
    return parse_direction(text)


def parse_window(text: str) -> str | tuple[float, ...]:
    """Read ``LOW,HIGH`` in HU, or the name of a window."""
    if text[:1].isalpha() and "," not in text:
        return text
    return _parse_numbers(text, 2, "a window: the HU that are black and white, LOW,HIGH, such as -450,1050")


def parse_clip_plane(text: str) -> tuple[float, ...]:
    """Read ``PX,PY,PZ,NX,NY,NZ``: a point in LPS mm and a normal."""
    return _parse_numbers(
        text, 6, "a plane: a point in LPS mm and the direction of the side that stays, PX,PY,PZ,NX,NY,NZ"
    )


def parse_slices(text: str) -> int | tuple[int, ...]:
    """Read ``N`` (every N-th slice) or ``K,K,...`` (the slices of these numbers); ``K,`` is a single slice."""
    try:
        numbers = tuple(int(part) for part in text.split(",") if part.strip())
    except ValueError:
        numbers = ()
    if not numbers:
        raise argparse.ArgumentTypeError(f"{text!r} is no number N (every N-th slice) and no list of slices K,K,...")
    return numbers if "," in text else numbers[0]


def parse_label_color(text: str) -> tuple[str, str]:
    """Read ``LABEL=COLOUR``."""
    label, _, color = text.rpartition("=")
    if not label or not color:
        raise argparse.ArgumentTypeError(f"{text!r} is not LABEL=COLOUR, such as L2=red or 20=#ff8000")
    return label, color


def parse_label_opacity(text: str) -> tuple[str, float]:
    """Read ``LABEL=OPACITY``."""
    label, _, number = text.rpartition("=")
    try:
        opacity = float(number)
    except ValueError:
        opacity = math.nan
    if not label or math.isnan(opacity):
        raise argparse.ArgumentTypeError(f"{text!r} is not LABEL=OPACITY, such as L2=0.2")
    return label, opacity


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
        raise argparse.ArgumentTypeError(
            f"{text!r} is not FILE[=COLOUR[,OPACITY]], such as l3.stl=orange,0.4 or l3.stl=,0.4"
        )
    return path, color or None, opacity


_FRAMES, _FPS, _DEGREES, _ANGLE = 100, 25.0, 360.0, 30.0


def _add_repeated(
    group: argparse._ArgumentGroup,
    option: str,
    parse: Callable[[str], Any],
    metavar: str,
    text: str,
    dest: str | None = None,
    first: bool = False,
) -> None:
    """Add an option that can be repeated; its values make a list."""
    dest = dest or option.removeprefix("--").replace("-", "_")
    group.add_argument(
        option,
        dest=dest,
        type=parse,
        metavar=metavar,
        action="append",
        default=[],
        help=f"{text}; may be given again",
        first=first,
    )


def add_looks(parser: argparse.ArgumentParser) -> None:
    """Add the options for the content of a picture and its colours."""
    group = parser.add_argument_group("what is shown")
    group.add_argument(
        "--mode",
        type=str.lower,
        metavar="M",
        help=f"one of: {', '.join(describe_modes())} (default: what the other options ask)",
        first=True,
    )
    group.add_argument(
        "--preset",
        type=str.lower,
        metavar="NAME",
        help="colours, opacities, light and mode by tissue (default: bone)",
        first=True,
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
        first=True,
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
        first=True,
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
        " left); several make a picture each: out_left.png", first=True,
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
        "--size",
        type=parse_picture_size,
        metavar="W[xH]",
        help="pixels of the picture (default: 1024x1024)",
        first=True,
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
        first=True,
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
        "--turntable",
        metavar="OUT",
        help="turn round the patient: .mp4, .gif, .apng, or a folder of PNG files",
        first=True,
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
