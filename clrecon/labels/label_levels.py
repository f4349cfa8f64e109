"""Labels as bodies: the samples around them, parts and holes inside that are filled, volumes in ml, and the levels at
which their surfaces have the volumes of their voxels, of enclosed labels all together.

The occupancy of a sample is the sum over the 5 x 5 x 5 samples around it that carry the label, weighted by [1 4 6 4 1]
/ 16 along each axis (two rounds of [1 2 1] / 4); beyond the map its outermost samples are repeated.

A label that others enclose has little or no free surface.  Its level also moves the borders that it shares with its
neighbours, and changes their volumes.  So the levels of all of them are found together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.blocks import MM3_PER_ML
from clrecon.geometry.regions import FACES, Regions
from clrecon.labels.label_map import LabelMap
from clrecon.system.light_dataclass import dataclass

REACH = 2
"""Samples each way that count; the kernels have the same number, in cl/surface/label_masks.h."""

FULL = 4 * 16**3
"""The occupancy deep in a label, where it is counted in whole numbers; levels are given in the same unit."""

KEEP = 1 / 16
"""Least distance of a vertex from a sample, as a share of the edge.  Where the mask is rougher than its occupancy, the
vertices around a voxel would otherwise meet in its centre and form triangles without width."""

STEEPNESS = 0.39
"""Change of the occupancy per voxel across a flat border, as a share of `FULL`: 3/8 along the axes, up to 0.40 else."""

START = round(0.475 * FULL)
"""First level that is tried.  Bodies of ten to fifty voxels across keep their volume at 0.46 to 0.485 of `FULL`."""

LEVELS = (FULL // 64, FULL - FULL // 64)
"""Lowest and highest level that is tried.  They include that of a single voxel, whose occupancy is 0.053."""

VOLUME_SHARE = 3e-4
"""Accepted error, as a share of the label's volume: a level with this error or less is kept."""

MOST_TRIALS = 14
"""Most levels that are tried: for large bodies 2 or 3, for tiny ones, whose vertices reach the ends of edges, more."""


def next_level(tried: Sequence[tuple[int, float]], wanted: float, rise: float) -> int:
    """Return the level to try next, by Newton's method, then the secant method, then interpolation between two levels.

    tried: Levels and their volumes, in the order of the trials; the best of them is returned where no other is useful.
    rise: Approximate change of the volume when the level rises by one: below 0.
    """
    if not tried:
        return START
    best = min(tried, key=lambda trial: abs(trial[1] - wanted))
    if abs(best[1] - wanted) <= VOLUME_SHARE * wanted or len(tried) == MOST_TRIALS:
        return best[0]
    volumes = dict(tried)
    low = max((level for level, volume in tried if volume >= wanted), default=LEVELS[0] - 1)
    high = min((level for level, volume in tried if volume < wanted), default=LEVELS[1] + 1)
    if low in volumes and high in volumes:
        share = (volumes[low] - wanted) / (volumes[low] - volumes[high])
        level = low + round(min(max(share, 0.1), 0.9) * (high - low))  # keeps away from both ends
    else:
        if len(tried) > 1:
            (first, volume), (second, other_volume) = sorted(tried, key=lambda trial: abs(trial[1] - wanted))[:2]
            rise = min((other_volume - volume) / (second - first), 0.1 * rise)
        level = best[0] + round((wanted - best[1]) / rise)
    if not low < level < high:
        level = (low + high) // 2
    return level if low < level < high else best[0]


FACES_PER_AREA = 1.5
"""Mean number of voxel faces at a border for one face's area of the border, over all directions."""

MOST_SWEEPS = 16
"""Most rounds of the search: three or four, for tiny labels, whose vertices reach the ends of their edges, more."""

DRIFT = 1e-4
"""Share by which the diagonal is increased: where labels fill a whole map, the equations would not be unique."""


def count_faces(labels: NDArray[Any]) -> NDArray[np.int64]:
    """Count each label's faces (highest number + 1, 2) towards no label and towards others, but at the map's ends."""
    faces = np.zeros((int(labels.max(initial=0)) + 1, 2), np.int64)
    for axis in range(3):
        size = labels.shape[axis]
        ends = np.take(labels, range(size - 1), axis=axis), np.take(labels, range(1, size), axis=axis)
        for inner, outer in (ends, ends[::-1]):
            for column, face in enumerate(
                ((inner != 0) & (outer == 0), (inner != 0) & (outer != 0) & (inner != outer))
            ):
                faces[:, column] += np.bincount(inner[face], minlength=len(faces))
    return faces


