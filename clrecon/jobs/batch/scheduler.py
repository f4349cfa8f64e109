"""Who deals cases to workers: the processes of this machine, or the workers of a Dask cluster, one case at a time each.

A worker that dies takes its own case along and no other.  It may have been out of memory because of its neighbours: the
case is made once more, alone, when all others are done.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import threading
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

from clrecon import errors
from clrecon.errors import ClreconError
from clrecon.jobs.batch.case import LOST, Answer
from clrecon.jobs.batch.plan import Case, Plan
from clrecon.jobs.cluster import WITHOUT_DASK_DEFAULTS, Died, open_cluster
from clrecon.reading.urls import is_url
from clrecon.system.light_dataclass import replace
from clrecon.system.processes import describe_end, share_machine, start_python

_COMMAND = ("-c", "from clrecon.jobs.batch.case import run_worker; run_worker()")
_SECONDS_TO_END = 5.0
"""Time that a worker gets to remove the folder of an unfinished case; the next run removes what is left."""


class Outcome(NamedTuple):
    """A case and what came of it; `death` says how the process ended that made it."""

    case: Case
    answer: Answer
    death: str = ""


class Scheduler(Protocol):
    """What deals cases to workers, here or on other machines; each case is a `make_case`."""

    def run(self, cases: Iterable[Case]) -> Iterator[Outcome]:
        """Yield the outcome of each case as it ends; a window of them is submitted, not all.

        An error is that of the output folder or of a device that is not there, and ends the batch.  When the iterator
        is closed, the workers are ended.
        """


class CaseProcess:
    """A process that makes one case after another.

    environment: Variables beside those of this process, None for those to leave out.
    cores: The only cores of its reading threads; None: all of this process.
    """

    def __init__(
        self, plan: Plan, environment: Mapping[str, str | None] | None = None, cores: Sequence[int] | None = None
    ):
        self.process = start_python(_COMMAND, "cases of a batch are made", environment)
        if cores is not None:
            with suppress(OSError):
                os.sched_setaffinity(self.process.pid, cores)
        self._send(plan.to_json())

    def _send(self, line: str) -> None:
        assert self.process.stdin is not None
        with suppress(OSError):  # it has ended: its answer is missing
            self.process.stdin.write(line.encode("utf-8", "surrogateescape") + b"\n")
            self.process.stdin.flush()

    def make(self, case: Case) -> Outcome:
        assert self.process.stdout is not None
        self._send(json.dumps(case))
        line = self.process.stdout.readline()
        if not line.endswith(b"\n"):
            return Outcome(case, Answer(LOST), describe_end(self.process.wait()))
        answer = json.loads(line)
        if isinstance(answer, dict):
            kind: type[ClreconError] = getattr(errors, answer["error"]["kind"])
            raise kind(answer["error"]["message"])
        return Outcome(case, Answer(*answer))

    @property
    def has_ended(self) -> bool:
        return self.process.poll() is not None

    def close(self) -> None:
        """Let the process end by itself, as it does when nobody asks any more."""
        assert self.process.stdin is not None and self.process.stdout is not None
        with suppress(OSError):
            self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()

    def end(self) -> None:
        """End the process in the middle of a case, whose folder it removes."""
        self.process.terminate()
        try:
            self.process.wait(_SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class LocalScheduler:
    """Processes of this machine, each with its device and its share of the processor's cores."""

    def __init__(self, plan: Plan):
        self._plan, self._devices = plan, plan.batch.deal_devices()
        self._lock = threading.Lock()
        self._workers: list[CaseProcess] = []
        self._is_ending = False

    def run(self, cases: Iterable[Case]) -> Iterator[Outcome]:
        waiting = iter(cases)
        outcomes: queue.SimpleQueue[Outcome | Exception | None] = queue.SimpleQueue()
        lost: list[Case] = []
        count = len(self._devices)
        for number in range(count):
            threading.Thread(target=self._serve, args=(number, waiting, outcomes), daemon=True).start()
        running = count
        try:
            while running:
                outcome = outcomes.get()
                if outcome is None:
                    running -= 1
                elif isinstance(outcome, Exception):
                    raise outcome
                elif outcome.death:
                    lost.append(outcome.case)
                else:
                    yield outcome
            for case in lost:
                worker = self._start(CaseProcess(self._plan, share_machine(self._devices[:1], 0)[0]))
                yield worker.make(case)
                worker.close()
        finally:
            self._end()

    def _serve(
        self, number: int, waiting: Iterator[Case], outcomes: queue.SimpleQueue[Outcome | Exception | None]
    ) -> None:
        """Give one worker a case after another, and a new one where it has ended."""
        worker: CaseProcess | None = None
        try:
            while (case := self._next_case(waiting)) is not None:
                if worker is None or worker.has_ended:
                    worker = self._start(CaseProcess(self._plan, *share_machine(self._devices, number)))
                outcome = worker.make(case)
                outcomes.put(outcome)
                if outcome.answer.is_last:
                    worker.close()
            if worker is not None:
                worker.close()
        except Exception as error:  # raised again by the thread that waits for the outcome
            outcomes.put(error)
        outcomes.put(None)

    def _next_case(self, waiting: Iterator[Case]) -> Case | None:
        with self._lock:
            return None if self._is_ending else next(waiting, None)

    def _start(self, worker: CaseProcess) -> CaseProcess:
        with self._lock:
            self._workers = [other for other in self._workers if not other.has_ended] + [worker]
        return worker

    def _end(self) -> None:
        """End the workers that still work, and wait until their unfinished folders are removed."""
        with self._lock:
            self._is_ending = True
            left = [worker for worker in self._workers if not worker.has_ended]
        for worker in left:
            worker.process.terminate()
        for worker in left:
            worker.end()


