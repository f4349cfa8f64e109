"""Volume rendering through a transfer function: the host's side of cl/render/composite.cl."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.kernels import Stopwatch, launch, upload
from clrecon.opencl import Device
from clrecon.operators.pictures import PictureBuffers, count_queues, highlight_table
from clrecon.operators.ray_view import RayView
from clrecon.operators.resident import LeapMap, RaySlab, ResidentVolume
from clrecon.rendering import Lighting, TransferFunction

__all__ = ["NODES", "TransferTables", "composite_slab"]

NODES = 4096
"""Entries of a transfer function's table, as in cl/render/composite.cl."""

LOWEST_LOG = -1000.0
"""log2 of what an opaque sample lets through: 0 in float32, and no infinity that a length of 0 would make NaN."""


@dataclass(frozen=True)
class TransferTables:
    """A transfer function for one ray step.

    Attributes
    ----------
    colors_d : buffer, (NODES, 4) float32
        Red, green, blue, and log2 of what a sample lets through.
    opacities_d : buffer, (NODES,) float32
        Over one ray step.
    shown : ndarray, shape (NODES,), bool
    low, scale : float
        Nearest node to v: ``floor((v - low) * scale + 0.5)``.
    """

    colors_d: Any
    opacities_d: Any
    shown: NDArray[np.bool_]
    low: float
    scale: float

    @classmethod
    def of(cls, device: Device, function: TransferFunction, ray_step: float) -> TransferTables:
        """Tables of `function` for samples every `ray_step` mm."""
        low, high = function.range_hu
        table = function.table(low, high, NODES)
        with np.errstate(divide="ignore"):
            let_through = np.log2(1.0 - table[:, 3].astype(np.float64)) * (ray_step / function.unit_distance)
        let_through = np.maximum(let_through, LOWEST_LOG)
        colors = table.copy()
        colors[:, 3] = let_through
        opacities = (-np.expm1(let_through * np.log(2.0))).astype(np.float32)
        shown = opacities > 0.0
        return cls(upload(device, colors), upload(device, opacities), shown, low, (NODES - 1) / (high - low))


def composite_slab(
    resident: ResidentVolume,
    slab: RaySlab,
    view: RayView,
    tables: TransferTables,
    leaps: LeapMap,
    lighting: Lighting,
    jitter: bool,
    output: PictureBuffers,
    stopwatch: Stopwatch,
) -> None:
    """Blend one slab into a picture.

    Parameters
    ----------
    view : RayView
        With the slab's focus.
    leaps : LeapMap
        Of this slab, for the transfer function of `tables`.
    output : PictureBuffers
        Holds what earlier slabs left.
    """
    device = resident.device
    lanes = int(device.kernel_variants["LANES"])
    width, height = view.size
    queues = count_queues(device)
    last = np.array([n - 1 for n in resident.volume.shape_ijk] + [0], dtype=np.float32)
    launch(
        device, resident.program("render/composite.cl")["composite_rays"], output.items(queues, lanes),
        slab.voxels_d, leaps.distances_d, tables.colors_d, tables.opacities_d,
        upload(device, highlight_table(lighting)), upload(device, view.table), output.states_d, output.image_d,
        output.depths_d, output.means_d, output.background, last,
        np.int32(slab.shape_ijk[0]), np.int32(slab.shape_ijk[1]), np.int32(slab.first_k), np.int32(slab.end_k),
        np.float32(slab.low_k), np.float32(slab.high_k), *(np.int32(n) for n in slab.bricks),
        np.float32(tables.low), np.float32(tables.scale), np.uint32(width), np.uint32(height),
        np.uint32(view.planes), np.int32(not view.camera.is_parallel), np.int32(lighting.shades), np.int32(jitter),
        np.int32(slab.stage), np.uint32(queues), stopwatch=stopwatch,
    )  # fmt: skip
