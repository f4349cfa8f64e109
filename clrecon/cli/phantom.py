"""``clrecon phantom``: a CT series with a known surface."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.proof.phantom.settings import KINDS, PhantomSettings
from clrecon.system.paths import keep_existing
from clrecon.system.text import format_ml


def add_arguments(parser: argparse.ArgumentParser) -> None:
    kinds = "\n".join(f"  {name:<9} {kind.said}" for name, kind in KINDS.items())
    parser.epilog = (
        "Writes a real DICOM series and truth.json with the affine and the exact area and volume, or with the voxels\n"
        "of each material and the label map materials.nrrd; with chosen levels also the label map levels.nrrd. Same\n"
        "settings and seed, same files.\n\n"
        f"kinds:\n{kinds}\n\n"
        "examples:\n  clrecon phantom phantom/ --kind torus --spacing 0.7 0.5 2.5 --tilt 12 --oblique 10 -5 30\n"
        "  clrecon phantom phantom/ --kind skull --table headrest --table-gap 4\n"
        "  clrecon phantom phantom/ --levels C1-L5 --scoliosis 35 --facet-gap 0.3 --spacing 0.7 0.7 1"
    )
    parser.add_argument("output", metavar="OUT", help="folder for the series")
    common.add_fields(parser, PhantomSettings)
    common.add_fields(parser.add_argument_group("of a spine"), PhantomSettings, "spine")
    common.add_fields(parser, PhantomSettings, "missing", "seed")
    common.add_no_clobber(parser, with_ids=False)


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.proof.phantom import write_phantom

    settings = common.make_settings(PhantomSettings, options)
    with keep_existing(keep=options.no_clobber):
        truth = write_phantom(options.output, settings, progress=console.progress)
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
        ghosts = [f"slice {one['slice']} shows {one['shows']}" for one in truth["ghosts"]["slices"]]
        lines.append(f"ghosts   {', '.join(ghosts)}; the last file is a localizer")
    maps = [name for name, made in (("materials.nrrd", truth["parts"]), ("levels.nrrd", levels)) if made]
    return [*lines, f"wrote    {printable(output)}, with the truth in {' and '.join(['truth.json', *maps])}"]


def _series_words(series: dict[str, Any]) -> str:
    remarks = []
    if series["uneven_mm"]:
        remarks.append(f"gaps vary by up to {series['uneven_mm']:g} mm")
    if series["missing"]:
        remarks.append(f"missing are slices {', '.join(map(str, series['missing']))}")
    if series["phases"] > 1:
        remarks.append(f"{series['phases']} phases at the same places")
    return "; ".join(remarks)
