"""Twin of `clrecon.operators.surface.extract`: marching cubes in plain numpy, in float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume, is_left_handed, iso_rule
from clrecon.geometry.vertices import golden_fraction, search_fraction
from clrecon.proof.surface.case_table import CORNERS, EDGES, case_table
from clrecon.proof.surface.trilinear_table import CELL_VERTEX, find_row, place_cell_vertices

Surface = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint32]]
"""Vertices (n, 3) and normals (n, 3), LPS mm, and triangles (m, 3)."""

_LARGEST_CASE = 8
"""More than the triangles of any case."""


def sample_grid(volume: Volume, rule: iso_rule.IsoRule, layers: int) -> NDArray[np.float64]:
    """Return the samples as float64, extended by `layers` of outside (closed) or of the border's own values (open)."""
    values = volume.voxels.astype(np.float64)
    if rule.closed:
        return np.pad(values, layers, constant_values=rule.outside)
    return np.pad(values, layers, mode="edge")


def gradients(field: NDArray[np.float64], closed: bool) -> NDArray[np.float64]:
    """Return the gradient per index step at every sample, one-sided at an open border, of a padded field."""
    parts = []
    for axis in (2, 1, 0):
        change = np.diff(field, axis=axis)
        first = np.take(change, range(change.shape[axis] - 1), axis=axis)
        second = np.take(change, range(1, change.shape[axis]), axis=axis)
        weight = np.full(first.shape[axis], 0.5)
        if not closed:
            weight[[0, -1]] = 1.0
        shape = [1, 1, 1]
        shape[axis] = -1
        inner = [slice(1, -1)] * 3
        inner[axis] = slice(None)
        parts.append(((first + second) * weight.reshape(shape))[tuple(inner)])
    return np.stack(parts, axis=-1)


def _find_cases(inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    gk, gj, gi = inside.shape
    cases = np.zeros((gk - 1, gj - 1, gi - 1), dtype=np.int64)
    for corner, (x, y, z) in enumerate(CORNERS):
        cases |= inside[z : gk - 1 + z, y : gj - 1 + y, x : gi - 1 + x].astype(np.int64) << corner
    return cases


def _edge_vertices(numbers: NDArray[np.int64], cells: NDArray[np.int64], edge: int) -> NDArray[np.int64]:
    """Return the vertices on an edge of cells; `numbers[k, j, i, axis]` is that on the edge that a sample owns."""
    axis, low, _ = EDGES[edge]
    k, j, i = (cells + CORNERS[low][::-1]).T
    return np.asarray(numbers[k, j, i, axis])


def _find_triangles(
    inside: NDArray[np.bool_], numbers: NDArray[np.int64], wanted: NDArray[np.bool_] | None = None
) -> NDArray[np.uint32]:
    """Return the triangles of all cells by the case table, or those wanted, in the order of the cells."""
    cases = _find_cases(inside)
    cells = np.argwhere((cases != 0) & (cases != 255) & (True if wanted is None else wanted))
    case_of = cases[tuple(cells.T)]
    triangle_rows, order = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for case in np.unique(case_of):
        of_case = np.flatnonzero(case_of == case)
        for number, triangle in enumerate(case_table()[case]):
            triangle_rows.append(np.stack([_edge_vertices(numbers, cells[of_case], edge) for edge in triangle], axis=1))
            order.append(_LARGEST_CASE * of_case + number)
    return np.concatenate(triangle_rows)[np.argsort(np.concatenate(order))].astype(np.uint32)


CellVertices = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]


def _find_trilinear_triangles(
    inside: NDArray[np.bool_], numbers: NDArray[np.int64], heights: NDArray[np.float32], margins: NDArray[np.float64]
) -> tuple[NDArray[np.uint32], CellVertices]:
    """Return the triangles of the trilinear field, and the vertices inside cells, numbered after those on edges, cell
    by cell: cell (k, j, i), point, gradient.  `margins` (gk, 3) are those of each layer.
    """
    cases = _find_cases(inside)
    triangles: list[list[int]] = []
    cells: list[NDArray[np.int64]] = []
    points, gradients = [np.empty((0, 3))], [np.empty((0, 3))]
    first = int(numbers.max()) + 1
    for cell in np.argwhere((cases != 0) & (cases != 255)):
        case, (k, j, i) = int(cases[tuple(cell)]), cell
        corners = [float(heights[k + z, j + y, i + x]) for x, y, z in CORNERS]
        row = find_row(case, corners)
        for triangle in row.triangles:
            triangles.append(
                [
                    first + len(cells) + v - CELL_VERTEX if v >= CELL_VERTEX else int(_edge_vertices(numbers, cell, v))
                    for v in triangle
                ]
            )
        if row.cell_vertices:
            cells += [cell] * row.cell_vertices
            placed = place_cell_vertices(row, case, corners, margins[k])
            points.append(placed[0])
            gradients.append(placed[1])
    inner_points = (np.array(cells, dtype=np.int64).reshape(-1, 3), np.concatenate(points), np.concatenate(gradients))
    return np.array(triangles, dtype=np.uint32).reshape(-1, 3), inner_points


