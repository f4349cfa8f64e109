"""HU at points, and volumes on other grids: against sums over corners, linear fields and scipy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import tolerances
from refusals import refused
from scipy import ndimage

import clrecon
from clrecon.errors import UsageError

TILTED = np.array([[0.7, 0.02, 0.01, 1.0], [0.0, 0.7, 0.3, 2.0], [0.1, 0.0, 1.1, 3.0], [0.0, 0.0, 0.0, 1.0]])
MIRRORED = TILTED @ np.diag([-1.0, 1.0, 1.0, 1.0])

HIGHEST_HU = 1500


def random_volume(affine=TILTED, dtype=np.int16, shape=(12, 15, 18), uneven=False):
    voxels = np.random.default_rng(1).integers(-1000, HIGHEST_HU, shape).astype(dtype)
    if not uneven:
        return clrecon.Volume(voxels, affine)
    gaps = np.random.default_rng(2).uniform(0.6, 1.9, shape[0] - 1)
    along = np.concatenate([[0.0], np.cumsum(gaps)])
    return clrecon.Volume(voxels, affine, slice_positions=affine[:3, 3] + along[:, None] * affine[:3, 2])


VOLUMES = {
    "tilted": random_volume(),
    "mirrored": random_volume(MIRRORED, np.float32),
    "uneven": random_volume(uneven=True),
}
TARGETS = {
    "straight grid": random_volume(np.diag([0.6, 0.9, 2.0, 1.0]), shape=(9, 14, 21)),
    "uneven grid": VOLUMES["uneven"],
}


def interpolate_by_corners(volume, ijk):
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
    expected = [interpolate_by_corners(volume, place) for place in ijk]
    assert volume.sample(volume.ijk_to_lps(ijk)) == pytest.approx(expected, abs=tolerances.TRILINEAR * HIGHEST_HU)


def voxel_centres(volume) -> np.ndarray:
    """LPS points of all voxels, in the order of their array."""
    k, j, i = np.indices(volume.shape)
    return volume.ijk_to_lps(np.column_stack([i.ravel(), j.ravel(), k.ravel()]))


@pytest.mark.parametrize("order", [0, 1], ids=["nearest", "trilinear"])
@pytest.mark.parametrize("name", VOLUMES)
def test_samples_at_voxel_centres_are_the_voxels(name, order):
    volume = VOLUMES[name]
    values = volume.sample(voxel_centres(volume), order=order)
    assert values == pytest.approx(volume.voxels.ravel(), abs=tolerances.TRILINEAR * HIGHEST_HU)


def test_a_point_takes_the_nearest_voxel():
    volume = VOLUMES["tilted"]
    i, j, k = 4, 7, 2
    assert volume.sample(volume.ijk_to_lps((i + 0.4, j - 0.4, k + 0.4)), order=0) == volume.voxels[k, j, i]


def test_a_spline_of_a_few_points_is_that_of_the_whole_volume():
    volume = random_volume(shape=(60, 70, 80))
    ijk = np.random.default_rng(4).uniform(30.0, 33.0, (50, 3))
    whole = ndimage.map_coordinates(volume.voxels.astype(float), ijk[:, ::-1].T, order=3, mode="nearest")
    assert volume.sample(volume.ijk_to_lps(ijk), order=3) == pytest.approx(whole, abs=tolerances.CUT_SPLINE_HU)


@pytest.mark.parametrize(
    "ijk",
    [(-0.51, 3, 3), (3, 3, 11.51), (np.nan, 0, 0), (np.inf, 0, 0)],
    ids=["before i = 0", "beyond k = 11", "NaN", "infinity"],
)
def test_samples_beyond_half_a_voxel_or_at_no_place_have_the_given_value(ijk):
    volume = VOLUMES["tilted"]
    with np.errstate(invalid="ignore"):
        point = volume.ijk_to_lps(ijk)
    assert volume.sample(point, outside=-7.0) == -7.0


@pytest.mark.parametrize(
    ("ijk", "kji"), [((-0.49, 3, 3), (3, 3, 0)), ((3, 3, 11.49), (11, 3, 3))], ids=["before i = 0", "beyond k = 11"]
)
def test_samples_within_half_a_voxel_beyond_the_last_centre_have_its_value(ijk, kji):
    volume = VOLUMES["tilted"]
    assert volume.sample(volume.ijk_to_lps(ijk), outside=-7.0) == pytest.approx(volume.voxels[kji])


def test_samples_outside_are_nan_where_no_value_is_given():
    assert np.isnan(VOLUMES["tilted"].sample((1e6, 0.0, 0.0)))


def test_a_single_point_is_mapped_to_a_single_point_and_back():
    volume, ijk = VOLUMES["uneven"], (3.5, 2.25, 4.75)
    point = volume.ijk_to_lps(ijk)
    assert point.shape == (3,)
    assert volume.lps_to_ijk(point) == pytest.approx(ijk)


def test_the_sample_at_a_single_point_is_the_number_of_a_list_of_one():
    volume = VOLUMES["uneven"]
    point = volume.ijk_to_lps((3.5, 2.25, 4.75))
    value = volume.sample(point)
    assert np.ndim(value) == 0
    assert value == volume.sample([point])[0]


@pytest.mark.parametrize(
    "points",
    ["abc", [1, 2], [[1, 2], [3]], 5, None, [[1, 2, 3, 4]]],
    ids=["text", "pair", "ragged", "number", "None", "four numbers"],
)
def test_sampling_at_what_are_no_points_is_refused(points):
    with refused(UsageError, "points"):
        VOLUMES["tilted"].sample(points)


def test_sampling_of_another_order_is_refused():
    with refused(UsageError, 0, 1, 3):
        VOLUMES["tilted"].sample((0, 0, 0), order=2)


@pytest.mark.parametrize("name", VOLUMES)
@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_a_volume_on_the_grid_of_another_has_the_values_at_its_centres(name, target):
    volume = VOLUMES[name]
    expected = volume.sample(voxel_centres(target), outside=-1024.0)
    rounding = tolerances.FILTER_ROUNDED_HU if volume.dtype.kind == "i" else tolerances.RESAMPLED_RAMP_HU
    assert volume.resample(target).voxels.ravel() == pytest.approx(expected, abs=rounding)


@pytest.mark.parametrize("name", VOLUMES)
@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_a_volume_on_the_grid_of_another_has_its_slices_and_keeps_its_type(name, target):
    volume = VOLUMES[name]
    resampled = volume.resample(target)
    assert resampled.uneven == target.uneven
    assert np.array_equal(resampled.slice_origins(), target.slice_origins())
    assert resampled.dtype == volume.dtype
    assert resampled.report["warnings"][-1].endswith("to the voxels of another volume")


def test_a_volume_resampled_with_three_steps_has_them_along_its_axes_and_in_its_report():
    resampled = VOLUMES["uneven"].resample((0.5, 0.75, 2.0))
    assert resampled.spacing == pytest.approx((0.5, 0.75, 2.0))
    assert not resampled.uneven
    assert resampled.report["resampled"] == {"method": "trilinear", "step_mm": [0.5, 0.75, 2.0]}


def test_resampling_to_a_volume_that_lies_apart_is_refused():
    volume = VOLUMES["tilted"]
    affine = TILTED.copy()
    affine[2, 3] += 900.0
    with refused(UsageError, "z", "mm"):
        volume.resample(clrecon.Volume(volume.voxels, affine))


def test_resampling_with_two_steps_is_refused():
    with refused(UsageError, "i", "j", "k", 2):
        VOLUMES["tilted"].resample((1.0, 1.0))
