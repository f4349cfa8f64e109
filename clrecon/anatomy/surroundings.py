"""What a projection of the lowest values leaves out: the air around the body, table and blankets, and masked voxels.

All of it is at least as low as what such a picture is made for (airways, emphysema, gas), so a ray that counted it
would show nothing else.  Voxels that are left out get a value above all others: the lowest value along a ray then never
is theirs, and a ray that meets nothing else is empty.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from clrecon.anatomy.body import BODY_STEPS, MARGIN_MM, find_body, find_unmeasured
from clrecon.anatomy.body_cells import count_cells, grow
from clrecon.errors import RefusedInputError
from clrecon.geometry.certificate import amend
from clrecon.geometry.volume import Volume
from clrecon.system.progress import Progress, Steps

LEFT_OUT = "left_out"
"""Entry of the report of a volume with voxels that are left out."""

SKIN_MM = 3.0
"""What is left out reaches at least so far under the surface of the body: values mix there with those of the air."""

LEAST_ROOM = 2.0
"""The value of what is left out lies at least so many times the range of the other values above them.  Between it and
a voxel beside it, the share of a voxel that can be mistaken for something else is then at most a third."""


def leave_out_surroundings(volume: Volume, *, progress: Progress | None = None) -> Volume:
    """Give the voxels outside of the body a value above all others.

    volume: A scan in HU.  Voxels that a mask has turned into air lie outside of what is found to be the body.
    progress: Called as ``progress("mask", steps done, steps)``.

    Returns: With the same places, of the same type where that has room above the values, else float32.
        ``report["left_out"]`` has ``highest_hu``, the highest value that counts: voxels above it are left out;
        ``value_hu``, which they get; and ``body``: whether a body was found.  Without one nothing is left out.
    """
    voxels, dtype = volume.voxels, volume.voxels.dtype
    low, high = float(np.nanmin(voxels)), float(np.nanmax(voxels))
    room = LEAST_ROOM * max(high - low, 1.0)
    value = high + 8.0 * room
    if dtype.kind in "iu" and np.iinfo(dtype).max - high >= room:
        value = float(min(np.iinfo(dtype).max, np.ceil(value)))
    else:
        dtype = np.dtype(np.float32)
    steps = Steps(progress, "mask", count_cells(volume)[0] + BODY_STEPS + len(voxels))
    taken = np.array(voxels, dtype=dtype)
    try:
        body, (si, sj, sk) = find_body(volume, steps=steps)
    except RefusedInputError:
        body = None
    if body is not None:
        across = np.sqrt(si * volume.spacing[0] * sj * volume.spacing[1])
        body = grow(body, -(max(1, round(MARGIN_MM / across)) + np.ceil(SKIN_MM / across)))
        for k, layer in enumerate(taken):
            kept = np.repeat(np.repeat(body[k // sk], sj, 0), si, 1)[: layer.shape[0], : layer.shape[1]]
            unmeasured = find_unmeasured(voxels[k : k + 1])[0]
            np.copyto(layer, value, where=~kept | unmeasured, casting="unsafe")
            volume.release_slices(k, k + 1)
            steps.take()
    facts = {"highest_hu": high, "value_hu": value, "body": body is not None}
    return volume.with_voxels(taken, amend(volume.report, **{LEFT_OUT: facts}))


def count_left_out(volume: Volume) -> dict[str, Any] | None:
    """Count the voxels that a volume leaves out.

    Returns: ``voxels``, their ``share`` of all, ``body``: whether a body was found, and ``region``: whether a region
        was applied too; None for another volume.
    """
    facts = volume.report.get(LEFT_OUT)
    if facts is None:
        return None
    voxels = sum(int(np.count_nonzero(layer > facts["highest_hu"])) for layer in volume.voxels)
    return {
        "voxels": voxels,
        "share": round(voxels / volume.voxels.size, 4),
        "body": facts["body"],
        "region": "region" in volume.report,
    }
