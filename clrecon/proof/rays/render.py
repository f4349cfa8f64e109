"""Twin of the raycaster: dvr, mip, minip, mean and drr in plain numpy, in float64, one sample of all rays at a time.

The way of a ray through a volume, the field there and jitter are shared by all ray twins: in float64, vectorised over
rays, which are arrays (n, 3): origins in LPS mm and unit directions.

References: Levoy 1988, "Display of surfaces from volume data" (compositing front to back, gradient opacity); Phong
1975 (shading, see `clrecon.rendering.looks.lighting`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array, slice_normal
from clrecon.geometry.iso_rule import slice_normal_matrices, takes_parts
from clrecon.proof.rays.openness import cell_length, open_volume
from clrecon.rendering import Lighting, TransferFunction
from clrecon.rendering.looks.lighting import LEAST_SOFT_GRADIENT
from clrecon.rendering.looks.piecewise import DENSE, PARTS, STEEP, Steepness
from clrecon.rendering.pictures.styles import Projection, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip


class Box:
    """The volume's box as bounds on three linear functions of LPS: inside is low <= normals @ p + offsets <= high.

    For an even stack the functions are its indices.  Slices of an uneven stack may shift sideways, so no box holds
    exactly its voxels.  The functions are then i and j counted in the plane of slice 0, with bounds around all slices,
    and the height over slice 0. Samples in that box but beside their slice are ignored.
    """

    def __init__(self, normals: Float64Array, offsets: Float64Array, low: Float64Array, high: Float64Array):
        self.normals, self.offsets = normals, offsets
        self.low, self.high = low, high


def box_of(volume: Volume, border: float = 0.5) -> Box:
    """Return the box that extends `border` index steps beyond the outermost voxel centres."""
    last = np.array(volume.shape_ijk, dtype=np.float64) - 1.0
    if not volume.uneven:
        inverse = np.linalg.inv(volume.affine)
        index, offset = np.asarray(inverse[:3, :3], np.float64), np.asarray(inverse[:3, 3], np.float64)
        return Box(index, offset, np.full(3, -border), last + border)
    first = volume.slice_origins()[0]
    in_plane = volume.affine[:3, :2]
    normal = slice_normal(volume.affine)
    if normal @ volume.affine[:3, 2] < 0.0:
        normal = -normal
    normals = np.asarray([*np.linalg.pinv(in_plane), normal], dtype=np.float64)
    ends = volume.ijk_to_lps([(0.0, 0.0, -border), (0.0, 0.0, last[2] + border)])
    corners = (np.vstack([volume.slice_origins(), ends]) - first) @ normals.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    low[:2] -= border
    high[:2] += last[:2] + border
    return Box(normals, np.asarray(-normals @ first, dtype=np.float64), low, high)


def find_interval(
    origins: Float64Array, directions: Float64Array, box: Box, clip: Clip | None = None, nearest: float = -np.inf
) -> tuple[Float64Array, Float64Array, NDArray[np.int64]]:
    """Find the part of rays that lies in a box and within clip planes, from `nearest` on: 0 for rays that begin at a
    camera.

    Return mm along the ray, ``t_out <= t_in`` for one that misses, and the number of the clip plane through which it
    enters, -1 for a side of the box or the camera.
    """
    planes = np.vstack(
        [
            np.column_stack([box.normals, box.low - box.offsets]),
            np.column_stack([-box.normals, box.offsets - box.high]),
            np.empty((0, 4)) if clip is None else clip.planes,
        ]
    )
    t_in, t_out = np.full(len(origins), nearest), np.full(len(origins), np.inf)
    entered_by = np.full(len(origins), -1)
    for number, plane in enumerate(planes):
        height = origins @ plane[:3] - plane[3]
        rate = directions @ plane[:3]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -height / rate
        t_out[(rate == 0.0) & (height < 0.0)] = -np.inf
        enters = (rate > 0.0) & (crossing > t_in)
        t_in[enters] = crossing[enters]
        entered_by[enters] = max(number - 6, -1)
        leaves = (rate < 0.0) & (crossing < t_out)
        t_out[leaves] = crossing[leaves]
    return t_in, t_out, entered_by


def sample_field(voxels: NDArray, ijk: Float64Array) -> Float64Array:
    """Interpolate voxels, (nk, nj, ni) or (nk, nj, ni, c), trilinearly at index coordinates (n, 3); beyond the
    outermost centres their value holds.

    Along i, then j, then k, each ``low + part * (high - low)``, so that a constant field stays constant to the last
    bit.
    """
    last = np.array(voxels.shape[2::-1]) - 1
    inside = np.clip(ijk, 0, last)
    cell = np.minimum(inside.astype(np.int64), np.maximum(last - 1, 0))
    part = (inside - cell).reshape(-1, 3, *[1] * (voxels.ndim - 3))
    i, j, k = zip(cell.T, np.minimum(cell + 1, last).T, strict=True)

    def between(axis: int, low: Float64Array, high: Float64Array) -> Float64Array:
        return low + part[:, axis] * (high - low)

    rows = [[voxels[k_at, j_at, i_at].astype(np.float64) for i_at in i] for k_at in k for j_at in j]
    lines = [between(0, *row) for row in rows]
    return between(2, between(1, *lines[:2]), between(1, *lines[2:]))


def voxel_gradients(voxels: NDArray, matrices: Float64Array) -> Float64Array:
    """Compute the gradient per mm at every voxel, (nk, nj, ni, 3), by the `slice_normal_matrices`; between voxels it is
    interpolated.

    Central differences; at the border half a one-sided difference (the index beyond is clamped).
    """
    wide = np.pad(voxels.astype(np.float64), 1, mode="edge")
    inner = slice(1, -1)
    along = [
        wide[inner, inner, 2:] - wide[inner, inner, :-2],
        wide[inner, 2:, inner] - wide[inner, :-2, inner],
        wide[2:, inner, inner] - wide[:-2, inner, inner],
    ]
    gradients = np.zeros((*voxels.shape, 3))
    for x, a in np.argwhere(matrices.any(axis=0)):
        gradients[..., x] += 0.5 * matrices[:, x, a, None, None] * along[a]
    return gradients


def hash_pixels(x: NDArray[np.integer], y: NDArray[np.integer]) -> NDArray[np.uint32]:
    """A 32-bit hash of pixels; `hash_pixel` in cl/rays/jitter.h gives the same bits.

    The mixer is lowbias32 (C. Wellons 2018, "Prospecting for hash functions"), first applied to y, then to x combined
    with the result.
    """
    mixed = _mix(np.asarray(y).astype(np.uint32) + np.uint32(0x9E3779B9))
    return _mix(np.asarray(x).astype(np.uint32) + mixed)


def _mix(bits: NDArray[np.uint32]) -> NDArray[np.uint32]:
    bits = (bits ^ (bits >> np.uint32(16))) * np.uint32(0x7FEB352D)
    bits = (bits ^ (bits >> np.uint32(15))) * np.uint32(0x846CA68B)
    return bits ^ (bits >> np.uint32(16))


def jitter_pixels(width: int, height: int) -> Float64Array:
    """Return the place of samples in their segments for each pixel, shape (height, width): 0 to below 1, 24 bits."""
    y, x = np.mgrid[:height, :width]
    return (hash_pixels(x, y) >> np.uint32(8)) * 2.0**-24


AIR_HU = -1000.0
"""HU that attenuates nothing; lower values (padding, voxels removed by a mask) count as this."""

TABLE_NODES = 4096
"""Entries of the table of a transfer function."""

OPAQUE = 0.99
"""Opacity at which a ray ends."""

_VISIBLE = 1.0 / 255.0
"""Opacity of a ray above which its current sample is the first hit."""

_FLAT_GRADIENT = 1e-6
"""HU per mm; smaller gradients have no direction."""

_PART_SLACK = 1e-3
"""Tolerance as a share of a sample: a step that divides the distance of slice planes up to rounding divides it."""

_PLANE_SLACK = 1.0 / 4096.0
"""Tolerance as a share of a sample: a plane just outside the way of a ray, within rounding, counts as inside."""


@dataclass
class RayPicture:
    """The results of rays, (h, w).

    rgba: Colours times opacity, and opacity; zero for modes that show values.
    depth: First hit, mm along the ray; NaN where nothing is hit.  In mip and minip the first place of the value; NaN in
        mean and drr.
    expected_depth: Mean depth, weighted by the opacity that each sample adds; in mip and minip the depth of the value.
    values: HU in mip, minip and mean, NaN outside of the volume; in drr mm of water, 0 there; NaN everywhere in dvr.
    """

    rgba: Float64Array
    depth: Float64Array
    expected_depth: Float64Array
    values: Float64Array

    def image(self) -> NDArray[np.uint8]:
        """Red, green, blue, opacity, not premultiplied, as in `clrecon.Rendering.image`: shape (h, w, 4), uint8."""
        opacity = self.rgba[..., 3:]
        colour = np.divide(self.rgba[..., :3], opacity, out=np.zeros_like(self.rgba[..., :3]), where=opacity > 0)
        straight = np.concatenate([colour, opacity], axis=-1)
        return np.floor(255.0 * np.clip(straight, 0.0, 1.0) + 0.5).astype(np.uint8)


class _Rays:
    """The rays of a picture with their way through a volume."""

    def __init__(self, volume: Volume, camera: Camera, size: Sequence[int], clip: Clip | None):
        origins, directions = camera.rays(size)
        self.volume = volume
        self.origins, self.directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
        self.count = len(self.origins)
        nearest = -np.inf if camera.is_parallel else 0.0
        self.t_in, self.t_out, _ = find_interval(self.origins, self.directions, box_of(volume), clip, nearest)
        self.last_ijk = np.array(volume.shape_ijk) - 1.0

    def places(self, ray: NDArray[np.int64], t: Float64Array) -> tuple[Float64Array, NDArray[np.bool_]]:
        """Return index coordinates at t of rays, and which of them lie in their slice (all in an even stack)."""
        ijk = self.volume.lps_to_ijk(self.origins[ray] + t[:, None] * self.directions[ray])
        if not self.volume.uneven:
            return ijk, np.ones(len(ijk), dtype=bool)
        in_slice = (ijk[:, :2] >= -0.5) & (ijk[:, :2] <= self.last_ijk[:2] + 0.5)
        return ijk, np.asarray(in_slice.all(axis=1))


def smooth_field(volume: Volume, sigma_mm: float | None) -> NDArray:
    """Return the voxels smoothed by a Gaussian, to the bits of cl/rays/smooth.cl; None: of a voxel, as without noise.

    In float32, one axis after the other, outwards from each voxel; whole numbers are rounded after each, halves down.
    """
    sigma = float(np.cbrt(np.prod(volume.spacing))) if sigma_mm is None else sigma_mm
    voxels = volume.voxels
    for axis, spacing in zip((2, 1, 0), volume.spacing, strict=True):
        reach = int(np.ceil(2.5 * sigma / spacing)) if sigma >= 0.25 * spacing else 0
        bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) * spacing / max(sigma, 1e-9)) ** 2)
        weights = (bell / bell.sum())[reach:].astype(np.float32)
        pads = [(reach, reach) if each == axis else (0, 0) for each in range(3)]
        wide = np.moveaxis(np.pad(voxels.astype(np.float32), pads, mode="edge"), axis, 0)
        count = len(wide) - 2 * reach
        total = weights[0] * wide[reach : reach + count]
        for step in range(1, reach + 1):
            total += weights[step] * (wide[reach - step :][:count] + wide[reach + step :][:count])
        total = np.moveaxis(total, 0, axis)
        voxels = total if voxels.dtype.kind == "f" else np.ceil(total - np.float32(0.5)).astype(voxels.dtype)
    return voxels


def cast_rays(
    volume: Volume, style: VolumeLook | Projection, camera: Camera, size: Sequence[int], lit: NDArray | None = None
) -> RayPicture:
    """Send a ray through each pixel; `lit` are the voxels whose gradients are lit, by default those of `smooth_field`.

    The field is trilinear between voxel centres; up to half a voxel beyond the outermost centres it has their values. A
    ray is divided into segments of the style's ray step, by default half the smallest spacing, from where it enters the
    volume within the clip planes; the last segment ends where it leaves.  Each segment has a sample in its middle, or
    with jitter at a place that depends on the pixel alone.  Modes "mip", "minip" and "mean" take the
    highest, lowest and mean value, the integral along the ray divided by its length.  A radiograph, "drr", is the
    thickness of water with the same attenuation as the ray: the integral of attenuation relative to water; its field
    interpolates max(HU, -1000) / 1000 + 1 between voxels.
    """
    step = style.ray_step or 0.5 * min(volume.spacing)
    rays = _Rays(volume, camera, size, style.clip)
    width, height = size
    if isinstance(style, VolumeLook):
        part = jitter_pixels(width, height).ravel() if style.jitter else np.full(rays.count, 0.5)
        if lit is None:
            lit = smooth_field(volume, style.smooth_light if style.light.shades else 0.0)
        result = _composite(rays, style, step, part, lit)
    elif style.kind in ("mean", "drr"):
        result = _integrate(rays, step, as_water=style.kind == "drr")
    else:
        result = _find_extreme(rays, step, 1.0 if style.kind == "mip" else -1.0)
    shape = (height, width)
    rgba, depth, expected_depth, values = result
    return RayPicture(
        rgba.reshape(*shape, 4), depth.reshape(shape), expected_depth.reshape(shape), values.reshape(shape)
    )


Found = tuple[Float64Array, Float64Array, Float64Array, Float64Array]
"""rgba (n, 4), depth, expected depth and values (n,)."""


@lru_cache(maxsize=2)
def _list_nodes(function: TransferFunction) -> Float64Array:
    return function.table(*function.range_hu, TABLE_NODES).astype(np.float64)


def look_up(transfer_function: TransferFunction, hu: Float64Array) -> Float64Array:
    """Return colour and opacity (n, 4) of the nearest of `TABLE_NODES` even HU over the function's range, float32."""
    low, high = transfer_function.range_hu
    number = np.floor((hu - low) * ((TABLE_NODES - 1) / (high - low)) + 0.5)
    return np.asarray(_list_nodes(transfer_function)[np.clip(number, 0, TABLE_NODES - 1).astype(np.int64)])


