"""Movements of a camera by gestures, in shares of the picture's height: x to the right, y down."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.views.camera import Camera
from clrecon.viewer.model.state import as_point

TURN_DEGREES = 180.0
"""By which a gesture over the height of the picture turns."""

MOST_MM, LEAST_MM = 1e5, 1e-2
"""Half heights between which a camera zooms: from a hundred metres to a hundredth of a millimetre."""


def turn_camera(camera: Camera, dx: float, dy: float) -> Camera:
    """Turn about the focal point as if the pointer held what is seen there, as pyvista's trackball does."""
    right, up, _ = camera.basis()
    turn = _rotation(up, -dx * TURN_DEGREES) @ _rotation(right, -dy * TURN_DEGREES)
    away = turn @ np.subtract(camera.position, camera.focal_point)
    return replace(camera, position=as_point(np.add(camera.focal_point, away)), up=as_point(turn @ up))


def roll_camera(camera: Camera, degrees: float) -> Camera:
    """Turn about the view; positive degrees turn the picture clockwise."""
    _, up, forward = camera.basis()
    return replace(camera, up=as_point(_rotation(forward, -degrees) @ up))


def pan_camera(camera: Camera, dx: float, dy: float) -> Camera:
    """Shift what is seen by shares of the picture's height, at the focal point."""
    right, up, _ = camera.basis()
    height = _height_mm(camera)
    shift = height * (dy * up - dx * right)
    return replace(
        camera,
        position=as_point(np.add(camera.position, shift)),
        focal_point=as_point(np.add(camera.focal_point, shift)),
    )


def zoom_camera(camera: Camera, factor: float, at: tuple[float, float] = (0.0, 0.0)) -> Camera:
    """Show everything `factor` times as large; what is seen at a place of the picture stays there.

    at: From the middle of the picture, in shares of its height.
    """
    if not (math.isfinite(factor) and factor > 0.0):
        raise UsageError(f"the factor of a zoom is a number above 0, not {factor!r}")
    before = _height_mm(camera)
    height = min(2.0 * MOST_MM, max(2.0 * LEAST_MM, before / factor))
    if camera.is_parallel:
        nearer = replace(camera, parallel_scale=0.5 * height)
    else:
        offset = np.subtract(camera.position, camera.focal_point) * (height / before)
        nearer = replace(camera, position=as_point(np.add(camera.focal_point, offset)))
    lost = 1.0 - before / height
    return pan_camera(nearer, at[0] * lost, at[1] * lost)


def pixel_camera(camera: Camera, size: tuple[int, int], x: float, y: float) -> Camera:
    """Return a camera whose picture of one pixel is seen along the ray of a place in this camera's picture.

    size: (width, height)
    x, y: Pixels from the top left corner; the first pixel's centre is (0.5, 0.5).
    """
    right, up, forward = camera.basis()
    width, height = size
    pixel = 2.0 * camera.half_height() / height
    offset = (x - 0.5 * width) * pixel * right + (0.5 * height - y) * pixel * up
    if camera.is_parallel:
        return replace(
            camera,
            position=as_point(np.add(camera.position, offset)),
            focal_point=as_point(np.add(camera.focal_point, offset)),
            parallel_scale=0.5 * pixel,
        )
    along = forward + offset
    along /= np.linalg.norm(along)
    angle = max(1e-3, math.degrees(pixel))
    return replace(camera, focal_point=as_point(camera.position + camera.distance * along), view_angle=angle)


def _height_mm(camera: Camera) -> float:
    """Return the height of the picture at the focal point."""
    return 2.0 * camera.half_height() * (1.0 if camera.is_parallel else camera.distance)


def _rotation(axis: Float64Array, degrees: float) -> Float64Array:
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    radians = math.radians(degrees)
    return np.asarray(np.eye(3) + math.sin(radians) * cross + (1.0 - math.cos(radians)) * cross @ cross)
