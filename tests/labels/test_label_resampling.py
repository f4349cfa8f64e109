"""Labels on the grid of a volume: exact where the grids are the same, nearest elsewhere, refused where they miss."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest
import tolerances
from label_files import OBLIQUE, make_labels
from refusals import refused
from scipy.spatial.transform import Rotation

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap, resample_labels
from clrecon.labels.resample import _shares_of_bone, _take_aligned

VOXELS = make_labels((5, 7, 8), numbers=(0, 0, 2, 5))
VOLUME = Volume(np.zeros((5, 7, 8), np.int16), OBLIQUE)


def with_axes_of_array(axes, flipped):
    """The same labels in the same place with the axes of the array permuted and flipped."""
    voxels = np.flip(VOXELS, flipped).transpose(axes)
    ijk = np.eye(4)
    for axis in flipped:
        ijk[2 - axis, 2 - axis], ijk[2 - axis, 3] = -1.0, VOXELS.shape[axis] - 1.0
    order = np.eye(4)[[*(2 - np.argsort(axes)[::-1]), 3]]
    return LabelMap(voxels, OBLIQUE @ ijk @ order)


def at_voxel(i, j, k):
    """The affine of a grid whose first voxel lies at this voxel of VOLUME."""
    affine = OBLIQUE.copy()
    affine[:, 3] = OBLIQUE @ (i, j, k, 1)
    return affine


@pytest.mark.parametrize("axes", list(permutations(range(3))), ids=str)
@pytest.mark.parametrize("flips", list(product((False, True), repeat=3)), ids=str)
def test_map_with_permuted_and_flipped_axes_gives_the_same_labels_exactly(axes, flips):
    flipped = tuple(axis for axis in range(3) if flips[axis])
    resampled = resample_labels(with_axes_of_array(axes, flipped), VOLUME)
    assert resampled.exact
    assert np.array_equal(resampled.voxels, VOXELS)
    assert resampled.inside == {2: 1.0, 5: 1.0}


def test_map_of_a_part_of_the_grid_is_placed_where_it_belongs():
    part = slice(3, None), slice(1, 5), slice(2, 7)  # k, j, i
    resampled = resample_labels(LabelMap(VOXELS[part], at_voxel(2, 1, 3)), VOLUME)
    expected = np.zeros_like(VOXELS)
    expected[part] = VOXELS[part]
    assert resampled.exact
    assert np.array_equal(resampled.voxels, expected)


def test_map_on_an_oblique_and_coarser_grid_gives_the_label_of_the_nearest_voxel():
    """Against brute force, voxel by voxel."""
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", (15, -25, 40), degrees=True).as_matrix() @ np.diag((0.9, 1.1, 3.0))
    middle_of_map, middle_of_volume = (4, 4, 2), (3.5, 3, 2)
    affine[:3, 3] = VOLUME.ijk_to_lps([middle_of_volume])[0] - affine[:3, :3] @ middle_of_map
    labels = LabelMap(make_labels((5, 9, 9), seed=3), affine)

    resampled = resample_labels(labels, VOLUME)

    assert not resampled.exact
    for k, j, i in np.ndindex(VOXELS.shape):
        place = np.linalg.solve(affine, [*VOLUME.ijk_to_lps([(i, j, k)])[0], 1.0])[:3]
        nearest_ijk = np.rint(place).astype(int)
        is_inside = (nearest_ijk >= 0).all() and (nearest_ijk < labels.shape_ijk).all()
        nearest_kji = tuple(nearest_ijk[::-1])
        assert resampled.voxels[k, j, i] == (labels.voxels[nearest_kji] if is_inside else 0)


def test_slices_with_uneven_gaps_get_the_labels_at_their_own_positions():
    labels = LabelMap(VOXELS, np.eye(4))
    positions = [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 4.0)]
    volume = Volume(np.zeros((3, 7, 8), np.int16), np.eye(4), slice_positions=positions)
    assert np.array_equal(resample_labels(labels, volume).voxels, VOXELS[[0, 1, 4]])


def test_voxel_half_way_between_two_of_the_map_gets_the_lower_one():
    half_as_wide = np.diag((0.5, 1.0, 1.0, 1.0))
    half_as_wide[0, 3] = 0.25  # voxels at x = 0.25, 0.75, 1.25, 1.75
    row = np.array([3, 0, 7, 9], np.uint8)
    at_half = np.eye(4)
    at_half[0, 3] = 0.5  # voxels at x = 0.5, 1.5, 2.5
    volume = Volume(np.zeros((1, 1, 3), np.int16), at_half)
    assert resample_labels(LabelMap(row[None, None], half_as_wide), volume).voxels.tolist() == [[[3, 7, 0]]]


def test_share_of_each_label_inside_of_the_volume_is_known():
    voxels = np.zeros((5, 7, 8), np.uint8)
    voxels[0, 0] = 3  # 8 columns, of which the last 4 leave the volume
    voxels[1, 1, 6:] = 4  # all of it leaves
    resampled = resample_labels(LabelMap(voxels, at_voxel(4, 0, 0)), VOLUME)
    assert resampled.inside == {3: 0.5, 4: 0.0}


@pytest.mark.parametrize("axis", range(3), ids=["i", "j", "k"])
@pytest.mark.parametrize("side", [-1, 1], ids=["below", "above"])
def test_layer_of_voxels_beyond_any_side_of_the_volume_is_not_inside(axis, side):
    layers = VOXELS.shape[2 - axis]
    step = [0, 0, 0]
    step[axis] = side
    resampled = resample_labels(LabelMap(np.full(VOXELS.shape, 3, np.uint8), at_voxel(*step)), VOLUME)
    assert resampled.inside == {3: pytest.approx((layers - 1) / layers, rel=tolerances.INSIDE_SHARE)}


@pytest.mark.parametrize(
    "affine",
    [
        np.array([[1, 0, 0, 0], [1, 0, 1e-3, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]]),  # slices a micrometre apart
        np.array([[1, 1, 0, 0], [0, 1e-3, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),  # columns a micrometre apart
    ],
    ids=["slices", "columns"],
)
def test_volume_with_an_axis_along_the_diagonal_of_the_map_is_not_aligned_with_it(affine):
    labels = LabelMap(np.arange(27, dtype=np.uint8).reshape(3, 3, 3), np.eye(4))
    assert _take_aligned(labels, Volume(np.zeros((2, 3, 3), np.int16), affine)) is None


def test_map_beside_the_scan_is_refused_with_the_share_inside():
    beside = OBLIQUE.copy()
    beside[1, 3] += 500.0  # mm
    with refused(RefusedInputError, "CT", 0):
        resample_labels(LabelMap(VOXELS, beside), VOLUME)


def test_map_below_the_scan_along_all_axes_is_refused_with_both_places():
    below = np.eye(4)
    below[:3, 3] = -20.0
    volume = Volume(np.zeros((3, 4, 5), np.int16), np.eye(4))
    words = r"\(0.1 ml\) lie inside the CT: they span x -20 to -16, y -20 to -16, z -20 to -17 mm, the CT x 0 to 4,"
    with pytest.raises(RefusedInputError, match=words):
        resample_labels(LabelMap(np.ones((4, 5, 5), np.uint8), below), volume)


def test_map_without_a_labelled_voxel_is_refused():
    with refused(RefusedInputError, "label", "empty"):
        resample_labels(LabelMap(np.zeros((2, 2, 2), np.uint8), OBLIQUE), VOLUME)


def test_array_in_place_of_a_label_map_is_refused():
    with refused(UsageError, "LabelMap", "labels"):
        resample_labels(VOXELS, VOLUME)


NUMBERS = np.arange(60, dtype=np.int16).reshape(3, 4, 5)


def take_aligned(labels, *, shape, shift):
    """Labels on a grid of `shape` [k, j, i] whose first voxel lies at `shift` (x, y, z); None where they do not fit."""
    affine = np.eye(4)
    affine[:3, 3] = shift
    return _take_aligned(labels, Volume(np.zeros(shape, np.int16), affine))


@pytest.mark.parametrize(
    ("shape", "shift", "expected"),
    [
        pytest.param((2, 3, 4), (0, 0, 0), NUMBERS[:2, :3, :4], id="first voxels"),
        pytest.param((2, 3, 4), (1, 1, 1), NUMBERS[1:, 1:, 1:], id="last voxels"),
        pytest.param((3, 4, 5), (0, 0, 1), np.concatenate([NUMBERS[1:], 0 * NUMBERS[:1]]), id="a slice beyond"),
    ],
)
def test_voxels_of_an_aligned_map_are_cut_out_and_zeros_put_beyond_it(shape, shift, expected):
    np.testing.assert_array_equal(take_aligned(LabelMap(NUMBERS, np.eye(4)), shape=shape, shift=shift), expected)


def test_map_on_the_grid_of_the_volume_is_not_copied():
    labels = LabelMap(NUMBERS, np.eye(4))
    assert np.shares_memory(take_aligned(labels, shape=(3, 4, 5), shift=(0, 0, 0)), labels.voxels)


def test_map_half_a_voxel_aside_is_not_aligned():
    assert take_aligned(LabelMap(NUMBERS, np.eye(4)), shape=(3, 4, 5), shift=(0.5, 0, 0)) is None


def test_slices_leave_memory_one_by_one_while_shares_of_bone_are_counted(monkeypatch):
    volume_of_bone, released = Volume(np.full((3, 2, 2), 500, np.int16), np.eye(4)), []
    monkeypatch.setattr(Volume, "release_slices", lambda self, first, end: released.append((first, end)))
    nothing = np.zeros((3, 2, 2), np.uint8)
    assert _shares_of_bone(volume_of_bone, nothing, nothing + 1) == [0.0, 1.0]
    assert released == [(0, 1), (1, 2), (2, 3)]
