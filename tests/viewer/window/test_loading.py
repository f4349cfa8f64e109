"""Reading in a thread: the session is handed over once, errors are raised by who waits, and nobody has to wait."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from clrecon.errors import Cancelled, NoDicomError
from clrecon.system.progress import Progress
from clrecon.viewer.window.loading import Loading

SECONDS = 20.0


class Session:
    closed = 0

    def close(self, timeout: float = 0.0) -> None:
        self.closed += 1


def wait_for(loading: Loading) -> Any:
    end = time.monotonic() + SECONDS
    while (found := loading.take()) is None:
        assert time.monotonic() < end
        time.sleep(0.001)
    return found


def test_the_session_is_handed_over_once_and_is_then_not_ours():
    session: Any = Session()
    loading = Loading(lambda progress: session)
    assert wait_for(loading) is session
    assert loading.take() is None
    loading.close(SECONDS)
    assert session.closed == 0


def test_an_error_is_raised_by_who_takes():
    def load(progress: Progress) -> Any:
        raise NoDicomError("nothing there")

    with pytest.raises(NoDicomError, match="nothing there"):
        wait_for(Loading(load))


def test_the_words_are_those_of_the_stage():
    told, go_on = threading.Event(), threading.Event()

    def load(progress: Progress) -> Any:
        progress("read", 3, 95)
        told.set()
        go_on.wait(SECONDS)
        return Session()

    loading = Loading(load, describe=lambda stage: f"now {stage}")
    assert told.wait(SECONDS)
    assert loading.words == "now read 3 of 95"
    assert loading.take() is None
    go_on.set()
    wait_for(loading)


def test_closing_ends_the_reading_and_what_nobody_took():
    session: Any = Session()
    begun, go_on = threading.Event(), threading.Event()

    def load(progress: Progress) -> Any:
        begun.set()
        go_on.wait(SECONDS)
        progress("read", 1, 2)
        raise AssertionError("it went on")

    loading = Loading(load)
    assert begun.wait(SECONDS)
    threading.Timer(0.05, go_on.set).start()
    loading.close(SECONDS)
    with pytest.raises(Cancelled):
        loading.take()

    loading = Loading(lambda progress: session)
    loading.close(SECONDS)
    assert session.closed == 1
