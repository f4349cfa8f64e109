"""Gestures of a view's camera: what lies under the pointer stays there, and the way back is the way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.views.camera import Camera
from clrecon.viewer.model.changes import pan_camera, pixel_camera, roll_camera, turn_camera, zoom_camera

FROM_THE_FRONT: Any = {"position": (10.0, -300.0, 40.0), "focal_point": (10.0, 20.0, 40.0), "up": (0.0, 0.0, 1.0)}
PARALLEL = Camera(**FROM_THE_FRONT, parallel_scale=80.0)
PERSPECTIVE = Camera(**FROM_THE_FRONT, view_angle=30.0)
SIZE = (320, 200)
BOTH = pytest.mark.parametrize("camera", [PARALLEL, PERSPECTIVE], ids=["parallel", "perspective"])
pytestmark = pytest.mark.unit


def pixel_of(camera: Camera, point) -> np.ndarray:
    """Where a point is seen, (x, y) in pixels."""
    return camera.project([point], SIZE)[0][0]


@BOTH
def test_shift_of_the_camera_moves_a_place_with_the_pointer(camera):
    before = pixel_of(camera, camera.focal_point)
    moved = pan_camera(camera, dx=0.25, dy=-0.1)
    height = SIZE[1]
    assert pixel_of(moved, camera.focal_point) == pytest.approx(before + np.array([0.25, -0.1]) * height)


@BOTH
@pytest.mark.parametrize("factor", [3.0, 0.4], ids=["in", "out"])
def test_zoom_of_the_camera_keeps_the_place_under_the_pointer_and_scales_pixels(camera, factor):
    right, up, _ = camera.basis()
    place = np.array(camera.focal_point) + 30.0 * right - 12.0 * up
    pixel = pixel_of(camera, place)
    pointer = (pixel - 0.5 * np.array(SIZE)) / SIZE[1]  # from the middle, in heights of the picture

    zoomed = zoom_camera(camera, factor, point=tuple(pointer))

    assert pixel_of(zoomed, place) == pytest.approx(pixel, abs=1e-6)
    assert zoomed.pixel_mm(SIZE) == pytest.approx(camera.pixel_mm(SIZE) / factor)


def test_zoom_of_the_camera_ends_at_a_hundredth_of_a_mm():
    camera = PARALLEL
    for _ in range(200):
        camera = zoom_camera(camera, 10.0)
    assert camera.parallel_scale == pytest.approx(0.01)


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_zoom_of_the_camera_by_no_factor_above_0_is_refused(factor):
    with refused(UsageError, "factor", "above"):
        zoom_camera(PARALLEL, factor)


@BOTH
def test_turn_of_the_camera_by_the_height_of_the_picture_is_half_a_turn_at_its_distance(camera):
    turned = turn_camera(camera, dx=1.0, dy=0.0)

    assert turned.basis().forward == pytest.approx(-camera.basis().forward)
    assert turned.distance == pytest.approx(camera.distance)


@BOTH
@pytest.mark.parametrize(("dx", "dy"), [(0.05, 0.0), (0.0, 0.05)], ids=["to the right", "down"])
def test_turn_of_the_camera_moves_the_front_of_an_object_with_the_pointer(camera, dx, dy):
    front = np.array(camera.focal_point) - 40.0 * camera.basis().forward

    moved = pixel_of(turn_camera(camera, dx=dx, dy=dy), front) - pixel_of(camera, front)

    along, across = (0, 1) if dx else (1, 0)
    assert moved[along] > 1.0  # pixels
    assert moved[across] == pytest.approx(0.0, abs=1e-6)


@BOTH
def test_turn_of_the_camera_and_back_is_where_it_was(camera):
    back = turn_camera(turn_camera(camera, dx=0.3, dy=0.0), dx=-0.3, dy=0.0)
    assert back.position == pytest.approx(camera.position)


@BOTH
def test_roll_of_the_camera_turns_the_picture_clockwise(camera):
    right, up, _ = camera.basis()
    top = np.array(camera.focal_point) + 20.0 * up
    rolled = roll_camera(camera, 90.0)
    assert pixel_of(rolled, top)[0] > pixel_of(rolled, camera.focal_point)[0] + 1.0


@BOTH
def test_camera_of_a_pixel_looks_along_its_ray(camera):
    origins, directions = camera.rays(SIZE)
    for x, y in ((0, 0), (SIZE[0] - 1, SIZE[1] - 1), (200, 30)):
        one = pixel_camera(camera, SIZE, x=x + 0.5, y=y + 0.5)
        origin, direction = (each[0, 0] for each in one.rays((1, 1)))
        assert origin == pytest.approx(origins[y, x], abs=1e-6)
        assert direction == pytest.approx(directions[y, x], abs=1e-9)
