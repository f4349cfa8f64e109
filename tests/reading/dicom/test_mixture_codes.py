"""Ways to group slices by the values of one element, and orders in which values repeat: closed cases without files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from pydicom.datadict import keyword_for_tag

from clrecon.reading.dicom.stack import mixtures
from clrecon.reading.dicom.stack.mixtures import ELEMENT_KINDS, INSTANCE_NUMBER, _code, alternates, find_verdict

DOCS = Path(__file__).parents[3] / "docs"
TAG = 0x00080032


def ways(tag, values):
    return [("".join(map(str, codes)), heaps) for codes, heaps in _code(tag, [str(value).encode() for value in values])]


def test_few_values_are_groups_and_many_are_heaps_at_the_widest_steps():
    assert ways(TAG, (5, 30, 5, 30)) == [("0101", False)]
    assert ways(TAG, (10, 9, 10)) == [("101", False)]  # in the order of numbers, not of text
    three = [("012", False), ("001", True), ("012", True)]  # the widest step is the last
    assert ways(TAG, (1, 2, 4)) == three
    nine = (0, 1, 2, 100, 101, 1000, 1001, 5000, 5001)
    assert ways(TAG, nine) == [("000000011", True), ("000001122", True), ("000112233", True)]
    assert ways(TAG, range(8))[0] == ("01234567", False)  # the most values that are groups
    assert ways(TAG, ("", "a", "", "b")) == [("0102", False), ("0101", False)]
    assert ways(TAG, ("a", "b", "c")) == [("012", False)]
    assert ways(TAG, ("1", "nan", "inf")) == [("210", False)]  # two of them are no numbers


def test_instance_numbers_are_two_heaps_from_twelve_slices_on():
    assert ways(INSTANCE_NUMBER, range(11)) == []
    assert ways(INSTANCE_NUMBER, range(12)) == [("000000111111", True)]
    assert ways(INSTANCE_NUMBER, [*range(11), "x"]) == []


def test_elements_whose_alternation_is_judged_are_those_of_the_page():
    kinds = {(kind.verdict, kind.reason): {keyword_for_tag(tag) for tag in kind.tags} for kind in ELEMENT_KINDS}
    assert all("" not in keywords for keywords in kinds.values())
    assert len(kinds) == len(ELEMENT_KINDS) and sum(map(len, kinds.values())) == len(set().union(*kinds.values()))
    page = (DOCS / "geometry.md").read_text()
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| (.+?) \| (\w+) .*\|$", page, re.M)
    assert {(verdict, reason): set(re.findall(r"\w+", names)) for names, reason, verdict in rows} == kinds
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
def test_alternating_elements_have_their_verdict_in_even_and_uneven_stacks(tag, even, uneven):
    assert (find_verdict(tag, True), find_verdict(tag, False)) == (even, uneven)


def test_an_order_has_to_repeat_three_times():
    codes = [0, 0, 1, 1] * 3
    even = np.ones(len(codes) - 1)
    assert alternates(codes, even.tolist()) and not alternates(codes[:-1], even[:-1].tolist())
