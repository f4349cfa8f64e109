"""``clrecon mesh``: from a CT series to a calibrated mesh."""

from __future__ import annotations

import argparse
from dataclasses import fields
from typing import Any

from clrecon.cli.common import (
    LEVELS_HELP,
    add_cropping,
    add_device,
    add_fields,
    add_keep_ids,
    add_masking,
    add_memory,
    add_no_clobber,
    add_reading,
    describe_space,
    describe_times,
    megabytes,
    parse_hu,
    parse_levels,
    parse_point,
    pick,
)
from clrecon.cli.console import Console, printable
from clrecon.cli.mesh_options import (
    add_label_arguments,
    add_methods,
    add_purpose,
    add_strict,
    describe_cells,
    describe_labels,
    describe_purposes,
    describe_refinement,
    finish_with_gates,
    label_choice,
)
from clrecon.jobs.mesh.purposes import settings_for
from clrecon.jobs.mesh.seeds import is_label_seed
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.outputs import MESH_FILES, OBJECT_FILES
from clrecon.jobs.presets import DEFAULT_PRESET, PRESETS
from clrecon.system.text import count_of, format_digits, format_ml, format_volume

_PARTS = (
    *("device", "read", "mask", "choose", "solid", "upload", "build", "kernels", "download"),
    *("select", "refine", "measure", "write", "other"),
)
_SHOWN_PARTS = 12

WHAT_BONE_COSTS = "in soft tissue 0.4 to 1.1 mm outside of the bone; --hu auto lies closer"
"""What the default level costs, measured by scripts/proof/measure_levels.py."""


