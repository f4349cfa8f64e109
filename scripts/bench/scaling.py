"""Case of scaling: is time linear in the size of the volume and of the surface?"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from isosurface import OwnSide, PeerSide
from measure import alternate, spread, summarise
from numpy.typing import NDArray
from registry import Job, case

from clrecon.proof.timing import FEWEST_PAIRS

FEWEST_SLICES = 64
POINTS = 8
MOST_TRIANGLES = 12_000_000
PAIRS_A_POINT = 7


def fit_line(x: Sequence[float], y: Sequence[float]) -> dict[str, float]:
    """Least squares y = intercept + slope x, and the share of the variance that the line explains.

    Returns ``slope, intercept, r2``; r2 is 1 for equal y.
    """
    slope, intercept = np.polyfit(x, y, 1)
    rest = np.asarray(y) - (intercept + slope * np.asarray(x))
    variance = float(np.sum((np.asarray(y) - np.mean(y)) ** 2))
    r2 = 1.0 - float(np.sum(rest**2)) / variance if variance > 0 else 1.0
    return {"slope": float(slope), "intercept": float(intercept), "r2": r2}


def choose_slices(slices: int, points: int = POINTS) -> list[int]:
    """Choose evenly spread numbers of slices, from 64 (or a quarter of few slices) to all."""
    first = FEWEST_SLICES if slices >= 2 * FEWEST_SLICES else max(slices // 4, 2)
    return sorted({round(value) for value in np.linspace(first, slices, points)})


def estimate_triangles(voxels: NDArray[Any], levels: Sequence[float]) -> list[float]:
    """Estimate the triangles of each level: two per crossed edge of the grid, counted in every n-th pair of slices.

    A surface has about twice as many triangles as vertices, and a vertex on every crossed edge.
    """
    step = max((len(voxels) - 1) // 8, 1)
    crossings = np.zeros(len(levels))
    pairs = range(0, len(voxels) - 1, step)
    for k in pairs:
        for number, level in enumerate(levels):
            inside, above = voxels[k] >= level, voxels[k + 1] >= level
            crossings[number] += np.count_nonzero(inside[1:] != inside[:-1])
            crossings[number] += np.count_nonzero(inside[:, 1:] != inside[:, :-1])
            crossings[number] += np.count_nonzero(inside != above)
    return list(2.0 * crossings * (len(voxels) - 1) / max(len(pairs), 1))


def choose_levels(voxels: NDArray[Any], points: int = POINTS, most: float = MOST_TRIANGLES) -> list[float]:
    """Choose whole iso values whose surfaces go from few to at most `most` triangles in even steps.

    They start at 0 HU: above lie the bones and, in the noise of a tissue, the densest surface.
    """
    sample = voxels[:: max(len(voxels) // 8, 1), ::4, ::4]
    low, high = max(float(sample.min()), 0.0), float(np.percentile(sample, 99.9))
    candidates = np.unique(np.rint(np.linspace(low, max(high, low + points), 96)))
    falling = candidates[::-1]
    counts = np.array(estimate_triangles(voxels, list(falling)))
    # From sparse to dense: the largest count so far replaces smaller ones, so that counts only rise.
    rising, first = np.unique(np.maximum.accumulate(counts), return_index=True)
    levels = falling[first]
    some = rising > 0
    if not some.any():
        return [float(falling[-1])]
    wanted = np.linspace(rising[some][0], min(rising[-1], most), points)
    return [float(round(level)) for level in np.interp(wanted, rising[some], levels[some])]


def _time_points(job: Job, points: Sequence[tuple[Any, float]]) -> list[dict[str, Any]]:
    """Time both sides at each (volume, HU), in rounds over all points, so that a slow spell affects all points alike.

    Each timed run follows an untimed run of the same point, so that memory of its size is allocated: else each point
    would also pay for pages that other points do not need.
    """
    from clrecon.operators.surface.extract import extract_isosurface

    sides: list[tuple[OwnSide, PeerSide, Any, float, list[float], list[float]]] = []
    for volume, hu in points:
        own = OwnSide(partial(extract_isosurface, volume, device=job.device, closed=False))
        sides.append((own, PeerSide(volume, job.peer_threads), volume, hu, [], []))
    start = time.perf_counter()
    for number in range(min(job.pairs, PAIRS_A_POINT)):
        if number >= FEWEST_PAIRS and time.perf_counter() - start > job.limit_s:
            break
        for own, peer, _, hu, ours, theirs in sides:
            mine, his = alternate(lambda: own.run(hu), lambda: peer.run(hu), 1)  # noqa: B023
            ours += mine
            theirs += his
    return [
        {
            **summarise(ours, theirs),
            "hu": hu,
            "slices": len(volume.voxels),
            "voxels": volume.voxels.size,
            "vertices": own.counts[-1][0],
            "triangles": own.counts[-1][1],
            "equal_counts": own.counts[-1] == peer.counts[-1],
        }
        for own, peer, volume, hu, ours, theirs in sides
    ]


def _fit(found: Sequence[dict[str, Any]], over: str) -> dict[str, dict[str, float]]:
    x = [point[over] for point in found]
    return {side: fit_line(x, [point[f"{side}_s"]["median"] for point in found]) for side in ("clrecon", "peer")}


@case("scaling", "time over the number of slices, and over the number of triangles from sparse to dense iso values")
def measure_scaling(job: Job) -> dict[str, Any]:
    """Time the first n slices of the input at the iso value; then several iso values on at most 149 slices."""
    from clrecon.geometry import Volume
    from clrecon.operators.surface.extraction import prepare_isosurface

    volume = job.input.volume()
    prepare_isosurface(job.device, volume.voxels.dtype)
    by_size = [(Volume(volume.voxels[:n], volume.affine), job.hu) for n in choose_slices(len(volume.voxels))]
    part = Volume(volume.voxels[:149], volume.affine)
    sizes = _time_points(job, by_size)
    levels = _time_points(job, [(part, hu) for hu in dict.fromkeys(choose_levels(part.voxels))])
    levels.sort(key=lambda point: point["triangles"])
    figures: dict[str, Any] = {"sizes": sizes, "levels": levels, "ratios": {}, "fits": {}}
    figures["ratios"]["over_sizes"] = spread([point["ratio"]["median"] for point in sizes])
    figures["ratios"]["over_levels"] = spread([point["ratio"]["median"] for point in levels])
    if len(sizes) > 2:
        figures["fits"]["voxels"] = _fit(sizes, "voxels")
    if len(levels) > 2:
        figures["fits"]["triangles"] = _fit(levels, "triangles")
    return figures
