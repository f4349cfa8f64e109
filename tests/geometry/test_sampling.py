"""HU at points, and volumes on other grids: against sums over corners, linear fields and scipy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from refusals import refused
from scipy import ndimage

import clrecon
from clrecon.errors import UsageError

TILTED = np.array([[0.7, 0.02, 0.01, 1.0], [0.0, 0.7, 0.3, 2.0], [0.1, 0.0, 1.1, 3.0], [0.0, 0.0, 0.0, 1.0]])
MIRRORED = TILTED @ np.diag([-1.0, 1.0, 1.0, 1.0])


def make_volume(affine=TILTED, dtype=np.int16, shape=(12, 15, 18), uneven=False):
    voxels = np.random.default_rng(1).integers(-1000, 1500, shape).astype(dtype)
    if not uneven:
        return clrecon.Volume(voxels, affine)
    gaps = np.random.default_rng(2).uniform(0.6, 1.9, shape[0] - 1)
    along = np.concatenate([[0.0], np.cumsum(gaps)])
    return clrecon.Volume(voxels, affine, slice_positions=affine[:3, 3] + along[:, None] * affine[:3, 2])


VOLUMES = {"tilted": make_volume(), "mirrored": make_volume(MIRRORED, np.float32), "uneven": make_volume(uneven=True)}


def sum_of_corners(volume, ijk):
    low = np.floor(ijk).astype(int)
    part = ijk - low
    total = 0.0
    for corner in itertools.product((0, 1), repeat=3):
        i, j, k = low + corner
        total += np.prod(np.where(corner, part, 1.0 - part)) * float(volume.voxels[k, j, i])
    return total


@pytest.mark.parametrize("name", VOLUMES)
def test_linear_samples_are_sums_over_the_corners_of_their_cell(name):
    volume = VOLUMES[name]
    ijk = np.random.default_rng(3).uniform(0.0, np.array(volume.shape_ijk) - 1.001, (100, 3))
    expected = [sum_of_corners(volume, place) for place in ijk]
    assert volume.sample(volume.ijk_to_lps(ijk)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", VOLUMES)
def test_voxel_centres_have_their_voxels(name):
    volume = VOLUMES[name]
    k, j, i = np.indices(volume.shape)
    points = volume.ijk_to_lps(np.column_stack([i.ravel(), j.ravel(), k.ravel()]))
    for order in (0, 1):
        assert volume.sample(points, order=order) == pytest.approx(volume.voxels.ravel(), abs=1e-6)


def test_a_point_takes_the_nearest_voxel():
    volume = VOLUMES["tilted"]
    assert volume.sample(volume.ijk_to_lps((4.4, 6.6, 2.4)), order=0) == volume.voxels[2, 7, 4]


def test_a_spline_of_a_few_points_is_that_of_the_whole_volume():
    volume = make_volume(shape=(60, 70, 80))
    ijk = np.random.default_rng(4).uniform(30.0, 33.0, (50, 3))
    whole = ndimage.map_coordinates(volume.voxels.astype(float), ijk[:, ::-1].T, order=3, mode="nearest")
    assert volume.sample(volume.ijk_to_lps(ijk), order=3) == pytest.approx(whole, abs=1e-5)


def test_samples_beyond_half_a_voxel_are_outside():
    volume = VOLUMES["tilted"]
    places = [(-0.49, 3, 3), (-0.51, 3, 3), (3, 3, 11.49), (3, 3, 11.51), (np.nan, 0, 0), (np.inf, 0, 0)]
    with np.errstate(invalid="ignore"):
        points = volume.ijk_to_lps(places)
    found = volume.sample(points, outside=-7.0)
    assert (found == -7.0).tolist() == [False, True, False, True, True, True]
    assert found[[0, 2]] == pytest.approx([volume.voxels[3, 3, 0], volume.voxels[11, 3, 3]])
    assert np.isnan(volume.sample((1e6, 0.0, 0.0)))


def test_one_point_is_as_good_as_many():
    volume = VOLUMES["uneven"]
    place = volume.ijk_to_lps((3.5, 2.25, 4.75))
    assert place.shape == (3,) and volume.lps_to_ijk(place) == pytest.approx((3.5, 2.25, 4.75))
    value = volume.sample(place)
    assert np.ndim(value) == 0 and value == volume.sample([place])[0]


@pytest.mark.parametrize("points", ["abc", [1, 2], [[1, 2], [3]], 5, None, [[1, 2, 3, 4]]])
def test_what_is_no_point_is_refused(points):
    with refused(UsageError, "points"):
        VOLUMES["tilted"].sample(points)


def test_sampling_of_another_order_is_refused():
    with refused(UsageError, 0, 1, 3):
        VOLUMES["tilted"].sample((0, 0, 0), order=2)


@pytest.mark.parametrize("name", VOLUMES)
@pytest.mark.parametrize("target", [make_volume(np.diag([0.6, 0.9, 2.0, 1.0]), shape=(9, 14, 21)), VOLUMES["uneven"]])
def test_on_the_grid_of_another_volume_values_are_those_at_its_centres(name, target):
    volume = VOLUMES[name]
    made = volume.resample(target)
    k, j, i = np.indices(target.shape)
    points = target.ijk_to_lps(np.column_stack([i.ravel(), j.ravel(), k.ravel()]))
    expected = volume.sample(points, outside=-1024.0)
    tolerance = 0.51 if volume.dtype.kind == "i" else 1e-3  # whole numbers are rounded
    assert made.voxels.ravel() == pytest.approx(expected, abs=tolerance)
    assert made.uneven == target.uneven and np.array_equal(made.slice_origins(), target.slice_origins())
    assert made.dtype == volume.dtype and made.report["warnings"][-1].endswith("to the voxels of another volume")


def test_three_steps_are_those_of_the_axes():
    made = VOLUMES["uneven"].resample((0.5, 0.75, 2.0))
    assert made.spacing == pytest.approx((0.5, 0.75, 2.0)) and not made.uneven
    assert made.report["resampled"] == {"method": "trilinear", "step_mm": [0.5, 0.75, 2.0]}


def test_volumes_that_lie_apart_and_other_numbers_of_steps_are_refused():
    volume = VOLUMES["tilted"]
    away = clrecon.Volume(volume.voxels, TILTED + [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 900.0], [0, 0, 0, 0]])
    with refused(UsageError, "z", "mm"):
        volume.resample(away)
    with refused(UsageError, "i", "j", "k", 2):
        volume.resample((1.0, 1.0))
