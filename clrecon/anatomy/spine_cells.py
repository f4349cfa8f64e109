"""The coarse grid on which the spinal canal is looked for, and traits, 0 to 1, of the middle of each cell."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.body_cells import sum_blocks
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.volume import Volume
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import in_threads

Field = NDArray[np.float32]

CELL_MM = (2.5, 2.5, 4.0)
"""Size along x, y and z of the cells in which the canal is searched."""
HU_RANGE = (-1024, 1500)
"""Values beyond these count as these in the means."""


@dataclass(frozen=True)
class SpineCells:
    """Mean HU of cells (nz, ny, nx), the lowest slice first, from `origin` on, LPS mm; -1024 outside of the scan."""

    values: Field
    origin: Float64Array

    def around(self, first: int, end: int, reach: int) -> Field:
        """Return the values of some slices and of `reach` more above and below; those at the ends are repeated."""
        return self.values[np.clip(np.arange(first - reach, end + reach), 0, len(self.values) - 1)]


def heights(mm: float) -> int:
    """Return the height of a window of `mm` along z in cells, an odd number."""
    return max(1, round(mm / CELL_MM[2]) | 1)


@dataclass(frozen=True)
class Lattice:
    """Where cells, `block` voxels along i, j, k, lie along x, y, z from the centre of the first one, LPS mm."""

    block: NDArray[np.int64]
    count: NDArray[np.int64]
    origin: Float64Array

    def blocks(self, volume: Volume) -> int:
        """Return the number of blocks along k."""
        return int(volume.shape_ijk[2] // self.block[2])


def plan_cells(volume: Volume) -> Lattice:
    size = np.array(volume.shape_ijk)
    block = np.maximum(1, np.rint(np.minimum(CELL_MM, 2.5) / volume.spacing)).astype(int)
    corners = volume.ijk_to_lps(
        [tuple(n - 0.5 if upper else -0.5 for n, upper in zip(size, bits, strict=True)) for bits in np.ndindex(2, 2, 2)]
    )
    low, high = corners.min(axis=0), corners.max(axis=0)
    count = np.maximum(((high - low) / CELL_MM).astype(int), 1)
    return Lattice(np.minimum(block, size), count, 0.5 * (low + high) - 0.5 * (count - 1) * CELL_MM)


def average_cells(volume: Volume, lattice: Lattice, done: Callable[[slice], None]) -> SpineCells:
    """Average the voxels in blocks of about a cell, then interpolate at the cells; `done` gets the slices of both."""
    means = _average_blocks(volume, lattice, done)
    x, y, z = (lattice.origin[axis] + CELL_MM[axis] * np.arange(lattice.count[axis]) for axis in range(3))
    values = np.empty(lattice.count[::-1], np.float32)
    steps = volume.affine[:3, :3]
    aligned = not volume.uneven and not (steps - np.diag(np.diag(steps))).any()
    interpolate = _interpolate_aligned if aligned else _interpolate

    def fill_layers(layers: slice) -> None:
        for k in range(layers.start, layers.stop):
            values[k] = interpolate(volume, means, lattice.block, x, y, float(z[k]))

    in_threads(fill_layers, len(values), 4, done)
    return SpineCells(values, lattice.origin)


def _average_blocks(volume: Volume, lattice: Lattice, done: Callable[[slice], None]) -> Field:
    """Return the means of blocks of voxels, shape (bk, bj, bi); what is left at the far ends is left out."""
    whole = np.array(volume.shape_ijk) // lattice.block * lattice.block
    fi, fj, fk = (int(n) for n in lattice.block)
    means = np.empty((whole // lattice.block)[::-1], np.float32)
    add: np.dtype[Any] = np.dtype(np.float32)
    if volume.voxels.dtype.kind != "f":  # a type that holds the largest sum of a block, which grows with its voxels
        add = np.promote_types(np.int32, np.min_scalar_type(-HU_RANGE[1] * fi * fj * fk))

    def average(layers: slice) -> None:
        for k in range(layers.start, layers.stop):
            part = np.clip(volume.voxels[fk * k : fk * (k + 1), : whole[1], : whole[0]], *HU_RANGE)
            np.divide(sum_blocks(part, fj, fi, add), fi * fj * fk, out=means[k], casting="same_kind")
            volume.release_slices(fk * k, fk * (k + 1))

    in_threads(average, len(means), 4, done)
    return means


def _interpolate(
    volume: Volume, means: Field, block: NDArray[np.int64], x: Float64Array, y: Float64Array, z: float
) -> Field:
    """Return the means at the cells of a slice; -1024 outside of the scan and where a mean is not a number."""
    from scipy.ndimage import map_coordinates

    size = np.array(volume.shape_ijk)
    plane = np.broadcast_arrays(x, y[:, None], z)
    ijk = volume.lps_to_ijk(np.stack(plane, axis=-1).reshape(-1, 3))
    inside = ((ijk >= -0.5) & (ijk <= size - 0.5)).all(axis=1)
    in_cells = ((ijk + 0.5) / block - 0.5).T[::-1]
    sampled = map_coordinates(means, in_cells, output=np.float32, order=1, mode="nearest")
    return np.where(inside, np.nan_to_num(sampled, nan=-1024.0), np.float32(-1024.0)).reshape(len(y), len(x))


def _interpolate_aligned(
    volume: Volume, means: Field, block: NDArray[np.int64], x: Float64Array, y: Float64Array, z: float
) -> Field:
    """Do the same for a volume whose axes are those of the patient: one axis after the other, which is faster."""
    field: Field = means
    missing = np.zeros((1, 1), bool)
    for axis, places in zip((2, 1, 0), (np.array([z]), y, x), strict=True):
        points = np.zeros((len(places), 3))
        points[:, axis] = places
        ijk = volume.lps_to_ijk(points)[:, axis]
        outside = (ijk < -0.5) | (ijk > volume.shape_ijk[axis] - 0.5)
        along = 2 - axis
        in_cells = np.clip((ijk + 0.5) / block[axis] - 0.5, 0.0, means.shape[along] - 1)
        low = np.minimum(in_cells.astype(np.int64), max(means.shape[along] - 2, 0))
        high = np.minimum(low + 1, means.shape[along] - 1)
        share = (in_cells - low).astype(np.float32).reshape([-1 if n == along else 1 for n in range(3)])
        field = field.take(low, axis=along) * (1.0 - share) + field.take(high, axis=along) * share
        if axis == 2:
            missing = missing | outside[0]
        else:
            missing = missing | (outside[:, None] if axis == 1 else outside)
    return np.where(missing, np.float32(-1024.0), np.nan_to_num(field[0], nan=-1024.0))


def with_border(field: Field, reach: int) -> Field:
    """Return slices with a border of `reach` cells of 0."""
    return np.pad(field, ((0, 0), (reach, reach), (reach, reach)))


def shifted(padded: Field, reach: int, dy: int, dx: int) -> Field:
    """Return a view of slices with a border: each cell has the value `dy` rows and `dx` columns further."""
    ny, nx = padded.shape[1] - 2 * reach, padded.shape[2] - 2 * reach
    return padded[:, reach + dy : reach + dy + ny, reach + dx : reach + dx + nx]


def disc_mean(field: Field, radius: float) -> Field:
    """Return the mean within `radius` mm in each slice; 0 beyond the ends.

    Sums of rows grow from the middle outwards, so that a disc costs as many additions as it has rows and columns.
    """
    reach = int(np.ceil(radius / CELL_MM[0]))
    halves = [int(np.sqrt(max(radius**2 - (dy * CELL_MM[1]) ** 2, -1.0)) / CELL_MM[0] + 1e-9)
              if radius >= abs(dy) * CELL_MM[1] else -1 for dy in range(-reach, reach + 1)]  # fmt: skip
    padded = with_border(field, reach)
    ny, nx = field.shape[1:]
    total, number = np.zeros_like(field), 0
    row = padded[:, :, reach : reach + nx].copy()
    for half in range(max(halves) + 1):
        if half:
            row += padded[:, :, reach - half : reach - half + nx]
            row += padded[:, :, reach + half : reach + half + nx]
        for shift, half_width in enumerate(halves):
            if half_width == half:
                total += row[:, shift : shift + ny]
                number += 2 * half + 1
    total /= number
    return total


def grow_cortex(cells: SpineCells, first: int, end: int, height: float) -> Field:
    """Return the density of cortical bone of some slices, 0 to 1: the largest within `height` mm along z."""
    reach = heights(height) // 2
    part = cells.around(first, end, reach)
    highest = part[: end - first].copy()
    for n in range(1, 2 * reach + 1):
        np.maximum(highest, part[n : n + end - first], out=highest)
    return np.asarray(np.clip((highest - 170.0) / 130.0, 0.0, 1.0))


def mean_along_z(part: Field, height: int) -> Field:
    """Return the means of `height` slices each, one slice fewer than `height` less than there are."""
    count = len(part) - height + 1
    total = part[:count].copy()
    for n in range(1, height):
        total += part[n : n + count]
    total /= height
    return total


CANAL_RADIUS, BODY_RADIUS = 5.0, 10.0
RING_MM = (8.0, 10.0, 12.0, 14.0, 16.0)
"""Distances from the middle of the canal at which its wall is searched."""
SHELL_MM = (12.0, 15.0, 18.0, 21.0, 24.0)
"""Distances from the middle of a vertebral body at which its wall is searched."""
BODY_AHEAD_MM = (20.0, 24.0, 28.0)
"""Distances from the middle of the canal to the middle of the vertebral body."""
DIRECTIONS = 16
WORTH = 2.2
"""Score that counts neither for nor against the path; the canal has about 3.2."""
SURE = {"wall": 0.75, "mirror": 0.55, "body": 0.25, "soft": 0.6}
"""A cell is sure when each of its traits is at least this."""
STILL = {name: least for name, least in SURE.items() if name != "mirror"}
"""Beside a sure cell the canal goes on in a cell with these traits: a scan that is cropped at one side, or a patient
who lies askew, has left and right that are not alike."""
SOFT_HU = (-80.0, 130.0)
"""The contents of a canal lie in this range: cerebrospinal fluid, nerves, and the fat around them."""
TISSUE_HU = -300.0
"""Rows and columns of cells without a higher value are not searched; the comparison of left and right clips to this."""
_BORDER = 10
"""Cells around the tissue that are looked at too: farther from it nothing that is measured here is above 0."""
PIECE = 4
"""Slices that are worked out together: what is made of them stays in the processor's cache."""


