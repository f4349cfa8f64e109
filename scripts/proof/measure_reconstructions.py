#!/usr/bin/env python3
"""How far the surfaces of one scan differ that is reconstructed in several ways: levels, and fitted to the cortex.

    python scripts/proof/measure_reconstructions.py phantoms
    python scripts/proof/measure_reconstructions.py scans thin=CT_FOLDER thick=CT_FOLDER:3
    python scripts/proof/measure_reconstructions.py page

`phantoms` draws one body with two kernels (soft, edge-enhancing) and slices of 1, 2.5 and 5 mm, finds the surfaces at
200 HU, at `--hu auto` and of `--surface cortex` along the same true normals in all of them, and keeps the differences
in docs/benchmarks/levels; `page` writes them into docs/iso_value.md.  `scans` prints the same of real reconstructions
of one scan, along the normals of the surface of the first; CT_FOLDER:3 is the mean of each three slices.  All need an
OpenCL device.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent), str(ROOT / "scripts" / "guide")]

from level_phantoms import (  # noqa: E402
    REACH_MM,
    SCANNING,
    STEP_MM,
    TRUNK,
    Phantom,
    Profiles,
    draw_phantom,
    find_on_mesh,
    sample_along,
    sample_profiles,
)
from marked_tables import markdown_table, put_table  # noqa: E402

from clrecon.anatomy.iso_choice import choose_iso_value  # noqa: E402
from clrecon.geometry import Volume  # noqa: E402
from clrecon.jobs.presets import PRESETS  # noqa: E402
from clrecon.system.pieces import spread_rows  # noqa: E402

FIGURES = ROOT / "docs" / "benchmarks" / "levels" / "reconstructions.json"
PAGE = ROOT / "docs" / "iso_value.md"
TABLE = "reconstructions of one scan"
RULES = {"preset": "200 HU", "auto": "auto", "fitted": "fitted to the cortex"}
KERNELS: dict[str, tuple[float, dict[str, float]]] = {
    "soft": (0.0, {"point_spread_mm": 0.8}),
    "edge-enhancing": (1.0, {"point_spread_mm": 0.4, "noise": 40.0}),
}
"""How much edges are enhanced, and the settings of the phantom."""
SLICES_MM = (1.0, 2.5, 5.0)
_PLACES = 6000

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Places:
    """Where surfaces are met along normals, mm, shape (n,) each, NaN where they are not.

    surfaces: By rule.
    stated: Error of the fitted surface.
    is_within: Whether the volume has all of the normal.
    """

    surfaces: dict[str, Values]
    stated: Values
    is_within: NDArray[np.bool_]


def make_phantoms() -> dict[str, Phantom]:
    """Return the reconstructions of one body, the reference first."""
    length = TRUNK["slices"] * TRUNK["spacing"][2]
    found = {}
    for kernel, (enhance, changes) in KERNELS.items():
        for step in SLICES_MM:
            settings = {**TRUNK, "slices": round(length / step), "spacing": (1.0, 1.0, step), **changes}
            name = f"{kernel}, {step:g} mm"
            found[name] = Phantom(name, SCANNING, settings, enhance=enhance)
    return found


def find_places(volume: Volume, points: Values, normals: Values) -> Places:
    """Find the surfaces along normals."""
    import clrecon

    way = np.arange(-REACH_MM, REACH_MM + STEP_MM / 2, STEP_MM)
    values = sample_along(volume, points, normals, way)
    profiles = Profiles(np.nan_to_num(values, nan=-1024.0), points, normals, way.astype(np.float32))
    surface = clrecon.extract_isosurface(volume, PRESETS["bone"].iso_value)
    mesh = clrecon.fit_cortex(surface, volume)
    fitted, rows = find_on_mesh(profiles, mesh.vertices, mesh.triangles)
    levels = {"preset": PRESETS["bone"].iso_value, "auto": choose_iso_value(volume).iso_value}
    return Places(
        {**{rule: profiles.errors(level).astype(np.float64) for rule, level in levels.items()}, "fitted": fitted},
        np.where(rows >= 0, mesh.values["error_mm"][mesh.triangles[rows, 0]].astype(np.float64), np.nan),
        ~np.isnan(values.min(axis=1)),
    )


def compare(one: Places, other: Places) -> dict[str, Any]:
    """Return by rule the distances between two surfaces, and the share of places at which one of them is lost."""
    is_within = one.is_within & other.is_within
    apart = {rule: np.abs(one.surfaces[rule] - other.surfaces[rule])[is_within] for rule in RULES}
    compared: dict[str, Any] = {}
    for rule, distances in apart.items():
        met = distances[np.isfinite(distances)]
        compared[rule] = {
            "median_mm": round(float(np.median(met)), 3),
            "p95_mm": round(float(np.percentile(met, 95)), 3),
            "lost_share": round(1.0 - len(met) / len(distances), 4),
        }
    stated = np.hypot(one.stated, other.stated)[is_within]
    known = np.isfinite(stated) & np.isfinite(apart["fitted"])
    within = np.mean(apart["fitted"][known] <= 1.96 * stated[known])
    compared["fitted"]["within_196_errors"] = round(float(within), 4)
    return compared


def name_pairs() -> list[tuple[str, str]]:
    """Return the pairs that are compared: kernels of one thickness, and thicknesses of one kernel."""
    soft, sharp = KERNELS
    pairs = [(f"{soft}, {step:g} mm", f"{sharp}, {step:g} mm") for step in SLICES_MM]
    thin = SLICES_MM[0]
    return pairs + [
        (f"{kernel}, {thin:g} mm", f"{kernel}, {step:g} mm") for kernel in KERNELS for step in SLICES_MM[1:]
    ]


def measure_phantoms() -> list[dict[str, Any]]:
    """Measure all pairs of one body."""
    phantoms = make_phantoms()
    first = next(iter(phantoms.values()))
    truth = sample_profiles(first, draw_phantom(first))
    places = {}
    for name, phantom in phantoms.items():
        places[name] = find_places(draw_phantom(phantom), truth.points, truth.normals)
        print(name, flush=True)
    return [{"one": a, "other": b, **compare(places[a], places[b])} for a, b in name_pairs()]


def read_scan(given: str) -> Volume:
    """Read CT_FOLDER, or CT_FOLDER:COUNT, whose slices are the means of so many."""
    import clrecon

    folder, _, count = given.partition(":")
    volume = clrecon.read_volume(folder)
    if not count:
        return volume
    step = int(count)
    whole = len(volume.voxels) // step * step
    thick = volume.voxels[:whole].reshape(-1, step, *volume.voxels.shape[1:]).mean(axis=1)
    affine = volume.affine.copy()
    affine[:3, 3] += 0.5 * (step - 1) * affine[:3, 2]
    affine[:3, 2] *= step
    return Volume(np.rint(thick).astype(np.int16), affine)


def measure_scans(scans: dict[str, str]) -> list[dict[str, Any]]:
    """Measure the pairs of the first of some reconstructions with the others."""
    import clrecon

    volumes = {name: read_scan(given) for name, given in scans.items()}
    first, *others = volumes
    surface = clrecon.extract_isosurface(volumes[first], PRESETS["bone"].iso_value)
    assert surface.normals is not None
    rows = spread_rows(surface.vertex_count, _PLACES)
    points, normals = surface.vertices[rows].astype(np.float64), surface.normals[rows].astype(np.float64)
    places = {name: find_places(volume, points, normals) for name, volume in volumes.items()}
    return [{"one": first, "other": name, **compare(places[first], places[name])} for name in others]


def make_table(figures: list[dict[str, Any]]) -> str:
    """Return the table of the page."""
    rows = []
    for pair in figures:
        cells = [
            f"{one['median_mm']:.2f}, {one['p95_mm']:.2f}, {100.0 * one['lost_share']:.1f} %"
            for one in (pair[rule] for rule in RULES)
        ]
        rows.append([pair["one"], pair["other"], *cells, f"{100.0 * pair['fitted']['within_196_errors']:.0f} %"])
    return markdown_table(["first", "second", *RULES.values(), "within 1.96 estimated errors"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("phantoms", "scans", "page"))
    parser.add_argument("scans", nargs="*", metavar="NAME=CT_FOLDER[:COUNT]", help="reconstructions of one scan")
    options = parser.parse_args()
    if options.what == "phantoms":
        FIGURES.write_text(json.dumps(measure_phantoms(), indent=1) + "\n", "utf-8")
    elif options.what == "scans":
        print(make_table(measure_scans(dict(given.partition("=")[::2] for given in options.scans))))
    else:
        table = make_table(json.loads(FIGURES.read_text("utf-8")))
        PAGE.write_text(put_table(PAGE.read_text("utf-8"), TABLE, table), "utf-8")


if __name__ == "__main__":
    main()
