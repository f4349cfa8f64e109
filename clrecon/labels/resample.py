"""Labels on the grid of a volume: the nearest label in mm, the same numbers where the grids are the same."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import Volume, apply_affine
from clrecon.labels.label_map import LabelMap

__all__ = ["LEAST_SHARE_INSIDE", "ResampledLabels", "resample_labels"]

LEAST_SHARE_INSIDE = 0.01
"""Of the labelled voxels.  A whole body's labels on a scan of one joint have more; those of another scan have not."""

ON_GRID = 0.01
"""Index steps: grids are the same when no voxel is further off than this."""

TIES = 1e-6
"""Index steps; half-way between two labels the lower index wins, whatever rounding does."""


@dataclass(frozen=True)
class ResampledLabels:
    """A label map on the grid of a volume.

    Attributes
    ----------
    voxels : ndarray, shape (nk, nj, ni), uint16
        As those of the volume.
    exact : bool
        Every voxel of the volume lies on one of the map (or outside of it): nothing was chosen by distance.
    inside : dict of int to float
        For each number its share of labelled voxels that lie inside the volume, 0 to 1.
    warnings : tuple of str
    """

    voxels: NDArray[np.uint16]
    exact: bool
    inside: dict[int, float]
    warnings: tuple[str, ...]


def resample_labels(labels: LabelMap, volume: Volume) -> ResampledLabels:
    """Bring a label map to the grid of a volume: for each voxel the label whose centre is nearest, in mm.

    "Nearest" is along the axes of the label grid, as nearest-neighbour interpolation is everywhere: the voxel of the
    map that contains the centre.

    Parameters
    ----------
    labels : LabelMap
    volume : Volume

    Raises
    ------
    RefusedInputError
        The map says that it belongs to another frame of reference, or less than 1 % of it lies inside the volume.
    UsageError
        Not a LabelMap and a Volume.
    """
    if not isinstance(labels, LabelMap) or not isinstance(volume, Volume):
        raise UsageError("a label map is brought to a volume: resample_labels(LabelMap, Volume)")
    if not labels.numbers:
        raise RefusedInputError("the label map is empty: no voxel has a label")
    _check_frame_of_reference(labels, volume)
    shares = _shares_inside(labels, volume)
    _check_overlap(labels, volume, shares)
    voxels, exact = _take_nearest(labels, volume)
    return ResampledLabels(voxels, exact, shares, labels.warnings)


def _check_frame_of_reference(labels: LabelMap, volume: Volume) -> None:
    ours, theirs = volume.report.get("frame_of_reference_hash"), labels.frame_of_reference_hash
    if ours is not None and theirs is not None and ours != theirs:
        raise RefusedInputError(
            f"the label map belongs to frame of reference {theirs}, the CT to {ours} (hashes): the scanner does not"
            " vouch that they lie together; choose the labels of this series"
        )


def _take_nearest(labels: LabelMap, volume: Volume) -> tuple[NDArray[np.uint16], bool]:
    """Slice by slice: a slice of the volume is a plane in the map, flat along i and j."""
    ni, nj, nk = volume.shape_ijk
    inverse = np.asarray(np.linalg.inv(labels.affine), dtype=np.float64)
    starts = apply_affine(inverse, volume.slice_origins())
    i_step, j_step = inverse[:3, :3] @ volume.affine[:3, 0], inverse[:3, :3] @ volume.affine[:3, 1]
    along = np.arange(ni)[:, None] * i_step, np.arange(nj)[:, None] * j_step
    # An axis of the map that only i, or only j, moves along needs one index a column, or a row.
    separable = [bool(np.ptp(along[0][:, a]) <= ON_GRID or np.ptp(along[1][:, a]) <= ON_GRID) for a in range(3)]
    taken = np.zeros((nk, nj, ni), dtype=np.uint16)
    exact = True
    for k in range(nk):
        index, valid = [], np.ones((1, 1), dtype=bool)
        for a, size in enumerate(labels.shape_ijk):
            place = starts[k, a] + along[0][None, :, a] + along[1][:, None, a]
            if separable[a]:
                place = place[:, :1] if np.ptp(along[0][:, a]) <= ON_GRID else place[:1, :]
            nearest = np.floor(place + (0.5 - TIES))
            inside = (nearest >= 0) & (nearest < size)
            exact = exact and bool((np.abs(place - nearest)[inside] <= ON_GRID).all())
            valid = valid & inside
            index.append(np.clip(nearest, 0, size - 1).astype(np.intp))
        if valid.any():
            taken[k] = np.where(valid, labels.voxels[index[2], index[1], index[0]], 0)
    return taken, exact


def _shares_inside(labels: LabelMap, volume: Volume) -> dict[int, float]:
    """For each label the share of its voxels whose centres lie inside the volume's outermost voxels."""
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
        held = ((places >= -0.5) & (places <= upper)).all(axis=1)
        inside += np.bincount(plane[j[held], i[held]], minlength=len(inside))
    return {number: float(inside[number]) / count for number, count in labels.counts.items()}


def _check_overlap(labels: LabelMap, volume: Volume, shares: dict[int, float]) -> None:
    total = sum(labels.counts.values())
    share = sum(shares[number] * count for number, count in labels.counts.items()) / max(total, 1)
    if share >= LEAST_SHARE_INSIDE:
        return
    ml = total * abs(np.linalg.det(labels.affine[:3, :3])) / 1000.0
    raise RefusedInputError(
        f"{100 * share:.2g} % of the labels ({ml:,.1f} ml) lie inside the CT: they span {_extent(labels)}, the CT"
        f" {_extent(volume)}; they belong to another scan, or one of both is misplaced"
    )


def _corners(grid: LabelMap | Volume) -> list[tuple[int, ...]]:
    """Index coordinates of the eight outermost voxels."""
    return list(product(*((0, n - 1) for n in grid.shape_ijk)))


def _extent(grid: LabelMap | Volume) -> str:
    """``x -250..249, y ..., z ... mm``: the corners' range."""
    points = apply_affine(grid.affine, _corners(grid))
    low, high = points.min(axis=0), points.max(axis=0)
    return ", ".join(f"{axis} {a:.0f} to {b:.0f}" for axis, a, b in zip("xyz", low, high, strict=True)) + " mm"
