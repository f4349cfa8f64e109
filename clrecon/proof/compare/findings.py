"""The report of a comparison, and what its numbers say, one sentence a finding, but for missing numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from clrecon.jobs.run import RunReport
from clrecon.system.records import Record
from clrecon.system.text import list_names


def seconds(value: float) -> str:
    """Write seconds with two digits that count: ``0.021``, ``0.39``, ``7.2``, ``42``."""
    if value >= 10.0:
        return f"{value:.0f}"
    if value >= 1.0:
        return f"{value:.1f}"
    return f"{value:.2f}" if value >= 0.1 else f"{value:.3f}"


def milliseconds(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 else f"{value:.1f}"


def megabytes(value: float) -> str:
    """Write bytes in MB (10^6 bytes)."""
    return f"{1e-6 * value:,.0f}"


def count(value: float) -> str:
    return f"{value:,.0f}"


def share(value: float) -> str:
    """Write a share of 1, such as a Dice coefficient; 1 alone is exactly 1."""
    return "1" if value == 1.0 else f"{min(value, 0.99999):.4f}"


def signed(value: float, digits: int = 3) -> str:
    return f"{value:+.{digits}f}"


def ratio(value: float) -> str:
    """Write a ratio of two positive numbers: ``1.3``, ``54``."""
    if value >= 10.0:
        return f"{value:,.0f}"
    return f"{value:.1f}" if math.isfinite(value) else "many"


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodRecord(Record):
    """A row of the comparison; docs/contract.md and docs/compare.md explain the measures.

    name, title, what, makes: See `clrecon.proof.compare.methods.Compared`.
    state: {"done", "failed", "declined"}
    first_s, warm_s: From voxels in memory to the result in memory, in a new process and again (median); no reading, no
        drawing.
    first_parts_s, warm_parts_s: By part: ``read``, ``build``, ``upload``, ``kernels``, ``host``, ``download``,
        ``draw``.
    kernels_ms: Of the warm run, as the device tells it; None without kernels.
    memory_bytes, memory_own_bytes: Most memory of its process, the interpreter and the scan included, and what of it
        the process did not have before it began.
    reasons: Why a measure is missing.
    small: Of ray casting: ``size``, ``first_s``, ``warm_s`` of a small picture, and ``scaled_s``, those of the full one
        reckoned from it where it was not made.
    """

    name: str
    title: str
    what: str
    makes: str
    peer: str
    state: str
    error: str | None
    triangles: int | None
    vertices: int | None
    points: int | None
    first_s: float | None
    warm_s: float | None
    warm_runs: int
    first_parts_s: Mapping[str, float]
    warm_parts_s: Mapping[str, float]
    kernels_ms: float | None
    memory_bytes: int | None
    memory_own_bytes: int | None
    cells_visited: int | None
    cells_all: int | None
    growing: Mapping[str, Any] | None
    quality: Mapping[str, Any] | None = None
    cells: Mapping[str, Any] | None = None
    slices: Mapping[str, Any] | None = None
    surfaces: Mapping[str, Any] | None = None
    truth: Mapping[str, Any] | None = None
    points_mm: Mapping[str, Any] | None = None
    pictures: Mapping[str, Any] | None = None
    reasons: Mapping[str, str]
    small: Mapping[str, Any] | None
    picture: str | None = None
    difference: str | None = None

    @property
    def is_done(self) -> bool:
        """True where the method made something."""
        return self.state == "done"


@dataclass(frozen=True, eq=False, kw_only=True)
class CompareReport(RunReport):
    """The report of a comparison: a `RunReport` with further entries, which docs/contract.md explains."""

    SCHEMA = "compare"

    date: str
    shape_ijk: list[int]
    spacing_mm: list[float]
    iso_value_hu: float
    iso_level_hu: float
    iso_value_reason: str
    closed_at_border: bool
    reference: str
    repeat: int
    with_truth: bool
    processor: str
    cores: int
    free_cores: float
    versions: Mapping[str, str]
    read_s: Mapping[str, float]
    findings: list[str]
    methods: list[MethodRecord]
    view: str
    size: list[int]
    slices: list[dict[str, Any]]
    paper: Mapping[str, Any] | None


SAME_MM = 1e-3
"""Surfaces whose 95th percentile of distances is below this are the same."""

_SAME_CELLS, NEAR_MM = 0.999, 2.0
"""Dice of cells from which on methods cut the same ones, and the largest distance then."""

_SLOWER, _MORE_MEMORY = 1.25, 1.25
"""Ratios from which on a method counts as worse than the reference: below, runs of one method differ as much."""

_LOWER_DICE, _LOWER_SSIM = 5e-4, 5e-3
_WIDER_MM = 5e-3


def find_findings(methods: Sequence[MethodRecord], reference: str, *, with_truth: bool) -> list[str]:
    """Return the findings, each a sentence; `reference` is the name of the method that others are compared with."""
    done = {method.name: method for method in methods if method.is_done}
    lines = [*_of_time(done, reference), *_of_same(done, reference), *_of_golden(done), *_of_growing(done, reference)]
    lines += [*_of_decimation(done, reference), *_of_clouds(done, with_truth), *_of_rays(done)]
    lines += _of_truth(done) if with_truth else ()
    missing = [method.title for method in methods if not method.is_done]
    if missing:
        lines.append(f"{list_names(missing)} did not run: the table says why.")
    return lines


Rows = Mapping[str, MethodRecord]


def _of_time(done: Rows, reference: str) -> Iterator[str]:
    timed = [m for m in done.values() if m.makes == "mesh" and m.warm_s]
    if len(timed) < 2:
        return
    fastest, slowest = (pick(timed, key=lambda m: m.warm_s or 0.0) for pick in (min, max))
    assert fastest.warm_s and slowest.warm_s and fastest.first_s
    yield (
        f"{fastest.title} is the fastest surface: {milliseconds(1e3 * fastest.warm_s)} ms from voxels to mesh when"
        f" warm, {seconds(fastest.first_s)} s the first time; {slowest.title} is the slowest with"
        f" {seconds(slowest.warm_s)} s, {ratio(slowest.warm_s / fastest.warm_s)} times as long."
    )
    reference_row, peers = done.get(reference), [m for m in timed if m.peer]
    if reference_row is None or reference_row.peer or not reference_row.warm_s or not peers:
        return
    best = min(peers, key=lambda m: m.warm_s or 0.0)
    assert best.warm_s
    times = best.warm_s / reference_row.warm_s
    sentence = (
        f"{reference_row.title} is {ratio(times)} times as fast"
        if times >= 1.0
        else f"{reference_row.title} takes {ratio(1.0 / times)} times as long"
    )
    yield f"{sentence} as the fastest peer, {best.title} ({milliseconds(1e3 * best.warm_s)} ms), when both are warm."


def _of_same(done: Rows, reference: str) -> Iterator[str]:
    reference_row = done.get(reference)
    others = [m for m in done.values() if m.name != reference and m.surfaces]
    same = [m for m in others if m.surfaces and m.surfaces["hd95_mm"] < SAME_MM]
    near = [m for m in others if m not in same and m.cells and m.cells["dice"] >= _SAME_CELLS and m.surfaces]
    near = [m for m in near if m.surfaces and m.surfaces["max_mm"] < NEAR_MM]
    if reference_row is None:
        return
    if same:
        give = "gives" if len(same) == 1 else "give"
        yield f"{list_names([m.title for m in same])} {give} the surface of {reference_row.title}, to 0.001 mm."
    if near:
        far = max(m.surfaces["hd95_mm"] for m in near if m.surfaces)
        yield (
            f"{list_names([m.title for m in near])} pass{'es' if len(near) == 1 else ''} through the same cells as"
            f" {reference_row.title} and divide{'s' if len(near) == 1 else ''} them into other triangles: HD95 up to"
            f" {far:.3f} mm."
        )


def _of_golden(done: Rows) -> Iterator[str]:
    linear, golden = done.get("i-mc"), done.get("i-mc-golden")
    if not (linear and golden and linear.slices and golden.slices and linear.warm_s and golden.warm_s):
        return
    lower = golden.slices["dice"] < linear.slices["dice"] - _LOWER_DICE
    times = golden.warm_s / linear.warm_s
    spent = "takes as long as with linear ones"
    if not 1.0 / _SLOWER < times < _SLOWER:
        spent = f"takes {ratio(times)} times as long" if times > 1.0 else f"takes {100.0 * times:.0f} % of the time"
    yield (
        f"With vertices at the golden section I-MC {spent}, and its sub-voxel Dice {'falls' if lower else 'goes'}"
        f" from {share(linear.slices['dice'])} to {share(golden.slices['dice'])}; Dice on the voxels' own lattice,"
        f" {share(linear.slices['voxel_dice'])} and {share(golden.slices['voxel_dice'])}, and overlap of cells cannot"
        " see where on its edge a vertex lies."
    )


def _of_growing(done: Rows, reference: str) -> Iterator[str]:
    grown, whole = done.get("i-mc"), done.get(reference)
    if not (grown and grown.cells_visited and grown.cells_all and grown.growing):
        return
    left = grown.growing["cells_left_out_share"]
    clause = (
        f" and leaves out {100.0 * left:.1f} % of those that the surface passes through: the parts that are too small"
        " to be grown from."
        if left > 0.0
        else " and leaves nothing out."
    )
    yield (
        f"I-MC visits {count(grown.cells_visited)} of {count(grown.cells_all)} cells, 1 in"
        f" {ratio(grown.cells_all / grown.cells_visited)},{clause}"
    )
    if whole and whole.name == "t-mc" and whole.warm_s and grown.warm_s:
        times = grown.warm_s / whole.warm_s
        yield (
            f"I-MC takes {ratio(times)} times as long as T-MC here: fewer visited cells are not less time on a device."
            if times >= 1.0
            else f"I-MC takes {100.0 * times:.0f} % of the time of T-MC here."
        )


def _of_decimation(done: Rows, reference: str) -> Iterator[str]:
    whole = done.get(reference)
    for name in ("g-mc", "s-mc"):
        row = done.get(name)
        if not (row and whole and row.triangles and whole.triangles and row.surfaces and row.slices):
            continue
        closed = "closed" if (row.quality or {}).get("closed") else "no longer closed"
        yield (
            f"{row.title} keeps {100.0 * row.triangles / whole.triangles:.0f} % of the triangles at a sub-voxel"
            f" Dice of {share(row.slices['dice'])}, HD95 {row.surfaces['hd95_mm']:.3f} mm and at most"
            f" {row.surfaces['max_mm']:.2f} mm, {closed}, in {seconds(row.warm_s or 0.0)} s."
        )


def _of_clouds(done: Rows, with_truth: bool) -> Iterator[str]:
    cloud = done.get("cloud")
    if not (cloud and cloud.points and cloud.points_mm):
        return
    figures = cloud.points_mm
    far = figures["to_reference_mm"]
    clause = f", {far['mean']:.2f} mm from the reference surface on average" if far else ""
    scatter = (
        f" and scattered by {figures['scatter_mm']:.2f} mm about the truth" if figures["scatter_mm"] is not None else ""
    )
    yield (
        f"The cloud has {count(cloud.points)} points{clause}{scatter}: they are centres of voxels, not places of the"
        " surface."
    )
    around = done.get("cloud-surface")
    if around and around.slices and around.surfaces:
        change = around.surfaces["volume_change_percent"]
        volume = "" if change is None else f", and its volume differs by {change:+.1f} %"
        yield f"The surface around the cloud has a sub-voxel Dice of {share(around.slices['dice'])}{volume}."


def _of_rays(done: Rows) -> Iterator[str]:
    rays, twin = done.get("rays"), done.get("rays-cpu")
    if rays and twin and rays.small and twin.small:
        width, height = twin.small["size"]
        times = twin.small["warm_s"] / rays.small["warm_s"]
        yield (
            f"Ray casting on the device is {ratio(times)} times as fast as in numpy at {width} x {height} pixels"
            f" ({seconds(rays.small['warm_s'])} and {seconds(twin.small['warm_s'])} s)."
        )


def _of_truth(done: Rows) -> Iterator[str]:
    known = [m for m in done.values() if m.truth]
    if not known:
        return
    scattered = {m.title: m.truth["scatter_mm"] for m in known if m.truth}
    best, worst = (pick(scattered, key=lambda title: scattered[title]) for pick in (min, max))
    biases = [m.truth["bias_mm"] for m in known if m.truth]
    yield (
        f"Against the true surface the level moves every surface by {min(biases):+.2f} to {max(biases):+.2f} mm; the"
        f" methods differ in scatter, from {scattered[best]:.3f} mm ({best}) to {scattered[worst]:.3f} mm ({worst})."
    )


def find_worse(method: MethodRecord, reference: MethodRecord | None) -> list[str]:
    if reference is None or not method.is_done or method.name == reference.name:
        return []
    if method.makes != "mesh":
        return ["no surface"]
    worse = []
    if method.warm_s and reference.warm_s and method.warm_s > _SLOWER * reference.warm_s:
        worse.append(f"{ratio(method.warm_s / reference.warm_s)} times slower")
    if method.memory_bytes and reference.memory_bytes and method.memory_bytes > _MORE_MEMORY * reference.memory_bytes:
        worse.append(f"{megabytes(method.memory_bytes - reference.memory_bytes)} MB more")
    if method.slices and reference.slices:
        lower = reference.slices["dice"] - method.slices["dice"]
        if lower > _LOWER_DICE:
            worse.append(f"Dice lower by {lower:.4f}")
    if method.truth and reference.truth:
        wider = method.truth["scatter_mm"] - reference.truth["scatter_mm"]
        if wider > _WIDER_MM:
            worse.append(f"scatter wider by {wider:.3f} mm")
    if method.quality and reference.quality and reference.quality["closed"] and not method.quality["closed"]:
        worse.append("not closed")
    return worse
