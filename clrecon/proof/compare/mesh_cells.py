"""The grid cells that a surface passes through, told by separating axes, exactly, and how far two sets of them agree.

Reference: Akenine-Moller 2001, "Fast 3D triangle-box overlap testing", Journal of Graphics Tools 6(1).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange.coordinates import rounding_step
from clrecon.geometry import Volume
from clrecon.geometry.affine import normal_matrix
from clrecon.geometry.grid import Grid
from clrecon.geometry.iso_rule import layer_normal_matrices
from clrecon.mesh.mesh import Mesh
from clrecon.system.arguments import explains_arguments
from clrecon.system.base_classes import Message
from clrecon.system.pieces import chunks, list_distinct
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record


def meets_box(corners: NDArray[np.float64], half: float) -> NDArray[np.bool_]:
    """Mark triangles that meet a cube around the origin, its faces included.

    Two convex bodies are apart exactly where their shadows on one of 13 lines are: the normals of the cube's faces, the
    normal of the triangle, and the cross products of its edges with those of the cube.

    corners: ndarray, shape (n, 3, 3), float64. Triangle, corner, axis; relative to the middle of its cube, whose edges
        are twice `half` long.
    """
    x = np.ascontiguousarray(corners.transpose(1, 2, 0))  # corner, axis, triangle
    meets = ((x.min(axis=0) <= half) & (x.max(axis=0) >= -half)).all(axis=0)
    edges = x[[1, 2, 0]] - x
    normal = np.cross(edges[0], edges[1], axis=0)
    meets &= np.abs(np.einsum("an,an->n", normal, x[0])) <= half * np.abs(normal).sum(axis=0)
    for edge in range(3):
        third = x[(edge + 2) % 3]
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            # The shadow of both ends of the edge is one point.
            eu, ev = edges[edge, u], edges[edge, v]
            first = eu * x[edge, v] - ev * x[edge, u]
            second = eu * third[v] - ev * third[u]
            reach = half * (np.abs(eu) + np.abs(ev))
            meets &= (np.minimum(first, second) <= reach) & (np.maximum(first, second) >= -reach)
    return np.asarray(meets)


_ROUNDINGS = 2.0
"""Steps of the coordinates by which a triangle may reach into a cell without passing through it: vertices are rounded,
and those of marching cubes stay four steps away from the samples."""

_BITS, _FARTHEST = 21, 1 << 20
"""Bits of a number of a cell for each axis, and the farthest cell from the grid's first that they hold."""

_MOST_CANDIDATES = 64
"""Triangles whose box meets more cells are divided into four, until none does."""

_PIECE = 1 << 16
"""Triangles at a time; the pairs of a triangle and a cell that are tested at once take at most about 100 MB."""

IntArray = NDArray[np.int64]
Triangles = NDArray[np.float64]
"""Corners, shape (n, 3, 3): triangle, corner, axis."""


class GridCells(Message):
    """A set of grid cells: cubes between eight neighbouring voxel centres, numbered by their lowest corner.

    Parameters
    ----------
    ijk : array_like, shape (n, 3), int
        Lowest corners; those beside the voxels, such as -1, belong to the border of a closed volume or lie outside.
    name : str
        What the set is, for reports: "t-mc", "truth".

    Raises
    ------
    UsageError
        The shape or type is wrong, or a cell is more than a million voxels away.
    """

    def __init__(self, ijk: Any, name: str = ""):
        corners = np.asarray(ijk)
        if corners.size == 0:
            corners = np.zeros((0, 3), np.int64)
        if corners.ndim != 2 or corners.shape[1] != 3 or corners.dtype.kind not in "iu":
            raise UsageError(
                f"cells are whole numbers of shape (n, 3), these are {corners.dtype} of shape {corners.shape}"
            )
        self._keys = list_distinct(_pack(corners.astype(np.int64)))
        self._keys.flags.writeable = False
        self.name = name

    @property
    def ijk(self) -> IntArray:
        """Lowest corners, shape (n, 3), int64, each once, ordered by k, j, i."""
        return _unpack(self._keys)

    @property
    def keys(self) -> IntArray:
        """One number a cell, ascending, shape (n,), int64: for operations on sets."""
        return self._keys

    def __len__(self) -> int:
        return len(self._keys)

    def __repr__(self) -> str:
        return f"GridCells({len(self)} cells{f' of {self.name}' if self.name else ''})"


