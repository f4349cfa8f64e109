"""Gestures of a view's camera: what lies under the pointer stays there, and the way back is the way."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.views.camera import Camera
from clrecon.viewer.model.changes import pan_camera, pixel_camera, roll_camera, turn_camera, zoom_camera

PARALLEL = Camera((10.0, -300.0, 40.0), (10.0, 20.0, 40.0), (0.0, 0.0, 1.0), parallel_scale=80.0)
PERSPECTIVE = Camera((10.0, -300.0, 40.0), (10.0, 20.0, 40.0), (0.0, 0.0, 1.0), view_angle=30.0)
SIZE = (320, 200)
BOTH = pytest.mark.parametrize("camera", [PARALLEL, PERSPECTIVE], ids=["parallel", "perspective"])
pytestmark = pytest.mark.unit


def seen_at(camera: Camera, point) -> np.ndarray:
    return camera.project([point], SIZE)[0][0]


@BOTH
def test_the_place_under_the_pointer_goes_with_a_shift(camera):
    before = seen_at(camera, camera.focal_point)
    moved = pan_camera(camera, 0.25, -0.1)
    assert seen_at(moved, camera.focal_point) == pytest.approx(before + np.array([0.25, -0.1]) * SIZE[1])


@BOTH
def test_the_place_under_the_pointer_stays_at_a_zoom(camera):
    right, up, _ = camera.basis()
    point = np.array(camera.focal_point) + 30.0 * right - 12.0 * up
    before = seen_at(camera, point)
    at = (before - 0.5 * np.array(SIZE)) / SIZE[1]
    for factor in (3.0, 0.4):
        zoomed = zoom_camera(camera, factor, tuple(at))
        assert seen_at(zoomed, point) == pytest.approx(before, abs=1e-6)
        assert zoomed.pixel_mm(SIZE) == pytest.approx(camera.pixel_mm(SIZE) / factor)


def test_a_zoom_ends_before_numbers_do():
    camera = PARALLEL
    for _ in range(200):
        camera = zoom_camera(camera, 10.0)
    assert camera.parallel_scale == pytest.approx(0.01)
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with refused(UsageError, 0):
            zoom_camera(PARALLEL, wrong)


@BOTH
def test_a_gesture_over_the_height_is_half_a_turn_that_follows_the_pointer(camera):
    turned = turn_camera(camera, 1.0, 0.0)
    assert turned.basis().forward == pytest.approx(-camera.basis().forward)
    front = np.array(camera.focal_point) - 40.0 * camera.basis().forward
    moved = seen_at(turn_camera(camera, 0.05, 0.0), front) - seen_at(camera, front)
    assert moved[0] > 1.0 and moved[1] == pytest.approx(0.0, abs=1e-6)
    moved = seen_at(turn_camera(camera, 0.0, 0.05), front) - seen_at(camera, front)
    assert moved[1] > 1.0 and moved[0] == pytest.approx(0.0, abs=1e-6)
    again = turn_camera(turn_camera(camera, 0.3, 0.0), -0.3, 0.0)
    assert again.position == pytest.approx(camera.position) and turned.distance == pytest.approx(camera.distance)


@BOTH
def test_a_roll_turns_the_picture_clockwise(camera):
    right, up, _ = camera.basis()
    top = np.array(camera.focal_point) + 20.0 * up
    rolled = roll_camera(camera, 90.0)
    assert seen_at(rolled, top)[0] > seen_at(rolled, camera.focal_point)[0] + 1.0


@BOTH
def test_the_camera_of_a_pixel_looks_along_its_ray(camera):
    origins, directions = camera.rays(SIZE)
    for x, y in ((0, 0), (319, 199), (200, 30)):
        one = pixel_camera(camera, SIZE, x + 0.5, y + 0.5)
        origin, direction = (each[0, 0] for each in one.rays((1, 1)))
        assert origin == pytest.approx(origins[y, x], abs=1e-6)
        assert direction == pytest.approx(directions[y, x], abs=1e-9)
