"""Checks of smoothing, and of decimation: collapses, triangles near a surface, and those that cut each other."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.distances import SurfaceDistance, triangle_distances
from clrecon.mesh.connectivity import find_edges
from clrecon.mesh.refine.collapse import FAR, REFUSED, History, Surface, collapse_in_rounds
from clrecon.mesh.refine.smoothing import Filter, Rings, sinc_terms
from clrecon.opencl import Device, kernel_number
from clrecon.operators.surface.collapse import LONG, RISE, DeviceCollapser
from clrecon.operators.surface.decimation import CrossingMarks, plan_crossings
from clrecon.operators.surface.smoothing import DeviceFilter
from clrecon.proof.checking import Check, require_close, require_equal
from clrecon.proof.surface import crossings as twin
from clrecon.proof.surface.collapses import PULL, FirstRound, measure_planes


def _scatter(count: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return triangles of three sizes at random, in pairs at one place, of which every other one shares a vertex."""
    random = np.random.default_rng(seed)
    size = random.choice([0.4, 1.0, 5.0], (count, 1, 1), p=[0.6, 0.35, 0.05])
    places = np.repeat(random.uniform(-20.0, 20.0, (count // 2, 1, 3)), 2, axis=0)
    corners = places + size * random.normal(size=(count, 3, 3))
    triangles = np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)
    triangles[::4, 2] = triangles[1::4, 0]
    return corners.reshape(-1, 3).astype(np.float32), triangles


def _check_crossings(device: Device) -> str:
    """Compare the marks of triangles that cut each other; none of these is so flat that float32 cannot tell."""
    vertices, triangles = _scatter(1600, 3)
    marks = CrossingMarks(device, plan_crossings(vertices, triangles), spare=10_000)
    unsure, cut = marks.look()
    is_cut = twin.mark_crossings(vertices, triangles)
    require_equal(cut, np.flatnonzero(is_cut), "triangles that cut each other")
    require_equal(unsure, unsure[:0], "triangles of which float32 cannot tell")
    changed = np.flatnonzero(np.arange(len(triangles)) % 4 < 2)
    vertices[triangles[changed]] += np.float32(1.5)
    _, again = marks.look_again(vertices, changed)
    wanted = changed[twin.mark_crossings(vertices, triangles)[changed]]
    require_equal(np.intersect1d(again, changed), wanted, "changed triangles that cut another one")
    return f"{len(cut):,} of {len(is_cut):,} triangles that cut another one, {len(wanted):,} of those that changed"


CROSSING_CHECKS = (
    Check("triangles that cut each other", ("enter_triangles", "mark_crossings", "clear_words"), _check_crossings),
)


_SIZE, _LARGE = 40, 150
"""Vertices along each side of the sheet, and of one of which more than 500 edges collapse in a round."""

ROUNDING_MM = 3e-4
"""Slack of bounds at coordinates up to 40 mm, and the rounding of float32."""

_LIMIT_MM, _TIGHT_MM = 0.16, 0.06
"""Limits of distances; of the tight one a third of the first collapses is refused."""

_LENGTH_WEIGHT = kernel_number("surface/collapse.h", "LENGTH_WEIGHT")
"""Of the length of an edge, beside its cost."""

_JUDGED = 200
"""Edges of a round that are judged one by one, 2 ms each."""

_MISSED = 0.05
"""Refused because a walk on this rough sheet misses the near face, for each that collapses; measured: 0.03."""

_PLACE_MM = 1e-4
"""Largest difference of a place, at coordinates up to 150 mm; measured: 9e-6."""

_EXPONENT_BIAS = 127
"""What float32 adds to exponents of 2."""


def _rough_sheet(rng: np.random.Generator, size: int = _SIZE) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(size), np.arange(size)))
    corner = (x + size * y)[(x < size - 1) & (y < size - 1)]
    lower = np.column_stack([corner, corner + 1, corner + size + 1])
    upper = np.column_stack([corner, corner + size + 1, corner + size])
    flat = np.column_stack([x, y, np.zeros(size * size)]).astype(np.float64)
    vertices: NDArray[np.float64] = flat + rng.normal(0.0, 0.25, (size * size, 3))
    return vertices, np.concatenate([lower, upper]).astype(np.uint32)


