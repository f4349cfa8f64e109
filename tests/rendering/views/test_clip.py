"""Clip planes and boxes: which points they keep."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.views.clip import Clip

POINTS = np.random.default_rng(8).uniform(-10.0, 10.0, (500, 3))


def test_a_box_keeps_what_lies_between_its_corners():
    low, high = np.array([-4.0, -9.0, 1.0]), np.array([2.0, 3.0, 8.0])
    clip = Clip.box(low, high)
    assert clip.planes.shape == (6, 4)
    assert np.array_equal(clip.contains(POINTS), ((POINTS >= low) & (POINTS <= high)).all(axis=1))
    assert clip.contains([low, high]).all()


def test_infinite_sides_are_open():
    clip = Clip.box((-np.inf, -np.inf, 0.0), (np.inf, np.inf, 5.0))
    assert clip.planes.tolist() == [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, -1.0, -5.0]]


def test_a_plane_keeps_the_side_of_its_normal():
    clip = Clip.plane((1.0, 2.0, 3.0), (0.0, 3.0, 4.0))
    assert clip.planes[0] == pytest.approx([0.0, 0.6, 0.8, 3.6])
    assert np.array_equal(clip.contains(POINTS), (POINTS - (1, 2, 3)) @ (0.0, 3.0, 4.0) >= 0.0)


def test_two_clips_keep_what_each_keeps():
    first, second = Clip.box((-5, -5, -5), (5, 5, 5)), Clip.plane((0, 0, 0), (1, 1, 0))
    both = first & second
    assert both.planes.shape == (7, 4)
    assert np.array_equal(both.contains(POINTS), first.contains(POINTS) & second.contains(POINTS))


def test_without_planes_everything_is_kept():
    assert Clip().planes.shape == (0, 4)
    assert Clip().contains(POINTS).all()
    assert (Clip() & Clip.plane((0, 0, 0), (1, 0, 0))) == Clip([(2, 0, 0, 0)])


def test_equal_clips_hash_alike():
    assert len({Clip.box((0, 0, 0), (1, 1, 1)), Clip.box((-0.0, 0, 0), (1, 1, 1))}) == 1


def test_planes_cannot_be_changed():
    with refused(ValueError, "read-only"):
        Clip.plane((0, 0, 0), (1, 0, 0)).planes[0, 0] = 5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Clip([(1, 0, 0)]), "shape"),
        (lambda: Clip([(1, 0, 0, np.nan)]), "NaN"),
        (lambda: Clip([(1, 0, 0, 0), (0, 0, 0, 1)]), "clip plane 1 has a normal of length 0"),
        (lambda: Clip([("a", 0, 0, 0)]), "four numbers"),
        (lambda: Clip.plane((0, 0), (1, 0, 0)), "point of a clip plane"),
        (lambda: Clip.plane((0, 0, 0), (0, 0, 0)), "length 0"),
        (lambda: Clip.box((0, 0, 0), (1, 0, 1)), "from 0 to 0 mm along y"),
        (lambda: Clip.box((0, 0, np.nan), (1, 1, 1)), "two corners"),
        (lambda: Clip.box((0, 0), (1, 1, 1)), "two corners"),
    ],
)
def test_what_is_no_clip_is_refused(make, message):
    with pytest.raises(UsageError, match=message):
        make()
