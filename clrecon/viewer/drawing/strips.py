"""Large pictures in strips, so that one that is no longer wanted ends soon."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from clrecon.rendering import Rendering
from clrecon.rendering.views.camera import Camera

STRIP_PIXELS = 1 << 18
"""Pixels of a strip: some 50 ms of volume rendering on two cores."""

STRIP_ROWS = 16
"""Rows of a strip are a multiple of this, which tiles of rays fill."""


def take_strips(
    take: Callable[[Camera, tuple[int, int]], Rendering], camera: Camera, size: tuple[int, int]
) -> Rendering:
    """Take the picture of a parallel camera strip by strip, where it is large; others in one.

    take: Takes a picture of a camera and a size; what it raises ends the work.
    """
    width, height = size
    rows = max(STRIP_ROWS, STRIP_PIXELS // width // STRIP_ROWS * STRIP_ROWS)
    if not camera.is_parallel or rows >= height:
        return take(camera, size)
    _, up, _ = camera.basis()
    pixel = camera.pixel_mm(size)
    strips = []
    for first in range(0, height, rows):
        end = min(first + rows, height)
        shift = (0.5 * height - 0.5 * (first + end)) * pixel * up
        own = replace(
            camera,
            position=_moved(camera.position, shift),
            focal_point=_moved(camera.focal_point, shift),
            parallel_scale=0.5 * (end - first) * pixel,
        )
        strips.append(take(own, (width, end - first)))
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(strip, name) for strip in strips])
        for name in ("image", "depth", "expected_depth", "values")
        if getattr(strips[0], name) is not None
    }
    report = {**strips[-1].report, "strips": len(strips)}
    return replace(strips[0], camera=camera, report=report, **joined)


def _moved(point: tuple[float, float, float], shift: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in point + shift)
    return x, y, z
