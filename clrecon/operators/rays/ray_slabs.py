"""Slabs of a volume for rays, their bricks, and leaps: which bricks show something, and how far the next one is."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.noise import gaussian_weights
from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array
from clrecon.labels import ResampledLabels
from clrecon.labels.label_levels import Growth
from clrecon.opencl import Stopwatch, allocate, check_budget, download, kernel_constant, launch, load_program, upload
from clrecon.operators.rays.picture_buffers import PictureBuffers, Shot, describe_picture
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import BOX_BORDER, enclose, label_variants, voxel_variants
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.label_style import LabelStyle
from clrecon.rendering.views.camera import Camera
from clrecon.system.light_dataclass import dataclass, field

BRICK_CELLS = kernel_constant("rays/leap.h", "BRICK_CELLS")
"""Cells of a brick along i and j."""

FARTHEST = kernel_constant("rays/leap.h", "FARTHEST")
"""Longest leap in bricks: with this distance as its margin, no brick is left to leap over."""


def choose_brick_cells(volume: Volume) -> tuple[int, int, int]:
    """Return the cells of a brick along i, j, k: fewer along k where slices are farther apart than voxels in them."""
    di, dj, dk = volume.spacing
    across = dk / max(di, dj)
    along = 2 if across >= 1.5 else BRICK_CELLS
    return BRICK_CELLS, BRICK_CELLS, 1 if across >= 3.0 else along


GROWN = 2
"""Voxels by which labels grow in volume rendering: a mask ends up to one before the bone, whose flank is one more."""

_OVERLAP = 2
"""Slices that a slab holds beyond its own at either side; cells and gradients at its ends read them."""

MOST_VOXELS = (1 << 31) - 1
"""Most voxels of a slab in kernels that take several samples at once: the difference of their indices is an int."""

RAYS = "rays"
"""Purpose by which slabs are planned."""

_BRICKS, _LABELS = "bricks for rays", "labels for rays"
_SMOOTHED = "smoothed volume"
"""Names of the objects that are kept for a whole volume."""

OPENNESS = "openness of places"
"""Name of the grid by which hollows are darkened, which is kept too."""


@dataclass(frozen=True)
class Smoothing:
    """A Gaussian along i, j, k: its standard deviation in mm, and for each axis the float32 weights of a voxel and of
    those at each distance on either side.
    """

    sigma_mm: float
    weights: tuple[NDArray[np.float32], ...]

    @classmethod
    def of(cls, volume: Volume, sigma_mm: float) -> Smoothing | None:
        """Return the smoothing of a volume, None for one that changes nothing; uneven slices count as even ones."""
        weights = tuple(gaussian_weights(sigma_mm / step) for step in volume.spacing)
        return None if all(len(along) == 1 for along in weights) else cls(sigma_mm, weights)


def _find_overlap(smoothing: Smoothing | None) -> int:
    return _OVERLAP if smoothing is None else _OVERLAP + len(smoothing.weights[2]) - 1


def smooth_voxels(resident: DeviceVolume, slab: RaySlab, smoothing: Smoothing) -> Any:
    """Return the smoothed voxels of a slab on the device, its own where no axis is smoothed."""
    device, (ni, nj, nk) = resident.device, slab.shape_ijk
    kernel = resident.program("rays/smooth.cl")["smooth_along"]
    groups = -(-ni // int(device.kernel_variants["LANES"]))
    from_d = slab.voxels_d
    for axis, weights in enumerate(smoothing.weights):
        if len(weights) > 1:
            to_d = allocate(device, ni * nj * nk * resident.dtype.itemsize)
            launch(
                device, kernel, groups * nj * nk, voxels=from_d, smoothed=to_d, weights=upload(device, weights),
                reach=len(weights) - 1, axis=axis, whole=resident.dtype.kind != "f", ni=ni, nj=nj, nk=nk, groups=groups,
            )  # fmt: skip
            from_d = to_d
    return from_d


def slab_smoothed(resident: DeviceVolume, slab: RaySlab, smoothing: Smoothing | None) -> Any:
    """Return the voxels of a slab whose gradients are lit; those of a whole one stay on the device."""
    if smoothing is None:
        return slab.voxels_d
    if not slab.is_whole:
        return smooth_voxels(resident, slab, smoothing)
    nbytes = math.prod(slab.shape_ijk) * resident.dtype.itemsize
    return resident.keep(_SMOOTHED, smoothing.sigma_mm, nbytes, lambda: smooth_voxels(resident, slab, smoothing))


def entry_slice(volume: Volume, camera: Camera) -> float:
    """Return the slice coordinate where the rays of a picture come from, see `ray_slabs`; infinite if parallel."""
    if camera.is_parallel:  # also in a view along the slices, where rays begin at any distance
        normal = slice_normal(volume.affine)
        rate = float(normal @ camera.basis().forward) * float(normal @ volume.affine[:3, 2])
        return -np.inf if rate > 0.0 else np.inf
    return float(volume.lps_to_ijk([camera.position])[0, 2])


@dataclass
class LeapMap:
    """The bricks of a slab that show something: Chebyshev distance in bricks to the next one from each, (bk, bj, bi)
    uint8, and the box around all, (low, high) in field coordinates, None if there is none.
    """

    distances_d: Any
    box: tuple[Float64Array, Float64Array] | None


@dataclass
class RaySlab:
    """Slices ``first_k`` to ``end_k - 1`` of a volume on the device, at least two along each axis.

    Samples with ``low_k <= k < high_k`` are its own; bit 0 of `stage` is set in the first slab of a picture, 1 in the
    last.
    """

    voxels_d: Any
    shape_ijk: tuple[int, int, int]
    first_k: int
    low_k: float
    high_k: float
    brick_cells: tuple[int, int, int]
    stage: int = 3
    ranges_d: Any = None
    maps: dict[Any, LeapMap] = field(default_factory=dict)

    @property
    def is_whole(self) -> bool:
        return self.stage == 3

    @property
    def bricks(self) -> tuple[int, int, int]:
        """Number of bricks (bi, bj, bk)."""
        bi, bj, bk = (max(1, -(-(n - 1) // c)) for n, c in zip(self.shape_ijk, self.brick_cells, strict=True))
        return bi, bj, bk

    @property
    def brick_arguments(self) -> dict[str, int]:
        """Arguments about bricks: their numbers, and the cells of each along k."""
        bi, bj, bk = self.bricks
        return {"bi": bi, "bj": bj, "bk": bk, "cells_k": self.brick_cells[2]}

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments about the slab for kernels that follow rays."""
        return {
            "voxels": self.voxels_d,
            "ni": self.shape_ijk[0],
            "nj": self.shape_ijk[1],
            "first_k": self.first_k,
            "end_k": self.end_k,
            "slab_low": self.low_k,
            "slab_high": self.high_k,
            "stage": self.stage,
            **self.brick_arguments,
        }

    @property
    def end_k(self) -> int:
        """The slice after the last one of the buffer."""
        return self.first_k + self.shape_ijk[2]


