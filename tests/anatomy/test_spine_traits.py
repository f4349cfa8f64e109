"""The traits of the spinal canal against the same formulas written out plainly, cell by cell and slice by slice."""

from __future__ import annotations

import numpy as np
import pytest
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
from clrecon.geometry import Volume

pytestmark = pytest.mark.unit


def some_cells(shape=(7, 52, 55), border=0) -> SpineCells:
    """Bone, muscle and air at random, in lumps as large as the filters, with air all around if there is a border."""
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(5)
    values = 40.0 + 900.0 * gaussian_filter(random.normal(size=shape), (1.0, 2.0, 2.0))
    values[:, :border] = values[:, shape[1] - border :] = -1000.0
    values[:, :, :border] = values[:, :, shape[2] - border :] = -1000.0
    return SpineCells(values.astype(np.float32), np.zeros(3))


def plain_shift(field, right, back):
    dx, dy = round(right / CELL_MM[0]), round(back / CELL_MM[1])
    moved = np.zeros_like(field)
    for j in range(field.shape[1]):
        for i in range(field.shape[2]):
            if 0 <= j + dy < field.shape[1] and 0 <= i + dx < field.shape[2]:
                moved[:, j, i] = field[:, j + dy, i + dx]
    return moved


def plain_disc(field, radius):
    from scipy.ndimage import convolve

    reach = int(np.ceil(radius / CELL_MM[0]))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] * CELL_MM[0]
    disc = (x**2 + y**2 <= radius**2).astype(np.float64)
    return convolve(field.astype(np.float64), disc[None] / disc.sum(), mode="constant")


def plain_enclosed(bone, distances):
    angles = np.arange(16) * (2.0 * np.pi / 16)
    walls = [
        np.max([plain_shift(bone, distance * np.cos(angle), distance * np.sin(angle)) for distance in distances], 0)
        for angle in angles
    ]
    return np.mean([np.minimum(wall / 0.7, 1.0) for wall in walls], axis=0)


def plain_mirror(values):
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


def plain_likeness(values):
    from scipy.ndimage import maximum_filter, maximum_filter1d, uniform_filter1d

    def cortex(height):
        return maximum_filter1d(np.clip((values - 170.0) / 130.0, 0, 1), heights(height), axis=0, mode="nearest")

    bone = uniform_filter1d(np.clip((values - 110.0) / 130.0, 0, 1), heights(16.0), axis=0, mode="nearest")
    soft = plain_disc((values > -80.0) & (values < 130.0), 5.0)
    wall = plain_enclosed(maximum_filter(cortex(24.0), (1, 2, 2)), (8.0, 10.0, 12.0, 14.0, 16.0))
    body = 0.5 * plain_disc(bone, 10.0) + 0.5 * plain_enclosed(cortex(12.0), (12.0, 15.0, 18.0, 21.0, 24.0))
    body = np.max([plain_shift(body, 0.0, -ahead) for ahead in (20.0, 24.0, 28.0)], axis=0)
    thick, thin = plain_disc(bone, 12.0), plain_disc(bone, 5.0)
    beside = np.minimum(plain_shift(thin, 36.0, -24.0) + plain_shift(thin, -36.0, -24.0), 1.0)
    behind = np.maximum(plain_shift(thick, 0.0, 50.0), plain_shift(thick, 0.0, 64.0))
    worth = body + wall + 0.5 * soft - plain_disc(bone, 4.0) - 0.5 * beside - behind
    mirror = np.where((worth > WORTH - 1.3) & (soft > 0.4), plain_mirror(values), 0.0)
    return worth + mirror, {"wall": wall, "mirror": mirror, "body": body, "soft": soft}


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("border", daily(1, [0, 14]))
def test_worth_of_every_cell_equals_that_of_the_plain_twin(border):
    cells = some_cells(border=border)
    seen: list[slice] = []
    found = measure_likeness(cells, seen.append)
    assert [(part.start, part.stop) for part in seen] == [(0, 4), (4, 7)]
    expected, traits = plain_likeness(cells.values.astype(np.float64))
    j, i = found.first
    assert found.first == ((4, 4) if border else (0, 0))  # ten cells of air beside the tissue
    ny, nx = found.worth.shape[1:]
    assert (ny, nx) == (52 - 2 * j, 55 - 2 * i)
    box = np.s_[:, j : j + ny, i : i + nx]
    assert np.abs(found.worth - expected[box]).max() < 1e-4
    outside = np.ones(expected.shape, bool)
    outside[box] = False
    assert expected[outside].max(initial=-1.0) < WORTH - 0.6  # all such cells count as little as a cell may
    # Where no trait is within rounding of its bound, each cell is as sure as by the plain figures.
    clear = np.min([np.abs(traits[name] - least) for name, least in SURE.items()], axis=0)[box] > 1e-5
    sure = np.all([traits[name] >= least for name, least in SURE.items()], axis=0)[box]
    assert np.array_equal(found.sure[clear], sure[clear]) and clear.mean() > 0.6


