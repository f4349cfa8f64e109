"""Volumes whose slices lie at places of their own: the map to millimetres and back, and gradients under it."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from uneven_volume import HEIGHTS, IN_PLANE, positions, uneven

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import layer_normal_matrices, slice_normal_matrices

upwards_and_downwards = pytest.mark.parametrize("sign", [1.0, -1.0], ids=["upwards", "downwards"])


@upwards_and_downwards
def test_every_voxel_lies_in_its_slice_by_rows_and_columns(sign):
    volume = uneven(sign=sign)
    i, j, k = (axis.ravel() for axis in np.mgrid[:4, :5, :6])
    expected = positions(sign=sign)[k] + np.stack([i, j], axis=1) @ IN_PLANE.T
    assert np.abs(volume.ijk_to_lps(np.stack([i, j, k], axis=1)) - expected).max() <= tolerances.FLOAT64_PLACE_MM


def random_ijk() -> np.ndarray:
    """400 places in and up to two voxels around a volume of 4 x 5 x 6."""
    return np.random.default_rng(5).uniform((-2, -2, -2), (6, 7, 8), (400, 3))


@upwards_and_downwards
def test_points_of_uneven_slices_are_mapped_back_to_their_indices(sign):
    volume, ijk = uneven(sign=sign), random_ijk()
    assert np.abs(volume.lps_to_ijk(volume.ijk_to_lps(ijk)) - ijk).max() <= tolerances.FLOAT64_PLACE_MM


@upwards_and_downwards
def test_points_between_two_uneven_slices_lie_on_a_straight_line_from_one_to_the_other(sign):
    volume, ijk = uneven(sign=sign), random_ijk()
    layer = np.clip(np.floor(ijk[:, 2]).astype(int), 0, 4)  # beyond the ends the first and last layer go on
    low, high = (volume.ijk_to_lps(np.column_stack([ijk[:, :2], layer + end])) for end in (0, 1))
    expected = low + (ijk[:, 2] - layer)[:, None] * (high - low)
    assert np.abs(volume.ijk_to_lps(ijk) - expected).max() <= tolerances.FLOAT64_PLACE_MM


def test_steps_of_the_ends_go_on_beyond_an_uneven_stack():
    volume = uneven()
    origins = volume.slice_origins(border=2)
    steps = np.diff(origins, axis=0)
    assert origins[2:-2] == pytest.approx(positions())
    assert steps[:2] == pytest.approx(np.tile(steps[2], (2, 1)))
    assert steps[-2:] == pytest.approx(np.tile(steps[-3], (2, 1)))


SLOPE_A_MM = np.array([3.0, -2.0, 5.0])
"""Of a field that is linear in space."""
of_each_slice = pytest.mark.parametrize("k", range(len(HEIGHTS)))


@of_each_slice
def test_gradients_of_a_linear_field_from_central_differences_are_exact_in_each_slice(k):
    before, _, after = uneven().slice_origins(border=1)[k : k + 3] @ SLOPE_A_MM
    differences = (*(IN_PLANE.T @ SLOPE_A_MM), (after - before) / 2)
    assert slice_normal_matrices(uneven(), border=0)[k] @ differences == pytest.approx(SLOPE_A_MM)


@of_each_slice
def test_gradients_of_a_linear_field_from_one_slice_to_the_next_are_exact_in_each_layer(k):
    here, after = uneven().slice_origins(border=1)[k + 1 : k + 3] @ SLOPE_A_MM
    differences = (*(IN_PLANE.T @ SLOPE_A_MM), after - here)
    assert layer_normal_matrices(uneven(), border=0)[k] @ differences == pytest.approx(SLOPE_A_MM)


@pytest.fixture
def affine_and_positions():
    """The same even slices by an affine alone, and by a table of their positions."""
    affine = np.array([[0.5, 0.1, 0.0, -30.0], [0.0, 0.7, -0.4, 20.0], [0.1, 0.0, 1.25, 5.0], [0, 0, 0, 1]])
    by_affine = Volume(np.zeros((6, 5, 4), np.int16), affine)
    by_positions = Volume(np.zeros((6, 5, 4), np.int16), affine, slice_positions=by_affine.slice_origins())
    return by_affine, by_positions


def test_even_slices_by_their_positions_lie_where_their_affine_puts_them(affine_and_positions):
    by_affine, by_positions = affine_and_positions
    ijk = np.random.default_rng(8).uniform(-3, 9, (50, 3))
    assert by_positions.ijk_to_lps(ijk) == pytest.approx(by_affine.ijk_to_lps(ijk))
    assert by_positions.lps_to_ijk(by_affine.ijk_to_lps(ijk)) == pytest.approx(ijk)


def test_even_slices_by_their_positions_have_the_gradients_of_their_affine(affine_and_positions):
    by_affine, by_positions = affine_and_positions
    expected = slice_normal_matrices(by_affine, border=1)
    assert slice_normal_matrices(by_positions, border=1) == pytest.approx(expected)


def test_a_volume_with_a_table_of_positions_counts_as_uneven(affine_and_positions):
    by_affine, by_positions = affine_and_positions
    assert (by_affine.uneven, by_positions.uneven) == (False, True)


def test_a_volume_with_other_voxels_keeps_its_places():
    volume = uneven()
    other = volume.with_voxels(np.full((6, 5, 4), 7.5, np.float32))
    assert other.uneven
    assert other.ijk_to_lps([(1, 2, 3.5)]) == pytest.approx(volume.ijk_to_lps([(1, 2, 3.5)]))
    assert (other.voxels == 7.5).all()


def test_a_volume_with_other_voxels_has_a_copy_of_the_warnings():
    volume = uneven()
    volume.report["warnings"].append("kept")
    other = volume.with_voxels(np.full((6, 5, 4), 7.5, np.float32))
    assert other.report["warnings"] == ["kept"]
    other.report["warnings"].append("its own")
    assert volume.report["warnings"] == ["kept"]


def test_other_voxels_of_another_shape_are_refused():
    with refused(UsageError, "shape", 6, 5):
        uneven().with_voxels(np.zeros((6, 5, 3)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda table: table[:-1], "5 slice positions for 6 slices"),
        (lambda table: table[[0, 2, 1, 3, 4, 5]], "from slice 1 to 2"),
        (lambda table: table[::-1], "advance"),
        (lambda table: np.where(np.arange(6)[:, None] == 2, np.nan, table), "NaN"),
    ],
    ids=["one missing", "two exchanged", "reversed", "NaN"],
)
def test_positions_that_do_not_advance_slice_by_slice_are_refused(change, words):
    affine = uneven().affine
    with pytest.raises(UsageError, match=words):
        Volume(np.zeros((6, 5, 4), np.int16), affine, slice_positions=change(positions()))


def test_repr_of_an_uneven_volume_has_its_size_type_and_spacing_and_names_uneven_slices():
    volume = uneven(np.zeros((6, 5, 4), np.int16))
    _, _, dk = volume.spacing
    assert repr(volume) == f"Volume(4 x 5 x 6 int16, spacing 0.5 x 0.7 x {dk:.3f} mm, uneven slices)"


def test_repr_of_an_even_volume_has_its_size_type_and_spacing():
    assert repr(Volume(np.zeros((2, 3, 4), np.uint8), np.eye(4))) == "Volume(4 x 3 x 2 uint8, spacing 1 x 1 x 1 mm)"


@pytest.mark.filterwarnings("error")
def test_a_point_that_is_not_finite_has_no_finite_indices_and_changes_no_other():
    volume = Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), slice_positions=[(0, 0, z) for z in (0.0, 1.0, 2.5, 3.0)])
    nan, infinite, finite = volume.lps_to_ijk([[np.nan, 0, 0], [0, 0, np.inf], [1, 2, 2.5]])
    assert not np.isfinite(nan).all()
    assert not np.isfinite(infinite).all()
    assert finite.tolist() == [1.0, 2.0, 2.0]  # slice 2 lies at z = 2.5
