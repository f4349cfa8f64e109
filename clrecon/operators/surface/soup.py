"""Marching cubes as papers compare with it: every cell is visited, each writes triangles of its own, welded afterwards.

A row for comparisons, in numpy, layer by layer.  Nothing is shared between cells: the vertex on an edge is computed up
to four times.  Each is computed from the same end of its edge, so that welding finds equal numbers.

Reference: Lorensen and Cline 1987; T-MC of Liu et al. 2019, J. Harbin Inst. Technol. (New Series) 26(6).
"""

from __future__ import annotations

import re
from functools import cache

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume, is_left_handed
from clrecon.geometry.iso_rule import IsoRule
from clrecon.geometry.vertex_rules import linear_fraction
from clrecon.opencl.sources import read_kernel_source

CORNERS = np.array([(c & 1, c >> 1 & 1, c >> 2) for c in range(8)])
"""(x, y, z) of each corner of a cell."""

MOST_TRIANGLES = 5


@cache
def case_triangles() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the number of triangles of each case, (256,), and their edges, (256, 5, 3), from the kernels' table."""
    words = re.findall(r"0x([0-9a-f]{16})UL", read_kernel_source("surface/mc_tables.h"))
    packed = np.array([int(word, 16) for word in words], np.uint64)
    shifts = np.arange(4, 4 + 12 * MOST_TRIANGLES, 4, dtype=np.uint64)
    edges = (packed[:, None] >> shifts & np.uint64(15)).astype(np.int64)
    return (packed & np.uint64(15)).astype(np.int64), edges.reshape(-1, MOST_TRIANGLES, 3)


def edge_corner(edge: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the lower corner (..., 3) of edges 0 to 11 in their cell, and their axes."""
    axis, side = edge // 4, edge % 4
    corner = np.zeros((*edge.shape, 3), np.int64)
    others = np.array([(1, 2), (0, 2), (0, 1)])[axis]
    np.put_along_axis(corner, others[..., :1], (side & 1)[..., None], -1)
    np.put_along_axis(corner, others[..., 1:], (side >> 1)[..., None], -1)
    return corner, axis


def _pad_layers(volume: Volume, rule: IsoRule, first: int, end: int) -> NDArray[np.float64]:
    """Return slices of the sample grid, with the border's values where it is closed."""
    border, nk = rule.border, volume.shape_ijk[2]
    layers = []
    for k in range(first - border, end - border):
        if 0 <= k < nk:
            layers.append(np.pad(volume.voxels[k].astype(np.float64), border, constant_values=rule.outside))
        else:
            ni, nj, _ = volume.shape_ijk
            layers.append(np.full((nj + 2 * border, ni + 2 * border), rule.outside))
    return np.stack(layers)


def extract_soup(volume: Volume, rule: IsoRule) -> NDArray[np.float64]:
    """Return the corners of all triangles in LPS mm, (m, 3, 3), counter-clockwise as seen from lower values."""
    counts, table = case_triangles()
    gk = volume.shape_ijk[2] + 2 * rule.border
    soup = [np.empty((0, 3, 3))]
    for k in range(gk - 1):
        values = _pad_layers(volume, rule, k, k + 2)
        inside = values >= rule.lowest_inside
        cases = np.zeros((inside.shape[1] - 1, inside.shape[2] - 1), np.int64)
        for bit, (x, y, z) in enumerate(CORNERS):
            cases |= inside[z, y : y + cases.shape[0], x : x + cases.shape[1]].astype(np.int64) << bit
        j, i = np.nonzero(counts[cases])
        case = cases[j, i]
        cell = np.repeat(np.arange(len(case)), counts[case])
        number = np.arange(len(cell)) - np.repeat(np.cumsum(counts[case]) - counts[case], counts[case])
        corner, axis = edge_corner(table[case[cell], number])  # (m, 3, 3) and (m, 3)
        low = np.stack([i[cell], j[cell], np.zeros(len(cell), np.int64)], 1)[:, None, :] + corner
        high = low + np.eye(3, dtype=np.int64)[axis]
        value, next_value = (values[at[..., 2], at[..., 1], at[..., 0]] for at in (low, high))
        placed = low.astype(np.float64)
        t = linear_fraction(value, next_value, rule.iso_level)
        np.put_along_axis(placed, axis[..., None], np.take_along_axis(placed, axis[..., None], -1) + t[..., None], -1)
        placed += np.array([0, 0, k]) - rule.border
        soup.append(volume.ijk_to_lps(placed.reshape(-1, 3)).reshape(-1, 3, 3))
    triangles = np.concatenate(soup)
    return triangles[:, ::-1] if is_left_handed(volume.affine) else triangles


def weld(soup: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Join corners at the same place: vertices (n, 3) in the order of their first triangle, and triangles (m, 3)."""
    corners = np.ascontiguousarray(soup.reshape(-1, 3)) + 0.0  # + 0.0: no two zeros
    _, first, found = np.unique(corners.view("V24"), return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return corners[first[order]], rank[found.reshape(-1)].reshape(-1, 3).astype(np.uint32)