def find_enclosed(
    labels: NDArray[Any], faces: NDArray[Any], boxes: Mapping[int, tuple[slice, ...]] | None = None
) -> tuple[int, ...]:
    """Return the labels with more faces to other labels than free (`count_faces`), and the labels that touch them."""
    enclosed = np.flatnonzero(faces[:, 1] > faces[:, 0])
    involved = set(enclosed.tolist())
    for number in enclosed:
        part = labels if boxes is None else labels[boxes[int(number)]]
        involved.update(np.flatnonzero(_count_between(part, int(number))).tolist())
    return tuple(sorted(involved - {0}))


def _count_between(part: NDArray[Any], number: int) -> NDArray[np.int64]:
    """Count the faces between the samples of a label and those of each other number, indexed by that number."""
    faces = np.zeros(int(part.max()) + 1, np.int64)
    for axis in range(3):
        size = part.shape[axis]
        low, high = (np.take(part, ends, axis=axis) for ends in (range(size - 1), range(1, size)))
        for inner, outer in ((low, high), (high, low)):
            faces += np.bincount(outer[(inner == number) & (outer != number)], minlength=len(faces))
    return faces


def level_biases(levels: dict[int, int], size: int) -> NDArray[np.int32]:
    """Return each label's lead over others where they touch (size,), in units of occupancy; 0 if not in `levels`."""
    biases = np.zeros(size, np.int32)
    for number, level in levels.items():
        biases[number] = START - level
    return biases


@dataclass(frozen=True)
class Borders:
    """How the volumes of enclosed labels change with their levels.

    voxels: (n,). Number of voxels of each label.
    slopes: scipy.sparse, (n, n). Number of voxels that label `row` loses when the level of label `column` rises by one.
    parts: (n,). The group of each label; labels that touch, directly or through others, form a group.
    filled: (n,). True for labels of a group that is bounded by the ends of the map alone.
    """

    numbers: tuple[int, ...]
    voxels: NDArray[np.float64]
    slopes: Any
    parts: NDArray[np.integer[Any]]
    filled: NDArray[np.bool_]

    @classmethod
    def of(
        cls, labels: NDArray[Any], numbers: Sequence[int], boxes: Mapping[int, tuple[slice, ...]] | None = None
    ) -> Borders:
        """Count the faces between the labels `numbers`; each box holds its label and the samples around it."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        table = np.full(int(labels.max(initial=0)) + 1, -1)
        table[list(numbers)] = np.arange(len(numbers))
        step = 1.0 / (FACES_PER_AREA * STEEPNESS * FULL)
        entries: list[tuple[int, int, float]] = []
        counts, outlets = [], []
        for row, number in enumerate(numbers):
            part = labels if boxes is None else labels[boxes[number]]
            counts.append(float(np.count_nonzero(part == number)))
            faces = _count_between(part, number)
            outlets.append(faces[0] + faces[1:][table[1 : len(faces)] < 0].sum() > 0)
            shared = faces[1:].sum()  # a lead over another label moves a border as a level twice as large
            entries.append((row, row, (1.0 + DRIFT) * step * (faces[0] + 0.5 * shared)))
            for neighbour in np.flatnonzero(faces):
                if neighbour != 0 and table[neighbour] >= 0:
                    entries.append((row, int(table[neighbour]), -0.5 * step * faces[neighbour]))
        rows, columns, values = zip(*entries, strict=True)
        slopes = coo_array((values, (rows, columns)), shape=(len(numbers),) * 2).tocsc()
        _, parts = connected_components(slopes, directed=False)
        open_parts = np.bincount(parts, outlets) > 0
        return cls(tuple(numbers), np.array(counts), slopes, parts, ~open_parts[parts])

    def share_rest(self, short: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the volumes that labels lack; less an equal share where a group fills the map and cannot get more."""
        weights = np.where(self.filled, self.voxels, 0.0)
        rest = np.bincount(self.parts, np.where(self.filled, short, 0.0))
        share = rest / np.maximum(np.bincount(self.parts, weights), 1.0)
        return short - weights * share[self.parts]