def _measure_octaves(
    vertices: NDArray[np.float64], triangles: NDArray[np.uint32], ends: NDArray[np.uint32]
) -> NDArray[np.float64]:
    """Return the base-2 logarithm of the cost of each edge: the least quadric error, and a share of its length."""
    of_vertices = measure_planes(vertices, triangles)
    start, end = of_vertices[ends]
    half = 0.5 * (vertices[ends[1]] - vertices[ends[0]])
    both = start + end
    weight = np.trace(both, axis1=1, axis2=2)
    pulled = both + PULL * weight[:, None, None] * np.eye(3)
    best = np.linalg.solve(pulled, np.einsum("kab,kb->ka", end - start, half)[:, :, None])[:, :, 0]
    cost = np.einsum("ka,kab,kb->k", best + half, start, best + half)
    cost += np.einsum("ka,kab,kb->k", best - half, end, best - half)
    return np.log2(cost + _LENGTH_WEIGHT * weight * np.einsum("ka,ka->k", half, half))


def _select_edges(
    octaves: NDArray[np.uint8], ends: NDArray[np.uint32], numbers: NDArray[np.intp], highest: int, count: int
) -> NDArray[np.bool_]:
    """Mark the edges that come first at their ends and at all neighbours of these."""
    mixed = numbers.astype(np.uint32) * np.uint32(0x9E3779B1)
    mixed ^= mixed >> np.uint32(15)
    mixed *= np.uint32(0x85EBCA77)
    mixed ^= mixed >> np.uint32(13)
    rank = octaves.astype(np.uint64) << np.uint64(32) | mixed
    rank[octaves == REFUSED] = np.iinfo(np.uint64).max
    first = np.full(count, np.iinfo(np.uint64).max)
    for end in ends:
        np.minimum.at(first, end, rank)
    least = first.copy()
    for end, neighbour in (ends, ends[::-1]):
        np.minimum.at(least, end, first[neighbour])
    selected: NDArray[np.bool_] = (octaves <= highest) & (rank == least[ends[0]]) & (rank == least[ends[1]])
    return selected


def _check_rings(history: History, ends: NDArray[np.uint32]) -> None:
    """Compare the rings of collapses of one round with the edges from both of their ends."""
    gone, count = np.flatnonzero(history.into >= 0), len(history.into)
    of_vertex = np.full(count, -1)
    of_vertex[gone] = of_vertex[history.into[gone]] = gone
    start, end = np.concatenate([ends, ends[::-1]], axis=1).astype(np.int64)
    is_beside = (of_vertex[start] >= 0) & (of_vertex[start] != of_vertex[end])
    expected = np.unique(of_vertex[start[is_beside]] * count + end[is_beside])
    size = history.size[gone]
    entries = np.repeat(history.begin[gone] - (np.cumsum(size) - size), size) + np.arange(size.sum())
    rings = np.repeat(gone, size) * count + history.neighbours[entries]
    require_equal(np.sort(rings), expected, "rings of collapses")


