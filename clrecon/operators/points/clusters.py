"""`cluster_points`: DBSCAN of clouds, of the voxels of a volume on its lattice, of others as free points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import checked_affine
from clrecon.opencl import Device, Stopwatch, check_memory, take_device, with_fallback
from clrecon.operators.masks.voxel_mask import checked_band, mark_band, mark_voxels, mask_bytes
from clrecon.operators.points.free_clusters import cluster_free_points
from clrecon.operators.points.point_extraction import extract_points
from clrecon.operators.points.voxel_clusters import ClusterSearch, checked_min_samples, pad_for, search_bytes
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.points.cloud import PointCloud, PointStep, VoxelNumbers
from clrecon.points.keep import REPORTED, ClusterFigures, measure_clusters
from clrecon.points.stencil import Lattice, Stencil, checked_eps, make_stencil
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import find_bounds
from clrecon.system.progress import Progress, ignore_progress

_DEFAULT_MIN_SAMPLES = 6

_PLANE_PLUS_ONE = "plane+1"
"""For min_samples: one more than the members of the stencil in a slice, so that a lone slice is noise."""

_WIDE_GAP = 1.5
"""Slice gap in pixels above which ``plane+1`` takes much bone too."""

LAYER_MM = 0.02
"""Points whose heights differ by less lie in one layer, because files round coordinates."""

_FEWEST_LAYERS = 4
"""Layers, and points a layer on average, from which on points without an affine are taken to lie in slices."""

_PLACES_CHECKED = 1 << 14
"""Points, evenly spread over the cloud, whose places are compared with their voxels: all would take as long as the
search itself."""

PLACE_TOLERANCE_MM = 0.01
"""Largest distance of a point from its voxel; rounding to float32 and in files is smaller."""


@dataclass(frozen=True, eq=False, repr=False)
class Clustering(PointStep):
    """The result of `cluster_points`: a `PointStep` that removes nothing.

    Attributes
    ----------
    cores : ndarray, shape (n,), bool, or None
        The core points.
    figures : ClusterFigures or None
        The figures of all clusters, for `clrecon.keep_clusters`.
    """

    cores: NDArray[np.bool_] | None = None
    figures: ClusterFigures | None = None


@explains_arguments
def cluster_points(
    cloud: PointCloud | Volume | DeviceVolume,
    eps: float | None = None,
    min_samples: int | str = _DEFAULT_MIN_SAMPLES,
    *,
    hu: ArrayLike | Sequence[float | None] | None = None,
    volume: Volume | DeviceVolume | None = None,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Clustering:
    """Cluster points by density (DBSCAN), equal to scikit-learn label for label for points in the same order.

    Points are core points when at least ``min_samples`` points lie within ``eps``, themselves included.  Core points
    within ``eps`` of each other belong to one cluster.  Clusters are numbered by their first core point; other points
    near core points take the lowest number among these; all others are noise, -1.

    Parameters
    ----------
    cloud : PointCloud, Volume or DeviceVolume
        A cloud of voxel centres (with ``ijk``), a cloud of free points (without), or a volume whose voxels in the band
        ``hu`` are clustered, in the order k, j, i.
    eps : float, optional
        mm in the patient, a ball whatever the spacing.  Distances up to ``eps * (1 + 1e-6)`` are within.  By default
        1.5 times the largest of the steps of the lattice: the pixels and the largest slice gap.  Free points need it.
    min_samples : int or "plane+1"
        1 to 255, of free points any number from 1; 1 gives connected components.  "plane+1" is one more than the
        members of the stencil in a slice: a slice without bone above and below becomes noise.
    hu : (float or None, float or None), optional
        Band in HU, both ends included, for a volume; None leaves an end open.
    volume : Volume or DeviceVolume, optional
        The volume that a cloud comes from, for its lattice.  It is needed where slices are uneven; else the affine of
        the cloud's report will do.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.  A `DeviceVolume` has its own.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("mask", slices done, all slices)`` where the voxels go to the device slab by slab, and as
        ``progress("clusters", done, 4)`` for free points.

    Returns
    -------
    Clustering
        The cloud with labels, its core points, and in ``facts`` eps, min_samples, the members of the stencil (in its
        slice and in all, fewest and most over the slices), the number of clusters, noise points and sheets, and the
        figures of the largest clusters: points, centre, box, principal standard deviations, whether it is a sheet.

    Raises
    ------
    UsageError
        ``eps``, ``min_samples`` or ``hu`` cannot be used, points are no voxels of a known lattice, or there are none.
    DeviceError
        No device, no room for the masks, or the device fails.

    References
    ----------
    Ester, Kriegel, Sander and Xu 1996.
    """
    check_memory(memory)
    tell = progress or ignore_progress
    if eps is not None:
        checked_eps(eps)
    if isinstance(cloud, PointCloud):
        if hu is not None:
            raise UsageError(f"{name_parameter('hu')} says which voxels of a volume are points; a cloud has its points")
        if not len(cloud):
            raise UsageError("the cloud is empty: there is nothing to cluster")
        if not cloud.has_ijk:
            return _cluster_free(cloud, eps, min_samples, volume, device, memory, tell)
        return _cluster_cloud(cloud, eps, min_samples, volume, device, memory)
    if not isinstance(cloud, Volume):
        raise TypeError(type(cloud))
    if hu is None or volume is not None:
        raise UsageError(f"clusters of a volume need {name_parameter('hu', 'LO,HI')} and no other volume")
    with open_volume(cloud, device, memory, "a search for clusters") as resident:
        for attempt in resident.with_fallback():
            with attempt as (_, notes):
                clusters = _cluster_band(resident, checked_band(hu), eps, min_samples, notes, tell)
    return clusters


@dataclass(frozen=True)
class _Request:
    lattice: Lattice
    eps: float
    samples: int
    stencil: Stencil
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, lattice: Lattice, eps: float | None, min_samples: int | str) -> _Request:
        used = lattice.default_eps if eps is None else checked_eps(eps)
        if not isinstance(min_samples, str):
            checked_min_samples(min_samples)
        stencil, warnings = make_stencil(lattice, used), []
        if stencil.is_alone:
            warnings.append(
                f"eps {used:g} mm is below every step of the voxels (the smallest is {lattice.least_step:.4g} mm): no"
                " point has a neighbour"
            )
        elif used * (1.0 + 1e-6) < lattice.largest_gap:
            warnings.append(
                f"eps {used:g} mm is below the largest slice gap of {lattice.largest_gap:.4g} mm: clusters end there,"
                " and each slice is a sheet"
            )
        if min_samples == _PLANE_PLUS_ONE:
            samples = checked_min_samples(stencil.in_plane + 1)
            if lattice.largest_gap > _WIDE_GAP * lattice.pixel:
                warnings.append(
                    f"min_samples {_PLANE_PLUS_ONE} ({samples}) takes much bone where slices are"
                    f" {lattice.largest_gap / lattice.pixel:.1f} pixels apart (over {_WIDE_GAP:g})"
                )
        elif isinstance(min_samples, str):
            raise UsageError(f"min_samples is {min_samples!r}: a whole number, or {_PLANE_PLUS_ONE}, is needed")
        else:
            samples = int(min_samples)
        return cls(lattice, used, samples, stencil, tuple(warnings))

    def describe(self, search: ClusterSearch) -> dict[str, Any]:
        return {
            "eps_mm": self.eps,
            "min_samples": self.samples,
            "stencil_members_in_plane": self.stencil.in_plane,
            "stencil_members": list(self.stencil.members),
            "clusters": search.count,
            "device_bytes": search.device_bytes,
        }

    def finish(
        self, cloud: PointCloud, labels: NDArray[np.int32], cores: NDArray[np.bool_], search: ClusterSearch,
        stopwatch: Stopwatch, notes: list[str],
    ) -> Clustering:  # fmt: skip
        labelled = cloud.changed(labels=labels)
        figures = measure_clusters(labelled)
        warnings = [*notes, *self.warnings]
        if self.samples > len(cloud):
            warnings.append(f"{len(cloud):,} points are fewer than min_samples {self.samples}: all are noise")
        facts = {
            **self.describe(search),
            "core_points": int(np.count_nonzero(cores)),
            "noise_points": int(np.count_nonzero(labels < 0)),
            "sheets": int(figures.sheets.sum()),
            "largest_clusters": figures.as_dicts(REPORTED),
            "device": search.device.label,
            "kernel_seconds": dict(stopwatch.by_kernel),
        }
        removed = np.zeros(len(cloud), dtype=np.uint8)
        return Clustering(labelled, removed, (), facts, tuple(warnings), cores, figures)


def _cluster_band(
    resident: DeviceVolume,
    band: tuple[float, float],
    eps: float | None,
    min_samples: int | str,
    notes: list[str],
    progress: Progress,
) -> Clustering:
    volume, device = resident.volume, resident.device
    stopwatch = Stopwatch()
    request = _Request.of(Lattice.of(volume), eps, min_samples)
    pad = pad_for(request.stencil)
    masks = mask_bytes(volume.shape_ijk, pad)
    needs = search_bytes(masks, request.stencil, volume.shape_ijk[1] * volume.shape_ijk[2])
    beside = {what: size for what, size in needs.items() if what not in masks}
    mask = mark_band(resident, band, pad=pad, beside=beside, stopwatch=stopwatch, progress=progress)
    with stopwatch.running(device):
        search = ClusterSearch(device, mask, request.stencil, request.samples, memory=resident.memory)
        labels, cores = search.label(), search.flag_cores()
    if not len(labels):
        raise UsageError(f"no voxel lies from {band[0]:g} to {band[1]:g} HU: there is nothing to cluster")
    cloud = extract_points(resident, kind="voxels", hu=band)
    return request.finish(cloud, labels, cores, search, stopwatch, notes)


def _cluster_free(
    cloud: PointCloud,
    eps: float | None,
    min_samples: int | str,
    volume: Volume | DeviceVolume | None,
    device: Device | str | int | None,
    memory: int | None,
    progress: Progress,
) -> Clustering:
    if volume is not None:
        raise UsageError("the points are no voxels (they have no ijk), so that a volume says nothing of them")
    if eps is None:
        raise UsageError(
            "the points are no voxels (they have no ijk), so that no lattice gives a distance: name one in mm"
            f" ({name_parameter('eps')}), about twice the spacing of the points"
        )
    if isinstance(min_samples, str):
        raise UsageError(
            f"the points are no voxels (they have no ijk) and lie in no planes: give a whole number in place of"
            f" {min_samples!r} ({name_parameter('min_samples')})"
        )
    free = cluster_free_points(cloud, eps, min_samples, device=device, memory=memory, progress=progress)
    labelled = cloud.changed(labels=free.labels)
    figures = measure_clusters(labelled)
    facts = {**free.facts, "sheets": int(figures.sheets.sum()), "largest_clusters": figures.as_dicts(REPORTED)}
    warnings = (*free.warnings, *_warn_of_layers(cloud, eps))
    return Clustering(labelled, np.zeros(len(cloud), np.uint8), (), facts, warnings, free.cores, figures)


def _warn_of_layers(cloud: PointCloud, eps: float) -> list[str]:
    """Return a warning where eps is below the distance of the slices that free points come from."""
    affine = cloud.report.get("affine_ijk_to_lps_mm")
    if affine is not None:
        step = float(np.linalg.norm(np.asarray(affine, dtype=np.float64)[:3, :3], axis=0).max())
    else:
        step = max(_layer_step(along) for along in cloud.points.T)
    if eps * (1.0 + 1e-6) >= step:
        return []
    return [
        f"eps {eps:g} mm is below the {step:.4g} mm between the slices that the points come from: clusters end where a"
        " surface runs across the slices, and a long bone falls into pieces"
    ]


def _layer_step(along: NDArray[Any]) -> float:
    """Return the largest step between layers of points that are flat along an axis; 0 where they are not in layers."""
    heights = np.sort(along.astype(np.float64))
    gaps = np.diff(heights)
    between = gaps[gaps > LAYER_MM]
    in_layers = len(between) >= _FEWEST_LAYERS and np.ptp(heights) - between.sum() <= LAYER_MM * len(between)
    return float(np.median(between)) if in_layers and len(between) * _FEWEST_LAYERS <= len(heights) else 0.0


def _cluster_cloud(
    cloud: PointCloud,
    eps: float | None,
    min_samples: int | str,
    volume: Volume | DeviceVolume | None,
    device: Device | str | int | None,
    memory: int | None,
) -> Clustering:
    scan = volume.volume if isinstance(volume, DeviceVolume) else volume
    order, lattice, voxels = _find_numbered(cloud, scan) or _find_listed(cloud, scan)
    request = _Request.of(lattice, eps, min_samples)
    chosen_device = take_device(device) if not isinstance(volume, DeviceVolume) else volume.device
    for attempt in with_fallback(chosen_device):
        with attempt as (current, notes):
            stopwatch = Stopwatch()
            with stopwatch.running(current):
                mask = mark_voxels(current, voxels, lattice.shape_ijk, pad=pad_for(request.stencil))
                search = ClusterSearch(current, mask, request.stencil, request.samples, memory=memory)
                labels, cores = search.label(), search.flag_cores()
                if order is not None:
                    labels, cores = _restore_order(search, labels, cores, order)
            clusters = request.finish(cloud, labels, cores, search, stopwatch, notes)
    return clusters


Order = NDArray[np.int64] | None


def _find_numbered(cloud: PointCloud, volume: Volume | None) -> tuple[Order, Lattice, VoxelNumbers] | None:
    """Return order, lattice and voxels of a cloud as it is extracted: numbers of that volume, ascending; else None."""
    voxels = cloud.voxel_numbers
    if volume is None or voxels is None or voxels.shape_ijk != volume.shape_ijk or voxels.numbers.dtype != np.uint32:
        return None
    within = not len(cloud) or int(voxels.numbers[-1]) < volume.voxels.size
    if not (within and (voxels.numbers[1:] > voxels.numbers[:-1]).all()):
        return None
    some = np.arange(0, len(cloud), _stride(cloud))
    _check_places(volume.ijk_to_lps(voxels.take(some).indices()), cloud, is_given=True)
    return None, Lattice.of(volume), voxels


def _find_listed(cloud: PointCloud, volume: Volume | None) -> tuple[Order, Lattice, NDArray[np.int32]]:
    assert cloud.ijk is not None
    order, ijk = _order_voxels(cloud.ijk)
    lattice, first = _find_lattice(cloud, volume)
    return order, lattice, ijk - first


def _order_voxels(ijk: NDArray[np.int32]) -> tuple[NDArray[np.int64] | None, NDArray[np.int32]]:
    """Return the order k, j, i of voxels, None if they have it already, and the voxels in that order."""
    low, high = find_bounds(ijk)
    ni, nj, nk = (high.astype(np.int64) - low + 1).tolist()
    kind = np.int32 if ni * nj * nk < 1 << 31 else np.int64
    i, j, k = (column.astype(kind, copy=False) - kind(first) for column, first in zip(ijk.T, low, strict=True))
    places = (k * kind(nj) + j) * kind(ni) + i
    if (places[1:] > places[:-1]).all():
        return None, ijk
    order = np.argsort(places, kind="stable")
    ijk, places = ijk[order], places[order]
    twice = int((places[1:] == places[:-1]).sum())
    if twice:
        raise UsageError(f"{twice:,} of {len(ijk):,} points have the voxel of another point: a voxel is one point")
    return order, ijk


def _restore_order(
    search: ClusterSearch, labels: NDArray[np.int32], cores: NDArray[np.bool_], order: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Return labels and core points in the order of the cloud, numbered by the first core point in that order."""
    inverse = np.empty_like(order)
    inverse[order] = np.arange(len(order))
    mine, mine_cores = labels[inverse], cores[inverse]
    clusters, firsts = np.unique(mine[mine_cores], return_index=True)
    number = np.zeros(max(search.count, 1), np.int32)
    number[clusters[np.argsort(firsts)]] = np.arange(len(clusters), dtype=np.int32)
    if len(clusters):
        mine = search.label(number[search.run_numbers()])[inverse]
    return mine, mine_cores


