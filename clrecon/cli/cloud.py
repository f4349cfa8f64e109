"""``clrecon cloud``: from a CT series or a cloud to a clean cloud of points."""

from __future__ import annotations

import argparse
import math
from dataclasses import fields
from typing import Any

from clrecon.cli.common import (
    add_cropping,
    add_device,
    add_keep_ids,
    add_masking,
    add_memory,
    add_no_clobber,
    add_reading,
    describe_times,
    megabytes,
    parse_point,
    pick,
)
from clrecon.cli.console import Console, printable
from clrecon.cli.mesh import describe_volume
from clrecon.jobs.cloud.settings import DENOISERS, GHOSTS, POINT_KINDS, STEPS, CloudSettings
from clrecon.jobs.inputs import CLOUD_INPUTS
from clrecon.system.text import count_of, format_band


def parse_level(text: str) -> float | tuple[float, ...]:
    """Read ``N`` as an iso value, and ``LO,HI`` or ``LO:HI`` as a band of HU."""
    try:
        numbers = tuple(float(part) for part in text.replace(":", ",").split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 2):
        raise argparse.ArgumentTypeError(f"{text!r} is no iso value N and no band LO,HI of HU")
    return numbers[0] if len(numbers) == 1 else numbers


def parse_clusters(text: str) -> dict[str, Any]:
    """Read ``eps=MM,min=N`` (either may be missing) as parameters of `clrecon.jobs.cloud.settings.Clustering`."""
    known = {"eps": "eps", "min": "min_samples"}
    found: dict[str, Any] = {}
    for part in text.split(","):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals or name not in known or known[name] in found:
            raise argparse.ArgumentTypeError(f"{text!r} is not eps=MM,min=N, such as eps=1.2,min=6")
        try:
            found[known[name]] = (
                value if value == "plane+1" and name == "min" else (float if name == "eps" else int)(value)
            )
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r}: {name} is no number: {value!r}") from None
    return found


def parse_denoisers(text: str) -> tuple[str, ...]:
    """Read names with commas between them; what is not known is refused with the settings."""
    return tuple(part.strip().lower() for part in text.split(","))


_EXAMPLES = """\
examples:
  clrecon cloud CT_FOLDER -o bone.ply
  clrecon cloud CT_FOLDER -o bone.npz --points shell --report bone.json
  clrecon cloud CT_FOLDER -o bone.ply --hu 200,3000 --cluster eps=1.2,min=6 --keep largest:2
  clrecon cloud CT_FOLDER -o bone.ply --hu 200,3000 --keep no-sheets --removed went.ply
  clrecon cloud scan.ply -o clean.ply --denoise grid,bilateral --normals --spacing 1 --surface clean.stl
  clrecon cloud CT_FOLDER -o t12.vtp --labels spine.nii.gz --label T12
  clrecon render went.ply -o went.png --color removed"""