def _check_verdicts(places: NDArray[np.float32], given: Surface, history: History, ends: NDArray[np.uint32]) -> float:
    """Compare which selected edges collapse, and to which places, with the twin; return the largest difference, mm."""
    vertices, triangles = places.astype(np.float64), given.triangles
    distance = SurfaceDistance(vertices, triangles)
    longest, rise = math.sqrt(LONG) * given.mean_edge, RISE * given.mean_edge
    first_round = FirstRound(vertices, triangles, _TIGHT_MM, longest, rise, distance)
    pairs = ends.T[:: max(1, ends.shape[1] // _JUDGED)].tolist()
    apart = [0.0]
    missed = passed = 0
    for pair, verdict in zip(pairs, first_round.judge(pairs), strict=True):
        into = [int(history.into[end]) for end in pair if history.into[end] >= 0]
        missed += verdict.should_pass and not into
        passed += bool(into)
        if into:
            require_equal(verdict.may_pass, True, "tests passed by edges that collapse")
            apart.append(float(np.linalg.norm(verdict.position - history.places[into[0]])))
    require_equal(missed <= _MISSED * passed, True, "edges that collapse, of those that pass all tests")
    return require_close(np.array(apart), np.zeros(len(apart)), _PLACE_MM, "places of collapses, in mm")


def _check_first_round(device: Device) -> str:
    """Compare costs of edges and which are selected with numpy; each of these collapses or is refused."""
    vertices, triangles = _rough_sheet(np.random.default_rng(11), _LARGE)
    places = vertices.astype(np.float32)
    given = Surface.of(places, triangles, find_edges(triangles, len(places)))
    collapser = DeviceCollapser(device, given, _TIGHT_MM**2)
    start, end = triangles.reshape(-1), triangles[:, (1, 2, 0)].reshape(-1)
    numbers = np.flatnonzero(np.arange(len(start)) < given.opposite.astype(np.int64))
    octaves, ends = collapser.octaves()[numbers], np.stack([start[numbers], end[numbers]])
    ranked = octaves != REFUSED
    expected = _measure_octaves(places.astype(np.float64), triangles, ends) + _EXPONENT_BIAS
    require_close(octaves[ranked] + 0.5, expected[ranked], 0.51, "octaves of costs")
    highest = int(np.percentile(octaves[ranked], 50))
    selected = _select_edges(octaves, ends, numbers, highest, len(places))
    collapser.look_at_standing()
    require_equal(collapser.run_round(0, highest, len(places))[0], int(selected.sum()), "edges that are selected")
    is_refused = collapser.octaves()[numbers] == REFUSED
    history = collapser.finish()[0]
    gone = history.into[ends] >= 0
    require_equal((gone.any(axis=0) | is_refused)[selected].all(), True, "selected edges collapse or are refused")
    _check_rings(history, ends)
    farthest = _check_verdicts(places, given, history, ends[:, selected])
    beside = np.zeros(len(places), bool)
    beside[ends[:, selected]] = True
    require_equal(beside[ends][gone].all(), True, "no other edges collapse")
    count = int((gone.any(axis=0) & selected).sum())
    return f"{int(selected.sum()):,} edges, of which {count:,} collapse, to places within {farthest:.1g} mm"


def _check_collapses(device: Device) -> str:
    """Collapse edges, and check what stands: names, faces, volume beneath, points within the limit, pairs of faces."""
    vertices, triangles = _rough_sheet(np.random.default_rng(12))
    places = vertices.astype(np.float32)
    given = Surface.of(places, triangles, find_edges(triangles, len(places)))
    collapser = DeviceCollapser(device, given, _LIMIT_MM**2)
    collapse_in_rounds(collapser, len(triangles), 0.0, lambda left: None)
    history, pairing = collapser.finish()
    corners = history.names()[triangles].astype(np.uint32)
    rows = np.flatnonzero((corners != corners[:, (1, 2, 0)]).all(axis=1))
    require_equal(len(rows), len(triangles) - 2 * history.count, "faces that are left")
    require_equal(history.count > len(places) // 4, True, "enough edges have collapsed")
    edges = find_edges(corners[rows], len(places))
    before = find_edges(triangles, len(places))
    require_equal(
        (edges.boundary, edges.nonmanifold, edges.oriented), (before.boundary, 0, True), "edges that are left"
    )
    beneath = [
        float(np.einsum("ij,ij->", at[faces[:, 0]], np.cross(at[faces[:, 1]], at[faces[:, 2]]))) / 6.0
        for at, faces in ((vertices, triangles), (history.places.astype(np.float64), corners[rows]))
    ]
    require_close(beneath[1], beneath[0], 1e-3, "volume beneath the sheet, in mm3")
    is_face = np.zeros(len(triangles), bool)
    is_face[rows] = True
    require_equal(is_face[pairing.faces_at], np.ones(len(triangles), bool), "faces at the middles of given ones")
    middles = vertices[triangles].mean(axis=1)
    apart = triangle_distances(
        middles.T, *history.places[corners[pairing.faces_at]].transpose(1, 2, 0).astype(np.float64)
    )
    require_equal(apart <= _LIMIT_MM + ROUNDING_MM, np.ones(len(triangles), bool), "middles within the limit")
    below = pairing.below[rows]
    require_equal((below >= 0).mean() > 0.5, True, "most of those that are left have a given face")
    require_equal(pairing.faces_at[below[below >= 0]], rows[below >= 0], "given faces at those that are left")
    standing = np.flatnonzero(history.into < 0)
    away = np.linalg.norm(history.places[standing] - places[pairing.homes[standing]], axis=1)
    require_equal(away.max() < 2.0, True, "given vertices beside those that are left")
    count = history.count
    history.undo(np.flatnonzero(history.into >= 0)[::9])
    corners = history.names()[triangles].astype(np.uint32)
    rows = np.flatnonzero((corners != corners[:, (1, 2, 0)]).all(axis=1))
    edges = find_edges(corners[rows], len(places))
    require_equal(
        (edges.boundary, edges.nonmanifold, edges.oriented), (before.boundary, 0, True), "edges after some are undone"
    )
    history.undo(np.flatnonzero(history.into >= 0))
    require_equal(history.places, places, "places after all are undone")
    return f"{count:,} collapses"


def _check_near_faces(device: Device) -> str:
    """Compare what is near a surface at all points with distances of points on a lattice."""
    rng = np.random.default_rng(13)
    vertices, triangles = _rough_sheet(rng)
    moved = (vertices + rng.normal(0.0, 0.05, vertices.shape)).astype(np.float32)
    given = Surface.of(vertices.astype(np.float32), triangles, find_edges(triangles, len(vertices)))
    hints = np.column_stack([np.full(len(triangles), -1), triangles]).astype(np.int32)
    corners = moved[triangles]
    collapser = DeviceCollapser(device, given, _LIMIT_MM**2)
    near = collapser.find_near_faces(corners, hints, False, _LIMIT_MM**2)
    rows, places = np.arange(len(triangles)), given.places.copy()
    collapser.show_present(places, triangles, rows, rows)
    places[triangles[len(triangles) // 3 : len(triangles) // 2]] += np.float32(0.4)
    has_changed = (places != given.places).any(axis=1)[triangles].any(axis=1)
    collapser.show_present(places, triangles, rows, np.flatnonzero(has_changed))
    changed = DeviceCollapser(device, Surface.of(places, triangles, find_edges(triangles, len(places))), _LIMIT_MM**2)
    require_equal(
        collapser.find_near_faces(corners, hints, True, _LIMIT_MM**2),
        changed.find_near_faces(corners, hints, False, _LIMIT_MM**2),
        "faces of a surface that has changed in part",
    )
    first, second = (share.ravel() / 3.0 for share in np.mgrid[:4, :4])
    weights = np.column_stack([first, second, 1.0 - first - second])[first + second < 1.0 + 1e-9]
    points = np.einsum("wc,kca->kwa", weights, corners[::4].astype(np.float64))
    distance = SurfaceDistance(vertices, triangles)(points.reshape(-1, 3)).reshape(len(points), -1).max(axis=1)
    is_far = near[:, 0] == FAR
    require_equal(is_far[::4][distance > _LIMIT_MM + ROUNDING_MM].all(), True, "triangles beyond the limit")
    require_equal(is_far[::4][distance < 0.8 * _LIMIT_MM].any(), False, "triangles within the limit")
    alone = (near[:, 0] >= 0) & (near[:, 1] < 0)
    require_equal(alone.sum() > 500, True, "triangles near one face")
    shown = triangle_distances(
        corners[alone].reshape(-1, 3).T.astype(np.float64),
        *vertices[triangles[np.repeat(near[alone, 0], 3)]].transpose(1, 2, 0),
    )
    require_equal(shown <= _LIMIT_MM + ROUNDING_MM, np.ones(len(shown), bool), "faces near all corners")
    return f"{len(triangles):,} triangles, {int(is_far.sum()):,} beyond the limit"


DISTANCE_CHECKS: tuple[Check, ...] = (
    Check(
        "collapses of edges",
        (
            "sum_quadrics", "rank_edges", "hang_points", "find_first_edges", "select_edges", "collapse_edges",
            "pair_faces",
        ),
        _check_collapses,
    ),
    Check(
        "the first round of collapses",
        ("sum_quadrics", "rank_edges", "find_first_edges", "select_edges", "collapse_edges"),
        _check_first_round,
    ),
    Check("triangles near a surface", ("frame_faces", "gather_stars", "find_near_faces"), _check_near_faces),
)  # fmt: skip


def _check_smoothing(device: Device) -> str:
    """Compare bends, normals and the steps of the filter with those of the host, bit for bit."""
    vertices, triangles = _rough_sheet(np.random.default_rng(14))
    places, rings = vertices.astype(np.float32), Rings.of(triangles, len(vertices))
    tested, twin_filter = DeviceFilter(device, rings), Filter(rings)
    bends, normals = tested.measure_bends(places)
    for actual, expected, subject in zip(
        (bends, normals), twin_filter.measure_bends(places), ("bends", "normals"), strict=True
    ):
        require_equal(actual, expected, subject)
    for iterations in (1, 20):
        terms = sinc_terms(iterations)
        require_equal(tested.find_steps(bends, terms), twin_filter.find_steps(bends, terms), "steps of the filter")
    return f"{len(places):,} vertices"


SMOOTHING_CHECKS = (Check("smoothing of a surface", ("measure_bends", "filter_bends"), _check_smoothing),)
