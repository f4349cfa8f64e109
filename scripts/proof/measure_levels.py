#!/usr/bin/env python3
"""What the default level of `clrecon mesh` costs and saves beside `--hu auto`, on phantoms and on scans of your own.

    python scripts/proof/measure_levels.py phantoms
    python scripts/proof/measure_levels.py scans thorax=CT_FOLDER head=OTHER_FOLDER
    python scripts/proof/measure_levels.py page

`phantoms` measures every phantom of `level_phantoms.py` (about five minutes on one core) at the preset bone, at
`--hu auto`, at `--hu half:BONE,TISSUE` with the phantom's own materials, at the best of the levels from 100 to 1200 HU,
the surface of `--surface cortex` itself, and surfaces as others make them (`level_peers.py`); `--seed` draws other
bodies, whose figures are in phantoms_SEED; `--fitted` measures the fitted surface alone.  `scans` does what can be done
without a truth: the level that auto picks in the scan, in its two halves and in every other slice, and how the surface
differs.  Both keep their figures in docs/benchmarks/levels; `page` writes them into docs/iso_value.md.  The scans and
the fitted surfaces need an OpenCL device.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent), str(ROOT / "scripts" / "guide")]

from level_peers import PEER_LEVELS, move_to_half_heights  # noqa: E402
from level_phantoms import (  # noqa: E402
    DRY,
    KINDS_OF_SCAN,
    NOTHING,
    PHANTOMS,
    REACH_MM,
    SCANNING,
    THIN,
    Phantom,
    Profiles,
    draw_phantom,
    find_on_mesh,
    sample_profiles,
)
from marked_tables import markdown_table, put_table  # noqa: E402

from clrecon.anatomy.iso_choice import IsoChoice, choose_iso_value, half_iso_value  # noqa: E402
from clrecon.errors import ClreconError, NoSurfaceError  # noqa: E402
from clrecon.geometry import Volume  # noqa: E402
from clrecon.jobs.presets import PRESETS  # noqa: E402
from clrecon.mesh import Mesh  # noqa: E402

FIGURES = ROOT / "docs" / "benchmarks" / "levels"
PAGE = ROOT / "docs" / "iso_value.md"
TRIED = range(100, 1201, 25)
CLOSE_MM = 0.5
RULES = ("preset", "auto", "half", "best", "fitted")
FITTED_AT = {DRY: -200.0}
"""Level of the surface that is moved onto the cortex, where it is not the preset's: dry bones lie in air."""
SHARES = (0.3, 0.35, 0.4, 0.45)
"""Levels at these shares of the way from tissue to bone, both as auto measures them."""
NO_HU = ("jaw", "longbone")
"""Phantoms whose values are not HU: no surface of theirs is fitted from a level in HU."""
AT_EACH_VERTEX = "50 % at each vertex"
PEERS = (*PEER_LEVELS, AT_EACH_VERTEX)


def measure_errors(profiles: Profiles, level: float) -> dict[str, float]:
    """Measure a level: mean signed and absolute distance where it is crossed, share lost, share within `CLOSE_MM`."""
    return describe_errors(profiles.errors(level), level, float(profiles.way_mm[-1]) / REACH_MM)


def level_of_start(phantom: Phantom) -> float:
    """Return the level of the surface whose vertices are moved."""
    return FITTED_AT.get(phantom.group, PRESETS["bone"].iso_value)


def measure_peers(phantom: Phantom, volume: Volume, profiles: Profiles, surface: Mesh) -> dict[str, dict[str, float]]:
    """Measure what others make of the phantom; `surface` is that whose vertices go to 50 %."""
    measured = {name: measure_errors(profiles, find(volume)) for name, find in PEER_LEVELS.items()}
    errors, _ = find_on_mesh(profiles, move_to_half_heights(surface, volume, phantom.scale), surface.triangles)
    return {**measured, AT_EACH_VERTEX: describe_errors(errors, level_of_start(phantom), phantom.scale)}