def shade(
    colours: Float64Array,
    gradients: Float64Array,
    directions: Float64Array,
    lighting: Lighting,
    lit: ArrayLike = 1.0,
    soft_gradient: float = 0.0,
    open_share: ArrayLike = 1.0,
) -> Float64Array:
    """Shade colours (n, 3) after Phong with gradients (n, 3) as normals, seen along directions (n, 3).

    Normals are turned towards the camera, and a fixed light only lights surfaces that face it.  A zero gradient has no
    direction: its colour gets full diffuse light and no highlight.  `lit` 0 means in shadow: only ambient light.  With
    `soft_gradient` (HU per mm) directions of small gradients count less, see `clrecon.rendering.Lighting`. Of all light
    `open_share` reaches the places.  Colours above 1 become 1.
    """
    magnitude = np.linalg.norm(gradients, axis=1)
    flat = magnitude < _FLAT_GRADIENT
    normals = gradients / np.where(flat, 1.0, magnitude)[:, None]
    to_camera = -directions
    to_light = to_camera
    if lighting.direction is not None:
        fixed = np.array(lighting.direction, dtype=np.float64)
        to_light = np.broadcast_to(fixed / np.linalg.norm(fixed), to_camera.shape)
    half_way = to_light + to_camera
    length = np.linalg.norm(half_way, axis=1, keepdims=True)
    half_way = np.divide(half_way, length, out=np.zeros_like(half_way), where=length > 1e-6)
    along = (normals * to_light).sum(axis=1)
    faces_light = along * (normals * to_camera).sum(axis=1) > 0.0  # light and camera on the same side
    diffuse = np.where(flat, 1.0, np.where(faces_light, np.abs(along), 0.0))
    shine = np.abs((normals * half_way).sum(axis=1)) ** lighting.specular_power
    highlight = np.where(flat | ~faces_light, 0.0, shine)
    certain = magnitude**2 / (magnitude**2 + max(soft_gradient, _FLAT_GRADIENT) ** 2)
    diffuse, highlight = 1.0 + certain * (diffuse - 1.0), certain * highlight
    share = np.broadcast_to(np.asarray(lit, dtype=np.float64), magnitude.shape)
    light = lighting.ambient + share * lighting.diffuse * diffuse
    shaded = colours * light[:, None] + (share * lighting.specular * highlight)[:, None]
    return np.minimum(np.broadcast_to(open_share, magnitude.shape)[:, None] * shaded, 1.0)


