"""Ghost slices: foreign slices of a stack, told by how little they have in common with both neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.points.cloud import PointCloud, PointStep
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass

_GHOST_SHARE = 0.75
"""A slice is a ghost where its likeness to both neighbours is below this share of their likeness to each other."""

_WITHIN_SHARE = 0.42
"""And where less than this share of its voxels lies within one of them, or of one of them within it, beyond chance: a
disc between two vertebrae is unlike both, but 89 % of it lies within one, and the base of a skull holds 61 % of one."""

REASON = "ghost slice"


@dataclass(frozen=True)
class GhostSlices:
    """The result of the slice test, ghosts ascending; of untested slices and without voxels to compare figures are NaN.

    points: (nk,). Voxels of the band `hu` in each slice.
    nearest: (nk,). The higher one of Dice's coefficients with the slice before and the one behind.
    around: (nk,). Dice's coefficient of these two slices with each other.
    within: (nk,). Share of a slice's voxels that lie within one of its neighbours, or of a neighbour's within it, the
        largest, corrected for chance: 0 where it is the share that the other takes of its whole slice, 1 where all lie
        within.
    """

    slices: tuple[int, ...]
    points: NDArray[np.int64]
    nearest: NDArray[np.float64]
    around: NDArray[np.float64]
    within: NDArray[np.float64]
    hu: tuple[float, float]
    warnings: tuple[str, ...] = ()

    @property
    def tested(self) -> int:
        """Number of slices that were tested: all with points but the first and the last."""
        return int(((self.points > 0) & np.isfinite(self.around)).sum())

    def as_dict(self) -> dict[str, Any]:
        """Return the entries of a report: ghosts with their figures, and the least like of all others."""
        others = np.where(np.isin(np.arange(len(self.points)), self.slices), np.nan, self._shares())
        return {
            "hu": list(self.hu),
            "slices": len(self.points),
            "slices_tested": self.tested,
            "ghost_slices": [
                {
                    "slice": k,
                    "points": int(self.points[k]),
                    "dice_with_neighbour": round(float(self.nearest[k]), 4),
                    "dice_of_neighbours": round(float(self.around[k]), 4),
                    "share_within_neighbour": round(float(self.within[k]), 4),
                }
                for k in self.slices
            ],
            "ghost_share": _GHOST_SHARE,
            "within_share": _WITHIN_SHARE,
            "least_share_of_others": None if np.isnan(others).all() else round(float(np.nanmin(others)), 4),
        }

    def _shares(self) -> NDArray[np.float64]:
        with np.errstate(divide="ignore", invalid="ignore"):
            shares: NDArray[np.float64] = np.where(self.points > 0, self.nearest / self.around, np.nan)
        return np.where(np.isfinite(shares), shares, np.nan)


def judge_slices(
    counts: NDArray[np.int64], area: int, hu: tuple[float, float], warnings: tuple[str, ...] = ()
) -> GhostSlices:
    """Tell the ghosts by counts (3, nk): voxels of a slice of `area`, in common with the next, and the one after."""
    points, nk = counts[0], counts.shape[1]
    nearest, around, within = np.full((3, nk), np.nan)
    if nk >= 3:
        with np.errstate(divide="ignore", invalid="ignore"):
            likeness = [2.0 * counts[n, : nk - n] / (points[: nk - n] + points[n:]) for n in (1, 2)]
            chance = points / area
            common = counts[1, :-1]
            next_holds = (common / points[:-1] - chance[1:]) / (1.0 - chance[1:])
            holds_next = (common / points[1:] - chance[:-1]) / (1.0 - chance[:-1])
            most = np.fmax(next_holds, holds_next)
        nearest[1:-1] = np.fmax(likeness[0][:-1], likeness[0][1:])
        around[1:-1] = likeness[1]
        within[1:-1] = np.fmax(most[:-1], most[1:])
    # NaN is no ghost.
    ghosts = (points > 0) & (nearest < _GHOST_SHARE * around) & (within < _WITHIN_SHARE)
    return GhostSlices(tuple(np.flatnonzero(ghosts).tolist()), points, nearest, around, within, hu, warnings)


@explains_arguments
def drop_ghost_slices(cloud: PointCloud, found: GhostSlices, *, volume: Volume | None = None) -> PointStep:
    """Remove the points of ghost slices.

    Parameters
    ----------
    cloud : PointCloud
        Voxel centres, or with ``volume`` points of a surface, of which those nearer than one slice to a ghost go.
    found : GhostSlices
        Of the volume that the cloud comes from, see `find_ghost_slices`.
    volume : Volume, optional
        That volume, for clouds without ``ijk``.

    Returns
    -------
    PointStep
        Reason "ghost slice".

    Raises
    ------
    UsageError
        The cloud has no voxel indices and no volume is given, or its slices are not those that were tested.
    """
    nk = len(found.points)
    k = cloud.voxel_slices()
    is_voxels = k is not None
    if k is None:
        if volume is None:
            raise UsageError("the points do not say in which slice they lie: give the volume that they come from")
        k = volume.lps_to_ijk(cloud.points)[:, 2]
    if len(k) and not -1.0 <= k.min() <= k.max() <= nk:
        raise UsageError(f"the points lie in slices {k.min():g} to {k.max():g}, {nk} were tested: another volume")
    removed = np.zeros(len(cloud), np.uint8)
    for ghost in found.slices:
        removed[k == ghost if is_voxels else np.abs(k - ghost) < 1.0] = 1
    left = cloud.select(removed == 0) if removed.any() else cloud
    return PointStep(left, removed, (REASON,), found.as_dict(), found.warnings)


@explains_arguments
def fill_ghost_slices(volume: Volume, found: GhostSlices) -> Volume:
    """Return a volume whose ghosts are copies of the slice before, or behind where that is a ghost too.

    It is for what looks at whole bodies, such as `remove_table`: a screen capture would tie body and table into one.
    No value of a filled slice was measured there: remove its points with `drop_ghost_slices` all the same.

    Parameters
    ----------
    volume : Volume
    found : GhostSlices
        Of this volume.

    Raises
    ------
    UsageError
        The volume has another number of slices than were tested.
    """
    if volume.shape_ijk[2] != len(found.points):
        raise UsageError(f"{len(found.points)} slices were tested, the volume has {volume.shape_ijk[2]}")
    if not found.slices:
        return volume
    voxels = volume.voxels.copy()
    for k in found.slices:
        voxels[k] = volume.voxels[k - 1 if k - 1 not in found.slices else k + 1]
    return volume.with_voxels(voxels)
