"""Twins of `clrecon.operators` in plain numpy: primitives, bricks of resident volumes, masks (boxes and tubes, where
every voxel is asked; balls, one nearest voxel at a time), filters in float64, and slices in float64.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.views.reformation import Sheet, SlabSamples


def exclusive_scan(counts: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], int]:
    """Return the sum of all counts before each element, (n,) uint32, and the total."""
    sums = np.cumsum(counts, dtype=np.uint64)
    total = int(sums[-1]) if sums.size else 0
    return (sums - counts).astype(np.uint32), total


def compact(mask: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the positions of the set bits of a bit mask in ascending order; bit b of word w is position 32 w + b."""
    return np.flatnonzero(mask[:, None] >> np.arange(32, dtype=np.uint32) & 1).astype(np.uint32)


def radix_sort(keys: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Sort keys, equal ones in the order of the input; return the number of each in the input too."""
    order = np.argsort(keys, kind="stable")
    return keys[order], order.astype(np.uint32)


def label_components(triangles: NDArray[np.uint32], vertex_count: int) -> tuple[int, NDArray[np.int64]]:
    """Number components by label propagation, in order of the first vertex; -1 for unused vertices."""
    roots = np.arange(vertex_count)
    while True:
        before = roots.copy()
        least = roots[triangles].min(axis=1)
        for corner in range(3):
            np.minimum.at(roots, triangles[:, corner], least)
        if np.array_equal(roots, before):
            break
    used = np.zeros(vertex_count, dtype=bool)
    used[triangles.reshape(-1)] = True
    is_root = used & (roots == np.arange(vertex_count))
    number = np.cumsum(is_root) - 1
    return int(np.count_nonzero(is_root)), np.where(used, number[roots], -1).astype(np.int64)


def find_irregular(triangles: NDArray[np.uint32], vertex_count: int, longest: int = 16) -> list[int]:
    """Return the used vertices whose triangles are not one closed fan of 3 to `longest`, one vertex at a time."""
    corners: list[list[tuple[int, int]]] = [[] for _ in range(vertex_count)]
    for a, b, c in triangles.tolist():
        for before, vertex, after in ((c, a, b), (a, b, c), (b, c, a)):
            corners[vertex].append((before, after))
    irregular = []
    for vertex, fan in enumerate(corners):
        if not fan:
            continue
        after_of = dict(fan)
        is_once = len(fan) == len(after_of) == len(set(after_of.values()))
        turned = fan[:1]
        while len(turned) <= len(fan) and turned[-1][1] in after_of and turned[-1][1] != fan[0][0]:
            turned.append((turned[-1][1], after_of[turned[-1][1]]))
        is_closed = is_once and len(turned) == len(fan) and turned[-1][1] == fan[0][0]
        if not (is_closed and 2 < len(fan) <= longest):
            irregular.append(vertex)
    return irregular


def measure_bricks(voxels: NDArray[Any], brick: int = 8) -> NDArray[Any]:
    """Return the lowest and highest value of each brick, (bk, bj, bi, 2)."""
    shape = [-(-n // brick) for n in voxels.shape]
    ranges = np.empty((*shape, 2), voxels.dtype)
    for brick_index in np.ndindex(*shape):
        part = voxels[tuple(slice(brick * n, brick * (n + 1)) for n in brick_index)]
        ranges[brick_index] = part.min(), part.max()
    return ranges


def compare_bricks(
    ranges: NDArray[Any], level: float, ni: int, border: int, brick: int = 8
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Return the state of each word of samples and the extent of each row of bricks, as the device operator does."""
    words = -(-(ni + 2 * border) // 32)
    states = np.zeros((*ranges.shape[:2], words), np.uint8)
    extents = np.zeros((*ranges.shape[:2], 2), np.uint16)
    for k, j in np.ndindex(*ranges.shape[:2]):
        for word in range(words):
            first, end = max(32 * word - border, 0), min(32 * word - border + 32, ni)
            if first < end:
                low, high = ranges[k, j, first // brick : (end - 1) // brick + 1].T
                states[k, j, word] = 0 if high.max() < level else 2 - (low.min() >= level)
        used = np.flatnonzero(states[k, j])
        if len(used):
            extents[k, j] = used[0], used[-1] + 1
    return states, extents


def fill_holes(chosen: ArrayLike, *, by_slice: bool = False) -> NDArray[np.bool_]:
    """Return the chosen voxels and those that they enclose, (nk, nj, ni): what a flood from beyond never meets."""
    from scipy.ndimage import binary_fill_holes

    bits = np.asarray(chosen, dtype=bool)
    return np.stack([binary_fill_holes(layer) for layer in bits]) if by_slice else np.asarray(binary_fill_holes(bits))


def grow(chosen: ArrayLike, voxels: ArrayLike) -> NDArray[np.bool_]:
    """Return the components that hold one of the voxels (n, 3), (nk, nj, ni)."""
    from scipy.ndimage import label

    bits = np.asarray(chosen, dtype=bool)
    components = label(bits)[0]
    return bits & np.isin(components, components[tuple(np.asarray(voxels).T)])


def find_places(volume: Volume, border: tuple[int, int, int] = (0, 0, 0)) -> NDArray[np.float64]:
    """Return LPS mm of all voxels, and of as many beyond them along i, j and k as `border` says, (nk, nj, ni, 3)."""
    shape = [n + 2 * more for n, more in zip(volume.voxels.shape, border[::-1], strict=True)]
    ijk = np.indices(shape)[::-1].reshape(3, -1).T - border
    return volume.ijk_to_lps(ijk).reshape(*shape, 3)


def find_in_box(volume: Volume, sides: ArrayLike) -> NDArray[np.bool_]:
    """Return the voxels in a box of sides (3, 2), LPS mm, and up to 1e-6 mm beyond; infinity leaves a side open."""
    low, high = np.asarray(sides, dtype=np.float64).T
    places = find_places(volume)
    in_box: NDArray[np.bool_] = ((places >= low - 1e-6) & (places <= high + 1e-6)).all(axis=-1)
    return in_box


def find_in_tube(volume: Volume, points: ArrayLike, radius_mm: float) -> NDArray[np.bool_]:
    """Return the voxels within ``radius_mm * (1 + 1e-6)`` of a line through points, shape (nk, nj, ni)."""
    line: NDArray[Any] = np.asarray(points, dtype=np.float64)
    places = find_places(volume)
    nearest = np.linalg.norm(places - line[0], axis=-1)
    for begin, end in zip(line[:-1], line[1:], strict=True):
        along = end - begin
        square = float(along @ along)
        part = np.clip(((places - begin) @ along) / square, 0.0, 1.0) if square else np.zeros(places.shape[:-1])
        nearest = np.minimum(nearest, np.linalg.norm(places - begin - part[..., None] * along, axis=-1))
    in_tube: NDArray[np.bool_] = nearest <= radius_mm * (1.0 + 1e-6)
    return in_tube


Bits = NDArray[np.bool_]


def dilate(volume: Volume, chosen: ArrayLike, mm: float, *, by_slice: bool = False) -> Bits:
    """Return the voxels within ``mm * (1 + 1e-6)`` of a chosen one, shape (nk, nj, ni)."""
    return _spread_mask(find_places(volume), np.asarray(chosen, dtype=bool), mm, by_slice)


def erode(volume: Volume, chosen: ArrayLike, mm: float, *, by_slice: bool = False, beyond: bool = False) -> Bits:
    """Return the voxels without one within ``mm * (1 + 1e-6)`` that is not chosen; `beyond`: those beyond are."""
    bits = np.asarray(chosen, dtype=bool)
    if beyond:
        return ~_spread_mask(find_places(volume), ~bits, mm, by_slice)
    # enough voxels that those beyond them are farther than `mm` from the volume
    steps = volume.affine[:3, :3].copy()
    ends = np.diff(volume.slice_origins(1), axis=0)[[0, -1]]
    borders = []
    for end in ends:
        steps[:, 2] = end
        borders.append(2 + np.ceil(mm * np.linalg.norm(np.linalg.inv(steps), axis=1)).astype(int))
    i, j, k = np.max(borders, axis=0).tolist()
    border = i, j, k
    padded = np.pad(~bits, [(n, n) for n in border[::-1]], constant_values=True)
    inner = tuple(slice(n, n + size) for n, size in zip(border[::-1], bits.shape, strict=True))
    return ~_spread_mask(find_places(volume, border), padded, mm, by_slice, inner)


def close(volume: Volume, chosen: ArrayLike, mm: float, *, by_slice: bool = False) -> Bits:
    """Return a dilation, eroded as if all beyond the volume were chosen."""
    return erode(volume, dilate(volume, chosen, mm, by_slice=by_slice), mm, by_slice=by_slice, beyond=True)


def _spread_mask(
    places: NDArray[np.float64], chosen: Bits, mm: float, by_slice: bool, inner: tuple[slice, ...] = (slice(None),) * 3
) -> Bits:
    """Return the voxels of the part `inner` that are near chosen ones."""
    from scipy.spatial import cKDTree

    wanted, k = places[inner], np.arange(len(places))[inner[0]]
    is_near = np.zeros(wanted.shape[:-1], bool)
    layers = [(slice(n, n + 1), slice(at, at + 1)) for n, at in enumerate(k)] if by_slice else [(slice(None),) * 2]
    for layers_there, layer in layers:
        if chosen[layer].any():
            tree = cKDTree(places[layer][chosen[layer]])
            distances = tree.query(wanted[layers_there].reshape(-1, 3), distance_upper_bound=2.0 * mm)[0]
            is_near[layers_there] = (distances <= mm * (1.0 + 1e-6)).reshape(is_near[layers_there].shape)
    return is_near


GROUP = 16
"""Voxels of a group, along i."""


def mark_mixed_groups(voxels: NDArray[Any], level: float, reach: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Mark the groups, (nk, nj, groups), each of 16 voxels of a row or fewer at its end, of which some voxel has both
    sides of a level in the box around it.

    Inside are values from the level on, NaN not; `reach` is half the size of the box along i, j, k, without its middle.
    """
    from scipy import ndimage

    inside = voxels >= level
    size = tuple(2 * n + 1 for n in reversed(reach))
    some = ndimage.maximum_filter(inside, size, mode="nearest")
    every = ndimage.minimum_filter(inside, size, mode="nearest")
    mixed = some & ~every
    ni = voxels.shape[2]
    padded = np.zeros((*voxels.shape[:2], -(-ni // GROUP) * GROUP), np.bool_)
    padded[:, :, :ni] = mixed
    return np.asarray(padded.reshape(*voxels.shape[:2], -1, GROUP).any(axis=3))


def spatial_weights(volume: Volume, offsets: NDArray[np.integer[Any]], sigma_mm: float) -> NDArray[np.float64]:
    """Return the weights of neighbours, steps along i, j, k, by their true distance, exp(-|t|^2 / (2 sigma^2)): (nk, n)
    for the voxels of each slice; beyond the ends the slices go on in the steps of the ends.
    """
    weights = np.empty((volume.shape_ijk[2], len(offsets)))
    for k, of_slice in enumerate(weights):
        here = np.array([3.0, 4.0, float(k)])
        steps = volume.ijk_to_lps(here + offsets) - volume.ijk_to_lps(here[None])
        of_slice[:] = np.exp(-np.einsum("ni,ni->n", steps, steps) / (2.0 * sigma_mm**2))
    return weights


def filter_bilateral(
    voxels: NDArray[Any], offsets: NDArray[np.integer[Any]], weights: NDArray[np.float64], sigma_hu: float
) -> NDArray[np.float64]:
    """Filter voxels: the weighted mean of the window, `offsets` (n, 3) along i, j, k, the voxel itself among them,
    before it is rounded.

    Beyond the border lies the value of the nearest voxel.  NaN and infinite ones stay, and count nowhere.
    """
    values = voxels.astype(np.float64)
    centre = np.where(np.isfinite(values), values, 0.0)
    sizes = values.shape[::-1]
    total, moved = np.zeros_like(values), np.zeros_like(values)
    for (i, j, k), of_slices in zip(offsets.tolist(), weights.T, strict=True):
        places = [np.clip(np.arange(n) + step, 0, n - 1) for n, step in zip(sizes, (i, j, k), strict=True)]
        near = values[np.ix_(*places[::-1])]
        counts = np.isfinite(near)
        away = np.where(counts, near, 0.0) - centre
        with np.errstate(over="ignore", under="ignore"):
            weight = of_slices[:, None, None] * np.exp(-0.5 * (away / sigma_hu) ** 2) * counts
        total += weight
        moved += weight * away
    with np.errstate(invalid="ignore"):
        filtered = centre + moved / total
    result: NDArray[np.float64] = np.where(np.isfinite(values), filtered, values)
    return result


def average_patches(layer: NDArray[Any], side: int, reach: int, noise: float, scale: float) -> NDArray[np.float64]:
    """Return the non-local means of a slice (nj, ni): of the voxels within `reach`, by patches of `side` voxels.

    A patch begins (side - 1) // 2 voxels before its own.  noise, scale: Arguments of `cl/filters/means.cl`.
    """
    before, frame = (side - 1) // 2, reach + side
    framed = np.pad(layer.astype(np.float64), frame, mode="reflect")
    inner = slice(frame, -frame)
    centre = framed[inner, inner]
    weights, changes = np.ones_like(centre), np.zeros_like(centre)
    for up, along in product(range(-reach, reach + 1), repeat=2):
        if up or along:
            shifted = np.roll(framed, (-up, -along), (0, 1))
            squares = (shifted - framed) ** 2
            sums = np.zeros_like(framed)
            for row, column in product(range(side), repeat=2):
                sums += np.roll(squares, (before - row, before - column), (0, 1))
            exponent = np.maximum(sums[inner, inner] - noise, 0.0) * scale
            weight = np.where(exponent <= 5.0 / math.log(2.0), np.exp2(-exponent), 0.0)
            weights += weight
            changes += weight * (shifted[inner, inner] - centre)
    means: NDArray[np.float64] = centre + changes / weights
    return means


EDGE = 2.0**-20
"""Index steps beyond the box of a volume that still count as inside: the rounding error of a pixel on a face."""


def is_inside(volume: Volume, points: Float64Array) -> NDArray[np.bool_]:
    """True for points (..., 3) in LPS mm within the box of a volume, half a voxel beyond the outer voxel centres."""
    ijk = volume.lps_to_ijk(points.reshape(-1, 3))
    inside = ((ijk >= -0.5 - EDGE) & (ijk <= np.array(volume.shape_ijk) - 1 + 0.5 + EDGE)).all(axis=1)
    return np.asarray(inside.reshape(points.shape[:-1]))


def sample_field(volume: Volume, points: Float64Array) -> Float64Array:
    """Interpolate HU trilinearly in the box of the volume; beyond the outer centres the nearest value holds."""
    last = np.array(volume.shape_ijk) - 1
    ijk = np.clip(volume.lps_to_ijk(points), 0.0, last)
    low = np.floor(ijk).astype(np.intp)
    part = ijk - low
    high = np.minimum(low + (part > 0.0), last)
    values = np.zeros(len(ijk))
    for corner in np.ndindex(2, 2, 2):
        i, j, k = (np.where(upper, high[:, axis], low[:, axis]) for axis, upper in enumerate(corner))
        weight = np.prod(np.where(corner, part, 1.0 - part), axis=1)
        # Voxels with weight 0 are ignored: they may be NaN.
        values += np.where(weight > 0.0, weight * volume.voxels[k, j, i].astype(np.float64), 0.0)
    return values


def reformat_sheet(volume: Volume, sheet: Sheet, samples: SlabSamples, combine: str = "mean") -> Float64Array:
    """Compute the values of all pixels of a sheet, HU; NaN where no sample lies within the volume."""
    shape = sheet.height, sheet.width
    values = np.full(shape, 0.0 if combine == "mean" else np.nan)
    weights = np.zeros(shape)
    for offset, weight in zip(samples.offsets, samples.weights, strict=True):
        points = sheet.points(depth=offset)
        inside = is_inside(volume, points)
        sampled = sample_field(volume, points[inside])
        weights[inside] += weight
        if combine == "mean":
            values[inside] += weight * sampled
        else:
            values[inside] = (np.fmax if combine == "max" else np.fmin)(values[inside], sampled)
    if combine == "mean":
        values = values / np.where(weights > 0.0, weights, 1.0)
    return np.asarray(np.where(weights > 0.0, values, np.nan))
