"""What pictures of the lowest values leave out: everything that is not surely inside of the body."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.anatomy.surroundings import LEFT_OUT, count_left_out, leave_out_surroundings
from clrecon.geometry import Volume

SPACING = (2.0, 2.0, 3.0)
AIR, TISSUE, GAS, PLATE = -1000, 40, -950, 200


def make_trunk(dtype: type = np.int16, step: int = 1) -> tuple[Volume, np.ndarray, np.ndarray]:
    """Make a trunk of 60 mm radius on a plate, with a ball of gas of 16 mm radius; also its radii and the gas."""
    k, j, i = np.mgrid[:20, :100, :90].astype(float)
    radius = np.hypot((j - 45.0) * SPACING[1], (i - 44.0) * SPACING[0])
    voxels = np.where(radius <= 60.0, TISSUE, AIR)
    ball = np.sqrt(((k - 10) * SPACING[2]) ** 2 + ((j - 40) * SPACING[1]) ** 2 + ((i - 50) * SPACING[0]) ** 2) <= 16.0
    voxels[ball] = GAS
    voxels[:, 80:83, 10:80] = PLATE
    affine = np.diag([*SPACING, 1.0])
    return Volume((voxels * step).astype(dtype), affine), radius, ball


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32])
def test_air_around_a_trunk_the_plate_and_the_edge_of_the_skin_are_left_out(dtype: type) -> None:
    volume, radius, _ = make_trunk(dtype)  # skin at 60 mm, a plate in the rows 80 to 82
    out = leave_out_surroundings(volume).voxels > PLATE
    edge_of_the_skin = (radius > 58.0) & (radius <= 60.0)  # which real scans mix with the air outside
    assert out[radius > 60.0].all()
    assert out[:, 80:83].all()
    assert out[edge_of_the_skin].all()


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32])
def test_tissue_and_gas_inside_of_a_trunk_are_not_left_out(dtype: type) -> None:
    volume, radius, gas = make_trunk(dtype)
    out = leave_out_surroundings(volume).voxels > PLATE
    assert not out[radius < 50.0].any()  # mm: the skin is left out down to 55.6 mm, measured; 3 mm and whole cells
    assert not out[gas].any()


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32])
def test_voxels_left_out_lie_far_above_the_highest_value_and_the_rest_stays(dtype: type) -> None:
    volume, _, _ = make_trunk(dtype)
    changed = leave_out_surroundings(volume).voxels
    out = changed > PLATE
    assert changed.dtype == dtype
    assert changed[out].min() >= PLATE + 2 * (PLATE - AIR)
    assert np.array_equal(changed[~out], volume.voxels[~out])


def test_report_counts_the_voxels_left_out_beside_a_body_and_has_the_highest_value() -> None:
    changed = leave_out_surroundings(make_trunk(np.int16)[0])
    out = changed.voxels > PLATE
    assert changed.report[LEFT_OUT]["highest_hu"] == PLATE
    expected = {"voxels": int(out.sum()), "share": round(float(out.mean()), 4), "body": True, "region": False}
    assert count_left_out(changed) == expected


def test_integers_without_room_above_their_values_become_floats_of_the_same_values() -> None:
    volume, _, _ = make_trunk(np.int16, step=30)  # up to 6,000 from -30,000: twice that range does not fit int16
    changed = leave_out_surroundings(volume)
    assert changed.voxels.dtype == np.float32
    stays = changed.voxels <= 30 * PLATE
    assert stays.any()
    assert np.array_equal(changed.voxels[stays], volume.voxels[stays].astype(np.float32))


def test_padding_beside_a_body_that_fills_the_slices_is_left_out() -> None:
    """Corners of one value are not measured, whatever lies beside them."""
    tissue_hu, padding_hu = 30, -3024
    voxels = np.full((6, 60, 60), tissue_hu, np.int16)
    j, i = np.mgrid[:60, :60]
    corner = np.hypot(j - 29.5, i - 29.5) > 34.0
    voxels[:, corner] = padding_hu
    out = leave_out_surroundings(Volume(voxels, np.diag([3.0, 3.0, 3.0, 1.0]))).voxels > tissue_hu
    assert out[:, corner].all()
    assert not out[:, 20:40, 20:40].any()  # the middle of the body


def test_nothing_of_a_scan_without_a_body_is_left_out_and_its_report_counts_none() -> None:
    volume = Volume(np.full((8, 40, 40), AIR, np.int16), np.diag([2.0, 2.0, 2.0, 1.0]))
    changed = leave_out_surroundings(volume)
    assert np.array_equal(changed.voxels, volume.voxels)
    assert count_left_out(changed) == {"voxels": 0, "share": 0.0, "body": False, "region": False}


def test_a_scan_whose_surroundings_were_not_looked_for_counts_none() -> None:
    assert count_left_out(make_trunk()[0]) is None
