"""`Clip`: the part of space that a picture shows, as planes in LPS mm, and the box of what it can show of a volume."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, map_points
from clrecon.geometry.grid import Grid
from clrecon.geometry.volume import Volume
from clrecon.rendering.views.camera import box_between, box_corners
from clrecon.rendering.views.directions import checked_vector
from clrecon.system.arguments import array_or_empty
from clrecon.system.base_classes import Message


class Clip(Message):
    """The part of space on the inner side of every plane; without planes, all of space.

    >>> Clip.box((-50, -50, 900), (50, 50, 1000)) & Clip.plane(point=(0, 0, 0), normal=(0, 1, 0))

    Parameters
    ----------
    planes : array_like, shape (n, 4)
        Normal and offset of each plane: a point p in LPS mm is kept where ``normal . p >= offset``. Normals may have
        any length; they are scaled to unit vectors, and the offsets with them.

    Raises
    ------
    UsageError
        The planes are not n times four finite numbers, or a normal has length 0.
    """

    def __init__(self, planes: ArrayLike = ()):
        try:
            table = np.array(planes, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise UsageError(f"clip planes are (normal, offset), four numbers each: {error}") from error
        table = table.reshape(0, 4) if table.size == 0 else table
        if table.ndim != 2 or table.shape[1] != 4:
            raise UsageError(f"clip planes are (normal, offset), shape (n, 4); these have shape {table.shape}")
        if not np.isfinite(table).all():
            raise UsageError("a clip plane holds NaN or infinite numbers")
        largest = np.abs(table[:, :3]).max(axis=1, initial=0.0, keepdims=True)
        lengths = largest * np.linalg.norm(table[:, :3] / np.maximum(largest, 1e-12), axis=1, keepdims=True)
        if len(table) and lengths.min() < 1e-12:
            raise UsageError(f"clip plane {int(lengths.argmin())} has a normal of length 0: it has no inner side")
        self._planes: Float64Array = table / lengths + 0.0  # no -0.0, so that equal clips have equal bytes
        self._planes.flags.writeable = False

    @classmethod
    def box(cls, low: ArrayLike, high: ArrayLike) -> Clip:
        """Keep a box along the axes of the patient.

        Parameters
        ----------
        low, high : array_like, shape (3,)
            LPS mm; infinite numbers leave a side open.

        Raises
        ------
        UsageError
            Not three numbers each, or ``low`` is not below ``high``.
        """
        corners = array_or_empty([low, high])
        if corners.shape != (2, 3) or np.isnan(corners).any():
            raise UsageError(f"a clip box has two corners of three numbers in LPS mm, not {low!r} and {high!r}")
        for axis, (below, above) in zip("xyz", corners.T, strict=True):
            if not below < above:
                raise UsageError(f"the clip box runs from {below:g} to {above:g} mm along {axis}: it holds nothing")
        planes = np.vstack([np.column_stack([np.eye(3), corners[0]]), np.column_stack([-np.eye(3), -corners[1]])])
        return cls(planes[np.isfinite(planes[:, 3])])

    @classmethod
    def plane(cls, point: ArrayLike, normal: ArrayLike) -> Clip:
        """Keep the side of a plane that its normal points to.

        Parameters
        ----------
        point : array_like, shape (3,)
            A point of the plane, LPS mm.
        normal : array_like, shape (3,)
            Vector of any length except 0.

        Raises
        ------
        UsageError
            Not three finite numbers each, or a normal of length 0.
        """
        through = checked_vector("the point of a clip plane", point)
        inwards = checked_vector("the normal of a clip plane", normal)
        with np.errstate(over="ignore", invalid="ignore"):  # an offset that is not finite is refused
            return cls([(*inwards, float(np.dot(inwards, through)))])

    @property
    def planes(self) -> Float64Array:
        """Unit normals and offsets in mm, shape (n, 4), float64, read-only."""
        return self._planes

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return which points (n, 3) or (3,), LPS mm, are kept: shape (n,) or one, bool."""
        planes = self._planes
        return map_points(lambda lps: (lps @ planes[:, :3].T >= planes[:, 3]).all(axis=1), points)  # type: ignore

    def __and__(self, other: Clip) -> Clip:
        """Keep only points that both keep."""
        if not isinstance(other, Clip):
            return NotImplemented
        return Clip(np.vstack([self._planes, other._planes]))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Clip) and np.array_equal(self._planes, other._planes)

    def __hash__(self) -> int:
        return hash(self._planes.tobytes())

    def __repr__(self) -> str:
        return f"Clip({self._planes.tolist()})"


class ShownLabels(NamedTuple):
    """Labels on the grid of a volume, (nk, nj, ni), and for each number whether its voxels are shown."""

    voxels: NDArray[np.integer]
    shown: NDArray[np.bool_]


