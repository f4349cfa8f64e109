"""Numbers as messages write them: digits that mean something, no exponents."""

from __future__ import annotations

import pytest

from clrecon.system.text import format_digits, format_hu


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (10_000.0, 4, "10,000"), (12_345.6, 3, "12,346"), (0.0039123, 3, "0.00391"), (-311.789, 3, "-312"),
        (0.0, 3, "0"), (-0.0, 3, "0"), (2.5, 3, "2.5"), (1.0, 4, "1"), (99.96, 3, "100"), (1e-20, 2, "0"),
        (5e-6, 2, "0.000005"), (float("inf"), 3, "inf"), (float("nan"), 3, "nan"), (1e300, 3, "1e+300"),
    ],
)  # fmt: skip
def test_number_is_written_with_grouped_digits_and_no_exponent_unless_it_is_huge(value, digits, text):
    assert format_digits(value, digits) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(-1024.0, "-1024"), (3071, "3071"), (-311.789, "-312"), (0.25, "0.25"), (-0.0, "0"), (4e6, "4,000,000")],
)
def test_hu_are_written_whole_or_with_three_significant_digits(value, text):
    assert format_hu(value) == text
