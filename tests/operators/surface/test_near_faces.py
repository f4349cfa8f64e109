"""Upper bounds of distances on a device equal those of their twin, or are nearer to the distance."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import sample_meshes as samples
from near_surfaces import FLAT_BOUND, FLAT_CASES, flat_case, sheet
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.mesh.compare.distances import NearDistance, triangle_distances
from clrecon.mesh.refine.deviation import MIDDLES, SurfaceBounds
from clrecon.operators.surface.decimation import DeviceBounds

ROUNDING_MM = 2e-4
"""Slack of bounds at coordinates of some tens of mm, and the rounding of float32."""


def rough(size: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    """Return a rough sheet and a source of points."""
    rng = np.random.default_rng(seed)
    vertices, triangles = sheet(size)
    return vertices + rng.normal(0.0, 0.25, vertices.shape), triangles, rng


@pytest.mark.every_device
@pytest.mark.parametrize("count", [1, 63, 64, 65, 1500])
def test_distances_around_hints_are_exact(device, count):
    vertices, triangles, rng = rough(20)
    points = rng.uniform(0.0, 19.0, (count, 3)) * [1, 1, 0.1]
    near = rng.integers(0, 400, (count, 3))
    length, rows = DeviceBounds(device, vertices, triangles).find_bounds(points, near, 0.0)
    exact, _ = NearDistance(vertices, triangles).find_around(points, near)
    assert ((length >= exact) & (length <= exact + ROUNDING_MM)).all()
    own = triangle_distances(points.T, *vertices[triangles[rows]].transpose(1, 2, 0))
    np.testing.assert_allclose(own, exact, atol=ROUNDING_MM)
    assert rows.dtype == np.int32 and length.dtype == np.float32


@pytest.mark.parametrize(("limit", "walks"), [(0.0, 0), (0.0, 3), (0.0, 9), (1.0, 9), (9.0, 9)])
def test_walks_and_limits_are_those_of_the_twin(device, limit, walks):
    vertices, triangles = sheet(9)
    points = np.array([[1.4, 1.2, 0.5], [6.4, 1.3, -0.25], [3.1, 3.05, 2.0]])
    near = np.array([[70, 10], [70, 11], [70, 12]])
    bounds = SurfaceBounds(vertices, triangles), DeviceBounds(device, vertices, triangles)
    (twin, own), (length, rows) = (each.find_bounds(points, near, limit, walks) for each in bounds)
    assert (length <= np.maximum(twin, limit) + ROUNDING_MM).all() and (length >= [0.5, 0.25, 2.0]).all()
    if walks == 9 and limit == 0.0:  # both end over the face
        np.testing.assert_allclose(length, twin, atol=ROUNDING_MM)
        np.testing.assert_array_equal(rows, own)


@pytest.mark.every_device
@pytest.mark.parametrize("case", FLAT_CASES)
def test_witnesses_are_the_faces_within_the_limit(device, case):
    bounds, arguments, expected = flat_case(partial(DeviceBounds, device), case)
    witnesses, left = bounds.find_witnesses(*arguments, FLAT_BOUND)
    assert (witnesses[:, 0].tolist(), int(left[0])) == expected


def test_vertices_that_are_left_lie_beyond_the_limit(device):
    vertices, triangles, rng = rough(24)
    places = (vertices + rng.normal(0.0, 0.2, vertices.shape)).astype(np.float32)
    names, limit = np.arange(len(vertices)), 0.3
    exact = NearDistance(vertices, triangles)
    length, beside = exact.find_around(places.astype(float), names[:, None])
    beside = np.where(length <= limit, beside, -1).astype(np.int32)
    witnesses, left = DeviceBounds(device, vertices, triangles).find_witnesses(places, triangles, names, beside, limit)
    _, of_twin = SurfaceBounds(vertices, triangles).find_witnesses(places, triangles, names, beside, limit)
    known = (beside[triangles] >= 0).all(axis=1)
    assert 100 < known.sum() < len(known) and not left[~known].any()
    assert ((left & ~of_twin) == 0).all()  # its distances are not longer
    seen = 0
    for middle, weights in enumerate(MIDDLES):
        points = np.einsum("i,kia->ka", weights, places[triangles].astype(float))
        around, _ = exact.find_around(points, triangles.astype(int))
        is_left = (left >> middle & 1).astype(bool)
        assert (around[is_left] > limit - ROUNDING_MM).all()
        own = np.flatnonzero(known & ~is_left & (witnesses[3 + middle] != witnesses[0]))
        shown = triangle_distances(points[own].T, *vertices[triangles[witnesses[3 + middle, own]]].transpose(1, 2, 0))
        seen += len(own) + is_left.sum()
        assert (shown <= limit).all()
    assert seen > 20


def test_vertices_without_faces_have_infinite_bounds_and_empty_requests_none(device):
    vertices, triangles = sheet(4)
    bounds = DeviceBounds(device, np.concatenate([vertices, [[9.0, 9.0, 9.0]]]), triangles)
    length, rows = bounds.find_bounds(np.array([[0.3, 0.2, 1.0]] * 2), np.array([[16, 16], [16, 0]]), 0.0, walks=2)
    assert np.isinf(length[0]) and rows[0] == -1 and rows[1] == 0
    assert bounds.find_bounds(np.zeros((0, 3)), np.zeros((0, 2), int), 1.0)[0].shape == (0,)
    nothing = np.zeros((0, 3), np.uint32)
    witnesses, left = bounds.find_witnesses(
        np.zeros((1, 3), np.float32), nothing, np.zeros(1, int), np.zeros(1, np.int32), 1.0
    )
    assert witnesses.shape == (7, 0) and left.shape == (0,)
    none = DeviceBounds(device, vertices, nothing)
    assert none.find_bounds(np.zeros((2, 3)), np.zeros((2, 1), int), 1.0)[1].tolist() == [-1, -1]


def test_faces_without_area_are_passed_over(device):
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
    triangles = np.array([[0, 1, 2], [0, 4, 0], [0, 1, 3]], np.uint32)
    points = np.array([[0.25, 0.25, 0.5], [1.5, -1.0, 0.0], [-1.0, 0.0, 0.0]])
    length, _ = DeviceBounds(device, vertices, triangles).find_bounds(points, np.zeros((3, 1), int), 0.0)
    assert (length >= [0.5, 1.0, 1.0]).all() and length[0] == pytest.approx(0.5, abs=ROUNDING_MM)
    assert length[2] == pytest.approx(1.0, abs=ROUNDING_MM)


def test_long_requests_are_made_in_parts(device):
    vertices, triangles, rng = rough(12)
    points, near = rng.uniform(0.0, 11.0, (500, 3)), rng.integers(0, 144, (500, 2))
    names, beside = np.arange(144), np.zeros(144, np.int32)
    arguments = vertices.astype(np.float32) + np.float32(0.3), triangles, names, beside, 0.4
    bounds = DeviceBounds(device, vertices, triangles)
    whole = (*bounds.find_bounds(points, near, 0.5, 2), *bounds.find_witnesses(*arguments))
    bounds = DeviceBounds(device, vertices, triangles)
    bounds.part = 64
    for one, other in zip(
        whole, (*bounds.find_bounds(points, near, 0.5, 2), *bounds.find_witnesses(*arguments)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.oclgrind
def test_bounds_and_witnesses_of_a_small_surface_are_found(device):
    vertices, triangles = samples.box()
    bounds = DeviceBounds(device, vertices, triangles.astype(np.uint32))
    length, _ = bounds.find_bounds(vertices * 1.1, np.arange(8)[:, None], 0.0, 2)
    assert (length > 0.0).all()
    beside = np.array([np.flatnonzero((triangles == corner).any(axis=1))[0] for corner in range(8)], np.int32)
    places = (1.1 * vertices).astype(np.float32)
    assert bounds.find_witnesses(places, triangles.astype(np.uint32), np.arange(8), beside, 0.02)[1].any()


def test_a_device_without_room_says_what_it_would_need(device):
    vertices, triangles = sheet(9)
    bounds = DeviceBounds(device, vertices, triangles)
    bounds.part = 1 << 40
    with refused(DeviceError, "points"):
        bounds.find_bounds(vertices, np.zeros((81, 1), int), 0.0)
