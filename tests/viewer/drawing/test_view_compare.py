"""Comparison of inputs: the first left of a line and the others right of it, with one camera."""

from __future__ import annotations

import numpy as np
import pytest
import view_scenes as scenes
from open_views import open_painters
from refusals import refused

from clrecon.errors import UsageError
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.model.state import picture_key

pytestmark = pytest.mark.opencl

SIZE = (96, 80)
LINE = 0.25
COLUMN = 24  # of 96


def other_scan():
    """The balls a third as dense: nothing of them reaches the iso value of the surface."""
    return scenes.make_scan(scale=0.25)


@pytest.fixture
def compared(device):
    """Model and painter of two scans and a mesh."""
    with open_painters(device) as make:
        yield make(scenes.make_scan(), other_scan(), scenes.make_mesh())


def show_alone(model: ViewModel, numbers: set[int]) -> None:
    """Hide the other inputs."""
    for number in {each.number for each in model.objects} - numbers:
        model.show(str(number), False)


@pytest.mark.parametrize("mode", ["surface", "bone", "mip", "slices"])
def test_comparison_has_the_first_input_left_of_its_line_and_the_others_right(mode, compared):
    model, painter = compared
    model.set_mode(mode)
    model.turn(dx=0.1, dy=0.05)
    first, *others = (each.number for each in model.objects)
    alone = []
    for numbers in ({first}, set(others)):
        show_alone(model, numbers)
        alone.append(painter.picture(model.state, SIZE).image)
        model.show_all()
    assert (alone[0] != alone[1]).any()

    model.set_compare(LINE)
    picture = painter.picture(model.state, SIZE)

    assert np.array_equal(picture.image[:, :COLUMN], alone[0][:, :COLUMN])
    assert np.array_equal(picture.image[:, COLUMN:], alone[1][:, COLUMN:])


def test_slices_of_a_comparison_show_both_scans_at_one_place(compared):
    model, painter = compared
    model.set_cross(scenes.middle(0).tolist())
    whole = painter.slice(model.state, "axial", SIZE)
    model.show(str(model.objects[0].number), False)
    other = painter.slice(model.state, "axial", SIZE)
    model.show_all()

    model.set_compare(0.5)
    both = painter.slice(model.state, "axial", SIZE)

    assert both.camera == whole.camera == other.camera
    assert np.array_equal(both.image[:, :48], whole.image[:, :48])
    assert np.array_equal(both.image[:, 48:], other.image[:, 48:])
    assert (whole.image[:, 48:] != other.image[:, 48:]).any()


def test_pick_finds_the_input_of_its_side(compared):
    model, painter = compared
    model.set_mode("bone")
    first, second, _ = (each.number for each in model.objects)

    model.set_compare(1.0)
    left = painter.pick(model.state, SIZE, 48.0, 40.0)
    model.set_compare(0.0)
    right = painter.pick(model.state, SIZE, 48.0, 40.0)

    assert left.object == first
    assert right is None or right.object != first


def test_line_of_a_comparison_is_part_of_what_pictures_depend_on():
    model = ViewModel(show_objects([scenes.make_scan(), other_scan()]))
    keys = []
    for share in (None, 0.2, 0.3):
        model.set_compare(share)
        keys.append([picture_key(model.state, view) for view in ("scene", "axial")])

    assert len({key for pair in keys for key in pair}) == 6


def test_comparison_is_one_step_of_undo_and_dragging_its_line_another():
    model = ViewModel(show_objects([scenes.make_scan(), scenes.make_mesh()]), clock=lambda: 0.0)
    model.toggle_compare()
    model.hold(True)
    for share in (0.4, 0.3, 0.2):
        model.set_compare(share)
    model.hold(False)

    steps = []
    while model.undo():
        steps.append(model.state.compare)
    assert steps == [0.5, None]


def test_comparison_of_one_input_is_refused():
    model = ViewModel(show_objects([scenes.make_scan(), scenes.make_labels()]))
    with refused(UsageError, "comparison", "two"):
        model.toggle_compare()


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_line_beside_the_picture_is_refused(share):
    model = ViewModel(show_objects([scenes.make_scan(), scenes.make_mesh()]))
    with refused(UsageError, "comparison"):
        model.set_compare(share)
