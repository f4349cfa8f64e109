"""The bilateral filter of volumes: the host's side of cl/filters/bilateral.cl and cl/filters/near_level.cl."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon import opencl as ocl
from clrecon.geometry import Volume
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.filters.settings import BilateralSettings, finish_result, inside_level
from clrecon.operators.primitives.scan import Compacted, compact, prepare_compact
from clrecon.operators.resident.device_volume import DeviceVolume, take_volume
from clrecon.operators.resident.tables import voxel_variants
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress

_NEAR_GROUP = ocl.kernel_constant("filters/near_level.cl", "GROUP")
"""Voxels of a group."""


@dataclass(frozen=True)
class SlicesThere:
    """`count` slices from `first` on that are on the device; `core_count` from `core_first` on are worked on."""

    voxels_d: Any
    ni: int
    nj: int
    first: int
    count: int
    core_first: int
    core_count: int

    @property
    def rows(self) -> int:
        return self.nj * self.count

    @property
    def core_rows(self) -> int:
        return self.nj * self.core_count


def row_words(ni: int) -> int:
    return -(-ni // (32 * _NEAR_GROUP))


def mixed_group_bytes(ni: int, rows: int, core_rows: int) -> int:
    """Return the most bytes on the device that `list_mixed_groups` takes."""
    words = row_words(ni)
    return 4 * words * (4 * rows + core_rows) + 4 * -(-ni // _NEAR_GROUP) * core_rows


def prepare_near_level(device: Device, dtype: DTypeLike = np.int16) -> Program:
    prepare_compact(device)
    return ocl.load_program(device, "filters/near_level.cl", voxel_variants(dtype))


def list_mixed_groups(
    device: Device, there: SlicesThere, dtype: DTypeLike, level: Any, reach: tuple[int, int, int]
) -> Compacted:
    """List the groups, ascending as ``32 * row_words(ni) * (core row) + group``, near which are both sides of a level.

    there: With all slices within reach of those that are worked on, as far as the volume has them.
    level: Lowest value inside; NaN is not.
    reach: Half the size of the box around a voxel along i, j, k, without its middle; at most 16 along i.
    """
    program, words = prepare_near_level(device, dtype), row_words(there.ni)
    count, core_count = words * there.rows, words * there.core_rows
    some_d, all_d, some_near_d, all_near_d = (ocl.allocate(device, 4 * count) for _ in range(4))
    mask_d = ocl.allocate(device, 4 * core_count)
    ocl.launch(
        device, program["classify_groups"], there.rows, voxels=there.voxels_d, some=some_d,
        every=all_d, level=level, ni=there.ni, rows=there.rows, words=words, reach=reach[0],
    )  # fmt: skip
    ocl.launch(
        device, program["spread_groups"], count, some=some_d, every=all_d, some_near=some_near_d,
        all_near=all_near_d, count=count, words=words, nj=there.nj, reach=reach[1],
    )  # fmt: skip
    ocl.launch(
        device, program["mark_mixed_groups"], core_count, some_near=some_near_d,
        all_near=all_near_d, mask=mask_d, count=core_count, slice_words=words * there.nj, slices=there.count,
        core_first=there.core_first - there.first, reach=reach[2],
    )  # fmt: skip
    return compact(device, mask_d, core_count)


VolumeKind = TypeVar("VolumeKind", Volume, DeviceVolume)

GROUP = ocl.kernel_constant("filters/bilateral.cl", "GROUP")
"""Voxels of a group."""

_BILATERAL = "bilateral filter"
"""Purpose by which slabs are planned."""

_TAPS_A_LAUNCH = 1 << 32
"""Taps of all voxels of a launch: about a second of work, after which progress is told."""


@explains_arguments
def filter_bilateral(
    volume: VolumeKind,
    *,
    sigma_mm: float | None = None,
    sigma_hu: float | None = None,
    dimensions: int = 3,
    near: float | None = None,
    normals: bool = False,
    taps: int | None = None,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> VolumeKind:
    """Filter a volume by distance and difference (Tomasi and Manduchi 1998): noise goes, edges of ``sigma_hu`` stay.

    Each voxel becomes the mean of its neighbours with the weights ``exp(-|t|^2 / (2 sigma_mm^2) - d^2 / (2
    sigma_hu^2))``, ``|t|`` the distance in mm and d the difference in HU.  Distances are those of the voxels' places,
    in anisotropic, sheared and uneven volumes too.  Beyond the border lies the value of the nearest voxel.  NaN and
    infinite voxels of floats stay as they are, and count nowhere.

    The window is the box around the ball of 2.5 sigma_mm.  Of one with more than ``taps`` voxels the nearest stay, in
    whole rings of equal distance.  It removes specks and smooths plateaus; it does not make the surface more accurate:
    see docs/filters.md.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        A `DeviceVolume` is filtered on its device, and the result stays there.
    sigma_mm : float, optional
        Default: one voxel, the geometric mean of its sides.
    sigma_hu : float, optional
        Default: three times the noise, see `clrecon.measure_noise`.
    dimensions : {3, 2}
        2: slice by slice.
    near : float, optional
        An iso value: only voxels near its surface are filtered, in a fraction of the time.  Each voxel is on the same
        side of it as after the whole filter, and the positions of the surface are the same bit for bit, but for those
        where a closed surface ends at the ends of the volume: see ``exact_at_ends``.  All else stays as it was.
    normals : bool
        With ``near``: the voxels that decide the normals at the vertices are filtered too.
    taps : int, optional
        Most voxels of a window, 2 to 4,096; default 125, in 2 dimensions 29.  In slices with square pixels 13 are
        OpenCV's disc of diameter 5.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.  A `DeviceVolume` has its own.
    memory : int, optional
        Most bytes taken on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("filter", slices done, all slices)``.

    Returns
    -------
    Volume or DeviceVolume
        As it was given; in the type of the voxels, whole numbers rounded.  ``report["filtered"]["steps"]`` has an entry
        for each filter: ``filter``, ``dimensions``, ``sigma_mm``, ``sigma_hu``, ``noise_hu`` where it was measured,
        ``taps``, ``window`` (voxels along i, j, k), ``whole_window_taps`` and ``window_share`` (of the weight of the
        whole window), ``near_hu``, ``rings``, ``exact_at_ends`` (with ``near``: False where voxels at the ends of the
        volume lie at ``near_hu`` or above, so that a surface that is closed there has other positions in its ends than
        after the whole filter), ``filtered_share`` (of all voxels) and ``slabs``.  A certificate stays one.

    Raises
    ------
    UsageError
        A sigma is not above 0 or not finite, or longer than the volume; ``taps`` leave no neighbour; there is no soft
        tissue to measure the noise in; integers beyond 2^24.
    NoSurfaceError
        The type of the voxels has no value at ``near``.
    DeviceError
        No device, no room for three slices, or the device fails.
    """
    resident, is_new = take_volume(volume, device, memory, "a filter")
    try:
        settings = BilateralSettings.checked(resident.volume, sigma_mm, sigma_hu, dimensions, near, normals, taps)
        for attempt in resident.with_fallback():
            with attempt as (_, notes):
                filtered: Any = _filter(resident, settings, notes, progress or ignore_progress, keep=not is_new)
        return filtered  # type: ignore[no-any-return]
    finally:
        if is_new:
            resident.close()


def _filter(
    resident: DeviceVolume, settings: BilateralSettings, notes: list[str], progress: Progress, *, keep: bool
) -> Volume | DeviceVolume:
    bilateral = run_bilateral(resident, settings, progress=progress)
    facts = {
        **settings.as_report(),
        "exact_at_ends": None if settings.near is None else not _reach_ends(bilateral.voxels, settings.near),
        "filtered_share": round(bilateral.share, 6),
        "slabs": bilateral.slabs,
    }
    warnings = [*notes, *settings.warnings, *bilateral.warnings]
    return finish_result(resident, bilateral.voxels, bilateral.voxels_d, facts, warnings, keep=keep)


def _reach_ends(voxels: NDArray[Any], level: float) -> bool:
    """Return whether voxels of a level and above lie in the outermost layers."""
    return any(bool((np.take(voxels, (0, -1), axis) >= level).any()) for axis in range(3))


@dataclass(frozen=True)
class Filtered:
    """Filtered voxels, on the device too where they fit as a whole, and the share that went through the filter."""

    voxels: NDArray[Any]
    voxels_d: Any
    share: float
    slabs: int
    warnings: tuple[str, ...]


def run_bilateral(
    resident: DeviceVolume,
    settings: BilateralSettings,
    *,
    stopwatch: Stopwatch | None = None,
    progress: Progress = ignore_progress,
) -> Filtered:
    """Filter the voxels of a volume, slab by slab where they do not fit the device as a whole."""
    run = _Run(resident, settings, stopwatch or Stopwatch(), progress)
    planned = resident.plan(_BILATERAL, resident.volume.shape_ijk[2], run.needs)
    if planned == 0:
        needed = sum(run.needs(1).values())
        raise resident.limits.refusal(f"a slice with the {2 * run.halo} slices around it needs {needed:,} bytes")
    for attempt in resident.attempts(_BILATERAL, planned, run.warnings):
        with attempt as slices:
            result = run.run(slices)
    return result


class _Groups(NamedTuple):
    """Groups of voxels that are filtered: how many, those of a row, and the list of those near the level, if any."""

    total: int
    per_row: int
    listed_d: Any


class _Run:
    """One filtering, whatever the number of slices in a slab."""

    def __init__(self, resident: DeviceVolume, settings: BilateralSettings, stopwatch: Stopwatch, progress: Progress):
        self.resident, self.settings = resident, settings
        self.stopwatch, self.progress = stopwatch, progress
        self.warnings: list[str] = []
        ni, self.nj, self.nk = resident.volume.shape_ijk
        self.ni, self.dtype = ni, resident.dtype
        self.window = settings.window.without_middle()
        reach = self.window.reach
        self.reach = reach[0]
        rings = 0 if settings.near is None else settings.rings
        # A window without neighbours along an axis says nothing of them: the box has them all the same.
        self.box = tuple(min(max(n, 1) + rings, GROUP) for n in reach)
        self.halo = reach[2] if settings.near is None else self.box[2]
        self.row_groups = -(-ni // GROUP)
        inner, inner_end = -(-self.reach // GROUP), (ni - self.reach) // GROUP
        self.inner, self.inner_end = (inner, inner_end) if inner < inner_end else (0, 0)
        self.strips = self.row_groups - (self.inner_end - self.inner)

    def needs(self, slices: int) -> dict[str, int]:
        there = self.nk if slices == self.nk else min(slices + 2 * self.halo, self.nk)
        window = self.settings.window
        strip = (GROUP + 2 * self.reach) * self.dtype.itemsize
        needs = {
            "volume": there * self.resident.slice_bytes,
            "filtered voxels": slices * self.resident.slice_bytes,
            "ends of the rows": there * self.nj * self.strips * strip,
            "window": 4 * window.exponents.size + 20 * window.taps,
        }
        if self.settings.near is not None:
            needs["groups near the level"] = mixed_group_bytes(self.ni, there * self.nj, slices * self.nj)
        return needs

    def run(self, slices: int) -> Filtered:
        device, stopwatch = self.resident.device, self.stopwatch
        with stopwatch.timed("build"):
            variants = {**voxel_variants(self.dtype), "LANES": device.kernel_variants["LANES"]}
            self.program = ocl.load_program(device, "filters/bilateral.cl", variants)
            if self.settings.near is not None:
                prepare_near_level(device, self.dtype)
        window = self.window
        self.tap_rows = window.rows()
        self.tap_rows_d = ocl.upload(device, self.tap_rows)
        steps, self.inner_jk = self._tap_steps()
        self.tap_steps_d = ocl.upload(device, steps)
        self.spatial_d = ocl.upload(device, np.maximum(window.exponents, -1000.0).astype(np.float32))
        self.progress("filter", 0, self.nk)
        shape = (self.nk, self.nj, self.ni)
        if slices == self.nk:
            voxels_d = self.resident.whole(stopwatch)
            filtered, filtered_d = ocl.empty_output(device, shape, self.dtype)
            groups = self._filter(SlicesThere(voxels_d, self.ni, self.nj, 0, self.nk, 0, self.nk), filtered_d)
            with stopwatch.timed("download"):
                filtered = ocl.download(device, filtered, filtered_d)
            return Filtered(filtered, filtered_d, self._share(groups), 1, tuple(self.warnings))
        filtered, groups = np.empty(shape, self.dtype), 0
        for first in range(0, self.nk, slices):
            end = min(first + slices, self.nk)
            there_first, there_end = max(0, first - self.halo), min(end + self.halo, self.nk)
            voxels_d = self.resident.part(there_first, there_end, stopwatch)
            part, part_d = ocl.empty_output(device, (end - first, self.nj, self.ni), self.dtype)
            there = SlicesThere(voxels_d, self.ni, self.nj, there_first, there_end - there_first, first, end - first)
            groups += self._filter(there, part_d)
            with stopwatch.timed("download"):
                filtered[first:end] = ocl.download(device, part, part_d)
            self.resident.volume.release_slices(there_first, end)
        return Filtered(filtered, None, self._share(groups), -(-self.nk // slices), tuple(self.warnings))

    def _tap_steps(self) -> tuple[NDArray[np.int32], tuple[int, int]]:
        """Return the steps to the taps in memory, and how far from the borders along j and k they are used."""
        steps = self.window.offsets.astype(np.int64) @ np.array([1, self.ni, self.ni * self.nj])
        reach = self.settings.window.reach
        if steps.max() > np.iinfo(np.int32).max:  # of slices beyond 100 million voxels: nowhere
            return np.zeros(1, np.int32), (self.nj, self.nk)
        return steps.astype(np.int32), (reach[1], reach[2])

    def _share(self, groups: int) -> float:
        return groups / (self.row_groups * self.nj * self.nk)

    def _filter(self, there: SlicesThere, filtered_d: Any) -> int:
        """Filter the slices that are worked on; return the number of groups that were filtered."""
        device, stopwatch = self.resident.device, self.stopwatch
        width = GROUP + 2 * self.reach
        ends_d = ocl.allocate(device, there.rows * self.strips * width * self.dtype.itemsize)
        sides = {"strips": max(self.strips, 1), "inner": self.inner, "inner_end": self.inner_end, "reach": self.reach}
        with stopwatch.running(device):
            if self.strips:
                ocl.launch(
                    device, self.program["copy_row_ends"], there.rows * self.strips,
                    voxels=there.voxels_d, ends=ends_d, ni=self.ni, rows=there.rows, **sides,
                )  # fmt: skip
            near = self.settings.near
            if near is None:
                groups = _Groups(self.row_groups * there.core_rows, self.row_groups, None)
            else:
                size = there.core_count * self.resident.slice_bytes
                offset = (there.core_first - there.first) * self.resident.slice_bytes
                ocl.copy_buffer(device, there.voxels_d, filtered_d, size, source_offset=offset)
                level = inside_level(self.dtype, near)
                box = (self.box[0], self.box[1], self.box[2])
                mixed_groups = list_mixed_groups(device, there, self.dtype, level, box)
                groups = _Groups(mixed_groups.count, 32 * row_words(self.ni), mixed_groups.positions_d)
            self._launch(there, filtered_d, ends_d, groups, sides)
        return groups.total

    def _launch(self, there: SlicesThere, filtered_d: Any, ends_d: Any, groups: _Groups, sides: dict[str, int]) -> None:
        """Filter all groups, or those of a list, in launches of about a second."""
        device, window = self.resident.device, self.window
        range_factor = math.sqrt(0.5 / math.log(2.0)) / self.settings.sigma_hu
        items = 1 if device.kernel_variants["LANES"] == "8" else GROUP
        slice_groups = self.row_groups * there.nj
        most = max(_TAPS_A_LAUNCH // (GROUP * window.taps * slice_groups), 1) * slice_groups
        for first in range(0, groups.total, most):
            count = min(most, groups.total - first)
            ocl.launch(
                device, self.program["filter_bilateral"], count * items,
                voxels=there.voxels_d, ends=ends_d, tap_rows=self.tap_rows_d, spatial=self.spatial_d,
                groups=self.tap_rows_d if groups.listed_d is None else groups.listed_d, filtered=filtered_d,
                range=range_factor, is_listed=groups.listed_d is not None, first_entry=first,
                group_count=first + count, row_groups=groups.per_row, ni=self.ni, nj=there.nj, nk=self.nk,
                first_k=there.first, core_k=there.core_first, tap_steps=self.tap_steps_d,
                row_count=len(self.tap_rows), steps=window.taps, inner_j=self.inner_jk[0], inner_k=self.inner_jk[1],
                table_taps=window.taps if len(window.exponents) > 1 else 0, **sides,
            )  # fmt: skip
            if groups.listed_d is None:
                ocl.wait(device)
                self.progress("filter", there.core_first + (first + count) // slice_groups, self.nk)
        if groups.listed_d is not None:
            self.progress("filter", there.core_first + there.core_count, self.nk)
