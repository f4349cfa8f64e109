"""Cells of the search for the body, and their growth, against the same thing written out plainly."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.anatomy.body import _find_cavities, find_unmeasured
from clrecon.anatomy.body_cells import count_cells, grow, measure_cells
from clrecon.geometry import Volume

pytestmark = pytest.mark.unit


def grow_plainly(mask, cells):
    from scipy import ndimage

    change = ndimage.binary_dilation if cells > 0 else ndimage.binary_erosion
    for turn in range(max(1, round(abs(cells)))):
        shape = ndimage.generate_binary_structure(2, 1 + turn % 2)[None]
        mask = change(mask, shape, border_value=cells < 0)
    return mask


sparse_even_and_dense = pytest.mark.parametrize("share", [0.02, 0.5, 0.97])


@sparse_even_and_dense
@pytest.mark.parametrize("cells", [0.3, 1, 2, 3.4, 5, -0.3, -1, -2, -3, -4.6])
@pytest.mark.parametrize("shape", [(6, 31, 27), (1, 1, 9), (2, 5, 1), (1, 1, 1)])
def test_growth_and_shrinkage_are_those_of_crosses_and_squares_in_turn(shape, cells, share):
    mask = np.random.default_rng(1).random(shape) < share
    assert np.array_equal(grow(mask, cells), grow_plainly(mask, cells))


@sparse_even_and_dense
@pytest.mark.parametrize("cells", [2, -2])
def test_growth_leaves_the_given_mask_as_it_is(cells, share):
    mask = np.random.default_rng(1).random((6, 31, 27)) < share
    before = mask.copy()
    grow(mask, cells)
    assert np.array_equal(mask, before)


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
@pytest.mark.parametrize("shape", [(5, 9, 11), (4, 8, 12), (1, 1, 1)])
def test_cells_hold_the_mean_and_the_counts_above_300_and_600_hu_of_their_voxels(shape, dtype):
    """Cells of 3 x 2 x 2 voxels; at the far ends some have fewer."""
    voxels = np.random.default_rng(2).integers(-1000, 1000, shape).astype(dtype)
    voxels.flat[0] = 300  # not above
    volume = Volume(voxels, np.diag((0.67, 1.0, 1.0, 1.0)))
    cells = measure_cells(volume)
    assert cells.step == (3, 2, 2)
    assert cells.mean.shape == count_cells(volume)
    for k, j, i in np.ndindex(cells.mean.shape):
        part = voxels[2 * k : 2 * k + 2, 2 * j : 2 * j + 2, 3 * i : 3 * i + 3]
        assert cells.mean[k, j, i] == pytest.approx(part.mean(dtype=np.float64), abs=1e-3)  # sums in float32
        assert (cells.dense[k, j, i], cells.hard[k, j, i]) == ((part > 300).sum(), (part > 600).sum())


def test_each_layer_of_cells_is_told_once():
    volume = Volume(np.zeros((5, 9, 11), np.int16), np.diag((0.67, 1.0, 1.0, 1.0)))
    parts: list[slice] = []
    cells = measure_cells(volume, parts.append)
    assert sorted(k for part in parts for k in range(part.start, part.stop)) == list(range(len(cells.mean)))


@pytest.mark.parametrize(("voxel_mm", "n"), [(2.0 / 41, 41), (1.0 / 32, 64)])
def test_counts_of_cells_hold_every_voxel_of_micro_ct(voxel_mm, n):
    """From n = 41 voxels a side on, 16 bits do not hold the number of voxels of a cell; a second one has 3 columns."""
    voxels = np.full((n, n, n + 3), 601, np.int16)
    voxels[0, 0, 0] = 600  # dense, above 300 HU, but not hard, above 600 HU
    cells = measure_cells(Volume(voxels, np.diag((voxel_mm, voxel_mm, voxel_mm, 1.0))))
    assert cells.step == (n, n, n)
    assert cells.dense.ravel().tolist() == [n**3, 3 * n * n]
    assert cells.hard.ravel().tolist() == [n**3 - 1, 3 * n * n]


def test_only_the_value_of_the_largest_corner_of_a_slice_counts_as_not_measured_and_only_there():
    layer = np.random.default_rng(4).normal(0.0, 100.0, (20, 20))
    layer[:4, :4] = -3024.0  # sixteen voxels at a corner
    layer[16:, 17:] = -2000.0  # twelve at another
    layer[8:13, 8:13] = -3024.0  # the value of the first corner, but in the middle
    expected = np.zeros((20, 20), bool)
    expected[:4, :4] = True
    mirrored = layer[:, ::-1]
    unmeasured = np.stack(list(find_unmeasured(np.stack([layer, mirrored] * 3))))
    np.testing.assert_array_equal(unmeasured, np.stack([expected, expected[:, ::-1]] * 3))


@pytest.mark.parametrize("turns", range(4), ids=["left", "bottom", "right", "top"])
@pytest.mark.parametrize(("from_border", "is_cavity"), [(0, False), (1, False), (2, True)])
def test_air_within_a_cell_of_the_border_of_the_scan_is_no_cavity(from_border, is_cavity, turns):
    tissue = np.ones((1, 12, 12), bool)
    tissue[:, 5:8, from_border : from_border + 3] = False
    tissue = np.rot90(tissue, turns, (1, 2))
    # Tissue of different HU: of one value at a corner it would be padding.
    hu = np.where(tissue, np.arange(144).reshape(tissue.shape), -1000).astype(np.float32)
    cavities = _find_cavities(hu, tissue, thick=np.zeros_like(tissue), across=2.0)
    assert np.array_equal(cavities, ~tissue & is_cavity)
