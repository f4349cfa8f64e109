"""The traits of the spinal canal against the same formulas written out plainly, cell by cell and slice by slice."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from variants import daily

from clrecon.anatomy.spine_cells import (
    CELL_MM,
    SURE,
    WORTH,
    SpineCells,
    average_cells,
    disc_mean,
    grow_cortex,
    heights,
    mean_along_z,
    measure_likeness,
    plan_cells,
)
from clrecon.anatomy.spine_line import _WORST
from clrecon.geometry import Volume

pytestmark = pytest.mark.unit


def random_cells(*, shape=(7, 52, 55), border=0) -> SpineCells:
    """Bone, muscle and air at random, in lumps as large as the filters, with air all around if there is a border."""
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(5)
    values = 40.0 + 900.0 * gaussian_filter(random.normal(size=shape), (1.0, 2.0, 2.0))
    values[:, :border] = values[:, shape[1] - border :] = -1000.0
    values[:, :, :border] = values[:, :, shape[2] - border :] = -1000.0
    return SpineCells(values.astype(np.float32), np.zeros(3))


def shift_plainly(field, right, back):
    """The field (nz, ny, nx) seen from mm to the right and the back of each cell; 0 beyond it."""
    dx, dy = round(right / CELL_MM[0]), round(back / CELL_MM[1])
    moved = np.zeros_like(field)
    for j in range(field.shape[1]):
        for i in range(field.shape[2]):
            if 0 <= j + dy < field.shape[1] and 0 <= i + dx < field.shape[2]:
                moved[:, j, i] = field[:, j + dy, i + dx]
    return moved


def average_disc_plainly(field, radius):
    from scipy.ndimage import convolve

    reach = int(np.ceil(radius / CELL_MM[0]))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] * CELL_MM[0]
    disc = (x**2 + y**2 <= radius**2).astype(np.float64)
    return convolve(field.astype(np.float64), disc[None] / disc.sum(), mode="constant")


def measure_enclosure_plainly(bone, distances):
    angles = np.arange(16) * (2.0 * np.pi / 16)
    walls = [
        np.max([shift_plainly(bone, distance * np.cos(angle), distance * np.sin(angle)) for distance in distances], 0)
        for angle in angles
    ]
    return np.mean([np.minimum(wall / 0.7, 1.0) for wall in walls], axis=0)


def measure_mirror_plainly(values):
    from scipy.ndimage import uniform_filter, uniform_filter1d

    smooth = uniform_filter1d(np.clip(values.astype(np.float64), -300.0, 500.0), heights(9.0), axis=0, mode="nearest")
    smooth = uniform_filter(smooth, (1, 2, 2))
    back, aside = np.arange(-18, 15, 2)[:, None], np.arange(1, 17, 2)
    nz, ny, nx = values.shape
    found = np.zeros(values.shape)
    for k, j, i in np.ndindex(nz, ny, nx):
        rows = np.clip(j + back, 0, ny - 1)
        right, left = (smooth[k, rows, np.clip(i + sign * aside, 0, nx - 1)] for sign in (1, -1))
        mean = 0.5 * (right + left).mean()
        power = ((right - mean) ** 2).sum() + ((left - mean) ** 2).sum()
        found[k, j, i] = 2.0 * ((right - mean) * (left - mean)).sum() / (power + 1.0)
    return np.clip(found, 0.0, 1.0)


def measure_likeness_plainly(values):
    from scipy.ndimage import maximum_filter, maximum_filter1d, uniform_filter1d

    def cortex(height):
        return maximum_filter1d(np.clip((values - 170.0) / 130.0, 0, 1), heights(height), axis=0, mode="nearest")

    bone = uniform_filter1d(np.clip((values - 110.0) / 130.0, 0, 1), heights(16.0), axis=0, mode="nearest")
    soft = average_disc_plainly((values > -80.0) & (values < 130.0), 5.0)
    wall = measure_enclosure_plainly(maximum_filter(cortex(24.0), (1, 2, 2)), (8.0, 10.0, 12.0, 14.0, 16.0))
    body = 0.5 * average_disc_plainly(bone, 10.0) + 0.5 * measure_enclosure_plainly(
        cortex(12.0), (12.0, 15.0, 18.0, 21.0, 24.0)
    )
    body = np.max([shift_plainly(body, 0.0, -ahead) for ahead in (20.0, 24.0, 28.0)], axis=0)
    thick, thin = average_disc_plainly(bone, 12.0), average_disc_plainly(bone, 5.0)
    beside = np.minimum(shift_plainly(thin, 36.0, -24.0) + shift_plainly(thin, -36.0, -24.0), 1.0)
    behind = np.maximum(shift_plainly(thick, 0.0, 50.0), shift_plainly(thick, 0.0, 64.0))
    worth = body + wall + 0.5 * soft - average_disc_plainly(bone, 4.0) - 0.5 * beside - behind
    mirror = np.where((worth > WORTH - 1.3) & (soft > 0.4), measure_mirror_plainly(values), 0.0)
    return worth + mirror, {"wall": wall, "mirror": mirror, "body": body, "soft": soft}


WORTH_ROUNDING = 1e-5
"""Sums of traits between 0 and 1 in float32; measured 5e-7."""


@pytest.fixture(scope="module", params=daily(1, [0, 14]), ids=["no border", "air all around"])
def likeness(request):
    """What was measured of random cells, the rows and columns that it covers, worth and traits by plain formulas."""
    cells = random_cells(border=request.param)
    measured = measure_likeness(cells, lambda part: None)
    worth, traits = measure_likeness_plainly(cells.values.astype(np.float64))
    j, i = measured.first
    covered = np.s_[:, j : j + measured.worth.shape[1], i : i + measured.worth.shape[2]]
    return measured, covered, worth, traits


@pytest.mark.release
@pytest.mark.seconds
def test_worth_of_every_cell_is_that_of_the_plain_formulas(likeness):
    measured, covered, worth, _ = likeness
    np.testing.assert_allclose(measured.worth, worth[covered], rtol=0, atol=WORTH_ROUNDING)


@pytest.mark.release
@pytest.mark.seconds
def test_cells_that_are_not_measured_count_as_little_as_a_cell_may(likeness):
    """Four of the 14 cells of air around are left out: farther from tissue than any trait looks."""
    _, covered, worth, _ = likeness
    is_left_out = np.ones(worth.shape, bool)
    is_left_out[covered] = False
    assert worth[is_left_out].max(initial=-1.0) < WORTH - _WORST  # from there on a path costs no more


@pytest.mark.release
@pytest.mark.seconds
def test_cells_are_sure_whose_traits_all_reach_their_bounds_by_the_plain_formulas(likeness):
    measured, covered, _, traits = likeness
    from_bounds = [np.abs(traits[name] - least) for name, least in SURE.items()]
    is_clear = np.min(from_bounds, axis=0)[covered] > 1e-5  # no trait is within rounding of its bound
    is_sure = np.all([traits[name] >= least for name, least in SURE.items()], axis=0)[covered]
    assert is_clear.mean() > 0.9  # measured 1.0
    assert np.array_equal(measured.sure[is_clear], is_sure[is_clear])


@pytest.mark.release
@pytest.mark.parametrize(("border", "first"), [(0, (0, 0)), (14, (4, 4))], ids=["no border", "air all around"])
def test_cells_farther_than_25_mm_from_tissue_are_not_measured(border, first):
    """Ten cells of 2.5 mm are kept around the tissue, on either side."""
    measured = measure_likeness(random_cells(shape=(7, 52, 55), border=border), lambda part: None)
    assert measured.first == first
    assert measured.worth.shape[1:] == (52 - 2 * first[0], 55 - 2 * first[1])


@pytest.mark.release
def test_likeness_is_measured_in_parts_of_four_slices_that_are_told_when_done():
    parts: list[slice] = []
    measure_likeness(random_cells(shape=(7, 52, 55)), parts.append)
    assert [(part.start, part.stop) for part in parts] == [(0, 4), (4, 7)]


def test_some_random_cells_and_not_all_are_sure_by_lower_bounds():
    lower = {"wall": 0.2, "mirror": 0.01, "body": 0.2, "soft": 0.2}
    sure = measure_likeness(random_cells(), lambda _: None, bounds=lower).sure
    assert sure.any()
    assert not sure.all()


@pytest.mark.parametrize("radius_mm", [2.0, 4.0, 5.0, 10.0, 12.0])
def test_disc_mean_is_the_sum_over_the_disc_by_its_cells(radius_mm):
    field = np.random.default_rng(2).random((2, 17, 21)).astype(np.float32)
    expected = average_disc_plainly(field, radius_mm)
    np.testing.assert_allclose(disc_mean(field, radius_mm), expected, rtol=0, atol=tolerances.FLOAT32_SHARE)


@pytest.fixture
def column_of_cells():
    """Six cells above each other, 4 mm high."""
    return SpineCells(np.array([100, 200, 400, 180, 100, 100], np.float32)[:, None, None], np.zeros(3))


CORTEX_OF_COLUMN = [30 / 130, 1, 1, 1, 10 / 130, 0]
"""From 170 HU, none, to 300 HU, whole; of each cell and those above and below it, 12 mm, the highest."""


def test_cortex_is_the_highest_within_12_mm_and_ends_with_the_scan(column_of_cells):
    cortex = [float(grow_cortex(column_of_cells, k, k + 1, height=12.0)[0, 0, 0]) for k in range(6)]
    assert cortex == pytest.approx(CORTEX_OF_COLUMN)


def test_cortex_of_all_cells_at_once_is_that_of_each(column_of_cells):
    assert grow_cortex(column_of_cells, first=0, end=6, height=12.0)[:, 0, 0].tolist() == pytest.approx(
        CORTEX_OF_COLUMN
    )


def test_cells_beyond_the_scan_are_those_of_its_end(column_of_cells):
    first_two_and_one_on_each_side = column_of_cells.around(first=0, end=2, reach=1)
    last_and_two_on_each_side = column_of_cells.around(first=5, end=6, reach=2)
    assert first_two_and_one_on_each_side[:, 0, 0].tolist() == [100, 100, 200, 400]
    assert last_and_two_on_each_side[:, 0, 0].tolist() == [180, 100, 100, 100, 100]


def test_the_mean_along_z_is_that_of_three_cells(column_of_cells):
    means = mean_along_z(column_of_cells.around(first=0, end=2, reach=1), height=3)[:, 0, 0]
    assert means == pytest.approx([(100 + 100 + 200) / 3, (100 + 200 + 400) / 3])


BLOCK_SPACING = (1.25, 2.5 / 3.0, 2.0)
"""Blocks of 2 x 3 x 2 voxels are as large as cells of 2.5 x 2.5 x 4 mm, so that each cell is the mean of its block."""


@pytest.mark.parametrize("dtype", [np.int16, np.float32, np.uint16])
def test_cells_are_means_of_blocks_of_values_cut_to_hu_of_the_body(dtype):
    voxels = np.random.default_rng(3).integers(0, 3000, (6, 12, 10)).astype(dtype)
    volume = Volume(voxels, np.diag((*BLOCK_SPACING, 1.0)))
    cells = average_cells(volume, plan_cells(volume), lambda part: None)
    blocks = np.clip(voxels, -1024, 1500).astype(np.float64).reshape(3, 2, 4, 3, 5, 2)
    np.testing.assert_allclose(cells.values, blocks.mean(axis=(1, 3, 5)), rtol=0, atol=1e-3)  # sums in float32


def test_the_origin_of_cells_is_the_middle_of_the_first_block():
    volume = Volume(np.zeros((6, 12, 10), np.int16), np.diag((*BLOCK_SPACING, 1.0)))
    cells = average_cells(volume, plan_cells(volume), lambda part: None)
    assert cells.origin.tolist() == pytest.approx([1.25 / 2, 2.5 / 3.0, 2.0 / 2])


def test_cells_are_averaged_within_slices_first_and_each_slice_and_layer_is_told_once():
    volume = Volume(np.zeros((6, 12, 10), np.int16), np.diag((*BLOCK_SPACING, 1.0)))
    lattice = plan_cells(volume)
    parts: list[slice] = []
    cells = average_cells(volume, lattice, parts.append)
    assert lattice.block.tolist() == [2, 3, 1]
    assert lattice.blocks(volume) == 6
    places = [k for part in parts for k in range(part.start, part.stop)]
    assert sorted(places) == sorted([*range(6), *range(len(cells.values))])


def test_sums_of_blocks_of_micro_ct_do_not_overflow():
    """A block of 125 voxels a side sums up to 2.9e9, more than 32 bits with a sign hold."""
    volume = Volume(np.full((125, 125, 125), 1500, np.int16), np.diag((0.02, 0.02, 0.02, 1.0)))
    assert plan_cells(volume).block.tolist() == [125, 125, 125]
    assert average_cells(volume, plan_cells(volume), lambda _: None).values.ravel().tolist() == [1500.0]


@pytest.fixture(params=[(9, 21, 18), (1, 1, 1)], ids=["9 slices", "one voxel"])
def straight_and_turned_cells(request, signs):
    """Cells of a scan with a hole of NaN: along the axes of the patient, and turned by next to nothing.

    The first are interpolated axis by axis, the second at once.
    """
    voxels = np.random.default_rng(4).normal(0.0, 300.0, request.param).astype(np.float32)
    voxels[:, 3:6, 4:8] = np.nan
    affine = np.diag((*np.multiply(signs, (0.9, 1.1, 3.3)), 1.0))
    affine[:3, 3] = (-13.0, 7.0, 90.0)
    turned = affine.copy()
    turned[0, 1] = 1e-9
    volumes = Volume(voxels, affine), Volume(voxels, turned)
    return [average_cells(volume, plan_cells(volume), lambda part: None) for volume in volumes]


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, -1)])
def test_cells_between_blocks_are_the_same_interpolated_axis_by_axis_and_at_once(straight_and_turned_cells):
    straight, turned = straight_and_turned_cells
    assert np.isfinite(straight.values).all()
    np.testing.assert_allclose(straight.values, turned.values, rtol=0, atol=1e-3)  # float32 at some 1000 HU


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, -1)])
def test_cells_of_nan_are_air(straight_and_turned_cells):
    straight, turned = straight_and_turned_cells
    has_a_hole = straight.values.size > 1  # one voxel alone has no room for the hole
    assert (straight.values == -1024.0).any() == has_a_hole
    assert (turned.values == -1024.0).any() == has_a_hole
