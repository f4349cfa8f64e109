"""Puts scripts/bench on the path, and results that are made up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[2] / "scripts" / "bench"

POCL = {
    "platform": "Portable Computing Language",
    "name": "pthread-skylake-avx512-Some CPU",
    "type": "cpu",
    "driver": "3.1+debian",
}


def spread_of(median: float, *, half: float = 0.1) -> dict[str, float]:
    """Quartiles `half` below and above a median, and extremes twice as far."""
    return {
        "median": median,
        "q1": median - half,
        "q3": median + half,
        "min": median - 2 * half,
        "max": median + 2 * half,
    }


def make_result(case: str = "isosurface-cold", *, given: str = "spine149", ratio: float = 2.0) -> dict[str, Any]:
    """A result of a case: clrecon took 30 ms and its peer 60 ms, whatever `ratio` says."""
    side = {"pairs": 5, "clrecon_s": spread_of(0.03, half=0.001), "peer_s": spread_of(0.06, half=0.001)}
    return {
        "schema": 1,
        "case": case,
        "input": {"name": given, "made_up": True},
        "device": POCL,
        "parameters": {"hu": 226.0, "peer_threads": 2},
        "triangles": 1_234_567,
        "ratios": {"all_threads": spread_of(ratio)},
        "sides": {"all_threads": {**side, "ratio": spread_of(ratio)}},
    }


def make_scaling_result() -> dict[str, Any]:
    """A result of four sizes, at each of which clrecon takes a third of the time of its peer."""

    def point(number: int) -> dict[str, Any]:
        return {
            "slices": 64 * number,
            "voxels": 10_000_000 * number,
            "triangles": 500_000 * number,
            "hu": 1000.0 - 100 * number,
            "clrecon_s": spread_of(0.01 * number, half=0.001),
            "peer_s": spread_of(0.03 * number, half=0.001),
        }

    line = {"slope": 1e-9, "intercept": 0.0, "r2": 1.0}
    points = [point(number) for number in range(1, 5)]
    fits = {over: {"clrecon": line, "peer": {**line, "slope": 3e-9}} for over in ("voxels", "triangles")}
    return {**make_result("scaling"), "sizes": points, "levels": points, "fits": fits}
