"""Twins of the pictures of points, discs that face the camera, and of triangles: the layers of each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.proof.rays.render import shade
from clrecon.rendering import Lighting
from clrecon.rendering.views.camera import Camera

LEAST_PIXELS, MOST_PIXELS = np.float32(0.7072), np.float32(128.0)
NEAREST_MM = np.float32(1e-3)
STEEPEST, DARKENING = 8.0, 0.5


def find_splats(
    points: NDArray[np.floating], camera: Camera, size: Sequence[int], radius_mm: float
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Find the point that each pixel shows: of the discs that cover its centre the nearest, of those the first; -1:
    none.

    All is float32, product by product and sum by sum as the kernel does it, so that both find the same; radii from
    0.7072 to 128 pixels count.  Depths, (h, w), are mm across the view, NaN where no point is.
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
            j, i = j[order], i[order]
            number = number[order]
            nearer = (z[number] < best[j, i]) | ((z[number] == best[j, i]) & (number < first[j, i]))
            best[j[nearer], i[nearer]] = z[number[nearer]]
            first[j[nearer], i[nearer]] = number[nearer]
    empty = first == len(z)
    return np.where(empty, np.float32(np.nan), best), np.where(empty, -1, first)


def _coordinate(
    points: NDArray[np.floating], axis: Float64Array, position: tuple[float, float, float]
) -> NDArray[np.float32]:
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
    """Colour and light the points of a picture of `find_splats`: (h, w, 4), and mm along the ray, (h, w).

    Points with normals are lit after Phong, if the lighting shades.  Without, eye-dome lighting (Boucheny 2009) darkens
    a pixel by ``exp(-0.5 s)``, s being the mean slope down to it from the eight pixels at a distance of `apart` pixels,
    those that are not nearer counted as 0 and none above 8.
    """
    height, width = depth.shape
    _, directions = camera.rays((width, height))
    there = numbers >= 0
    rgba = np.zeros((height, width, 4))
    rgba[there, 3] = 1.0
    rgb = colors[numbers[there]]
    if lighting.shades:
        if normals is not None:
            rgb = shade(rgb, normals[numbers[there]].astype(np.float64), directions[there], lighting)
        else:
            rgb = rgb * _eye_dome(depth, camera, apart)[there][:, None]
    rgba[there, :3] = rgb
    along = 1.0 if camera.is_parallel else directions @ camera.basis().forward
    return rgba, np.asarray(depth / along, dtype=np.float64)


def _eye_dome(depth: NDArray[np.float32], camera: Camera, apart: int) -> Float64Array:
    height, width = depth.shape
    around = np.pad(depth.astype(np.float64), apart, constant_values=np.nan)
    pixel = 2.0 * camera.half_height() / height
    reach = apart * pixel * (1.0 if camera.is_parallel else depth)
    total = np.zeros(depth.shape)
    for down in (-1, 0, 1):
        for aside in (-1, 0, 1):
            top, left = apart + down * apart, apart + aside * apart
            slope = (depth - around[top : top + height, left : left + width]) / reach
            total += np.clip(np.nan_to_num(slope, nan=0.0), 0.0, STEEPEST)
    return np.asarray(np.exp(-DARKENING * total / 8.0))


NOTHING_MM = np.float32(1e-12)
_FAR_ENOUGH_MM = 0.1
"""Depth of the corners from which on a triangle is looked for between them alone."""


class Meetings(NamedTuple):
    """Where rays meet triangles, by pixel, depth across the view in mm, and number; shares (n, 3) of the corners."""

    pixels: NDArray[np.int64]
    triangles: NDArray[np.int64]
    depths: NDArray[np.float32]
    shares: Float64Array


def find_meetings(
    vertices: NDArray[np.floating], triangles: NDArray[np.integer], camera: Camera, size: Sequence[int]
) -> Meetings:
    """Find all triangles that the ray of each pixel meets; a ray on an edge counts as a little right and above of it.

    All but the signs of areas is float32, product by product and sum by sum as the kernel does it; products of two
    float32 are exact in float64.
    """
    width, height = size
    pixel, half_x, half_y = (np.float32(v) for v in (2.0 * camera.half_height() / height, 0.5 * width, 0.5 * height))
    aside = ((np.arange(width, dtype=np.float32) + np.float32(0.5)) - half_x) * pixel
    upwards = (half_y - (np.arange(height, dtype=np.float32) + np.float32(0.5))) * pixel
    places = np.stack([_coordinate(vertices, axis, camera.position) for axis in camera.basis()], axis=1)
    meetings: list[tuple[NDArray[np.int64], int, NDArray[np.float32], Float64Array]] = []
    all_pixels = np.arange(width * height).reshape(height, width)
    for number, corners in enumerate(places[triangles.astype(np.int64)]):
        scale = [np.float32(1.0)] * 3 if camera.is_parallel else list(corners[:, 2])
        across, down = _window(corners[:, 0] / scale, aside, pixel), _window(corners[:, 1] / scale, upwards, pixel)
        if not camera.is_parallel and corners[:, 2].min() < _FAR_ENOUGH_MM:
            across, down = slice(None), slice(None)
        x = [_drop_nothing(corners[n, 0] - scale[n] * aside[across])[None, :] for n in range(3)]
        y = [_drop_nothing(corners[n, 1] - scale[n] * upwards[down])[:, None] for n in range(3)]
        sides, areas = zip(*(_find_side(x[n], y[n], x[n - 2], y[n - 2]) for n in range(3)), strict=True)
        met = (sides[0] != 0) & (sides[0] == sides[1]) & (sides[1] == sides[2])
        if not np.any(met):
            continue
        u, v, w = (areas[n][met] for n in (1, 2, 0))
        a, b, c = corners[:, 2]
        total = (u + v) + w
        depth = np.clip(((u * a + v * b) + w * c) / total, corners[:, 2].min(), corners[:, 2].max())
        seen = np.full(len(depth), True) if camera.is_parallel else depth >= NEAREST_MM
        shares = (np.stack([u, v, w], axis=1).astype(np.float64) / total[:, None])[seen]
        meetings.append((all_pixels[down, across][met][seen], number, depth[seen], shares))
    if not meetings:
        return Meetings(np.zeros(0, int), np.zeros(0, int), np.zeros(0, np.float32), np.zeros((0, 3)))
    pixels = np.concatenate([each[0] for each in meetings])
    numbers = np.concatenate([np.full(len(each[0]), each[1]) for each in meetings])
    depths, shares = np.concatenate([each[2] for each in meetings]), np.concatenate([each[3] for each in meetings])
    order = np.lexsort((numbers, depths, pixels))
    return Meetings(pixels[order], numbers[order], depths[order], shares[order])


def nth_layer(meetings: Meetings, layer: int, size: Sequence[int]) -> NDArray[np.int64]:
    """Return the place among the meetings of what each pixel shows in a layer, (h, w); -1 where it has none."""
    width, height = size
    first = np.searchsorted(meetings.pixels, np.arange(width * height))
    counts = np.bincount(meetings.pixels, minlength=width * height)
    return np.where(counts > layer, first + layer, -1).reshape(height, width)


class ColoredMesh(NamedTuple):
    """Triangles (m, 3) between vertices (n, 3), with their colours and normals, by default those of the triangles."""

    vertices: NDArray[np.floating]
    triangles: NDArray[np.integer]
    colors: Float64Array
    normals: NDArray[np.floating] | None


def shade_layer(
    meetings: Meetings, places: NDArray[np.int64], mesh: ColoredMesh, camera: Camera, lighting: Lighting
) -> tuple[Float64Array, Float64Array]:
    """Colour and light a layer, the `places` of `nth_layer` among the meetings: (h, w, 3), and mm along the ray, (h,
    w), NaN where it has nothing."""
    height, width = places.shape
    there = places >= 0
    corners = mesh.triangles.astype(np.int64)[meetings.triangles[places[there]]]
    shares = meetings.shares[places[there]]
    directions = camera.rays((width, height))[1][there]
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[corners], 1, 0)
    face = np.cross(b - a, c - a)
    length = np.linalg.norm(face, axis=1, keepdims=True)
    face = np.where(length > 0.0, face / np.where(length > 0.0, length, 1.0), -directions)
    normal = face
    if mesh.normals is not None:
        normal = np.einsum("nk,nki->ni", shares, mesh.normals.astype(np.float64)[corners])
        normal = np.where(np.einsum("ni,ni->n", normal, face)[:, None] < 0.0, -normal, normal)
    away = np.einsum("ni,ni->n", normal, directions)
    wrong = away * np.einsum("ni,ni->n", face, directions) < 0.0
    normal = normal - np.where(wrong, 1.001 * away, 0.0)[:, None] * directions
    rgb, depth = np.zeros((height, width, 3)), np.full((height, width), np.nan)
    colors_here = np.einsum("nk,nki->ni", shares, mesh.colors[corners])
    rgb[there] = shade(colors_here, normal, directions, lighting) if lighting.shades else colors_here
    along = 1.0 if camera.is_parallel else directions @ camera.basis().forward
    depth[there] = meetings.depths[places[there]] / along
    return rgb, depth


def _window(places: NDArray[np.float32], centres: NDArray[np.float32], pixel: np.float32) -> slice:
    """Return the pixels between corners along one axis, with two more on either side."""
    near = np.flatnonzero((centres >= places.min() - 2.0 * pixel) & (centres <= places.max() + 2.0 * pixel))
    return slice(near[0], near[-1] + 1) if len(near) else slice(0, 0)


def _drop_nothing(lengths: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(np.abs(lengths) < NOTHING_MM, np.float32(0.0), lengths)


def _find_side(
    ax: NDArray[np.float32], ay: NDArray[np.float32], bx: NDArray[np.float32], by: NDArray[np.float32]
) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Return the sign of ax by - ay bx, or that a little beside it, and the difference."""
    first, second = ax.astype(np.float64) * by, ay.astype(np.float64) * bx
    exact = np.sign(first - second)
    beside = np.where(ay != by, np.sign(ay - by), np.sign(bx - ax))
    short_one, short_other = ax * by, ay * bx
    rest = (first - short_one).astype(np.float32) - (second - short_other).astype(np.float32)
    area = np.where(short_one != short_other, short_one - short_other, rest)
    return np.where(exact != 0.0, exact, beside).astype(np.int8), area
