"""Gradients of a volume at points: the host's side of cl/points/gradients.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceMemoryError
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    describe_shortage,
    download,
    empty_output,
    launch,
    load_program,
    upload,
)
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.voxel_types import voxel_variants
from clrecon.system.progress import Progress, ignore_progress

GRADIENTS = "gradients"
"""Purpose by which slabs are planned."""

BELOW, ABOVE = 1, 2
"""Slices below and above a slab that differences over half a voxel need."""

FARTHEST = 2.0**29
"""Farthest place in index steps: what lies beyond has no gradient anyway."""


def prepare_gradients(device: Device, dtype: np.dtype) -> Program:  # type: ignore[type-arg]
    """Build the kernel for volumes of `dtype`."""
    return load_program(device, "points/gradients.cl", voxel_variants(dtype))


def find_gradients(
    resident: DeviceVolume,
    points: NDArray[np.floating],
    *,
    stopwatch: Stopwatch,
    progress: Progress | None = None,
    warnings: list[str] | None = None,
) -> NDArray[np.float32]:
    """Find the gradient of a volume at points.

    A volume that does not fit the device goes through it slab by slab, with the same result.

    points: ndarray, shape (n, 3), LPS mm
    progress: Called as ``progress("gradients", slices done, all slices)``.
    warnings: Gets a line each time that the device had no room for the planned slabs.

    Returns: ndarray, shape (n, 3), float32. HU per mm, LPS.  Beyond the border the volume is surrounded by its lowest
        value, at least -1024 HU; farther away the gradient is zero.
    """
    volume, nk = resident.volume, resident.volume.shape_ijk[2]
    places = np.clip(volume.lps_to_ijk(points), -FARTHEST, FARTHEST).astype(np.float32)

    def needs(slices: int) -> dict[str, int]:
        held = min(slices + BELOW + ABOVE, nk) * resident.slice_bytes
        return {"volume": held, "places": places.nbytes, "gradients": places.nbytes}

    slices = resident.plan(GRADIENTS, nk, needs)
    if slices < 1:
        raise DeviceMemoryError(f"no gradients can be found: {describe_shortage(resident.limits, needs(1))}")
    return resident.halve(
        GRADIENTS,
        slices,
        lambda slices: _all_slabs(resident, places, slices, stopwatch, progress or ignore_progress),
        warnings=warnings,
    )


def _all_slabs(
    resident: DeviceVolume, places: NDArray[np.float32], slices: int, stopwatch: Stopwatch, progress: Progress
) -> NDArray[np.float32]:
    device, volume = resident.device, resident.volume
    ni, nj, nk = volume.shape_ijk
    with stopwatch.timed("build"):
        program = prepare_gradients(device, resident.dtype)
    origins = volume.slice_origins(1)
    origins_d = upload(device, (origins - origins[0]).astype(np.float32))
    places_d = upload(device, places)
    gradients, gradients_d = empty_output(device, places.shape, np.float32)
    for first in range(0, nk, slices):
        end = min(first + slices, nk)
        low, high = max(first - BELOW, 0), min(end + ABOVE, nk)
        if slices >= nk:
            voxels_d, low = resident.whole(stopwatch), 0
        else:
            voxels_d = resident.part(low, high, stopwatch)
        with stopwatch.running(device):
            launch(
                device, program["find_gradients"], len(places), stopwatch=stopwatch,
                voxels=voxels_d, places=places_d, origins=origins_d, gradients=gradients_d, ni=ni, nj=nj, nk=nk,
                first_k=low, own_first=first, own_end=end, step_i=(*volume.affine[:3, 0], 0.0),
                step_j=(*volume.affine[:3, 1], 0.0), outside=resident.values.lowest, points=len(places),
            )  # fmt: skip
        volume.release_slices(low, high)
        progress("gradients", end, nk)
    return download(device, gradients, gradients_d)
