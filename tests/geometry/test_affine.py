"""The affine: composed, applied, inverted, and what is read off it."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
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


@pytest.fixture
def composed():
    """Columns 0.5 mm apart along a row, rows 0.7 mm apart along a column, slices by (0, 0.3, 2.5) mm."""
    return compose_affine(ROW * 0.5, COLUMN * 0.7, k_step=(0.0, 0.3, 2.5), origin=(-10.0, 20.0, 30.0))


def test_a_composed_affine_places_the_origin_columns_rows_and_slices(composed):
    origin, column_2, row_2, slice_2 = apply_affine(composed, [(0, 0, 0), (2, 0, 0), (0, 2, 0), (0, 0, 2)])
    assert np.allclose(origin, (-10, 20, 30))
    assert np.allclose(column_2 - origin, 2 * 0.5 * ROW)
    assert np.allclose(row_2 - origin, 2 * 0.7 * COLUMN)
    assert np.allclose(slice_2 - origin, (0, 2 * 0.3, 2 * 2.5))


def test_spacing_is_the_length_of_the_columns_of_an_affine(composed):
    assert column_spacing(composed) == pytest.approx((0.5, 0.7, np.hypot(0.3, 2.5)))


@pytest.mark.parametrize("towards", [1.0, -1.0], ids=["to the head", "to the feet"])
@pytest.mark.parametrize("prone", [False, True], ids=["supine", "prone"])
@pytest.mark.parametrize("tilt", [0.0, 3.0, -20.0])
def test_tilt_is_positive_where_the_front_edge_is_nearer_the_head(tilt, prone, towards):
    angle = np.radians(tilt)
    turned = -1.0 if prone else 1.0
    row = np.array([turned, 0.0, 0.0])
    back = np.array([0.0, np.cos(angle), -np.sin(angle)])  # the back edge of a slice lies lower
    affine = compose_affine(row, turned * back, k_step=(0.0, 0.0, towards * 2.0), origin=(0.0, 0.0, 0.0))
    assert signed_tilt(affine) == pytest.approx(tilt, abs=1e-9)


@pytest.mark.parametrize("lean", [0.5, -0.5])
def test_the_tilt_of_coronal_slices_has_no_sign(lean):
    row, column = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
    affine = compose_affine(row, column, k_step=(0.0, 2.0, lean), origin=(0.0, 0.0, 0.0))
    assert signed_tilt(affine) == pytest.approx(np.degrees(np.arctan2(0.5, 2.0)))


TILTS = pytest.mark.parametrize("tilt", [0.0, 1.0, 12.0, -20.0])


def tilted_affine(tilt: float) -> np.ndarray:
    """Slices turned about x by so many degrees, stacked along z."""
    angle = np.radians(tilt)
    column = np.array([0, np.cos(angle), np.sin(angle)])
    return compose_affine((0.5, 0, 0), 0.7 * column, k_step=(0, 0, 1.25), origin=(1, 2, 3))


@TILTS
def test_tilt_is_the_angle_between_slice_step_and_slice_normal(tilt):
    assert tilt_degrees(tilted_affine(tilt)) == pytest.approx(abs(tilt), abs=1e-9)


@TILTS
def test_the_normal_of_tilted_slices_is_turned_by_the_tilt(tilt):
    angle = np.radians(tilt)
    assert np.allclose(slice_normal(tilted_affine(tilt)), (0, -np.sin(angle), np.cos(angle)))


def test_an_affine_is_left_handed_once_one_axis_is_turned_round():
    right_handed = compose_affine(ROW, COLUMN, k_step=np.cross(ROW, COLUMN), origin=(0, 0, 0))
    assert not is_left_handed(right_handed)
    assert is_left_handed(right_handed @ np.diag((1.0, 1.0, -1.0, 1.0)))


def test_normal_matrix_keeps_normals_perpendicular_under_shear():
    sheared = compose_affine((0.7, 0, 0), (0, 0.5, 0.1), k_step=(0.2, -0.4, 2.5), origin=(0, 0, 0))
    tangents_ijk = np.array([(1.0, 2.0, 0.0), (0.0, 1.0, -3.0)])
    tangents_mm = tangents_ijk @ sheared[:3, :3].T
    normal = normal_matrix(sheared) @ np.cross(*tangents_ijk)
    assert np.allclose(tangents_mm @ normal, 0.0, atol=tolerances.FLOAT64_SHARE)


def test_ras_negates_x_and_y_and_is_a_rotation():
    rotation = frame_from_lps("ras")
    assert np.array_equal(rotation @ (1.0, 2.0, 3.0), (-1.0, -2.0, 3.0))
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_an_unknown_frame_is_refused():
    with refused(UsageError, "mri"):
        frame_from_lps("mri")


def test_an_affine_to_ras_has_its_first_two_rows_negated():
    affine = np.arange(1.0, 17.0).reshape(4, 4)
    signs = np.array([[-1.0], [-1.0], [1.0], [1.0]])
    assert np.array_equal(lps_affine_from_ras(affine.tolist()), affine * signs)


@pytest.mark.parametrize(
    ("affine", "words"),
    [
        (np.eye(3), "4x4"),
        (np.diag((1.0, 1.0, np.nan, 1.0)), "NaN"),
        (np.diag((1.0, 1.0, 0.0, 1.0)), "singular"),
        (np.array([[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), "singular"),
        (np.eye(4) * 2.0, "last row"),
    ],
    ids=["3x3", "NaN", "no slice step", "two equal steps", "last row of 2"],
)
def test_a_matrix_that_places_no_voxels_is_refused(affine, words):
    with pytest.raises(UsageError, match=words):
        checked_affine(affine)


def affine_with_a_flat_step(height: float) -> np.ndarray:
    """The slice step lies along a row but for a height of so much of its length."""
    affine = np.eye(4)
    affine[0, 2] = 1.0
    affine[2, 2] = height
    return affine


def test_three_steps_whose_volume_is_more_than_a_millionth_of_a_box_are_an_affine():
    affine = affine_with_a_flat_step(1.01e-6)
    assert np.array_equal(checked_affine(affine), affine)


def test_three_steps_whose_volume_is_less_than_a_millionth_of_a_box_are_refused():
    with refused(UsageError, "affine", "singular"):
        checked_affine(affine_with_a_flat_step(0.99e-6))


@pytest.mark.parametrize(
    "points", [(1.0, 2.0), [(1.0, 2.0)], [[(1.0, 2.0, 3.0)]], 1.0], ids=["pair", "pairs", "three axes", "number"]
)
def test_points_that_are_not_n_by_3_are_refused(points):
    volume = Volume(np.zeros((2, 3, 4), np.int16), np.eye(4))
    with refused(UsageError, 3):
        volume.ijk_to_lps(points)


@pytest.mark.parametrize("border", [0, 1, 2])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_largest_coordinate_is_that_of_the_outermost_layer(axis, border, side):
    affine = np.diag((side * 2.0, side * 4.0, side * 8.0, 1.0))
    affine[axis, 3] = -1000.0  # the other coordinates are small
    columns_rows_slices = (4, 3, 2)
    first, last = -border, columns_rows_slices[axis] - 1 + border
    ends = [-1000.0 + side * (2.0, 4.0, 8.0)[axis] * n for n in (first, last)]
    assert largest_coordinate(Volume(np.zeros((2, 3, 4), np.int16), affine), border=border) == max(np.abs(ends))
