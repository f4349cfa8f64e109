"""Far from the origin of the frame: where it begins, what is said, and from where vertices are counted."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry import Volume, frame_from_lps
from clrecon.geometry.vertices import (
    find_vertex_origin,
    float32_step,
    is_far,
    largest_coordinate,
    power_of_two_over,
    warnings_of_far,
)


def volume_from(x: float) -> Volume:
    """3 x 3 x 3 voxels of 1 mm; with a layer around them they reach from x - 1 to x + 3."""
    affine = np.eye(4)
    affine[0, 3] = x
    return Volume(np.zeros((3, 3, 3), np.int16), affine)


@pytest.mark.parametrize(("x", "far"), [(4092.75, False), (4093.0, True), (-4094.75, False), (-4095.0, True)])
def test_far_begins_at_4096_mm(x, far):
    volume = volume_from(x)
    assert largest_coordinate(volume) == max(abs(x - 1.0), abs(x + 3.0))
    words = [
        "the volume reaches 4096 mm from the origin, where float32 comes in steps of 0.00049 mm: vertices are float64"
    ]
    assert warnings_of_far(volume) == words * far
    origin = find_vertex_origin(volume)
    assert (None if origin is None else origin.tolist()) == ([x + 1.0, 1.0, 1.0] if far else None)


def test_points_are_far_on_either_side():
    for sign in (1.0, -1.0):
        assert is_far(np.array([[0.0, sign * 4096.0, 0.0]])) and not is_far(np.array([[0.0, sign * 4095.5, 0.0]]))
    assert not is_far(np.empty((0, 3)))


def test_the_step_of_float32_doubles_with_the_power_of_two():
    assert [float32_step(mm) for mm in (1.0, 2.0, 3.5, 4096.0)] == [2.0**-23, 2.0**-22, 2.0**-22, 2.0**-11]


def test_lps_is_the_frame_itself():
    assert np.array_equal(frame_from_lps("LPS"), np.eye(3))
    for name in ("abc", "lpt", "xyz"):
        with refused(UsageError, name):
            frame_from_lps(name)


@pytest.mark.parametrize(
    ("exponent", "scale"),
    [(126, -126), (125, -126), (124, -125), (0, -1), (-1, 0), (-127, 126), (-128, 126), (-149, 126)],
)
def test_the_power_of_two_stays_within_the_normal_numbers_of_float32(exponent: int, scale: int) -> None:
    assert power_of_two_over(2.0**exponent) == 2.0**scale
    assert power_of_two_over(1.5 * 2.0**exponent) == 2.0**scale