@dataclass(frozen=True)
class Likeness:
    """How much each cell (nz, ny, nx) of a box, from row and column `first`, is like the middle of the spinal canal.

    worth: Sum of the traits for it, less those against it.
    sure, goes_on: Each trait for it is at least as in `SURE`, or those of `STILL` as there.
    """

    worth: Field
    sure: NDArray[np.bool_]
    goes_on: NDArray[np.bool_]
    first: tuple[int, int]

    def box_of(self, cells: SpineCells) -> SpineCells:
        (row, column), (_, ny, nx) = self.first, self.worth.shape
        return SpineCells(cells.values[:, row : row + ny, column : column + nx], cells.origin)


def measure_likeness(cells: SpineCells, done: Callable[[slice], None], bounds: Mapping[str, float] = SURE) -> Likeness:
    """Measure how much each cell is like the canal's middle; `done` is called in this thread with finished slices."""
    rows, columns = (_extent(cells.values, axis) for axis in (1, 2))
    box = SpineCells(np.ascontiguousarray(cells.values[:, rows, columns]), cells.origin)
    worth = np.empty(box.values.shape, np.float32)
    sure, goes_on = np.empty(box.values.shape, bool), np.empty(box.values.shape, bool)

    def measure_layers(layers: slice) -> None:
        worth[layers], traits = _measure_traits(box, layers.start, layers.stop)
        sure[layers] = np.logical_and.reduce([traits[name] >= least for name, least in bounds.items()])
        goes_on[layers] = np.logical_and.reduce([traits[name] >= least for name, least in STILL.items()])

    in_threads(measure_layers, len(worth), PIECE, done)
    return Likeness(worth, sure, goes_on, (rows.start, columns.start))


