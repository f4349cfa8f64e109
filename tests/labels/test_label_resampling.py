"""Labels on the grid of a volume: exact where the grids are the same, nearest elsewhere, refused where they miss."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest
from label_files import OBLIQUE, make_labels
from refusals import refused

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap, resample_labels
from clrecon.labels.resample import _shares_of_bone, _take_aligned

VOXELS = make_labels((5, 7, 8))
VOLUME = Volume(np.zeros((5, 7, 8), np.int16), OBLIQUE)


def turned(axes, flipped):
    """The same labels in the same place with the axes of the array permuted and flipped."""
    voxels = np.flip(VOXELS, flipped).transpose(axes)
    ijk = np.eye(4)
    for axis in flipped:
        ijk[2 - axis, 2 - axis], ijk[2 - axis, 3] = -1.0, VOXELS.shape[axis] - 1.0
    order = np.eye(4)[[*(2 - np.argsort(axes)[::-1]), 3]]
    return LabelMap(voxels, OBLIQUE @ ijk @ order)


@pytest.mark.parametrize("axes", list(permutations(range(3))))
def test_permuted_and_flipped_grids_give_the_same_labels(axes):
    for flips in product((False, True), repeat=3):
        taken = resample_labels(turned(axes, tuple(a for a in range(3) if flips[a])), VOLUME)
        assert taken.exact
        assert np.array_equal(taken.voxels, VOXELS)
        assert taken.inside == {2: 1.0, 5: 1.0}


def test_a_part_of_the_grid_is_placed_where_it_belongs():
    affine = OBLIQUE.copy()
    affine[:, 3] = OBLIQUE @ (2, 1, 3, 1)
    taken = resample_labels(LabelMap(VOXELS[3:, 1:5, 2:7], affine), VOLUME)
    expected = np.zeros_like(VOXELS)
    expected[3:, 1:5, 2:7] = VOXELS[3:, 1:5, 2:7]
    assert taken.exact and np.array_equal(taken.voxels, expected)


def test_the_nearest_label_is_taken_on_any_grid():
    """Against brute force, voxel by voxel, on a turned and coarser grid."""
    from scipy.spatial.transform import Rotation

    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", (15, -25, 40), degrees=True).as_matrix() @ np.diag((0.9, 1.1, 3.0))
    affine[:3, 3] = VOLUME.ijk_to_lps([(3.5, 3, 2)])[0] - affine[:3, :3] @ (4, 4, 2)
    labels = LabelMap(make_labels((5, 9, 9), seed=3), affine)
    taken = resample_labels(labels, VOLUME)
    assert not taken.exact
    for k, j, i in np.ndindex(VOXELS.shape):
        place = np.linalg.solve(affine, [*VOLUME.ijk_to_lps([(i, j, k)])[0], 1.0])[:3]
        index = np.rint(place).astype(int)
        inside = (index >= 0).all() and (index < labels.shape_ijk).all()
        assert taken.voxels[k, j, i] == (labels.voxels[tuple(index[::-1])] if inside else 0)


def test_every_slice_is_placed_by_its_own_position(monkeypatch):
    """A stack with uneven gaps: the labels of the slice that lies there, not of the one with that number."""
    labels = LabelMap(VOXELS, np.diag((1.0, 1.0, 1.0, 1.0)))
    volume = Volume(np.zeros((3, 7, 8), np.int16), np.eye(4))
    heights = np.array([0.0, 1.0, 4.0])
    monkeypatch.setattr(Volume, "slice_origins", lambda self, border=0: np.outer(heights, (0, 0, 1.0)))
    assert np.array_equal(resample_labels(labels, volume).voxels, VOXELS[[0, 1, 4]])


def test_half_way_the_lower_index_wins():
    fine = np.diag((0.5, 1.0, 1.0, 1.0))
    fine[0, 3] = 0.25
    row = np.array([3, 0, 7, 9], np.uint8)
    volume = Volume(
        np.zeros((1, 1, 3), np.int16), np.array([[1.0, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    )
    assert resample_labels(LabelMap(row[None, None], fine), volume).voxels.tolist() == [[[3, 7, 0]]]


def test_share_of_each_label_inside_is_known():
    moved = OBLIQUE.copy()
    moved[:, 3] = OBLIQUE @ (4, 0, 0, 1)
    voxels = np.zeros((5, 7, 8), np.uint8)
    voxels[0, 0], voxels[1, 1, 6:] = 3, 4
    taken = resample_labels(LabelMap(voxels, moved), VOLUME)
    assert taken.inside == {3: 0.5, 4: 0.0}


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [-1, 1])
def test_voxels_beyond_any_side_are_not_inside(axis, side):
    moved = OBLIQUE.copy()
    moved[:3, 3] += side * OBLIQUE[:3, axis]
    size = VOXELS.shape[2 - axis]
    taken = resample_labels(LabelMap(np.full(VOXELS.shape, 3, np.uint8), moved), VOLUME)
    assert taken.inside == {3: pytest.approx((size - 1) / size, rel=1e-12)}


def test_axes_that_run_into_one_are_not_aligned():
    """Rows run along the diagonal of the map, and the slices lie a micrometre apart."""
    affine = np.array([[1, 0, 0, 0], [1, 0, 1e-3, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    labels = LabelMap(np.arange(27, dtype=np.uint8).reshape(3, 3, 3), np.eye(4))
    assert _take_aligned(labels, Volume(np.zeros((2, 3, 3), np.int16), affine)) is None
    across = np.array([[1, 1, 0, 0], [0, 1e-3, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    assert _take_aligned(labels, Volume(np.zeros((2, 3, 3), np.int16), across)) is None


def test_labels_of_another_place_are_refused_with_the_numbers():
    far = OBLIQUE.copy()
    far[:3, 3] += (0, 500, 0)
    with refused(RefusedInputError, "CT", 0):
        resample_labels(LabelMap(VOXELS, far), VOLUME)


def test_labels_below_the_first_voxel_along_all_axes_are_refused_with_both_places():
    far = np.eye(4)
    far[:3, 3] = -20.0
    volume = Volume(np.zeros((3, 4, 5), np.int16), np.eye(4))
    words = r"\(0.1 ml\) lie inside the CT: they span x -20 to -16, y -20 to -16, z -20 to -17 mm, the CT x 0 to 4,"
    with pytest.raises(RefusedInputError, match=words):
        resample_labels(LabelMap(np.ones((4, 5, 5), np.uint8), far), volume)


def test_an_empty_map_is_refused():
    with refused(RefusedInputError, "label", "empty"):
        resample_labels(LabelMap(np.zeros((2, 2, 2), np.uint8), OBLIQUE), VOLUME)


def test_array_in_place_of_a_label_map_is_refused():
    with refused(UsageError, "LabelMap", "labels"):
        resample_labels(VOXELS, VOLUME)


def test_an_aligned_map_is_cut_out_and_the_same_grid_is_not_copied():
    numbers = np.arange(60, dtype=np.int16).reshape(3, 4, 5)
    labels = LabelMap(numbers, np.eye(4))

    def taken(shape, shift):
        affine = np.eye(4)
        affine[:3, 3] = shift
        return _take_aligned(labels, Volume(np.zeros(shape, np.int16), affine))

    assert np.shares_memory(taken((3, 4, 5), (0, 0, 0)), labels.voxels)
    np.testing.assert_array_equal(taken((2, 3, 4), (0, 0, 0)), numbers[:2, :3, :4])
    np.testing.assert_array_equal(taken((2, 3, 4), (1, 1, 1)), numbers[1:, 1:, 1:])
    np.testing.assert_array_equal(
        taken((3, 4, 5), (0, 0, 1)), np.concatenate([numbers[1:], np.zeros_like(numbers[:1])])
    )
    assert taken((3, 4, 5), (0.5, 0, 0)) is None


def test_slices_leave_memory_one_by_one_where_bone_is_counted(monkeypatch):
    volume, left = Volume(np.full((3, 2, 2), 500, np.int16), np.eye(4)), []
    monkeypatch.setattr(Volume, "release_slices", lambda self, first, end: left.append((first, end)))
    half = np.zeros((3, 2, 2), np.uint8)
    assert _shares_of_bone(volume, half, half + 1) == [0.0, 1.0]
    assert left == [(0, 1), (1, 2), (2, 3)]
