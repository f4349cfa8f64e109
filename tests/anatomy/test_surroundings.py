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
def test_what_is_not_surely_in_the_body_is_left_out(dtype: type) -> None:
    volume, radius, gas = make_trunk(dtype)  # skin at 60 mm, a plate in the rows 80 to 82, a ball of gas
    made = leave_out_surroundings(volume)
    out = made.voxels > PLATE
    assert out[radius > 60.0].all() and out[:, 80:83].all()
    assert not out[radius < 50.0].any() and not out[gas].any()
    rim = (radius > 58.0) & (radius <= 60.0)
    assert out[rim].mean() > 0.97, "the edge of the skin, which real scans mix with the air outside"


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32])
def test_what_is_left_out_lies_far_above_the_highest_value_and_the_rest_stays(dtype: type) -> None:
    volume, _, _ = make_trunk(dtype)
    made = leave_out_surroundings(volume)
    out = made.voxels > PLATE
    assert made.voxels.dtype == dtype
    assert made.voxels[out].min() >= PLATE + 2 * (PLATE - AIR)
    assert np.array_equal(made.voxels[~out], volume.voxels[~out])


def test_report_counts_what_is_left_out_beside_a_body() -> None:
    made = leave_out_surroundings(make_trunk(np.int16)[0])
    out = made.voxels > PLATE
    assert made.report[LEFT_OUT]["highest_hu"] == PLATE and made.report[LEFT_OUT]["body"] is True
    expected = {"voxels": int(out.sum()), "share": round(float(out.mean()), 4), "body": True, "region": False}
    assert count_left_out(made) == expected


def test_types_without_room_above_their_values_become_floats() -> None:
    volume, _, _ = make_trunk(np.int16, 30)  # up to 6,000 from -30,000: twice that does not fit int16
    made = leave_out_surroundings(volume)
    assert made.voxels.dtype == np.float32
    kept = made.voxels <= made.report[LEFT_OUT]["highest_hu"]
    assert np.array_equal(made.voxels[kept], volume.voxels[kept].astype(np.float32))


def test_padding_beside_a_body_that_fills_the_slices_is_left_out() -> None:
    """Corners of one value are not measured, whatever lies beside them."""
    volume, _, _ = make_trunk()
    voxels = np.full((6, 60, 60), 30, np.int16)
    j, i = np.mgrid[:60, :60]
    corner = np.hypot(j - 29.5, i - 29.5) > 34.0
    voxels[:, corner] = -3024
    made = leave_out_surroundings(Volume(voxels, np.diag([3.0, 3.0, 3.0, 1.0])))
    out = made.voxels > 30
    assert out[:, corner].all() and not out[:, 20:40, 20:40].any()


def test_without_a_body_nothing_is_left_out_and_that_is_said() -> None:
    volume = Volume(np.full((8, 40, 40), AIR, np.int16), np.diag([2.0, 2.0, 2.0, 1.0]))
    made = leave_out_surroundings(volume)
    assert np.array_equal(made.voxels, volume.voxels)
    assert count_left_out(made) == {"voxels": 0, "share": 0.0, "body": False, "region": False}
    assert count_left_out(volume) is None
