"""``clrecon demo``: a demonstration that takes seconds and needs no data."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.cli.mesh import describe_mesh


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "Writes a synthetic CT series of a spine to OUT/ct, a picture of it to OUT/bone.png, its bone surface to\n"
        "OUT/bone.stl and the report to OUT/report.json, and compares a sphere of known size with its mesh.\n"
        "A second run replaces the first."
    )
    parser.add_argument("output", metavar="OUT", nargs="?", help="folder (default: clrecon-demo)")
    common.add_device(parser, memory=False)
    common.add_no_clobber(parser, with_ids=False)


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.proof.demo import DEMO_FOLDER, make_demo

    outcome = make_demo(options.output or DEMO_FOLDER, options.device, **common.run_options(options, console))
    common.show_report(outcome, _summary(outcome), options, console, of="mesh")
    return 0


def _summary(outcome: dict[str, Any]) -> list[str]:
    folder = printable(outcome["folder"])
    check, seconds = outcome["check"], outcome["seconds"]
    width, height = outcome["picture"]["pictures"][0]["size"]
    error = 100.0 * (check["volume_ml"] / check["true_volume_ml"] - 1.0)
    spacing = " x ".join(f"{step:.3g}" for step in check["spacing_mm"])
    return [
        *describe_mesh(outcome["mesh"]),
        f"affine   off by {outcome['affine_error_mm']:.2g} mm from the one that the series was made with",
        f"check    sphere in voxels of {spacing} mm, gantry tilted {check['tilt_deg']:+.3g} degrees:"
        f" {check['volume_ml']:.4f} ml of {check['true_volume_ml']:.4f} ml ({error:+.2f} %),"
        f" no vertex off by more than {check['radius_error_max_mm']:.3f} mm",
        f"wrote    {folder}/ct, and bone.png, bone.stl and report.json beside it, in {seconds['total']:.1f} s",
        f"picture  {folder}/bone.png: volume rendering, {width} x {height}, without OpenGL or a screen",
        f"next     clrecon mesh {folder}/ct -o bone.stl",
        f"         clrecon render {folder}/ct -o left.png --view left",
    ]
