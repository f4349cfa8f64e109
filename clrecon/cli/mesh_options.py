"""The options of ``clrecon mesh`` by subject - labels, methods, refinement, purposes, gates - and their results in
words."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from clrecon.cli.common import parse_point
from clrecon.cli.console import Console
from clrecon.errors import UsageError
from clrecon.jobs.presets import PURPOSES, Purpose
from clrecon.system.text import count_of, format_digits, format_ml, format_volume

if TYPE_CHECKING:
    from clrecon.jobs.mesh.settings import LabelChoice


def _parse_color(text: str) -> tuple[str, str]:
    """Read ``LABEL=COLOUR``."""
    from clrecon.cli.render_options import parse_label_color  # numpy: not loaded for a help text

    return parse_label_color(text)


def add_label_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options for label maps; without `files` all labels go into one."""
    group = parser.add_argument_group("labels", "one mesh a label: the label picks the cells, HU place the vertices")
    group.add_argument(
        "--labels",
        metavar="FILE|FOLDER",
        help="label map: NIfTI, NRRD (.seg.nrrd too), MetaImage, DICOM SEG, RTSTRUCT, or a folder of masks",
        first=True,
    )
    group.add_argument(
        "--label", metavar="NAME|N", action="append", help="this label only; may be given again (default: all)"
    )
    group.add_argument("--hide-label", metavar="NAME|N", action="append", help="not this label; may be given again")
    group.add_argument(
        "--label-color",
        metavar="LABEL=COLOUR",
        type=_parse_color,
        action="append",
        help="colour of a label in .ply and in the formats of several objects, such as L3=orange; may be given again",
    )
    group.add_argument(
        "--surface",
        metavar="hu|mask",
        help="hu: HU place the vertices (default); mask: the label's own surface, smoothed within its voxels and with"
        " their volume, whatever the HU: organs, lungs, what HU do not show",
    )
    group.add_argument(
        "--grow",
        type=float,
        metavar="MM",
        help="dense voxels this near to a label are its own (default: one voxel each way)",
    )


def label_choice(options: argparse.Namespace) -> LabelChoice | None:
    """Make the settings of labels from the options, None without a label map."""
    if options.labels is not None:
        from clrecon.jobs.mesh.settings import LabelChoice

        surface = "hu" if options.surface is None else options.surface.lower()
        return LabelChoice(
            options.labels,
            tuple(options.label or ()),
            options.grow,
            bool(options.solid),
            surface,
            hidden=tuple(options.hide_label or ()),
            colors=tuple(options.label_color or ()),
        )
    given = {
        "--label": options.label,
        "--hide-label": options.hide_label,
        "--label-color": options.label_color,
        "--grow": options.grow is not None,
        "--surface": options.surface,
    }
    for option, value in given.items():
        if value:
            raise UsageError(f"{option} says how labels become meshes: give their file with --labels FILE")
    return None


def describe_labels(meshes: list[dict[str, Any]]) -> list[str]:
    """Describe the surfaces of labels in a line; no line without labels."""
    labels = [mesh for mesh in meshes if mesh["label"] is not None]
    if not labels:
        return []
    count = len({mesh["label_number"] for mesh in labels})
    if labels[0]["surface"] == "mask":
        kinds = [f"labels   {count} label{'s' * (count > 1)}, by {'their' if count > 1 else 'its'} own mask"]
        return kinds + _describe_volumes(labels)
    shares = [100.0 * mesh["vertices_by_hu_share"] for mesh in labels]
    low, high = min(shares), max(shares)
    share = f"{low:.0f}" if round(low) == round(high) else f"{low:.0f} to {high:.0f}"
    grow_mm = labels[0]["grow_mm"]
    growth = "one voxel" if grow_mm is None else f"{grow_mm:.3g} mm"
    kind = ", solid" if labels[0]["solid"] else ""
    return [
        f"labels   {count} label{'s' * (count > 1)}{kind}, grown by {growth}; HU place {share} % of the vertices",
        *_describe_volumes(labels),
    ]


def _describe_volumes(labels: list[dict[str, Any]]) -> list[str]:
    """Compare the total volume of the meshes with that of the voxels of their labels."""
    surfaces = {(mesh["label_number"], mesh["iso_value_hu"]): mesh for mesh in labels}.values()
    if any(mesh["label_mesh_ml"] is None for mesh in surfaces):
        return []
    label_ml = sum(mesh["label_compared_ml"] for mesh in surfaces)
    mesh_ml = sum(mesh["label_mesh_ml"] for mesh in surfaces)
    change = 100.0 * (mesh_ml / label_ml - 1.0)
    return [f"         {format_volume(mesh_ml)} of mesh for {format_volume(label_ml)} of labels ({change:+.1f} %)"]


METHOD_NAMES = ("t-mc", "i-mc", "g-mc", "s-mc", "t-mc-soup", "skimage")


