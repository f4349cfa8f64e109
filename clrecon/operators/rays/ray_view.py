"""The table of a picture's rays for the kernels, see cl/rays/view.h."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume, normal_matrix
from clrecon.geometry.affine import Float64Array
from clrecon.opencl import kernel_constant
from clrecon.operators.resident.frame import FieldFrame
from clrecon.rendering import Lighting
from clrecon.rendering.looks.lighting import LEAST_SOFT_GRADIENT
from clrecon.rendering.views.camera import Camera, box_corners

TILE = kernel_constant("rays/view.h", "TILE")
"""Pixels along each side of a tile."""

BOX_ROW = kernel_constant("rays/view.h", "VIEW_BOX_LOW")
"""Row of the box in the table; its upper end and both of the focus follow."""

NEAR_ROW = kernel_constant("rays/view.h", "VIEW_NEAR")
"""Row of the table with the depth at which rays begin."""

ENDLESS = 1e30
"""Offset of a clip plane that nothing reaches, in float32."""


@dataclass(frozen=True)
class RayView:
    """The rays of a picture in the form for a device.

    size: (width, height)
    ray_step: mm.
    table: ndarray, shape (rows, 4), float32
    planes: Number of clip planes among the rows.
    spread: ndarray, shape (3,), float64. Largest distance in field coordinates between a ray of a tile and the one in
        its middle, plus one ray step.
    """

    camera: Camera
    size: tuple[int, int]
    ray_step: float
    table: NDArray[np.float32]
    planes: int
    spread: Float64Array

    @property
    def arguments(self) -> dict[str, int]:
        """Arguments that describe the picture and its clip planes to kernels; the table is uploaded on its own."""
        width, height = self.size
        return {
            "width": width,
            "height": height,
            "planes": self.planes,
            "perspective": int(not self.camera.is_parallel),
        }

    @classmethod
    def of(
        cls,
        volume: Volume,
        camera: Camera,
        size: tuple[int, int],
        ray_step: float,
        *,
        lighting: Lighting | None = None,
        planes: Float64Array | None = None,
        box: tuple[Float64Array, Float64Array],
        focus: tuple[Float64Array, Float64Array],
    ) -> RayView:
        """Set the table up.

        planes: ndarray, shape (n, 4), float64. Half-spaces in LPS mm that are kept: ``normal . p >= offset``.
        box, focus: (low, high), each ndarray, shape (3,), float64. Field coordinates of the volume, and of its visible
            part.
        """
        frame = FieldFrame.of(volume)
        right, up, forward = camera.basis()
        width, height = size
        pixel = 2.0 * camera.half_height() / height
        position = np.array(camera.position)
        corner_x, corner_y = (0.5 - 0.5 * width) * pixel, (0.5 * height - 0.5) * pixel
        corner = right * corner_x + up * corner_y
        corners = box_corners(volume)
        centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        near = float((centre - position) @ forward - np.linalg.norm(corners - centre, axis=1).max())
        if camera.is_parallel:
            origins = (position + corner + near * forward, pixel * right, -pixel * up)
            directions = (forward, np.zeros(3), np.zeros(3))
        else:
            near = max(near, 0.0)
            directions = (forward + corner, pixel * right, -pixel * up)
            origins = (position + near * directions[0], near * directions[1], near * directions[2])
        light = Lighting() if lighting is None else lighting
        toward = np.zeros(3) if light.direction is None else np.array(light.direction) / np.linalg.norm(light.direction)
        rows = [
            frame.matrix @ origins[0] + frame.offset,
            frame.matrix @ origins[1],
            frame.matrix @ origins[2],
            *(frame.matrix @ direction for direction in directions),
            *directions,
            *box,
            *focus,
            *normal_matrix(volume.affine),
        ]
        table = np.zeros((len(rows) + 3, 4))
        table[: len(rows), :3] = rows
        table[-3] = (*toward, 0.0 if light.direction is None else 1.0)
        table[-2] = light.ambient, light.diffuse, light.specular, light.specular_power
        table[-1] = near, ray_step, max(light.soft_gradient, LEAST_SOFT_GRADIENT) ** 2, 0.0
        count = 0
        if planes is not None and len(planes):
            table = np.vstack([table, np.clip(frame.planes(planes), -ENDLESS, ENDLESS)])
            count = len(planes)
        across, along = 0.5 * TILE * pixel, 0.0
        if not camera.is_parallel:
            across, along = _perspective_spread(camera, size, float(np.linalg.norm(corners - position, axis=1).max()))
        axes = np.abs(frame.matrix @ np.column_stack([right, up, forward]))
        spread = axes @ (across, across, along) + ray_step * np.linalg.norm(frame.matrix, axis=1)
        return cls(camera, size, ray_step, table.astype(np.float32), count, spread)

    def widened(self) -> NDArray[np.float32]:
        """Return the table without clip planes, with the focus, enlarged by the spread on all sides, as its box."""
        table = self.table[: len(self.table) - self.planes].copy()
        table[BOX_ROW, :3] = table[BOX_ROW + 2, :3] - self.spread
        table[BOX_ROW + 1, :3] = table[BOX_ROW + 3, :3] + self.spread
        return table


def _perspective_spread(camera: Camera, size: tuple[int, int], farthest: float) -> tuple[float, float]:
    """Return the distance, across and along the view, of a tile's rays from its middle ray, up to `farthest` mm away.

    Points at equal distance along two rays differ by that distance times the difference of the unit directions.  This
    is at most the difference of the directions scaled to length 1 along the view; along the view, that times the sine
    of the angle to it.
    """
    width, height = size
    pixel = 2.0 * camera.half_height() / height
    edge = pixel * math.hypot(0.5 * width + TILE, 0.5 * height + TILE)  # tiles may extend beyond the picture
    across = math.sqrt(2.0) * 0.5 * (TILE - 1) * pixel * farthest
    return across, across * edge / math.hypot(1.0, edge)
