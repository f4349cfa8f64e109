"""Cropping: the voxels in a box of mm, each at its own place."""

from __future__ import annotations

import dicom_series
import numpy as np
import pytest
import tolerances
from refusals import refused
from uneven_volume import positions, uneven

from clrecon import Volume
from clrecon.errors import UsageError
from clrecon.geometry.blocks import crop_volume
from clrecon.reading import read_volume

pytestmark = pytest.mark.unit

OPEN = np.array([-np.inf] * 3), np.array([np.inf] * 3)


def numbered_volume() -> Volume:
    """4 x 5 x 6 voxels of 2 x 3 x 4 mm from the origin on, each with its number."""
    voxels = np.arange(6 * 5 * 4, dtype=np.int32).reshape(6, 5, 4)
    return Volume(voxels, np.diag((2.0, 3.0, 4.0, 1.0)))


def places_by_value(volume):
    """The LPS point of each voxel by its number."""
    nk, nj, ni = volume.voxels.shape
    ijk = np.array([(i, j, k) for k in range(nk) for j in range(nj) for i in range(ni)], float)
    return dict(zip(volume.voxels.reshape(-1).tolist(), volume.ijk_to_lps(ijk), strict=True))


def check_places(volume, cropped):
    """Assert that each voxel lies where it did."""
    before = places_by_value(volume)
    for value, place in places_by_value(cropped).items():
        assert np.allclose(place, before[value], atol=tolerances.FLOAT64_PLACE_MM)


def between(z0, z1):
    """The corners of a box that is open along x and y."""
    low, high = OPEN[0].copy(), OPEN[1].copy()
    low[2], high[2] = z0, z1
    return low, high


def test_voxels_whose_centres_lie_on_the_sides_of_the_box_stay_in_their_place():
    cropped = crop_volume(numbered_volume(), low=(2, 3, 8), high=(4, 9, 16))
    assert cropped.shape_ijk == (2, 3, 3)
    assert np.array_equal(cropped.affine[:3, 3], (2, 3, 8))
    check_places(numbered_volume(), cropped)


def test_report_of_a_crop_has_the_indices_of_its_first_voxel():
    cropped = crop_volume(numbered_volume(), low=(2, 3, 8), high=(4, 9, 16))
    assert cropped.report["crop"]["first_ijk"] == [1, 1, 2]


def test_a_box_in_ras_keeps_the_voxels_of_the_box_in_lps_with_x_and_y_negated():
    in_ras = crop_volume(numbered_volume(), low=(-4, -9, 8), high=(-2, -3, 16), space="ras")
    in_lps = crop_volume(numbered_volume(), low=(2, 3, 8), high=(4, 9, 16))
    assert np.array_equal(in_ras.voxels, in_lps.voxels)


def test_the_warning_of_a_crop_in_ras_has_the_coordinates_and_the_frame_that_were_given():
    warning = crop_volume(numbered_volume(), low=(-4, -9, 8), high=(-2, -3, 16), space="ras").report["warnings"][-1]
    assert "x -4 to -2" in warning
    assert "(RAS)" in warning


def test_the_warning_of_a_crop_says_the_box_and_how_much_of_the_volume_stays():
    cropped = crop_volume(numbered_volume(), *between(8, 16))
    assert cropped.report["warnings"][-1] == (
        "cropped to z 8 to 16 mm (LPS): 60 of 120 voxels stay (50 %), 8 x 15 x 12 of 8 x 15 x 24 mm"
    )


@pytest.fixture(params=[{"angles": (10, -20, 35)}, {"tilt_deg": 12.0}], ids=["oblique", "tilted gantry"])
def oblique_crop(request, tmp_path):
    """A volume read from DICOM, whose voxels are numbers, its part in a box in mm, and the numbers in that box."""
    dicom_series.write_series(tmp_path, dicom_series.Plan(shape=(7, 6, 9), gap=1.25, **request.param))
    read = read_volume(tmp_path)
    volume = Volume(np.arange(read.voxels.size, dtype=np.int32).reshape(read.voxels.shape), read.affine, read.report)
    places = places_by_value(volume)
    low, high = np.quantile(list(places.values()), (0.3, 0.8), axis=0)
    in_the_box = [value for value, place in places.items() if (place >= low).all() and (place <= high).all()]
    return volume, crop_volume(volume, low, high), in_the_box