def _find_light(volume: Volume, style: VolumeLook) -> Callable[[Float64Array], Float64Array]:
    """Return what tells the share of the light that reaches places of index coordinates (n, 3)."""
    length = cell_length(volume)

    def find_opacity(voxels: NDArray) -> NDArray:
        let_through = 1.0 - look_up(style.function, voxels.astype(np.float64))[..., 3]
        return np.asarray(1.0 - let_through ** (length / style.function.unit_distance))

    return open_volume(volume, find_opacity, style.ambient_occlusion, style.clip)


def _composite(rays: _Rays, style: VolumeLook, step: float, part: Float64Array, lit: NDArray) -> Found:
    voxels = rays.volume.voxels
    transfer_function, lighting = style.function, style.light
    find_light = _find_light(rays.volume, style)
    matrices = slice_normal_matrices(rays.volume, 0)
    gradients = None if transfer_function.gradient_opacity is None else voxel_gradients(voxels, matrices)
    lit_gradients = voxel_gradients(lit, matrices)
    rgba = np.zeros((rays.count, 4))
    depth, weighted = np.full(rays.count, np.nan), np.zeros(rays.count)
    steep = _SteepSegments(rays, transfer_function, step, part)
    for number, (ray, t, length) in enumerate(_segments(rays, step, part, rgba[:, 3])):
        ijk, there = rays.places(ray, t)
        values = sample_field(voxels, ijk)
        opacity = look_up(transfer_function, values)[:, 3]
        if steep.is_there:
            t, values, opacity = steep.take_parts(number, ray, t, length, values, opacity)
        opacity = np.where(there, opacity, 0.0)
        seen = opacity > 0.0
        ray, t = ray[seen], t[seen]
        length, opacity = length[seen], opacity[seen]
        colour = look_up(transfer_function, values[seen])[:, :3]
        ijk, _ = rays.places(ray, t)
        if gradients is not None:
            slope = sample_field(gradients, ijk)
            opacity = opacity * transfer_function.gradient_factor(np.linalg.norm(slope, axis=1))
        slope = sample_field(lit_gradients, ijk)
        softness = max(lighting.soft_gradient, LEAST_SOFT_GRADIENT)
        colour = shade(
            colour, slope, rays.directions[ray], lighting, soft_gradient=softness, open_share=find_light(ijk)
        )
        opacity = 1.0 - (1.0 - opacity) ** (length / transfer_function.unit_distance)
        weight = (1.0 - rgba[ray, 3]) * opacity
        rgba[ray, :3] += weight[:, None] * colour
        rgba[ray, 3] += weight
        weighted[ray] += weight * t
        first = np.isnan(depth[ray]) & (rgba[ray, 3] > _VISIBLE)
        depth[ray[first]] = t[first]
    any_weight = rgba[:, 3] > 0.0
    expected = np.divide(weighted, rgba[:, 3], out=np.full(rays.count, np.nan), where=any_weight)
    return rgba, depth, expected, np.full(rays.count, np.nan)


