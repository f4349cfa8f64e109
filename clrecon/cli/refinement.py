"""Options of smoothing, decimation, purposes and gates, and the description of their results."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from clrecon.cli.console import Console
from clrecon.jobs.presets import PURPOSES, Purpose
from clrecon.system.text import count_of, format_digits, format_ml

SCAN_GATE_FAILED, GATE_FAILED = 7, 8
"""Exit code for a failed gate with ``--strict``; everything is written."""

_ITERATIONS = 20


def add_refinement(parser: argparse.ArgumentParser) -> None:
    """Add --smooth, --decimate and --max-deviation."""
    group = parser.add_argument_group("refinement")
    group.add_argument(
        "--smooth",
        type=int,
        nargs="?",
        const=_ITERATIONS,
        metavar="N",
        help=f"smooth with N iterations of a windowed sinc filter (default: {_ITERATIONS})",
    )
    group.add_argument(
        "--decimate",
        type=float,
        metavar="SHARE",
        help="take away this share of the triangles, such as 0.9, or as much as the largest deviation lets",
    )
    group.add_argument(
        "--max-deviation",
        dest="max_deviation_mm",
        type=float,
        metavar="MM",
        help="smoothing and decimation each move nothing further (default: a quarter of the shortest voxel step)",
    )


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
