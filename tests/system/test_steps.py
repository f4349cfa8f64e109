"""Counted steps, and work in threads that reports them."""

from __future__ import annotations

import threading

import pytest

from clrecon.errors import Cancelled
from clrecon.system import pieces
from clrecon.system.progress import Steps

pytestmark = pytest.mark.unit


def test_steps_are_reported_from_none_to_all_and_never_above():
    reported: list[tuple[str, int, int]] = []
    steps = Steps(lambda *step: reported.append(step), stage="mask", total=7)
    steps.take()
    steps.take_slice(slice(3, 8))
    steps.take(4)  # 10 of 7: work that was begun again
    assert reported == [("mask", 0, 7), ("mask", 1, 7), ("mask", 6, 7), ("mask", 7, 7)]


def test_steps_without_a_report_are_counted():
    steps = Steps(progress=None, stage="mask", total=2)
    steps.take()
    assert steps.done == 1


@pytest.mark.parametrize("threads", [1, 3])
def test_pieces_of_work_are_reported_in_order_in_the_thread_of_the_caller_after_their_end(threads, monkeypatch):
    monkeypatch.setattr(pieces, "count_readers", lambda count, most: min(count, threads))
    worked: set[int] = set()
    reported: list[tuple[int, int]] = []
    reporting_threads: set[int] = set()

    def work(piece: slice) -> None:
        worked.update(range(piece.start, piece.stop))

    def report(piece: slice) -> None:
        assert set(range(piece.start, piece.stop)) <= worked
        reported.append((piece.start, piece.stop))
        reporting_threads.add(threading.get_ident())

    pieces.in_threads(work, 23, size=5, done=report)

    assert reported == [(0, 5), (5, 10), (10, 15), (15, 20), (20, 23)]
    assert reporting_threads == {threading.get_ident()}


@pytest.mark.parametrize("threads", [1, 2])
def test_work_in_threads_is_ended_by_an_error_of_its_report(threads, monkeypatch):
    monkeypatch.setattr(pieces, "count_readers", lambda count, most: min(count, threads))
    worked: list[int] = []

    def cancel(piece: slice) -> None:
        raise Cancelled("enough")

    piece_count = 1000
    with pytest.raises(Cancelled):
        pieces.in_threads(lambda piece: worked.append(piece.start), piece_count, size=1, done=cancel)
    assert len(worked) < piece_count  # the first is reported; a thread may have begun some others by then