class _SteepSegments:
    """Divides segments where the transfer function is steep, by a parabola through three samples, and blends them."""

    def __init__(self, rays: _Rays, function: TransferFunction, step: float, part: Float64Array):
        self.rays, self.function = rays, function
        self.step, self.part = step, part
        low, high = function.range_hu
        self.low, self.scale = low, (TABLE_NODES - 1) / (high - low)
        self.clear = (1.0 - _list_nodes(function)[:, 3]) ** (step / function.unit_distance)
        self.steepness = Steepness.of((1.0 - self.clear).astype(np.float32), self.scale)
        self.is_there = self.steepness.is_steep and takes_parts(rays.volume, step)
        shown = np.flatnonzero(self.clear < 1.0)
        first, end = (int(shown[0]), int(shown[-1]) + 1) if len(shown) else (TABLE_NODES, -1)
        # Values beyond the first and the last node count as these nodes.
        self.first = -np.inf if first == 0 else float(first)
        self.last = np.inf if end == TABLE_NODES else float(end)

    def nodes(self, values: Float64Array) -> NDArray[np.int64]:
        return np.clip(values, 0, TABLE_NODES - 1).astype(np.int64)

    def sample(self, number: float | Float64Array, ray: NDArray[np.int64]) -> Float64Array:
        """Return values of samples of rays, in nodes; after the last sample its own value."""
        rays, part = self.rays, self.part[ray]
        length = rays.t_out[ray] - rays.t_in[ray]
        last = np.ceil(length / self.step) - 1.0
        t_last = rays.t_in[ray] + last * self.step + part * (length - last * self.step)
        ijk, _ = rays.places(ray, np.minimum(rays.t_in[ray] + (number + part) * self.step, t_last))
        return (sample_field(rays.volume.voxels, ijk) - self.low) * self.scale + 0.5

    def take_parts(
        self, number: int, ray: NDArray[np.int64], t: Float64Array, length: Float64Array, values: Float64Array,
        opacity: Float64Array,
    ) -> tuple[Float64Array, Float64Array, Float64Array]:  # fmt: skip
        """Return places, values and opacities of segments `number`, whose samples have `values` and `opacity`."""
        here, after = (values - self.low) * self.scale + 0.5, self.sample(number + 1, ray)
        before = self.sample(number - 1 if number else -np.minimum(self.part[ray], 0.5), ray)
        if number == 0:
            before = 2.0 * before - here
        nothing = np.maximum(before, here) < self.first
        nothing |= np.minimum(before, here) >= self.last
        front, back = np.where(nothing, 0.0, 0.5 * (before - here)), 0.5 * (after - here)
        least, most = np.minimum(np.minimum(front, back), 0.0), np.maximum(np.maximum(front, back), 0.0)
        changes = self.steepness.changes
        change = changes[self.nodes(here + most)] - changes[self.nodes(here + least)]
        dense = 1.0 - self.clear[self.nodes(here)] > DENSE
        steep = (here + most >= self.first) & (here + least < self.last)
        steep &= ((most - least > self.steepness.narrow) & (change > STEEP)) | dense
        clear = np.ones(len(ray))
        seen_at, seen_value = np.zeros(len(ray)), np.zeros(len(ray))
        for share in (np.arange(PARTS) + 0.5) / PARTS - 0.5:
            end = (2.0 if number else 1.0) * front if share < 0.0 else 2.0 * back
            rise = np.clip(share * (back - front + share * (back + front)), np.minimum(end, 0.0), np.maximum(end, 0.0))
            behind = clear * self.clear[self.nodes(here + rise)] ** (1.0 / PARTS)
            seen_at += (clear - behind) * share
            seen_value += (clear - behind) * (here + rise)
            clear = behind
        whole = np.maximum(1.0 - clear, 1e-6)
        in_parts = (seen_value / whole - 0.5) / self.scale + self.low
        over_unit = 1.0 - clear ** (self.function.unit_distance / self.step)
        return (
            np.where(steep, t + seen_at / whole * length, t),
            np.where(steep, in_parts, values),
            np.where(steep, over_unit, opacity),
        )