def _pack(ijk: IntArray) -> IntArray:
    if ijk.size and (ijk.min() < -_FARTHEST or ijk.max() >= _FARTHEST):
        raise UsageError(
            f"cells lie between {ijk.min(axis=0).tolist()} and {ijk.max(axis=0).tolist()}, more than {_FARTHEST} from"
            " the first voxel: the surface does not belong to this grid"
        )
    i, j, k = (ijk + _FARTHEST).T
    return np.asarray(k << 2 * _BITS | j << _BITS | i)


def _unpack(keys: IntArray) -> IntArray:
    mask = (1 << _BITS) - 1
    return np.stack([(keys >> (axis * _BITS) & mask) - _FARTHEST for axis in range(3)], axis=1)


@dataclass(frozen=True, eq=False)
class CellOverlap(Record):
    """How far the cells of a surface agree with those of a reference.

    cells_outside: Cells of the surface outside of the grid and its border of one voxel.
    recall: Share of the reference's cells that the surface passes through: the repetition rate of characteristic voxels
        of Liu et al. 2019.
    precision: Share of the surface's cells that are the reference's too.
    dice, jaccard: 2 common / (cells + reference cells); common / all cells of either.
    """

    reference: str
    cells: int
    reference_cells: int
    common_cells: int
    cells_outside: int
    recall: float
    precision: float
    dice: float
    jaccard: float


@explains_arguments
def find_mesh_cells(mesh: Mesh, grid: Grid, *, name: str = "", progress: Progress | None = None) -> GridCells:
    """Find the grid cells that the triangles of a mesh pass through.

    The test of triangle and cell is exact (separating axes), in index coordinates, so that sheared, tilted and uneven
    grids are served too.  A triangle passes through a cell when it reaches farther into it than coordinates are
    rounded.  One that lies in the plane between two cells belongs to the upper one.

    Parameters
    ----------
    mesh : Mesh
    grid : Volume or LabelMap
        The voxels between whose centres the cells lie.
    name : str
        Of the set.
    progress : callable, optional
        Called as ``progress("cells", triangles done, all triangles)``.

    Returns
    -------
    GridCells

    Raises
    ------
    UsageError
        An index of a triangle or a coordinate is wrong, or the mesh reaches farther beyond the grid than the grid is
        large.

    References
    ----------
    Akenine-Moller 2001, "Fast 3D triangle-box overlap testing", Journal of Graphics Tools 6(1).
    """
    mesh.check()
    if mesh.triangle_count == 0:
        return GridCells([], name)
    margin = _ROUNDINGS * rounding_step(mesh.vertices) * _steps_per_mm(grid)
    ijk = grid.lps_to_ijk(mesh.vertices)
    _check_place(ijk, grid)
    report = progress or ignore_progress
    packed = []
    for piece in chunks(mesh.triangle_count, _PIECE):
        report("cells", piece.start, mesh.triangle_count)
        packed += [list_distinct(_pack(cells)) for cells in _cells_of(ijk[mesh.triangles[piece]], min(margin, 0.25))]
    report("cells", mesh.triangle_count, mesh.triangle_count)
    return GridCells(_unpack(list_distinct(np.concatenate(packed))), name)


def _steps_per_mm(grid: Grid) -> float:
    """Return the most index steps that a millimetre can be, in any direction and between any slices."""
    if isinstance(grid, Volume):
        matrices = layer_normal_matrices(grid, 1)
    else:
        matrices = normal_matrix(grid.affine)[None]
    return float(np.linalg.norm(matrices, axis=1).max())


def _check_place(ijk: NDArray[np.float64], grid: Grid) -> None:
    """Refuse a mesh that reaches farther beyond the grid than the grid is large: its cells could be any number."""
    low, high = ijk.min(axis=0), ijk.max(axis=0)
    size = np.array(grid.shape_ijk) + 1
    if (low < -size).any() or (high > 2 * size).any():
        raise UsageError(
            f"the mesh does not belong to this grid: it runs from {low.round(1).tolist()} to"
            f" {high.round(1).tolist()} in voxels (i, j, k) of {list(grid.shape_ijk)}; see whether both are in the same"
            " patient frame"
        )