def traits_of(cells: SpineCells, k: int) -> dict[str, Field]:
    """Return the traits of the cells of one slice, (ny, nx) each, by their names in `SURE`."""
    return {name: field[0] for name, field in _measure_traits(cells, k, k + 1)[1].items()}


def _extent(values: Field, axis: int) -> slice:
    """Return the rows or columns that hold tissue, with a border."""
    count = values.shape[axis]
    has = values.max(axis=tuple({0, 1, 2} - {axis})) > TISSUE_HU
    if not has.any():
        return slice(0, count)
    first, last = int(has.argmax()), count - 1 - int(has[::-1].argmax())
    return slice(max(first - _BORDER, 0), min(last + 1 + _BORDER, count))


def _measure_traits(cells: SpineCells, first: int, end: int) -> tuple[Field, dict[str, Field]]:
    """Return what the cells of some slices are worth, and their traits by name."""
    bone_reach = heights(16.0) // 2
    bone = np.clip((cells.around(first, end, bone_reach) - 110.0) / 130.0, 0.0, 1.0)
    bone = mean_along_z(bone, 2 * bone_reach + 1)
    values = cells.values[first:end]
    soft = disc_mean(((values > SOFT_HU[0]) & (values < SOFT_HU[1])).astype(np.float32), CANAL_RADIUS)
    cortex = grow_cortex(cells, first, end, 24.0)
    wide = np.pad(cortex, ((0, 0), (1, 0), (1, 0)), mode="edge")
    cortex = np.maximum(np.maximum(wide[:, 1:, 1:], wide[:, :-1, 1:]), np.maximum(wide[:, 1:, :-1], wide[:, :-1, :-1]))
    wall = _enclosed(cortex, RING_MM)
    body = 0.5 * disc_mean(bone, BODY_RADIUS) + 0.5 * _enclosed(grow_cortex(cells, first, end, 12.0), SHELL_MM)
    body = _highest(body, [(0.0, -ahead) for ahead in BODY_AHEAD_MM])
    thick, thin = disc_mean(bone, 12.0), disc_mean(bone, CANAL_RADIUS)
    right, left = _moved(thin, [(36.0, -24.0), (-36.0, -24.0)])
    beside = np.minimum(right + left, 1.0)
    behind = _highest(thick, [(0.0, 50.0), (0.0, 64.0)])
    worth = body + wall + 0.5 * soft - disc_mean(bone, 4.0) - 0.5 * beside - behind
    mirror = np.where((worth > WORTH - 1.3) & (soft > 0.4), _mirrored(cells, first, end), np.float32(0.0))
    traits = {"wall": wall, "mirror": mirror, "body": body, "soft": soft}
    return worth + mirror, traits


