"""Ways to group slices by the values of one element, and orders in which values repeat: closed cases without files."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pydicom.datadict import keyword_for_tag

from clrecon.reading.dicom.stack import mixtures
from clrecon.reading.dicom.stack.mixtures import ELEMENT_KINDS, INSTANCE_NUMBER, _code, alternates, find_verdict

DOCS = Path(__file__).parents[3] / "docs"
TAG = 0x00080032


def codes_of(tag, values):
    """Each way to group slices by an element: a digit for the group of each slice, and whether groups are ranges."""
    return [("".join(map(str, codes)), heaps) for codes, heaps in _code(tag, [str(value).encode() for value in values])]


@pytest.mark.parametrize(
    ("values", "codes"),
    [
        pytest.param((5, 30, 5, 30), "0101", id="two numbers"),
        pytest.param((10, 9, 10), "101", id="numbers in their order, not in that of text"),
        pytest.param(("a", "b", "c"), "012", id="three texts"),
        pytest.param(("1", "nan", "inf"), "210", id="two that are no numbers"),
    ],
)
def test_slices_with_few_values_are_grouped_by_value(values, codes):
    assert codes_of(TAG, values) == [(codes, False)]


def test_slices_with_three_numbers_are_also_grouped_by_ranges_at_the_widest_step():
    assert codes_of(TAG, (1, 2, 4)) == [("012", False), ("001", True), ("012", True)]  # 2 to 4 is the widest


def test_slices_with_nine_numbers_are_grouped_by_ranges_alone():
    nine = (0, 1, 2, 100, 101, 1000, 1001, 5000, 5001)
    assert codes_of(TAG, nine) == [("000000011", True), ("000001122", True), ("000112233", True)]


def test_slices_with_eight_values_are_still_grouped_by_value():
    assert codes_of(TAG, range(8))[0] == ("01234567", False)


def test_slices_without_the_element_are_one_group_or_differ_from_all_others():
    assert codes_of(TAG, ("", "a", "", "b")) == [("0102", False), ("0101", False)]


def test_instance_numbers_of_twelve_slices_are_grouped_in_two_halves():
    assert codes_of(INSTANCE_NUMBER, range(12)) == [("000000111111", True)]


@pytest.mark.parametrize("values", [range(11), [*range(11), "x"]], ids=["eleven", "one is no number"])
def test_instance_numbers_of_fewer_slices_or_with_a_text_are_not_grouped(values):
    assert codes_of(INSTANCE_NUMBER, values) == []


def test_each_element_whose_alternation_is_judged_is_known_and_in_one_row():
    keywords = [keyword_for_tag(tag) for kind in ELEMENT_KINDS for tag in kind.tags]
    assert "" not in keywords
    assert len(keywords) == len(set(keywords)) > 0


def test_rows_of_elements_on_the_page_are_those_of_the_code():
    kinds = {(kind.verdict, kind.reason): {keyword_for_tag(tag) for tag in kind.tags} for kind in ELEMENT_KINDS}
    page = (DOCS / "geometry.md").read_text()
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| (.+?) \| (\w+) .*\|$", page, re.M)
    assert {(verdict, reason): set(re.findall(r"\w+", names)) for names, reason, verdict in rows} == kinds


def test_elements_that_differ_in_every_series_are_never_judged():
    assert {keyword_for_tag(tag) for tag in mixtures.NEVER} == {
        *("SOPInstanceUID", "SeriesInstanceUID", "InstanceNumber", "ImagePositionPatient", "ImageOrientationPatient"),
        "SliceLocation",
    }


@pytest.mark.parametrize(
    ("tag", "even", "uneven"),
    [
        (0x00080032, "phases", "phases"),  # AcquisitionTime
        (0x00181140, "nothing", "pixels"),  # RotationDirection
        (0x00181151, "pixels", "pixels"),  # XRayTubeCurrent
        (0x00181130, "pixels", "phases"),  # TableHeight: in no row
        (0x00291010, "pixels", "pixels"),  # private
    ],
)
def test_alternating_element_has_its_verdict_in_even_and_uneven_stacks(tag, even, uneven):
    assert (find_verdict(tag, even=True), find_verdict(tag, even=False)) == (even, uneven)


def test_order_of_values_alternates_where_it_repeats_three_times():
    codes = [0, 0, 1, 1] * 3
    even_gaps = [1.0] * (len(codes) - 1)
    assert alternates(codes, even_gaps)
    assert not alternates(codes[:-1], even_gaps[:-1])
