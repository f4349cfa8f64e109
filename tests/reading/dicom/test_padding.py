"""Padding: filled with the air beside it, so that the circle of reconstruction is no tube at any iso value."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
import tolerances
from dicom_series import Plan, set_values, write_series

from clrecon.geometry import AIR_HU
from clrecon.proof.surface.extract import extract_isosurface
from clrecon.reading import read_volume
from clrecon.reading.common.padding import SAMPLED_SLICES, PaddingMasks, pack_mask

SHAPE = (6, 40, 40)
CENTRE, RADIUS = 19.5, 18.0
SWEEP = [-2500, -2000, -1500, -1100, *range(-1025, -978, 3), -950, -900, -700, -500, -100, 0, 30, 200, 700, 1500, 3000]


def outside_of_circle():
    """True outside of the circle of reconstruction, shape (rows, columns)."""
    y, x = np.ogrid[: SHAPE[1], : SHAPE[2]]
    return (x - CENTRE) ** 2 + (y - CENTRE) ** 2 > RADIUS**2


def make_body(*, air, noise, reach=0.0):
    """HU of a body (40) with a bone (900) in air; with `reach` the body goes beyond the circle at low x."""
    y, x = np.mgrid[: SHAPE[1], : SHAPE[2]]
    hu = np.full(SHAPE, float(air))
    hu[:, ((x - CENTRE + reach) / 11) ** 2 + ((y - CENTRE) / 8) ** 2 <= 1] = 40
    hu[:, (x - CENTRE + reach) ** 2 + (y - CENTRE) ** 2 <= 9] = 900
    return np.rint(hu + np.random.default_rng(1).normal(0, noise, SHAPE)) if noise else hu


def write_padded(folder, hu, padding=-2000, every=1):
    """Slices of HU; in each, or in every second or third, the stored value outside of the circle is `padding`."""
    plan = Plan(shape=SHAPE)
    outside = outside_of_circle()

    def change(ds, k):
        stored = (hu[k] - plan.intercept).astype(np.int16)
        if k % every == 0:
            stored[outside] = padding
            ds.add_new("PixelPaddingValue", "SS", padding)
        ds.PixelData = stored.tobytes()

    write_series(folder, plan, change)


def crossed_share(voxels, iso_value, pairs):
    """Share of the pairs of neighbours of all slices that an iso value parts; `pairs` are masks along x and along y."""
    inside = voxels >= iso_value
    x, y = (inside[:, :, 1:] != inside[:, :, :-1])[:, pairs[0]], (inside[:, 1:] != inside[:, :-1])[:, pairs[1]]
    return (x.sum() + y.sum()) / (x.size + y.size)


def pairs_between(one, other):
    """Which neighbours along x, and along y, lie on either side of a border, as masks."""
    return (one[:, 1:] & other[:, :-1]) | (other[:, 1:] & one[:, :-1]), (one[1:] & other[:-1]) | (other[1:] & one[:-1])


IN_THEORY, IN_SCANS, BELOW_THAT_OF_SCANS, ABOVE_THAT_OF_SCANS = -1000, -994, -1012, -960  # scans: -1010 to -970 HU


@pytest.mark.parametrize("air", [IN_THEORY, IN_SCANS, BELOW_THAT_OF_SCANS, ABOVE_THAT_OF_SCANS])
def test_no_tube_at_any_iso_value_where_air_has_no_noise(tmp_path, air):
    write_padded(tmp_path, make_body(air=air, noise=0))
    volume = read_volume(tmp_path)
    assert volume.report["padding_hu"] == air
    assert volume.report["hu_range"] == [air, 900]
    outside = outside_of_circle()
    for iso_value in SWEEP:
        assert crossed_share(volume.voxels, iso_value, pairs_between(outside, ~outside)) == 0, iso_value


@pytest.mark.parametrize("iso_value", [-990, -700, 0, 200])
def test_no_surface_of_a_padded_body_lies_at_the_circle(tmp_path, iso_value):
    write_padded(tmp_path, make_body(air=-994, noise=0))
    volume = read_volume(tmp_path)
    vertices = extract_isosurface(volume, iso_value)[0]
    assert len(vertices) > 0
    ij = volume.lps_to_ijk(vertices)[:, :2]
    from_centre = np.hypot(ij[:, 0] - CENTRE, ij[:, 1] - CENTRE)
    assert from_centre.max() < RADIUS - 4  # the body is 11 voxels wide


def test_padding_of_a_fixed_value_would_have_a_tube_at_the_circle(tmp_path):
    """Known bad: what the fill is for."""
    write_padded(tmp_path, make_body(air=-994, noise=0))
    voxels = read_volume(tmp_path).voxels.copy()
    outside = outside_of_circle()
    voxels[:, outside] = AIR_HU
    between_both = -1010  # the fixed value of -1024 and the air of -994
    assert crossed_share(voxels, between_both, pairs_between(outside, ~outside)) == 1


@pytest.mark.parametrize("noise", [5, 12, 40])
@pytest.mark.parametrize("clipped", [False, True])
def test_iso_value_in_noisy_air_crosses_the_border_of_padding_no_more_than_the_air(tmp_path, noise, clipped):
    hu = make_body(air=-995, noise=noise)
    write_padded(tmp_path, np.maximum(hu, -1024) if clipped else hu)
    volume = read_volume(tmp_path)
    outside = outside_of_circle()
    y, x = np.mgrid[: SHAPE[1], : SHAPE[2]]
    air = ~outside & (((x - CENTRE) / 12) ** 2 + ((y - CENTRE) / 9) ** 2 > 1)  # a voxel beside the body, 11 x 8
    for iso_value in SWEEP:
        at_border = crossed_share(volume.voxels, iso_value, pairs_between(outside, ~outside))
        in_air = crossed_share(volume.voxels, iso_value, pairs_between(air, air))
        assert at_border <= in_air + tolerances.PADDING_BORDER_SHARE, iso_value


@pytest.mark.parametrize("noise", [5, 12, 40])
@pytest.mark.parametrize("clipped", [False, True])
def test_padding_beside_noisy_air_is_filled_with_its_middle_hu(tmp_path, noise, clipped):
    hu = make_body(air=-995, noise=noise)
    write_padded(tmp_path, np.maximum(hu, -1024) if clipped else hu)
    median_error = noise / 5  # of some hundred voxels beside the circle
    assert read_volume(tmp_path).report["padding_hu"] == pytest.approx(-995, abs=median_error)


@pytest.mark.parametrize("noise", [0, 12])
@pytest.mark.parametrize("iso_value", [-500, 200])
def test_surface_of_a_body_cut_by_the_circle_is_closed_there(tmp_path, noise, iso_value):
    write_padded(tmp_path, make_body(air=-1000, noise=noise, reach=14.0))
    volume = read_volume(tmp_path)
    vertices, _, triangles = extract_isosurface(volume, iso_value)
    edges = np.sort(np.concatenate([triangles[:, pair] for pair in ((0, 1), (1, 2), (2, 0))]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    ij = volume.lps_to_ijk(vertices)[:, :2]
    assert ij[:, 0].min() < 3  # it does reach the circle
    assert np.hypot(ij[:, 0] - CENTRE, ij[:, 1] - CENTRE).max() < RADIUS + 1.5  # a voxel and its diagonal


@pytest.mark.parametrize("inside", [40, 24, -3000], ids=["body", "values without an intercept", "far below air"])
def test_padding_without_air_beside_it_is_filled_with_the_hu_of_air(tmp_path, inside):
    write_padded(tmp_path, np.full(SHAPE, inside), padding=-2500)
    volume = read_volume(tmp_path)
    assert volume.report["padding_hu"] == AIR_HU
    assert (volume.voxels[:, outside_of_circle()] == AIR_HU).all()


def test_measured_voxels_keep_their_hu_and_padding_gets_one_value(tmp_path):
    hu = np.maximum(make_body(air=-995, noise=20), -1024)
    write_padded(tmp_path, hu)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels[:, ~outside_of_circle()], hu[:, ~outside_of_circle()])
    assert (hu[:, ~outside_of_circle()] == AIR_HU).any()  # among them measured ones at the floor
    assert (volume.voxels[:, outside_of_circle()] == volume.report["padding_hu"]).all()


def test_slices_that_declare_no_padding_are_measured_whatever_they_hold(tmp_path):
    write_padded(tmp_path, make_body(air=-1000, noise=0), every=2)
    volume = read_volume(tmp_path)
    assert volume.report["padding_share"] == pytest.approx(outside_of_circle().mean() / 2)
    assert (volume.voxels[:, outside_of_circle()] == -1000).all()  # filled like the air that the others have there


def test_padding_of_slices_with_other_intercepts_is_filled_with_one_hu(tmp_path):
    """Padding is a stored value: its HU would differ with each slice's intercept."""
    plan = Plan(shape=SHAPE)
    outside = outside_of_circle()
    air, bright, slope = -1001, -961, 0.5

    def change(ds, k):
        intercept = -1024 + k
        stored = np.where(outside, -2000, (air - intercept) / slope).astype(np.int16)
        stored[20, 20] = (bright - intercept) / slope
        ds.PixelData = stored.tobytes()
        ds.add_new("PixelPaddingValue", "SS", -2000)
        set_values(RescaleSlope=slope, RescaleIntercept=intercept)(ds, k)

    write_series(tmp_path, plan, change)
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.float32
    assert volume.report["padding_hu"] == air
    assert (volume.voxels[:, 20, 20] == bright).all()
    assert np.count_nonzero(volume.voxels != air) == len(volume.voxels)


