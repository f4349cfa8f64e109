"""Labels on the grid of a volume: each voxel gets the nearest label in mm; labels on the same grid stay unchanged."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume, apply_affine
from clrecon.labels.label_map import LabelMap
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_ml

log = get_logger(__name__)

_LEAST_SHARE_INSIDE = 0.01
"""Least share of the labelled voxels inside the volume: labels of a whole body have more in a scan of one joint, of
another scan less."""

ON_GRID = 0.01
"""Tolerance in index steps: grids are the same when no voxel is further off than this."""

BONE_HU = 200.0
"""Voxels of at least this value count as bone in the test for a misplaced label map."""

TIES = 1e-6
"""Tolerance in index steps: half-way between two labels the lower index wins, independent of rounding."""


@dataclass(frozen=True)
class ResampledLabels:
    """A label map on the grid of a volume.

    voxels: (nk, nj, ni), uint8 or uint16.  Do not change it: it may be the map's own array.
    exact: Every voxel of the volume coincides with a voxel of the map or lies outside the map.
    inside: For each number its share of labelled voxels that lie inside the volume, 0 to 1.
    """

    voxels: NDArray[Any]
    exact: bool
    inside: dict[int, float]
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        return f"ResampledLabels({self.voxels.shape}, exact={self.exact}, {len(self.inside)} labels)"


@explains_arguments
def resample_labels(labels: LabelMap, volume: Volume, *, progress: Progress | None = None) -> ResampledLabels:
    """Resample a label map to the grid of a volume: for each voxel the label whose centre is nearest, in mm.

    "Nearest" is meant along the axes of the label grid, as usual for nearest-neighbour interpolation: it is the voxel
    of the map that contains the centre.  Axes in another order or direction are only rearranged.

    Parameters
    ----------
    labels : LabelMap
        On any grid.
    volume : Volume
        Its slices may be uneven.
    progress : callable, optional
        ``progress("resample", done, total)`` in slices.

    Returns
    -------
    ResampledLabels
        ``voxels[k, j, i]`` is the label of ``volume.voxels[k, j, i]``; 0 beyond the map.

    Raises
    ------
    RefusedInputError
        The map names another frame of reference, or less than 1 % of it lies inside the volume.
    UsageError
        The arguments are not a LabelMap and a Volume.
    """
    shares = check_together(labels, volume)
    voxels, exact = _take_labels(labels, volume, progress or ignore_progress)
    misplaced = warn_of_place(labels, volume, voxels)
    log_warnings(log, misplaced)
    return ResampledLabels(voxels, exact, shares, (*labels.warnings, *misplaced))


def warn_of_place(labels: LabelMap, volume: Volume, voxels: NDArray[Any] | None = None) -> list[str]:
    """Return a warning where a map has the shape of the scan and another affine, which its array may not fit.

    Where only the order or direction of the axes differs, as after a careful turn, there is none unless the labels lie
    better in bone at the same indices.

    voxels: The map on the grid of the volume; None: it is brought there if it is needed.
    """
    if labels.shape_ijk != volume.shape_ijk:
        return []
    corners = np.array(_corners(volume), dtype=np.float64)
    places = apply_affine(np.linalg.inv(volume.affine) @ labels.affine, corners)  # in steps of the scan
    if np.abs(places - corners).max() <= ON_GRID:
        return []
    placed = _take_labels(labels, volume, ignore_progress)[0] if voxels is None else voxels
    by_affine, by_index = _shares_of_bone(volume, placed, labels.voxels)
    box, scan = (np.stack((each.min(axis=0), each.max(axis=0))) for each in (places, corners))
    if by_affine >= by_index and np.abs(box - scan).max() <= ON_GRID:
        return []
    names = ("step along i", "step along j", "step along k", "first voxel")
    differing = [
        f"{name} {_triple(one)} and {_triple(other)}"
        for name, one, other in zip(names, labels.affine[:3].T, volume.affine[:3].T, strict=True)
        if _triple(one) != _triple(other)
    ]
    return [
        "the label map has the shape of the scan and another affine (of the map and of the scan:"
        f" {', '.join(differing)} mm): {100 * by_affine:.0f} % of its voxels in the scan have {BONE_HU:g} HU or more"
        f" where its affine puts them, {100 * by_index:.0f} % at the same indices of the scan; if it was drawn on this"
        " scan, save it with the scan's affine"
    ]


def _triple(vector: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{value + 0.0:.4g}' for value in vector)})"


def _shares_of_bone(volume: Volume, *maps: NDArray[Any]) -> list[float]:
    """Return the share of the labelled voxels of each map, on the grid of the volume, that are as dense as bone."""
    counts = np.zeros((len(maps), 2), dtype=np.int64)
    for k, layer in enumerate(volume.voxels):
        dense = layer >= BONE_HU
        for number, voxels in enumerate(maps):
            labelled = voxels[k] > 0
            counts[number] += np.count_nonzero(labelled & dense), np.count_nonzero(labelled)
        volume.release_slices(k, k + 1)
    return [float(dense) / max(int(labelled), 1) for dense, labelled in counts]


def _take_labels(labels: LabelMap, volume: Volume, progress: Progress) -> tuple[NDArray[Any], bool]:
    """Return the labels on the grid of the volume, and whether each voxel coincides with one of the map."""
    aligned = _take_aligned(labels, volume)
    return (aligned, True) if aligned is not None else _take_nearest(labels, volume, progress)


def check_together(labels: LabelMap, volume: Volume) -> dict[int, float]:
    """Refuse a map of another scan; return for each number its share of labelled voxels inside the volume, 0 to 1."""
    if not labels.numbers:
        raise RefusedInputError("the label map is empty: no voxel has a label")
    ours, theirs = volume.report.get("frame_of_reference_hash"), labels.frame_of_reference_hash
    if ours is not None and theirs is not None and ours != theirs:
        raise RefusedInputError(
            f"the label map belongs to frame of reference {theirs}, the CT to {ours} (hashes): it is not verified that"
            " their coordinates agree; choose the labels of this series"
        )
    shares = _shares_inside(labels, volume)
    _check_overlap(labels, volume, shares)
    return shares


def _take_aligned(labels: LabelMap, volume: Volume) -> NDArray[Any] | None:
    """Return the labels, copied if need be; None unless both grids have the same places up to directions and ends."""
    inverse = np.asarray(np.linalg.inv(labels.affine), dtype=np.float64)
    starts = apply_affine(inverse, volume.slice_origins())
    steps = inverse[:3, :3] @ volume.affine[:3, :3]  # columns: steps in the map per step along i, j, k
    whole = np.rint(steps).astype(np.int64)
    origin = np.rint(starts[0]).astype(np.int64)
    size = np.array(volume.shape_ijk)
    if (np.abs(whole).sum(axis=0) != 1).any() or (np.abs(whole).sum(axis=1) != 1).any():
        return None
    off = np.abs(steps - whole)[:, :2] @ size[:2]
    off_slices = np.abs(starts - origin - np.arange(len(starts))[:, None] * whole[:, 2])
    if (off + off_slices).max() > ON_GRID:
        return None
    axes = [int(np.flatnonzero(whole[:, b])[0]) for b in range(3)]  # axes of the map for i, j, k of the volume
    view = labels.voxels.transpose([2 - axes[b] for b in (2, 1, 0)])
    source, target = [], []
    for b in (2, 1, 0):
        sign = whole[axes[b], b]
        first = int(origin[axes[b]])
        length = labels.shape_ijk[axes[b]]
        if sign < 0:
            view = np.flip(view, 2 - b)
            first = length - 1 - first
        begin, end = max(0, -first), min(int(size[b]), length - first)
        source.append(slice(begin + first, max(begin, end) + first))
        target.append(slice(begin, max(begin, end)))
    if view.shape == volume.voxels.shape and not any(part.start for part in (*source, *target)):
        return np.ascontiguousarray(view)
    sampled = np.zeros(volume.voxels.shape, dtype=labels.voxels.dtype)
    sampled[tuple(target)] = view[tuple(source)]
    return sampled


def _take_nearest(labels: LabelMap, volume: Volume, progress: Progress) -> tuple[NDArray[Any], bool]:
    """Take the nearest labels slice by slice: a slice of the volume is a plane in the map, linear along i and j."""
    ni, nj, nk = volume.shape_ijk
    inverse = np.asarray(np.linalg.inv(labels.affine), dtype=np.float64)
    starts = apply_affine(inverse, volume.slice_origins())
    i_step, j_step = inverse[:3, :3] @ volume.affine[:3, 0], inverse[:3, :3] @ volume.affine[:3, 1]
    along = np.arange(ni)[:, None] * i_step, np.arange(nj)[:, None] * j_step
    # A map axis that only i (or only j) moves along needs one index for each column (or row).
    separable = [bool(np.ptp(along[0][:, a]) <= ON_GRID or np.ptp(along[1][:, a]) <= ON_GRID) for a in range(3)]
    sampled = np.zeros((nk, nj, ni), dtype=labels.voxels.dtype)
    exact = True
    for k in range(nk):
        progress("resample", k, nk)
        index, valid = [], np.ones((1, 1), dtype=bool)
        for a, size in enumerate(labels.shape_ijk):
            coordinate = starts[k, a] + along[0][None, :, a] + along[1][:, None, a]
            if separable[a]:
                coordinate = coordinate[:, :1] if np.ptp(along[0][:, a]) <= ON_GRID else coordinate[:1, :]
            nearest = np.floor(coordinate + (0.5 - TIES))
            inside = (nearest >= 0) & (nearest < size)
            exact = exact and bool((np.abs(coordinate - nearest)[inside] <= ON_GRID).all())
            valid = valid & inside
            index.append(np.clip(nearest, 0, size - 1).astype(np.intp))
        if valid.any():
            sampled[k] = np.where(valid, labels.voxels[index[2], index[1], index[0]], 0)
    return sampled, exact


def _shares_inside(labels: LabelMap, volume: Volume) -> dict[int, float]:
    """Return for each label the share of its voxels whose centres lie inside the volume's outermost voxels."""
    upper = np.array(volume.shape_ijk) - 0.5
    corners = volume.lps_to_ijk(apply_affine(labels.affine, _corners(labels)))
    if (corners >= -0.5).all() and (corners <= upper).all():
        return dict.fromkeys(labels.counts, 1.0)
    inside = np.zeros(max(labels.numbers, default=0) + 1, dtype=np.int64)
    for k, plane in enumerate(labels.voxels):
        j, i = np.nonzero(plane)
        if not len(j):
            continue
        points = apply_affine(labels.affine, np.stack([i, j, np.full(len(i), k)], axis=1))
        places = volume.lps_to_ijk(points)
        is_inside = ((places >= -0.5) & (places <= upper)).all(axis=1)
        inside += np.bincount(plane[j[is_inside], i[is_inside]], minlength=len(inside))
    return {number: float(inside[number]) / count for number, count in labels.counts.items()}