def add_methods(parser: argparse.ArgumentParser) -> None:
    """Add --method, --grow-from and --vertex-rule."""
    group = parser.add_argument_group("method", "marching cubes as papers compare them: see docs/methods.md")
    group.add_argument(
        "--method",
        type=str.lower,
        metavar="|".join(METHOD_NAMES),
        help="t-mc: every cell (default); i-mc: only what hangs together with seeds; g-mc: t-mc, then quadric collapse"
        " without a bound; s-mc: t-mc, then decimation within a bound; t-mc-soup, skimage: on the CPU, to compare with",
    )
    group.add_argument(
        "--grow-from",
        type=_parse_seed,
        action="append",
        default=[],
        metavar="auto|X,Y,Z|label:NAME",
        help="seeds of i-mc: auto takes the parts with at least 1/20 of the cells of the largest; a point in mm of the"
        " frame of --space, at most 10 mm from the surface; a label of --labels. May be given again",
    )
    group.add_argument(
        "--vertex-rule",
        type=str.lower,
        metavar="linear|golden|golden-search",
        help="where on an edge a vertex lies: linear (default); golden: at 0.618 whatever the HU, up to 0.6 voxels off;"
        " golden-search: where a cubic crosses the iso value, no better than linear",
    )


def _parse_seed(text: str) -> str | tuple[float, ...]:
    """Read ``auto``, ``label:NAME`` or ``X,Y,Z``."""
    if text.lower() == "auto":
        return "auto"
    if text.lower().startswith("label:"):
        return f"label:{text[6:]}"
    try:
        return parse_point(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is neither auto nor X,Y,Z in mm nor label:NAME") from error


def describe_cells(report: dict[str, Any]) -> list[str]:
    """Describe the cells that each grown surface visited, and what was left out; no line for whole ones."""
    lines: list[str] = []
    for mesh in report["meshes"]:
        cells, growing = mesh["cells"], mesh["growing"]
        if not growing:
            continue
        share = cells["all"] / max(cells["visited"], 1)
        told = [
            f"cells    {cells['visited']:,} visited, {cells['active']:,} active, {cells['all']:,} in all (1 in"
            f" {share:,.0f} visited)",
            f"grown    from {', '.join(growing['from'])}: {growing['components_taken']:,} of"
            f" {count_of(growing['components'], 'part')};"
            f" {100 * growing['cells_left_out_share']:.1f} % of the active cells left"
            f" out, the largest part of them {growing['largest_left_out_cells']:,}",
        ]
        lines += [line for line in told if line not in lines]
    return lines


SCAN_GATE_FAILED, GATE_FAILED = 7, 8
"""Exit code for a failed gate with ``--strict``; everything is written."""


def add_strict(parser: argparse._ActionsContainer) -> None:
    """Add --strict."""
    parser.add_argument(
        "--strict",
        action="store_true",
        help=f"exit with {GATE_FAILED} when a gate of a mesh fails (closed, manifold, no cuts, close to the scan ...),"
        f' with {SCAN_GATE_FAILED} when only gates of the scan do (see "clrecon info")',
    )


def add_purpose(parser: argparse._ActionsContainer) -> None:
    """Add --for."""
    parser.add_argument(
        "--for",
        type=str.lower,
        dest="purpose",
        metavar="PURPOSE",
        help="what the mesh is for, with the settings that this takes (others given beside it win); "
        + "; ".join(map(_describe_purpose, PURPOSES.values())),
        first=True,
    )


def describe_refinement(meshes: list[dict[str, Any]]) -> list[str]:
    """Describe the changes by smoothing and decimation: those of one mesh, or the largest of several."""
    found = [mesh["refinement"] for mesh in meshes if mesh["refinement"]]
    if not found:
        return []
    worst = max(found, key=lambda each: each["deviation"]["hd95_mm"] / each["voxel_mm"])
    parts = []
    if "smooth" in worst:
        parts.append(_describe_smoothing(worst["smooth"]))
    if "decimate" in worst:
        parts.append(_describe_decimation(worst["decimate"]))
    deviation, voxel = worst["deviation"], worst["voxel_mm"]
    if deviation["volume_change_percent"] is not None:
        parts.append(f"volume {round(deviation['volume_change_percent'], 2) + 0.0:+.2f} %")
    which = "refined " if len(found) == 1 else "refined (worst mesh)"
    lengths = ", ".join(
        f"{name} {deviation[key]:.3f} mm ({deviation[key] / voxel:.2f} voxel)"
        for name, key in (("mean", "assd_mm"), ("95 % within", "hd95_mm"), ("largest", "max_mm"))
    )
    return [f"{which} {', '.join(parts)}", f"         from the surface before: {lengths}"]


def _describe_smoothing(found: dict[str, Any]) -> str:
    """Describe the iterations, and what was not smoothed."""
    parts = [count_of(found["iterations"], "iteration")]
    if found["components_left"]:
        parts.append(f"{count_of(found['components_left'], 'component')} left unsmoothed to keep the volume")
    if found["vertices_not_finite"]:
        parts.append(f"{count_of(found['vertices_not_finite'], 'vertex', 'vertices')} without a finite step not moved")
    return f"smoothed ({'; '.join(parts)})"


def _describe_decimation(found: dict[str, Any]) -> str:
    """Describe how many triangles were removed, how many were asked for, and why decimation ended."""
    asked, reached = 100 * found["fraction"], 100 * found["reached"]
    topology = _describe_topology(found["topology"])
    if found["ended_by"] == "share":
        return f"{reached:.1f} % of the triangles taken away, as asked, {topology}"
    bound = f"the bound of {format_digits(found['max_deviation_mm'])} mm"
    return f"{reached:.1f} % of the triangles taken away of {asked:g} % asked for: {bound} ended it, {topology}"


def _describe_topology(found: Mapping[str, Any]) -> str:
    """Describe the Euler number before and after, and in how many components it changed."""
    before, after = found["euler_number_before"], found["euler_number_after"]
    if not (found["components_changed"] or found["components_lost"]):
        return f"Euler number {before} before and after"
    parts = [f"changed in {found['components_changed']} of {count_of(found['components_before'], 'component')}"]
    if found["components_lost"]:
        parts.append(f"{found['components_lost']} lost")
    return f"Euler number {before} before, {after} after ({', '.join(parts)})"


def _describe_purpose(purpose: Purpose) -> str:
    """Describe a purpose by the options that it stands for; part of the help of ``--for``."""
    options = [
        f"--{field.replace('_', '-')}"
        + ("" if value is True else f" {' '.join(value)}" if isinstance(value, tuple) else f" {value}")
        for field, value in purpose.settings.items()
    ]
    return f"{purpose.name}: {' '.join(options)}: {purpose.description}".replace("%", "%%")


def describe_purposes(meshes: list[dict[str, Any]]) -> list[str]:
    """Describe the facts that matter for printing the mesh; of several meshes only the first."""
    found = [mesh["print"] for mesh in meshes if mesh.get("print")]
    if not found:
        return []
    facts, wall, left_out = found[0], found[0]["wall"], found[0]["left_out"]
    which = "print    " if len(found) == 1 else "print    (first mesh) "
    lines = [f"{which}size {' x '.join(f'{length:.1f}' for length in facts['size_mm'])} mm"]
    if wall["median_mm"] is not None:
        lines[0] += (
            f", walls {wall['median_mm']:.1f} mm (median), 5 % below {format_digits(wall['p5_mm'], 2)} mm,"
            f" {100 * wall['thin_share']:.1f} % below {wall['thin_mm']:g} mm"
        )
    pieces = f"{count_of(left_out['pieces'], 'piece')} of {format_ml(left_out['pieces_ml'])} together"
    cavities = (
        f"{count_of(left_out['cavities'], 'closed cavity', 'closed cavities')} of {format_ml(left_out['cavities_ml'])}"
    )
    if left_out["pieces"] or left_out["cavities"]:
        lines.append(f"         left out {pieces}, filled {cavities}")
    if left_out["not_bone"] is not None:
        bone = left_out["pieces"] + facts["pieces"] - left_out["not_bone"]
        lines.append(
            f"         kept {facts['pieces']:,} of {bone:,} pieces with walls like bone; {left_out['not_bone']:,} of"
            f" {format_ml(left_out['not_bone_ml'])} are not, or are crumbs"
        )
    return lines


GATES_OF_AFFINE = ("grid_residual",)
"""Gates for the fit of the affine to the slices.  Meshes do not need it: they use the position of each slice."""


def finish_with_gates(report: dict[str, Any], console: Console, strict: bool) -> int:
    """Print the warnings of a report; returns the exit code.

    With `strict` a failed gate of the volume or of a mesh is an error, which is printed even with ``--quiet`` and
    ``--json``; that of a mesh decides the code.  Exception: a failed gate of `GATES_OF_AFFINE` (uneven slices) stays a
    warning.
    """
    from clrecon.jobs.mesh.refinement import warn_of_gates

    gates = [gate for gate in report["volume"].get("gates", ()) if gate["name"] not in GATES_OF_AFFINE]
    of_volume = [{"mesh": "volume", **gate} for gate in gates]
    failed_scan = warn_of_gates(of_volume) if strict else []
    failed_mesh = warn_of_gates(report["gates"]) if strict else []
    failed = failed_scan + failed_mesh
    for warning in report["warnings"]:
        if warning not in failed:
            console.warn(warning)
    for line in failed:
        console.error(line)
    if failed_mesh:
        return GATE_FAILED
    return SCAN_GATE_FAILED if failed_scan else 0