class DaskScheduler:
    """Workers of Dask distributed, here or on other machines, which have a process each for the cases.

    That process does without Dask's libraries and variables, and its death is that of a case and not of the worker.
    """

    def __init__(self, plan: Plan, address: str, warn: Callable[[str], None]):
        self._address, self._warn = address, warn
        self._devices = plan.batch.deal_devices()
        self._plan = replace(plan, output=os.path.abspath(plan.output))

    def run(self, cases: Iterable[Case]) -> Iterator[Outcome]:
        batch = uuid.uuid4().hex
        absolute = (
            case if is_url(case.source) else case._replace(source=os.path.abspath(case.source)) for case in cases
        )
        with open_cluster(self._address, self._devices, self._warn) as cluster:
            try:
                for case, result in cluster.run_tasks(
                    make_on_worker, absolute, batch, self._plan.to_json(), is_suspect=lambda outcome: outcome.death
                ):
                    yield Outcome(case, Answer(LOST), result.message) if isinstance(result, Died) else result
            finally:
                cluster.call_all(end_on_worker)


_process_of_worker: dict[str, CaseProcess] = {}
"""Of a worker: the process for the cases of a batch, by the batch; that of an older one has been ended."""

_lock_of_worker = threading.Lock()


def make_on_worker(case: Sequence[Any], batch: str, plan: str) -> Outcome:
    """Make a case in the process of this worker, which is started by its first case; one after another."""
    with _lock_of_worker:
        process = _process_of_worker.get(batch)
        if process is None or process.has_ended:
            end_on_worker()
            process = CaseProcess(Plan.from_json(plan), WITHOUT_DASK_DEFAULTS)
            _process_of_worker[batch] = process
        outcome = process.make(Case(*case))
        if outcome.answer.is_last:
            process.close()
        return outcome


def end_on_worker() -> None:
    """End the process of this worker, in the middle of a case if need be."""
    while _process_of_worker:
        _, process = _process_of_worker.popitem()
        process.end()
