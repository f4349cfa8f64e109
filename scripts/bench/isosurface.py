"""Cases of surfaces in one process, beside vtkFlyingEdges3D on the same array at the same level."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import islice, repeat
from typing import Any

from floors import active_brick_share, copy_bandwidth, floor_bytes, kernel_bytes, share_of_floor, usable_bandwidth
from measure import Costs, alternate, medians, spread, summarise
from registry import Job, case

LEVEL_STEPS = (0, 150, 40, 250, 80, 300, 20)
"""Steps of `isosurface-resident`, HU above the iso value; every round starts one HU higher.

No iso value is used twice, so that no result can be cached."""

PAGES = (
    "all_threads, sequential: the outputs of a call are freed before the next one, so that clrecon, the C library or"
    " the system may give the same pages again; fresh_pages: all outputs are kept; page_faults count what was new"
)


class OwnSide:
    """Runs of clrecon, with the reports of its meshes."""

    def __init__(self, extract: Callable[[float], Any]):
        self._extract = extract
        self.costs = Costs()
        self.keep: list[Any] | None = None
        self.kernels: list[dict[str, float]] = []
        self.parts: list[dict[str, float]] = []
        self.counts: list[tuple[int, int]] = []
        self.device_bytes: dict[str, int] | None = None

    def run(self, hu: float) -> float:
        """Return the seconds of one surface; the mesh is freed afterwards, unless a list is given to `keep` it."""
        start = time.perf_counter()
        mesh = self.costs.measure(lambda: self._extract(hu))
        seconds = time.perf_counter() - start
        self.kernels.append(mesh.report.get("kernel_seconds", {}))
        self.parts.append(mesh.report.get("seconds", {}))
        self.device_bytes = mesh.report.get("device_bytes")
        self.counts.append((len(mesh.vertices), len(mesh.triangles)))
        if self.keep is not None:
            self.keep.append(mesh)
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
    """Runs of vtkFlyingEdges3D."""

    def __init__(self, volume: Any, threads: int):
        from clrecon.proof.bench import FlyingEdges

        self._peer = FlyingEdges(volume, threads)
        self._volume = volume
        self.costs = Costs()
        self.keep: list[Any] | None = None
        self.counts: list[tuple[int, int]] = []

    def run(self, hu: float) -> float:
        """Return the seconds of one surface at clrecon's level; the output is freed or kept as in `OwnSide`."""
        level = level_of(self._volume, hu)
        done = self.costs.measure(lambda: self._peer.run(level, self.keep))
        self.counts.append((done.vertices, done.triangles))
        return float(done.seconds)

    def describe(self) -> dict[str, Any]:
        """Describe the peer and the costs of its runs."""
        name = f"vtkFlyingEdges3D {self._peer.version}, normals on, scalars and gradients off"
        return {"name": name, "threads": self._peer.threads, "cost": self.costs.describe()}


def level_of(volume: Any, hu: float) -> float:
    """Return the HU of the surface between voxels: k - 0.5 for whole HU.  One voxel is read: the caches stay."""
    from clrecon.geometry import Volume
    from clrecon.geometry.iso_rule import choose_iso_rule

    return float(choose_iso_rule(Volume(volume.voxels[:1, :1, :1], volume.affine), hu, closed=False).iso_level)


def describe_surface(
    job: Job, volume: Any, side: dict[str, Any], counts: tuple[int, int], seconds: float, read_share: float
) -> dict[str, Any]:
    """Describe surfaces: counts, rates, time by kernel, and shares of the physical floor."""
    bandwidth = copy_bandwidth(job.device)
    best = usable_bandwidth(bandwidth, job.device)
    shape = (volume.voxels.size, volume.voxels.itemsize, *counts)
    moved = floor_bytes(*shape, job.device.type == "cpu", read_share)
    # The event times of some drivers are useless: no time by kernel then.
    kernels = side["clrecon"]["kernel_seconds"] if job.device.has_event_times else {}
    return {
        "vertices": counts[0],
        "triangles": counts[1],
        "mvoxels_per_s": 1e-6 * volume.voxels.size / seconds,
        "mtriangles_per_s": 1e-6 * counts[1] / seconds,
        "kernel_seconds": kernels,
        "device_bytes": side["clrecon"]["device_bytes"],
        "copy_bytes_per_s": bandwidth,
        "floor_bytes": moved,
        "floor_read_share": read_share,
        "percent_of_floor": share_of_floor(moved, best, seconds),
        "kernels_percent_of_floor": share_of_floor(moved, best, sum(kernels.values())),
        "kernel_percent_of_copy": {
            name: share_of_floor(moved_by, best, kernels[name])
            for name, moved_by in kernel_bytes(*shape).items()
            if kernels.get(name)
        },
        "pages": PAGES,
    }