def test_some_of_these_cells_are_sure_by_lower_bounds():
    lower = {"wall": 0.2, "mirror": 0.01, "body": 0.2, "soft": 0.2}
    sure = measure_likeness(some_cells(), lambda _: None, lower).sure
    assert 0.001 < sure.mean() < 0.9


@pytest.mark.parametrize("radius", [2.0, 4.0, 5.0, 10.0, 12.0])
def test_disc_mean_equals_a_plain_sum(radius):
    field = np.random.default_rng(2).random((2, 17, 21)).astype(np.float32)
    assert np.abs(disc_mean(field, radius) - plain_disc(field, radius)).max() < 1e-6


def test_windows_along_z_end_with_the_scan():
    cells = SpineCells(np.array([100, 200, 400, 180, 100, 100], np.float32)[:, None, None], np.zeros(3))
    found = [float(grow_cortex(cells, k, k + 1, 12.0)[0, 0, 0]) for k in range(6)]
    assert found == pytest.approx([30 / 130, 1, 1, 1, 10 / 130, 0])
    assert np.array_equal(grow_cortex(cells, 0, 6, 12.0)[:, 0, 0], np.float32(found))
    assert mean_along_z(cells.around(0, 2, 1), 3)[:, 0, 0] == pytest.approx([400 / 3, 700 / 3])
    assert cells.around(5, 6, 2)[:, 0, 0].tolist() == [180, 100, 100, 100, 100]


@pytest.mark.parametrize("dtype", [np.int16, np.float32, np.uint16])
def test_cells_are_means_of_blocks(dtype):
    """Blocks of 2 x 3 x 2 voxels are as large as cells here, so that each cell is the mean of its block."""
    voxels = np.random.default_rng(3).integers(0, 3000, (6, 12, 10)).astype(dtype)
    volume = Volume(voxels, np.diag((1.25, 2.5 / 3.0, 2.0, 1.0)))
    lattice = plan_cells(volume)
    seen: list[slice] = []
    cells = average_cells(volume, lattice, seen.append)
    assert lattice.block.tolist() == [2, 3, 1] and lattice.blocks(volume) == 6
    assert sum(part.stop - part.start for part in seen) == 6 + len(cells.values)
    blocks = np.clip(voxels, -1024, 1500).astype(np.float64).reshape(3, 2, 4, 3, 5, 2).mean(axis=(1, 3, 5))
    assert cells.values.shape == blocks.shape
    assert np.abs(cells.values - blocks).max() < 1e-3
    assert cells.origin.tolist() == pytest.approx([0.625, 2.5 / 3.0, 1.0])


def test_sums_of_blocks_of_micro_ct_do_not_overflow():
    """A block of 125 voxels a side sums up to 2.9e9, more than 32 bits with a sign hold."""
    volume = Volume(np.full((125, 125, 125), 1500, np.int16), np.diag((0.02, 0.02, 0.02, 1.0)))
    assert plan_cells(volume).block.tolist() == [125, 125, 125]
    assert average_cells(volume, plan_cells(volume), lambda _: None).values.ravel().tolist() == [1500.0]


@pytest.mark.parametrize("shape", [(9, 21, 18), (1, 1, 1)])
@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, -1)])
def test_cells_between_blocks_are_interpolated_the_same_way_along_all_axes(shape, signs):
    """A scan along the axes of the patient is interpolated axis by axis, one turned by next to nothing at once."""
    voxels = np.random.default_rng(4).normal(0.0, 300.0, shape).astype(np.float32)
    voxels[:, 3:6, 4:8] = np.nan
    affine = np.diag((*np.multiply(signs, (0.9, 1.1, 3.3)), 1.0))
    affine[:3, 3] = (-13.0, 7.0, 90.0)
    turned = affine.copy()
    turned[0, 1] = 1e-9
    found, expected = (
        average_cells(volume, plan_cells(volume), lambda _: None)
        for volume in (Volume(voxels, affine), Volume(voxels, turned))
    )
    assert found.values.shape == expected.values.shape and np.isfinite(found.values).all()
    assert np.abs(found.values - expected.values).max() < 1e-3
    assert (found.values == -1024.0).any() == (expected.values == -1024.0).any() == (shape[0] > 1)
