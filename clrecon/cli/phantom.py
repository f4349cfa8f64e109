"""``clrecon phantom``: a CT series with a known surface."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli.common import add_no_clobber
from clrecon.cli.console import Console, printable
from clrecon.system.text import format_ml

_SETTINGS = (
    "kind", "size", "slices", "spacing", "tilt", "oblique", "noise", "point_spread_mm", "seed", "radius_mm",
    "table", "table_gap_mm", "prone", "ghosts", "levels", "facet_gap_mm", "kyphosis_deg", "scoliosis_deg", "uneven_mm",
    "missing", "phases",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = (
        "Writes a real DICOM series and truth.json with the affine and the exact area and volume, or with the voxels\n"
        "of each material and the label map materials.nrrd; with chosen levels also the label map levels.nrrd. Same\n"
        "settings and seed, same files.\n\n"
        f"kinds:\n{_list_kinds()}\n\n"
        "examples:\n  clrecon phantom phantom/ --kind torus --spacing 0.7 0.5 2.5 --tilt 12 --oblique 10 -5 30\n"
        "  clrecon phantom phantom/ --kind skull --table headrest --table-gap 4\n"
        "  clrecon phantom phantom/ --levels C1-L5 --scoliosis 35 --facet-gap 0.3 --spacing 0.7 0.7 1"
    )
    parser.add_argument("output", metavar="OUT", help="folder for the series")
    parser.add_argument(
        "--kind", type=str.lower, metavar="K", help="what to make; see below (default: spine)", first=True
    )
    parser.add_argument("--size", metavar="N", help="columns and rows, like 256 or 256x192 (default: 256)", first=True)
    parser.add_argument(
        "--slices", type=int, metavar="N", help="default: as many as the levels need, 120 without levels", first=True
    )
    parser.add_argument(
        "--spacing",
        type=float,
        nargs=3,
        metavar=("DJ", "DI", "DK"),
        help="mm between rows, columns, slices (default: by kind, of a spine 1 1 1.25)",
        first=True,
    )
    parser.add_argument("--tilt", type=float, metavar="DEG", help="gantry tilt (default: 0)", first=True)
    parser.add_argument(
        "--oblique", type=float, nargs=3, metavar=("X", "Y", "Z"), help="degrees about the patient's axes"
    )
    parser.add_argument(
        "--noise",
        type=float,
        metavar="HU",
        help="standard deviation of the noise (default: 12, of an analytic shape 0)",
        first=True,
    )
    parser.add_argument(
        "--point-spread",
        dest="point_spread_mm",
        type=float,
        metavar="MM",
        help="standard deviation of the blur (default: 0.5, of an analytic shape 0)",
    )
    parser.add_argument("--radius", dest="radius_mm", type=float, metavar="MM", help="radius of an analytic shape")
    parser.add_argument(
        "--table", type=str.lower, metavar="T", help="what a body lies on: none, flat, curved or headrest", first=True
    )
    parser.add_argument(
        "--table-gap",
        dest="table_gap_mm",
        type=float,
        metavar="MM",
        help="between body and table (default: 0, they touch)",
    )
    parser.add_argument("--prone", action="store_true", default=None, help="the patient lies on the face")
    parser.add_argument(
        "--ghosts", action="store_true", default=None, help="of a spine: two foreign slices, and a localizer"
    )
    _add_spine(parser)
    parser.add_argument("--missing", metavar="N,M-O", help="numbers of slices that are left out, like 20-22,40")
    parser.add_argument(
        "--seed", type=int, metavar="N", help="place within a voxel, noise and texture (default: 0)", first=True
    )
    add_no_clobber(parser)


def _add_spine(parser: argparse.ArgumentParser) -> None:
    spine = parser.add_argument_group("of a spine")
    spine.add_argument("--levels", metavar="C1-L5", help="vertebrae to show, like L4-L5 or C3-C7,T1-T5", first=True)
    spine.add_argument(
        "--facet-gap", dest="facet_gap_mm", type=float, metavar="MM", help="distance of neighbours in the facet joints"
    )
    for name, positive in (("kyphosis", "the back is round"), ("scoliosis", "the middle lies to the left")):
        spine.add_argument(
            f"--{name}", dest=f"{name}_deg", type=float, metavar="DEG",
            help=f"angle between the first and the last level; positive: {positive}",
        )  # fmt: skip
    spine.add_argument(
        "--uneven", dest="uneven_mm", type=float, metavar="MM", help="the gaps of the slices vary by up to this much"
    )
    spine.add_argument(
        "--phases", type=int, metavar="N", help="series at the same places, with ever more contrast medium"
    )


def _list_kinds() -> str:
    from clrecon.proof.phantom.job import describe_kinds

    return "\n".join(f"  {name:<9} {said}" for name, said in describe_kinds().items())


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.proof.phantom.job import make_phantom

    given: dict[str, Any] = {name: getattr(options, name) for name in _SETTINGS}
    truth = make_phantom(options.output, no_clobber=options.no_clobber, progress=console.progress, **given)
    console.result(truth)
    for line in _summary(truth, options.output):
        console.say(line)
    return 0


def _summary(truth: dict[str, Any], output: str) -> list[str]:
    ni, nj, nk = truth["shape_ijk"]
    spacing = " x ".join(f"{step:.4g}" for step in truth["spacing_mm"])
    lines = [f"phantom  {truth['kind']}, {nk} slices of {ni} x {nj}, spacing {spacing} mm"]
    if abs(truth["tilt_deg"]) >= 0.05:
        lines[0] += f", tilt {truth['tilt_deg']:+.2f} degrees"
    for material, part in (truth["parts"] or {}).items():
        dense = f", {part['voxels_above_300_hu']:,} voxels above 300 HU" if part["voxels_above_300_hu"] else ""
        lines.append(f"{material:<8} {format_ml(part['volume_ml'], 4)}{dense}")
    lines.append(f"surface  at {truth['iso_value_hu']:g} HU")
    if truth["surface"]:
        lines[-1] += f": {truth['surface']['area_mm2']:,.1f} mm2, {truth['surface']['volume_ml']:,.3f} ml"
    levels = [level for level in (truth["spine"] or {}).get("vertebrae", []) if "label" in level]
    if levels:
        lines.append(f"levels   {', '.join(level['name'] for level in levels)}")
        if cut := [level["name"] for level in levels if not level["whole"]]:
            lines[-1] += f"; not whole in the volume: {', '.join(cut)}"
    if series := truth.get("series"):
        lines.append(f"series   {_series_words(series)}")
    if truth["ghosts"]:
        said = [f"slice {one['slice']} shows {one['shows']}" for one in truth["ghosts"]["slices"]]
        lines.append(f"ghosts   {', '.join(said)}; the last file is a localizer")
    maps = [name for name, made in (("materials.nrrd", truth["parts"]), ("levels.nrrd", levels)) if made]
    return [*lines, f"wrote    {printable(output)}, with the truth in {' and '.join(['truth.json', *maps])}"]


def _series_words(series: dict[str, Any]) -> str:
    said = []
    if series["uneven_mm"]:
        said.append(f"gaps vary by up to {series['uneven_mm']:g} mm")
    if series["missing"]:
        said.append(f"missing are slices {', '.join(map(str, series['missing']))}")
    if series["phases"] > 1:
        said.append(f"{series['phases']} phases at the same places")
    return "; ".join(said)