def extract_isosurface(
    volume: Volume,
    iso_value: iso_rule.Level,
    *,
    closed: bool = True,
    topology: str = "separated",
    below: bool = False,
    vertex_rule: str = "linear",
    grown: Callable[[NDArray[np.bool_]], NDArray[np.bool_]] | None = None,
) -> Surface:
    """Extract the iso surface of a small volume: vertices, LPS mm, unit normals towards what is outside, and triangles,
    counter-clockwise as seen from outside.

    closed: Surround the volume with outside.
    topology: {"separated", "trilinear"}. Keep inside corners apart that only meet across a face or cell, or join them
        where the trilinear field does.
    vertex_rule: {"linear", "golden", "golden-search"}
    grown: Function from the samples that are inside, (gk, gj, gi), to the cells whose triangles are wanted; None: all.
    """
    rule = iso_rule.choose_iso_rule(
        volume, iso_value, closed=closed, topology=topology, below=below, vertex_rule=vertex_rule
    )
    inside = rule.mark_inside(sample_grid(volume, rule, rule.border))
    if rule.closed:
        inside[[0, -1]] = inside[:, [0, -1]] = inside[:, :, [0, -1]] = False
    cells = None if grown is None else grown(inside)
    if not below:
        return extract_inside(volume, rule, inside, cells=cells)
    # The surface around the other samples, turned round: exactly that of the iso value, in ambiguous cells too.
    positions, normals, triangles = extract_inside(volume, rule, ~inside, cells=cells)
    return positions, -normals, triangles[:, ::-1].copy()


def extract_inside(
    volume: Volume,
    rule: iso_rule.IsoRule,
    inside: NDArray[np.bool_],
    hu_places: NDArray[np.bool_] | None = None,
    cells: NDArray[np.bool_] | None = None,
) -> Surface:
    """Extract the surface between the samples that are inside, on the grid of the volume and its border, and the
    others.

    hu_places: ndarray, shape (gk, gj, gi), bool. Where both samples of an edge are marked, HU place the vertex at the
        iso level.  Elsewhere it lies half way, and its normal follows `inside`. None: HU place every vertex.
    cells: ndarray, shape (gk - 1, gj - 1, gi - 1), bool. Cells whose triangles are wanted.

    Normals point down, and up where the surface ends a range at its upper end.
    """
    field = sample_grid(volume, rule, rule.border)
    slopes = gradients(sample_grid(volume, rule, rule.border + 1), rule.closed)
    edges = find_crossed_edges(inside)
    value, next_value = field[edges.near], field[edges.far]
    margin = edge_margins(volume, rule, edges)
    half_way = np.zeros(len(edges.axis), dtype=bool)
    if hu_places is not None:
        half_way = ~(hu_places[edges.near] & hu_places[edges.far])
    change = np.where(half_way, 1.0, next_value - value)
    above = np.zeros(len(edges.axis), dtype=bool)
    if rule.highest_inside is not None:  # the outer end lies above the range
        above = np.maximum(value, next_value) > rule.highest_inside
    level = np.where(above, rule.upper_level or 0.0, rule.iso_level)
    t = np.where(half_way, 0.5, np.clip((level - value) / change, margin, 1.0 - margin))
    if rule.vertex_rule == "golden":
        t = golden_fraction(value)
    elif rule.vertex_rule == "golden-search":
        along = np.arange(len(edges.axis)), edges.axis
        before, after = next_value - 2.0 * slopes[edges.near][along], value + 2.0 * slopes[edges.far][along]
        t = np.clip(search_fraction(before, value, next_value, after, level), margin, 1.0 - margin)
    slope, next_slope = (1.0 - t[:, None]) * slopes[edges.near], t[:, None] * slopes[edges.far]
    if half_way.any():
        around = np.pad(inside.astype(np.float64), 1, mode="constant" if rule.closed else "edge")
        slopes = gradients(around, rule.closed)
        slope[half_way], next_slope[half_way] = slopes[edges.near][half_way], slopes[edges.far][half_way]
    slope[above], next_slope[above] = -slope[above], -next_slope[above]  # gradients point inwards from here on
    return build_surface(volume, rule, inside, edges, EdgePlaces(t, slope, next_slope), cells)


@dataclass(frozen=True)
class CrossedEdges:
    """Edges of the sample grid between a sample inside and one outside, in the order of their vertices.

    numbers: ndarray, shape (gk, gj, gi, 3), int64. The vertex on the edge that a sample owns along each axis, where it
        is crossed.
    near, far: tuple of three ndarray, shape (n,), int64. (k, j, i) of the owner and of the other end.
    """

    numbers: NDArray[np.int64]
    near: tuple[NDArray[np.int64], ...]
    far: tuple[NDArray[np.int64], ...]
    axis: NDArray[np.int64]