def choose_levels(borders: Borders, measure: Callable[[dict[int, int]], dict[int, float]]) -> dict[int, int]:
    """Choose levels at which enclosed labels have the volumes of their voxels; `measure` returns those of meshes."""
    from scipy.sparse.linalg import spsolve

    levels = dict.fromkeys(borders.numbers, START)
    best: tuple[float, dict[int, int]] | None = None
    for _ in range(MOST_SWEEPS):
        volumes = measure(levels)
        short = borders.voxels - np.array([volumes[number] for number in borders.numbers])
        short = borders.share_rest(short)
        shares = np.abs(short) / borders.voxels
        if best is None or shares.sum() < best[0]:
            best = float(shares.sum()), levels
        if shares.max() <= VOLUME_SHARE:
            break
        steps = np.atleast_1d(spsolve(borders.slopes, short))
        following = {
            number: min(max(levels[number] - round(float(step)), LEVELS[0]), LEVELS[1])
            for number, step in zip(borders.numbers, steps, strict=True)
        }
        if following == levels:
            break
        levels = following
    assert best is not None
    return best[1]


_MOST_OFFSETS = 5000
_SAME_DISTANCE = 1e-6
"""Relative difference; offsets whose lengths differ by less, by rounding alone, are equally near."""


@dataclass(frozen=True)
class Growth:
    """The growth of labels on one grid by mm, or by one voxel in each direction.

    offsets: (n, 3). (di, dj, dk) to the samples around, without (0, 0, 0), nearest in mm first, shear included.
    shells: (n,). Shell numbers from 0; offsets of equal length have the same.
    """

    grow_mm: float | None
    offsets: NDArray[np.int32]
    shells: NDArray[np.int32]

    @classmethod
    def of(cls, volume: Volume, grow_mm: float | None) -> Growth:
        steps = volume.affine[:3, :3]
        if grow_mm is None:
            return cls(None, *_sort(_offsets_within((1, 1, 1)), steps))
        limit = _checked(grow_mm, volume)
        reach = np.floor(limit * np.linalg.norm(np.linalg.inv(steps), axis=1) + 1e-9).astype(int)
        offsets = _offsets_within(tuple(reach))
        near = np.linalg.norm(offsets @ steps.T, axis=1) <= limit * (1.0 + _SAME_DISTANCE)
        return cls(limit, *_sort(offsets[near], steps))

    @property
    def table(self) -> NDArray[np.int32]:
        """Offsets and shells for a device, shape (n, 4)."""
        return np.concatenate([self.offsets, self.shells[:, None]], axis=1)

    @property
    def reach(self) -> tuple[int, int, int]:
        """Largest offset along i, j, k in samples."""
        i, j, k = np.abs(self.offsets).max(axis=0, initial=0)
        return int(i), int(j), int(k)


def _checked(grow_mm: float, volume: Volume) -> float:
    try:
        number = float(grow_mm)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"labels grow by a number of mm, not {grow_mm!r}") from error
    if not (math.isfinite(number) and number >= 0.0):
        raise UsageError(f"labels grow by 0 mm or more, not {number:g}")
    di, dj, dk = volume.spacing
    if 4 / 3 * math.pi * number * number * number / (di * dj * dk) > _MOST_OFFSETS:  # number**3 may overflow
        raise UsageError(
            f"labels cannot grow by {number:g} mm on voxels of {di:.3g} x {dj:.3g} x {dk:.3g} mm: growth mends the"
            " border of a mask, up to some ten voxels"
        )
    return number


def _offsets_within(reach: tuple[Any, ...]) -> NDArray[np.int32]:
    grids: Any = np.meshgrid(*(np.arange(-n, n + 1) for n in reach), indexing="ij")
    offsets = np.stack([grid.ravel() for grid in grids], axis=1).astype(np.int32)
    return offsets[offsets.any(axis=1)]


