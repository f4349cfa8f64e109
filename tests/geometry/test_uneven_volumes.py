"""Volumes whose slices lie at places of their own: the map to millimetres and back, and gradients under it."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from uneven_volume import IN_PLANE, positions, uneven

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import layer_normal_matrices, slice_normal_matrices


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_every_voxel_lies_at_its_slice(sign):
    volume = uneven(sign=sign)
    i, j, k = (axis.ravel() for axis in np.mgrid[:4, :5, :6])
    points = volume.ijk_to_lps(np.stack([i, j, k], axis=1))
    truth = positions(sign)[k] + np.stack([i, j], axis=1) @ IN_PLANE.T
    assert np.abs(points - truth).max() <= tolerances.FLOAT64_PLACE_MM


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_map_is_linear_in_each_layer_and_has_an_inverse(sign):
    volume = uneven(sign=sign)
    ijk = np.random.default_rng(5).uniform((-2, -2, -2), (6, 7, 8), (400, 3))
    lps = volume.ijk_to_lps(ijk)
    assert np.abs(volume.lps_to_ijk(lps) - ijk).max() <= tolerances.FLOAT64_PLACE_MM
    layer = np.clip(np.floor(ijk[:, 2]).astype(int), 0, 4)
    low, high = (volume.ijk_to_lps(np.column_stack([ijk[:, :2], layer + end])) for end in (0, 1))
    part = (ijk[:, 2] - layer)[:, None]
    assert np.abs(low + part * (high - low) - lps).max() <= tolerances.FLOAT64_PLACE_MM


def test_steps_of_the_ends_go_on_beyond_an_uneven_stack():
    volume = uneven()
    origins = volume.slice_origins(border=2)
    steps = np.diff(origins, axis=0)
    assert origins[2:-2] == pytest.approx(positions())
    assert steps[:2] == pytest.approx(np.tile(steps[2], (2, 1)))
    assert steps[-2:] == pytest.approx(np.tile(steps[-3], (2, 1)))


def test_gradients_of_a_linear_field_come_out_exact():
    slope = np.array([3.0, -2.0, 5.0])
    volume = uneven()
    values = volume.slice_origins(border=1) @ slope
    at_samples, in_layers = slice_normal_matrices(volume, 0), layer_normal_matrices(volume, 0)
    in_plane = IN_PLANE.T @ slope
    for k in range(6):
        before, here, after = values[k : k + 3]
        assert at_samples[k] @ (*in_plane, (after - before) / 2) == pytest.approx(slope)
        assert in_layers[k] @ (*in_plane, after - here) == pytest.approx(slope)


def test_even_positions_are_the_affine():
    affine = np.array([[0.5, 0.1, 0.0, -30.0], [0.0, 0.7, -0.4, 20.0], [0.1, 0.0, 1.25, 5.0], [0, 0, 0, 1]])
    even = Volume(np.zeros((6, 5, 4), np.int16), affine)
    table = Volume(np.zeros((6, 5, 4), np.int16), affine, slice_positions=even.slice_origins())
    ijk = np.random.default_rng(8).uniform(-3, 9, (50, 3))
    assert table.ijk_to_lps(ijk) == pytest.approx(even.ijk_to_lps(ijk))
    assert table.lps_to_ijk(even.ijk_to_lps(ijk)) == pytest.approx(ijk)
    assert slice_normal_matrices(table, 1) == pytest.approx(slice_normal_matrices(even, 1))
    assert even.uneven is False and table.uneven is True


def test_volume_with_other_voxels_keeps_places_and_warnings():
    volume = uneven()
    volume.report["warnings"].append("kept")
    other = volume.with_voxels(np.full((6, 5, 4), 7.5, np.float32))
    assert other.ijk_to_lps([(1, 2, 3.5)]) == pytest.approx(volume.ijk_to_lps([(1, 2, 3.5)]))
    assert other.uneven and other.voxels.max() == 7.5 and other.report["warnings"] == ["kept"]
    other.report["warnings"].append("its own")
    assert volume.report["warnings"] == ["kept"]
    with refused(UsageError, "shape", 6, 5):
        volume.with_voxels(np.zeros((6, 5, 3)))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda table: table[:-1], "5 slice positions for 6 slices"),
        (lambda table: table[[0, 2, 1, 3, 4, 5]], "from slice 1 to 2"),
        (lambda table: table[::-1], "advance"),
        (lambda table: np.where(np.arange(6)[:, None] == 2, np.nan, table), "NaN"),
    ],
)
def test_what_is_no_stack_is_refused(change, says):
    affine = uneven().affine
    with pytest.raises(UsageError, match=says):
        Volume(np.zeros((6, 5, 4), np.int16), affine, slice_positions=change(positions()))


def test_a_volume_says_that_its_slices_are_uneven():
    assert repr(uneven()) == "Volume(4 x 5 x 6 int16, spacing 0.5 x 0.7 x 1.822 mm, uneven slices)"
    assert repr(Volume(np.zeros((2, 3, 4), np.uint8), np.eye(4))) == "Volume(4 x 3 x 2 uint8, spacing 1 x 1 x 1 mm)"


@pytest.mark.filterwarnings("error")
def test_a_point_that_is_not_finite_has_no_place():
    volume = Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), None, [(0, 0, z) for z in (0.0, 1.0, 2.5, 3.0)])
    places = volume.lps_to_ijk([[np.nan, 0, 0], [0, 0, np.inf], [1, 2, 2.5]])
    assert not np.isfinite(places[:2]).all(axis=1).any() and places[2].tolist() == [1.0, 2.0, 2.0]
