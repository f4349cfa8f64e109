"""What the middle of the spinal canal looks like, as figures of 0 to 1 for every cell, worked out slice by slice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.spine_cells import (
    CELL_MM,
    Field,
    SpineCells,
    disc_mean,
    grow_cortex,
    heights,
    mean_along_z,
    shifted,
    with_border,
)
from clrecon.system.pieces import in_threads

CANAL_RADIUS, BODY_RADIUS = 5.0, 10.0
RING_MM = (8.0, 10.0, 12.0, 14.0, 16.0)
"""Distances from the middle of the canal at which its wall is looked for."""
SHELL_MM = (12.0, 15.0, 18.0, 21.0, 24.0)
"""Distances from the middle of a vertebral body at which its wall is looked for."""
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
"""Between these lies what a canal holds: fluid, nerves and fat around them."""
TISSUE_HU = -300.0
"""Rows and columns of cells without a value above this are not looked at; values are cut there for the mirror."""
BORDER = 10
"""Cells around the tissue that are looked at too: farther from it nothing that is measured here is above 0."""
PIECE = 4
"""Slices that are worked out together: what is made of them stays in the processor's cache."""


@dataclass(frozen=True)
class Likeness:
    """How much each cell of a box is like the middle of the spinal canal.

    worth: ndarray, shape (nz, ny, nx), float32. Sum of the traits for it, less those against it.
    sure: ndarray, shape (nz, ny, nx), bool. Each trait for it is at least as in `SURE`.
    goes_on: ndarray, shape (nz, ny, nx), bool. The traits of `STILL` are at least as there.
    first: Row and column of the box among the cells; outside of it are only air and what is not measured.
    """

    worth: Field
    sure: NDArray[np.bool_]
    goes_on: NDArray[np.bool_]
    first: tuple[int, int]

    def box_of(self, cells: SpineCells) -> SpineCells:
        """Return the box of the cells that was measured."""
        (row, column), (_, ny, nx) = self.first, self.worth.shape
        return SpineCells(cells.values[:, row : row + ny, column : column + nx], cells.origin)


def measure_likeness(cells: SpineCells, done: Callable[[slice], None]) -> Likeness:
    """Measure how much each cell is like the middle of the spinal canal.

    done: Called in the thread of the caller with the slices that are finished.
    """
    rows, columns = (_extent(cells.values, axis) for axis in (1, 2))
    box = SpineCells(np.ascontiguousarray(cells.values[:, rows, columns]), cells.origin)
    worth = np.empty(box.values.shape, np.float32)
    sure, goes_on = np.empty(box.values.shape, bool), np.empty(box.values.shape, bool)

    def work(where: slice) -> None:
        worth[where], traits = _look(box, where.start, where.stop)
        sure[where] = np.logical_and.reduce([traits[name] >= least for name, least in SURE.items()])
        goes_on[where] = np.logical_and.reduce([traits[name] >= least for name, least in STILL.items()])

    in_threads(work, len(worth), PIECE, done)
    return Likeness(worth, sure, goes_on, (rows.start, columns.start))


def traits_of(cells: SpineCells, k: int) -> dict[str, Field]:
    """Return the traits of the cells of one slice, (ny, nx) each, by their names in `SURE`."""
    return {name: field[0] for name, field in _look(cells, k, k + 1)[1].items()}


def _extent(values: Field, axis: int) -> slice:
    """Return the rows or columns that hold tissue, with a border."""
    count = values.shape[axis]
    has = values.max(axis=tuple({0, 1, 2} - {axis})) > TISSUE_HU
    if not has.any():
        return slice(0, count)
    first, last = int(has.argmax()), count - 1 - int(has[::-1].argmax())
    return slice(max(first - BORDER, 0), min(last + 1 + BORDER, count))


def _look(cells: SpineCells, first: int, end: int) -> tuple[Field, dict[str, Field]]:
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
    """Return the field with the values that each cell has `right` and `back` mm further in its slice, for each way; 0
    beyond the ends.
    """
    steps = [_steps(*way) for way in ways]
    reach = max(abs(n) for step in steps for n in step)
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
        for way in (right, left):
            squares += square[:, :, way]
            sums += padded[:, :, way]
    product, power, total = (
        np.add.reduce([field[:, up + row : up + row + ny] for row in back], axis=0)
        for field in (products, squares, sums)
    )
    count = len(back) * len(aside)
    mean = total / (2.0 * count)
    both = 2.0 * (product - count * mean**2)
    return np.asarray(np.clip(both / (power - 2.0 * count * mean**2 + 1.0), 0.0, 1.0), dtype=np.float32)