class EdgePlaces(NamedTuple):
    """Where vertices lie on their edges.

    t: ndarray, shape (n,). Part of the edge, from the near end.
    slope, next_slope: ndarray, shape (n, 3). Parts of the two ends in the gradient at the vertex, per step along i, j,
        k; where their sum vanishes, the direction of the edge is used.
    """

    t: NDArray[np.float64]
    slope: NDArray[np.float64]
    next_slope: NDArray[np.float64]


def find_crossed_edges(inside: NDArray[np.bool_]) -> CrossedEdges:
    """Find the crossed edges of a sample grid, shape (gk, gj, gi)."""
    crossed = np.zeros((*inside.shape, 3), dtype=bool)
    crossed[:, :, :-1, 0] = inside[:, :, :-1] != inside[:, :, 1:]
    crossed[:, :-1, :, 1] = inside[:, :-1, :] != inside[:, 1:, :]
    crossed[:-1, :, :, 2] = inside[:-1, :, :] != inside[1:, :, :]
    numbers = (np.cumsum(crossed) - 1).reshape(crossed.shape)
    k, j, i, axis = np.argwhere(crossed).T
    return CrossedEdges(numbers, (k, j, i), (k + (axis == 2), j + (axis == 1), i + (axis == 0)), axis)


def edge_margins(volume: Volume, rule: iso_rule.IsoRule, edges: CrossedEdges) -> NDArray[np.float64]:
    """Return the smallest distance of each vertex from a sample, in steps, shape (n,)."""
    margins, layers = iso_rule.vertex_margin(volume, rule.border), iso_rule.layer_margins(volume, rule.border)
    return np.asarray(np.where(edges.axis == 2, layers[edges.near[0]], margins[edges.axis]))


def build_surface(
    volume: Volume,
    rule: iso_rule.IsoRule,
    inside: NDArray[np.bool_],
    edges: CrossedEdges,
    places: EdgePlaces,
    cells_wanted: NDArray[np.bool_] | None = None,
) -> Surface:
    """Place the vertices on their edges, and write the triangles.

    cells_wanted: ndarray, shape (gk - 1, gj - 1, gi - 1), bool. Cells whose triangles are wanted, of the topology
        "separated"; vertices of no triangle are left out then.
    """
    (k, j, i), (k1, j1, i1) = edges.near, edges.far
    axis, numbers = edges.axis, edges.numbers
    t = places.t
    slope, next_slope = places.slope.copy(), places.next_slope.copy()
    field = sample_grid(volume, rule, rule.border)
    margins, layers = iso_rule.vertex_margin(volume, rule.border), iso_rule.layer_margins(volume, rule.border)
    step = np.eye(3, dtype=np.int64)[axis]
    origins = volume.slice_origins(rule.border)
    here = np.stack([i, j], axis=1) - rule.border
    along = t[:, None]
    positions = origins[k] + (here + along * step[:, :2]) @ volume.affine[:3, :2].T + along * (origins[k1] - origins[k])
    flat = ~(slope + next_slope).any(axis=1)
    rise = np.where(inside[k1, j1, i1], 1.0, -1.0)
    slope[flat], next_slope[flat] = (rise[:, None] * step)[flat], 0.0
    at_samples = iso_rule.slice_normal_matrices(volume, rule.border)
    up = np.einsum("nij,nj->ni", at_samples[k], slope) + np.einsum("nij,nj->ni", at_samples[k1], next_slope)
    if rule.topology == "separated":
        triangles = _find_triangles(inside, numbers, cells_wanted)
    else:
        heights = field.astype(np.float32) - np.float32(rule.iso_level)
        in_cells = np.column_stack([np.broadcast_to(margins[:2], (len(layers), 2)), layers])
        triangles, (cells, points, cell_slope) = _find_trilinear_triangles(inside, numbers, heights, in_cells)
        ck = cells[:, 0]
        cell_up = np.einsum("nij,nj->ni", iso_rule.layer_normal_matrices(volume, rule.border)[ck], cell_slope)
        in_slice = cells[:, :0:-1] - rule.border + points[:, :2]
        placed = origins[ck] + in_slice @ volume.affine[:3, :2].T + points[:, 2:] * (origins[ck + 1] - origins[ck])
        # Slice by slice: first the vertices on edges, then those inside cells.
        order = np.argsort(np.concatenate([k, ck]), kind="stable")
        triangles = np.argsort(order).astype(np.uint32)[triangles]
        positions, up = (np.concatenate(pair)[order] for pair in ((positions, placed), (up, cell_up)))
    normals = -up / np.linalg.norm(up, axis=1, keepdims=True)
    if cells_wanted is not None:
        used, left = np.unique(triangles, return_inverse=True)
        positions, normals = positions[used], normals[used]
        triangles = left.reshape(-1, 3).astype(np.uint32)
    if is_left_handed(volume.affine):
        triangles = triangles[:, ::-1].copy()
    return positions, normals, triangles
