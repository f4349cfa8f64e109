"""The solid bone of one labelled vertebra on a lattice in LPS mm, and the points of its surface.

HU and label are resampled (trilinear) on a regular lattice first, so that tilted, sheared and uneven stacks are right.
Where HU cross the level between two points of the lattice, the surface lies at the crossing; elsewhere half way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry import AIR_HU, Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.regions import FACES, Regions
from clrecon.labels.label_levels import Growth, fill_solid
from clrecon.system.light_dataclass import dataclass

Box = tuple[slice, slice, slice]

_LATTICE_STEP_MM = 0.5
"""Step of the lattice: half of a fine voxel, a quarter of a coarse one."""

_QUICK_STRIDE = 2
"""Points of the lattice in one step of the quick distances."""

MARGIN_MM = 3.0
"""What is sampled beyond the label on each side; the walls' profiles of HU need it."""

LARGEST_MM = 250.0
"""Longest side of a label that can be one vertebra, with its transverse and spinous processes."""


@dataclass(frozen=True)
class Lattice:
    """Points in steps of mm along the axes of LPS, from `origin`; the shape is along z, y, x."""

    origin: Float64Array
    step: float
    shape: tuple[int, int, int]

    def points(self, kji: NDArray[Any]) -> Float64Array:
        """Return LPS mm (n, 3) of array indices (n, 3) in the order z, y, x."""
        return self.origin + self.step * np.asarray(kji, dtype=np.float64)[:, ::-1]

    def indices(self, points: Float64Array) -> Float64Array:
        """Return array coordinates, shape (3, n), in the order z, y, x, of LPS mm (n, 3)."""
        return np.ascontiguousarray(((points - self.origin) / self.step).T[::-1])


@dataclass(frozen=True)
class FittedLattice:
    """What a surface fitted to the bone is on a lattice.

    solid: Points within it.
    shares, placed: For each axis, one point shorter along it: part of the step at which the surface crosses it, and
        whether its place was fitted there.
    """

    solid: NDArray[np.bool_]
    shares: Sequence[NDArray[np.float32]]
    placed: Sequence[NDArray[np.bool_]]


Fitted = Callable[[Lattice], FittedLattice]


def sample_volume(volume: Volume, points: Float64Array) -> NDArray[np.float32]:
    """Return HU (trilinear) at LPS mm (n, 3), `AIR_HU` beyond the scan; only the part around the points is read."""
    from scipy.ndimage import map_coordinates

    places = volume.lps_to_ijk(points)[:, ::-1].T
    low = np.maximum(np.floor(places.min(axis=1)).astype(int), 0)
    high = np.minimum(np.ceil(places.max(axis=1)).astype(int) + 1, volume.voxels.shape)
    if (high <= low).any():
        return np.full(len(points), AIR_HU, np.float32)
    box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    part = np.asarray(volume.voxels[box], dtype=np.float32)
    sampled = map_coordinates(part, places - low[:, None], order=1, mode="constant", cval=AIR_HU)
    return np.asarray(sampled, dtype=np.float32)


def label_box(labels: NDArray[Any], number: int, margin: tuple[int, int, int]) -> Box | None:
    """Return the box (k, j, i) of a label in an array, `margin` (k, j, i) larger and within it; None without one."""
    from scipy.ndimage import find_objects

    objects = find_objects((labels == number).view(np.uint8))
    if not objects:
        return None
    return tuple(  # type: ignore[return-value]
        slice(max(0, part.start - more), min(size, part.stop + more))
        for part, more, size in zip(objects[0], margin, labels.shape, strict=True)
    )


def _own(labels: NDArray[Any], number: int, volume: Volume) -> NDArray[np.bool_]:
    """Mark a label's voxels, and those of no label one voxel from it that no other label is nearer to."""
    grown = labels.copy()
    for di, dj, dk in Growth.of(volume, None).offsets:
        shifted = np.zeros_like(labels)
        source, target = [], []
        for step, size in zip((dk, dj, di), labels.shape, strict=True):
            source.append(slice(max(0, step), size + min(0, step)))
            target.append(slice(max(0, -step), size - max(0, step)))
        shifted[tuple(target)] = labels[tuple(source)]
        np.copyto(grown, shifted, where=grown == 0)
    return np.asarray(grown == number)


