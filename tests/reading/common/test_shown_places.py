"""The gate ``shown_places``: slices in each other's place, told by what they show."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.reading.common.likeness import judge_shown_places


def make_slices(count: int = 14) -> np.ndarray:
    """A ball that moves by two pixels from slice to slice and grows."""
    k, j, i = np.indices((count, 40, 44), dtype=np.float64)
    return (900.0 - 60.0 * np.hypot(j - 12.0 - k, i - 8.0 - 2.0 * k)).clip(-1000.0, 900.0).astype(np.int16)


@pytest.mark.parametrize(("first", "second"), [(3, 9), (2, 6), (4, 5), (7, 9)])
def test_two_slices_in_each_others_place_are_named(first: int, second: int) -> None:
    voxels = make_slices()
    assert judge_shown_places(voxels).ok is True
    voxels[[first, second]] = voxels[[second, first]]
    gate = judge_shown_places(voxels)
    assert gate.ok is False and f"(slices {first + 1} and {second + 1} of 14 seem to lie" in gate.text


@pytest.mark.parametrize("end", [0, 13])
def test_an_exchange_with_a_slice_at_an_end_is_not_told(end: int) -> None:
    voxels = make_slices()
    voxels[[end, 6]] = voxels[[6, end]]
    assert judge_shown_places(voxels).ok is True
