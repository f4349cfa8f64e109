"""What lies inside of a closed surface, on a lattice: where it crosses the lines of the lattice, counted along each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.system.pieces import chunks

IntArray = NDArray[np.integer]

ASIDE = np.array([1.4142e-5, 1.7321e-5])
"""Steps by which a surface is moved, so that no line meets a vertex: a surface has its own on lines of the grid."""

_PIECE = 1 << 18
"""Triangles that are looked at together."""


def cross_lines(
    vertices: Float64Array, triangles: NDArray[np.uint32], shape: Sequence[int]
) -> tuple[IntArray, Float64Array, IntArray]:
    """Find where a surface crosses the lines along the last axis of a lattice, each line an even number of times.

    vertices: ndarray, shape (n, 3). In steps of the lattice, in the order of its axes, `shape` (a, b, c).
    Returns the line of each crossing, a number below a * b, its place along the line in steps, and its triangle.
    """
    flat = vertices[:, :2] + ASIDE
    crossings = [
        _cross_some(vertices, flat, triangles[where], shape, where.start) for where in chunks(len(triangles), _PIECE)
    ]
    lines, places, rows = (np.concatenate(parts) for parts in zip(*crossings, strict=True))
    return lines, places, rows


def _cross_some(
    vertices: Float64Array, flat: Float64Array, triangles: NDArray[np.uint32], shape: Sequence[int], first: int
) -> tuple[IntArray, Float64Array, IntArray]:
    corners = flat[triangles]
    low = np.maximum(np.ceil(corners.min(axis=1)), 0.0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1)), np.array(shape[:2]) - 1.0).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = size[:, 0] * size[:, 1]
    rows = np.repeat(np.arange(len(triangles)), count)
    inner = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    a, b = low[rows, 0] + inner // size[rows, 1], low[rows, 1] + inner % size[rows, 1]
    names = triangles[rows]
    sides, shares = [], []
    for from_corner, to_corner in pairwise((*names.T, names[:, 0])):
        # from the lower to the higher number: both triangles of an edge find the same side of it
        turned = from_corner > to_corner
        start, end = flat[np.where(turned, to_corner, from_corner)], flat[np.where(turned, from_corner, to_corner)]
        area = (end[:, 0] - start[:, 0]) * (b - start[:, 1]) - (end[:, 1] - start[:, 1]) * (a - start[:, 0])
        sides.append((area >= 0.0) ^ turned)
        shares.append(np.where(turned, -area, area))
    hit = np.flatnonzero((sides[0] == sides[1]) & (sides[1] == sides[2]))
    of_edges = np.stack(shares)[:, hit]
    along = vertices[names[hit], 2]  # the corner across edge (0, 1) is 2, and so on
    total = of_edges.sum(axis=0)
    places = np.einsum("en,ne->n", of_edges[[1, 2, 0]], along) / np.where(total == 0.0, 1.0, total)
    return a[hit] * shape[1] + b[hit], places, rows[hit] + first


def fill_lines(lines: IntArray, places: Float64Array, shape: Sequence[int]) -> NDArray[np.bool_]:
    """Mark the points of a lattice that lie inside, shape `shape`, from the crossings of its lines."""
    count, length = shape[0] * shape[1], shape[2]
    after = np.clip(np.ceil(places), 0, length).astype(np.int64)
    turns = np.bincount(lines * (length + 1) + after, minlength=count * (length + 1)).reshape(*shape[:2], length + 1)
    return np.asarray(np.cumsum(turns, axis=2)[:, :, :length] % 2 == 1)


def fill_surface(vertices: Float64Array, triangles: NDArray[np.uint32], shape: Sequence[int]) -> NDArray[np.bool_]:
    """Mark the points of a lattice that lie inside of a closed surface, see `cross_lines`."""
    lines, places, _ = cross_lines(vertices, triangles, shape)
    return fill_lines(lines, places, shape)
