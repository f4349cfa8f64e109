"""The threads of a view: the latest request wins, errors are words, and closing takes no time."""

from __future__ import annotations

import threading
import time

import pytest

from clrecon.errors import Cancelled, DeviceError
from clrecon.viewer.session.worker import Worker

pytestmark = pytest.mark.unit


@pytest.fixture
def worker():
    """A worker, with the errors that it told in `errors`."""
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


def test_latest_work_of_a_kind_waits_and_earlier_ones_are_dropped(worker):
    held, done = Held(), []
    worker.ask("other", held)
    held.begun.wait(5.0)
    for number in range(5):
        worker.ask("picture", lambda job, number=number: done.append(number))
    assert worker.busy == ["other", "picture"]
    held.go.set()
    assert worker.wait(5.0) and done == [4] and held.done


@pytest.mark.parametrize("gives_way", [True, False])
def test_running_work_is_cancelled_by_the_next_of_its_kind_only_if_it_gives_way(worker, gives_way):
    held = Held()
    worker.ask("picture", held, gives_way=gives_way)
    held.begun.wait(5.0)

    worker.ask("picture", lambda job: None)
    held.go.set()

    assert worker.wait(5.0)
    assert held.done is not gives_way
    assert worker.errors == []


def test_waiting_work_of_a_lower_rank_is_done_first(worker):
    held, done = Held(), []
    worker.ask("first", held)
    held.begun.wait(5.0)
    for rank, kind in ((3, "c"), (1, "a"), (2, "b")):
        worker.ask(kind, lambda job: done.append(job.kind), rank=rank)
    held.go.set()
    assert worker.wait(5.0) and done == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("error", "told"),
    [
        pytest.param(DeviceError("the device has no room"), ["the device has no room"], id="of clrecon"),
        pytest.param(ZeroDivisionError("by zero"), ["ZeroDivisionError: by zero", "fault of clrecon"], id="unexpected"),
    ],
)
def test_error_of_work_is_told_in_words_and_the_worker_goes_on(worker, error, told):
    def fail(job):
        raise error

    worker.ask("one", fail)
    assert worker.wait(5.0)
    done = []
    worker.ask("two", lambda job: done.append(1))
    assert worker.wait(5.0)

    ((kind, words),) = worker.errors
    assert kind == "one"
    assert [text for text in told if text not in words] == []
    assert done == [1]


def test_cancelled_work_is_no_error(worker):
    def be_cancelled(job):
        raise Cancelled

    worker.ask("one", be_cancelled)

    assert worker.wait(5.0)
    assert worker.errors == []


def test_closed_worker_cancels_what_runs_and_takes_no_more_work(worker):
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


def test_running_and_waiting_work_is_cancelled_by_its_kind(worker):
    held, done = Held(), []
    worker.ask("long", held)
    held.begun.wait(5.0)
    worker.ask("later", lambda job: done.append(1))
    worker.cancel("later")
    worker.cancel("long")
    held.go.set()
    assert worker.wait(5.0) and not held.done and done == []