def test_report_of_a_scan_without_padding_has_no_hu_of_padding(tmp_path):
    write_series(tmp_path)
    assert read_volume(tmp_path).report["padding_hu"] is None


def test_padding_masks_are_freed_at_once_when_they_are_dropped():
    voxels = np.zeros((2, 8, 8), np.int16)
    masks = PaddingMasks(voxels)
    masks.add(0, pack_mask(np.eye(8, dtype=bool)))
    masks.fill()
    gc.disable()
    try:
        seen = weakref.ref(masks)
        del masks
        assert seen() is None
    finally:
        gc.enable()


@pytest.mark.release
@pytest.mark.parametrize("iso_value", [-1500, -1023, -1015, -1010, -1005, -1000])
def test_real_scan_has_no_tube_at_iso_values_below_its_air(real_data, iso_value):
    """Its air, some -970 HU, touches the circle; -1024 there would be a tube."""
    volume = read_volume(real_data / "thoracic_0p8mm")
    filled = volume.report["padding_hu"]
    assert -990 < filled < -950
    y, x = np.ogrid[:512, :512]
    outside = (volume.voxels[0] == filled) & ((x - 255.5) ** 2 + (y - 255.5) ** 2 > 255.0**2)
    border = pairs_between(outside, ~outside)
    assert crossed_share(volume.voxels, iso_value, border) < tolerances.REAL_TUBE_SHARE
    if iso_value > AIR_HU:
        with_fixed_value = np.where(outside, np.int16(AIR_HU), volume.voxels)
        assert crossed_share(with_fixed_value, iso_value, border) > 1 - tolerances.REAL_TUBE_SHARE


@pytest.mark.release
def test_padding_of_a_real_scan_clipped_at_its_rim_is_filled_with_that_value(real_data):
    assert read_volume(real_data / "lumbar_4p25mm").report["padding_hu"] == AIR_HU


@pytest.mark.parametrize(
    ("count", "step"), [(1, 1), (SAMPLED_SLICES, 1), (SAMPLED_SLICES + 1, 2), (3 * SAMPLED_SLICES, 3)]
)
def test_air_is_sampled_in_slices_along_the_whole_scan(count, step):
    """Air that is 1 HU denser from slice to slice: the median of that beside the padding of every `step` th slice."""
    voxels = np.full((count, 3, 3), -1000, np.int16) + np.arange(count, dtype=np.int16)[:, None, None]
    padding = np.zeros((3, 3), bool)
    padding[0, 0] = True
    masks = PaddingMasks(voxels)
    for k in range(count):
        masks.add(k, pack_mask(padding))
    beside_padding = sorted(2 * [-1000.0 + k for k in range(0, count, step)])  # right and below, in each slice
    lower_median = beside_padding[(len(beside_padding) - 1) // 2]
    assert masks.fill() == lower_median and (voxels[:, 0, 0] == lower_median).all()