def _steps(right: float, back: float) -> tuple[int, int]:
    """Return a distance to the right and to the back in mm as rows and columns."""
    return round(back / CELL_MM[1]), round(right / CELL_MM[0])


def _moved(field: Field, ways: list[tuple[float, float]]) -> list[Field]:
    """Return, for each way, the values so many mm further right and back in the slices; 0 beyond the ends."""
    steps = [_steps(*way) for way in ways]
    reach = int(np.abs(steps).max())
    padded = with_border(field, reach)
    return [shifted(padded, reach, dy, dx) for dy, dx in steps]


def _highest(field: Field, ways: list[tuple[float, float]]) -> Field:
    return np.asarray(np.maximum.reduce(_moved(field, ways)))


def _enclosed(bone: Field, distances: tuple[float, ...]) -> Field:
    """Return the share of the directions in which bone stands at one of the distances."""
    reach = int(np.ceil(max(distances) / min(CELL_MM[:2])))
    padded = with_border(np.minimum(bone / 0.7, 1.0), reach)
    sums, wall = np.zeros_like(bone), np.empty_like(bone)
    for angle in np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS):
        steps = {_steps(distance * np.cos(angle), distance * np.sin(angle)) for distance in distances}
        views = [shifted(padded, reach, dy, dx) for dy, dx in sorted(steps)]
        np.maximum(views[0], views[-1], out=wall)
        for view in views[1:-1]:
            np.maximum(wall, view, out=wall)
        sums += wall
    sums /= DIRECTIONS
    return sums


def _mirrored(cells: SpineCells, first: int, end: int) -> Field:
    """Correlate the left with the mirrored right: 40 mm to the sides, 44 mm to the front and 36 mm to the back.

    All sums are sums of products of shifted slices: first over the columns to the sides, then over the rows.
    """
    height = heights(9.0)
    # What is subtracted changes no correlation, and leaves the products smaller.
    smooth = np.clip(cells.around(first, end, height // 2), TISSUE_HU, 500.0) - 50.0
    smooth = mean_along_z(smooth.astype(np.float32), height)
    wide = np.pad(smooth, ((0, 0), (1, 0), (1, 0)), mode="edge")
    smooth = 0.25 * (wide[:, 1:, 1:] + wide[:, :-1, 1:] + wide[:, 1:, :-1] + wide[:, :-1, :-1])
    back = range(round(-44.0 / CELL_MM[1]), round(36.0 / CELL_MM[1]) + 1, 2)
    aside = range(1, round(40.0 / CELL_MM[0]) + 1, 2)
    up, reach = -back[0], aside[-1]
    ny, nx = smooth.shape[1:]
    padded = np.pad(smooth, ((0, 0), (up, back[-1]), (reach, reach)), mode="edge")
    products, squares, sums = (np.zeros((*padded.shape[:2], nx), np.float32) for _ in range(3))
    square = padded**2
    for step in aside:
        right, left = slice(reach + step, reach + step + nx), slice(reach - step, reach - step + nx)
        products += padded[:, :, right] * padded[:, :, left]
        for side in (right, left):
            squares += square[:, :, side]
            sums += padded[:, :, side]
    product, power, total = (
        np.add.reduce([field[:, up + row : up + row + ny] for row in back], axis=0)
        for field in (products, squares, sums)
    )
    count = len(back) * len(aside)
    mean = total / (2.0 * count)
    both = 2.0 * (product - count * mean**2)
    return np.asarray(np.clip(both / (power - 2.0 * count * mean**2 + 1.0), 0.0, 1.0), dtype=np.float32)