@dataclass(frozen=True)
class SolidBone:
    """The solid bone of one vertebra: arrays of the lattice, and points (n, 3) of the surface, a step apart, LPS mm.

    hu: At the points of the lattice within `MARGIN_MM` of the label; elsewhere `AIR_HU`.
    mask: True in the label itself, whatever the HU.
    by_hu: True where HU place a point of the surface, by the level or by a fit; False where the label ends or fills.
    steps: Columns: the steps of the scan's voxels along i, j, k, mm.
    fitted: The surface was fitted to the bone, from that at the level on.
    cut: Voxels (m, 3) of the label in the outermost layer of the scan, LPS mm: beyond them the vertebra may go on.
    """

    lattice: Lattice
    hu: NDArray[np.float32]
    solid: NDArray[np.bool_]
    mask: NDArray[np.bool_]
    surface: Float64Array
    by_hu: NDArray[np.bool_]
    level: float
    steps: Float64Array
    cut: Float64Array
    fitted: bool = False

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.surface)

    @cached_property
    def _quick(self) -> NDArray[np.float32]:
        from scipy.ndimage import distance_transform_edt

        # from a point to the nearest one outside; the surface lies half a step before it on average
        step = _QUICK_STRIDE * self.lattice.step
        thin = self.solid[(slice(None, None, _QUICK_STRIDE),) * 3]
        far = distance_transform_edt(np.pad(thin, 1), sampling=step)[1:-1, 1:-1, 1:-1]
        return np.asarray(far - step / 2.0, dtype=np.float32)

    def quick_depth(self, points: Float64Array) -> Float64Array:
        """Return the distance from the surface, mm, below 0 outside, of LPS mm (n, 3), right to about half a mm."""
        from scipy.ndimage import map_coordinates

        places = self.lattice.indices(points) / _QUICK_STRIDE
        return np.asarray(map_coordinates(self._quick, places, order=1, mode="nearest"), dtype=np.float64)

    def nearest(self, points: Float64Array) -> tuple[Float64Array, NDArray[np.intp]]:
        """Return distances (n,) to the nearest points of the surface, and their places in `surface`."""
        distance, index = self._tree.query(points)
        return np.asarray(distance, dtype=np.float64), np.asarray(index, dtype=np.intp)

    def is_solid(self, points: Float64Array) -> NDArray[np.bool_]:
        """Tell of LPS mm (n, 3) whether the nearest point of the lattice is solid; False beyond the lattice."""
        return self._look_up(self.solid, points)

    def is_labelled(self, points: Float64Array) -> NDArray[np.bool_]:
        """Tell of LPS mm (n, 3) whether the nearest point of the lattice has the label; False beyond the lattice."""
        return self._look_up(self.mask, points)

    def _look_up(self, marked: NDArray[np.bool_], points: Float64Array) -> NDArray[np.bool_]:
        index = np.rint(self.lattice.indices(points)).astype(np.intp)
        limits = np.array(self.lattice.shape)[:, None]
        within = ((index >= 0) & (index < limits)).all(axis=0)
        is_marked = np.zeros(len(points), dtype=bool)
        is_marked[within] = marked[tuple(index[:, within])]
        return is_marked

    def depth(self, points: Float64Array) -> Float64Array:
        """Return the distance from the surface, mm, positive inside, of LPS mm (n, 3)."""
        distance, _ = self.nearest(points)
        return np.where(self.is_solid(points), distance, -distance)

    def sample_hu(self, points: Float64Array) -> Float64Array:
        """Return HU (trilinear) at LPS mm (n, 3); beyond the lattice those of its end."""
        from scipy.ndimage import map_coordinates

        sampled = map_coordinates(self.hu, self.lattice.indices(points), order=1, mode="nearest")
        return np.asarray(sampled, dtype=np.float64)


def fill_vertebra(
    volume: Volume, labels: NDArray[Any], number: int, level: float, subject: str, fitted: Fitted | None = None
) -> SolidBone:
    """Make the solid bone of one label on the volume's own grid; `subject` names it in messages.

    Inside is what has the level, HU, and is the label's own (or one voxel beyond), and what that encloses, see
    `clrecon.labels.label_levels.fill_solid`.  The canal is open above and below, and so stays outside.
    """
    margin = tuple(int(np.ceil(MARGIN_MM / step)) + 1 for step in np.array(volume.spacing)[::-1])
    box = label_box(labels, number, margin)  # type: ignore[arg-type]
    if box is None:
        raise RefusedInputError(f"no voxel of {subject} lies in the scan")
    mask = labels[box]
    start = np.array([part.start for part in box])
    vertebra_mask = _own(mask, number, volume)
    voxels = np.asarray(volume.voxels[box], dtype=np.float32)
    dense = np.where(vertebra_mask & (voxels >= level), mask.dtype.type(number), mask.dtype.type(0))
    if not dense.any():
        raise RefusedInputError(
            f"no voxel of {subject} has {level:g} HU or more: they run to {float(voxels[mask == number].max()):g} HU"
        )
    voxels_found = np.argwhere(mask == number)
    ends = ((voxels_found + start == 0) | (voxels_found + start == np.array(volume.voxels.shape) - 1)).any(axis=1)
    places = volume.ijk_to_lps((voxels_found + start)[:, ::-1].astype(np.float64))
    low, high = places.min(axis=0) - MARGIN_MM, places.max(axis=0) + MARGIN_MM
    if (high - low).max() > LARGEST_MM:
        raise RefusedInputError(
            f"{subject} is {(high - low).max() - 2 * MARGIN_MM:.0f} mm long: that is no vertebra, give the label of one"
        )
    solid_voxels = dense.copy()
    fill_solid(solid_voxels, mask, number, (slice(None),) * 3, True)
    counts = np.ceil((high - low) / _LATTICE_STEP_MM).astype(int) + 1
    lattice = Lattice(low, _LATTICE_STEP_MM, (int(counts[2]), int(counts[1]), int(counts[0])))
    filled = (solid_voxels != 0) & (dense == 0)
    parts = (mask == number, vertebra_mask, solid_voxels != 0, filled)
    hu, label, solid = _sample(volume, start, voxels, parts, lattice, level)
    laid = None if fitted is None else fitted(lattice)
    solid = _largest(solid if laid is None else laid.solid)
    surface, by_hu = _cross(lattice, hu, solid, level, laid)
    if not len(surface):
        raise RefusedInputError(f"nothing of {subject} is left at {level:g} HU")
    return SolidBone(
        lattice, hu, solid, label, surface, by_hu, level, np.array(volume.affine[:3, :3]), places[ends],
        laid is not None,
    )  # fmt: skip


