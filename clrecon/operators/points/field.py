"""A signed distance around a cloud with normals, on nodes, and the signs of all nodes: the host's side of
cl/points/field.cl and cl/points/field_signs.cl.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.opencl import Device, MemoryLimits
from clrecon.operators.points.grid import CELL_ROUNDING, GridPlan, fill_grid, plan_grid
from clrecon.operators.primitives.scan import BitRows, compact, exclusive_scan
from clrecon.operators.primitives.union_find import label_components
from clrecon.system.light_dataclass import dataclass


class Masks(BitRows):
    """Masks of nodes on a device, cleared: a bit for each node, (nz, ny, words) uint32, rows along x of whole words.

    They are of nodes within B of a point, of those within one spacing, and of near ones whose field is not positive.
    """

    shape: tuple[int, int, int]
    COUNT: ClassVar[int] = 6
    """Masks that exist together at most, those of `decide_signs` among them."""

    def __init__(self, device: Device, shape: tuple[int, int, int]):
        self.device, self.shape = device, shape
        self.near_d, self.core_d, self.negative_d = (self.make() for _ in range(3))
        program = ocl.load_program(device, "points/grid.cl", {"LANES": device.kernel_variants["LANES"]})
        for mask_d in (self.near_d, self.core_d, self.negative_d):
            ocl.launch(device, program["clear_cells"], self.total_words, mask=mask_d, total=self.total_words)

    def make(self) -> Any:
        return ocl.allocate(self.device, 4 * self.total_words)

    def fetch(self, mask_d: Any) -> NDArray[np.uint32]:
        """Return a mask, shape (nz, ny, words)."""
        return ocl.download(self.device, np.empty((self.shape[2], self.shape[1], self.words), np.uint32), mask_d)


@dataclass(frozen=True)
class Signs:
    """What `decide_signs` found: nodes inside, (nz, ny, words) uint32, votes for far `regions`, and those against the
    winner.

    With `outside_is_inside` the region around everything was voted inside: the normals point inward.
    """

    inside_d: Any
    votes: int
    against: int
    regions: int
    outside_is_inside: bool

    @property
    def share_against(self) -> float:
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

    def __init__(self, masks: Masks, limits: MemoryLimits, memory: int | None, used: int):
        self.masks, self.memory = masks, memory
        self.device = masks.device
        self._limits, self._taken = limits, used
        self._program = ocl.load_program(masks.device, "points/field_signs.cl")
        self._lines = {"words": masks.words, "rows": masks.rows}

    def run(self, kernel: str, items: int, **arguments: Any) -> None:
        ocl.launch(self.device, self._program[kernel], items, **arguments)

    def _check(self, buffer: str, size: int) -> None:
        ocl.require_room(self._limits, {"field": self._taken, buffer: size}, "the inside of the cloud cannot be found")

    def find_runs(self) -> _Runs:
        masks, rows = self.masks, self.masks.rows
        along = {"nx": masks.shape[0], **self._lines}
        counts_d = ocl.allocate(self.device, 4 * rows)
        self.run("count_runs", rows, near=masks.near_d, counts=counts_d, **along)
        offsets = exclusive_scan(self.device, counts_d, rows, in_place=True)
        self._check("runs of far nodes", 25 * offsets.total + 8 * rows)
        firsts_d, lasts_d = (ocl.allocate(self.device, 4 * offsets.total) for _ in range(2))
        self.run(
            "list_runs", rows, near=masks.near_d, offsets=offsets.offsets_d, firsts=firsts_d, lasts=lasts_d, **along
        )
        return _Runs(offsets.offsets_d, firsts_d, lasts_d, offsets.total)

    def number_regions(self, runs: _Runs) -> tuple[int, NDArray[np.int64]]:
        masks, rows = self.masks, self.masks.rows
        of = {"offsets": runs.offsets_d, "firsts": runs.firsts_d, "lasts": runs.lasts_d}
        sizes = {"ny": masks.shape[1], "rows": rows, "runs": runs.count}
        counts_d = ocl.allocate(self.device, 4 * rows)
        self.run("count_joins", rows, counts=counts_d, **of, **sizes)
        places = exclusive_scan(self.device, counts_d, rows, in_place=True)
        self._check("pairs of runs", 25 * runs.count + 12 * places.total)
        pairs = np.empty((places.total, 3), np.uint32)
        if places.total:
            pairs_d = ocl.allocate(self.device, 12 * places.total)
            self.run("list_joins", rows, places=places.offsets_d, pairs=pairs_d, **of, **sizes)
            ocl.download(self.device, pairs, pairs_d)
            del pairs_d
        count, labels = label_components(self.device, pairs, runs.count, memory=self.memory)
        lone = np.flatnonzero(labels < 0)
        labels[lone] = count + np.arange(len(lone))
        return count + len(lone), labels

    def count_votes(self, runs: _Runs) -> NDArray[np.uint32]:
        """Return the votes for outside and for inside of each run, shape (runs, 2)."""
        masks = self.masks
        votes_d = ocl.allocate(self.device, 8 * runs.count)
        self.run(
            "count_votes", masks.rows,
            near=masks.near_d, negative=masks.negative_d, offsets=runs.offsets_d, firsts=runs.firsts_d,
            lasts=runs.lasts_d, votes=votes_d, nx=masks.shape[0], ny=masks.shape[1], runs=runs.count, **self._lines,
        )  # fmt: skip
        return ocl.download(self.device, np.empty((runs.count, 2), np.uint32), votes_d)

    def paint(self, runs: _Runs, signs: NDArray[np.uint8], rounds: int) -> Any:
        """Return the mask of nodes inside; `negative_d` is used up."""
        masks = self.masks
        inside_d, reached_d, next_reached_d = (masks.make() for _ in range(3))
        next_inside_d, masks.negative_d = masks.negative_d, None
        self.run(
            "paint_regions", masks.rows,
            near=masks.near_d, negative=next_inside_d, offsets=runs.offsets_d, firsts=runs.firsts_d,
            lasts=runs.lasts_d, signs=ocl.upload(self.device, signs), inside=inside_d, reached=reached_d,
            also_reached=next_reached_d, nx=masks.shape[0], runs=runs.count, **self._lines,
        )  # fmt: skip
        for _ in range(rounds):
            self.run(
                "flood_signs", masks.total_words,
                near=masks.near_d, core=masks.core_d, inside=inside_d, reached=reached_d, next_inside=next_inside_d,
                next_reached=next_reached_d, ny=masks.shape[1], **self._lines,
            )  # fmt: skip
            inside_d, next_inside_d = next_inside_d, inside_d
            reached_d, next_reached_d = next_reached_d, reached_d
        return inside_d


def decide_signs(
    masks: Masks, limits: MemoryLimits, rounds: int, *, memory: int | None = None, taken: int = 0
) -> Signs:
    """Decide which nodes are inside, signs flooding `rounds` nodes; negative ones are used up, `taken` bytes gone."""
    decision = _Decision(masks, limits, memory, taken)
    runs = decision.find_runs()
    count, regions = decision.number_regions(runs)
    votes = decision.count_votes(runs).astype(np.float64)
    sums = np.stack([np.bincount(regions, weights=side, minlength=count) for side in votes.T])
    is_inside = sums[1] > sums[0]
    inside_d = decision.paint(runs, is_inside[regions].astype(np.uint8), rounds)
    against = int(sums.min(axis=0).sum())
    return Signs(inside_d, int(sums.sum()), against, count, bool(is_inside[regions[0]]))


BRICK = tuple(ocl.kernel_constant("points/field.cl", name) for name in ("BRICK_LONG", "BRICK_WIDE", "BRICK_WIDE"))
BRICK_ROWS = ocl.kernel_constant("points/field.cl", "BRICK_ROWS")
_BRICK_BYTES = 4 * ocl.kernel_constant("points/field.cl", "BRICK_NODES")

MOST_NODES = 2**31
"""Most nodes of a field."""

LEAST_SHARE = 1e-6
"""No node lies nearer to the surface than this share of the spacing, in the value of the field: 0 has no sign."""


@dataclass(frozen=True)
class FieldSettings:
    """Lengths of a field in mm: spacing h of the nodes, reach R and smoothing s of the weights, bridge B."""

    spacing: float
    reach: float
    smoothing: float
    bridge: float

    @property
    def rounds(self) -> int:
        """Nodes that signs flood from a far node on: 2 B, as the farthest far node is about B away."""
        return 2 * math.ceil(self.bridge / self.spacing)

    def squared(self) -> dict[str, float]:
        """The squares as kernels take them: products of float32."""
        values = {name: np.float32(getattr(self, name)) for name in ("reach", "smoothing", "bridge", "spacing")}
        return {f"squared_{name}": float(value * value) for name, value in values.items()}


@dataclass(frozen=True, eq=False)
class Nodes(BitRows):
    """Nodes of a field: bricks (x, y, z) around the points; `corner`, float32 mm, is relative to `base`, LPS mm."""

    corner: NDArray[np.float32]
    base: NDArray[np.float64]
    spacing: np.float32
    bricks: tuple[int, int, int]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes (nx, ny, nz)."""
        x, y, z = (count * size for count, size in zip(self.bricks, BRICK, strict=True))
        return x, y, z

    @property
    def count(self) -> int:
        return math.prod(self.shape)

    @property
    def mask_bytes(self) -> int:
        return 4 * self.total_words

    @property
    def brick_words(self) -> int:
        return -(-self.bricks[0] // 32)

    @property
    def layer_bytes(self) -> int:
        return 4 * self.shape[0] * self.shape[1] * BRICK[2]

    @property
    def corner_and_spacing(self) -> tuple[float, float, float, float]:
        x, y, z = map(float, self.corner)
        return x, y, z, float(self.spacing)

    @property
    def affine(self) -> NDArray[np.float64]:
        """4x4, node (i, j, k) to LPS mm."""
        affine = np.diag([*[float(self.spacing)] * 3, 1.0])
        affine[:3, 3] = self.base + self.corner
        return affine


def plan_nodes(points: GridPlan, settings: FieldSettings) -> Nodes:
    h = np.float32(settings.spacing)
    margin = settings.bridge + float(h)
    low, high = points.points.min(axis=0).astype(np.float64), points.points.max(axis=0).astype(np.float64)
    corner = (low - margin).astype(np.float32)
    counts = np.ceil((high + margin - corner) / float(h)) + 1.0
    bricks = [math.ceil(min(count, 2.0**40) / size) for count, size in zip(counts, BRICK, strict=True)]
    nodes = Nodes(corner, points.base, h, (bricks[0], bricks[1], bricks[2]))
    if nodes.count > MOST_NODES:
        size = " x ".join(f"{length:.6g}" for length in high - low)
        least = settings.spacing * (nodes.count / MOST_NODES) ** (1.0 / 3.0)
        raise UsageError(
            f"nodes every {settings.spacing:.6g} mm: the box of the points, {size} mm, has"
            f" {' x '.join(f'{count:,}' for count in nodes.shape)} = {nodes.count:,} of them, possible are"
            f" {MOST_NODES:,}: take {1.05 * least:.3g} mm or more, or remove points that lie far from all others"
        )
    return nodes


@dataclass(frozen=True)
class _Slab:
    """Layers of bricks that go through the device together, and the listed bricks in them."""

    first: int
    end: int
    first_brick: int
    end_brick: int


class NodeField:
    """The field of a cloud on a device, for one set of lengths; normals are of length 1 and point outward."""

    def __init__(
        self,
        device: Device,
        points: Any,
        normals: NDArray[np.float32],
        settings: FieldSettings,
        *,
        memory: int | None = None,
    ):
        self.device, self.settings = device, settings
        self.limits = ocl.memory_limits(device, memory)
        plan = plan_grid(points, 2.0 * settings.spacing)
        self.nodes = plan_nodes(plan, settings)
        # Cells are found by coordinates in float32.
        extent = float(np.ptp(plan.points, axis=0).max()) + 2.0 * settings.bridge
        self._within = settings.reach + 1e-3 * settings.spacing + 4.0 * CELL_ROUNDING * extent
        n = len(plan.points)
        needs = {**plan.needs(device), **self._kept(n), "normals as given": 12 * n, "nodes": self.nodes.layer_bytes}
        ocl.require_room(self.limits, needs, "no surface can be made of the cloud")
        self._program = ocl.load_program(device, "points/field.cl", {"LANES": device.kernel_variants["LANES"]})
        self.grid = fill_grid(device, plan, memory=memory)
        self._normals_d = self._sort_normals(normals)
        self._list_d, self._list = self._find_bricks()
        self.slabs = self._plan_slabs()
        self.masks = Masks(device, self.nodes.shape)
        self._values = self._measure()

    def _run(self, kernel: str, items: int, **arguments: Any) -> None:
        ocl.launch(self.device, self._program[kernel], items, **arguments)

    @property
    def bricks(self) -> int:
        return len(self._list)

    def _kept(self, n: int) -> dict[str, int]:
        """Return the bytes of what stays while slabs are worked on, beside the grid."""
        return {"normals": 12 * n, "masks of nodes": Masks.COUNT * self.nodes.mask_bytes}

    def _sort_normals(self, normals: NDArray[np.float32]) -> tuple[Any, Any, Any]:
        n = self.grid.n
        sorted_d = [ocl.allocate(self.device, 4 * n) for _ in range(3)]
        self._run(
            "sort_normals", n,
            normals=ocl.upload(self.device, normals), order=self.grid.order_d, n=n,
            nx=sorted_d[0], ny=sorted_d[1], nz=sorted_d[2],
        )  # fmt: skip
        return sorted_d[0], sorted_d[1], sorted_d[2]

    @cached_property
    def _where(self) -> dict[str, Any]:
        origin = self.grid.origin_and_scale
        return {"nodes": self.nodes.corner_and_spacing, "origin": origin, "within": self._within}

    def _find_bricks(self) -> tuple[Any, NDArray[np.uint32]]:
        """List the bricks that points may reach; on the device and here."""
        grid, nodes = self.grid, self.nodes
        bricks_x, bricks_y, bricks_z = nodes.bricks
        rows, words = bricks_y * bricks_z, nodes.brick_words
        merged_d = ocl.allocate(self.device, 4 * rows * grid.words)
        bricks_d = ocl.allocate(self.device, 4 * rows * words)
        self._run(
            "merge_rows", rows * grid.words,
            mask=grid.mask_d, merged=merged_d, ny=grid.shape[1], nz=grid.shape[2], words=grid.words,
            bricks_y=bricks_y, bricks_z=bricks_z, **self._where,
        )  # fmt: skip
        self._run(
            "mark_reached", rows * words,
            merged=merged_d, bricks=bricks_d, nx=grid.shape[0], words=grid.words, bricks_x=bricks_x,
            brick_words=words, rows=rows, **self._where,
        )  # fmt: skip
        compacted = compact(self.device, bricks_d, rows * words)
        listed = ocl.download(self.device, np.empty(compacted.count, np.uint32), compacted.positions_d)
        return compacted.positions_d, listed

    def _plan_slabs(self) -> tuple[_Slab, ...]:
        """Cut the layers of bricks into slabs that the device has room for."""
        layers = self.nodes.bricks[2]
        per_layer = 32 * self.nodes.brick_words * self.nodes.bricks[1]
        before = np.searchsorted(self._list, per_layer * np.arange(layers + 1, dtype=np.int64))

        def cut_slabs(thick: int) -> tuple[_Slab, ...]:
            ends = [min(first + thick, layers) for first in range(0, layers, thick)]
            return tuple(
                _Slab(first, end, int(before[first]), int(before[end]))
                for first, end in zip(range(0, layers, thick), ends, strict=True)
            )

        def shortage(thick: int) -> str:
            most = max(slab.end_brick - slab.first_brick for slab in cut_slabs(thick))
            slab_needs = {"nodes": thick * self.nodes.layer_bytes, "bricks": _BRICK_BYTES * most}
            resident = {"grid": self.grid.nbytes, "list of bricks": 4 * self.bricks, **self._kept(self.grid.n)}
            return ocl.describe_shortage(self.limits, {**resident, **slab_needs})

        thick = bisect_left(range(1, layers + 1), True, key=lambda count: shortage(count) != "")
        if thick == 0:
            raise DeviceMemoryError(f"no surface can be made of the cloud: {shortage(1)}")
        return cut_slabs(thick)

    def _measure(self) -> list[Any]:
        """Measure the field in all bricks; return the values of each slab, on the device where there is one slab."""
        grid, nodes = self.grid, self.nodes
        device = self.device
        values = []
        for slab in self.slabs:
            count = slab.end_brick - slab.first_brick
            values_d = ocl.allocate(device, _BRICK_BYTES * count)
            if count:
                self._run(
                    "measure_nodes", count if int(device.kernel_variants["LANES"]) > 1 else BRICK_ROWS * count,
                    mask=grid.mask_d, ranks=grid.ranks_d, starts=grid.starts_d,
                    px=grid.x_d, py=grid.y_d, pz=grid.z_d,
                    nx=self._normals_d[0], ny=self._normals_d[1], nz=self._normals_d[2],
                    list=self._listed(slab), values=values_d, count=count,
                    near=self.masks.near_d, core=self.masks.core_d, negative=self.masks.negative_d,
                    cells_x=grid.shape[0], cells_y=grid.shape[1], cells_z=grid.shape[2], words=grid.words,
                    nodes_y=nodes.shape[1], node_words=nodes.words, bricks_y=nodes.bricks[1],
                    brick_words=nodes.brick_words, **self._where, **self.settings.squared(),
                )  # fmt: skip
            if len(self.slabs) > 1:
                values.append(ocl.download(device, np.empty((count, _BRICK_BYTES // 4), np.float32), values_d))
            else:
                values.append(values_d)
        return values

    def _listed(self, slab: _Slab) -> Any:
        if len(self.slabs) == 1:
            return self._list_d
        return ocl.upload(self.device, self._list[slab.first_brick : slab.end_brick])

    @property
    def nbytes(self) -> int:
        """Bytes on the device without points and grid, with all masks."""
        values = _BRICK_BYTES * self.bricks if len(self.slabs) == 1 else 0
        return values + 4 * self.bricks + Masks.COUNT * self.nodes.mask_bytes

    def release_points(self) -> None:
        """Free the points and their grid: the values stay."""
        del self.grid, self._normals_d

    def release(self) -> None:
        del self._values, self._list_d, self.masks

    def fill(self, signs: Signs, progress: Callable[[int, int], None] | None = None) -> NDArray[np.float32]:
        """Return the field as a volume, positive inside, with the decided signs; shape (nz, ny, nx), mm."""
        nx, ny, nz = self.nodes.shape
        device, whole = self.device, len(self.slabs) == 1
        volume, volume_d = ocl.empty_output(device, (nz, ny, nx), np.float32) if whole else (
            ocl.result_pages.empty((nz, ny, nx), np.float32), None,
        )  # fmt: skip
        for number, slab in enumerate(self.slabs):
            first, end = BRICK[2] * slab.first, BRICK[2] * slab.end
            slab_d = volume_d if whole else ocl.allocate(device, 4 * nx * ny * (end - first))
            self._fill_slab(slab, signs, self._values[number], slab_d)
            ocl.download(device, volume[first:end], slab_d)
            if progress is not None:
                progress(number + 1, len(self.slabs))
        return volume

    def _fill_slab(self, slab: _Slab, signs: Signs, values: Any, slab_d: Any) -> None:
        nodes = self.nodes
        bricks_x, bricks_y, _ = nodes.bricks
        far = float(np.float32(self.settings.bridge))
        offset, rows = BRICK[2] * slab.first * nodes.shape[1], BRICK[2] * (slab.end - slab.first) * nodes.shape[1]
        sizes = {"bricks_x": bricks_x, "node_words": nodes.words, "row_offset": offset, "far_value": far}
        self._run("fill_far", rows * bricks_x, inside=signs.inside_d, volume=slab_d, rows=rows, **sizes)
        count = slab.end_brick - slab.first_brick
        if count:
            self._run(
                "place_bricks", BRICK_ROWS * count,
                list=self._listed(slab), values=values if len(self.slabs) == 1 else ocl.upload(self.device, values),
                near=self.masks.near_d, inside=signs.inside_d, volume=slab_d,
                nodes_y=nodes.shape[1], bricks_y=bricks_y, brick_words=nodes.brick_words,
                least=LEAST_SHARE * float(nodes.spacing), count=count, **sizes,
            )  # fmt: skip
