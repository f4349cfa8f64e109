"""Triangles that cut each other, found with a device: the same pairs as by the host, whatever the triangles."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from variants import daily

from clrecon.errors import Cancelled
from clrecon.mesh.intersections import find_self_intersections
from clrecon.operators.surface import decimation
from clrecon.operators.surface.decimation import find_crossings, mark_crossings, plan_crossings
from clrecon.proof.surface import crossings as twin
from clrecon.system.progress import Steps


def scattered(count: int, sizes=(0.3, 1.0, 6.0), seed: int = 5, extent=(30.0, 30.0, 30.0)):
    """Triangles of several sizes at random, in pairs at one place, of which every other one shares a vertex."""
    random = np.random.default_rng(seed)
    size = random.choice(sizes, (count, 1, 1))
    places = np.repeat(np.multiply(extent, random.random((count, 1, 3))), 2, axis=0)[:count]
    corners = places + size * random.normal(size=(count, 3, 3))
    triangles = np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)
    for first in range(0, count - 1, 4):
        triangles[first, 2] = triangles[first + 1, 0]
    return corners.reshape(-1, 3).astype(np.float32), triangles


def pairs(found) -> set[tuple[int, int]]:
    return {(int(min(pair)), int(max(pair))) for pair in found}


@pytest.mark.every_device
@pytest.mark.parametrize("count", [1, 2, 31, 32, 33, 200])
def test_crossing_triangles_are_marked_as_by_the_twin(device, count):
    vertices, triangles = scattered(count, sizes=(0.3, 1.0, 5.0))
    found = mark_crossings(device, plan_crossings(vertices, triangles))
    assert np.array_equal(found, twin.mark_crossings(vertices, triangles))
    assert count < 700 or 0.05 < found.mean() < 0.95


def test_levels_double_their_edge_and_the_finest_has_few_rows():
    plan = plan_crossings(*scattered(700, sizes=(*[0.1] * 60, 6.0)), most_rows=100)
    edges, longest = plan.edges.T
    np.testing.assert_allclose(edges, edges[0] * 2.0 ** np.arange(len(edges)), rtol=1e-6)
    assert (longest <= edges).all()
    rows = plan.levels[:, 1].astype(int) * plan.levels[:, 2]
    assert 50 < rows[0] <= 100 and len(rows) == len(plan.edges) > 1


@pytest.mark.oclgrind
def test_few_crossing_triangles_are_marked_as_by_the_twin(device):
    vertices, triangles = scattered(150, extent=(8.0, 8.0, 8.0))
    found = mark_crossings(device, plan_crossings(vertices, triangles))
    assert np.array_equal(found, twin.mark_crossings(vertices, triangles)) and found.any()


@pytest.mark.parametrize("sizes", [(0.01, 1.0, 40.0), (1.0,), (0.02, 0.021)])
@pytest.mark.parametrize("extent", [(60.0, 50.0, 40.0), (0.0, 90.0, 5.0), (500.0, 1.0, 1.0)])
@pytest.mark.parametrize("place", daily(1, [3000.0, 0.0]))
def test_crossing_pairs_are_those_of_the_host(device, sizes, extent, place):
    vertices, triangles = scattered(1200, sizes, extent=extent)
    vertices += np.float32(place)
    expected = find_self_intersections(vertices, triangles)
    assert pairs(find_crossings(device, vertices, triangles, fewest=1)) == pairs(expected)


@pytest.mark.parametrize("fewest", [1, 10_000])
def test_crossings_with_a_changed_triangle_are_those_of_the_host(device, fewest):
    vertices, triangles = scattered(900)
    changed = np.arange(900) % 4 == 1
    every = find_self_intersections(vertices, triangles)
    expected = every[changed[every].any(axis=1)]
    assert pairs(find_crossings(device, vertices, triangles, changed, fewest=fewest)) == pairs(expected) and 10 < len(
        expected
    ) < len(every)


@pytest.mark.parametrize("scale", daily(1, [2.0**-60, 2.0**-9, 1.0, 2.0**30]))
def test_bodies_that_cut_each_other_have_the_pairs_of_the_host_at_any_scale(device, scale):
    """Whatever the unit of length; two spheres whose triangles lie in each other's planes too."""
    sphere = samples.sphere(rounds=3)
    for shift in ((11.0, 4.0, -3.0), (0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (25.0, 0.0, 0.0)):
        vertices, triangles = samples.join(sphere, samples.sphere(shift, 10.0, 3))
        arrays = (scale * vertices).astype(np.float32), np.asarray(triangles, np.uint32)
        expected = find_self_intersections(*arrays)
        assert pairs(find_crossings(device, *arrays, fewest=1)) == pairs(expected)
        assert len(expected) > 0 or shift[0] != 11.0


def test_a_closed_surface_leaves_nothing_to_look_at(device):
    """Neighbours share vertices, and what lies farther is told apart in float32."""
    vertices, triangles = samples.torus(120, 60)
    found = mark_crossings(device, plan_crossings(vertices.astype(np.float32), np.asarray(triangles, np.uint32)))
    assert not found.any()


def test_triangles_without_area_are_left_to_the_host(device):
    nothing = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
    assert len(find_crossings(device, *nothing, fewest=1)) == 0
    vertices, triangles = scattered(400)
    vertices[::7] = vertices[1::7][: len(vertices[::7])]
    assert pairs(find_crossings(device, vertices, triangles, fewest=1)) == pairs(
        find_self_intersections(vertices, triangles)
    )


@pytest.mark.parametrize("case", ["small", "float64", "no room"])
def test_triangles_that_the_device_does_not_take_are_left_to_the_host(device, case, monkeypatch):
    given: dict = {} if case == "small" else {"fewest": 1}
    monkeypatch.setattr(decimation, "mark_crossings", None)
    vertices, triangles = scattered(600)
    own = vertices.astype(np.float64) if case == "float64" else vertices
    told: list[tuple[str, int, int]] = []
    steps = Steps(lambda *step: told.append(step), "crossings", 600)
    found = find_crossings(device, own, triangles, memory=1 if case == "no room" else None, steps=steps, **given)
    assert pairs(found) == pairs(find_self_intersections(vertices, triangles)) and len(found) > 10
    assert told[0] == ("crossings", 0, 600) and told[-1] == ("crossings", 600, 600)


def test_progress_counts_triangles_and_may_end_the_work(device):
    plan = plan_crossings(*scattered(600))
    told: list[int] = []
    mark_crossings(device, plan, piece=256, steps=Steps(lambda *step: told.append(step[1]), "crossings", 600))
    assert told == [0, 256, 512, 600]

    def cancel(stage: str, done: int, total: int) -> None:
        if done:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        mark_crossings(device, plan, piece=256, steps=Steps(cancel, "crossings", 600))
    told.clear()
    steps = Steps(lambda *step: told.append(step[1]), "crossings", 600)
    assert len(find_crossings(device, *scattered(600), fewest=1, steps=steps)) > 10 and told == [0, 600]