def measure_fitted(phantom: Phantom, volume: Volume, profiles: Profiles, surface: Mesh) -> dict[str, float]:
    """Measure the surface of `clrecon mesh --surface cortex` itself, with the shares of places within 1 and 1.96 of the
    errors that it says.
    """
    import clrecon

    level, start = level_of_start(phantom), time.perf_counter()
    mesh = clrecon.fit_cortex(surface, volume)
    seconds = time.perf_counter() - start
    errors, rows = find_on_mesh(profiles, mesh.vertices, mesh.triangles)
    said = np.where(rows >= 0, mesh.values["error_mm"][mesh.triangles[rows, 0]], np.nan)
    known = np.isfinite(said) & np.isfinite(errors)
    names = {"within_error": 1.0, "within_196_errors": 1.96} if known.any() else {}
    within = {name: np.mean(np.abs(errors[known]) <= times * said[known]) for name, times in names.items()}
    constants = mesh.report["cortex"]["constants"]
    return {
        **describe_errors(errors, level, phantom.scale),
        **{name: round(float(share), 4) for name, share in within.items()},
        **{name: round(float(constants[name]), 3) for name in ("blur_mm", "blur_across_mm", "cortex_hu")},
        "seconds": round(seconds, 2),
        "triangles": mesh.triangle_count,
    }


def try_fit(phantom: Phantom, volume: Volume, profiles: Profiles, surface: Mesh) -> dict[str, Any]:
    """Measure the fitted surface, or say why there is none."""
    try:
        return measure_fitted(phantom, volume, profiles, surface)
    except NoSurfaceError as error:
        return {"refused": str(error)}


def describe_errors(errors: NDArray[np.floating], level: float, scale: float = 1.0) -> dict[str, float]:
    """Describe signed distances from the truth, NaN where there is no surface; `scale` is that of the phantom."""
    found = errors[np.isfinite(errors)]
    if not len(found):
        return {"level_hu": level, "lost_share": 1.0, "close_share": 0.0}
    return {
        "level_hu": level,
        "bias_mm": round(float(found.mean()), 4),
        "mean_mm": round(float(np.abs(found).mean()), 4),
        "p95_mm": round(float(np.percentile(np.abs(found), 95)), 4),
        "lost_share": round(1.0 - len(found) / len(errors), 4),
        "close_share": round(float((np.abs(found) <= CLOSE_MM * scale).sum() / len(errors)), 4),
    }


def with_seed(seed: int) -> list[Phantom]:
    """Return the phantoms with bodies and noise of another seed."""
    return [replace(phantom, settings={**phantom.settings, "seed": seed}) for phantom in PHANTOMS]


def choose(volume: Volume) -> tuple[IsoChoice | None, str, float]:
    """Return the choice of auto, or None, its reason or refusal, and its seconds."""
    start = time.perf_counter()
    try:
        choice = choose_iso_value(volume)
    except NoSurfaceError as error:
        return None, str(error), time.perf_counter() - start
    return choice, choice.reason, time.perf_counter() - start


def _level(choice: IsoChoice | None) -> float | None:
    return None if choice is None else choice.iso_value


