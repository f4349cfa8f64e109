"""The box of what a picture can show: known voxels, bands, clips, labels, slices; tilted and uneven stacks."""

from __future__ import annotations

import math

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.rendering.views.clip import Clip, ShownLabels, check_center, find_seen_box

AFFINE = np.array([[2.0, 0, 0, -30.0], [0, 3.0, 0, -40.0], [0, 0, 5.0, 100.0], [0, 0, 0, 1]])


def block() -> np.ndarray:
    """Return air with a block of 500 HU at i 6 to 9, j 8 to 14, k 3 to 5, and one of 40 HU at i 15, j 2, k 9."""
    voxels = np.full((12, 20, 24), -1000, np.int16)
    voxels[3:6, 8:15, 6:10] = 500
    voxels[9, 2, 15] = 40
    return voxels


SHOWN = (0.0, math.inf)  # HU: both blocks, and not the air


def extent(box) -> list[list[float]]:
    """The lowest and highest corner of a box in mm."""
    corners = box_corners(box)
    return np.round([corners.min(axis=0), corners.max(axis=0)], 6).tolist()


def between(low, high) -> list[list[float]]:
    """The corners in mm of the voxels from one index to another, of AFFINE."""
    return [(AFFINE[:3, :3] @ index + AFFINE[:3, 3]).tolist() for index in (low, high)]


WHOLE = between((5, 1, 2), (16, 15, 10))  # one voxel beyond both blocks


def test_box_reaches_one_voxel_beyond_what_is_seen():
    box = find_seen_box(Volume(block(), AFFINE), (200.0, math.inf))

    assert extent(box) == between((5, 7, 2), (10, 15, 6))  # the block of 500 HU


def test_box_ends_half_a_voxel_beyond_the_outer_voxels_of_the_volume():
    box = find_seen_box(Volume(np.full((2, 3, 4), 300, np.int16), AFFINE), (200.0, math.inf))

    assert extent(box) == between((-0.5, -0.5, -0.5), (3.5, 2.5, 1.5))


def test_box_of_a_band_holds_what_is_above_its_low_end_and_below_its_high_end():
    voxels = block()
    voxels[voxels == -1000] = 700  # all above the band but for the block of 40 HU

    box = find_seen_box(Volume(voxels, AFFINE), (20.0, 60.0))

    assert extent(box) == between((14, 1, 8), (16, 3, 10))  # the block of 40 HU


def test_box_of_everything_holds_both_blocks():
    assert extent(find_seen_box(Volume(block(), AFFINE), SHOWN)) == WHOLE


def test_box_leaves_out_labels_that_are_hidden():
    volume = Volume(block(), AFFINE)
    labels = np.where(volume.voxels == 500, 2, 0).astype(np.uint8)
    hidden = ShownLabels(labels, np.array([True, True, False]))

    box = find_seen_box(volume, SHOWN, labels=hidden)

    assert extent(box) == between((14, 1, 8), (16, 3, 10))  # the block of 40 HU


def test_box_ends_at_the_side_of_a_clip_box_that_cuts_the_volume():
    clip = Clip.box((-10, -99, 0), (99, 99, 999))  # all but x = -10 mm lie beyond the volume

    box = find_seen_box(Volume(block(), AFFINE), SHOWN, clip=clip)

    assert extent(box) == [[-10.0, *WHOLE[0][1:]], WHOLE[1]]


def test_box_leaves_out_what_lies_beyond_an_aslant_clip_plane():
    clip = Clip.plane((0, 0, 130), (0, 0.2, -1))

    box = find_seen_box(Volume(block(), AFFINE), SHOWN, clip=clip)

    assert extent(box) == between((5, 7, 2), (10, 15, 6))  # the block of 500 HU, below the plane


