"""Work on the workers of Dask distributed: a window of tasks is submitted, and one whose worker dies runs again alone.

Dask holds all tasks that are assigned to a dead worker responsible, waiting ones too: hence the window.  Anybody who
reaches a scheduler can run code on it: the one that is started here listens on the loopback interface alone, and asks
for a certificate that is made for it.
"""

from __future__ import annotations

import queue
import re
import socket
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from itertools import islice
from time import monotonic
from typing import Any, NamedTuple

from clrecon.errors import ClreconError, UnreachableError, UsageError
from clrecon.system.arguments import name_parameter
from clrecon.system.packages import import_package
from clrecon.system.processes import share_machine
from clrecon.version import package_version

LOCAL = "local"
"""In place of an address: a scheduler and workers of this machine, for this command alone."""

_ADDRESS = re.compile(r"(?:tcp|tls|ws|wss|ucx)://.+:\d+")

_TASKS_A_WORKER = 2
"""One runs, one waits: the worker is never idle, and a death touches few."""

_SECONDS_BETWEEN_LOOKS = 1.0

_SETTINGS: Mapping[str, Any] = {
    # The default, a low MALLOC_TRIM_THRESHOLD_, gives every large temporary array back to the system: half of the time.
    "distributed.nanny.pre-spawn-environ": {"DASK_LOGGING__DISTRIBUTED": "critical"},
    "distributed.worker.profile.enabled": False,
    # Looks of the processes at themselves: by default 3 % of a core beside a cluster of one worker, so 1 %.
    "distributed.admin.tick.interval": "2s",
    "distributed.admin.system-monitor.interval": "10s",
    # Dask gives up a worker that needs longer to start again; `Cluster` replaces those that have ended.
    "distributed.deploy.lost-worker-timeout": "24h",
    # All memory of a case is "unmanaged", for which Dask would pause its workers.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
}

_QUIET: Mapping[str, Any] = {"distributed.admin.large-graph-warning-threshold": "1 TB"}
"""Voxels are sent with their tasks: Dask would advise on each from 10 MB on."""

WITHOUT_DASK_DEFAULTS: Mapping[str, str | None] = {"MALLOC_TRIM_THRESHOLD_": None}
"""Variables of Dask's workers that processes started by them do without."""


class Died(NamedTuple):
    """In place of a result: the task's worker died, also when nothing else ran on it."""

    message: str


def check_address(address: str) -> str:
    """Return the address of a scheduler, or `LOCAL`; a wrong one is a ValueError."""
    if address != LOCAL and not _ADDRESS.fullmatch(address):
        raise ValueError(f"{address!r:.60} is no scheduler: {LOCAL}, or an address such as tls://host:8786")
    return address


