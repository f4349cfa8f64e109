"""The time limit of devices: how it is given, and that it is given back."""

from __future__ import annotations

import math

import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.system.progress import DEFAULT_SECONDS, device_seconds, time_limit


def test_time_limit_counts_within_its_block_and_the_outer_one_again_after_it():
    assert device_seconds() == DEFAULT_SECONDS
    with time_limit(3):
        with time_limit(5):
            assert device_seconds() == 5.0
        assert device_seconds() == 3.0
    assert device_seconds() == DEFAULT_SECONDS


def test_time_limit_of_0_seconds_is_no_limit():
    with time_limit(0):
        assert device_seconds() == math.inf


@pytest.mark.parametrize("limit", [-1, math.nan, "5", None, True])
def test_time_limit_that_is_no_positive_number_or_0_is_refused(limit):
    with refused(UsageError, "limit", "seconds"), time_limit(limit):
        pass