def _epilog() -> str:
    width = max(map(len, PRESETS))
    lines = [f"  {p.name:<{width}}  {p.iso_value:>5g} HU  {p.description}" for p in PRESETS.values()]
    return "\n".join(
        (
            "presets:",
            *lines,
            "",
            "The mesh is in patient millimetres, by default in the DICOM frame (LPS: left, posterior, superior).",
            "It is written as a whole or not at all, and an older file of that name stays until then.",
            "Several meshes get names of their own: bone_200hu.stl, bone_001.stl, bone_200hu_001.stl.",
            "Area, volume and components cost time and are measured with --report, --json or -v only.",
            "",
            "examples:",
            "  clrecon mesh CT_FOLDER -o bone.stl",
            "  clrecon mesh CT_FOLDER -o skull.glb --hu 300 --keep-largest 1 --report skull.json",
            "  clrecon mesh CT_FOLDER -o bone.stl --hu auto",
            "  clrecon mesh CT_FOLDER -o print.3mf --for print",
            "  clrecon mesh CT_FOLDER -o bone.stl --hu auto --keep bone --solid",
            "  clrecon mesh CT_FOLDER -o bone.stl --hu 200,350 --min-volume 1 --split",
            "  clrecon mesh CT_FOLDER -o fat.stl --hu -150:-30 --remove-table",
            "  clrecon mesh CT_FOLDER -o lung.stl --below -400 --keep-largest 2",
            "  clrecon mesh CT_FOLDER -o spine.stl --hu 226 --method i-mc --grow-from -18,-126,-448",
            "  clrecon mesh CT_FOLDER -o bone.stl --labels spine.nii.gz --label T12 --label L1",
        )
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = _epilog()
    parser.add_argument(
        "input",
        metavar="INPUT",
        help="DICOM folder (subfolders and any file names are fine) or file; or a NIfTI, NRRD or MetaImage file",
    )
    parser.add_argument("-o", "--output", metavar="OUT", required=True, help=f"mesh file: {MESH_FILES}", first=True)
    add_purpose(parser)
    add_reading(parser)
    add_masking(parser)
    add_cropping(parser)
    surface = parser.add_argument_group("surface")
    add_levels(surface)
    add_solid(surface)
    surface.add_argument(
        "--space", type=str.lower, default="lps", metavar="lps|ras", help="patient frame of the mesh (default: lps)"
    )
    surface.add_argument(
        "--topology",
        type=str.lower,
        default="separated",
        metavar="T",
        help="what is done where the voxels leave open which of them are joined: separated keeps them apart (default),"
        " trilinear joins those that the trilinear interpolation joins",
    )
    surface.add_argument(
        "--open", dest="closed", action="store_false", help="leave the surface open at the border of the volume"
    )
    add_methods(parser)
    components = parser.add_argument_group("components")
    add_selection(components)
    components.add_argument(
        "--all-parts",
        action="store_true",
        help="with --for print: keep all bones, not the largest alone; named objects of a .3mf, one mesh in other"
        " formats",
    )
    components.add_argument("--split", action="store_true", help="write one file a component, the largest first")
    components.add_argument(
        "--one-file",
        action="store_true",
        help=f"labels, components of --split or several iso values in one file ({OBJECT_FILES}), each"
        " an object with its name and a colour of its own",
    )
    add_label_arguments(parser)
    add_fields(parser.add_argument_group("refinement"), MeshSettings, "refinement")
    device = parser.add_argument_group("device")
    add_device(device)
    add_memory(device)
    _add_checks(parser)


def add_levels(surface: argparse._ArgumentGroup) -> None:
    """Declare --hu, --below, --preset and --keep-outside: which values a surface encloses."""
    level = surface.add_mutually_exclusive_group()
    level.add_argument(
        "--hu", type=parse_hu, default={}, metavar="N[,N...]|A:B|auto|half:B,T", help=LEVELS_HELP, first=True
    )
    level.add_argument(
        "--below",
        type=parse_levels,
        metavar="N[,N...]",
        help="in place of an iso value: inside is what lies below N HU, such as lungs, airways and sinuses (-400); the"
        " air round the patient is left out",
    )
    level.add_argument(
        "--preset",
        type=str.lower,
        metavar="NAME",
        help=f"iso value by tissue, one of: {', '.join(PRESETS)} (default: {DEFAULT_PRESET})",
    )
    surface.add_argument("--keep-outside", action="store_true", help="with --below: leave the air round the patient in")


def add_solid(surface: argparse._ArgumentGroup) -> None:
    """Declare --solid and --seal: whether what is enclosed is filled."""
    surface.add_argument(
        "--solid",
        action=argparse.BooleanOptionalAction,
        help="fill what the bone encloses: marrow, and canals that the ends of the scan cut; the brain, the chest and"
        " air stay out; with --labels: what is less dense within a label",
        first=True,
    )
    surface.add_argument(
        "--seal",
        dest="seal_mm",
        type=float,
        metavar="MM",
        help="with --solid: close pores up to twice as wide, less one voxel (default: 2.5 to 3, by the voxels)",
    )


def add_selection(components: argparse._ArgumentGroup) -> None:
    """Declare --keep, --keep-largest, --min-volume and --seed: which components stay."""
    add_fields(components, MeshSettings, "selection")
    components.add_argument(
        "--seed",
        dest="seeds",
        type=parse_point,
        metavar="X,Y,Z",
        action="append",
        default=[],
        help="keep the component whose surface lies nearest to this point, in mm of the frame of --space;"
        " repeat it for several",
    )


def _add_checks(parser: argparse.ArgumentParser) -> None:
    checks = parser.add_argument_group("checks")
    add_strict(checks)
    add_no_clobber(checks)
    add_keep_ids(checks)
    checks.add_argument(
        "--report", metavar="FILE", help="write affine, counts, quality, device and times as JSON", first=True
    )


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.jobs.mesh.job import make_mesh, makes_objects

    names = {own.name for own in fields(MeshSettings)} - {"purpose"}
    given = {**pick(options, names), **options.hu, "labels": label_choice(options)}
    given = {name: value for name, value in given.items() if value is not None}
    if options.solid and options.labels is not None and not any(map(is_label_seed, options.grow_from)):
        given.pop("solid")  # it says how each label becomes a mesh
    settings = MeshSettings(**settings_for(options.purpose, given))
    report = make_mesh(
        options.input,
        options.output,
        settings,
        report_path=options.report,
        no_clobber=options.no_clobber,
        measure=bool(options.report or options.json or options.verbose),
        progress=console.progress,
    )
    console.result(report)
    for line in describe_mesh(report):
        console.say(line)
    together = options.one_file or (options.all_parts and makes_objects(options.output))
    console.say(f"wrote    {_describe_files(options.output, report, together=together)}")
    if options.report:
        console.say(f"report   {printable(options.report)}")
    return finish_with_gates(report, console, settings.strict)


def describe_mesh(report: dict[str, Any]) -> list[str]:
    """Describe a report for people: the input, the meshes, the device, the time."""
    border = "closed" if report["closed_at_border"] else "open"
    end = "crop" if report["volume"].get("crop") else "volume"
    return [
        f"input    {describe_volume(report['volume'])}",
        f"surface  {_describe_surfaces(report)}, {border} at the border of the {end}",
        *_describe_solid(report["volume"].get("solid")),
        f"mesh     {report['vertices']:,} vertices, {report['triangles']:,} triangles",
        *_describe_quality(report),
        *describe_cells(report),
        *describe_labels(report["meshes"]),
        *_describe_parts(report["meshes"]),
        *describe_refinement(report["meshes"]),
        *describe_purposes(report["meshes"]),
        f"device   {printable(report['device'])}{_describe_slabs(report)}",
        f"time     {describe_times(report['seconds'], _PARTS)}",
    ]


def _describe_surfaces(report: dict[str, Any]) -> str:
    """Describe what the surfaces enclose, and why."""
    inside = dict.fromkeys(tuple(mesh["inside_hu"] or ()) for mesh in report["meshes"])
    if () in inside:
        return "masks of labels, whatever their HU"
    return f"{', '.join(_describe_inside(*ends) for ends in inside)} HU ({_describe_choice(report)})"


def _describe_solid(solid: dict[str, Any] | None) -> list[str]:
    """Describe what was filled in a line; no line where nothing should be."""
    if solid is None:
        return []
    left = sum(kind["ml"] for kind in solid["open"].values())
    stays = f", {format_digits(left)} ml enclosed stay open" if left >= 0.05 else ""
    share = 100.0 * solid["filled_share"]
    filled = f"{solid['filled_ml']:,.1f} ml" if solid["filled_ml"] >= 0.1 else format_ml(solid["filled_ml"])
    return [f"solid    {filled} filled, {share:.0f} % of the solid{stays}"]


def _describe_inside(low: float | None, high: float | None) -> str:
    """Describe what a surface encloses, in the form of the option."""
    if high is None:
        return f"{low:g}"
    return f"below {high:g}" if low is None else f"{low:g}:{high:g}"


def _describe_slabs(report: dict[str, Any]) -> str:
    """Give the number of slabs, if the volume did not fit as a whole."""
    if report["slabs"] == 1:
        return ""
    return f", {report['slabs']} slabs of at most {megabytes(sum(report['device_bytes'].values()))}"


def _describe_choice(report: dict[str, Any]) -> str:
    """Give the reason for the iso value in a few words."""
    choice = report["iso_value_choice"]
    if choice is None:
        if report["preset"] == "bone":
            return f"preset bone: {WHAT_BONE_COSTS}"
        return f"preset {report['preset']}" if report["preset"] else "as given"
    if choice["method"] != "auto":
        return f"half way between tissue {choice['tissue_hu']:g} and bone {choice['bone_hu']:g} HU, as given"
    below = "air" if choice["background"] == "air" else "tissue"
    return f"auto: half way between {below} {choice['tissue_hu']:.0f} and bone {choice['bone_hu']:.0f} HU"


def describe_volume(volume: dict[str, Any]) -> str:
    """Describe the input in one line, from the certificate of a report."""
    parts = []
    if volume.get("shape_ijk"):
        ni, nj, nk = volume["shape_ijk"]
        parts.append(f"{count_of(nk, 'slice')} of {ni} x {nj}")
    if volume.get("spacing_mm"):
        di, dj, dk = volume["spacing_mm"]
        gaps = volume["gap_mm"]
        along = f", uneven gaps of {gaps['min']:.4g} to {gaps['max']:.4g}" if volume["uneven"] else f" x {dk:.4g}"
        parts.append(f"spacing {di:.4g} x {dj:.4g}{along} mm")
    if volume.get("tilt_deg") and abs(volume["tilt_deg"]) >= 0.05:
        parts.append(f"tilt {volume['tilt_deg']:+.2f} degrees")
    return ", ".join(parts)


def _describe_parts(meshes: list[dict[str, Any]]) -> list[str]:
    """Describe each of several meshes in a line; of many meshes only some."""
    if len(meshes) == 1:
        return []
    lines = []
    for mesh in meshes[:_SHOWN_PARTS]:
        volume = "" if mesh["volume_ml"] is None else f", {format_volume(mesh['volume_ml'])}"
        lines.append(f"         {mesh['name']}: {mesh['triangles']:,} triangles{volume}")
    if len(meshes) > _SHOWN_PARTS:
        lines.append(f"         and {len(meshes) - _SHOWN_PARTS:,} more")
    return lines


def _describe_files(output: str, report: dict[str, Any], *, together: bool) -> str:
    from clrecon.jobs.outputs import name_outputs

    paths = [output] if together else name_outputs(output, [mesh["name"] or "" for mesh in report["meshes"]])
    names = [printable(str(path)) for path in (paths[0], paths[-1])]
    files = {1: names[0], 2: " and ".join(names)}.get(len(paths), f"{names[0]} to {names[1]}, {len(paths):,} files")
    return f"{files}, {megabytes(report['output']['bytes'])}, {describe_space(output, report['space'])}"


def _describe_quality(report: dict[str, Any]) -> list[str]:
    if report["components"] is None:
        return []
    closed = "closed" if report["closed"] else "not closed"
    manifold = "manifold" if report["manifold"] else "not manifold"
    volume = "" if report["volume_ml"] is None else f", {format_volume(report['volume_ml'])}"
    parts = f"{report['components']:,} component{'s' * (report['components'] != 1)}"
    return [f"         {parts}, {closed}, {manifold}, {report['area_mm2']:,.0f} mm2{volume}"]
