"""Pictures for tests of what happens to pictures: no volume and no device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clrecon.rendering import Rendering
from clrecon.rendering.views.camera import Camera

PARALLEL = Camera((0, -300, 0), (0, 0, 0), (0, 0, 1), parallel_scale=100.0)
PERSPECTIVE = Camera((0, -300, 0), (0, 0, 0), (0, 0, 1), view_angle=40.0)


def make_picture(
    size: tuple[int, int] = (120, 80), *, background: Sequence[int] = (0, 0, 0, 255), camera: Camera | None = PARALLEL
) -> Rendering:
    """A disc of changing colour before a background, with depths where it is."""
    width, height = size
    y, x = np.mgrid[:height, :width]
    distance = np.hypot(x + 0.5 - width / 2, y + 0.5 - height / 2) / (0.3 * min(size))
    image = np.empty((height, width, 4), np.uint8)
    image[:] = background
    inside = distance < 1.0
    shade = (220 - 120 * distance[inside]).astype(np.uint8)
    image[inside] = np.stack([shade, shade // 2, 255 - shade, np.full_like(shade, 255)], axis=-1)
    depth = np.where(inside, 200.0 + 50.0 * distance, np.nan).astype(np.float32)
    return Rendering(image, depth, depth + np.float32(1.0), camera)
