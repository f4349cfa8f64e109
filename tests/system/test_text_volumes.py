"""Volumes in words: ml, and mm3 where ml have no digits left."""

from __future__ import annotations

import pytest

from clrecon.system.text import format_ml, format_volume

pytestmark = pytest.mark.unit


@pytest.mark.parametrize(
    ("ml", "short", "long"),
    [
        (1234.567, "1,235 ml", "1,234.57 ml"),
        (0.1, "0.1 ml", "0.10 ml"),
        (0.0999, "99.9 mm3", "99.9 mm3"),
        (0.003355, "3.35 mm3", "3.35 mm3"),
        (-0.002, "-2 mm3", "-2 mm3"),
        (0.0, "0 ml", "0 ml"),
    ],
)
def test_volumes_are_written_in_ml_and_below_a_tenth_of_a_ml_in_mm3(ml, short, long):
    assert (format_ml(ml), format_volume(ml)) == (short, long)