def test_a_crop_of_an_oblique_volume_is_the_smallest_block_that_holds_the_box(oblique_crop):
    volume, cropped, in_the_box = oblique_crop
    check_places(volume, cropped)
    is_inside = np.isin(cropped.voxels, in_the_box)
    assert is_inside.sum() == len(in_the_box) > 18  # of 7 x 6 x 9 voxels; measured 36 and 72
    assert is_inside.any(axis=(1, 2)).all(), "every slice is needed"
    assert is_inside.any(axis=(0, 2)).all(), "every row is needed"
    assert is_inside.any(axis=(0, 1)).all(), "every column is needed"


def test_the_certificate_of_a_crop_has_its_shape_affine_and_range(oblique_crop):
    _, cropped, _ = oblique_crop
    assert cropped.certificate is not None
    assert cropped.report["shape_ijk"] == list(cropped.shape_ijk)
    assert np.allclose(cropped.report["affine_ijk_to_lps_mm"], cropped.affine)
    assert cropped.report["hu_range"] == list(cropped.hu_range)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["upwards", "downwards"])
def test_uneven_slices_of_a_crop_stay_in_their_place(sign):
    voxels = np.arange(6 * 5 * 4, dtype=np.int32).reshape(6, 5, 4)
    volume = uneven(voxels, sign=sign)
    heights = positions(sign=sign)[:, 2]
    low, high = sorted((heights[1], heights[4]))
    cropped = crop_volume(volume, *between(low - 1, high + 1))
    assert cropped.uneven
    assert cropped.voxels.shape[0] >= 4  # slices 1 to 4
    check_places(volume, cropped)


@pytest.fixture
def stack_with_a_gap():
    """Slices at z = 0, 1, 2, 3 and 9, 10, 11 mm."""
    table = np.zeros((7, 3))
    table[:, 2] = (0.0, 1.0, 2.0, 3.0, 9.0, 10.0, 11.0)
    affine = np.diag((0.5, 0.5, 11.0 / 6.0, 1.0))
    return Volume(np.arange(7 * 2 * 2).reshape(7, 2, 2), affine, slice_positions=table)


def test_slices_of_a_crop_beside_a_gap_are_even(stack_with_a_gap):
    cropped = crop_volume(stack_with_a_gap, *between(8.0, 12.0))
    assert not cropped.uneven
    assert cropped.affine[:3, 2].tolist() == pytest.approx([0, 0, 1])
    check_places(stack_with_a_gap, cropped)


def test_slices_of_a_crop_across_a_gap_are_uneven(stack_with_a_gap):
    cropped = crop_volume(stack_with_a_gap, *between(2.0, 10.0))
    assert cropped.uneven
    check_places(stack_with_a_gap, cropped)


def test_a_crop_of_an_uneven_stack_to_one_voxel_is_even_and_in_its_place():
    volume = uneven(np.arange(6 * 5 * 4, dtype=np.int32).reshape(6, 5, 4))
    first_voxel_of_slice_4 = volume.slice_origins()[4]
    cropped = crop_volume(volume, first_voxel_of_slice_4 - 1e-3, first_voxel_of_slice_4 + 1e-3)
    assert cropped.voxels.shape == (1, 1, 1)
    assert not cropped.uneven
    check_places(volume, cropped)


def test_a_box_above_the_volume_is_refused_with_its_heights_and_frame():
    with refused(UsageError, "LPS", 100, 120):
        crop_volume(numbered_volume(), *between(100, 120))


def test_a_box_whose_low_corner_lies_above_the_high_one_is_refused():
    with refused(UsageError, 9, 3):
        crop_volume(numbered_volume(), low=(0, 9, 0), high=(1, 3, 1))


@pytest.mark.parametrize(
    ("low", "high"), [((0, np.nan, 0), (1, 3, 1)), ((0, 0), (1, 1)), ("a", "b")], ids=["NaN", "two numbers", "text"]
)
def test_a_box_that_is_not_two_corners_of_three_numbers_is_refused(low, high):
    with refused(UsageError, "corners", "numbers"):
        crop_volume(numbered_volume(), low, high)


def test_a_box_between_two_slices_is_refused_as_it_holds_nothing():
    with refused(UsageError, "nothing"):
        crop_volume(numbered_volume(), *between(1.0, 3.0))


@pytest.mark.parametrize(
    ("low", "high", "shape_ijk"),
    [((2, 3, 8), (4, 9, 16), (4, 5, 5)), (*OPEN, (4, 5, 6))],
    ids=["one voxel around", "whole volume"],
)
def test_a_margin_is_added_around_the_box_and_ends_with_the_volume(low, high, shape_ijk):
    assert crop_volume(numbered_volume(), low, high, margin=1).shape_ijk == shape_ijk
