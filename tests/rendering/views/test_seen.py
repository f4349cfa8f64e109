"""The box of what a picture can show: known voxels, bands, clips, labels, slices; tilted and uneven stacks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.rendering.views.clip import Clip, ShownLabels, check_center, find_seen_box

AFFINE = np.array([[2.0, 0, 0, -30.0], [0, 3.0, 0, -40.0], [0, 0, 5.0, 100.0], [0, 0, 0, 1]])


def block(volume_shape=(12, 20, 24)) -> np.ndarray:
    """Return air with a block of 500 HU at i 6 to 9, j 8 to 14, k 3 to 5, and one of 40 HU at i 15, j 2, k 9."""
    voxels = np.full(volume_shape, -1000, np.int16)
    voxels[3:6, 8:15, 6:10] = 500
    voxels[9, 2, 15] = 40
    return voxels


def extent(box) -> list[list[float]]:
    corners = box_corners(box)
    return np.round([corners.min(axis=0), corners.max(axis=0)], 6).tolist()


def test_a_box_reaches_one_voxel_beyond_what_is_seen():
    box = find_seen_box(Volume(block(), AFFINE), (200.0, math.inf))
    assert extent(box) == [[-30 + 2 * 5, -40 + 3 * 7, 100 + 5 * 2], [-30 + 2 * 10, -40 + 3 * 15, 100 + 5 * 6]]


def test_a_box_ends_with_the_volume():
    box = find_seen_box(Volume(np.full((2, 3, 4), 300, np.int16), AFFINE), (200.0, math.inf))
    assert extent(box) == [[-31.0, -41.5, 97.5], [-23.0, -32.5, 107.5]]


def test_a_band_needs_what_is_above_its_low_end_and_below_its_high_end():
    voxels = block()
    voxels[voxels == -1000] = 700  # all above the band but for the block of 40 HU
    box = find_seen_box(Volume(voxels, AFFINE), (20.0, 60.0))
    assert extent(box) == [[-30 + 2 * 14, -40 + 3 * 1, 100 + 5 * 8], [-30 + 2 * 16, -40 + 3 * 3, 100 + 5 * 10]]


def test_labels_that_are_hidden_and_what_is_clipped_do_not_count():
    volume = Volume(block(), AFFINE)
    labels = np.zeros(volume.voxels.shape, np.uint8)
    labels[3:6, 8:15, 6:10] = 2
    hidden = ShownLabels(labels, np.array([True, True, False]))
    whole = find_seen_box(volume, (0.0, math.inf))
    small = find_seen_box(volume, (0.0, math.inf), labels=hidden)
    assert extent(small) == [[-2, -37, 140], [2, -31, 150]] and extent(whole) == [[-20, -37, 110], [2, 5, 150]]
    assert extent(find_seen_box(volume, (0.0, math.inf), clip=Clip.box((-10, -99, 0), (99, 99, 999)))) == [
        [-10.0, -37.0, 110.0], [2.0, 5.0, 150.0]
    ]  # fmt: skip
    below = find_seen_box(volume, (0.0, math.inf), clip=Clip.plane((0, 0, 130), (0, 0.2, -1)))
    assert extent(below) == [[-20, -19, 110], [-10, 5, 130]]
    assert find_seen_box(volume, (0.0, math.inf), clip=Clip.box((50, -99, 0), (99, 99, 999))) is None
    assert find_seen_box(volume, (1000.0, math.inf)) is None


def test_only_chosen_slices_count():
    box = find_seen_box(Volume(block(), AFFINE), (0.0, math.inf), slices=[4, 5, 6])
    assert extent(box) == [[-20, -19, 120], [-10, 5, 125]]


def test_tilted_and_uneven_stacks_lie_where_they_were_taken():
    voxels = block()
    heights = np.array([0, 1, 2, 10, 11, 20, 30, 31, 32, 33, 34, 35.0]) + 100.0
    places = np.column_stack([np.full(12, -30.0), -40.0 + 0.3 * heights, heights])  # sheared along j
    volume = Volume(voxels, AFFINE, slice_positions=places)
    low, high = extent(find_seen_box(volume, (200.0, math.inf)))
    assert (low[0], high[0]) == (-20, -10) and (low[2], high[2]) == (102.0, 130.0)
    assert low[1] == pytest.approx(-40 + 0.3 * 102 + 3 * 7) and high[1] == pytest.approx(-40 + 0.3 * 130 + 3 * 15)


def test_a_centre_moves_the_picture_and_keeps_its_scale():
    volume = Volume(np.zeros((20, 20, 20), np.int16), np.diag((2.0, 2.0, 2.0, 1.0)))
    for view, angle in (("left", None), ((30, 20), None), ("anterior", 25.0)):
        plain = Camera.fit(volume, view, view_angle=angle)
        moved = Camera.fit(volume, view, view_angle=angle, center=(3.0, 35.0, 12.0))
        assert moved.focal_point == (3.0, 35.0, 12.0)
        assert moved.parallel_scale == plain.parallel_scale and moved.view_angle == plain.view_angle
        assert np.allclose(moved.basis(), plain.basis())
        pixels, depths = moved.project([(3.0, 35.0, 12.0)], (80, 60))
        assert np.allclose(pixels, [(40.0, 30.0)])
        if angle is None:  # all of the volume is in front of the camera
            assert moved.project(box_corners(volume), (80, 60))[1].min() > 0.0


@pytest.mark.parametrize("center", [(1.0, 2.0), (1.0, 2.0, math.nan), "middle", (1, 2, 1000), (-31.1, 0, 110)])
def test_centres_that_cannot_be_are_refused(center):
    with pytest.raises(UsageError, match="centre of"):
        check_center(center, Volume(block(), AFFINE))
    assert check_center((-30, -40, 100), Volume(block(), AFFINE)) == (-30.0, -40.0, 100.0)
