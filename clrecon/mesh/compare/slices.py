"""A mesh cut into slices again, against the voxels that it was made from."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule, choose_iso_rule
from clrecon.mesh.compare.lattice import Lattice, count_points, exclusive_or, find_level_runs
from clrecon.mesh.compare.parity import find_piercings
from clrecon.mesh.mesh import Mesh
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record

FINER = 3
"""Points of the lattice for each voxel, along each axis."""

OFFSETS = (0.137, 0.271, 0.389)
"""Where the lattice begins, in its own steps along i, j, k: off the planes of the voxels and of each other."""

_MOST_ODD = 0.01
"""Share of the rows with the mesh that it may pierce an odd number of times before it is refused as open."""


@dataclass(frozen=True, eq=False)
class SliceOverlap(Record):
    """How far a mesh, filled in slices, agrees with the voxels' trilinear HU.

    dice: 2 common / (points in the mesh + points in the HU) on the fine lattice.
    voxel_dice: The same on the voxels' own lattice.  It cannot see where on its edge a vertex lies.
    finer: Points of the fine lattice for each voxel and axis.
    points_mesh, points_hu, points_common: Points of the fine lattice inside of the mesh, at the level or above, and
        both.
    rows_odd: Rows of the fine lattice that the mesh pierces an odd number of times, where it is open; left out.
    """

    dice: float
    voxel_dice: float
    finer: int
    points_mesh: int
    points_hu: int
    points_common: int
    rows_odd: int


@explains_arguments
def measure_slices(
    mesh: Mesh,
    volume: Volume,
    iso_value: float,
    *,
    closed: bool = True,
    finer: int = FINER,
    offsets: Sequence[float] = OFFSETS,
    progress: Progress | None = None,
) -> SliceOverlap:
    """Cut a mesh into slices again and compare them with the HU, on a lattice finer than the voxels and off their
    planes.

    A point of the lattice is in the mesh when a row of the lattice has pierced it an odd number of times before.  A
    row that runs through an edge or a vertex pierces one of the triangles there, by half-open intervals.  A point is
    in the bone when the trilinear HU reach the level.

    Parameters
    ----------
    mesh : Mesh
        Closed; the patient frame is that of the volume.
    volume : Volume
        The voxels, uneven ones too.
    iso_value : float
        HU, that of the mesh.
    closed : bool
        The mesh was closed where it leaves the volume: see `extract_isosurface`.
    finer : int
        Points of the lattice for each voxel and axis, 1 to 16.
    offsets : three floats
        Where the lattice begins, in its own steps along i, j, k, from 0 to below 1.
    progress : callable, optional
        Called as ``progress("slices", layers of cells done, all layers)``.

    Returns
    -------
    SliceOverlap

    Raises
    ------
    UsageError
        The mesh is open: more than one row in a hundred is pierced an odd number of times.  Or an argument is wrong,
        or the mesh lies wholly outside of the volume.
    NoSurfaceError
        The mesh is empty.
    """
    mesh.check()
    if mesh.triangle_count == 0:
        raise NoSurfaceError("a mesh without triangles has no slices")
    shifts = _check_lattice(finer, offsets)
    if np.ndim(iso_value):
        raise UsageError(f"slices are compared at one iso value, not at {iso_value!r}")
    rule = choose_iso_rule(volume, iso_value, closed)
    ijk = volume.lps_to_ijk(mesh.vertices)
    _check_place(ijk, volume, rule)
    told = progress or ignore_progress
    lattices = (Lattice.over(volume, rule, int(finer), shifts), Lattice.over(volume, rule, 1, (0.0, 0.0, 0.0)))
    layers = lattices[0].cells_ijk[2]
    found = []
    for n, lattice in enumerate(lattices):
        tell = functools.partial(_tell, told, n * layers, 2 * layers)
        found.append(_count(ijk, mesh.triangles, volume, rule, lattice, tell))
    fine, own = found
    told("slices", 2 * layers, 2 * layers)
    return SliceOverlap(
        dice=fine.dice,
        voxel_dice=own.dice,
        finer=int(finer),
        points_mesh=fine.mesh,
        points_hu=fine.hu,
        points_common=fine.common,
        rows_odd=fine.odd,
    )


def _tell(told: Progress, before: int, total: int, done: int) -> None:
    told("slices", before + done, total)


def _check_lattice(finer: int, offsets: Sequence[float]) -> tuple[float, float, float]:
    if isinstance(finer, bool) or not isinstance(finer, int | np.integer) or not 1 <= finer <= 16:
        raise UsageError(f"the lattice is a whole number of times finer than the voxels, 1 to 16, not {finer!r}")
    if len(offsets) != 3 or not all(0.0 <= offset < 1.0 for offset in offsets):
        raise UsageError(f"the lattice has three offsets from 0 to below 1, not {tuple(offsets)}")
    return float(offsets[0]), float(offsets[1]), float(offsets[2])


def _check_place(ijk: NDArray[np.float64], volume: Volume, rule: IsoRule) -> None:
    low, high = ijk.min(axis=0), ijk.max(axis=0)
    if (high < -rule.border).any() or (low > np.array(volume.shape_ijk) - 1 + rule.border).any():
        raise UsageError(
            f"the mesh lies outside of the volume: it runs from {low.round(1).tolist()} to {high.round(1).tolist()} in"
            f" voxels (i, j, k) of {list(volume.shape_ijk)}; see whether both are in the same patient frame"
        )


@dataclass(frozen=True)
class _Counts:
    mesh: int
    hu: int
    common: int
    odd: int

    @property
    def dice(self) -> float:
        both = self.mesh + self.hu
        return 2.0 * self.common / both if both else 0.0


def _count(
    ijk: NDArray[np.float64],
    triangles: NDArray[np.uint32],
    volume: Volume,
    rule: IsoRule,
    lattice: Lattice,
    told: Callable[[int], None],
) -> _Counts:
    """Count the points of a lattice that are in the mesh, in the HU, and in both."""
    mesh, hu = find_piercings(ijk, triangles, lattice), find_level_runs(volume, rule, lattice, told)
    rows, ends = np.unique(lattice.row_of(mesh), return_counts=True)
    odd = rows[ends % 2 == 1]
    if len(odd) > _MOST_ODD * len(rows):
        raise UsageError(
            f"the mesh is open: {len(odd)} of {len(rows)} rows through it pierce it an odd number of times, and what"
            " lies inside is not defined; close it first"
        )
    if len(odd):
        mesh, hu = (keys[~np.isin(lattice.row_of(keys), odd)] for keys in (mesh, hu))
    own, wanted, apart = count_points(mesh), count_points(hu), count_points(exclusive_or(mesh, hu))
    return _Counts(own, wanted, (own + wanted - apart) // 2, len(odd))