@pytest.mark.parametrize(
    ("band", "clip"),
    [
        pytest.param(SHOWN, Clip.box((50, -99, 0), (99, 99, 999)), id="clipped away"),
        pytest.param((1000.0, math.inf), None, id="below the band"),
    ],
)
def test_volume_that_shows_nothing_has_no_box(band, clip):
    assert find_seen_box(Volume(block(), AFFINE), band, clip=clip) is None


def test_box_of_chosen_slices_leaves_out_the_others():
    box = find_seen_box(Volume(block(), AFFINE), SHOWN, slices=[4, 5, 6])

    assert extent(box) == between((5, 7, 4), (10, 15, 5))  # the block of 500 HU is in the slices 3 to 5


def test_box_of_an_uneven_and_sheared_stack_lies_where_its_slices_were_taken():
    heights = np.array([0, 1, 2, 10, 11, 20, 30, 31, 32, 33, 34, 35.0]) + 100.0
    places = np.column_stack([np.full(12, -30.0), -40.0 + 0.3 * heights, heights])  # sheared along j
    volume = Volume(block(), AFFINE, slice_positions=places)

    low, high = extent(find_seen_box(volume, (200.0, math.inf)))

    # The block of 500 HU and one voxel around it: i 5 to 10, j 7 to 15, slices 2 and 6 at 102 and 130 mm.
    assert low == pytest.approx([-30 + 2 * 5, -40 + 0.3 * 102 + 3 * 7, 102.0])
    assert high == pytest.approx([-30 + 2 * 10, -40 + 0.3 * 130 + 3 * 15, 130.0])


CUBE = Volume(np.zeros((20, 20, 20), np.int16), np.diag((2.0, 2.0, 2.0, 1.0)))
CENTRE = (3.0, 35.0, 12.0)  # mm, in the cube from -1 to 39
of_views = pytest.mark.parametrize(
    ("view", "angle"),
    [
        pytest.param("left", None, id="parallel from a side"),
        pytest.param((30, 20), None, id="parallel aslant"),
        pytest.param("anterior", 25.0, id="perspective"),
    ],
)


@of_views
def test_camera_with_a_centre_shows_it_in_the_middle_of_the_picture(view, angle):
    moved = Camera.fit(CUBE, view, view_angle=angle, center=CENTRE)

    pixels, _ = moved.project([CENTRE], (80, 60))
    assert moved.focal_point == CENTRE
    assert pixels[0] == pytest.approx((40.0, 30.0))


@of_views
def test_camera_with_a_centre_keeps_its_scale_and_direction(view, angle):
    plain = Camera.fit(CUBE, view, view_angle=angle)

    moved = Camera.fit(CUBE, view, view_angle=angle, center=CENTRE)

    assert (moved.parallel_scale, moved.view_angle) == (plain.parallel_scale, plain.view_angle)
    assert np.array(moved.basis()) == pytest.approx(np.array(plain.basis()))


@pytest.mark.parametrize("view", ["left", (30, 20)], ids=["from a side", "aslant"])
def test_parallel_camera_with_a_centre_has_the_whole_volume_in_front_of_it(view):
    moved = Camera.fit(CUBE, view, center=CENTRE)

    _, depths = moved.project(box_corners(CUBE), (80, 60))
    assert depths.min() > 0.0


@pytest.mark.parametrize(
    "center",
    [
        pytest.param((1.0, 2.0), id="two numbers"),
        pytest.param((1.0, 2.0, math.nan), id="not a number"),
        pytest.param("middle", id="text"),
        pytest.param((1, 2, 1000), id="above the volume"),
        pytest.param((-31.1, 0, 110), id="more than half a voxel beside the volume"),
    ],
)
def test_centre_that_is_no_point_of_the_volume_is_refused(center):
    with refused(UsageError, "centre"):
        check_center(center, Volume(block(), AFFINE))


def test_centre_in_the_volume_is_accepted_as_floats():
    assert check_center((-30, -40, 100), Volume(block(), AFFINE)) == (-30.0, -40.0, 100.0)
