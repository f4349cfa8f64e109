"""The affine: composed, applied, inverted, and what is read off it."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry import (
    Volume,
    apply_affine,
    column_spacing,
    compose_affine,
    frame_from_lps,
    is_left_handed,
    lps_affine_from_ras,
    normal_matrix,
    signed_tilt,
    slice_normal,
    tilt_degrees,
)
from clrecon.geometry.affine import checked_affine
from clrecon.geometry.vertices import largest_coordinate

ROW = np.array([0.8, 0.6, 0.0])
COLUMN = np.array([-0.36, 0.48, 0.8])


def test_compose_places_columns_rows_and_slices():
    affine = compose_affine(ROW * 0.5, COLUMN * 0.7, (0.0, 0.3, 2.5), (-10.0, 20.0, 30.0))
    mapped = apply_affine(affine, [(0, 0, 0), (2, 0, 0), (0, 2, 0), (0, 0, 2)])
    assert np.allclose(mapped[0], (-10, 20, 30))
    assert np.allclose(mapped[1] - mapped[0], ROW)
    assert np.allclose(mapped[2] - mapped[0], COLUMN * 1.4)
    assert np.allclose(mapped[3] - mapped[0], (0, 0.6, 5.0))
    assert column_spacing(affine) == pytest.approx((0.5, 0.7, np.hypot(0.3, 2.5)))


@pytest.mark.parametrize("towards", [1.0, -1.0], ids=["to the head", "to the feet"])
@pytest.mark.parametrize("prone", [False, True])
@pytest.mark.parametrize("tilt", [0.0, 3.0, -20.0])
def test_tilt_is_positive_where_the_front_edge_is_nearer_the_head(tilt, prone, towards):
    angle = np.radians(tilt)
    turned = -1.0 if prone else 1.0
    row = np.array([turned, 0.0, 0.0])
    back = np.array([0.0, np.cos(angle), -np.sin(angle)])  # the back edge of a slice lies lower
    affine = compose_affine(row, turned * back, (0.0, 0.0, towards * 2.0), (0.0, 0.0, 0.0))
    assert signed_tilt(affine) == pytest.approx(tilt, abs=1e-9)
    assert tilt_degrees(affine) == pytest.approx(abs(tilt), abs=1e-9)


def test_the_tilt_of_coronal_slices_has_no_sign():
    for lean in (0.5, -0.5):
        affine = compose_affine((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 2.0, lean), (0.0, 0.0, 0.0))
        assert signed_tilt(affine) == tilt_degrees(affine) > 14.0


@pytest.mark.parametrize("tilt", [0.0, 1.0, 12.0, -20.0])
def test_tilt_is_the_angle_between_step_and_normal(tilt):
    angle = np.radians(tilt)
    affine = compose_affine((0.5, 0, 0), (0, 0.7 * np.cos(angle), 0.7 * np.sin(angle)), (0, 0, 1.25), (1, 2, 3))
    assert tilt_degrees(affine) == pytest.approx(abs(tilt), abs=1e-9)
    assert np.allclose(slice_normal(affine), (0, -np.sin(angle), np.cos(angle)))


def test_handedness_follows_the_determinant():
    affine = compose_affine(ROW, COLUMN, np.cross(ROW, COLUMN), (0, 0, 0))
    assert not is_left_handed(affine)
    assert is_left_handed(affine @ np.diag((1.0, 1.0, -1.0, 1.0)))


def test_normal_matrix_keeps_normals_perpendicular_under_shear():
    affine = compose_affine((0.7, 0, 0), (0, 0.5, 0.1), (0.2, -0.4, 2.5), (0, 0, 0))
    tangents = np.array([(1.0, 2.0, 0.0), (0.0, 1.0, -3.0)])
    index_normal = np.cross(*tangents)
    normal = normal_matrix(affine) @ index_normal
    assert np.allclose(tangents @ affine[:3, :3].T @ normal, 0.0, atol=1e-12)


def test_ras_negates_x_and_y_and_is_a_rotation():
    rotation = frame_from_lps("ras")
    assert np.array_equal(rotation @ (1.0, 2.0, 3.0), (-1.0, -2.0, 3.0))
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    with refused(UsageError, "mri"):
        frame_from_lps("mri")


def test_an_affine_to_ras_has_its_first_two_rows_negated():
    affine = np.arange(1.0, 17.0).reshape(4, 4)
    signs = np.array([[-1.0], [-1.0], [1.0], [1.0]])
    assert np.array_equal(lps_affine_from_ras(affine.tolist()), affine * signs)


@pytest.mark.parametrize(
    ("affine", "says"),
    [
        (np.eye(3), "4x4"),
        (np.diag((1.0, 1.0, np.nan, 1.0)), "NaN"),
        (np.diag((1.0, 1.0, 0.0, 1.0)), "singular"),
        (np.array([[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), "singular"),
        (np.eye(4) * 2.0, "last row"),
    ],
)
def test_what_is_no_affine_is_refused(affine, says):
    with pytest.raises(UsageError, match=says):
        checked_affine(affine)


def test_three_steps_span_space_down_to_a_millionth():
    affine = np.eye(4)
    affine[0, 2], affine[2, 2] = 1.0, 1.01e-6
    assert np.array_equal(checked_affine(affine), affine)
    affine[2, 2] = 0.99e-6
    with refused(UsageError, "affine", "singular"):
        checked_affine(affine)


@pytest.mark.parametrize("points", [(1.0, 2.0), [(1.0, 2.0)], [[(1.0, 2.0, 3.0)]], 1.0])
def test_points_must_come_as_n_by_3(points):
    volume = Volume(np.zeros((2, 3, 4), np.int16), np.eye(4))
    with refused(UsageError, 3):
        volume.ijk_to_lps(points)


@pytest.mark.parametrize("border", [0, 1, 2])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_largest_coordinate_is_that_of_the_outermost_layer(axis, border, side):
    affine = np.diag((side * 2.0, side * 4.0, side * 8.0, 1.0))
    affine[axis, 3] = -1000.0  # the other coordinates are small
    first, last = -border, (4, 3, 2)[axis] - 1 + border
    ends = [-1000.0 + side * (2.0, 4.0, 8.0)[axis] * n for n in (first, last)]
    assert largest_coordinate(Volume(np.zeros((2, 3, 4), np.int16), affine), border=border) == max(np.abs(ends))