def find_seen_box(
    volume: Volume,
    band: tuple[float, float] = (-math.inf, math.inf),
    *,
    clip: Clip | None = None,
    labels: ShownLabels | None = None,
    slices: Iterable[int] | None = None,
) -> Grid | None:
    """Return the box along the patient's axes around everything that a picture can show of a volume, as one voxel.

    A trilinear value within a band of HU needs a voxel at its low end or above and one at its high end or below, both
    around its place.  So the box holds what lies within a voxel of both kinds: it can be larger than what is seen, and
    is never smaller.  None where nothing can be seen.

    band: (low, high). HU that are shown, infinite where it has no end.
    labels: Voxels of labels that are not shown do not count.
    slices: Only these slices are shown.
    """
    chosen = range(volume.shape_ijk[2]) if slices is None else sorted(slices)
    reach = 1.0 if slices is None else 0.0
    ends = [(np.greater_equal, band[0]), (np.less_equal, band[1])]
    tests = [(test, end) for test, end in ends if math.isfinite(end)]
    places: list[list[tuple[int, ...]]] = [[] for _ in range(max(len(tests), 1))]
    origins = volume.slice_origins()
    for k in chosen:
        layer = volume.voxels[k]
        there = _voxels_kept(volume, origins[k], clip)
        if labels is not None:
            shown = labels.shown[labels.voxels[k]]
            there = shown if there is None else there & shown
        for number in range(len(places)):
            seen = tests[number][0](layer, tests[number][1]) if tests else np.ones(layer.shape, dtype=bool)
            extent = _extent_of_marked(seen if there is None else seen & there)
            if extent is not None:
                places[number].append((k, *extent))
        volume.release_slices(k, k + 1)
    boxes = [_corners_of_extents(volume, np.array(found, dtype=np.float64), reach) for found in places if found]
    if len(boxes) < len(places):
        return None
    low = np.max([box.min(axis=0) for box in boxes], axis=0)
    high = np.min([box.max(axis=0) for box in boxes], axis=0)
    for normal, offset in [] if clip is None else [(plane[:3], plane[3]) for plane in clip.planes]:
        axis = int(np.abs(normal).argmax())
        if abs(normal[axis]) > 1.0 - 1e-12:
            low[axis] = max(low[axis], offset) if normal[axis] > 0 else low[axis]
            high[axis] = min(high[axis], -offset) if normal[axis] < 0 else high[axis]
    return None if (high < low).any() else box_between(low, high)


def check_center(center: object, shown: Grid) -> tuple[float, float, float]:
    """Return the centre of a picture, three numbers in LPS mm."""
    point = checked_vector("the centre of a picture", center)  # type: ignore[arg-type]
    corners = box_corners(shown)
    low, high = corners.min(axis=0), corners.max(axis=0)
    if (np.array(point) < low - 1e-6).any() or (np.array(point) > high + 1e-6).any():
        box = ", ".join(f"{axis} {a:.1f} to {b:.1f}" for axis, a, b in zip("xyz", low, high, strict=True))
        center_text = ", ".join(f"{value:g}" for value in point)
        raise UsageError(
            f"the centre of the picture ({center_text}) lies outside of what is shown, which runs from {box} LPS mm"
            " (are the numbers RAS?)"
        )
    return point


def _voxels_kept(volume: Volume, origin: Float64Array, clip: Clip | None) -> NDArray[np.bool_] | None:
    """Return the voxels of a slice (nj, ni) of which a clip leaves something; None for all."""
    if clip is None:
        return None
    ni, nj, _ = volume.shape_ijk
    columns = volume.affine[:3, :3]
    is_kept = np.ones((nj, ni), dtype=bool)
    for plane in clip.planes:
        along_i, along_j, along_k = plane[:3] @ columns
        reach = abs(along_i) + abs(along_j) + abs(along_k)  # a voxel shows as far as to its neighbours
        is_kept &= (np.arange(nj) * along_j)[:, None] + np.arange(ni) * along_i >= plane[3] - plane[:3] @ origin - reach
    return is_kept


def _extent_of_marked(seen: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """Return the first and last column and row of the marked voxels of a slice, None without any."""
    columns = np.flatnonzero(seen.any(axis=0))
    if not len(columns):
        return None
    rows = np.flatnonzero(seen.any(axis=1))
    return int(columns[0]), int(columns[-1]), int(rows[0]), int(rows[-1])


def _corners_of_extents(volume: Volume, extents: Float64Array, reach: float) -> Float64Array:
    """Return the corners of the extents (k, i0, i1, j0, j1) of slices, LPS mm, larger by a voxel within the volume."""
    most = np.array(volume.shape_ijk) - 0.5
    k, low_i, high_i, low_j, high_j = extents.T
    ends = [
        (np.maximum(low_i - 1.0, -0.5), np.minimum(high_i + 1.0, most[0])),
        (np.maximum(low_j - 1.0, -0.5), np.minimum(high_j + 1.0, most[1])),
        (np.maximum(k - reach, -0.5), np.minimum(k + reach, most[2])),
    ]
    return volume.ijk_to_lps(np.concatenate([np.column_stack(corner) for corner in product(*ends)]))
