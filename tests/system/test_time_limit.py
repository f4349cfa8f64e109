"""The time limit of devices: how it is given, and that it is given back."""

from __future__ import annotations

import math

from refusals import refused

from clrecon.errors import UsageError
from clrecon.system.progress import DEFAULT_SECONDS, device_seconds, time_limit


def test_time_limits_are_nested_and_wrong_ones_refused():
    assert device_seconds() == DEFAULT_SECONDS
    with time_limit(3):
        assert device_seconds() == 3.0
        with time_limit(0):
            assert device_seconds() == math.inf
        assert device_seconds() == 3.0
    assert device_seconds() == DEFAULT_SECONDS
    for wrong in (-1, math.nan, "5", None, True):
        with refused(UsageError, "limit", "seconds"), time_limit(wrong):
            pass
