"""The gate ``shown_places``: slices in each other's place, told by what they show."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.reading.common.likeness import judge_shown_places


def make_slices(count: int = 14) -> np.ndarray:
    """A ball that moves by two pixels from slice to slice and grows."""
    k, j, i = np.indices((count, 40, 44), dtype=np.float64)
    return (900.0 - 60.0 * np.hypot(j - 12.0 - k, i - 8.0 - 2.0 * k)).clip(-1000.0, 900.0).astype(np.int16)


def test_slices_in_their_order_pass_the_gate() -> None:
    assert judge_shown_places(make_slices()).ok is True


@pytest.mark.parametrize(("first", "second"), [(3, 9), (2, 6), (4, 5), (7, 9)])
def test_two_slices_in_each_others_place_fail_the_gate_and_are_named(first: int, second: int) -> None:
    voxels = make_slices(14)
    voxels[[first, second]] = voxels[[second, first]]
    gate = judge_shown_places(voxels)
    assert gate.ok is False
    assert f"(slices {first + 1} and {second + 1} of 14 seem to lie" in gate.text


@pytest.mark.parametrize("end", [0, 13])
def test_slice_exchanged_with_the_first_or_last_passes_the_gate_unnoticed(end: int) -> None:
    """A known limit: the outermost slices have a neighbour on one side alone."""
    voxels = make_slices(14)
    voxels[[end, 6]] = voxels[[6, end]]
    assert judge_shown_places(voxels).ok is True
