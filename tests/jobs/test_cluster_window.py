"""Tasks on a cluster: how many are submitted at once, and which run again alone when a worker dies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from concurrent.futures import CancelledError
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import NoSurfaceError, UnreachableError, UsageError
from clrecon.jobs.cluster import Cluster, Died, check_address, open_cluster
from clrecon.version import package_version

WORKERS = 3


class KilledWorker(Exception):
    """What Dask raises for a task whose workers died, by this name."""


class FakeFuture:
    """fault: Raised in place of handing the result over."""

    def __init__(self, work: Callable[[], Any] | None, fault: Exception | None = None):
        self.status, self.error, self.value, self.fault = "finished", None, None, fault
        if work is None:
            self.status = "cancelled"
            return
        try:
            self.value = work()
        except Exception as error:
            self.status, self.error = "error", error

    def exception(self) -> Exception | None:
        return self.error

    def result(self) -> Any:
        if self.fault is not None:
            raise self.fault
        return self.value


class FakeClient:
    """A scheduler of three workers: a task ends when so many are submitted that nobody submits more.

    The task `killer` kills its worker, and Dask blames each task that is submitted at that time.
    """

    def __init__(self, is_lost: bool = False, fault: Exception | None = None):
        self.fault = fault
        self.is_lost, self.running, self.most, self.cancelled = is_lost, {}, 0, []
        self.submitted: Counter[str] = Counter()

    def nthreads(self) -> dict[str, int]:
        return dict.fromkeys(map(str, range(WORKERS)), 1)

    def submit(self, run: Callable[..., Any], version: str, function: Any, item: str, *shared: Any, key: str) -> Any:
        self.submitted[item] += 1
        future = FakeFuture(None if self.is_lost else lambda: run(version, function, item, *shared), self.fault)
        client = self

        class Submitted:
            status = property(lambda self: future.status)
            exception, result = future.exception, future.result

            def add_done_callback(self, tell: Callable[[Any], None]) -> None:
                client.running[self] = (item, future, tell)
                client.most = max(client.most, len(client.running))
                is_the_last = client.submitted.total() >= 10  # of the ten words that most tests run
                if len(client.running) == 2 * WORKERS or is_the_last:
                    client.end_all()

        return Submitted()

    def end_all(self) -> None:
        ended, self.running = self.running, {}
        is_deadly = any(item == "killer" for item, _, _ in ended.values())
        for submitted, (_, future, tell) in ended.items():
            if is_deadly:
                future.status, future.error = "error", KilledWorker()
            tell(submitted)

    def cancel(self, futures: list[Any]) -> None:
        self.cancelled += futures


def in_capitals(item: str, error: Exception | None = None) -> str:
    if error is not None:
        raise error
    return item.upper()


def run_all(client: FakeClient, items: str, *shared: Any, function: Callable[..., Any] = in_capitals) -> dict[str, Any]:
    """Run a function on each word of `items` and with what all share; return the results by word."""
    return dict(Cluster(client, "tcp://far:8786", print).run_tasks(function, items.split(), *shared))


def test_two_tasks_a_worker_are_submitted_at_once_and_no_more() -> None:
    client = FakeClient()
    assert run_all(client, "a b c d e f g h i j") == {letter: letter.upper() for letter in "abcdefghij"}
    assert client.most == 2 * WORKERS


def test_tasks_blamed_for_a_death_run_again_and_only_the_one_that_dies_alone_is_lost() -> None:
    client = FakeClient()
    results = run_all(client, "a b killer c d e f g h i")
    assert isinstance(results.pop("killer"), Died)
    assert results == {letter: letter.upper() for letter in "abcdefghi"}
    assert client.submitted["killer"] == client.submitted["a"] == 2


def test_error_of_a_task_is_raised_and_what_was_submitted_is_cancelled() -> None:
    client = FakeClient()
    with refused(NoSurfaceError, "nothing"):
        run_all(client, "a b c d e f g h i j", NoSurfaceError("nothing there"))
    assert len(client.cancelled) == 2 * WORKERS - 1  # all but that with the error


def test_worker_without_a_package_is_refused_with_the_scheduler_and_the_version_to_install() -> None:
    with refused(UsageError, "tcp://far:8786", "ModuleNotFoundError", package_version()):
        run_all(FakeClient(), "a b c d e f g h i j", ModuleNotFoundError("No module named 'clrecon'"))


def test_lost_scheduler_is_an_error_with_its_address() -> None:
    with refused(UnreachableError, "tcp://far:8786"):
        run_all(FakeClient(is_lost=True), "a b c d e f")


@pytest.mark.parametrize(
    "fault", [ConnectionResetError("reset by peer"), CancelledError("lost dependencies")], ids=repr
)
def test_scheduler_lost_while_a_result_is_fetched_is_an_error_with_its_address(fault: Exception) -> None:
    with refused(UnreachableError, "tcp://far:8786"):
        run_all(FakeClient(fault=fault), "a b c d e f")


@pytest.mark.parametrize("address", ["host:8786", "tcp://host", "http://host:8786", "8786", "Local"])
def test_word_that_is_no_address_of_a_scheduler_is_refused(address: str) -> None:
    with refused(ValueError, address):
        check_address(address)


@pytest.mark.filterwarnings("error")
def test_task_with_many_voxels_is_sent_without_advice_of_dask() -> None:
    distributed = pytest.importorskip("distributed")
    voxels = np.ones(11_000_000, np.uint8)  # Dask's threshold is 10 MB
    with (
        distributed.LocalCluster(n_workers=1, processes=False, protocol="tcp", dashboard_address=None) as local,
        open_cluster(local.scheduler_address, []) as cluster,
    ):
        [(sent, is_equal)] = cluster.run_tasks(np.array_equal, [voxels], voxels[:3])
    assert sent is voxels
    assert not is_equal


class OwnWorkers:
    """Two workers of Dask's local cluster, of which it has closed the first, and started none in its place."""

    def __init__(self) -> None:
        self.loop = SimpleNamespace(add_callback=lambda function, *given: function(*given))
        self.worker_spec = {0: {}, 1: {}}
        self.workers = {0: SimpleNamespace(status=SimpleNamespace(name="closed"))} | {
            1: SimpleNamespace(status=SimpleNamespace(name="running"))
        }

    def scale(self, count: int) -> None:
        """Start what is missing, as `distributed.SpecCluster` does."""
        for name in [*self.worker_spec][:count]:
            self.workers.setdefault(name, SimpleNamespace(status=SimpleNamespace(name="new")))


def test_own_worker_that_dask_has_given_up_is_replaced_and_the_other_stays() -> None:
    local = OwnWorkers()

    Cluster(FakeClient(), "local", warn=lambda text: None, local=local).count_workers()

    assert {name: worker.status.name for name, worker in local.workers.items()} == {0: "new", 1: "running"}
