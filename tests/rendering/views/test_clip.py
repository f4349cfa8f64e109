"""Clip planes and boxes: which points they keep."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.views.clip import Clip

POINTS = np.random.default_rng(8).uniform(-10.0, 10.0, (500, 3))


def test_box_keeps_the_points_between_its_corners():
    low, high = np.array([-4.0, -9.0, 1.0]), np.array([2.0, 3.0, 8.0])

    kept = Clip.box(low, high).contains(POINTS)

    assert np.array_equal(kept, ((POINTS >= low) & (POINTS <= high)).all(axis=1))
    assert 0 < kept.sum() < len(POINTS)


def test_box_keeps_its_corners():
    low, high = (-4.0, -9.0, 1.0), (2.0, 3.0, 8.0)

    assert Clip.box(low, high).contains([low, high]).tolist() == [True, True]


def test_infinite_sides_of_a_box_have_no_planes():
    clip = Clip.box((-np.inf, -np.inf, 0.0), (np.inf, np.inf, 5.0))

    assert clip.planes.tolist() == [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, -1.0, -5.0]]


def test_plane_is_its_unit_normal_and_the_height_of_its_point_along_it():
    clip = Clip.plane(point=(1.0, 2.0, 3.0), normal=(0.0, 3.0, 4.0))

    assert clip.planes[0] == pytest.approx([0.0, 3 / 5, 4 / 5, (2.0 * 3 + 3.0 * 4) / 5])


def test_plane_keeps_the_side_of_its_normal():
    on_plane, normal = (1.0, 2.0, 3.0), (0.0, 3.0, 4.0)

    kept = Clip.plane(on_plane, normal).contains(POINTS)

    assert np.array_equal(kept, (POINTS - on_plane) @ normal >= 0.0)
    assert 0 < kept.sum() < len(POINTS)


def test_two_clips_keep_the_points_that_both_keep():
    first, second = Clip.box((-5, -5, -5), (5, 5, 5)), Clip.plane((0, 0, 0), (1, 1, 0))

    kept = (first & second).contains(POINTS)

    assert np.array_equal(kept, first.contains(POINTS) & second.contains(POINTS))
    assert kept.sum() < first.contains(POINTS).sum()


def test_clip_without_planes_keeps_everything():
    assert Clip().contains(POINTS).all()


def test_clip_without_planes_and_another_are_the_other():
    assert (Clip() & Clip.plane((0, 0, 0), (1, 0, 0))) == Clip.plane((0, 0, 0), (1, 0, 0))


def test_planes_of_longer_normals_are_the_same_clip():
    assert Clip([(2, 0, 0, 8)]) == Clip([(1, 0, 0, 4)])


def test_equal_clips_are_one_in_a_set():
    clips = {Clip.box((0, 0, 0), (1, 1, 1)), Clip.box((-0.0, 0, 0), (1, 1, 1))}

    assert clips == {Clip.box((0, 0, 0), (1, 1, 1))}


def test_planes_of_a_clip_cannot_be_changed():
    clip = Clip.plane((0, 0, 0), (1, 0, 0))

    with refused(ValueError, "read-only"):
        clip.planes[0, 0] = 5


NO_CLIPS = {
    "three numbers": (lambda: Clip([(1, 0, 0)]), "shape"),
    "a distance that is no number": (lambda: Clip([(1, 0, 0, np.nan)]), "NaN"),
    "a plane without a normal": (
        lambda: Clip([(1, 0, 0, 0), (0, 0, 0, 1)]), "clip plane 1 has a normal of length 0",
    ),
    "a letter": (lambda: Clip([("a", 0, 0, 0)]), "four numbers"),
    "a point of two numbers": (lambda: Clip.plane((0, 0), (1, 0, 0)), "point of a clip plane"),
    "a normal of no length": (lambda: Clip.plane((0, 0, 0), (0, 0, 0)), "length 0"),
    "a flat box": (lambda: Clip.box((0, 0, 0), (1, 0, 1)), "from 0 to 0 mm along y"),
    "a corner that is no number": (lambda: Clip.box((0, 0, np.nan), (1, 1, 1)), "two corners"),
    "a corner of two numbers": (lambda: Clip.box((0, 0), (1, 1, 1)), "two corners"),
}  # fmt: skip


@pytest.mark.parametrize(("make", "message"), NO_CLIPS.values(), ids=NO_CLIPS)
def test_planes_and_boxes_that_make_no_clip_are_refused(make, message):
    with pytest.raises(UsageError, match=message):
        make()