def pad_slices(voxels: NDArray[Any]) -> NDArray[Any]:
    """Return voxels with every axis of length 1 doubled: a cell needs two, and the field stays the same."""
    for axis, length in enumerate(voxels.shape):
        if length == 1:
            voxels = np.repeat(voxels, 2, axis=axis)
    return voxels


def plan_ray_slabs(
    resident: DeviceVolume,
    others: Mapping[str, int],
    extra: Mapping[str, int],
    labels: ResampledLabels | None = None,
    smoothing: Smoothing | None = None,
) -> int:
    """Return the number of slices in a slab, all if everything fits beside labels and `others`, bytes of other buffers;
    `extra` are needed only with more than one slab.
    """
    overlap = 2 * _find_overlap(smoothing) + 1
    ni, nj, nk = resident.volume.shape_ijk
    cells, size = choose_brick_cells(resident.volume), resident.dtype.itemsize

    def needs(slices: int) -> dict[str, int]:
        held_slices = nk if slices >= nk else slices + overlap
        shape = max(2, ni), max(2, nj), max(2, held_slices)
        bricks, samples = math.prod(-(-n // c) for n, c in zip(shape, cells, strict=True)), math.prod(shape)
        beside = {} if labels is None else {"labels": 2 * samples * labels.voxels.itemsize}  # they grow
        if smoothing is not None:
            beside |= {_SMOOTHED: samples * size, "smoothing": samples * size}  # a pass reads one and writes the other
        rest = {} if slices >= nk else extra
        return {"volume": samples * size, "bricks": bricks * (2 * size + 4), **beside, **others, **rest}

    most = None
    if int(resident.device.kernel_variants["LANES"]) > 1:
        most = MOST_VOXELS // (max(2, ni) * max(2, nj))
        most = most if nk <= most else most - overlap
    slices = resident.plan(RAYS, nk, needs, counted=(_BRICKS, _LABELS, _SMOOTHED, OPENNESS), most=most)
    if slices == 0:
        check_budget(resident.device, needs(1), resident.memory)
    return max(slices, 1)


def ray_slabs(
    resident: DeviceVolume, slices: int, entry_k: float, stopwatch: Stopwatch, smoothing: Smoothing | None = None
) -> Iterator[RaySlab]:
    """Yield the volume in slabs of `slices` slices, ordered by their distance from `entry_k`, the slice coordinate of
    the camera, from which rays go away; infinite: slabs begin at that end.
    """
    nk = resident.volume.shape_ijk[2]
    if slices >= nk:
        yield _whole_slab(resident, stopwatch)
        return
    parts = [(first, min(first + slices, nk)) for first in range(0, nk, slices)]
    if np.isfinite(entry_k):
        parts.sort(key=lambda part: max(part[0] - entry_k, entry_k - part[1], 0.0))
    elif entry_k > 0.0:
        parts.reverse()
    cells, overlap = choose_brick_cells(resident.volume), _find_overlap(smoothing)
    for number, (first, end) in enumerate(parts):
        low, high = (-np.inf if first == 0 else first), (np.inf if end == nk else end)
        held_first, held_end = max(first - overlap, 0), min(end + overlap + 1, nk)
        voxels_d, shape = upload_part(resident, held_first, held_end, stopwatch)
        stage = (number == 0) + 2 * (number == len(parts) - 1)
        yield RaySlab(voxels_d, shape, held_first, low, high, cells, stage)
        resident.volume.release_slices(first, end)


def slab_labels(
    resident: DeviceVolume, slab: RaySlab, labels: ResampledLabels, stopwatch: Stopwatch, *, grown: bool = False
) -> Any:
    """Return the labels of a slab's voxels on the device, grown by `GROWN` voxels or not; those of a whole one stay."""

    def make_labels() -> Any:
        with stopwatch.timed("upload"):
            made_d = upload(resident.device, pad_slices(labels.voxels[slab.first_k : slab.end_k]))
        for _ in range(GROWN if grown else 0):
            made_d = _grow_labels(resident, slab, made_d, labels.voxels.dtype)
        return made_d

    if not slab.is_whole:
        return make_labels()
    # The labels are kept too, so that no other array can get their address in the meantime.
    return resident.keep(_LABELS, (id(labels), grown), labels.voxels.nbytes, lambda: (labels, make_labels()))[1]


def _grow_labels(resident: DeviceVolume, slab: RaySlab, labels_d: Any, dtype: np.dtype[Any]) -> Any:
    """Return labels of a slab in which voxels without one have that of the nearest of the voxels around them."""
    device, (ni, nj, nk) = resident.device, slab.shape_ijk
    near = Growth.of(resident.volume, None).table
    made_d = allocate(device, ni * nj * nk * dtype.itemsize)
    program = load_program(device, "surface/labels.cl", {**voxel_variants(resident.dtype), **label_variants(dtype)})
    lowest = -np.inf if resident.dtype.kind == "f" else np.iinfo(resident.dtype).min
    launch(
        device, program["own_samples"], ni * nj * nk, voxels=slab.voxels_d, labels=labels_d,
        near=upload(device, near), inside=made_d, level=lowest, ni=ni, nj=nj, nk=nk, offsets=len(near),
    )  # fmt: skip
    return made_d


def _whole_slab(resident: DeviceVolume, stopwatch: Stopwatch) -> RaySlab:
    """Return the only slab of a volume that fits; its bricks and their ranges stay on the device with the voxels."""

    def make_slab() -> RaySlab:
        voxels = resident.volume.voxels
        padded = pad_slices(voxels)
        voxels_d = resident.whole(stopwatch) if padded is voxels else resident.upload(padded, stopwatch)
        nk, nj, ni = padded.shape
        return RaySlab(voxels_d, (ni, nj, nk), 0, -np.inf, np.inf, choose_brick_cells(resident.volume))

    ni, nj, nk = (max(2, n) for n in resident.volume.shape_ijk)
    cells = choose_brick_cells(resident.volume)
    bricks = math.prod(-(-n // c) for n, c in zip((ni, nj, nk), cells, strict=True))
    return resident.keep(_BRICKS, None, bricks * (2 * resident.dtype.itemsize + 4), make_slab)


def upload_part(resident: DeviceVolume, first: int, end: int, stopwatch: Stopwatch) -> tuple[Any, tuple[int, int, int]]:
    voxels = resident.volume.voxels[first:end]
    padded = pad_slices(voxels)
    nk, nj, ni = padded.shape
    if padded is voxels:
        return resident.part(first, end, stopwatch), (ni, nj, nk)
    resident.make_way()
    return resident.upload(padded, stopwatch), (ni, nj, nk)


ROWS_AT_ONCE = kernel_constant("rays/leaps.cl", "ROWS_AT_ONCE")
"""Rows of bricks for each work-item."""


def measure_cells(resident: DeviceVolume, slab: RaySlab) -> Any:
    """Return the lowest and highest value of samples in each brick of a slab, (bk, bj, bi, 2), on the device."""
    if slab.ranges_d is None:
        bricks, (ni, nj, nk) = math.prod(slab.bricks), slab.shape_ijk
        slab.ranges_d = allocate(resident.device, 2 * bricks * resident.dtype.itemsize)
        launch(
            resident.device, resident.program("rays/leaps.cl")["measure_cells"], bricks,
            voxels=slab.voxels_d, ranges=slab.ranges_d, ni=ni, nj=nj, nk=nk, **slab.brick_arguments,
        )  # fmt: skip
    return slab.ranges_d


def find_leaps(
    resident: DeviceVolume, slab: RaySlab, key: Any, shown: NDArray[np.bool_], low: float, scale: float
) -> LeapMap:
    """Return the leap map for visible values, or the one that was made for `key`, which tells the source of `shown`.

    The visible nodes, (nodes,) bool, are those of a table; nearest to a value v is ``floor((v - low) * scale + 0.5)``.
    """
    known = slab.maps.get(key)
    if known is not None:
        return known
    ranges_d = measure_cells(resident, slab)
    device, program = resident.device, resident.program("rays/leaps.cl")
    bi, bj, bk = slab.bricks
    bricks = bi * bj * bk
    counts_d = upload(device, np.concatenate([[0], np.cumsum(shown)]).astype(np.int32))
    from_d, to_d = allocate(device, bricks), allocate(device, bricks)
    launch(
        device, program["mark_bricks"], bricks, ranges=ranges_d, shown=counts_d, distances=from_d, bins_low=low,
        bins_scale=scale, bins=len(shown), bricks=bricks,
    )  # fmt: skip
    launch(
        device, program["spread_in_rows"], -(-bj * bk // ROWS_AT_ONCE),
        distances=from_d, spread=to_d, bi=bi, rows=bj * bk,
    )  # fmt: skip
    for outer, count, stride in ((bk, bj, bi), (1, bk, bi * bj)):
        from_d, to_d = to_d, from_d
        chunks = -(-stride // 16)
        items = outer * count * chunks
        launch(
            device, program["spread_along"], items,
            distances=from_d, spread=to_d, count=count, stride=stride, chunks=chunks, items=items,
        )  # fmt: skip
    from_d = to_d
    slab.maps.clear()  # one map for a slab: making it takes some milliseconds
    marked = download(device, np.empty((bk, bj, bi), np.uint8), from_d) == 0
    leaps = slab.maps[key] = LeapMap(from_d, _find_box(resident.volume, marked, slab))
    return leaps


def _find_box(volume: Volume, marked: NDArray[np.bool_], slab: RaySlab) -> tuple[Float64Array, Float64Array] | None:
    ends = []
    across = np.any(marked, axis=0)
    occupied = np.any(across, axis=0), np.any(across, axis=1), np.any(marked, axis=(1, 2))
    for along, cells in zip(occupied, slab.brick_cells, strict=True):
        marked_cells = np.flatnonzero(along)
        if not len(marked_cells):
            return None
        ends.append((marked_cells[0] * cells, (marked_cells[-1] + 1) * cells))
    low, high = np.array(ends, dtype=np.float64).T
    low[2] += slab.first_k
    high[2] += slab.first_k
    # Bricks at the ends extend to the border of the volume.
    return enclose(volume, low - BOX_BORDER, high + BOX_BORDER)


class SlabPicture(ABC):
    """A picture of a volume whose slabs are drawn one after the other."""

    smoothing: Smoothing | None = None
    beside: Mapping[str, int] = MappingProxyType({})
    """Bytes on the device of what is made for the picture beside its slabs."""

    def __init__(
        self, resident: DeviceVolume, shot: Shot, ray_step: float, style: LabelStyle | None, warnings: list[str]
    ):
        self.resident, self.shot = resident, shot
        self.ray_step = ray_step
        self.labels = None if style is None else resident.bring(style.labels)
        self.warnings = [*warnings, *([] if self.labels is None else self.labels.warnings)]
        self.stopwatch = Stopwatch()

    @abstractmethod
    def take(self, slices: int) -> Rendering:
        """Take the picture with so many slices in a slab."""

    @abstractmethod
    def draw(self, slab: RaySlab, output: PictureBuffers) -> None:
        """Add a slab to the picture, and wait."""

    def run(self) -> Rendering:
        """Take the picture, with thinner slabs if the device has no room for the planned ones."""
        others, extra = PictureBuffers.needs(self.shot.size)
        planned = plan_ray_slabs(self.resident, {**others, **self.beside}, extra, self.labels, self.smoothing)
        for attempt in self.resident.attempts(RAYS, planned, self.warnings):
            with attempt as slices:
                picture = self.take(slices)
        return picture

    def slabs(self, slices: int) -> Iterator[RaySlab]:
        entry_k = entry_slice(self.resident.volume, self.shot.camera)
        return ray_slabs(self.resident, slices, entry_k, self.stopwatch, self.smoothing)

    def draw_slabs(self, slices: int) -> tuple[PictureBuffers, int]:
        """Return the drawn picture, still on the device, and the number of slabs."""
        nk = self.resident.volume.shape_ijk[2]
        tell = self.shot.progress
        number = 0
        output = PictureBuffers(self.resident.device, self.shot.size, self.shot.background, slices < nk)
        tell("slabs", 0, nk)
        for slab in self.slabs(slices):
            number += 1
            self.draw(slab, output)
            tell("slabs", min(number * slices, nk), nk)
        return output, number

    def describe(self, mode: str, slabs: int, **facts: Any) -> dict[str, Any]:
        facts |= {"ray_step_mm": self.ray_step, "slabs": slabs}
        return describe_picture(mode, self.resident.device, self.stopwatch, self.warnings, **facts)
