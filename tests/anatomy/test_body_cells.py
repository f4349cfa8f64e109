"""Cells of the search for the body, and their growth, against the same thing written out plainly."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.anatomy.body import _find_cavities, find_unmeasured
from clrecon.anatomy.body_cells import count_cells, grow, measure_cells
from clrecon.geometry import Volume

pytestmark = pytest.mark.unit


def plain_growth(mask, cells):
    from scipy import ndimage

    change = ndimage.binary_dilation if cells > 0 else ndimage.binary_erosion
    for turn in range(max(1, round(abs(cells)))):
        shape = ndimage.generate_binary_structure(2, 1 + turn % 2)[None]
        mask = change(mask, shape, border_value=cells < 0)
    return mask


@pytest.mark.parametrize("cells", [0.3, 1, 2, 3.4, 5, -0.3, -1, -2, -3, -4.6])
@pytest.mark.parametrize("shape", [(6, 31, 27), (1, 1, 9), (2, 5, 1), (1, 1, 1)])
def test_growth_is_that_of_crosses_and_squares_in_turn(shape, cells):
    random = np.random.default_rng(1)
    for share in (0.02, 0.5, 0.97):
        mask = random.random(shape) < share
        before = mask.copy()
        assert np.array_equal(grow(mask, cells), plain_growth(mask, cells))
        assert np.array_equal(mask, before)


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
@pytest.mark.parametrize("shape", [(5, 9, 11), (4, 8, 12), (1, 1, 1)])
def test_cells_hold_mean_and_counts_of_their_voxels(shape, dtype):
    """Cells of 3 x 2 x 2 voxels; at the far ends some have fewer."""
    voxels = np.random.default_rng(2).integers(-1000, 1000, shape).astype(dtype)
    voxels.flat[0] = 300  # not above
    volume = Volume(voxels, np.diag((0.67, 1.0, 1.0, 1.0)))
    seen: list[slice] = []
    cells = measure_cells(volume, seen.append)
    assert cells.step == (3, 2, 2) and cells.mean.shape == count_cells(volume)
    assert sum(part.stop - part.start for part in seen) == len(cells.mean)
    for k, j, i in np.ndindex(cells.mean.shape):
        part = voxels[2 * k : 2 * k + 2, 2 * j : 2 * j + 2, 3 * i : 3 * i + 3]
        assert cells.mean[k, j, i] == pytest.approx(part.mean(dtype=np.float64), abs=1e-3)
        assert (cells.dense[k, j, i], cells.hard[k, j, i]) == ((part > 300).sum(), (part > 600).sum())


@pytest.mark.parametrize(("mm", "n"), [(2.0 / 41, 41), (1.0 / 32, 64)])
def test_counts_of_cells_hold_every_voxel_of_micro_ct(mm, n):
    """From 41 voxels a side on, 16 bits do not hold the number of voxels of a cell."""
    voxels = np.full((n, n, n + 3), 601, np.int16)
    voxels[0, 0, 0] = 600
    cells = measure_cells(Volume(voxels, np.diag((mm, mm, mm, 1.0))))
    assert cells.step == (n, n, n)
    assert cells.dense.ravel().tolist() == [n**3, 3 * n * n]
    assert cells.hard.ravel().tolist() == [n**3 - 1, 3 * n * n]


def test_what_is_not_measured_begins_at_the_corners_and_is_large():
    layer = np.random.default_rng(4).normal(0.0, 100.0, (20, 20))
    layer[:4, :4] = -3024.0  # sixteen, at a corner
    layer[16:, 17:] = -2000.0  # twelve, at another
    layer[8:13, 8:13] = -3024.0  # the same value, within
    found = find_unmeasured(np.stack([layer, layer[:, ::-1]] * 3))
    expected = np.zeros((20, 20), bool)
    expected[:4, :4] = True
    assert all(np.array_equal(out, own) for out, own in zip(found, [expected, expected[:, ::-1]] * 3, strict=True))


@pytest.mark.parametrize("turns", range(4))
def test_air_within_a_cell_of_the_border_of_the_scan_is_no_cavity(turns):
    for place, found in ((0, False), (1, False), (2, True)):
        tissue = np.ones((1, 12, 12), bool)
        tissue[:, 5:8, place : place + 3] = False
        tissue = np.rot90(tissue, turns, (1, 2))
        cells = np.where(tissue, np.arange(144).reshape(tissue.shape), -1000).astype(np.float32)
        cavities = _find_cavities(cells, tissue, np.zeros_like(tissue), 2.0)
        assert np.array_equal(cavities, ~tissue if found else np.zeros_like(tissue))