class Cluster:
    """The workers of a scheduler; `open_cluster` makes one."""

    def __init__(self, client: Any, address: str, warn: Callable[[str], None], local: Any = None):
        self._client, self._local = client, local
        self._address, self._warn = address, warn

    def count_workers(self) -> int:
        """Return the number of workers that are there; of this command's own, those that have ended are replaced."""
        try:
            if self._local is not None:
                self._local.loop.add_callback(_replace_ended, self._local)
            return len(self._client.nthreads())
        except (OSError, RuntimeError, AttributeError) as error:  # as Dask has it between losing and closing
            raise self._lost() from error

    def run_tasks(
        self,
        function: Callable[..., Any],
        items: Iterable[Any],
        *shared: Any,
        is_suspect: Callable[[Any], bool] = lambda result: False,
    ) -> Iterator[tuple[Any, Any]]:
        """Yield each item with the result of ``function(item, *shared)`` as it ends; `Died` in place of it.

        function: Of a module of clrecon, which the workers import.
        is_suspect: Results of tasks that are to run once more, alone, like those whose worker died.
        An error of a task is raised.
        """
        suspects: list[Any] = []
        for item, result in self._run_window(function, items, shared, None):
            if isinstance(result, Died) or is_suspect(result):
                suspects.append(item)
            else:
                yield item, result
        for item in suspects:
            yield from self._run_window(function, [item], shared, 1)

    def _run_window(
        self, function: Callable[..., Any], items: Iterable[Any], shared: tuple[Any, ...], width: int | None
    ) -> Iterator[tuple[Any, Any]]:
        waiting, running = iter(items), dict[Any, Any]()
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        window, is_empty = 0, False
        next_look = 0.0
        try:
            while True:
                if monotonic() >= next_look:
                    workers = self.count_workers()
                    window, next_look = width or _TASKS_A_WORKER * workers, monotonic() + _SECONDS_BETWEEN_LOOKS
                    if workers == 0 and not is_empty:
                        self._warn(f"waiting for workers: the scheduler {self._address} has none")
                    is_empty = workers == 0
                for item in islice(waiting, max(0, window - len(running))):
                    future = self._client.submit(
                        _run_task, package_version(), function, item, *shared, key=f"clrecon-{uuid.uuid4().hex}"
                    )
                    running[future] = item
                    future.add_done_callback(ended.put)
                if not running and not is_empty:
                    return
                with suppress(queue.Empty):
                    future = ended.get(timeout=_SECONDS_BETWEEN_LOOKS)
                    yield running.pop(future), self._result_of(future)
        finally:
            with suppress(Exception):
                self._client.cancel(list(running))

    def _result_of(self, future: Any) -> Any:
        from concurrent.futures import CancelledError

        if future.status == "cancelled":
            raise self._lost()
        try:
            error = future.exception() if future.status == "error" else None
            if error is None:
                return future.result()
        except (OSError, CancelledError) as lost:  # a task that ended without an error: its result did not arrive
            raise self._lost() from lost
        if type(error).__name__ == "KilledWorker":
            return Died("its worker died, and so did others that got it: out of memory, or ended by somebody")
        if isinstance(error, ClreconError):
            raise error
        raise UsageError(
            f"a worker of the scheduler {self._address} cannot do the work, {type(error).__name__} ({error!s:.200}):"
            f" install clrecon {package_version()} and the same packages there"
        ) from error

    def call_all(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Call a function on all workers and return the results; workers that cannot are left out."""
        with suppress(Exception):
            return [*self._client.run(function, *arguments, on_error="ignore").values()]
        return []

    def _lost(self) -> UnreachableError:
        return UnreachableError(f"lost the connection to the scheduler {self._address}: start it again")


@contextmanager
def open_cluster(
    address: str, devices: Sequence[str | None], warn: Callable[[str], None] = lambda text: None
) -> Iterator[Cluster]:
    """Connect to a scheduler, or start one here with a worker for each of these devices; all end with the block."""
    distributed = import_package("distributed", name_parameter("scheduler", address))
    import logging

    import dask.config

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is an error here, or a result
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_QUIET))
        if address == LOCAL:
            stack.enter_context(dask.config.set(_SETTINGS))
            connected = stack.enter_context(_start_workers(distributed, devices))
            client = stack.enter_context(distributed.Client(connected, security=connected.security))
        else:
            client = stack.enter_context(_connect(distributed, address))
        yield Cluster(client, address, warn, connected if address == LOCAL else None)


def _replace_ended(cluster: Any) -> None:
    """Start workers in place of those that were killed while they started, which Dask does not start again."""
    for name, worker in [*cluster.workers.items()]:
        if worker.status.name in ("closed", "failed"):
            del cluster.workers[name]
    cluster.scale(len(cluster.worker_spec))


def _connect(distributed: Any, address: str) -> AbstractContextManager[Any]:
    try:
        client: AbstractContextManager[Any] = distributed.Client(address)
    except (OSError, ValueError, TypeError, RuntimeError) as error:  # TypeError: tls:// without certificates
        raise UnreachableError(
            f"no Dask scheduler answers at {address} ({error!s:.200}): start it with dask scheduler, or name another"
        ) from error
    return client


def _start_workers(distributed: Any, devices: Sequence[str | None]) -> AbstractContextManager[Any]:
    """Start a scheduler that only this user's processes reach, and a worker for each device."""
    import_package("cryptography", name_parameter("scheduler", LOCAL))
    import logging

    security = distributed.Security.temporary()
    workers = {}
    for number in range(len(devices)):
        environment, cores = share_machine(devices, number)
        options = {"host": "127.0.0.1", "nthreads": 1, "memory_limit": 0, "env": environment, "security": security}
        early = "import os, signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"  # Ctrl-C is for the command
        options["preload"] = [early if cores is None else f"{early}os.sched_setaffinity(0, {cores})\n"]
        workers[number] = {"cls": distributed.Nanny, "options": {**options, "dashboard": False}}
    scheduler = {"host": "127.0.0.1", "protocol": "tls", "dashboard": False, "security": security}
    cluster: AbstractContextManager[Any] = distributed.SpecCluster(
        workers=workers,
        scheduler={"cls": distributed.Scheduler, "options": {**scheduler, "dashboard_address": "127.0.0.1:0"}},
        security=security,
        silence_logs=logging.CRITICAL,
    )
    return cluster


def _run_task(version: str, function: Callable[..., Any], item: Any, *shared: Any) -> Any:
    """Run a task in a worker, whose version of clrecon must be that of the command."""
    if package_version() != version:
        host = socket.gethostname()
        raise UsageError(f"the worker on {host} has clrecon {package_version()}, this command {version}: install one")
    return function(item, *shared)
