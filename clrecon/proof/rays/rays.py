"""Shared parts of the ray twins: the way of a ray through a volume, the field there, and jitter.

Everything is float64 and vectorised over rays.  Rays are arrays (n, 3): origins in LPS mm and unit directions.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array, slice_normal


class Planes(Protocol):
    """Form of `clrecon.rendering.views.clip.Clip`: unit normals and offsets (n, 4); kept is normal . p >= offset."""

    @property
    def planes(self) -> Float64Array: ...


class Box:
    """The volume's box as bounds on three linear functions of LPS: inside is low <= normals @ p + offsets <= high.

    For an even stack the functions are its indices.  Slices of an uneven stack may shift sideways, so no box holds
    exactly its voxels.  The functions are then i and j counted in the plane of slice 0, with bounds around all slices,
    and the height over slice 0. Samples in that box but beside their slice are ignored.
    """

    def __init__(self, normals: Float64Array, offsets: Float64Array, low: Float64Array, high: Float64Array):
        self.normals, self.offsets, self.low, self.high = normals, offsets, low, high


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
    origins: Float64Array, directions: Float64Array, box: Box, clip: Planes | None = None, nearest: float = -np.inf
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
    return np.einsum("kxa,kjia->kjix", matrices, 0.5 * np.stack(along, axis=-1))


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
