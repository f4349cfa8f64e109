"""Upper bounds of distances to a surface on a device: the host's side of cl/surface/near_faces.cl."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.frames import rounding_of_bounds
from clrecon.mesh.connectivity import Fans
from clrecon.mesh.refine.bounds import WITNESSES, SurfaceBounds
from clrecon.opencl import (
    Device,
    Program,
    check_budget,
    download,
    empty_output,
    kernel_constant,
    launch,
    load_program,
    upload,
)
from clrecon.system.pieces import chunks

PART = 1 << 20
"""Points or triangles of a launch: each stays short, and its arrays fit beside the surface."""

if kernel_constant("surface/near_faces.cl", "WITNESSES") != WITNESSES:
    raise ImportError("cl/surface/near_faces.cl and clrecon.mesh.refine.bounds differ in the number of witnesses")

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]


def prepare_near_faces(device: Device) -> Program:
    """Build the kernels of `DeviceBounds`."""
    return load_program(device, "surface/near_faces.cl")


class DeviceBounds(SurfaceBounds):
    """A surface to which distances are bounded on a device; its twin is `SurfaceBounds`.

    The nearest point of each triangle is found, where the twin may take one near it: bounds are as short or shorter,
    or within the limit.

    vertices: ndarray, shape (n, 3), mm, near zero
    triangles: ndarray, shape (m, 3), uint32
    fans: As for `NearDistance`.
    """

    def __init__(
        self,
        device: Device,
        vertices: NDArray[np.floating],
        triangles: NDArray[np.uint32],
        fans: Fans | None = None,
    ):
        super().__init__(vertices, triangles, fans)
        self._device = device

    def prepare(self) -> None:
        """Bring the surface to the device, before threads use it."""
        assert self._surface

    @property
    def slack(self) -> float:
        """As of the twin."""
        return self._slack

    @cached_property
    def _slack(self) -> float:
        return rounding_of_bounds(max(float(self._vertices.max(initial=0)), -float(self._vertices.min(initial=0))))

    @cached_property
    def _program(self) -> Program:
        return prepare_near_faces(self._device)

    @cached_property
    def _surface(self) -> dict[str, Any]:
        """The arguments of the kernels that are the surface."""
        arrays = {
            "places": self._vertices.astype(np.float32),
            "faces": self._triangles,
            "begin": self._fans.begin.astype(np.int32),
            "around": self._fans.rows.astype(np.int32, copy=False),
        }
        part = {"points of a launch": 64 * PART, "vertices": 20 * len(self._vertices)}
        check_budget(self._device, {name: array.nbytes for name, array in arrays.items()} | part)
        return {
            name: upload(self._device, array if len(array) else np.zeros(4, array.dtype))
            for name, array in arrays.items()
        }

    def find_upper_bounds(self, points: Float64Array, near: IntArray) -> tuple[Float64Array, NDArray[np.int64]]:
        """As `NearDistance.find_upper_bounds`."""
        length, rows = self.find_bounds(points, near[:, None], 0.0)
        return length.astype(np.float64), rows.astype(np.int64)

    def find_bounds(
        self, points: Float64Array, near: IntArray, limit: float, walks: int = 0
    ) -> tuple[Float32Array, IntArray]:
        """As `SurfaceBounds.find_bounds`."""
        device, surface = self._device, self._surface
        squares = np.empty(len(points), np.float32)
        rows = np.empty(len(points), np.int32)
        for where in chunks(len(points), PART):
            count = where.stop - where.start
            here = (upload(device, points[where].astype(np.float32)), upload(device, near[where].astype(np.int32)))
            found = empty_output(device, (count,), np.float32), empty_output(device, (count,), np.int32)
            launch(
                device, self._program["find_near_faces"], count, points=here[0], near=here[1], **surface,
                squares=found[0][1], rows=found[1][1], hints=near.shape[1], walks=walks, enough=self._most(limit),
                count=count,
            )  # fmt: skip
            squares[where], rows[where] = download(device, *found[0]), download(device, *found[1])
        nothing = rows < 0
        length = np.sqrt(squares) + np.float32(self.slack)
        length[nothing] = np.inf
        return length, rows

    def find_witnesses(
        self, places: Float32Array, triangles: IntArray, names: IntArray, beside: IntArray, limit: float
    ) -> tuple[IntArray, NDArray[np.uint8]]:
        """As `SurfaceBounds.find_witnesses`."""
        device = self._device
        witnesses: NDArray[np.int32] = np.empty((WITNESSES, len(triangles)), np.int32)
        left = np.empty(len(triangles), np.uint8)
        of_vertices = {
            "vertices": upload(device, places),
            "names": upload(device, names.astype(np.int32)),
            "beside": upload(device, beside),
        }
        for where in chunks(len(triangles), PART):
            count = where.stop - where.start
            faces = upload(device, triangles[where])
            found = empty_output(device, (WITNESSES, count), np.int32), empty_output(device, (count,), np.uint8)
            launch(
                device, self._program["find_witnesses"], count, triangles=faces, **of_vertices, **self._surface,
                witnesses=found[0][1], left=found[1][1], enough=self._most(limit), count=count,
            )  # fmt: skip
            witnesses[:, where], left[where] = download(device, *found[0]), download(device, *found[1])
        return witnesses, left
