"""The canal of one vertebra: of blocks whose canal is known, tilted ones, and of what has none."""

from __future__ import annotations

import numpy as np
import pytest
from variants import daily

from clrecon.geometry import Volume
from clrecon.labels.canal import _Places, find_canal

BODY, PEDICLES, LAMINA = (0, 30), (8, 22), (8, 14)
"""Heights in mm of the parts of a block; the canal is 20 mm wide and 16 mm deep between them."""


def block(spacing=(1.0, 1.0, 1.0), tilt=0.0, lamina=LAMINA, pedicles=PEDICLES, gap=0.0):
    """A vertebra of boxes: solid bone, volume, and where its canal is at the height of the pedicles."""
    size = np.ceil(np.array((70.0, 90.0, 50.0)) / spacing).astype(int)
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = -35.0, -45.0, -10.0
    k, j, i = np.indices(size[::-1])
    x, y, z = (affine[a, a] * index + affine[a, 3] for a, index in enumerate((i, j, k)))
    y = y - np.tan(np.radians(tilt)) * (z - np.mean(pedicles))

    def within(values, low, high):
        return (values >= low) & (values < high)

    body = within(np.abs(x), 0, 20) & within(y, -35, -8) & within(z, *BODY)
    sides = within(np.abs(x), 10, 18) & within(y, -8, 8) & within(z, *pedicles)
    arch = within(np.abs(x), gap, 18) & within(y, 8, 14) & within(z, *lamina)
    spine = within(np.abs(x), gap, 3) & within(y, 14, 30) & within(z, *lamina)
    canal = within(np.abs(x), 0, 10) & within(y, -8, 8) & within(z, *pedicles)
    return body | sides | arch | spine, Volume(np.zeros(size[::-1], np.int16), affine), canal


def test_the_canal_of_a_block_is_found_to_the_voxel():
    solid, volume, expected = block()
    canal = find_canal(solid, volume)
    assert np.array_equal(canal.voxels, expected)
    assert (canal.closed_slices, canal.together) == (6, 1)
    assert canal.height_mm == pytest.approx(14.0)


@pytest.mark.parametrize("tilt", [-20.0, 20.0])
def test_a_tilted_canal_goes_on_in_its_direction(tilt):
    solid, volume, expected = block(tilt=tilt)
    canal = find_canal(solid, volume)
    assert not (canal.voxels & solid).any()
    both = (canal.voxels & expected).sum()
    assert both >= 0.97 * expected.sum()
    assert both >= 0.97 * canal.voxels.sum()


def test_canal_is_found_in_coarse_and_anisotropic_voxels():
    for spacing in ((3.0, 3.0, 3.0), (0.8, 1.1, 4.0), (2.0, 2.0, 1.0)):
        solid, volume, expected = block(spacing)
        assert np.array_equal(find_canal(solid, volume).voxels, expected)


def test_slices_close_an_arch_together():
    # the lamina lies below the pedicles: no slice has both
    solid, volume, expected = block(lamina=(3, 8))
    canal = find_canal(solid, volume)
    assert canal.together == 2
    assert canal.closed_slices == 2
    assert (canal.voxels & expected).sum() >= 0.99 * expected.sum()
    assert canal.voxels.sum() <= 1.1 * expected.sum()


@pytest.mark.parametrize(
    "change", daily(1, [{"gap": 3.0}, {"pedicles": (8, 8)}, {"lamina": (25, 29), "pedicles": (2, 8)}]), ids=str
)
def test_an_open_arch_has_no_canal(change):
    solid, volume, _ = block(**change)
    assert find_canal(solid, volume) is None
    assert find_canal(np.zeros_like(solid), volume) is None


def test_holes_of_the_body_are_no_canal():
    solid, volume, expected = block()
    hollow = solid.copy()
    hollow[36:40, 15:30, 20:50] = False  # an endplate that is hollow: rings in the topmost slices
    hollow[:, 12:24, 25:45] = False  # a hole through the body, larger than the canal
    canal = find_canal(hollow, volume)
    assert np.array_equal(canal.voxels, expected)
    hollow[18:32, :, 17:53] = False  # and without a canal there is none
    assert find_canal(hollow, volume) is None


def test_closed_chamber_behind_the_canal_is_no_canal():
    solid, volume, expected = block()
    solid[16:28, 58:86, 10:60] = True  # a large spinous process, whose chamber is larger than the canal
    solid[18:26, 61:83, 13:57] = False
    assert np.array_equal(find_canal(solid, volume).voxels, expected)


def test_small_gaps_of_an_arch_are_no_canal():
    solid, volume, _ = block(pedicles=(8, 8))
    solid[18:24, 30:60, 30:60] = True
    solid[18:24, 50:55, 40:45] = False  # 25 mm2
    assert find_canal(solid, volume) is None


def test_gaps_of_a_pedicle_beside_the_canal_are_left_out():
    solid, volume, expected = block()
    solid[27:31, 40:44, 45:52] = False  # 7 mm into a pedicle, where the arch is open behind
    canal = find_canal(solid, volume)
    beside = canal.voxels & ~expected
    assert (expected & ~canal.voxels).sum() == 0
    assert beside.sum() == 4 * 4 * 4  # 4 mm of it
    assert beside[27:31, 40:44, 45:49].all()


def test_uneven_and_turned_slices_keep_their_places():
    solid, volume, expected = block()
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])  # rows and columns the other way round, as of a prone patient
    turned[:3, 3] = volume.affine[:3, 3] + volume.affine[:3, :2] @ (np.array(volume.shape_ijk[:2]) - 1)
    flipped = Volume(volume.voxels, turned)
    assert np.array_equal(find_canal(solid[:, ::-1, ::-1], flipped).voxels[:, ::-1, ::-1], expected)
    kept = np.array([k for k in range(50) if k % 3 != 1 or k < 6])
    origins = volume.slice_origins()[kept]
    uneven = Volume(volume.voxels[kept], volume.affine, slice_positions=origins)
    canal = find_canal(solid[kept], uneven)
    assert np.array_equal(canal.voxels, expected[kept])
    assert canal.height_mm == pytest.approx(14.0, abs=1.01)


def test_canal_shifted_beyond_a_slice_is_left_out():
    places = _Places(Volume(np.zeros((2, 3, 4), np.int16), np.eye(4)))
    full = np.ones((3, 4), bool)
    for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1), (2, -2)):
        shifted = places.shift(full, 0, 1, np.array([di, dj], float))
        expected = np.zeros((3, 4), bool)
        expected[max(0, dj) : 3 + min(0, dj), max(0, di) : 4 + min(0, di)] = True
        assert np.array_equal(shifted, expected)


def test_three_slices_tell_the_direction_of_a_canal():
    solid, volume, expected = block((1.0, 1.0, 4.0), tilt=20.0)
    canal = find_canal(solid, volume)
    assert np.count_nonzero(expected.any(axis=(1, 2))) == 3
    assert (canal.voxels & expected).sum() >= 0.97 * max(expected.sum(), canal.voxels.sum())
