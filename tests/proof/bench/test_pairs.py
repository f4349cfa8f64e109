"""Timing in pairs, with a fake clock."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from refusals import refused

from clrecon.proof.timing import FEWEST_PAIRS, alternate, free_cores, processor_name, spread, summarise, usable_cores


class FakeTime:
    """A clock that only runs when something works."""

    def __init__(self) -> None:
        self.now = 100.0
        self.order = ""

    def worker(self, name: str, seconds: float) -> Callable[[], float]:
        def work() -> float:
            self.now += seconds
            self.order += name
            return seconds

        return work

    def clock(self) -> float:
        return self.now


def test_spread_of_five_numbers_has_inclusive_quartiles() -> None:
    assert spread([4.0, 1.0, 3.0, 2.0, 5.0]) == {"median": 3.0, "q1": 2.0, "q3": 4.0, "min": 1.0, "max": 5.0}


def test_spread_of_one_number_is_that_number() -> None:
    assert spread([7]) == {"median": 7.0, "q1": 7.0, "q3": 7.0, "min": 7.0, "max": 7.0}


def test_first_of_two_timed_functions_changes_with_every_pair_after_a_warm_up() -> None:
    time = FakeTime()
    ours, theirs = alternate(time.worker("a", 1.0), time.worker("b", 2.0), pairs=4, clock=time.clock)
    assert time.order == "ab" + "ab" + "ba" + "ab" + "ba"
    assert (ours, theirs) == ([1.0] * 4, [2.0] * 4)


def test_without_a_warm_up_no_call_precedes_the_first_pair() -> None:
    time = FakeTime()
    alternate(time.worker("a", 1.0), time.worker("b", 2.0), pairs=1, warm=False, clock=time.clock)
    assert time.order == "ab"


@pytest.mark.parametrize(("limit", "pairs"), [(100.0, 9), (16.0, 5), (0.0, FEWEST_PAIRS), (None, 9)])
def test_time_limit_ends_the_pairs_but_not_before_the_fewest(limit: float | None, pairs: int) -> None:
    """A pair takes 3 s; nine are asked for, and the limit is looked at before each."""
    time = FakeTime()
    ours, theirs = alternate(time.worker("a", 1.0), time.worker("b", 2.0), pairs=9, limit_s=limit, clock=time.clock)
    assert len(ours) == len(theirs) == pairs


def test_ratio_of_times_is_that_of_pairs_and_not_of_medians() -> None:
    ours, theirs = [1.0, 2.0, 10.0], [2.0, 6.0, 10.0]  # ratios 2, 3 and 1; of the medians 6 / 2
    summary = summarise(ours, theirs)
    assert summary["ratio"] == {"median": 2.0, "q1": 1.5, "q3": 2.5, "min": 1.0, "max": 3.0}


def test_summary_of_pairs_has_the_median_of_each_side_and_their_number() -> None:
    summary = summarise([1.0, 2.0, 10.0], [2.0, 6.0, 10.0])
    assert summary["clrecon_s"]["median"] == 2.0
    assert summary["peer_s"]["median"] == 6.0
    assert summary["pairs"] == 3


def test_times_of_different_length_are_no_pairs() -> None:
    with refused(ValueError, 2, "longer"):
        summarise([1.0], [1.0, 2.0])


def test_processor_name_is_the_first_of_cpuinfo(tmp_path: Path) -> None:
    file = tmp_path / "cpuinfo"
    file.write_text("processor\t: 0\nmodel name\t: Some CPU @ 2 GHz\nmodel name\t: other\n")
    assert processor_name(file) == "Some CPU @ 2 GHz"


def test_processor_without_cpuinfo_has_a_name(tmp_path: Path) -> None:
    assert processor_name(tmp_path / "none") != ""


def test_free_cores_are_some_and_about_no_more_than_there_are() -> None:
    clock_error = 3  # two clocks over 0.05 s
    assert 1 / clock_error < free_cores(0.05) < clock_error * usable_cores()
