"""Planes of the slices: turned with the cross, scrolled along their own direction, and what they say of it."""

from __future__ import annotations

import numpy as np
import pytest
import view_scenes as scenes
from refusals import refused
from view_models import make_model

from clrecon.errors import UsageError
from clrecon.rendering.views.reformation import PLANES, find_plane
from clrecon.viewer.model.planes import checked_turn, find_forward, turn_cross, turn_plane

pytestmark = pytest.mark.unit

ROUNDING = 1e-12  # of directions of length 1 in double precision


def test_straight_slices_look_up_back_and_to_the_right_of_the_patient() -> None:
    looks = {plane: find_forward(plane).tolist() for plane in PLANES}

    assert looks == {"axial": [0, 0, 1], "coronal": [0, 1, 0], "sagittal": [-1, 0, 0]}


def test_quarter_turn_on_the_axial_slice_turns_the_two_others_clockwise_and_leaves_it() -> None:
    turn = turn_cross(turn=None, plane="axial", degrees=90.0)

    looks = [find_forward(plane, turn) for plane in ("axial", "coronal", "sagittal")]

    # From below, where the patient's left is at the right, clockwise goes from the back to the right of the patient.
    assert np.allclose(looks, [(0, 0, 1), (-1, 0, 0), (0, -1, 0)], rtol=0, atol=ROUNDING)


def test_turned_slices_stay_across_each_other_after_a_thousand_turns() -> None:
    turn = None
    for n in range(1000):
        turn = turn_cross(turn, ("axial", "coronal", "sagittal")[n % 3], 7.3 * n)

    looks = np.array([find_forward(plane, turn) for plane in PLANES])

    assert np.allclose(looks @ looks.T, np.eye(3), rtol=0, atol=ROUNDING)


def test_slice_on_which_the_cross_is_turned_stays_as_it_is() -> None:
    camera = find_plane(scenes.make_scan(), "sagittal", size=(200, 100))

    turned = turn_plane(camera, turn_cross(turn=None, plane="sagittal", degrees=35.0))

    assert np.allclose(np.array(turned.basis()), np.array(camera.basis()), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("degrees", [20.0, 90.0])  # beyond 72 degrees little of the upward direction lies in the slice
def test_turned_slice_is_seen_along_its_direction_from_as_far_away(degrees: float) -> None:
    camera = find_plane(scenes.make_scan(), "coronal", size=(200, 100))
    turn = turn_cross(turn=None, plane="sagittal", degrees=degrees)

    turned = turn_plane(camera, turn)

    assert np.allclose(turned.basis().forward, find_forward("coronal", turn), rtol=0, atol=ROUNDING)
    assert turned.distance == pytest.approx(camera.distance)


def test_turned_slice_says_its_angle_in_place_of_its_number() -> None:
    model = make_model()

    model.turn_cross("sagittal", degrees=-20.0)

    shown = model.facts()["slices"]
    assert shown["axial"]["place"] == shown["coronal"]["place"] == "turned 20.0°"
    assert "number" not in shown["axial"]
    assert shown["sagittal"]["number"] > 0


def test_scrolling_a_turned_slice_goes_along_its_direction() -> None:
    model = make_model()
    model.turn_cross("coronal", degrees=30.0)
    before = np.array(model.state.cross)

    model.scroll("axial", 2)

    moved = np.array(model.state.cross) - before
    assert np.linalg.norm(moved) > 1.0  # mm; its layers are 0.9 and 1.4 mm thick
    assert np.allclose(
        moved / np.linalg.norm(moved), find_forward("axial", model.state.turn), rtol=0, atol=1e-9
    )  # a difference of places of some 200 mm


def test_straightened_slices_lie_along_the_axes_of_the_patient() -> None:
    model = make_model()
    model.turn_cross("axial", degrees=30.0)

    model.straighten()

    looks = [find_forward(plane, model.state.turn).tolist() for plane in ("axial", "coronal", "sagittal")]
    assert looks == [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    assert "number" in model.facts()["slices"]["coronal"]  # in place of its angle


@pytest.mark.parametrize(
    "rows",
    [
        pytest.param([[1, 0, 0], [0, 1, 0], [0, 0, -1]], id="mirror"),
        pytest.param([[2, 0, 0], [0, 2, 0], [0, 0, 2]], id="twice as large"),
        pytest.param([[1, 0, 0], [1, 0, 0], [0, 0, 1]], id="two rows alike"),
        pytest.param([[1, 0, 0], [0, 1, 0]], id="two rows"),
    ],
)
def test_turn_of_a_file_that_is_no_rotation_is_refused(rows: list) -> None:
    with refused(UsageError, "rotation"):
        checked_turn(rows)


def test_key_for_thick_slices_goes_from_planes_to_mean_to_most_and_back() -> None:
    model = make_model()
    shown = []

    for _ in range(4):
        shown.append((model.state.slab_mm, model.state.combine))
        model.step_slab()

    assert shown == [(0.0, "mean"), (10.0, "mean"), (10.0, "max"), (0.0, "mean")]