def _sort(offsets: NDArray[np.int32], steps: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Sort offsets by length and number their shells; within a shell they keep index order despite rounding."""
    lengths = np.linalg.norm(offsets @ steps.T, axis=1)
    order = np.argsort(lengths, kind="stable")
    offsets, lengths = offsets[order], lengths[order]
    shells = np.zeros(len(lengths), dtype=np.int32)
    if len(lengths):
        shells[1:] = np.cumsum(np.diff(lengths) > _SAME_DISTANCE * lengths[:-1])
    order = np.lexsort((*offsets.T, shells))
    return np.ascontiguousarray(offsets[order], dtype=np.int32), shells


Box = tuple[slice, slice, slice]


def find_boxes(labels: NDArray[Any], numbers: tuple[int, ...], reach: tuple[int, int, int]) -> dict[int, Box]:
    """Find the box (k, j, i) of each number's samples in the grid, `reach` (i, j, k) samples and one more around."""
    from scipy.ndimage import find_objects

    objects = find_objects(labels, max_label=max(numbers, default=0))
    boxes = {}
    for number in numbers:
        box = objects[number - 1]
        if box is not None:
            boxes[number] = tuple(
                slice(max(0, part.start - more - 1), min(size, part.stop + more + 1))
                for part, more, size in zip(box, reach[::-1], labels.shape, strict=True)
            )
    return boxes  # type: ignore[return-value]


def fill_solid(solid: NDArray[Any], labels: NDArray[Any], number: int, box: Box, closed: bool) -> int:
    """Make the inside of one label solid, in place; return the number of samples that were filled.

    A sample becomes inside of the label when one of these is true:

    - It is deep in the mask: all 26 neighbours carry the label too.  (The volume's end is no border of the mask.)
    - It carries the label, and no path three samples wide leads to it from outside.
    - It carries no label, and no path at all leads to it from outside.

    A path is a chain of face neighbours of which none is inside or deep.  So where the outside reaches the outermost
    layer of the mask, the HU decide there: they place the outer surface.  Pores of the cortex are too narrow for a
    path.

    solid: (nk, nj, ni). For each sample the label that it is inside of, 0 for none; changed in place.
    labels: (nk, nj, ni). The mask, not grown.
    box: Box of the label and at least one sample around it, as `find_boxes` returns it.
    closed: Everything beyond the border of the volume is outside.
    """
    from scipy.ndimage import binary_dilation, binary_erosion

    cube = np.ones((3, 3, 3), dtype=bool)
    body, mask = solid[box] == number, labels[box] == number
    deep = binary_erosion(mask, cube, border_value=1)
    passable = np.pad(~(body | deep), 1, constant_values=True)
    if not closed:
        _close_ends(passable, box, solid.shape)
    outside = _reach_from_faces(passable)
    wide = _reach_from_faces(passable & ~binary_dilation(np.pad(body, 1), cube))
    wide = binary_dilation(wide, cube) & outside
    inner = (slice(1, -1),) * 3
    filled = (mask & ~wide[inner]) | ((labels[box] == 0) & ~outside[inner])
    filled &= solid[box] == 0
    solid[box][filled] = number
    return int(np.count_nonzero(filled))


def _close_ends(passable: NDArray[np.bool_], box: Box, shape: tuple[int, ...]) -> None:
    """Block the sides of the box where the volume itself ends: no path from outside begins there."""
    for axis, (part, size) in enumerate(zip(box, shape, strict=True)):
        for side, at_end in ((0, part.start == 0), (-1, part.stop == size)):
            if at_end:
                np.moveaxis(passable, axis, 0)[side] = False


def _reach_from_faces(passable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the samples that can be reached from the sides of the box through face neighbours."""
    components = Regions(passable, FACES)
    return components.cells_of(components.reach_border((0, 1, 2)))


def label_ml(labels: LabelMap, number: int) -> float:
    """Return the volume of a label on the map's own grid, ml."""
    return labels.counts.get(number, 0) * abs(float(np.linalg.det(labels.affine[:3, :3]))) / MM3_PER_ML


def count_ml(voxels: NDArray[Any], number: int, box: Box, voxel_ml: NDArray[np.float64]) -> float:
    """Return the ml of the voxels with a number, which all lie in the box; `voxel_ml` is that of `slice_voxel_ml`."""
    return float(np.count_nonzero(voxels[box] == number, axis=(1, 2)) @ voxel_ml[box[0]])
