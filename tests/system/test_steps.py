"""Counted steps, and work in threads that reports them."""

from __future__ import annotations

import threading

import pytest

from clrecon.errors import Cancelled
from clrecon.system import pieces
from clrecon.system.progress import Steps

pytestmark = pytest.mark.unit


def test_steps_begin_at_none_and_end_with_all():
    told: list[tuple[str, int, int]] = []
    steps = Steps(lambda *step: told.append(step), "mask", 7)
    steps.take()
    steps.take_slice(slice(3, 8))
    steps.take(4)  # work that was begun again: there is never more done than there is
    assert told == [("mask", 0, 7), ("mask", 1, 7), ("mask", 6, 7), ("mask", 7, 7)]
    Steps(None, "mask", 1).take()


@pytest.mark.parametrize("threads", [1, 3])
def test_pieces_are_reported_in_order_in_the_thread_of_the_caller(threads, monkeypatch):
    monkeypatch.setattr(pieces, "count_readers", lambda count, most: min(count, threads))
    worked: set[int] = set()
    told: list[tuple[int, int, int]] = []

    def done(piece: slice) -> None:
        assert set(range(piece.start, piece.stop)) <= worked
        told.append((piece.start, piece.stop, threading.get_ident()))

    pieces.in_threads(lambda piece: worked.update(range(piece.start, piece.stop)), 23, 5, done)
    here = threading.get_ident()
    assert told == [(0, 5, here), (5, 10, here), (10, 15, here), (15, 20, here), (20, 23, here)]


@pytest.mark.parametrize("threads", [1, 2])
def test_a_report_may_end_the_work(threads, monkeypatch):
    monkeypatch.setattr(pieces, "count_readers", lambda count, most: min(count, threads))
    worked: list[int] = []

    def done(piece: slice) -> None:
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        pieces.in_threads(lambda piece: worked.append(piece.start), 1000, 1, done)
    assert len(worked) < 1000
