"""Twin of the pictures of points: discs that face the camera, the nearest one in each pixel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.reference.rays.render import shade
from clrecon.rendering import Lighting
from clrecon.rendering.views.camera import Camera

LEAST_PIXELS, MOST_PIXELS = np.float32(0.7072), np.float32(128.0)
NEAREST_MM = np.float32(1e-3)
STEEPEST, DARKENING = 8.0, 0.5


def find_splats(
    points: NDArray[np.floating], camera: Camera, size: Sequence[int], radius_mm: float
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Find the point that each pixel shows: of the discs that cover its centre the nearest, of those the first.

    All is float32, product by product and sum by sum as the kernel does it, so that both find the same.

    points: ndarray, shape (n, 3), floating. LPS mm.
    size: (width, height)
    radius_mm: Of the discs; at least 0.7072 and at most 128 pixels count.

    Returns:
    depth: ndarray, shape (h, w), float32. Mm across the view; NaN where no point is.
    numbers: ndarray, shape (h, w), int64. Points; -1 where none is.
    """
    width, height = size
    x, y, z = (_coordinate(points, axis, camera.position) for axis in camera.basis())
    pixel = np.float32(2.0 * camera.half_height() / height)
    scale = np.ones_like(z) if camera.is_parallel else z
    seen = np.full(len(z), True) if camera.is_parallel else z >= NEAREST_MM
    side = np.where(seen, pixel * scale, np.float32(1.0))
    reach = np.clip(np.float32(radius_mm), LEAST_PIXELS * side, MOST_PIXELS * side)
    column = np.floor(x / side + np.float32(0.5 * width))
    row = np.floor(np.float32(0.5 * height) - y / side)
    most = int(np.ceil((reach / side).max(initial=0.0))) + 2
    best = np.full((height, width), np.inf, np.float32)
    first = np.full((height, width), len(z), np.int64)
    for down in range(-most, most + 1):
        for aside in range(-most, most + 1):
            at_x, at_y = column + aside, row + down
            to_x = x - scale * (((at_x.astype(np.float32) + np.float32(0.5)) - np.float32(0.5 * width)) * pixel)
            to_y = y - scale * ((np.float32(0.5 * height) - (at_y.astype(np.float32) + np.float32(0.5))) * pixel)
            on = seen & (to_x * to_x + to_y * to_y <= reach * reach)
            on &= (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
            number = np.flatnonzero(on)
            j, i = at_y[on].astype(int), at_x[on].astype(int)
            # Sorted with the best point of each pixel last: numpy keeps the last value that is assigned.
            order = np.lexsort((-number, -z[number]))
            j, i, number = j[order], i[order], number[order]
            nearer = (z[number] < best[j, i]) | ((z[number] == best[j, i]) & (number < first[j, i]))
            best[j[nearer], i[nearer]] = z[number[nearer]]
            first[j[nearer], i[nearer]] = number[nearer]
    empty = first == len(z)
    return np.where(empty, np.float32(np.nan), best), np.where(empty, -1, first)


def _coordinate(
    points: NDArray[np.floating], axis: Float64Array, position: tuple[float, float, float]
) -> NDArray[np.float32]:
    """Return the coordinates along an axis of the camera, from its position, in float32."""
    p, (a, b, c) = points.astype(np.float32), axis.astype(np.float32)
    return ((a * p[:, 0] + b * p[:, 1]) + c * p[:, 2]) + np.float32(-(axis @ np.array(position)))


def shade_splats(
    depth: NDArray[np.float32],
    numbers: NDArray[np.int64],
    colors: Float64Array,
    normals: NDArray[np.floating] | None,
    camera: Camera,
    lighting: Lighting,
    apart: int,
) -> tuple[Float64Array, Float64Array]:
    """Colour and light the points of a picture.

    Points with normals are lit after Phong.  Without, eye-dome lighting (Boucheny 2009) darkens a pixel by
    ``exp(-0.5 s)``, s being the mean slope down to it from the eight pixels at a distance of `apart` pixels, those that
    are not nearer counted as 0 and none above 8.

    depth, numbers: Result of `find_splats`.
    colors: ndarray, shape (n, 3), float64. 0 to 1.
    normals: ndarray, shape (n, 3), floating
    lighting: One that does not shade leaves the colours as they are.
    apart: Pixels.

    Returns:
    rgba: ndarray, shape (h, w, 4), float64
    depth: ndarray, shape (h, w), float64. Mm along the ray.
    """
    height, width = depth.shape
    _, directions = camera.rays((width, height))
    there = numbers >= 0
    rgba = np.zeros((height, width, 4))
    rgba[there, 3] = 1.0
    found = colors[numbers[there]]
    if lighting.shades:
        if normals is not None:
            found = shade(found, normals[numbers[there]].astype(np.float64), directions[there], lighting)
        else:
            found = found * _eye_dome(depth, camera, apart)[there][:, None]
    rgba[there, :3] = found
    along = 1.0 if camera.is_parallel else directions @ camera.basis().forward
    return rgba, np.asarray(depth / along, dtype=np.float64)


def _eye_dome(depth: NDArray[np.float32], camera: Camera, apart: int) -> Float64Array:
    height, width = depth.shape
    around = np.pad(depth.astype(np.float64), apart, constant_values=np.nan)
    pixel = 2.0 * camera.half_height() / height
    way = apart * pixel * (1.0 if camera.is_parallel else depth)
    total = np.zeros(depth.shape)
    for down in (-1, 0, 1):
        for aside in (-1, 0, 1):
            top, left = apart + down * apart, apart + aside * apart
            slope = (depth - around[top : top + height, left : left + width]) / way
            total += np.clip(np.nan_to_num(slope, nan=0.0), 0.0, STEEPEST)
    return np.asarray(np.exp(-DARKENING * total / 8.0))
