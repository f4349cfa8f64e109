"""Timing in pairs, with clocks that are made up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

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


def test_spread_has_inclusive_quartiles() -> None:
    assert spread([4.0, 1.0, 3.0, 2.0, 5.0]) == {"median": 3.0, "q1": 2.0, "q3": 4.0, "min": 1.0, "max": 5.0}
    assert spread([7]) == {"median": 7.0, "q1": 7.0, "q3": 7.0, "min": 7.0, "max": 7.0}


def test_who_is_first_changes_with_every_pair() -> None:
    time = FakeTime()
    ours, theirs = alternate(time.worker("a", 1.0), time.worker("b", 2.0), 4, clock=time.clock)
    assert time.order == "ab" + "ab" + "ba" + "ab" + "ba"
    assert (ours, theirs) == ([1.0] * 4, [2.0] * 4)


def test_without_warming_nothing_runs_beforehand() -> None:
    time = FakeTime()
    alternate(time.worker("a", 1.0), time.worker("b", 2.0), 1, warm=False, clock=time.clock)
    assert time.order == "ab"


@pytest.mark.parametrize(("limit", "pairs"), [(100.0, 9), (16.0, 5), (0.0, FEWEST_PAIRS), (None, 9)])
def test_time_limit_ends_the_pairs_after_the_fewest(limit: float | None, pairs: int) -> None:
    time = FakeTime()
    ours, theirs = alternate(time.worker("a", 1.0), time.worker("b", 2.0), 9, limit_s=limit, clock=time.clock)
    assert len(ours) == len(theirs) == pairs


def test_ratios_are_those_of_pairs() -> None:
    summary = summarise([1.0, 2.0, 10.0], [2.0, 6.0, 10.0])
    assert summary["ratio"] == {"median": 2.0, "q1": 1.5, "q3": 2.5, "min": 1.0, "max": 3.0}
    # medians of both sides would give 6 / 2
    assert (summary["clrecon_s"]["median"], summary["peer_s"]["median"], summary["pairs"]) == (2.0, 6.0, 3)
    with pytest.raises(ValueError, match="shorter|longer"):
        summarise([1.0], [1.0, 2.0])


def test_processor_name_is_read_from_the_system(tmp_path: Path) -> None:
    file = tmp_path / "cpuinfo"
    file.write_text("processor\t: 0\nmodel name\t: Some CPU @ 2 GHz\nmodel name\t: other\n")
    assert processor_name(file) == "Some CPU @ 2 GHz"
    assert processor_name(tmp_path / "none") != ""


def test_free_cores_are_counted() -> None:
    assert 0.3 < free_cores(0.05) < 3 * usable_cores()