def compare_sides(
    job: Job, make_own: Callable[[], OwnSide], volume: Any, hus: Callable[[], Iterator[float]], *, fresh: bool
) -> dict[str, Any]:
    """Time clrecon against flying edges with all threads; then, in fewer pairs, against the sequential default, and
    (`fresh`) with all threads again while every output is kept."""
    variants = [("all_threads", job.peer_threads, job.pairs)]
    if job.peer_threads > 1:
        variants.append(("sequential", 1, min(job.pairs, 7)))
    if fresh:
        variants.append(("fresh_pages", job.peer_threads, min(job.pairs, 5)))
    figures: dict[str, Any] = {"ratios": {}, "sides": {}}
    for name, threads, pairs in variants:
        own, peer = make_own(), PeerSide(volume, threads)
        if name == "fresh_pages":
            own.keep, peer.keep = [], []
        summary, ours, theirs = _alternate_sides(own, peer, hus, pairs, job.limit_s)
        figures["ratios"][name] = summary["ratio"]
        figures["sides"][name] = {
            **summary,
            "clrecon": own.describe(),
            "peer": peer.describe(),
            "equal_counts": own.counts == peer.counts,
            "counts": own.counts,
            "ours": ours,
            "theirs": theirs,
        }
    return figures


def _alternate_sides(
    own: OwnSide, peer: PeerSide, hus: Callable[[], Iterator[float]], pairs: int, limit_s: float
) -> tuple[dict[str, Any], list[float], list[float]]:
    mine, his = hus(), hus()
    ours, theirs = alternate(lambda: own.run(next(mine)), lambda: peer.run(next(his)), pairs, limit_s=limit_s)
    return summarise(ours, theirs), ours, theirs


@case("isosurface-cold", "host volume to host mesh, kernels built, against flying edges with all cores")
def measure_cold(job: Job) -> dict[str, Any]:
    """One process; every call uploads the volume and extracts vertices, normals and triangles of an open surface."""
    from clrecon.operators.surface.extract import extract_isosurface
    from clrecon.operators.surface.extraction import prepare_isosurface

    volume = job.input.volume()
    prepare_isosurface(job.device, volume.voxels.dtype)

    def make_own() -> OwnSide:
        return OwnSide(lambda hu: extract_isosurface(volume, hu, device=job.device, closed=False))

    figures = compare_sides(job, make_own, volume, lambda: repeat(job.hu), fresh=True)
    side = figures["sides"]["all_threads"]
    return {**figures, **describe_surface(job, volume, side, side["counts"][0], side["clrecon_s"]["median"], 1.0)}


def walk_levels(hu: float) -> Iterator[float]:
    """Iso values that never come twice (in 20 rounds, see `LEVEL_STEPS`)."""
    number = 0
    while True:
        yield hu + LEVEL_STEPS[number % len(LEVEL_STEPS)] + number // len(LEVEL_STEPS)
        number += 1


@case("isosurface-resident", "a new iso value on a volume that is on the device, against flying edges")
def measure_resident(job: Job) -> dict[str, Any]:
    """Time both sides at the same iso values, none of them twice."""
    from clrecon.operators.surface.extract import SurfaceExtractor
    from clrecon.operators.surface.extraction import prepare_isosurface

    volume = job.input.volume()
    prepare_isosurface(job.device, volume.voxels.dtype)
    with SurfaceExtractor(volume, device=job.device) as extractor:

        def make_own() -> OwnSide:
            return OwnSide(lambda hu: extractor.extract(hu, closed=False))

        # The untimed first run of each side puts the volume on the device.
        figures = compare_sides(job, make_own, volume, lambda: walk_levels(job.hu), fresh=False)
    side = figures["sides"]["all_threads"]
    levels = list(islice(walk_levels(job.hu), side["pairs"] + 1))
    # The floor is that of the iso value itself; runs at it (and some HU above) are every seventh of the walk.
    first = [
        seconds for hu, seconds in zip(levels[1:], side["ours"], strict=True) if hu - job.hu < min(LEVEL_STEPS[1:])
    ]
    seconds = spread(first or side["ours"])["median"]
    share = active_brick_share(volume.voxels, job.hu)
    return {**figures, **describe_surface(job, volume, side, side["counts"][0], seconds, share), "levels_hu": levels}
