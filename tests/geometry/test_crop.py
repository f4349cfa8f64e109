"""Cropping: the voxels in a box of mm, each at its own place."""

from __future__ import annotations

import dicom_series
import numpy as np
import pytest
from refusals import refused
from uneven_volume import positions, uneven

from clrecon import Volume
from clrecon.errors import UsageError
from clrecon.geometry.blocks import crop_volume
from clrecon.reading import read_volume

pytestmark = pytest.mark.unit

OPEN = np.array([-np.inf] * 3), np.array([np.inf] * 3)


def numbered(shape=(6, 5, 4), affine=None):
    voxels = np.arange(np.prod(shape), dtype=np.int32).reshape(shape)
    return Volume(voxels, np.diag((2.0, 3.0, 4.0, 1.0)) if affine is None else affine)


def places_by_value(volume):
    nk, nj, ni = volume.voxels.shape
    ijk = np.array([(i, j, k) for k in range(nk) for j in range(nj) for i in range(ni)], float)
    return dict(zip(volume.voxels.reshape(-1).tolist(), volume.ijk_to_lps(ijk), strict=True))


def check_places(volume, cropped):
    before = places_by_value(volume)
    for value, place in places_by_value(cropped).items():
        assert np.allclose(place, before[value], atol=1e-9)


def between(z0, z1):
    low, high = OPEN[0].copy(), OPEN[1].copy()
    low[2], high[2] = z0, z1
    return low, high


def test_centres_on_the_sides_stay():
    cropped = crop_volume(numbered(), (2, 3, 8), (4, 9, 16))
    assert cropped.shape_ijk == (2, 3, 3)
    assert np.array_equal(cropped.affine[:3, 3], (2, 3, 8))
    assert cropped.report["crop"]["first_ijk"] == [1, 1, 2]
    check_places(numbered(), cropped)


def test_ras_turns_x_and_y():
    cropped = crop_volume(numbered(), (-4, -9, 8), (-2, -3, 16), space="ras")
    assert cropped.report["crop"]["first_ijk"] == [1, 1, 2] and cropped.shape_ijk == (2, 3, 3)
    assert "x -4 to -2" in cropped.report["warnings"][-1] and "(RAS)" in cropped.report["warnings"][-1]


def test_the_words_have_the_figures():
    cropped = crop_volume(numbered(), *between(8, 16))
    assert cropped.report["warnings"][-1] == (
        "cropped to z 8 to 16 mm (LPS): 60 of 120 voxels stay (50 %), 8 x 15 x 12 of 8 x 15 x 24 mm"
    )


@pytest.mark.parametrize("plan", [dicom_series.Plan(shape=(7, 6, 9), angles=(10, -20, 35), gap=1.25),
                                  dicom_series.Plan(shape=(7, 6, 9), tilt_deg=12.0, gap=1.25)])  # fmt: skip
def test_oblique_blocks_are_the_smallest_that_hold_the_box(tmp_path, plan):
    dicom_series.write_series(tmp_path, plan)
    read = read_volume(tmp_path)
    volume = Volume(np.arange(read.voxels.size, dtype=np.int32).reshape(read.voxels.shape), read.affine, read.report)
    places = places_by_value(volume)
    table = np.array(list(places.values()))
    low, high = np.quantile(table, 0.3, axis=0), np.quantile(table, 0.8, axis=0)
    inside = [value for value, place in places.items() if (place >= low).all() and (place <= high).all()]
    cropped = crop_volume(volume, low, high)
    check_places(volume, cropped)
    kept = np.isin(cropped.voxels, inside)
    assert kept.sum() == len(inside) > 5
    assert all(kept.any(axis=tuple({0, 1, 2} - {axis})).all() for axis in range(3))
    assert cropped.report["shape_ijk"] == list(cropped.shape_ijk)
    assert np.allclose(cropped.report["affine_ijk_to_lps_mm"], cropped.affine)
    assert cropped.certificate is not None and cropped.report["hu_range"] == list(cropped.hu_range)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_uneven_slices_keep_their_own_positions(sign):
    voxels = np.arange(6 * 5 * 4, dtype=np.int32).reshape(6, 5, 4)
    volume = uneven(voxels, sign)
    heights = positions(sign)[:, 2]
    low, high = sorted((heights[1], heights[4]))
    cropped = crop_volume(volume, *between(low - 1, high + 1))
    assert cropped.uneven and cropped.voxels.shape[0] >= 3
    check_places(volume, cropped)


def test_even_slices_of_a_stack_with_a_gap_become_even():
    table = np.zeros((7, 3))
    table[:, 2] = (0.0, 1.0, 2.0, 3.0, 9.0, 10.0, 11.0)
    affine = np.diag((0.5, 0.5, 11.0 / 6.0, 1.0))
    volume = Volume(np.arange(7 * 2 * 2).reshape(7, 2, 2), affine, slice_positions=table)
    cropped = crop_volume(volume, *between(8.0, 12.0))
    assert not cropped.uneven and np.allclose(cropped.affine[:3, 2], (0, 0, 1)) and cropped.affine[2, 3] == 9.0
    check_places(volume, cropped)
    across = crop_volume(volume, *between(2.0, 10.0))
    assert across.uneven
    check_places(volume, across)


def test_crop_of_an_uneven_stack_to_one_slice_is_even_and_in_place():
    volume = uneven(np.arange(6 * 5 * 4, dtype=np.int32).reshape(6, 5, 4))
    table = positions()
    low = table[4] - 1e-3
    cropped = crop_volume(volume, low, table[4] + 1e-3)
    assert cropped.voxels.shape == (1, 1, 1) and not cropped.uneven
    check_places(volume, cropped)


def test_crops_that_leave_nothing_and_wrong_boxes_are_refused_in_one_line():
    with refused(UsageError, "LPS", 100, 120):
        crop_volume(numbered(), *between(100, 120))
    with refused(UsageError, 9, 3):
        crop_volume(numbered(), (0, 9, 0), (1, 3, 1))
    for low, high in (((0, np.nan, 0), (1, 3, 1)), ((0, 0), (1, 1)), ("a", "b")):
        with pytest.raises(UsageError, match="two corners of three numbers"):
            crop_volume(numbered(), low, high)


def test_a_box_between_two_centres_holds_nothing():
    with refused(UsageError, "nothing"):
        crop_volume(numbered(), *between(1.0, 3.0))


def test_a_margin_ends_with_the_volume():
    assert crop_volume(numbered(), (2, 3, 8), (4, 9, 16), margin=1).shape_ijk == (4, 5, 5)
    assert crop_volume(numbered(), *OPEN, margin=1).shape_ijk == (4, 5, 6)
