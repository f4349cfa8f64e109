"""Twin of `clrecon.operators.masks.enclosed`: the voxels that are filled, by floods and distances of voxels' places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.proof.volumes.volume_twins import dilate, erode, fill_holes

Bits = NDArray[np.bool_]


def dilate_within(volume: Volume, chosen: Bits, room: Bits, mm: float) -> Bits:
    """Return the chosen voxels, and those of `room` that are joined with them by short ways over faces of its voxels.

    Along each axis a way has as many steps as `mm`, rounded up; along an axis with longer steps it has none.
    """
    steps = np.array(volume.spacing)[::-1]
    most = [int(np.ceil(mm / step - 1e-6)) if step <= mm * (1 + 1e-6) else 0 for step in steps]
    reached = chosen.copy()
    for done in range(max(most)):
        near = np.zeros_like(chosen)
        for axis in (axis for axis in range(3) if most[axis] > done):
            moved, target = np.moveaxis(reached, axis, 0), np.moveaxis(near, axis, 0)
            target[1:] |= moved[:-1]
            target[:-1] |= moved[1:]
        reached |= near & room
    return reached


def find_filled(volume: Volume, bone: Bits, seal_mm: float, bone_ml: float) -> Bits:
    """Return the voxels that bone encloses, shape (nk, nj, ni), whatever they hold and however wide they are."""
    sealed = bone.copy()
    for by_slice in (False, True):
        sealed |= erode(volume, dilate(volume, bone, seal_mm, by_slice=by_slice), seal_mm, by_slice=by_slice)
    padded = np.pad(sealed, 1)  # an end of the volume is a way out but where a slice of its own is closed
    for axis in range(3):
        for inner, outer in ((0, 0), (-1, -1)):
            face = np.take(sealed, inner, axis=axis)
            np.moveaxis(padded, axis, 0)[outer][1:-1, 1:-1] = fill_holes(face)
    body = fill_holes(padded)[(slice(1, -1),) * 3]
    room = body & ~bone
    joints = _between(volume, bone, seal_mm, bone_ml) & sealed & ~bone
    return room & ~dilate_within(volume, ~body | joints, room, seal_mm)


def _between(volume: Volume, bone: Bits, mm: float, least_ml: float) -> Bits:
    """Return the voxels near two pieces that have some volume each."""
    from scipy.ndimage import label

    pieces, count = label(bone)
    ml = slice_voxel_ml(volume)
    near = np.zeros(bone.shape, int)
    for number in range(1, count + 1):
        own = pieces == number
        if np.count_nonzero(own, axis=(1, 2)) @ ml >= least_ml:
            near += dilate(volume, own, mm)
    return near > 1