def _check_overlap(labels: LabelMap, volume: Volume, shares: dict[int, float]) -> None:
    total = sum(labels.counts.values())
    share = sum(shares[number] * count for number, count in labels.counts.items()) / max(total, 1)
    is_crop = any(volume.report.get(part) is not None for part in ("crop", "sliced"))  # which may leave most labels out
    if share >= _LEAST_SHARE_INSIDE or (is_crop and share > 0.0):
        return
    if is_crop:
        raise RefusedInputError(
            f"no label lies in the crop: the labels span {_extent(labels)}, the cropped CT {_extent(volume)}"
        )
    ml = total * abs(np.linalg.det(labels.affine[:3, :3])) / 1000.0
    raise RefusedInputError(
        f"{100 * share:.2g} % of the labels ({format_ml(ml)}) lie inside the CT: they span {_extent(labels)}, the CT"
        f" {_extent(volume)}; they belong to another scan, or one of both is misplaced"
    )


def _corners(grid: LabelMap | Volume) -> list[tuple[int, ...]]:
    """Return the index coordinates of the eight outermost voxels."""
    return list(product(*((0, n - 1) for n in grid.shape_ijk)))


def _extent(grid: LabelMap | Volume) -> str:
    """Describe the range of the corners: ``x -250..249, y ..., z ... mm``."""
    points = apply_affine(grid.affine, _corners(grid))
    low, high = points.min(axis=0), points.max(axis=0)
    return ", ".join(f"{axis} {a:.0f} to {b:.0f}" for axis, a, b in zip("xyz", low, high, strict=True)) + " mm"