def _sample(
    volume: Volume, start: NDArray[Any], voxels: NDArray[np.float32], parts: tuple[NDArray[np.bool_], ...],
    lattice: Lattice, level: float,
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:  # fmt: skip
    """Resample HU and label, plane by plane, and decide which points of the lattice are solid.

    `parts` are the voxels of the label, its own, the solid ones, and those that are filled and not dense.
    """
    from scipy.ndimage import map_coordinates

    nz, ny, nx = lattice.shape
    hu = np.full(lattice.shape, AIR_HU, np.float32)
    mask, solid = np.zeros(lattice.shape, bool), np.zeros(lattice.shape, bool)
    shares = [part.astype(np.float32) for part in parts]
    # the voxels within `MARGIN_MM` of the label, and one more
    from scipy.ndimage import maximum_filter

    size = tuple(2 * (int(np.ceil(MARGIN_MM / step)) + 1) + 1 for step in volume.spacing[::-1])
    near = np.asarray(maximum_filter(parts[1].view(np.uint8), size), dtype=bool)
    y, x = (part.ravel() for part in np.indices((ny, nx)))
    last = np.array(voxels.shape)[:, None] - 0.5
    for z in range(nz):
        points = lattice.points(np.stack((np.full(len(x), z), y, x), axis=1))
        places = volume.lps_to_ijk(points)[:, ::-1].T - start[:, None]
        within = ((places >= -0.5) & (places < last)).all(axis=0)
        within[within] = near[tuple(np.floor(places[:, within] + 0.5).astype(np.intp))]
        places = places[:, within]
        sampled = [map_coordinates(part, places, order=1, mode="nearest") for part in (voxels, *shares)]
        values, label, own_share, whole, filled = sampled
        # a cell whose corners are all solid is so throughout; in others HU decide, and half a filled voxel
        inside = ((values >= level) & (own_share >= 0.5)) | (filled >= 0.5) | (whole >= 1.0 - 1e-4)
        in_plane = within.reshape(ny, nx)
        hu[z][in_plane] = values
        mask[z][in_plane] = label >= 0.5
        solid[z][in_plane] = inside
    return hu, mask, solid


def _largest(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the largest piece of a solid, without the cavities in it."""
    pieces = Regions(solid, FACES)
    solid = pieces.cells_of(np.arange(len(pieces.sizes)) == pieces.sizes.argmax())
    gaps = Regions(~solid, FACES)
    return solid | gaps.cells_of(~gaps.reach_border((0, 1, 2)))


def _cross(
    lattice: Lattice, hu: NDArray[np.float32], solid: NDArray[np.bool_], level: float, fitted: FittedLattice | None
) -> tuple[Float64Array, NDArray[np.bool_]]:
    """Return the points where the steps of the lattice leave the solid, and whether HU place them."""
    points, placed = [], []
    for axis in range(3):
        size = solid.shape[axis]
        first = np.take(solid, range(size - 1), axis=axis)
        second = np.take(solid, range(1, size), axis=axis)
        near_index = np.argwhere(first != second)
        ends = near_index.copy()
        ends[:, axis] += 1
        near_hu, far_hu = hu[tuple(near_index.T)].astype(np.float64), hu[tuple(ends.T)].astype(np.float64)
        outward = first[tuple(near_index.T)]
        inner, outer = np.where(outward, near_hu, far_hu), np.where(outward, far_hu, near_hu)
        if fitted is None:
            by_hu = (inner >= level) & (outer < level)
            share = np.where(by_hu, (near_hu - level) / np.where(near_hu == far_hu, 1.0, near_hu - far_hu), 0.5)
        else:
            by_hu, share = fitted.placed[axis][tuple(near_index.T)], fitted.shares[axis][tuple(near_index.T)]
        crossing = near_index.astype(np.float64)
        crossing[:, axis] += share
        points.append(lattice.points(crossing))
        placed.append(by_hu)
    return np.concatenate(points), np.concatenate(placed)
