"""Slices whose voxels of a band are unlike those of both neighbours: the host side of cl/points/slice_overlap.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry import Volume
from clrecon.opencl import Device, Stopwatch, allocate, download, launch, load_program
from clrecon.operators.masks.voxel_mask import VoxelMask, checked_band, mark_band
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.points.ghost_slices import GhostSlices, judge_slices
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress, ignore_progress


def count_overlaps(device: Device, mask: VoxelMask) -> NDArray[np.int64]:
    """Count the voxels of each slice, and those in common with the next one and the one after, as (3, nk)."""
    _, nj, nk = mask.shape_ijk
    counts_d = allocate(device, 12 * mask.rows)
    program = load_program(device, "points/slice_overlap.cl")
    launch(
        device, program["count_overlaps"], mask.rows, mask=mask.mask_d, counts=counts_d, nj=nj, nk=nk, words=mask.words
    )
    rows = download(device, np.empty((3, nk, nj), np.uint32), counts_d)
    counts: NDArray[np.int64] = rows.sum(axis=2, dtype=np.int64)
    return counts


@explains_arguments
def find_ghost_slices(
    volume: Volume | DeviceVolume,
    hu: ArrayLike,
    *,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> GhostSlices:
    """Find foreign slices inside a stack: screen captures, localizers, slices of another place.

    The voxels of a band are compared by Dice's coefficient D of two slices.  Slice k is a ghost if ``max(D(k - 1, k),
    D(k, k + 1)) < 0.75 D(k - 1, k + 1)``, its neighbours are more like each other than like it, and if less than 0.45
    of its voxels, corrected for chance, lie within one of them.  Two foreign slices side by side are not found; of two
    with one slice between, that slice may be taken for one.  The first and the last slice have one neighbour and are
    not tested.

    Parameters
    ----------
    volume : Volume or DeviceVolume
    hu : (float or None, float or None)
        Band in HU, both ends included.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.  A `DeviceVolume` has its own.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("mask", slices done, all slices)`` where the voxels go to the device slab by slab.

    Returns
    -------
    GhostSlices
        The ghosts, and the figures of every slice.

    Raises
    ------
    UsageError
        ``hu`` is no band.
    NoSurfaceError
        The type of the voxels has no value in the band.
    DeviceError
        No device, no room for the mask, or the device fails.
    """
    band = checked_band(hu)
    with open_volume(volume, device, memory, "a search for ghost slices") as resident:
        ni, nj, nk = resident.volume.shape_ijk
        beside = {"counts of rows": 12 * nj * nk}
        for attempt in resident.with_fallback():
            with attempt as (current, warnings):
                stopwatch = Stopwatch()
                mask = mark_band(
                    resident, band, beside=beside, stopwatch=stopwatch, progress=progress or ignore_progress
                )
                with stopwatch.running(current):
                    counts = count_overlaps(current, mask)
                ghosts = judge_slices(counts, ni * nj, band, tuple(warnings))
    return ghosts
