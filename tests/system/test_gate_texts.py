"""Texts of gates: a measured figure beside its bound."""

from __future__ import annotations

import math

import pytest

from clrecon.system.records import at_least, at_most


@pytest.mark.parametrize(
    ("measured", "unit", "text"),
    [
        (0.250004, "voxel", "distance: 0.250004 voxel, at most 0.25"),
        (0.25, "voxel", "distance: 0.25 voxel, at most 0.25"),
        (0.393111, None, "distance: 0.393, at most 0.25"),
        (0.25000004, None, "distance: 0.25000004, at most 0.25"),
    ],
)
def test_figure_of_a_gate_has_the_digits_that_tell_it_from_its_upper_bound(
    measured: float, unit: str | None, text: str
) -> None:
    assert at_most("p95", measured, bound=0.25, unit=unit, subject="distance").text == text


def test_figure_of_a_gate_has_the_digits_that_tell_it_from_its_lower_bound() -> None:
    gate = at_least("kept", 0.9799999, bound=0.98, unit=None, subject="bone")
    assert gate.text == "bone: 0.9799999, at least 0.98"


def test_figure_that_is_nan_fails_its_gate() -> None:
    assert at_most("p95", math.nan, bound=0.25, unit=None, subject="distance").ok is False
