"""``clrecon cloud``: from a CT series or a cloud to a clean cloud of points."""

from __future__ import annotations

import argparse
import math
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.jobs.cloud.settings import STEPS, CloudSettings, Clustering
from clrecon.jobs.inputs import CLOUD_INPUTS
from clrecon.system.records import describe_volume
from clrecon.system.text import count_of, format_band, format_bytes

_EXAMPLES = """\
examples:
  clrecon cloud CT_FOLDER -o bone.ply
  clrecon cloud CT_FOLDER -o bone.npz --points shell --report bone.json
  clrecon cloud CT_FOLDER -o bone.ply --hu 200,3000 --cluster eps=1.2,min=6 --keep largest:2
  clrecon cloud CT_FOLDER -o bone.ply --hu 200,3000 --keep no-sheets --removed went.ply
  clrecon cloud scan.ply -o clean.ply --denoise grid,bilateral --normals --spacing 1 --surface clean.stl
  clrecon cloud CT_FOLDER -o t12.vtp --labels spine.nii.gz --label T12
  clrecon render went.ply -o went.png --color removed"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    width = max(map(len, STEPS))
    parser.epilog = "\n".join(
        (
            "The steps run in this order, in whichever order the options are given:",
            *(f"  {name:<{width}}  {text}" for name, text in STEPS.items()),
            "",
            "Points are in patient millimetres, by default in the DICOM frame (LPS: left, posterior, superior).",
            "All files appear at the end, completely or not at all; until then older files of these names are kept.",
            "",
            _EXAMPLES,
        )
    )
    kinds = ", ".join(CLOUD_INPUTS)
    common.add_input(parser, f"{common.SCAN_FOLDER}; {common.GRID_FILE}; or a cloud of points ({kinds})")
    common.add_output(parser, "cloud file: .ply .vtp .npz .xyz or .las")
    common.add_fields(parser, CloudSettings)
    common.add_reading(parser)
    common.add_masking(parser, crop=True)
    common.add_fields(parser.add_argument_group("points"), CloudSettings, "points")
    steps = parser.add_argument_group("steps")
    common.add_fields(steps, CloudSettings, "steps")
    steps.add_argument(
        "--surface", metavar="FILE", help="also write a closed mesh around the points, which need normals for it"
    )
    common.add_device(parser.add_argument_group("device"))
    checks = parser.add_argument_group("files and checks")
    checks.add_argument(
        "--removed",
        metavar="FILE",
        help="also write all points as they were before any removal; the label is the reason why a point was removed"
        " (0: kept)",
    )
    common.add_fields(checks, CloudSettings, "checks")
    common.add_no_clobber(checks)
    common.add_report(checks, "the figures of each step, device and times")


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.cloud.job import CloudFiles, make_cloud

    clusters = None if options.clusters is None else Clustering(**options.clusters)
    settings = common.make_settings(CloudSettings, options, clusters=clusters)
    files = CloudFiles(options.output, options.removed, options.surface, options.report)
    report = make_cloud(options.input, files, settings, **common.run_options(options, console))
    paths, space = {"cloud": options.output, "removed": options.removed, "surface": options.surface}, report["space"]
    written = [
        f"wrote    {printable(paths[entry['what']])}, {format_bytes(entry['bytes'])}, {space.upper()} mm"
        for entry in report["outputs"]
    ]
    common.show_report(report, describe_cloud_job(report) + written, options, console)
    return 0


def describe_cloud_job(report: dict[str, Any]) -> list[str]:
    lines: list[str] = []
    for step in report["steps"]:
        head = "steps    " if not lines else "         "
        lines.append(f"{head}{step['step']}: {_describe_step(step)}, {step['seconds']:.2f} s")
    known = common.describe_known(normals=report["normals"], hu=report["has_hu"], labels=report["labels"])
    return [
        f"input    {_describe_input(report)}",
        *lines,
        *_describe_removed(report),
        f"cloud    {count_of(report['points'], 'point')}{known}",
        *_describe_surface(report["surface"]),
        f"device   {printable(report['device'])}",
        f"time     {common.describe_times(report['seconds'])}",
    ]


def _describe_input(report: dict[str, Any]) -> str:
    if report["cloud_read"] is None:
        return describe_volume(report["volume"])
    file = report["cloud_read"]["file"] or {}
    frame = (
        f", {file['space']} as {'the file says' if file['space_from'] == 'file' else file['space_from']}"
        if file
        else ""
    )
    return f"{report['cloud_read']['points']:,} points{frame}"


def _describe_step(step: dict[str, Any]) -> str:
    after = step["points_after"]
    if step["step"] == "points":
        band = step.get("band_hu")
        level = f" of {step['iso_value_hu']:g} HU" if step.get("iso_value_hu") is not None else ""
        level = f" of {format_band(band[0], math.inf if band[1] is None else band[1])}" if band else level
        share = f", {100.0 * step['share']:.3g} % of {step['voxels']:,} voxels" if "share" in step else ""
        return f"{count_of(after, 'point')} ({step['kind']}{level}){share}"
    if "clusters" in step and "eps_mm" in step:
        noise = f", {count_of(step['noise_points'], 'point')} of noise" if "noise_points" in step else ""
        return (
            f"{count_of(step['clusters'], 'cluster')} at eps {step['eps_mm']:.4g} mm, min {step['min_samples']}{noise}"
        )
    if "rms_move_mm" in step:
        return f"{after:,} points moved by {step['rms_move_mm']:.3f} mm rms, at most {step['largest_move_mm']:.3f} mm"
    if "doubtful" in step:
        return f"{after:,} normals, {step['doubtful']:,} doubtful, oriented by {step['oriented_by'] or 'nothing'}"
    removed = [f"{count:,} {reason}" for reason, count in step["removed"].items() if count]
    if not removed:
        return f"{after:,} points, none removed"
    return f"{after:,} of {step['points_before']:,} points kept, removed {', '.join(removed)}"


def _describe_removed(report: dict[str, Any]) -> list[str]:
    if not report["removed_labels"]:
        return []
    names = ", ".join(f"{entry['label']} {entry['reason']}" for entry in report["removed_labels"])
    return [f"removed  labels of that file: {names}"]


def _describe_surface(surface: dict[str, Any] | None) -> list[str]:
    if surface is None:
        return []
    against = f"{100.0 * surface['votes_against_share']:.2g} % of the votes against it"
    walls = f"{100.0 * surface['wall_share']:.2g} % walls without points"
    return [
        f"surface  {surface['vertices']:,} vertices, {surface['triangles']:,} triangles, closed, {against}, {walls}"
    ]