def _epilog() -> str:
    width = max(map(len, STEPS))
    return "\n".join(
        (
            "The steps run in this order, whatever the order of the options:",
            *(f"  {name:<{width}}  {text}" for name, text in STEPS.items()),
            "",
            "Points are in patient millimetres, by default in the DICOM frame (LPS: left, posterior, superior).",
            "All files appear as a whole at the end or not at all, and older files of these names stay until then.",
            "",
            _EXAMPLES,
        )
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = _epilog()
    parser.add_argument(
        "input",
        metavar="INPUT",
        help="DICOM folder (subfolders and any file names are fine) or file; a NIfTI, NRRD or MetaImage file; or a"
        f" cloud of points ({', '.join(CLOUD_INPUTS)})",
    )
    parser.add_argument(
        "-o", "--output", metavar="OUT", required=True, help="cloud file: .ply .vtp .npz .xyz or .las", first=True
    )
    parser.add_argument(
        "--space",
        type=str.lower,
        default="lps",
        metavar="lps|ras",
        help="patient frame of the written files and of seeds (default: lps)",
    )
    parser.add_argument(
        "--input-space",
        type=str.lower,
        metavar="lps|ras",
        help="patient frame of a cloud file that does not say its own (default: lps)",
    )
    add_reading(parser)
    add_masking(parser)
    add_cropping(parser)
    _add_points(parser)
    _add_steps(parser)
    device = parser.add_argument_group("device")
    add_device(device)
    add_memory(device)
    checks = parser.add_argument_group("files and checks")
    checks.add_argument(
        "--removed",
        metavar="FILE",
        help="write the points before any of them went, each with the number of the reason why it went as label (0:"
        " kept)",
    )
    checks.add_argument(
        "--allow-point-loss",
        action="store_true",
        help="go on where a step that should take noise alone takes more than half of the points, which else is"
        " refused",
    )
    add_no_clobber(checks)
    add_keep_ids(checks)
    checks.add_argument(
        "--report", metavar="FILE", help="write the figures of each step, device and times as JSON", first=True
    )


def _add_points(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("points")
    group.add_argument(
        "--points",
        type=str.lower,
        metavar="|".join(POINT_KINDS),
        help="surface: where the HU cross the iso value, between the voxels; voxels: the centres of those within;"
        " shell: of these the outer ones (default: surface, with a band voxels)",
        first=True,
    )
    group.add_argument(
        "--hu",
        type=parse_level,
        metavar="N|LO,HI",
        help="iso value, inside is N and above; or a band, both ends included (default: that of bone)",
        first=True,
    )
    group.add_argument(
        "--labels",
        metavar="FILE|FOLDER",
        help="label map: NIfTI, NRRD (.seg.nrrd too), MetaImage, DICOM SEG, RTSTRUCT, or a folder of masks",
        first=True,
    )
    group.add_argument("--label", metavar="NAME|N", help="points of this label only (default: of all)")
    group.add_argument(
        "--paper",
        action="store_true",
        help="place and filter voxels as the papers print it, and say by how much that is wrong",
    )


def _add_steps(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("steps")
    group.add_argument(
        "--ghost-slices",
        type=str.lower,
        default=GHOSTS[0],
        metavar="|".join(GHOSTS),
        help="slices inside the stack that are unlike both neighbours, as screen captures and localizers are: drop"
        f" takes their points away, keep warns of them (default: {GHOSTS[0]})",
    )
    group.add_argument(
        "--cluster",
        dest="clusters",
        type=parse_clusters,
        nargs="?",
        const={},
        metavar="eps=MM,min=N",
        help="density clusters (DBSCAN) without noise: neighbours are within eps, and a core point has min of them,"
        " itself included; min=plane+1 makes noise of lone slices (default: 1.5 times the largest voxel step, 6)",
        first=True,
    )
    group.add_argument(
        "--keep",
        metavar="RULE",
        action="append",
        default=[],
        help="clusters that stay: largest, largest:N, min:POINTS, seed:X,Y,Z (the nearest), no-sheets (tables and image"
        " planes go); may be given again",
        first=True,
    )
    group.add_argument(
        "--outliers",
        type=float,
        nargs="?",
        const=2.0,
        metavar="SD",
        help="points go whose mean distance to 16 neighbours is SD standard deviations over the mean (without a number:"
        " 2)",
    )
    group.add_argument(
        "--denoise",
        type=parse_denoisers,
        default=(),
        metavar=",".join(DENOISERS),
        help="grid: points alone in a cell of a grid go; bilateral: points move along their normals to the weighted"
        " mean height of their neighbours, edges stay",
        first=True,
    )
    group.add_argument(
        "--normals",
        action="store_true",
        help="unit normals that point out of bone; points of a surface have those of the scan until they are moved",
        first=True,
    )
    group.add_argument(
        "--viewpoint",
        type=parse_point,
        metavar="X,Y,Z",
        help="a point inside of the object, mm in the frame of --space: normals of a cloud that was read point away"
        " from it (a scan turns its own by HU)",
    )
    group.add_argument("--spacing", type=float, metavar="MM", help="keep one point for each cell of that size")
    group.add_argument(
        "--surface", metavar="FILE", help="write a closed mesh around the points too, which need normals for it"
    )


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.jobs.cloud.job import CloudFiles, make_cloud
    from clrecon.jobs.cloud.settings import Clustering

    given = pick(options, {own.name for own in fields(CloudSettings)})
    clusters = None if options.clusters is None else Clustering(**options.clusters)
    settings = CloudSettings(**{**given, "clusters": clusters, "keep": tuple(options.keep)})
    files = CloudFiles(options.output, options.removed, options.surface, options.report)
    report = make_cloud(options.input, files, settings, no_clobber=options.no_clobber, progress=console.progress)
    console.result(report)
    for line in describe_cloud_job(report):
        console.say(line)
    paths = {"cloud": options.output, "removed": options.removed, "surface": options.surface}
    for entry in report["outputs"]:
        console.say(
            f"wrote    {printable(paths[entry['what']])}, {megabytes(entry['bytes'])}, {report['space'].upper()} mm"
        )
    if options.report:
        console.say(f"report   {printable(options.report)}")
    for warning in report["warnings"]:
        console.warn(warning)
    return 0


def describe_cloud_job(report: dict[str, Any]) -> list[str]:
    """Describe a report for people: the input, each step with what it took away, the cloud, the time."""
    return [
        f"input    {_describe_input(report)}",
        *_describe_steps(report["steps"]),
        *_describe_removed(report),
        f"cloud    {count_of(report['points'], 'point')}{_describe_known(report)}",
        *_describe_surface(report["surface"]),
        f"device   {printable(report['device'])}",
        f"time     {describe_times(report['seconds'])}",
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


def _describe_steps(steps: list[dict[str, Any]]) -> list[str]:
    lines: list[str] = []
    for step in steps:
        head = "steps    " if not lines else "         "
        lines.append(f"{head}{step['step']}: {_describe_step(step)}, {step['seconds']:.2f} s")
    return lines


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
        return f"{after:,} points, none went"
    return f"{after:,} of {step['points_before']:,} points stay, {', '.join(removed)} went"


def _describe_removed(report: dict[str, Any]) -> list[str]:
    """Name the labels of the file of removed points."""
    if not report["removed_labels"]:
        return []
    names = ", ".join(f"{entry['label']} {entry['reason']}" for entry in report["removed_labels"])
    return [f"removed  labels of that file: {names}"]


def _describe_known(report: dict[str, Any]) -> str:
    known = [word for word, name in (("normals", "normals"), ("HU", "has_hu"), ("labels", "labels")) if report[name]]
    return f" with {', '.join(known)}" if known else ""


def _describe_surface(surface: dict[str, Any] | None) -> list[str]:
    if surface is None:
        return []
    against = f"{100.0 * surface['votes_against_share']:.2g} % of the votes against it"
    walls = f"{100.0 * surface['wall_share']:.2g} % walls without points"
    return [
        f"surface  {surface['vertices']:,} vertices, {surface['triangles']:,} triangles, closed, {against}, {walls}"
    ]
