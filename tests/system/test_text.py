"""Numbers as messages write them: digits that mean something, no exponents."""

from __future__ import annotations

import pytest

from clrecon.system.text import escape_character, format_digits, format_hu, guess_word


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


@pytest.mark.parametrize(
    ("character", "code"),
    [("\udcc3", "\\xc3"), ("\u202e", "\\u202e"), ("\0", "\\x00")],
    ids=["byte of a name", "turns text round", "nul"],
)
def test_character_that_is_not_printed_is_written_as_its_code(character, code):
    assert escape_character(character) == code


@pytest.mark.parametrize(("letters", "guess"), [(64, f" (did you mean {'b' * 63}?)"), (65, "")], ids=["64", "65"])
def test_word_of_up_to_64_letters_is_compared_with_those_that_are_known(letters, guess):
    assert guess_word("b" * letters, ["b" * 63]) == guess