def _segments(
    rays: _Rays, step: float, part: Float64Array, opacity: Float64Array
) -> Iterator[tuple[NDArray[np.int64], Float64Array, Float64Array]]:
    """Yield segment by segment (ray numbers, t of the sample, length) of the rays that are not opaque yet."""
    depth_range = rays.t_out - rays.t_in
    segments = np.where(depth_range > 0.0, np.ceil(depth_range / step), 0.0)
    for number in range(int(segments.max(initial=0.0))):
        ray = np.flatnonzero((number < segments) & (opacity < OPAQUE))
        if len(ray) == 0:
            return
        start = rays.t_in[ray] + number * step
        length = np.clip(rays.t_out[ray] - start, 0.0, step)
        yield ray, start + part[ray] * length, length


def _integrate(rays: _Rays, step: float, as_water: bool) -> Found:
    voxels = rays.volume.voxels
    if as_water:
        voxels = np.maximum(voxels.astype(np.float64), AIR_HU) / -AIR_HU + 1.0
    total, path = np.zeros(rays.count), np.zeros(rays.count)
    for ray, t, length in _segments(rays, step, np.full(rays.count, 0.5), np.zeros(rays.count)):
        ijk, there = rays.places(ray, t)
        total[ray] += np.where(there, length * sample_field(voxels, ijk), 0.0)
        path[ray] += np.where(there, length, 0.0)
    mean = np.divide(total, path, out=np.full(rays.count, np.nan), where=path > 0.0)
    nowhere = np.full(rays.count, np.nan)
    return np.zeros((rays.count, 4)), nowhere, nowhere.copy(), total if as_water else mean


