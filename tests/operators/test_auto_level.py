"""The level "auto": that of `choose_iso_value`, wherever a level is taken, and reported."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from refusals import refused
from slab_surfaces import assert_same

import clrecon
from clrecon.errors import NoSurfaceError, UsageError


@pytest.fixture(scope="module")
def ball_of_bone() -> clrecon.Volume:
    """A ball of bone in soft tissue."""
    k, j, i = np.indices((24, 40, 40)) - np.array([11.5, 19.5, 19.5])[:, None, None, None]
    depth = 8.0 - np.sqrt(k**2 + j**2 + i**2)
    noise = np.random.default_rng(3).normal(0.0, 8.0, k.shape)
    return clrecon.Volume(np.rint(40 + 700 / (1 + np.exp(-2.0 * depth)) + noise).astype(np.int16), np.eye(4))


Take = Callable[[Any, Any, Any], Any]
TAKERS: dict[str, Take] = {
    "surface": lambda volume, level, device: clrecon.extract_isosurface(volume, level, device=device),
    "solid": lambda volume, level, device: clrecon.extract_isosurface(volume, level, solid=True, device=device),
    "surfaces": lambda volume, level, device: clrecon.extract_isosurfaces(volume, [level], device=device)[0],
    "method": lambda volume, level, device: clrecon.extract_by_method(volume, level, "t-mc", device=device),
    "label": lambda volume, level, device: clrecon.extract_labels(volume, boxed(volume), level, device=device)[1],
    "points": lambda volume, level, device: clrecon.extract_points(volume, level, device=device),
    "voxels": lambda volume, level, device: clrecon.extract_points(volume, level, kind="voxels", device=device),
    "filled": lambda volume, level, device: clrecon.fill_enclosed(volume, level, device=device),
}


def boxed(volume: clrecon.Volume) -> clrecon.LabelMap:
    return clrecon.LabelMap(np.ones(volume.shape, np.uint8), volume.affine)


@pytest.mark.first_device
@pytest.mark.parametrize("taker", TAKERS)
def test_auto_is_the_level_that_choose_iso_value_measures(
    taker: str, ball_of_bone: clrecon.Volume, device: Any
) -> None:
    measured = clrecon.choose_iso_value(ball_of_bone).iso_value
    auto, given = (TAKERS[taker](ball_of_bone, level, device) for level in ("auto", measured))
    if isinstance(auto, clrecon.Mesh):
        assert_same(auto, given)
    elif isinstance(auto, clrecon.PointCloud):
        assert np.array_equal(auto.points, given.points)
    else:
        assert np.array_equal(auto, given)


@pytest.mark.first_device
@pytest.mark.parametrize("taker", TAKERS)
def test_report_says_why_auto_chose_its_level(taker: str, ball_of_bone: clrecon.Volume, device: Any) -> None:
    choice = clrecon.choose_iso_value(ball_of_bone)
    auto, given = (TAKERS[taker](ball_of_bone, level, device).report for level in ("auto", choice.iso_value))
    if taker == "filled":
        auto, given = auto["solid"], given["solid"]
    assert auto["iso_value_reason"] == choice.reason
    assert auto["iso_value_choice"]["bone_hu"] == choice.bone_hu
    assert "iso_value_reason" not in given


SOFT_TISSUE = clrecon.Volume(np.full((8, 8, 8), 40, np.int16), np.eye(4))


def test_auto_is_refused_in_a_volume_without_bone(device: Any) -> None:
    with refused(NoSurfaceError, "bone", 40, 8):
        clrecon.extract_isosurface(SOFT_TISSUE, "auto", device=device)


def test_a_word_other_than_auto_is_refused_as_a_level(device: Any) -> None:
    with refused(UsageError, "bone"):
        clrecon.extract_isosurface(SOFT_TISSUE, "bone", device=device)  # type: ignore[arg-type]
