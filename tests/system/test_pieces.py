"""Work on long arrays: two functions at the same time."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from clrecon.system import pieces
from clrecon.system.pieces import deal_in_order, list_distinct, side_by_side, spread_rows

pytestmark = pytest.mark.unit


@pytest.mark.parametrize(
    ("count", "most", "rows"), [(10, 4, [0, 3, 6, 9]), (3, 4, [0, 1, 2]), (0, 4, [])], ids=["some", "all", "none"]
)
def test_spread_rows_begin_with_the_first_and_end_with_the_last(count, most, rows):
    assert spread_rows(count, most).tolist() == rows


def test_two_functions_run_at_the_same_time():
    barrier = threading.Barrier(2, timeout=20.0)  # lets two callers pass together, with the numbers 0 and 1
    assert set(side_by_side(barrier.wait, barrier.wait)) == {0, 1}


def test_results_of_two_functions_are_returned_in_their_order():
    assert tuple(side_by_side(lambda: "first", lambda: "second")) == ("first", "second")


@pytest.mark.parametrize("fails_first", [True, False])
def test_error_of_one_of_two_functions_is_raised_after_both_have_ended(fails_first):
    ended = []

    def fail() -> None:
        raise ZeroDivisionError("one of two")

    def end() -> None:
        ended.append("the other")

    with pytest.raises(ZeroDivisionError, match="one of two"):
        side_by_side(*((fail, end) if fails_first else (end, fail)))
    assert ended == ["the other"]


@pytest.mark.parametrize(
    ("numbers", "distinct"), [([], []), ([7], [7]), ([3, 3, 3], [3]), ([[5, -1], [2, 5]], [-1, 2, 5])]
)
def test_distinct_numbers_of_an_array_are_listed_once_in_rising_order_with_its_type(numbers, distinct):
    found = list_distinct(np.array(numbers, dtype=np.int32))
    assert found.dtype == np.int32
    assert found.tolist() == distinct


with_one_and_three_threads = pytest.mark.parametrize("threads", [1, 3])


@with_one_and_three_threads
@pytest.mark.parametrize("count", [1000, 0])
def test_work_in_threads_covers_each_row_once(monkeypatch, threads, count):
    monkeypatch.setattr(pieces, "count_readers", lambda *_: threads)
    calls_of_row = np.zeros(1000, dtype=int)

    def count_call(rows: slice) -> None:
        calls_of_row[rows] += 1

    pieces.in_threads(count_call, count, size=64)
    assert (calls_of_row[:count] == 1).all()
    assert (calls_of_row[count:] == 0).all()


@with_one_and_three_threads
def test_an_error_in_one_piece_is_raised_by_the_whole(monkeypatch, threads):
    monkeypatch.setattr(pieces, "count_readers", lambda *_: threads)

    def fail_late(rows: slice) -> None:
        if rows.start > 500:
            raise ValueError("this piece")

    with pytest.raises(ValueError, match="this piece"):
        pieces.in_threads(fail_late, 1000, size=64)


def test_results_of_dealt_items_come_in_their_order_although_a_later_one_is_ready_first() -> None:
    later_is_ready = threading.Event()

    def work(item: int) -> int:
        if item == 0:
            assert later_is_ready.wait(10)
        if item == 1:
            later_is_ready.set()
        return -item

    assert list(deal_in_order([work, work], range(5))) == [0, -1, -2, -3, -4]


def test_workers_get_no_more_items_than_may_wait_for_their_turn() -> None:
    begun: list[int] = []
    results = deal_in_order([begun.append, begun.append], range(100))
    next(results)
    assert len(begun) <= 2 * 2 + 1  # two of each of two workers wait, and one was taken
    results.close()


def test_error_of_a_dealt_item_is_raised_in_its_turn() -> None:
    def work(item: int) -> int:
        return 6 // item

    results = deal_in_order([work, work], [3, 2, 0, 1])
    assert [next(results), next(results)] == [2, 3]
    with pytest.raises(ZeroDivisionError):
        next(results)
