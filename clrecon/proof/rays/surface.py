"""Twins of mode surface, the first place of each ray where the closed field reaches an iso value, shaded, and of mode
slices, slices of a volume in space, blended along the ray of each pixel; in float64.

The closed field is the one that `clrecon.operators.surface.extract` takes its closed mesh from: surrounded by a layer
of outside, its surface at the level of `clrecon.geometry.iso_rule.IsoRule`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.iso_rule import choose_iso_rule, slice_normal_matrices
from clrecon.proof.rays.openness import open_volume
from clrecon.proof.rays.render import RayPicture, box_of, find_interval, sample_field, shade, voxel_gradients
from clrecon.rendering.pictures.styles import SlicesInSpace, SurfaceLook
from clrecon.rendering.views.camera import Camera

_HALVINGS = 10
"""Number of halvings of a step: the hit is then known to 1e-3 of it."""


class _ClosedField:
    """The field surrounded by a layer of outside, at places in LPS."""

    def __init__(self, volume: Volume, iso_value: float):
        rule = choose_iso_rule(volume, iso_value)
        voxels = volume.voxels.astype(np.float64)
        self.volume = volume
        self.level, self.outside = rule.iso_level, rule.outside
        self.closed = np.pad(voxels, 1, constant_values=rule.outside)
        wider = np.pad(voxels, 2, constant_values=rule.outside)
        self.gradients = voxel_gradients(wider, slice_normal_matrices(volume, 2))[1:-1, 1:-1, 1:-1]
        self.last = np.array(volume.shape_ijk) - 1.0

    def inside(self, points: Float64Array) -> NDArray[np.bool_]:
        """Return which LPS points (n, 3) are inside; nothing beyond the layer of outside is."""
        ijk = self.volume.lps_to_ijk(points)
        there = ((ijk >= -1.0) & (ijk <= self.last + 1.0)).all(axis=1)
        return there & (sample_field(self.closed, ijk + 1.0) >= self.level)

    def gradient(self, points: Float64Array) -> Float64Array:
        return sample_field(self.gradients, self.volume.lps_to_ijk(points) + 1.0)


def cast_surface(volume: Volume, style: SurfaceLook, camera: Camera, size: Sequence[int]) -> RayPicture:
    """Find the surface along the ray of each pixel; both depths are that of the hit, and there are no values.

    Samples lie the style's ray step apart, by default half the smallest spacing, from where the ray enters the closed
    volume, the last where it leaves; between the first inside and the one before it the surface is found by bisection.
    A ray that begins inside, behind a clip plane or at a camera inside, has its hit at once: on the clip plane the
    cap's normal is the plane's, at a camera it is the ray's own direction.

    With shadows a hit has only ambient light if a ray from it towards a fixed light meets something inside, from one
    step on and within the clip planes.
    """
    step = style.ray_step or 0.5 * min(volume.spacing)
    field, box = _ClosedField(volume, style.iso_value), box_of(volume, border=1.0)
    origins, directions = (rays.reshape(-1, 3) for rays in camera.rays(size))
    nearest = -np.inf if camera.is_parallel else 0.0
    t_in, t_out, entered_by = find_interval(origins, directions, box, style.clip, nearest)
    hit, at_once = _first_inside(field, origins, directions, t_in, t_out, step)
    rays_hit = np.flatnonzero(~np.isnan(hit))
    points = origins[rays_hit] + hit[rays_hit, None] * directions[rays_hit]
    normals = field.gradient(points)
    for n in np.flatnonzero(at_once[rays_hit]):
        plane = entered_by[rays_hit[n]]
        cut = style.clip if plane >= 0 else None
        normals[n] = directions[rays_hit[n]] if cut is None else cut.planes[plane, :3]
    lit = np.ones(len(rays_hit))
    if style.shadows:
        light = np.array(style.light.direction, dtype=np.float64)
        towards = np.broadcast_to(light / np.linalg.norm(light), points.shape)
        _, far, _ = find_interval(points, towards, box, style.clip)
        blocked, _ = _first_inside(field, points, towards, np.full(len(rays_hit), step), far, step)
        lit = np.where(np.isnan(blocked), 1.0, 0.0)
    colours = shade(np.broadcast_to(style.rgb, points.shape), normals, directions[rays_hit], style.light, lit)
    find_light = open_volume(volume, lambda voxels: voxels >= field.level, style.ambient_occlusion, style.clip)
    colours = colours * find_light(volume.lps_to_ijk(points))[:, None]
    rgba = np.zeros((len(origins), 4))
    rgba[rays_hit] = np.column_stack([colours, np.ones(len(rays_hit))])
    width, height = size
    depth = hit.reshape(height, width)
    return RayPicture(rgba.reshape(height, width, 4), depth, depth.copy(), np.full((height, width), np.nan))


def _first_inside(
    field: _ClosedField,
    origins: Float64Array,
    directions: Float64Array,
    t_in: Float64Array,
    t_out: Float64Array,
    step: float,
) -> tuple[Float64Array, NDArray[np.bool_]]:
    """Return where rays are first inside, mm or NaN, and which of them begin inside."""
    hit = np.full(len(origins), np.nan)
    at_once = np.zeros(len(origins), dtype=bool)
    steps = np.where(t_out > t_in, np.ceil((t_out - t_in) / step), -1.0)
    for number in range(int(steps.max(initial=-1.0)) + 1):
        ray = np.flatnonzero((number <= steps) & np.isnan(hit))
        t = np.minimum(t_in[ray] + number * step, t_out[ray])
        inside = field.inside(origins[ray] + t[:, None] * directions[ray])
        ray, high = ray[inside], t[inside]
        low = high if number == 0 else t_in[ray] + (number - 1) * step
        at_once[ray] = number == 0
        for _ in range(_HALVINGS if number else 0):
            middle = 0.5 * (low + high)
            inside = field.inside(origins[ray] + middle[:, None] * directions[ray])
            low, high = np.where(inside, low, middle), np.where(inside, middle, high)
        hit[ray] = high
    return hit, at_once


def overlay_slices(
    volume: Volume, camera: Camera, size: Sequence[int], style: SlicesInSpace
) -> tuple[Float64Array, Float64Array]:
    """Find where each ray crosses the planes of slices, from front to back, and blend them: (h, w, 4), premultiplied,
    and mm to the first visible slice, (h, w), NaN without one.  The style has a window of two numbers."""
    width, height = size
    slices = np.asarray(style.slices, dtype=np.int64).ravel()
    black, white = np.asarray(style.window)
    origins, directions = (rays.reshape(-1, 3) for rays in camera.rays(size))
    normal = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
    starts = volume.slice_origins()[slices]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = ((starts[:, None] - origins) @ normal) / (directions @ normal)
    rgba, depth = np.zeros((len(origins), 4)), np.full(len(origins), np.nan)
    for order in np.argsort(crossings, axis=0):
        t = np.take_along_axis(crossings, order[None], axis=0)[0]
        k = slices[order]
        there = np.isfinite(t) & (camera.is_parallel | (t >= 0.0))
        points = origins + np.where(there, t, 0.0)[:, None] * directions
        if style.clip is not None:
            there &= (points @ style.clip.planes[:, :3].T >= style.clip.planes[:, 3]).all(axis=1)
        value, inside = _read_slices(volume, points, k)
        there &= inside & (value >= style.lowest_hu)
        weight = np.where(there, (1.0 - rgba[:, 3]) * style.opacity, 0.0)
        rgba[:, :3] += (weight * np.clip((value - black) / (white - black), 0.0, 1.0))[:, None]
        rgba[:, 3] += weight
        depth = np.where(there & np.isnan(depth), t, depth)
    return rgba.reshape(height, width, 4), depth.reshape(height, width)


def _read_slices(volume: Volume, points: Float64Array, k: NDArray[np.int64]) -> tuple[Float64Array, NDArray[np.bool_]]:
    """Read bilinear values (n,) at points of slices k, and which points are in the slice or half a voxel around it."""
    ij = (points - volume.slice_origins()[k]) @ np.linalg.pinv(volume.affine[:3, :2]).T
    last = np.array(volume.shape_ijk[:2]) - 1
    inside = ((ij >= -0.5) & (ij <= last + 0.5)).all(axis=1)
    ij = np.clip(ij, 0, last)
    low = np.minimum(ij.astype(int), np.maximum(last - 1, 0))
    high = np.minimum(low + 1, last)
    part_i, part_j = (ij - low).T
    rows = [
        volume.voxels[k, j, low[:, 0]] * (1.0 - part_i) + volume.voxels[k, j, high[:, 0]] * part_i
        for j in (low[:, 1], high[:, 1])
    ]
    return rows[0] * (1.0 - part_j) + rows[1] * part_j, inside
