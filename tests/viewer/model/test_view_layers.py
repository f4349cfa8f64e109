"""Slices of a view, without a device: their numbers, paging from layer to layer, the mode that shows them in space."""

from __future__ import annotations

import numpy as np
import pytest
import view_scenes as scenes
from view_models import make_model

from clrecon.geometry import Volume
from clrecon.rendering.views.directions import LEAST_COSINE

pytestmark = pytest.mark.unit


@pytest.fixture
def model_of_small_scan():
    """Of 3 x 4 x 5 voxels, slices 2 mm apart: i runs to the right, j to the back, k up; its cross in (2, 1, 0)."""
    model = make_model(Volume(np.zeros((5, 4, 3), np.int16), np.diag([-1.0, 1.0, 2.0, 1.0])))
    model.set_cross((-2.0, 1.0, 0.0))
    return model


@pytest.mark.parametrize(
    ("plane", "facts"),
    [
        ("axial", {"place": "I 0.0 mm", "number": 1, "count": 5}),
        ("coronal", {"place": "P 1.0 mm", "number": 2, "count": 4}),
        ("sagittal", {"place": "R 2.0 mm", "number": 3, "count": 3}),
    ],
)
def test_slice_has_its_place_and_its_number_of_all(model_of_small_scan, plane, facts):
    assert model_of_small_scan.facts()["slices"][plane] == facts


def test_slice_that_is_scrolled_by_three_has_a_number_three_higher(model_of_small_scan):
    model_of_small_scan.scroll("axial", 3)
    assert model_of_small_scan.facts()["slices"]["axial"] == {"place": "S 6.0 mm", "number": 4, "count": 5}


def test_slice_without_a_scan_has_a_place_and_no_number():
    model = make_model(scenes.make_mesh())
    assert set(model.facts()["slices"]["sagittal"]) == {"place"}


def test_slices_begin_in_the_middle_of_the_scan_whatever_lies_beside_it():
    far = scenes.make_mesh(at=np.array([500.0, 0.0, 0.0]))
    cross = make_model(far, scenes.make_scan()).state.cross
    assert scenes.make_scan().lps_to_ijk(cross) == pytest.approx([22.0, 20.0, 11.0])  # of 44 x 40 x 22 voxels


def paged(affine, plane: str, positions=None) -> list[tuple[int, float]]:
    """Number and index along k of every position that paging reaches, the way back included, of 3 x 4 x 5 voxels."""
    volume = Volume(np.zeros((5, 4, 3), np.int16), np.array(affine), slice_positions=positions)
    model = make_model(volume)
    model.set_cross(volume.ijk_to_lps([1.0, 2.0, 2.3]))
    model.scroll(plane, -1e308)
    places = []
    for step in (1, -1):
        version = -1
        while version != model.version:
            version = model.version
            number = model.facts()["slices"][plane]["number"]
            places.append((number, round(float(volume.lps_to_ijk(model.state.cross)[2]), 6)))
            model.scroll(plane, step)
    assert places[: len(places) // 2] == places[len(places) // 2 :][::-1]
    return places[: len(places) // 2]


TURNED = [[0.0, 0.0, 2.5, 0.0], [0.7, 0.0, 0.0, 0.0], [0.0, 0.7, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]  # k runs to the left

TILTED = [[0.7, 0.0, 0.0, 0.0], [0.0, 0.7, 0.7, 0.0], [0.0, 0.0, 2.5, 0.0], [0.0, 0.0, 0.0, 1.0]]  # gantry tilt

UNEVEN = np.outer([0.0, 2.5, 3.0, 9.0, 10.0], [0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("affine", "plane", "positions", "last_first"),
    [
        (np.diag([0.7, 0.7, 2.5, 1.0]), "axial", None, False),
        (np.diag([0.7, 0.7, -2.5, 1.0]), "axial", None, True),
        (np.diag([0.7, 0.7, 2.5, 1.0]), "axial", UNEVEN, False),
        (TURNED, "sagittal", None, True),
        (TILTED, "axial", None, False),
    ],
    ids=["upwards", "downwards", "uneven", "turned", "tilted"],
)
def test_paging_through_slices_shows_each_layer_once_at_its_middle(affine, plane, positions, last_first):
    layers = [4.0, 3.0, 2.0, 1.0, 0.0] if last_first else [0.0, 1.0, 2.0, 3.0, 4.0]
    assert paged(affine, plane, positions) == list(zip([1, 2, 3, 4, 5], layers, strict=True))


def test_paging_an_oblique_scan_goes_to_the_middle_of_the_next_layer_at_the_cross():
    scan = scenes.make_scan()
    model = make_model(scan)
    model.set_cross(scan.ijk_to_lps([22.0, 20.0, 11.3]))
    steps = (("axial", 2, -1, [10.0, 11.0]), ("sagittal", 0, 1, [21.0, 20.0]))  # to the right, where i gets smaller
    for plane, axis, first_step, layers in steps:
        model.scroll(plane, first_step)
        first = scan.lps_to_ijk(model.state.cross)[axis]
        model.scroll(plane, 1)
        assert [first, scan.lps_to_ijk(model.state.cross)[axis]] == pytest.approx(layers), plane


def test_slice_without_a_scan_is_scrolled_by_a_mm():
    model = make_model(scenes.make_mesh())
    before = model.state.cross[2]
    model.scroll("axial", 1)
    assert model.state.cross[2] == pytest.approx(before + 1.0)


def test_slice_without_a_scan_is_scrolled_to_the_end_of_the_objects():
    model = make_model(scenes.make_mesh())
    model.scroll("axial", 10_000)
    assert model.state.cross[2] == pytest.approx(model.objects[0].corners[:, 2].max())


def test_mode_slices_turns_a_camera_that_sees_them_edge_on():
    model = make_model(scenes.make_scan())

    model.set_mode("slices")

    normal = np.cross(*model.scans[0].volume.affine[:3, :2].T)
    cosine = model.camera.basis().forward @ normal / np.linalg.norm(normal)
    assert abs(cosine) >= LEAST_COSINE  # a quarter of their height is seen, as at least in `clrecon.render`
    assert model.facts()["notes"] == []


def test_mode_slices_and_its_turn_of_the_camera_are_undone_in_one_step():
    model = make_model(scenes.make_scan())
    start = model.camera
    model.set_mode("slices")
    model.undo()
    assert (model.camera, model.state.mode) == (start, "surface")


def test_slices_that_are_seen_edge_on_are_noted():
    model = make_model(scenes.make_scan())
    model.set_mode("slices")
    model.look("anterior")
    assert "turn the picture" in model.facts()["notes"][0]


def test_mode_slices_leaves_a_camera_that_sees_them():
    model = make_model(scenes.make_scan())
    model.look("superior")
    start = model.camera
    model.set_mode("slices")
    assert model.camera == start
