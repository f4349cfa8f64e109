"""The options of ``clrecon render`` by subject, their values, and the settings made from them."""

from __future__ import annotations

import argparse
import math
import os

from clrecon.cli.common import add_fields, make_part
from clrecon.jobs.inputs import MESH_INPUTS
from clrecon.jobs.render.settings import (
    COLORS,
    CURVED_KINDS,
    POINT_COLORS,
    SHEET_SLICES,
    WINDOWS,
    LabelLook,
    MeshFile,
    RenderSettings,
    Turntable,
    describe_modes,
    describe_presets,
    parse_direction,
    parse_numbers,
)


def parse_window(text: str) -> str | tuple[float, ...]:
    """Read ``LOW,HIGH`` in HU, or the name of a window."""
    if text[:1].isalpha() and "," not in text:
        return text
    return parse_numbers(text, 2, "a window: the HU that are black and white, LOW,HIGH, such as -450,1050")


def parse_clip_plane(text: str) -> tuple[float, ...]:
    """Read ``PX,PY,PZ,NX,NY,NZ``: a point in LPS mm and a normal."""
    return parse_numbers(
        text, 6, "a plane: a point in LPS mm and the direction of the side that stays, PX,PY,PZ,NX,NY,NZ"
    )


def parse_slices(text: str) -> int | tuple[int, ...]:
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


def add_looks(parser: argparse.ArgumentParser) -> None:
    """Add the options for the content of a picture and its colours."""
    group = parser.add_argument_group("what is shown")
    group.add_argument(
        "--mode",
        type=str.lower,
        metavar="M",
        words=describe_modes(),
        help=f"one of: {', '.join(describe_modes())} (default: what the other options ask)",
        first=True,
    )
    group.add_argument(
        "--preset",
        type=str.lower,
        metavar="NAME",
        words=describe_presets(),
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
        words=COLORS,
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
        type=parse_direction,
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
    add_fields(group, RenderSettings, "camera")
    group.add_argument("--depth", metavar="FILE", help="write mm along the ray to the first hit: .npy or .tif, float32")
    group.add_argument("--values", metavar="FILE", help="write the HU of modes that show HU: .npy or .tif, float32")


def add_clipping(parser: argparse.ArgumentParser) -> None:
    """Add the planes that limit the part of space that is shown."""
    group = parser.add_argument_group("clipping, in mm of the patient (LPS)")
    group.add_argument(
        "--clip",
        dest="clip_planes",
        type=parse_clip_plane,
        metavar="PX,PY,PZ,NX,NY,NZ",
        action="append",
        default=[],
        help="keep the side of a plane through a point that a normal points to; may be given again",
    )


def add_curve(parser: argparse.ArgumentParser) -> None:
    """Add the options of slices (in space or single) and of curved reformations."""
    group = parser.add_argument_group("slices and curved reformations")
    group.add_argument("--thickness", type=float, metavar="MM", help="of a thick slice (default: 0, a plane)")
    group.add_argument(
        "--combine",
        type=str.lower,
        metavar="HOW",
        words=("mean", "max", "min"),
        help="mean, max or min of a thick slice (default: mean)",
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
        "--cpr",
        type=str.lower,
        metavar="KIND",
        words=CURVED_KINDS,
        help="straightened or stretched (default: straightened)",
    )


def add_meshes(parser: argparse.ArgumentParser) -> None:
    """Add the options for meshes that are shown with the input."""
    group = parser.add_argument_group("meshes with the input")
    group.add_argument(
        "--mesh",
        dest="meshes",
        type=parse_mesh,
        metavar="FILE[=COLOUR[,OPACITY]]",
        action="append",
        default=[],
        help=f"show a mesh too ({', '.join(MESH_INPUTS)}), in modes dvr, surface, slices, points and mesh; may be given"
        " again",
    )
    add_fields(group, RenderSettings, "meshes")


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Add the options of the turntable."""
    group = parser.add_argument_group("motion")
    group.add_argument(
        "--turntable",
        metavar="OUT",
        help="turn round the patient: .mp4, .gif, .apng, or a folder of PNG files",
        first=True,
    )
    add_fields(group, Turntable)


def render_settings(options: argparse.Namespace) -> RenderSettings:
    """Make settings from the options of the command."""
    named = options.color in POINT_COLORS
    look = "says how a label looks: give the label map with --labels FILE"
    turn = "says how a picture moves: name it with --turntable OUT"
    given = {name: getattr(options, name, None) for name in RenderSettings.keywords()} | {
        "color": None if named else options.color,
        "color_by": options.color if named else None,
        "views": tuple(view for views in options.views or () for view in views),
        "thickness": options.thickness or None,  # 0 is the same as no thickness
        "offset_mm": options.offset_mm or None,
        "labels": make_part(LabelLook, options, options.path, look),
        "meshes": tuple(MeshFile(*given) for given in options.meshes),
        "turntable": make_part(Turntable, options, options.turntable, turn),
    }
    return RenderSettings.of(**{name: value for name, value in given.items() if value is not None})
