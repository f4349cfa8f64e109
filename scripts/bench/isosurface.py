"""Surfaces in one process, beside vtkFlyingEdges3D on the same array at the same level."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from floors import active_brick_share, copy_bandwidth, floor_bytes, share_of_floor
from measure import Costs, alternate, medians, summarise
from registry import Job, case

__all__ = ["LEVEL_STEPS", "OwnSide", "PeerSide", "measure_cold", "measure_resident"]

LEVEL_STEPS = (0, 150, 40, 250, 80, 300, 20)
"""HU above the iso value that `isosurface-resident` walks through; every round starts one HU higher, so that no iso
value is ever asked for twice and nothing can be kept by value."""

PAGES = (
    "outputs of a call are freed before the next one; whether the C library then gives the same pages back or the"
    " system maps new ones is in the page_faults of each side (about none: recycled)"
)


class OwnSide:
    """Runs clrecon and keeps what its meshes say."""

    def __init__(self, extract: Callable[[float], Any]):
        self._extract = extract
        self.costs = Costs()
        self.kernels: list[dict[str, float]] = []
        self.parts: list[dict[str, float]] = []
        self.counts: list[tuple[int, int]] = []
        self.device_bytes: dict[str, int] | None = None

    def run(self, hu: float) -> float:
        """Seconds of one surface; the mesh is freed before this returns."""
        start = time.perf_counter()
        mesh = self.costs.measure(lambda: self._extract(hu))
        seconds = time.perf_counter() - start
        self.kernels.append(mesh.report.get("kernel_seconds", {}))
        self.parts.append(mesh.report.get("seconds", {}))
        self.device_bytes = mesh.report.get("device_bytes")
        self.counts.append((len(mesh.vertices), len(mesh.triangles)))
        return seconds

    def describe(self) -> dict[str, Any]:
        """Medians over all runs but the first, which warms up."""
        return {
            "kernel_seconds": medians(self.kernels[1:]),
            "seconds_by_part": medians(self.parts[1:]),
            "device_bytes": self.device_bytes,
            "cost": self.costs.describe(),
        }


class PeerSide:
    """Runs vtkFlyingEdges3D."""

    def __init__(self, volume: Any, threads: int):
        from clrecon.pipeline.peer import FlyingEdges

        self._peer = FlyingEdges(volume, threads)
        self._volume = volume
        self.costs = Costs()
        self.counts: list[tuple[int, int]] = []

    def run(self, hu: float) -> float:
        """Seconds of one surface at the level where clrecon puts it; the output is freed before this returns."""
        level = level_of(self._volume, hu)
        done = self.costs.measure(lambda: self._peer.run(level))
        self.counts.append((done.vertices, done.triangles))
        return float(done.seconds)

    def describe(self) -> dict[str, Any]:
        """What it is and what its runs cost."""
        name = f"vtkFlyingEdges3D {self._peer.version}, normals on, scalars and gradients off"
        return {"name": name, "threads": self._peer.threads, "cost": self.costs.describe()}


def level_of(volume: Any, hu: float) -> float:
    """Where the surface lies between two voxels: k - 0.5 for whole HU.  Asks one voxel: the caches stay as they are."""
    from clrecon.geometry import Volume
    from clrecon.geometry.field import choose_iso_rule

    return float(choose_iso_rule(Volume(volume.voxels[:1, :1, :1], volume.affine), hu, closed=False).iso_level)


def describe_surface(
    job: Job, volume: Any, counts: tuple[int, int], seconds: float, read_share: float
) -> dict[str, Any]:
    """Counts, rates and the share of the physical floor."""
    bandwidth = copy_bandwidth(job.device)
    vertices, triangles = counts
    moved = floor_bytes(
        volume.voxels.size, volume.voxels.itemsize, vertices, triangles, job.device.type == "cpu", read_share
    )
    return {
        "vertices": vertices,
        "triangles": triangles,
        "mvoxels_per_s": 1e-6 * volume.voxels.size / seconds,
        "mtriangles_per_s": 1e-6 * triangles / seconds,
        "copy_bytes_per_s": bandwidth,
        "floor_bytes": moved,
        "floor_read_share": read_share,
        "percent_of_floor": share_of_floor(moved, bandwidth, seconds),
        "pages": PAGES,
    }


def compare_sides(job: Job, own: OwnSide, volume: Any, hus: Callable[[], Iterator[float]]) -> dict[str, Any]:
    """Time clrecon against flying edges with all threads, then against the sequential default in fewer pairs."""
    figures: dict[str, Any] = {"ratios": {}, "sides": {}}
    for name, threads, pairs in (("all_threads", job.peer_threads, job.pairs), ("sequential", 1, min(job.pairs, 7))):
        if name == "sequential" and job.peer_threads == 1:
            continue
        peer = PeerSide(volume, threads)
        mine, his = hus(), hus()
        start = len(own.counts)
        ours, theirs = alternate(lambda: own.run(next(mine)), lambda: peer.run(next(his)), pairs, limit_s=job.limit_s)  # noqa: B023
        summary = summarise(ours, theirs)
        figures["ratios"][name] = summary["ratio"]
        figures["sides"][name] = {
            **summary,
            "peer": peer.describe(),
            "equal_counts": own.counts[start:] == peer.counts,
            "ours": ours,
            "theirs": theirs,
        }
    return figures


@case("isosurface-cold", "host volume to host mesh, kernels built, against flying edges with all cores")
def measure_cold(job: Job) -> dict[str, Any]:
    """One process; every call uploads the volume and extracts vertices, normals and triangles of an open surface."""
    from clrecon.operators.isosurface import extract_isosurface, prepare_isosurface

    volume = job.input.volume()
    prepare_isosurface(job.device, volume.voxels.dtype)
    own = OwnSide(lambda hu: extract_isosurface(volume, hu, job.device, closed=False))

    def same() -> Iterator[float]:
        while True:
            yield job.hu

    figures = compare_sides(job, own, volume, same)
    seconds = figures["sides"]["all_threads"]["clrecon_s"]["median"]
    return {**figures, **own.describe(), **describe_surface(job, volume, own.counts[-1], seconds, 1.0)}


@contextmanager
def open_extractor(volume: Any, device: Any) -> Iterator[tuple[Callable[[float], Any], bool]]:
    """A function HU -> mesh on a resident volume, and whether it is only a stand-in that uploads every time."""
    from clrecon.operators import isosurface

    extractor_type = getattr(isosurface, "SurfaceExtractor", None)
    if extractor_type is None:
        yield lambda hu: isosurface.extract_isosurface(volume, hu, device, closed=False), True
        return
    with extractor_type(volume, device) as extractor:
        yield lambda hu: extractor.extract(hu, closed=False), False


def walk_levels(hu: float) -> Iterator[float]:
    """Iso values that never come twice (in 20 rounds, see `LEVEL_STEPS`)."""
    number = 0
    while True:
        yield hu + LEVEL_STEPS[number % len(LEVEL_STEPS)] + number // len(LEVEL_STEPS)
        number += 1


@case("isosurface-resident", "a new iso value on a volume that is on the device, against flying edges")
def measure_resident(job: Job) -> dict[str, Any]:
    """Both sides walk through the same iso values, none of them twice."""
    from clrecon.operators.isosurface import prepare_isosurface

    volume = job.input.volume()
    prepare_isosurface(job.device, volume.voxels.dtype)
    start = time.perf_counter()
    with open_extractor(volume, job.device) as (extract, is_stand_in):
        opened = time.perf_counter() - start
        own = OwnSide(extract)
        figures = compare_sides(job, own, volume, lambda: walk_levels(job.hu))
    side = figures["sides"]["all_threads"]
    asked = walk_levels(job.hu)
    levels = [next(asked) for _ in own.counts[: side["pairs"] + 1]]
    # The floor is that of the first iso value; its runs are those at the places 0, 7, 14 of the walk.
    first = [seconds for hu, seconds in zip(levels[1:], side["ours"], strict=False) if hu - job.hu < 20]
    seconds = medians([{"s": value} for value in first or side["ours"]])["s"]
    share = active_brick_share(volume.voxels, job.hu)
    return {
        **figures,
        **own.describe(),
        **describe_surface(job, volume, own.counts[0], seconds, share),
        "stand_in": is_stand_in,
        "open_seconds": opened,
        "levels_hu": levels,
    }
