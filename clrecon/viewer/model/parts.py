"""Parts of a scan at an iso value: clusters of voxels that share faces, and the label map by which they are drawn.

The label map lies on the scan's own grid.  A voxel at the iso value or above has the number of its cluster, 1 for the
largest; the smaller ones have one number together.  Clusters are grown by one voxel, so that the surface, which lies
between voxels, and what volume rendering shows of the edge belong to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.labels import LabelMap
from clrecon.labels.resample import ResampledLabels
from clrecon.opencl import download
from clrecon.operators.masks.mask import Mask
from clrecon.operators.masks.runs import find_components
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_hu
from clrecon.viewer.model.state import Box, Point, ShownPart

_MOST_CLUSTERS = 20
"""Clusters that are parts of their own."""

SMALLER = _MOST_CLUSTERS + 1
"""Number of all others together."""

STEPS = 5
"""Steps of the search, as progress counts them."""


class ClusterMap(LabelMap):
    """Numbers of clusters on the grid of a scan, whose slices may be uneven: other label maps have even ones."""

    def __init__(self, voxels: NDArray[np.uint8], volume: Volume):
        super().__init__(voxels, volume.affine.copy())
        self._volume = volume

    def ijk_to_lps(self, points: ArrayLike) -> Float64Array:
        return self._volume.ijk_to_lps(points)

    def lps_to_ijk(self, points: ArrayLike) -> Float64Array:
        return self._volume.lps_to_ijk(points)


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundParts:
    """The parts of a scan by its number: `labels`, grown by a voxel, and `placed` on its grid; 0 is all else.

    small_count: Components that are one part together, `SMALLER`.
    """

    scan: int
    iso_value: float
    shown: tuple[bool, float]
    volume: Volume
    labels: LabelMap
    placed: ResampledLabels
    parts: tuple[ShownPart, ...]
    small_count: int = 0


def number_at(volume: Volume, numbers: NDArray[Any], point: Point) -> int:
    """Return the number of the voxel that is nearest to a place in LPS mm; 0 outside of the volume."""
    ijk = np.rint(volume.lps_to_ijk([point])[0]).astype(np.int64)
    if (ijk < 0).any() or (ijk >= volume.shape_ijk).any():
        return 0
    i, j, k = ijk
    return int(numbers[k, j, i])


def number_vertices(inner: NDArray[np.int64], voxels: NDArray) -> NDArray:
    """Return the number of the voxel that `find_inner` found for each vertex, 0 for none."""
    return np.where(inner >= 0, voxels.reshape(-1)[inner], 0)


def find_inner(vertices: NDArray[np.floating], volume: Volume, iso_value: float) -> NDArray[np.int64]:
    """Return the place in memory of the voxel that is inside at the edge of each vertex of an iso surface, or -1."""
    level = choose_iso_rule(volume, iso_value).iso_level
    ijk = volume.lps_to_ijk(vertices)
    near = np.rint(ijk)
    axis = np.argmax(np.abs(ijk - near), axis=1)
    rows = np.arange(len(ijk))
    ends = np.stack([near, near]).astype(np.int64)
    ends[0, rows, axis] = np.floor(ijk[rows, axis])
    ends[1, rows, axis] = ends[0, rows, axis] + 1
    last = np.array(volume.shape_ijk) - 1
    inner = np.full(len(ijk), -1, np.int64)
    for end in ends:
        within = ((end >= 0) & (end <= last)).all(axis=1)
        i, j, k = np.clip(end, 0, last).T
        inside = within & (volume.voxels[k, j, i] > level)
        inner[inside] = np.ravel_multi_index((k, j, i), volume.voxels.shape)[inside]
    return inner


@dataclass(frozen=True, eq=False)
class _Runs:
    """Runs of voxels along i: cluster, row, first and last voxel of each."""

    clusters: NDArray[np.int32]
    rows: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]


def find_clusters(
    resident: DeviceVolume,
    scan: int,
    iso_value: float,
    shown: tuple[bool, float],
    progress: Progress | None = None,
    *,
    lock: AbstractContextManager[Any] | None = None,
) -> FoundParts:
    """Find the parts of a scan, voxels at the iso value and above; `lock` is held while the device works.

    shown: Which voxels of the scan `resident` holds, see `ViewState.voxels`.
    """
    tell, volume = progress or ignore_progress, resident.volume
    tell("parts", 0, STEPS)
    with lock or nullcontext():
        runs = _find_runs(resident, iso_value)
    tell("parts", 1, STEPS)
    lengths = runs.last - runs.first + 1
    sizes = np.bincount(runs.clusters, weights=lengths).astype(np.int64)
    order = np.argsort(-sizes, kind="stable")
    numbers = np.full(len(sizes), SMALLER, np.uint8)
    numbers[order[:_MOST_CLUSTERS]] = np.arange(1, min(_MOST_CLUSTERS, len(sizes)) + 1)
    of_runs = numbers[runs.clusters]
    voxels = _fill_runs(volume, runs, of_runs)
    tell("parts", 2, STEPS)
    grow_labels(voxels)
    tell("parts", 3, STEPS)
    parts = _describe_parts(volume, scan, iso_value, runs, of_runs, sizes)
    tell("parts", 4, STEPS)
    labels = ClusterMap(voxels, volume)
    tell("parts", STEPS, STEPS)
    return FoundParts(
        scan=scan, iso_value=iso_value, shown=shown, volume=volume, labels=labels,
        placed=ResampledLabels(labels.voxels, True, {}, ()), parts=parts,
        small_count=max(0, len(sizes) - _MOST_CLUSTERS),
    )  # fmt: skip


def _find_runs(resident: DeviceVolume, iso_value: float) -> _Runs:
    """Find runs of voxels at the iso value or above, and their clusters; none where no voxel is so high."""
    nothing = np.empty(0, np.int64)
    try:
        mask = Mask.from_band(resident, (iso_value, np.inf))
    except NoSurfaceError:
        return _Runs(nothing.astype(np.int32), nothing, nothing, nothing)
    components = find_components(mask.device, mask.bits, memory=resident.memory)
    count, rows = components.runs.count, mask.bits.rows
    if not count:
        return _Runs(nothing.astype(np.int32), nothing, nothing, nothing)
    clusters = download(mask.device, np.empty(count, np.int32), components.numbers_d)
    columns = download(mask.device, np.empty((count, 2), np.uint16), components.runs.runs_d)
    counts = download(mask.device, np.empty(rows + 1, np.uint32), components.runs.row_counts_d).astype(np.int64)
    of_rows = np.repeat(np.arange(rows, dtype=np.int64), np.diff(counts))
    return _Runs(clusters, of_rows, columns[:, 0].astype(np.int64), columns[:, 1].astype(np.int64))


def _fill_runs(volume: Volume, runs: _Runs, numbers: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Write the number of each run to its voxels: differences at the ends of runs, summed up along memory."""
    ni = volume.shape_ijk[0]
    steps = np.zeros(volume.voxels.size + 1, np.uint8)
    steps[runs.rows * ni + runs.first] = numbers
    steps[runs.rows * ni + runs.last + 1] -= numbers  # wraps round, as the sum does
    return np.cumsum(steps[:-1], dtype=np.uint8, out=steps[:-1]).reshape(volume.voxels.shape)


