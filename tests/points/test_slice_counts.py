"""Ghost slices from counts: figures of the slices, without a device."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.points.ghost_slices import judge_slices


def test_figures_of_five_slices_are_those_by_hand() -> None:
    """The middle slice is the likest of its neighbours to none: 2 * 10 / 50 behind, and these are 2 * 11 / 40 alike."""
    counts = np.array([[10, 20, 30, 20, 10], [6, 5, 10, 9, 0], [4, 11, 5, 0, 0]])
    found = judge_slices(counts, 100, (200.0, np.inf), ("a word",))
    np.testing.assert_allclose(found.nearest, [np.nan, 0.4, 0.4, 0.6, np.nan], rtol=1e-12)
    np.testing.assert_allclose(found.around, [np.nan, 0.2, 0.55, 0.25, np.nan], rtol=1e-12)
    within = (10 / 20 - 0.3) / 0.7  # of the slice behind in this one: more than the other way round
    np.testing.assert_allclose(found.within, [np.nan, (6 / 10 - 0.2) / 0.8, within, (9 / 10 - 0.2) / 0.8, np.nan])
    assert (found.slices, found.tested, found.warnings) == ((2,), 3, ("a word",))
    assert found.as_dict() == {
        "hu": [200.0, np.inf],
        "slices": 5,
        "slices_tested": 3,
        "ghost_slices": [
            {
                "slice": 2,
                "points": 30,
                "dice_with_neighbour": 0.4,
                "dice_of_neighbours": 0.55,
                "share_within_neighbour": round(within, 4),
            }
        ],
        "ghost_share": 0.75,
        "within_share": 0.42,
        "least_share_of_others": 2.0,
    }


@pytest.mark.parametrize("alike", [(0, 9), (9, 0)])
def test_a_slice_like_one_of_its_neighbours_is_no_ghost(alike: tuple[int, int]) -> None:
    found = judge_slices(np.array([[10, 10, 10], [*alike, 0], [8, 0, 0]]), 100, (0.0, 1.0))
    assert found.slices == () and found.nearest[1] == pytest.approx(0.9) and found.around[1] == pytest.approx(0.8)


@pytest.mark.parametrize("common", [5, 6, 7])
def test_a_ghost_has_less_than_three_quarters(common: int) -> None:
    found = judge_slices(np.array([[8, 8, 8], [common, 0, 0], [8, 0, 0]]), 9, (0.0, 1.0))
    assert found.slices == ((1,) if common == 5 else ())


@pytest.mark.parametrize("alike", [(70, 0), (0, 70), (72, 0), (0, 72)])
def test_less_than_042_of_a_ghost_lies_within_a_neighbour(alike: tuple[int, int]) -> None:
    """0.70 and 0.72 of its voxels, where chance is 0.5: 0.40 and 0.44, as a clean phantom of 5 mm has."""
    found = judge_slices(np.array([[100, 100, 100], [*alike, 0], [100, 0, 0]]), 200, (0.0, 1.0))
    assert found.slices == ((1,) if max(alike) == 70 else ())
