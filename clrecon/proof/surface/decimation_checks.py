"""Checks of smoothing, and of what decimation asks: which triangles cut each other, and bounds of distances."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.compare.distances import NearDistance, triangle_distances
from clrecon.mesh.refine.deviation import MIDDLES, SurfaceBounds
from clrecon.mesh.refine.smoothing import Filter, Rings, sinc_terms
from clrecon.opencl import Device
from clrecon.operators.surface.decimation import DeviceBounds, mark_crossings, plan_crossings
from clrecon.operators.surface.smoothing import DeviceFilter
from clrecon.proof.checking import Check, require_close, require_equal
from clrecon.proof.surface import crossings as twin


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
    is_cut = mark_crossings(device, plan_crossings(vertices, triangles))
    require_equal(is_cut, twin.mark_crossings(vertices, triangles), "triangles that cut each other")
    return f"{int(is_cut.sum()):,} of {len(is_cut):,} triangles that cut another one"


CROSSING_CHECKS = (
    Check("triangles that cut each other", ("enter_triangles", "mark_crossings", "clear_words"), _check_crossings),
)


SIZE = 40
"""Vertices along each side of the sheet: 3042 triangles."""

ROUNDING_MM = 3e-4
"""Slack of bounds at coordinates up to 40 mm, and the rounding of float32."""

_LIMIT_MM = 0.16


def _rough_sheet(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(SIZE), np.arange(SIZE)))
    corner = (x + SIZE * y)[(x < SIZE - 1) & (y < SIZE - 1)]
    lower = np.column_stack([corner, corner + 1, corner + SIZE + 1])
    upper = np.column_stack([corner, corner + SIZE + 1, corner + SIZE])
    flat = np.column_stack([x, y, np.zeros(SIZE * SIZE)]).astype(np.float64)
    vertices: NDArray[np.float64] = flat + rng.normal(0.0, 0.25, (SIZE * SIZE, 3))
    return vertices, np.concatenate([lower, upper]).astype(np.uint32)


def _check_distances(device: Device) -> str:
    """Compare distances around hints, and after walks, with those of the triangles."""
    rng = np.random.default_rng(12)
    vertices, triangles = _rough_sheet(rng)
    count = 2000
    points = rng.uniform(0.0, SIZE - 1.0, (count, 3)) * [1.0, 1.0, 0.1]
    near = rng.integers(0, len(vertices), (count, 3))
    bounds = DeviceBounds(device, vertices, triangles)
    expected, _ = NearDistance(vertices, triangles).find_around(points, near)
    worst = 0.0
    for walks in (0, 40):
        length, rows = bounds.find_bounds(points, near, 0.0, walks)
        require_equal((rows >= 0) & (rows < len(triangles)), np.ones(count, dtype=bool), "rows of nearest triangles")
        exact = triangle_distances(points.T, *vertices[triangles[rows]].transpose(1, 2, 0))
        worst = max(worst, require_close(length, exact, ROUNDING_MM, "distances to the nearest triangles, in mm"))
        if walks == 0:
            require_close(length, expected, ROUNDING_MM, "distances to triangles around vertices, in mm")
        else:
            require_equal(length <= expected + ROUNDING_MM, np.ones(count, dtype=bool), "distances after walks")
            moved = int(np.count_nonzero(length < 0.5 * expected))
            require_equal(moved > count // 2, True, "points that are nearer after walks")
    return f"{count:,} points within {worst:.1e} mm"


def _check_witnesses(device: Device) -> str:
    """Compare what is left of triangles near a surface with distances to it."""
    rng = np.random.default_rng(13)
    vertices, triangles = _rough_sheet(rng)
    places = (vertices + rng.normal(0.0, 0.15, vertices.shape)).astype(np.float32)
    names = np.arange(len(vertices))
    exact = NearDistance(vertices, triangles)
    length, rows = exact.find_around(places.astype(np.float64), names[:, None])
    beside = np.where(length <= _LIMIT_MM, rows, -1).astype(np.int32)
    arguments = (places, triangles, names, beside, _LIMIT_MM)
    witnesses, left = DeviceBounds(device, vertices, triangles).find_witnesses(*arguments)
    _, of_twin = SurfaceBounds(vertices, triangles).find_witnesses(*arguments)
    require_equal(witnesses[:3], beside[triangles].T, "witnesses of corners")
    require_equal(left & ~of_twin, np.zeros(len(left), np.uint8), "middles that are left")
    known = (beside[triangles] >= 0).all(axis=1)
    for middle, weights in enumerate(MIDDLES):
        points = np.einsum("i,kia->ka", weights, places[triangles].astype(np.float64))
        around, _ = exact.find_around(points, triangles.astype(np.int64))
        is_left = (left >> middle & 1).astype(bool)
        require_equal(around[is_left] > _LIMIT_MM - ROUNDING_MM, np.ones(int(is_left.sum()), bool), "middles left")
        of = np.flatnonzero(known & ~is_left & (witnesses[3 + middle] != witnesses[0]))
        shown = triangle_distances(points[of].T, *vertices[triangles[witnesses[3 + middle, of]]].transpose(1, 2, 0))
        require_equal(shown <= _LIMIT_MM, np.ones(len(of), bool), "witnesses of middles")
        require_equal(witnesses[3 + middle][~known], witnesses[0][~known], "witnesses of triangles without one")
    return f"{len(triangles):,} triangles, {np.count_nonzero(left)} with middles left"


DISTANCE_CHECKS: tuple[Check, ...] = (
    Check("distances to a surface", ("find_near_faces",), _check_distances),
    Check("witnesses of triangles near a surface", ("find_witnesses",), _check_witnesses),
)


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
