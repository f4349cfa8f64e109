"""Projections of a volume along rays: the host's side of cl/rays/project.cl."""

from __future__ import annotations

import numpy as np

from clrecon.opencl import Stopwatch, kernel_constant, kernel_number, launch, upload
from clrecon.operators.rays.buffers import PictureBuffers, count_queues
from clrecon.operators.rays.leaps import measure_cells
from clrecon.operators.rays.ray_view import RayView
from clrecon.operators.rays.slabs import RaySlab
from clrecon.operators.resident.device_volume import DeviceVolume

AIR_HU = kernel_number("rays/project.cl", "AIR_HU")
"""Attenuates nothing: lower values are padding, or what a mask left."""

PROJECTIONS = {
    mode: kernel_constant("rays/project.cl", macro)
    for mode, macro in {"mip": "HIGHEST", "minip": "LOWEST", "mean": "MEAN", "drr": "RADIOGRAPH"}.items()
}
"""Numbers of the modes in the kernel."""


def project_slab(
    resident: DeviceVolume,
    slab: RaySlab,
    view: RayView,
    mode: str,
    output: PictureBuffers,
    stopwatch: Stopwatch,
) -> None:
    """Add one slab to a projection; `output.means_d` receives the values.

    mode: {"mip", "minip", "mean", "drr"}
    """
    variants = {"LEAST_VALUE": f"({AIR_HU:g})"} if mode == "drr" else {}
    device = resident.device
    queues, lanes = count_queues(device), int(device.kernel_variants["LANES"])
    last = np.array([n - 1 for n in resident.volume.shape_ijk] + [0], dtype=np.float32)
    launch(
        device, resident.program("rays/project.cl", **variants)["project_rays"], output.items(queues, lanes),
        stopwatch=stopwatch, ranges=measure_cells(resident, slab, stopwatch), view=upload(device, view.table),
        states=output.states_d, depths=output.depths_d, values=output.means_d, last_place=last,
        which=PROJECTIONS[mode], queues=queues, **slab.arguments, **view.arguments, **resident.stack.arguments,
    )  # fmt: skip
