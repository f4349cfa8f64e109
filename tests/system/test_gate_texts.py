"""Texts of gates."""

from __future__ import annotations

import math

from clrecon.system.records import at_least, at_most


def test_a_figure_beside_its_bound_has_the_digits_that_tell_them_apart() -> None:
    assert at_most("p95", 0.250004, 0.25, "voxel", "distance")["text"] == "distance: 0.250004 voxel, at most 0.25"
    assert at_most("p95", 0.25, 0.25, "voxel", "distance")["text"] == "distance: 0.25 voxel, at most 0.25"
    assert at_most("p95", 0.393111, 0.25, None, "distance")["text"] == "distance: 0.393, at most 0.25"
    assert at_least("kept", 0.9799999, 0.98, None, "bone")["text"] == "bone: 0.9799999, at least 0.98"
    assert at_most("p95", math.nan, 0.25, None, "distance")["ok"] is False
