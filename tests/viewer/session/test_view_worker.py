"""The threads of a view: the latest request wins, errors are words, and closing takes no time."""

from __future__ import annotations

import threading
import time

import pytest

from clrecon.errors import Cancelled, DeviceError
from clrecon.system.progress import Worker

pytestmark = pytest.mark.unit


@pytest.fixture
def worker():
    errors: list[tuple[str, str]] = []
    made = Worker("test", lambda kind, words: errors.append((kind, words)))
    made.errors = errors  # type: ignore[attr-defined]
    yield made
    made.close()


class Held:
    """Work that waits until it is let go."""

    def __init__(self):
        self.begun, self.go, self.done = threading.Event(), threading.Event(), False

    def __call__(self, job):
        self.begun.set()
        self.go.wait(5.0)
        if job.cancelled():
            raise Cancelled
        self.done = True


def test_of_a_kind_the_latest_waits_and_others_are_dropped(worker):
    held, done = Held(), []
    worker.ask("other", held)
    held.begun.wait(5.0)
    for number in range(5):
        worker.ask("picture", lambda job, number=number: done.append(number))
    assert worker.busy == ["other", "picture"]
    held.go.set()
    assert worker.wait(5.0) and done == [4] and held.done


def test_running_work_is_cancelled_by_the_next_only_if_it_gives_way(worker):
    for gives_way in (True, False):
        held = Held()
        worker.ask("picture", held, gives_way=gives_way)
        held.begun.wait(5.0)
        worker.ask("picture", lambda job: None)
        held.go.set()
        assert worker.wait(5.0) and held.done is not gives_way
    assert worker.errors == []


def test_lower_ranks_come_first(worker):
    held, done = Held(), []
    worker.ask("first", held)
    held.begun.wait(5.0)
    for rank, kind in ((3, "c"), (1, "a"), (2, "b")):
        worker.ask(kind, lambda job: done.append(job.kind), rank=rank)
    held.go.set()
    assert worker.wait(5.0) and done == ["a", "b", "c"]


def test_errors_are_words_and_the_thread_goes_on(worker):
    def fail(error):
        def work(job):
            raise error

        return work

    worker.ask("one", fail(DeviceError("the device has no room")))
    assert worker.wait(5.0)
    worker.ask("two", fail(ZeroDivisionError("by zero")))
    assert worker.wait(5.0)
    worker.ask("three", fail(Cancelled()))
    assert worker.wait(5.0)
    assert worker.errors[0] == ("one", "the device has no room") and len(worker.errors) == 2
    assert "ZeroDivisionError: by zero" in worker.errors[1][1] and "fault of clrecon" in worker.errors[1][1]


def test_closing_cancels_what_runs_and_takes_nothing_more(worker):
    steps = []

    def work(job):
        while True:
            job.progress("stage")
            steps.append(1)
            time.sleep(0.002)

    worker.ask("long", work)
    while not steps:
        time.sleep(0.001)
    assert worker.close() and worker.ask("more", work) is None
    count = len(steps)
    time.sleep(0.02)
    assert len(steps) == count and worker.busy == []


def test_a_kind_can_be_cancelled(worker):
    held, done = Held(), []
    worker.ask("long", held)
    held.begun.wait(5.0)
    worker.ask("later", lambda job: done.append(1))
    worker.cancel("later")
    worker.cancel("long")
    held.go.set()
    assert worker.wait(5.0) and not held.done and done == []
