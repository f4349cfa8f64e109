"""Ghost slices from counts: figures of the slices, without a device."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.points.ghost_slices import GhostSlices, judge_slices

VOXELS_OF_SLICES = [10, 20, 30, 20, 10]
WITH_THE_NEXT, WITH_THE_NEXT_BUT_ONE = [6, 5, 10, 9, 0], [4, 11, 5, 0, 0]
"""Columns of 100 in which a slice has a voxel and the next one too, or the next but one."""


@pytest.fixture
def five_slices() -> GhostSlices:
    """The middle one is the least like its neighbours, which are more like each other."""
    counts = np.array([VOXELS_OF_SLICES, WITH_THE_NEXT, WITH_THE_NEXT_BUT_ONE])
    return judge_slices(counts, area=100, hu=(200.0, np.inf), warnings=("a word",))


def test_likeness_of_a_slice_is_the_larger_dice_coefficient_with_its_two_neighbours(five_slices: GhostSlices) -> None:
    with_0, with_1, with_2, with_3 = (2 * common / pair for common, pair in [(6, 30), (5, 50), (10, 50), (9, 30)])
    expected = [np.nan, max(with_0, with_1), max(with_1, with_2), max(with_2, with_3), np.nan]
    np.testing.assert_allclose(five_slices.nearest, expected)


def test_likeness_of_the_neighbours_of_a_slice_is_their_dice_coefficient(five_slices: GhostSlices) -> None:
    expected = [np.nan, 2 * 4 / (10 + 30), 2 * 11 / (20 + 20), 2 * 5 / (30 + 10), np.nan]
    np.testing.assert_allclose(five_slices.around, expected)


BEYOND_CHANCE_OF_SLICE_2 = (10 / 20 - 0.3) / 0.7
"""Half of the slice behind lies in slice 2, which holds 0.3 of all columns by chance."""


def test_the_share_of_a_slice_within_a_neighbour_counts_beyond_chance(five_slices: GhostSlices) -> None:
    """The larger share of the four: of the slice in either neighbour, and of either neighbour in the slice."""
    expected = [np.nan, (6 / 10 - 0.2) / 0.8, BEYOND_CHANCE_OF_SLICE_2, (9 / 10 - 0.2) / 0.8, np.nan]
    np.testing.assert_allclose(five_slices.within, expected)


def test_a_slice_less_like_its_neighbours_than_these_are_like_each_other_is_a_ghost(five_slices: GhostSlices) -> None:
    assert (five_slices.slices, five_slices.tested) == ((2,), 3)


def test_warnings_of_the_counts_are_those_of_the_judged_slices(five_slices: GhostSlices) -> None:
    assert five_slices.warnings == ("a word",)


def test_the_report_of_ghost_slices_has_the_figures_of_each_and_the_limits(five_slices: GhostSlices) -> None:
    assert five_slices.as_dict() == {
        "hu": [200.0, np.inf],
        "slices": 5,
        "slices_tested": 3,
        "ghost_slices": [
            {
                "slice": 2,
                "points": VOXELS_OF_SLICES[2],
                "dice_with_neighbour": 2 * 10 / (30 + 20),
                "dice_of_neighbours": 2 * 11 / (20 + 20),
                "share_within_neighbour": round(BEYOND_CHANCE_OF_SLICE_2, 4),
            }
        ],
        "ghost_share": 0.75,
        "within_share": 0.42,
        "least_share_of_others": 2.0,
    }


def judge_three_slices(*, voxels: int, common: tuple[int, int], around: int, columns: int) -> GhostSlices:
    """Three slices of so many voxels each: those in common with either neighbour, and of both neighbours."""
    return judge_slices(np.array([[voxels] * 3, [*common, 0], [around, 0, 0]]), area=columns, hu=(0.0, 1.0))


@pytest.mark.parametrize("common", [(0, 9), (9, 0)], ids=["with the next", "with the one before"])
def test_a_slice_more_like_one_of_its_neighbours_than_these_are_like_each_other_is_no_ghost(
    common: tuple[int, int],
) -> None:
    judged = judge_three_slices(voxels=10, common=common, around=8, columns=100)
    assert judged.nearest[1] == pytest.approx(0.9)
    assert judged.around[1] == pytest.approx(0.8)
    assert judged.slices == ()


@pytest.mark.parametrize(("common", "ghosts"), [(5, (1,)), (6, ()), (7, ())])
def test_a_ghost_is_less_than_three_quarters_as_like_its_neighbours_as_these_are_like_each_other(
    common: int, ghosts: tuple[int, ...]
) -> None:
    """The neighbours are equal, with 8 voxels each."""
    assert judge_three_slices(voxels=8, common=(common, 0), around=8, columns=9).slices == ghosts


@pytest.mark.parametrize(
    ("common", "ghosts"), [((70, 0), (1,)), ((0, 70), (1,)), ((72, 0), ()), ((0, 72), ())], ids=str
)
def test_less_than_42_percent_beyond_chance_of_a_ghost_lie_within_a_neighbour(
    common: tuple[int, int], ghosts: tuple[int, ...]
) -> None:
    """0.70 and 0.72 of its voxels, where chance is 0.5: 0.40 and 0.44, as a clean phantom of 5 mm has."""
    assert judge_three_slices(voxels=100, common=common, around=100, columns=200).slices == ghosts
