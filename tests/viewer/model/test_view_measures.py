"""Measures of a view, without a device: made of points, named, undone, removed."""

from __future__ import annotations

import pytest
from refusals import refused
from view_models import make_model

from clrecon.errors import UsageError
from clrecon.viewer.model.state import Pick

pytestmark = pytest.mark.unit


def measure(model, tool, *points):
    """Return what the last of the points, or the end of a curve, makes."""
    model.start_tool(tool)
    made = [model.add_point(Pick(point=point)) for point in points]
    return model.end_tool() if tool == "curve" else made[-1]


def test_a_distance_is_made_of_two_points_in_mm():
    model = make_model()
    model.start_tool("distance")
    assert model.add_point(Pick(point=(0.0, 0.0, 0.0))) is None
    distance = model.add_point(Pick(point=(3.0, 4.0, 12.0)))
    assert distance.value == pytest.approx(13.0)  # 9 + 16 + 144 = 13 * 13
    assert distance.text == "13.0 mm"


def test_an_angle_is_made_at_the_second_of_three_points_in_degrees():
    angle = measure(make_model(), "angle", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 2.0, 0.0))
    assert angle.value == pytest.approx(90.0)
    assert angle.unit == "degrees"


def test_a_curve_is_made_of_its_points_when_its_tool_ends():
    model = make_model()
    points = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    model.start_tool("curve")
    assert [model.add_point(Pick(point=point)) for point in points] == [None] * 4
    assert model.end_tool().value == pytest.approx(3.0)
    assert model.state.curve == points
    assert model.state.tool is None


def test_a_seed_is_made_of_one_point_and_has_its_place_as_text():
    model = make_model()
    assert measure(model, "seed", (1.0, 2.0, 3.0)).value is None
    assert model.facts()["measures"][0]["text"] == "1.0, 2.0, 3.0 mm LPS"


def test_measures_are_undone_one_by_one_and_cleared_together():
    model = make_model()
    measure(model, "seed", (1.0, 2.0, 3.0))
    measure(model, "distance", (0.0, 0.0, 0.0), (3.0, 4.0, 12.0))
    measure(model, "seed", (4.0, 5.0, 6.0))
    model.undo()
    assert [each.kind for each in model.state.measures] == ["seed", "distance"]
    model.clear_measures()
    assert list(model.state.measures) == []
    assert model.undo() == "the measures"
    assert [each.kind for each in model.state.measures] == ["seed", "distance"]


def test_measures_are_named_by_their_kind_with_the_first_free_number():
    model = make_model()
    for x in (1.0, 2.0, 3.0):
        measure(model, "seed", (x, 0.0, 0.0))
    measure(model, "distance", (0.0, 0.0, 0.0), (3.0, 4.0, 12.0))
    model.remove_measure(1)
    measure(model, "seed", (4.0, 0.0, 0.0))
    assert [each.name for each in model.state.measures] == ["place 1", "place 3", "distance 1", "place 2"]


def test_a_measure_is_renamed_without_spaces_around_and_undone():
    model = make_model()
    measure(model, "distance", (0.0, 0.0, 0.0), (3.0, 4.0, 12.0))
    model.rename_measure(0, "  L3 height ")
    assert model.facts()["measures"][0]["name"] == "L3 height"
    assert model.undo() == "the name L3 height"
    assert model.facts()["measures"][0]["name"] == "distance 1"


def test_a_removed_measure_comes_back_by_undo_in_its_order():
    model = make_model()
    for x in (1.0, 2.0, 3.0):
        measure(model, "seed", (x, 0.0, 0.0))
    before = model.state
    model.remove_measure(1)
    assert [each.name for each in model.state.measures] == ["place 1", "place 3"]
    model.undo()
    assert model.state == before


@pytest.mark.parametrize("name", ["", "   ", "a" * 81, "two\nlines", "turned\u202eround", 3], ids=repr)
def test_name_of_a_measure_that_cannot_be_read_is_refused(name):
    model = make_model()
    measure(model, "seed", (1.0, 2.0, 3.0))
    with refused(UsageError, "name", 80):
        model.rename_measure(0, name)
    assert model.state.measures[0].name == "place 1"


@pytest.mark.parametrize("n", [-1, 1, True, 0.0])
def test_removal_of_a_measure_that_is_not_there_is_refused(n):
    model = make_model()
    measure(model, "seed", (1.0, 2.0, 3.0))
    with refused(UsageError, "measure", repr(n)):
        model.remove_measure(n)
    assert len(model.state.measures) == 1


def test_curve_of_a_view_is_the_one_that_was_made_last():
    model = make_model()
    for length in (3.0, 5.0):
        model.start_tool("curve")
        for x in (0.0, length):
            model.add_point(Pick(point=(x, 0.0, 0.0)))
        model.end_tool()
    assert model.state.curve == ((0.0, 0.0, 0.0), (5.0, 0.0, 0.0))


def test_an_angle_of_points_in_one_place_is_refused():
    model = make_model()
    model.start_tool("angle")
    model.add_point(Pick(point=(0.0, 0.0, 0.0)))
    model.add_point(Pick(point=(0.0, 0.0, 0.0)))
    with refused(UsageError, "angle", "points"):
        model.add_point(Pick(point=(1.0, 0.0, 0.0)))
