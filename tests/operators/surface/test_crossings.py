"""Triangles that cut each other, found with a device: the same pairs as by the host, whatever the triangles."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from variants import daily

from clrecon.errors import Cancelled
from clrecon.mesh.intersections import find_self_intersections
from clrecon.operators.surface import decimation
from clrecon.operators.surface.decimation import CrossingMarks, find_crossings, follow_crossings, plan_crossings
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


def marked(device, vertices, triangles, **options):
    return together(CrossingMarks(device, plan_crossings(vertices, triangles)).look(**options))


def together(found):
    unsure, cut = found
    return np.union1d(unsure, cut)


def pairs(found) -> set[tuple[int, int]]:
    return {(int(min(pair)), int(max(pair))) for pair in found}


@pytest.mark.every_device
@pytest.mark.parametrize("count", [1, 2, 31, 32, 33, 200])
def test_crossing_triangles_are_marked_as_by_the_twin(device, count):
    vertices, triangles = scattered(count, sizes=(0.3, 1.0, 5.0))
    expected = np.flatnonzero(twin.mark_crossings(vertices, triangles))
    assert np.array_equal(marked(device, vertices, triangles), expected)


MANY_SMALL_TRIANGLES = (*[0.1] * 60, 6.0)  # mm


def test_triangles_are_entered_in_the_rows_that_their_boxes_touch():
    plan = plan_crossings(*scattered(700, sizes=MANY_SMALL_TRIANGLES), most_rows=100)
    corners, ny = plan.vertices[plan.triangles], int(plan.grid.last[1]) + 1
    low, high = (plan.grid.steps(box[:, 1], 1) for box in (corners.min(axis=1), corners.max(axis=1)))
    deep, far = (plan.grid.steps(box[:, 2], 2) for box in (corners.min(axis=1), corners.max(axis=1)))
    expected = {
        (row, y + ny * z)
        for row in range(700)
        for z in range(deep[row], far[row] + 1)
        for y in range(low[row], high[row] + 1)
    }
    assert len(expected) > 800  # measured 898
    order, rows = plan.enter(slice(None))
    assert set(zip(order.tolist(), rows.tolist(), strict=True)) == expected
    assert len(order) == plan.entries == len(expected)


def test_entries_of_a_row_lie_in_the_order_of_their_lowest_x():
    plan = plan_crossings(*scattered(700, sizes=MANY_SMALL_TRIANGLES), most_rows=100)
    order, rows = plan.enter(slice(None))
    steps = plan.grid.steps(plan.vertices[plan.triangles].min(axis=1)[:, 0], 0)[order]
    keys = rows.astype(np.int64) * (int(plan.grid.last[0]) + 1) + steps
    assert (np.diff(keys) >= 0).all()


def test_there_are_no_more_rows_than_allowed_and_more_than_half_of_them():
    plan = plan_crossings(*scattered(700, sizes=MANY_SMALL_TRIANGLES), most_rows=100)
    assert 50 < plan.grid.rows <= 100  # measured 90


def test_long_triangles_among_short_ones_make_rows_wide_enough_for_few_entries():
    plan = plan_crossings(*scattered(700, sizes=(0.1, 0.1, 0.1, 20.0)))
    assert 1.2 * 700 < plan.entries < 1.8 * 700  # 1.5 where places are random


@pytest.mark.every_device
def test_triangles_that_surely_cut_another_one_are_nearly_all_that_do(device):
    vertices, triangles = scattered(900)
    _, cut = CrossingMarks(device, plan_crossings(vertices, triangles)).look()
    expected = np.unique(find_self_intersections(vertices, triangles))
    assert set(cut) <= set(expected)
    assert len(cut) > 0.99 * len(expected)


def test_triangles_that_touch_in_a_point_are_not_sure_to_cut(device):
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, 0], [1, 1, 4], [2, 1, 4]], np.float32)
    unsure, cut = CrossingMarks(device, plan_crossings(vertices, np.arange(6, dtype=np.uint32).reshape(2, 3))).look()
    assert unsure.tolist() == [0, 1]
    assert len(cut) == 0


def test_a_triangle_without_area_is_not_sure_to_cut_what_it_passes_through(device):
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, -1], [1, 1, 3], [1, 1, 1]], np.float32)
    unsure, cut = CrossingMarks(device, plan_crossings(vertices, np.arange(6, dtype=np.uint32).reshape(2, 3))).look()
    assert unsure.tolist() == [0, 1]
    assert len(cut) == 0


@pytest.mark.oclgrind
def test_crossing_triangles_of_a_small_body_are_marked_as_by_the_twin(device):
    vertices, triangles = scattered(150, extent=(8.0, 8.0, 8.0))
    found = marked(device, vertices, triangles)
    assert len(found) > 0
    assert np.array_equal(found, np.flatnonzero(twin.mark_crossings(vertices, triangles)))


@pytest.mark.parametrize("sizes", [(0.01, 1.0, 40.0), (1.0,), (0.02, 0.021)])
@pytest.mark.parametrize("extent", [(60.0, 50.0, 40.0), (0.0, 90.0, 5.0), (500.0, 1.0, 1.0)])
@pytest.mark.parametrize("place", daily(1, [3000.0, 0.0]))
def test_crossing_pairs_are_those_of_the_host(device, sizes, extent, place):
    vertices, triangles = scattered(1200, sizes, extent=extent)
    vertices += np.float32(place)
    expected = find_self_intersections(vertices, triangles)
    assert pairs(find_crossings(device, vertices, triangles, fewest=1)) == pairs(expected)


@pytest.mark.parametrize("scale", daily(1, [2.0**-60, 2.0**-9, 1.0, 2.0**30]))
@pytest.mark.parametrize(
    "shift",
    [(11.0, 4.0, -3.0), (0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (25.0, 0.0, 0.0)],
    ids=["cut", "equal", "in each other's planes", "apart"],
)
def test_two_spheres_have_the_crossing_pairs_of_the_host_at_any_scale(device, scale, shift):
    """Spheres of 10 units, the second shifted."""
    vertices, triangles = samples.join(samples.sphere(rounds=3), samples.sphere(centre=shift, radius=10.0, rounds=3))
    arrays = (scale * vertices).astype(np.float32), np.asarray(triangles, np.uint32)
    assert pairs(find_crossings(device, *arrays, fewest=1)) == pairs(find_self_intersections(*arrays))


def test_two_spheres_that_cut_each_other_have_crossing_pairs(device):
    vertices, triangles = samples.join(
        samples.sphere(rounds=3), samples.sphere(centre=(11.0, 4.0, -3.0), radius=10.0, rounds=3)
    )
    assert len(find_crossings(device, vertices.astype(np.float32), np.asarray(triangles, np.uint32), fewest=1)) > 0


def test_no_triangle_of_a_torus_is_marked(device):
    """Neighbours share vertices, and what lies farther is told apart in float32."""
    vertices, triangles = samples.torus(rings=120, sides=60)
    assert len(marked(device, vertices.astype(np.float32), np.asarray(triangles, np.uint32))) == 0


@pytest.mark.every_device
def test_triangles_without_area_are_marked(device):
    vertices, triangles = samples.torus(rings=20, sides=10)
    vertices, triangles = vertices.astype(np.float32), np.asarray(triangles, np.uint32)
    vertices[triangles[7, 1]] = vertices[triangles[7, 0]]
    assert 7 in marked(device, vertices, triangles)


@pytest.mark.every_device
@pytest.mark.parametrize("sizes", [(0.3, 1.0, 6.0), (1.0,), (0.02, 40.0)])
def test_changed_triangles_and_what_they_cut_are_marked_after_each_change(device, sizes):
    vertices, triangles = scattered(900, sizes)
    marks = CrossingMarks(device, plan_crossings(vertices, triangles), spare=20_000)  # room for all changes
    marks.look()
    random = np.random.default_rng(2)
    for count in (20, 10):  # of 2,700 corners: 45 and 25 triangles
        corners = random.choice(len(vertices), count, replace=False)
        vertices[corners] += random.normal(0.0, 3.0, (count, 3)).astype(np.float32)
        is_changed = np.isin(triangles, corners).any(axis=1)
        unsure, cut = marks.look_again(vertices, np.flatnonzero(is_changed))
        rows = np.union1d(unsure, cut)
        expected = pairs(find_self_intersections(vertices, triangles, is_changed))
        assert len(expected) > 0
        assert set(cut) <= set(np.ravel(list(expected)))
        assert pairs(rows[find_self_intersections(vertices, triangles[rows], is_changed[rows])]) == expected


def test_of_some_rows_those_that_cut_each_other_are_marked_by_their_numbers(device):
    vertices, triangles = scattered(900)
    rows = np.flatnonzero(np.arange(900) % 3 > 0)
    marks = follow_crossings(device, vertices, triangles, rows, fewest=1)
    assert np.array_equal(together(marks.look()), rows[marked(device, vertices, triangles[rows])])


def test_rows_that_come_back_are_marked_among_all_where_there_is_room_and_where_there_is_none(device):
    """600 of 900 are entered, and room for a quarter: 50 that come back fit in, 300 do not."""
    vertices, triangles = scattered(900)
    for back in (np.arange(600, 650), np.arange(600, 900)):
        marks = follow_crossings(device, vertices, triangles, np.arange(600), fewest=1)
        marks.look()
        expected = np.flatnonzero(twin.mark_crossings(vertices, triangles[: back[-1] + 1]))
        assert set(expected[expected >= 600]) <= set(together(marks.look_again(vertices, back))) <= set(expected)


def test_triangle_that_moves_out_of_another_one_and_back_into_it_cuts_it_only_there(device):
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, -1], [1, 1, 3], [2, 1, 3]], np.float32)
    plan = plan_crossings(vertices, np.arange(6, dtype=np.uint32).reshape(2, 3))
    marks = CrossingMarks(device, plan, spare=100)  # room for all changes
    found = [together(marks.look()).tolist()]
    for triangle, shift in ((1, 9.0), (0, 0.5), (1, -9.0)):
        vertices[3 * triangle : 3 * triangle + 3] += np.float32(shift)
        found.append(together(marks.look_again(vertices, np.array([triangle]))).tolist())
    assert found == [[0, 1], [], [], [0, 1]]


def test_change_of_more_triangles_than_there_is_room_for_is_looked_at_anew(device):
    vertices, triangles = scattered(400)
    marks = CrossingMarks(device, plan_crossings(vertices, triangles))
    marks.look()
    moved = vertices[::-1].copy()
    assert np.array_equal(together(marks.look_again(moved, np.arange(400))), marked(device, moved, triangles))


def test_a_triangle_without_area_crosses_nothing(device):
    point = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
    assert len(find_crossings(device, *point, fewest=1)) == 0


def test_crossings_among_triangles_without_area_are_those_of_the_host(device):
    vertices, triangles = scattered(400)
    vertices[::7] = vertices[1::7][: len(vertices[::7])]  # two corners in one place
    found = find_crossings(device, vertices, triangles, fewest=1)
    assert len(found) > 10  # measured 221
    assert pairs(found) == pairs(find_self_intersections(vertices, triangles))


@pytest.mark.parametrize(
    ("dtype", "options"),
    [(np.float32, {}), (np.float64, {"fewest": 1}), (np.float32, {"fewest": 1, "memory": 1})],
    ids=["too few", "float64", "no room"],
)
def test_triangles_that_the_device_does_not_take_have_the_crossings_of_the_host(device, dtype, options, monkeypatch):
    monkeypatch.setattr(decimation, "CrossingMarks", None)
    vertices, triangles = scattered(600)
    told: list[tuple[str, int, int]] = []
    steps = Steps(lambda *step: told.append(step), "crossings", 600)
    found = find_crossings(device, vertices.astype(dtype), triangles, steps=steps, **options)
    assert len(found) > 10  # measured 606
    assert pairs(found) == pairs(find_self_intersections(vertices, triangles))
    assert told[0] == ("crossings", 0, 600)
    assert told[-1] == ("crossings", 600, 600)


def test_progress_of_crossings_is_told_after_each_part(device):
    told: list[int] = []
    marked(device, *scattered(600), part=256, steps=Steps(lambda *step: told.append(step[1]), "crossings", 600))
    assert told == [0, 256, 512, 600]


@pytest.mark.every_device
def test_triangles_entered_in_parts_have_the_marks_of_all_at_once(device):
    vertices, triangles = scattered(900)
    assert np.array_equal(marked(device, vertices, triangles, part=128), marked(device, vertices, triangles))


def test_progress_of_crossings_may_end_the_work(device):
    def cancel(stage: str, done: int, total: int) -> None:
        if done:
            raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        marked(device, *scattered(600), part=256, steps=Steps(cancel, "crossings", 600))


def test_progress_of_crossings_counts_all_triangles_of_one_piece_at_once(device):
    told: list[int] = []
    steps = Steps(lambda *step: told.append(step[1]), "crossings", 600)
    assert len(find_crossings(device, *scattered(600), fewest=1, steps=steps)) > 10  # measured 606
    assert told == [0, 600]
