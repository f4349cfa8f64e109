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


def volume_from(x_mm: float) -> Volume:
    """3 x 3 x 3 voxels of 1 mm; with a layer around them they reach from x_mm - 1 to x_mm + 3."""
    affine = np.eye(4)
    affine[0, 3] = x_mm
    return Volume(np.zeros((3, 3, 3), np.int16), affine)


NEAR, FAR = [4092.75, -4094.75], [4093.0, -4095.0]
"""Where volumes begin that reach to 4095.75 mm from the origin, and to 4096 mm."""

FAR_WARNING = (
    "the volume reaches 4096 mm from the origin, where float32 comes in steps of 0.00049 mm: vertices are float64"
)


@pytest.mark.parametrize("x_mm", NEAR + FAR)
def test_the_largest_coordinate_of_a_volume_is_that_of_the_layer_around_it(x_mm):
    assert largest_coordinate(volume_from(x_mm)) == max(abs(x_mm - 1.0), abs(x_mm + 3.0))


@pytest.mark.parametrize("x_mm", NEAR)
def test_vertices_of_a_volume_within_4096_mm_count_from_the_origin_without_a_warning(x_mm):
    assert find_vertex_origin(volume_from(x_mm)) is None
    assert warnings_of_far(volume_from(x_mm)) == []


@pytest.mark.parametrize("x_mm", FAR)
def test_vertices_of_a_volume_from_4096_mm_on_count_from_its_centre_with_a_warning(x_mm):
    origin = find_vertex_origin(volume_from(x_mm))
    assert origin is not None
    assert origin.tolist() == [x_mm + 1.0, 1.0, 1.0]
    assert warnings_of_far(volume_from(x_mm)) == [FAR_WARNING]


@pytest.mark.parametrize(("y", "far"), [(4096.0, True), (-4096.0, True), (4095.5, False), (-4095.5, False)])
def test_points_are_far_from_4096_mm_on_either_side(y, far):
    assert is_far(np.array([[0.0, y, 0.0]])) == far


def test_no_points_are_not_far():
    assert not is_far(np.empty((0, 3)))


@pytest.mark.parametrize(("mm", "step"), [(1.0, 2.0**-23), (2.0, 2.0**-22), (3.5, 2.0**-22), (4096.0, 2.0**-11)])
def test_the_step_of_float32_doubles_with_the_power_of_two(mm, step):
    assert float32_step(mm) == step


def test_lps_is_the_frame_itself():
    assert np.array_equal(frame_from_lps("LPS"), np.eye(3))


@pytest.mark.parametrize("name", ["abc", "lpt", "xyz"])
def test_frames_of_other_letters_are_refused(name):
    with refused(UsageError, name):
        frame_from_lps(name)


@pytest.mark.parametrize("factor", [1.0, 1.5])
@pytest.mark.parametrize(
    ("exponent", "scale"),
    [(126, -126), (125, -126), (124, -125), (0, -1), (-1, 0), (-127, 126), (-128, 126), (-149, 126)],
)
def test_a_value_is_scaled_below_one_by_a_power_of_two_that_is_a_normal_number_of_float32(
    exponent: int, scale: int, factor: float
) -> None:
    """Normal powers of two reach from 2^-126 to 2^127."""
    assert power_of_two_over(factor * 2.0**exponent) == 2.0**scale