def _cells_of(triangles: Triangles, margin: float) -> Iterator[IntArray]:
    """Yield cells of triangles, shape (n, 3), some of them several times."""
    # by columns, shape (corner, axis, n): numpy takes the least along a short axis slowly
    columns = np.ascontiguousarray(triangles.transpose(1, 2, 0))
    # triangles in a plane between cells count for the upper cells
    plane = np.rint(columns[0])
    flat = (np.abs(columns - plane) <= margin).all(axis=0)
    corners = lifted = np.where(flat, plane + 0.5, columns)
    owner = np.arange(len(triangles))
    reached = np.zeros(len(triangles), dtype=bool)
    while len(owner):
        low = np.ceil(corners.min(axis=0) - 1.0 + margin).astype(np.int64)
        size = np.maximum(np.floor(corners.max(axis=0) - margin).astype(np.int64) - low + 1, 0)
        count = size.prod(axis=0)
        single = np.flatnonzero(count == 1)
        reached[owner[single]] = True
        yield low.take(single, axis=1).T
        several = np.flatnonzero((count > 1) & (count <= _MOST_CANDIDATES))
        for cells, row in _tested(corners, low, size, several, margin):
            reached[owner[row]] = True
            yield cells
        many = count > _MOST_CANDIDATES
        # four triangles between corners and middles of edges of each
        a, b, c = corners[:, :, many]
        ab, bc = 0.5 * (a + b), 0.5 * (b + c)
        ca = 0.5 * (c + a)
        parts = [np.stack(part) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        corners, owner = np.concatenate(parts, axis=2), np.tile(owner[many], 4)
    # Slivers along an edge between cells reach farther into none of them than coordinates are rounded.
    yield np.floor(lifted[:, :, ~reached].mean(axis=0)).astype(np.int64).T


def _tested(
    corners: Triangles, low: IntArray, size: IntArray, rows: IntArray, margin: float
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the cells of some rows that pass the test, and their rows; all by columns."""
    for piece in chunks(len(rows), _PIECE // _MOST_CANDIDATES * 4):
        part = rows[piece]
        count = size.take(part, axis=1).prod(axis=0)
        pair = part.repeat(count)
        rank = np.arange(len(pair)) - np.repeat(np.cumsum(count) - count, count)
        ni, nj, _ = size.take(pair, axis=1)
        cells = low.take(pair, axis=1) + np.stack([rank % ni, rank // ni % nj, rank // (ni * nj)])
        near = corners.take(pair, axis=2) - (cells + 0.5)
        meets = np.flatnonzero(meets_box(near.transpose(2, 0, 1), 0.5 - margin))
        yield cells.take(meets, axis=1).T, pair[meets]


@explains_arguments
def measure_cells(
    mesh: Mesh | GridCells,
    reference: Mesh | GridCells,
    grid: Grid,
    *,
    reference_name: str | None = None,
    progress: Progress | None = None,
) -> CellOverlap:
    """Measure how far the grid cells of a surface agree with those of a reference.

    Parameters
    ----------
    mesh, reference : Mesh or GridCells
        Surfaces, or their cells where these are known (`find_mesh_cells`, `find_cut_cells`).
    grid : Volume or LabelMap
        The voxels between whose centres the cells lie.
    reference_name : str, optional
        Name of the reference in the result; by default that of its cells, or "reference".
    progress : callable, optional
        As in `find_mesh_cells`.

    Returns
    -------
    CellOverlap

    Raises
    ------
    NoSurfaceError
        A set is empty.
    UsageError
        As `find_mesh_cells`; or the mesh lies wholly outside of the grid.
    """
    mesh_cells = mesh if isinstance(mesh, GridCells) else find_mesh_cells(mesh, grid, progress=progress)
    wanted = reference if isinstance(reference, GridCells) else find_mesh_cells(reference, grid, progress=progress)
    for role, cells in (("surface", mesh_cells), ("reference", wanted)):
        if len(cells) == 0:
            raise NoSurfaceError(f"the {role} passes through no cell: there is nothing to compare")
    corners = mesh_cells.ijk
    outside = int(((corners < -1) | (corners >= np.array(grid.shape_ijk))).any(axis=1).sum())
    if outside == len(mesh_cells):
        raise UsageError(
            f"the mesh lies wholly outside of the grid: its cells run from {corners.min(axis=0).tolist()} to"
            f" {corners.max(axis=0).tolist()}, those of the grid from -1 to {[n - 1 for n in grid.shape_ijk]}; see"
            " whether both are in the same patient frame"
        )
    common = len(np.intersect1d(mesh_cells.keys, wanted.keys, assume_unique=True))
    return CellOverlap(
        reference=reference_name or wanted.name or "reference",
        cells=len(mesh_cells),
        reference_cells=len(wanted),
        common_cells=common,
        cells_outside=outside,
        recall=common / len(wanted),
        precision=common / len(mesh_cells),
        dice=2.0 * common / (len(mesh_cells) + len(wanted)),
        jaccard=common / (len(mesh_cells) + len(wanted) - common),
    )