def _find_lattice(cloud: PointCloud, volume: Volume | None) -> tuple[Lattice, NDArray[np.int32]]:
    assert cloud.ijk is not None
    low, high = find_bounds(cloud.ijk)
    some = cloud.ijk[:: _stride(cloud)]
    if volume is not None:
        if (low < 0).any() or (high >= volume.shape_ijk).any():
            raise UsageError(
                f"the cloud's voxels run from {low.tolist()} to {high.tolist()}, the volume has {volume.shape_ijk}"
                " voxels: it is another volume"
            )
        _check_places(volume.ijk_to_lps(some), cloud, is_given=True)
        return Lattice.of(volume), np.zeros(3, np.int32)
    affine = cloud.report.get("affine_ijk_to_lps_mm")
    if affine is None:
        raise UsageError("the cloud does not say where its voxels lie: give the volume that it comes from")
    matrix = checked_affine(affine)
    _check_places(some @ matrix[:3, :3].T + matrix[:3, 3], cloud, is_given=False)
    ni, nj, nk = (high - low + 1).tolist()
    return Lattice((ni, nj, nk), matrix), low


def _stride(cloud: PointCloud) -> int:
    """Return the step from one point whose place is compared to the next."""
    return max(1, len(cloud) // _PLACES_CHECKED)


def _check_places(places: NDArray[np.float64], cloud: PointCloud, *, is_given: bool) -> None:
    """Refuse a cloud whose points do not lie at their voxels; `is_given`: the volume is."""
    away = float(np.abs(places - cloud.points[:: _stride(cloud)]).max())
    if away > PLACE_TOLERANCE_MM:
        raise UsageError(
            f"points lie up to {away:.3g} mm from their voxels"
            + (": it is another volume" if is_given else ", as in uneven stacks: give the volume")
        )