def grow_labels(voxels: NDArray[np.uint8]) -> None:
    """Give voxels without a label that of a neighbour, over faces, edges and corners, in place."""
    for axis in range(3):
        turned = np.moveaxis(voxels, axis, 0)
        before = turned.copy()
        for here, there in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            np.copyto(turned[here], before[there], where=turned[here] == 0)


def _describe_parts(
    volume: Volume, scan: int, iso_value: float, runs: _Runs, numbers: NDArray[np.uint8], sizes: NDArray[np.int64]
) -> tuple[ShownPart, ...]:
    voxel_ml = abs(float(np.linalg.det(volume.affine[:3, :3]))) / 1000.0
    nj = volume.shape_ijk[1]
    lengths = runs.last - runs.first
    parts = []
    order = np.argsort(numbers, kind="stable")
    ends = np.searchsorted(numbers[order], np.arange(SMALLER + 2))
    for number in range(1, SMALLER + 1):
        own_runs = order[ends[number] : ends[number + 1]]
        if not len(own_runs):
            continue
        count = int((lengths[own_runs] + 1).sum())
        k, j = np.divmod(runs.rows[own_runs], nj)
        longest = int(np.argmax(lengths[own_runs]))
        middle = (runs.first[own_runs][longest] + lengths[own_runs][longest] // 2, j[longest], k[longest])
        low, high = (runs.first[own_runs].min(), j.min(), k.min()), (runs.last[own_runs].max(), j.max(), k.max())
        several = len(sizes) - _MOST_CLUSTERS
        name = f"part {number}" if number < SMALLER else f"{several:,} smaller part{'s' * (several > 1)}"
        x, y, z = volume.ijk_to_lps([middle])[0].tolist()
        parts.append(
            ShownPart(
                key=f"{scan}/{number}",
                name=name,
                kind="cluster",
                object=scan,
                number=number,
                ml=count * voxel_ml,
                count=count,
                box=_box_of(volume, low, high),
                inside=(x, y, z),
            )
        )
    below = f"below {format_hu(iso_value)} HU"
    return (*parts, ShownPart(key=f"{scan}/0", name=below, kind="rest", object=scan, number=0))


def _box_of(volume: Volume, low: Sequence[int], high: Sequence[int]) -> Box:
    """Return the box in LPS around a block of voxels, half a voxel more on each side."""
    (i0, j0, k0), (i1, j1, k1) = low, high
    corners = list(product((i0 - 0.5, i1 + 0.5), (j0 - 0.5, j1 + 0.5), (k0 - 0.5, k1 + 0.5)))
    places = volume.ijk_to_lps(corners)
    (x0, y0, z0), (x1, y1, z1) = places.min(axis=0).tolist(), places.max(axis=0).tolist()
    return (x0, y0, z0), (x1, y1, z1)


def carry_looks(old: Sequence[ShownPart], found_parts: FoundParts) -> list[ShownPart]:
    """Return found parts with the looks that parts had at another iso value, known again by a place within."""
    fresh = {part.number: part for part in found_parts.parts}
    for part in sorted(old, key=lambda each: -(each.count or 0)):
        if part.is_plain:
            continue
        number = 0
        if part.kind == "cluster":
            if part.number == SMALLER:
                number = SMALLER
            elif part.inside is not None:
                number = number_at(found_parts.volume, found_parts.labels.voxels, part.inside)
        known = fresh.get(number)
        if known is not None and known.is_plain and (number == 0) == (part.kind == "rest"):
            fresh[number] = replace(known, color=part.color, opacity=part.opacity, visible=part.visible)
    return list(fresh.values())
