"""The signs of all nodes of a field: the host's side of cl/points/field_signs.cl."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceMemoryError
from clrecon.opencl import (
    Device,
    MemoryLimits,
    Program,
    Stopwatch,
    allocate,
    describe_shortage,
    download,
    launch,
    load_program,
    upload,
)
from clrecon.operators.primitives.scan import exclusive_scan, prepare_scan
from clrecon.operators.primitives.union_find import label_components, prepare_components


def prepare_signs(device: Device) -> Program:
    """Build the kernels of `decide_signs`."""
    prepare_scan(device)
    prepare_components(device)
    return load_program(device, "points/field_signs.cl")


class Masks:
    """Masks of nodes on a device, cleared: a bit for each node, rows along x of whole words.

    near_d, core_d, negative_d: buffer, (nz, ny, words) uint32. Nodes within B of a point, those within one spacing, and
        near ones whose field is not positive.
    """

    COUNT: ClassVar[int] = 6
    """Masks that exist together at most, those of `decide_signs` among them."""

    def __init__(self, device: Device, shape: tuple[int, int, int], stopwatch: Stopwatch | None = None):
        self.device, self.shape, self.stopwatch = device, shape, stopwatch
        self.words = -(-shape[0] // 32)
        self.rows = shape[1] * shape[2]
        self.near_d, self.core_d, self.negative_d = (self.make() for _ in range(3))
        program = load_program(device, "points/grid.cl", {"LANES": device.kernel_variants["LANES"]})
        for mask_d in (self.near_d, self.core_d, self.negative_d):
            launch(device, program["clear_cells"], self.total, stopwatch=stopwatch, mask=mask_d, total=self.total)

    @property
    def total(self) -> int:
        """Words of a mask."""
        return self.words * self.rows

    def make(self) -> Any:
        """Return a buffer for another mask."""
        return allocate(self.device, 4 * self.total)

    def fetch(self, mask_d: Any) -> NDArray[np.uint32]:
        """Return a mask, shape (nz, ny, words)."""
        return download(self.device, np.empty((self.shape[2], self.shape[1], self.words), np.uint32), mask_d)


@dataclass(frozen=True)
class Signs:
    """What `decide_signs` found.

    inside_d: buffer, (nz, ny, words) uint32. Nodes inside.
    votes, against: Votes for far regions, and those against the winner.
    regions: Number of far regions.
    outside_is_inside: The region around everything was voted inside: the normals point inward.
    """

    inside_d: Any
    votes: int
    against: int
    regions: int
    outside_is_inside: bool

    @property
    def share_against(self) -> float:
        """Share of the votes that were against the winner."""
        return self.against / self.votes if self.votes else 0.0


@dataclass(frozen=True)
class _Runs:
    """Runs of far nodes on the device."""

    offsets_d: Any
    firsts_d: Any
    lasts_d: Any
    count: int


class _Decision:
    """The passes of cl/points/field_signs.cl."""

    def __init__(self, masks: Masks, limits: MemoryLimits, memory: int | None, taken: int):
        self.masks, self.device, self.memory = masks, masks.device, memory
        self._limits, self._taken = limits, taken
        self._program = prepare_signs(masks.device)
        self._lines = {"words": masks.words, "rows": masks.rows}

    def run(self, kernel: str, items: int, **arguments: Any) -> None:
        """Launch a kernel over `items` work-items."""
        launch(self.device, self._program[kernel], items, stopwatch=self.masks.stopwatch, **arguments)

    def _check(self, what: str, size: int) -> None:
        shortage = describe_shortage(self._limits, {"field": self._taken, what: size})
        if shortage:
            raise DeviceMemoryError(f"the inside of the cloud cannot be found: {shortage}")

    def find_runs(self) -> _Runs:
        """List the runs of far nodes."""
        masks, rows = self.masks, self.masks.rows
        along = {"nx": masks.shape[0], **self._lines}
        counts_d = allocate(self.device, 4 * rows)
        self.run("count_runs", rows, near=masks.near_d, counts=counts_d, **along)
        offsets = exclusive_scan(self.device, counts_d, rows, in_place=True, stopwatch=masks.stopwatch)
        self._check("runs of far nodes", 25 * offsets.total + 8 * rows)
        firsts_d, lasts_d = (allocate(self.device, 4 * offsets.total) for _ in range(2))
        self.run(
            "list_runs", rows, near=masks.near_d, offsets=offsets.offsets_d, firsts=firsts_d, lasts=lasts_d, **along
        )
        return _Runs(offsets.offsets_d, firsts_d, lasts_d, offsets.total)

    def number_regions(self, runs: _Runs) -> tuple[int, NDArray[np.int64]]:
        """Return the number of regions, and that of each run."""
        masks, rows = self.masks, self.masks.rows
        of = {"offsets": runs.offsets_d, "firsts": runs.firsts_d, "lasts": runs.lasts_d}
        sizes = {"ny": masks.shape[1], "rows": rows, "runs": runs.count}
        counts_d = allocate(self.device, 4 * rows)
        self.run("count_joins", rows, counts=counts_d, **of, **sizes)
        places = exclusive_scan(self.device, counts_d, rows, in_place=True, stopwatch=masks.stopwatch)
        self._check("pairs of runs", 25 * runs.count + 12 * places.total)
        pairs = np.empty((places.total, 3), np.uint32)
        if places.total:
            pairs_d = allocate(self.device, 12 * places.total)
            self.run("list_joins", rows, places=places.offsets_d, pairs=pairs_d, **of, **sizes)
            download(self.device, pairs, pairs_d)
            del pairs_d
        count, labels = label_components(self.device, pairs, runs.count, memory=self.memory, stopwatch=masks.stopwatch)
        lone = np.flatnonzero(labels < 0)
        labels[lone] = count + np.arange(len(lone))
        return count + len(lone), labels

    def count_votes(self, runs: _Runs) -> NDArray[np.uint32]:
        """Return the votes for outside and for inside of each run, shape (runs, 2)."""
        masks = self.masks
        votes_d = allocate(self.device, 8 * runs.count)
        self.run(
            "count_votes", masks.rows,
            near=masks.near_d, negative=masks.negative_d, offsets=runs.offsets_d, firsts=runs.firsts_d,
            lasts=runs.lasts_d, votes=votes_d, nx=masks.shape[0], ny=masks.shape[1], runs=runs.count, **self._lines,
        )  # fmt: skip
        return download(self.device, np.empty((runs.count, 2), np.uint32), votes_d)

    def paint(self, runs: _Runs, signs: NDArray[np.uint8], rounds: int) -> Any:
        """Return the mask of nodes inside; `negative_d` is used up."""
        masks = self.masks
        inside_d, reached_d, next_reached_d = (masks.make() for _ in range(3))
        next_inside_d, masks.negative_d = masks.negative_d, None
        self.run(
            "paint_regions", masks.rows,
            near=masks.near_d, negative=next_inside_d, offsets=runs.offsets_d, firsts=runs.firsts_d,
            lasts=runs.lasts_d, signs=upload(self.device, signs), inside=inside_d, reached=reached_d,
            also_reached=next_reached_d, nx=masks.shape[0], runs=runs.count, **self._lines,
        )  # fmt: skip
        for _ in range(rounds):
            self.run(
                "flood_signs", masks.total,
                near=masks.near_d, core=masks.core_d, inside=inside_d, reached=reached_d, next_inside=next_inside_d,
                next_reached=next_reached_d, ny=masks.shape[1], **self._lines,
            )  # fmt: skip
            inside_d, next_inside_d = next_inside_d, inside_d
            reached_d, next_reached_d = next_reached_d, reached_d
        return inside_d


def decide_signs(
    masks: Masks, limits: MemoryLimits, rounds: int, *, memory: int | None = None, taken: int = 0
) -> Signs:
    """Decide which nodes are inside; see `clrecon.reference.points.field.decide_signs`.

    masks: Its `negative_d` is used up.
    rounds: Nodes that signs flood from a far node on.
    memory: Bytes that may be taken on the device; None is all of its memory.
    taken: Bytes that are taken already, those of the masks among them.
    """
    decision = _Decision(masks, limits, memory, taken)
    runs = decision.find_runs()
    count, regions = decision.number_regions(runs)
    votes = decision.count_votes(runs).astype(np.float64)
    sums = np.stack([np.bincount(regions, weights=side, minlength=count) for side in votes.T])
    is_inside = sums[1] > sums[0]
    inside_d = decision.paint(runs, is_inside[regions].astype(np.uint8), rounds)
    against = int(sums.min(axis=0).sum())
    return Signs(inside_d, int(sums.sum()), against, count, bool(is_inside[regions[0]]))