def measure_phantom(phantom: Phantom, *, fitted_alone: bool = False) -> dict[str, Any]:
    """Measure all rules on one phantom, or the fitted surface; "best" has the largest share within `CLOSE_MM`."""
    import clrecon

    volume = draw_phantom(phantom)
    spacing = [round(float(step), 4) for step in volume.spacing]
    figures: dict[str, Any] = {"name": phantom.name, "group": phantom.group, "spacing_mm": spacing}
    if fitted_alone and phantom.group != NOTHING:
        profiles = sample_profiles(phantom, volume)
        surface = clrecon.extract_isosurface(volume, level_of_start(phantom))
        return {**figures, "points": len(profiles.values), "fitted": try_fit(phantom, volume, profiles, surface)}
    choice, reason, seconds = choose(volume)
    level = _level(choice)
    figures |= {"auto": {"level_hu": level, "reason": reason}, "seconds": round(seconds, 3)}
    if phantom.group == NOTHING:
        return figures
    profiles = sample_profiles(phantom, volume)
    figures["points"] = len(profiles.values)
    half = half_iso_value(phantom.bone_hu, phantom.tissue_hu).iso_value
    levels = {"preset": PRESETS["bone"].iso_value, "auto": level, "half": half}
    tried = {float(hu): measure_errors(profiles, float(hu)) for hu in TRIED}
    for rule, hu in levels.items():
        if hu is not None:
            figures[rule] = {**figures.get(rule, {}), **measure_errors(profiles, hu)}
    figures["best"] = max(tried.values(), key=lambda one: one["close_share"])
    surface = clrecon.extract_isosurface(volume, level_of_start(phantom))
    figures["peers"] = measure_peers(phantom, volume, profiles, surface)
    figures["fitted"] = try_fit(phantom, volume, profiles, surface)
    if choice is not None:
        tissue, way = choice.tissue_hu, choice.bone_hu - choice.tissue_hu
        figures["shares"] = {f"{share:g}": measure_errors(profiles, round(tissue + share * way)) for share in SHARES}
    figures["fixed"] = {f"{hu:g}": tried[hu] for hu in (150.0, 225.0, 250.0, 300.0, 350.0, 400.0)}
    return figures


