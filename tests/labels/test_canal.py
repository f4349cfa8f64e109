"""The canal of one vertebra: of blocks whose canal is known, tilted ones, and of what has none."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from variants import daily

from clrecon.geometry import Volume
from clrecon.labels.canal import LEAST_HOLE_MM2, SPREAD_MM, _Places, find_canal

BODY, PEDICLES, LAMINA = (0, 30), (8, 22), (8, 14)
"""Heights in mm of the parts of a block; the canal is 20 mm wide and 16 mm deep between them."""


def make_block(spacing=(1.0, 1.0, 1.0), tilt=0.0, lamina=LAMINA, pedicles=PEDICLES, gap=0.0):
    """A vertebra of boxes: its solid bone, a volume, and its canal between the pedicles.

    By default a voxel is 1 mm; the first is at x = -35, y = -45 (in front), z = -10 mm.
    """
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


def dice(found, expected):
    """Twice the common voxels of two masks over the voxels of both."""
    return 2 * np.count_nonzero(found & expected) / (np.count_nonzero(found) + np.count_nonzero(expected))


def test_canal_between_the_pedicles_is_found_to_the_voxel():
    solid, volume, expected = make_block()
    assert np.array_equal(find_canal(solid, volume).voxels, expected)


def test_canal_says_its_height_and_the_slices_that_the_arch_closes():
    solid, volume, _ = make_block()
    canal = find_canal(solid, volume)
    assert canal.height_mm == pytest.approx(PEDICLES[1] - PEDICLES[0])
    assert canal.closed_slices == LAMINA[1] - LAMINA[0]  # of 1 mm
    assert canal.together == 1  # each of them closes the arch alone


@pytest.mark.parametrize("tilt", [-20.0, 20.0])
def test_tilted_canal_is_followed_in_its_direction_beyond_the_lamina(tilt):
    solid, volume, expected = make_block(tilt=tilt)
    canal = find_canal(solid, volume)
    assert not (canal.voxels & solid).any()
    assert dice(canal.voxels, expected) >= tolerances.TILTED_CANAL_DICE


@pytest.mark.parametrize("spacing", [(3.0, 3.0, 3.0), (0.8, 1.1, 4.0), (2.0, 2.0, 1.0)], ids=str)
def test_canal_is_found_to_the_voxel_in_coarse_and_anisotropic_voxels(spacing):
    solid, volume, expected = make_block(spacing)
    assert np.array_equal(find_canal(solid, volume).voxels, expected)


def test_arch_whose_lamina_lies_below_the_pedicles_is_closed_by_two_slices_together():
    solid, volume, expected = make_block(lamina=(3, 8), pedicles=(8, 22))  # no slice has both
    canal = find_canal(solid, volume)
    assert (canal.together, canal.closed_slices) == (2, 2)
    assert not (expected & ~canal.voxels).any()
    assert np.count_nonzero(canal.voxels) <= 1.1 * np.count_nonzero(expected)  # and a slice beside the lamina


@pytest.mark.parametrize(
    "arch",
    daily(
        1,
        [
            pytest.param({"gap": 3.0}, id="gap of 6 mm in the lamina"),
            pytest.param({"pedicles": (8, 8)}, id="no pedicles"),
            pytest.param({"lamina": (25, 29), "pedicles": (2, 8)}, id="lamina far above the pedicles"),
        ],
    ),
)
def test_vertebra_with_an_open_arch_has_no_canal(arch):
    solid, volume, _ = make_block(**arch)
    assert find_canal(solid, volume) is None


def test_map_without_bone_has_no_canal():
    solid, volume, _ = make_block()
    assert find_canal(np.zeros_like(solid), volume) is None


def block_with_a_hollow_body():
    solid, volume, canal = make_block()
    solid[36:40, 15:30, 20:50] = False  # an endplate that is hollow: rings in the topmost slices
    solid[:, 12:24, 25:45] = False  # a hole through the body, larger than the canal
    return solid, volume, canal


def test_canal_of_a_body_with_larger_holes_is_still_that_between_the_pedicles():
    solid, volume, expected = block_with_a_hollow_body()
    assert np.array_equal(find_canal(solid, volume).voxels, expected)


def test_holes_of_a_body_without_an_arch_are_no_canal():
    solid, volume, _ = block_with_a_hollow_body()
    solid[18:32, :, 17:53] = False  # pedicles and lamina, z from 8 to 22 mm, and the body between
    assert find_canal(solid, volume) is None


def test_closed_chamber_behind_the_canal_is_not_taken_for_it():
    solid, volume, expected = make_block()
    solid[16:28, 58:86, 10:60] = True  # a large spinous process, whose chamber is larger than the canal
    solid[18:26, 61:83, 13:57] = False
    assert np.array_equal(find_canal(solid, volume).voxels, expected)


def test_hole_of_25_mm2_behind_the_body_is_no_canal():
    assert LEAST_HOLE_MM2 > 25
    solid, volume, _ = make_block(pedicles=(8, 8))
    solid[18:24, 30:60, 30:60] = True
    solid[18:24, 50:55, 40:45] = False  # 5 x 5 voxels of 1 mm
    assert find_canal(solid, volume) is None


def test_gap_of_a_pedicle_beside_the_canal_counts_for_its_first_4_mm_alone():
    assert SPREAD_MM == 4.0
    solid, volume, expected = make_block()
    gap = np.zeros_like(solid)
    gap[27:31, 40:44, 45:52] = True  # 7 mm into a pedicle from the canal, in slices where the arch is open behind
    first_4_mm = np.zeros_like(solid)
    first_4_mm[27:31, 40:44, 45:49] = True
    canal = find_canal(solid & ~gap, volume)
    assert np.array_equal(canal.voxels, expected | first_4_mm)


def test_canal_of_a_scan_with_reversed_rows_and_columns_is_the_same():
    solid, volume, expected = make_block()
    reversed_affine = np.diag([-1.0, -1.0, 1.0, 1.0])  # as of a prone patient
    last_row_and_column = np.array(volume.shape_ijk[:2]) - 1
    reversed_affine[:3, 3] = volume.affine[:3, 3] + volume.affine[:3, :2] @ last_row_and_column
    canal = find_canal(solid[:, ::-1, ::-1], Volume(volume.voxels, reversed_affine))
    assert np.array_equal(canal.voxels[:, ::-1, ::-1], expected)


def test_canal_of_uneven_slices_is_the_same_in_the_slices_that_are_left():
    solid, volume, expected = make_block()
    kept = np.array([k for k in range(50) if k % 3 != 1 or k < 6])  # gaps of 1 and 2 mm
    uneven = Volume(volume.voxels[kept], volume.affine, slice_positions=volume.slice_origins()[kept])
    canal = find_canal(solid[kept], uneven)
    assert np.array_equal(canal.voxels, expected[kept])
    assert canal.height_mm == pytest.approx(PEDICLES[1] - PEDICLES[0], abs=1.01)  # half a gap at either end


@pytest.mark.parametrize("step", [(1, 0), (-1, 0), (0, 1), (0, -1), (2, -2)], ids=str)
def test_part_of_a_canal_shifted_beyond_a_slice_is_left_out(step):
    di, dj = step
    nj, ni = 3, 4
    places = _Places(Volume(np.zeros((2, nj, ni), np.int16), np.eye(4)))
    shifted = places.shift(np.ones((nj, ni), bool), source=0, target=1, slope=np.array(step, float))
    expected = np.zeros((nj, ni), bool)
    expected[max(0, dj) : nj + min(0, dj), max(0, di) : ni + min(0, di)] = True
    assert np.array_equal(shifted, expected)


def test_tilted_canal_of_three_slices_is_followed_in_its_direction():
    solid, volume, expected = make_block(spacing=(1.0, 1.0, 4.0), tilt=20.0)
    assert np.count_nonzero(expected.any(axis=(1, 2))) == 3
    canal = find_canal(solid, volume)
    assert dice(canal.voxels, expected) >= tolerances.TILTED_CANAL_DICE