def _find_extreme(rays: _Rays, step: float, sign: float) -> Found:
    best, depth = np.full(rays.count, -np.inf), np.full(rays.count, np.nan)
    for ray, t in _plane_samples(rays, step):
        ijk, there = rays.places(ray, t)
        values = sign * sample_field(rays.volume.voxels, ijk)
        better = there & (values > best[ray])
        best[ray[better]] = values[better]
        depth[ray[better]] = t[better]
    values = np.where(np.isnan(depth), np.nan, sign * best)
    return np.zeros((rays.count, 4)), depth, depth.copy(), values


def _plane_samples(rays: _Rays, step: float) -> Iterator[tuple[NDArray[np.int64], Float64Array]]:
    """Yield sample by sample (ray numbers, t), on all slice planes of the index axis that the ray crosses fastest.

    Between two planes there are additional samples as `step` requires.  Where no sample falls into the way through the
    volume (a thin space between clip planes), there is one in the middle.  Uneven stacks have samples in the middles of
    segments, as in other modes.
    """
    if rays.volume.uneven:
        yield from ((ray, t) for ray, t, _ in _segments(rays, step, np.full(rays.count, 0.5), np.zeros(rays.count)))
        return
    inverse = np.linalg.inv(rays.volume.affine)
    rates = rays.directions @ inverse[:3, :3].T
    axis = np.abs(rates).argmax(axis=1)[:, None]
    rate = np.take_along_axis(rates, axis, axis=1)[:, 0]
    start = np.take_along_axis(rays.origins @ inverse[:3, :3].T + inverse[:3, 3], axis, axis=1)[:, 0]
    spacing = 1.0 / (np.abs(rate) * np.maximum(np.ceil(1.0 / (np.abs(rate) * step) - _PART_SLACK), 1.0))
    t_of_plane_0 = -start / rate
    valid = rays.t_out > rays.t_in
    t_in, t_out = np.where(valid, rays.t_in, 0.0), np.where(valid, rays.t_out, -1.0)
    first = np.ceil((t_in - t_of_plane_0) / spacing - _PLANE_SLACK)
    last = np.floor((t_out - t_of_plane_0) / spacing + _PLANE_SLACK)
    missed = np.flatnonzero(valid & (last < first))
    yield missed, 0.5 * (t_in + t_out)[missed]
    for number in range(int((last - first).max(initial=-1.0)) + 1):
        ray = np.flatnonzero(valid & (first + number <= last))
        yield ray, t_of_plane_0[ray] + (first[ray] + number) * spacing[ray]