def measure_scan(name: str, folder: Path) -> dict[str, Any]:
    """Measure a scan without a truth: the choice, its steadiness, and both surfaces."""
    import clrecon

    start = time.perf_counter()
    try:
        volume = clrecon.read_volume(folder)
    except ClreconError as error:
        return {"name": name, "refused": str(error)}
    read_s = time.perf_counter() - start
    choice, reason, seconds = choose(volume)
    level = _level(choice)
    count = len(volume.voxels)
    parts = {"lower half": volume.voxels[: count // 2], "upper half": volume.voxels[count // 2 :],
             "every other slice": volume.voxels[::2]}  # fmt: skip
    figures: dict[str, Any] = {
        "name": name,
        "shape_ijk": list(volume.voxels.shape[::-1]),
        "spacing_mm": [round(float(step), 4) for step in volume.spacing],
        "read_seconds": round(read_s, 3),
        "choose_seconds": round(seconds, 3),
        "auto": {"level_hu": level, "reason": reason},
        "parts_hu": {
            part: _level(choose(Volume(voxels, np.eye(4), volume.report))[0])
            for part, voxels in parts.items()
            if len(voxels)
        },
    }
    for rule, hu in (("preset", PRESETS["bone"].iso_value), ("auto", level)):
        if hu is not None:
            figures[rule] = {**figures.get(rule, {}), "level_hu": hu, **_measure_surface(volume, hu)}
    if level is not None and "refused" not in figures["preset"]:
        figures["moved_mm"] = _moved(volume, PRESETS["bone"].iso_value, level)
    return figures


def _measure_surface(volume: Volume, hu: float) -> dict[str, Any]:
    import clrecon

    try:
        quality = clrecon.extract_isosurface(volume, hu).quality()
    except ClreconError as error:
        return {"refused": str(error)}
    return {name: quality[name] for name in ("components", "volume_ml", "area_mm2", "triangles", "closed")}


def _moved(volume: Volume, one: float, other: float) -> float:
    """Median distance from the surface at `one` to that at `other`, mm."""
    import clrecon
    from clrecon.mesh.compare.distances import SurfaceDistance, sample_surface

    first, second = (clrecon.extract_isosurface(volume, hu) for hu in (other, one))
    points = sample_surface(first.vertices, first.triangles, 5000)
    return round(float(np.median(SurfaceDistance(second.vertices, second.triangles)(points))), 4)


def summarise(figures: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return means, the worst case, and the spread over one body's scans, by rule: of all with bone but other kinds."""
    summary = {}
    with_bone = [one for one in figures if "best" in one and one["group"] not in (KINDS_OF_SCAN, THIN)]
    shares = [f"{100.0 * float(share):.0f} % of the way" for share in with_bone[0]["shares"]]
    flat = [
        {**one, **{f"{hu} HU": row for hu, row in one["fixed"].items()},
         **dict(zip(shares, one.get("shares", {}).values(), strict=False)), **one["peers"]}
        for one in with_bone
    ]  # fmt: skip
    for rule in (*RULES, *PEERS, *(f"{hu} HU" for hu in with_bone[0]["fixed"]), *shares):
        rows = [one.get(rule, {}) for one in flat]
        measured = [row for row in rows if "bias_mm" in row]
        same = [row["bias_mm"] for row, one in zip(rows, with_bone, strict=True)
                if one["group"] == SCANNING and "bias_mm" in row]  # fmt: skip
        summary[rule] = {
            "measured": len(measured),
            "mean_mm": round(float(np.mean([row["mean_mm"] for row in measured])), 3),
            "worst_mm": max(row["mean_mm"] for row in measured),
            "lost_share": round(float(np.mean([row["lost_share"] for row in measured])), 4),
            "worst_lost_share": max(row["lost_share"] for row in measured),
            "close_share": round(float(np.mean([row["close_share"] for row in measured])), 4),
            "spread_of_bias_mm": round(float(np.std(same)), 3),
        }
    return summary


# --- tables ---
def _cell(figures: dict[str, Any], digits: int = 2) -> str:
    if "bias_mm" not in figures:
        return "refused" if figures.get("level_hu") is None else "none"
    lost, close = 100.0 * figures["lost_share"], 100.0 * figures["close_share"]
    return f"{figures['level_hu']:.0f}: {figures['bias_mm']:+.{digits}f}, {lost:.0f} %, {close:.0f} %"


def phantom_table(figures: Sequence[dict[str, Any]]) -> str:
    """Return the table of phantoms."""
    head = ("phantom", "preset bone", "auto", "half", "best", "fitted to the cortex", *PEERS)
    rows = []
    for one in figures:
        digits = 2 if min(one["spacing_mm"]) > 0.2 else 4
        measured = {**one, **one.get("peers", {})}
        cells = [_cell(measured[rule], digits) if rule in measured else "" for rule in (*RULES, *PEERS)]
        rows.append((one["name"], *cells))
    return markdown_table(head, rows)


def error_table(bodies: dict[str, Sequence[dict[str, Any]]]) -> str:
    """Return the table of the errors that fits state, by seed of the bodies: shares of places within them."""
    rows = []
    for seed, figures in bodies.items():
        for title, others in (("in the means above", False), ("other kinds of scan, thin walls", True)):
            fits = [
                one["fitted"] for one in figures
                if (one["group"] in (KINDS_OF_SCAN, THIN)) == others and one["name"] not in NO_HU
                and "within_error" in one.get("fitted", {})
            ]  # fmt: skip
            within = [fit["within_196_errors"] for fit in fits]
            means = [np.mean([fit["within_error"] for fit in fits]), np.mean(within), min(within)]
            rows.append((seed, title, len(fits), *(f"{100.0 * share:.0f} %" for share in means)))
    head = ("seed", "phantoms", "number", "within 1 estimated error", "within 1.96 estimated errors",
            "within 1.96 in the worst phantom")  # fmt: skip
    return markdown_table(head, rows)


def summary_table(figures: Sequence[dict[str, Any]]) -> str:
    """Return the table over all phantoms."""
    head = ("level", "mean distance, mm", "in the worst phantom, mm", "lost", "lost in the worst phantom",
            "within 0.5 mm", "standard deviation over ten scans of one body, mm")  # fmt: skip
    rows = []
    for rule, row in summarise(figures).items():
        rows.append((
            rule, f"{row['mean_mm']:.2f}", f"{row['worst_mm']:.2f}", f"{100 * row['lost_share']:.1f} %",
            f"{100 * row['worst_lost_share']:.0f} %", f"{100 * row['close_share']:.0f} %",
            f"{row['spread_of_bias_mm']:.2f}",
        ))  # fmt: skip
    return markdown_table(head, rows)


def _number(value: Any) -> str:
    return "refused" if value is None else f"{value:.0f}" if value >= 10.0 else f"{value:g}"


def scan_table(figures: Sequence[dict[str, Any]]) -> str:
    """Return the table of scans."""
    head = ("scan", "auto, HU", "auto in each half; in every second slice, HU", "volume at 200 HU; at auto",
            "components at 200 HU; at auto", "distance of the two surfaces (median)")  # fmt: skip
    rows: list[tuple[str, ...]] = []
    for one in figures:
        if "refused" in one:
            rows.append((one["name"], one["refused"], *[""] * 4))
            continue
        parts = [_number(value) for value in one["parts_hu"].values()]
        both = [one.get(rule, {}) for rule in ("preset", "auto")]
        volumes, pieces = ([row.get(name) for row in both] for name in ("volume_ml", "components"))
        moved = one.get("moved_mm")
        rows.append((
            f"{one['name']}, {' x '.join(map(str, one['shape_ijk']))}, {one['spacing_mm'][2]:.3g} mm",
            _number(one["auto"]["level_hu"]), f"{', '.join(parts[:2])}; {parts[-1]}",
            "; ".join("none" if v is None else f"{v:,.0f} ml" for v in volumes),
            "; ".join("none" if v is None else f"{v:,}" for v in pieces),
            "" if moved is None else f"{moved:.2f} mm",
        ))  # fmt: skip
    return markdown_table(head, rows)


def tables() -> dict[str, str]:
    """Return all tables of docs/iso_value.md by the names of their markers."""
    phantoms, scans = (json.loads((FIGURES / f"{name}.json").read_text("utf-8")) for name in ("phantoms", "scans"))
    others = {path.stem.removeprefix("phantoms_"): path for path in sorted(FIGURES.glob("phantoms_*.json"))}
    bodies = {"default": phantoms, **{seed: json.loads(path.read_text("utf-8")) for seed, path in others.items()}}
    return {
        "levels of phantoms": phantom_table(phantoms),
        "stated errors": error_table(bodies),
        "levels in all": summary_table(phantoms),
        "levels of scans": scan_table(scans),
    }


def write_page() -> None:
    """Write the tables into docs/iso_value.md."""
    text = PAGE.read_text("utf-8")
    for name, table in tables().items():
        text = put_table(text, name, table)
    PAGE.write_text(text, "utf-8")


def _keep(name: str, figures: Sequence[dict[str, Any]]) -> None:
    """Keep figures in place of the same ones of the same names, those of phantoms in their order."""
    FIGURES.mkdir(parents=True, exist_ok=True)
    path = FIGURES / f"{name}.json"
    before = json.loads(path.read_text("utf-8")) if path.exists() else []
    kept = {one["name"]: one for one in before}
    kept |= {one["name"]: {**kept.get(one["name"], {}), **one} for one in figures}
    order = {phantom.name: place for place, phantom in enumerate(PHANTOMS)}
    rows = sorted(kept.values(), key=lambda one: order.get(one["name"], 0))
    finite = json.loads(json.dumps(rows), parse_constant=lambda _: math.nan)
    path.write_text(json.dumps(finite, indent=1) + "\n", "utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("phantoms", "scans", "page"))
    parser.add_argument("names", nargs="*", metavar="NAME", help="phantoms, else all; of scans NAME=CT_FOLDER")
    parser.add_argument("--seed", type=int, help="of bodies other than those of the tables")
    parser.add_argument("--fitted", action="store_true", help="measure the fitted surface alone")
    options = parser.parse_args()
    if options.what == "page":
        write_page()
        return
    figures = []
    if options.what == "phantoms":
        for phantom in PHANTOMS if options.seed is None else with_seed(options.seed):
            if options.names and phantom.name not in options.names:
                continue
            figures.append(measure_phantom(phantom, fitted_alone=options.fitted))
            print(
                phantom.name,
                *(f"{rule} {_cell(figures[-1][rule])};" for rule in RULES if rule in figures[-1]),
                flush=True,
            )
    else:
        for given in options.names:
            name, _, folder = given.partition("=")
            figures.append(measure_scan(name, Path(folder)))
            print(json.dumps(figures[-1]), flush=True)
    _keep(options.what if options.seed is None else f"{options.what}_{options.seed}", figures)


if __name__ == "__main__":
    main()
