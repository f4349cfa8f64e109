"""Who deals cases to workers: here the processes of this machine, one case each at a time.

A worker that dies takes its own case along and no other.  It may have been out of memory because of its neighbours: the
case is made once more, alone, when all others are done.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import NamedTuple, Protocol

from clrecon import errors
from clrecon.errors import ClreconError
from clrecon.jobs.batch.case import LOST, Answer
from clrecon.jobs.batch.plan import Case, Plan
from clrecon.system.processes import describe_end, list_cores, start_python

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


class _Worker:
    """A process that makes one case after another."""

    def __init__(self, plan: Plan, number: int, device: str | None, workers: int):
        cores = list_cores()
        environment = {} if device is None else {"CLRECON_DEVICE": device}
        if workers > 1 and "POCL_MAX_PTHREAD_COUNT" not in os.environ:
            environment["POCL_MAX_PTHREAD_COUNT"] = str(max(1, len(cores) // workers))
        self.process = start_python(_COMMAND, "cases of a batch are made", environment)
        if 1 < workers <= len(cores) and hasattr(os, "sched_setaffinity"):  # its reading threads follow
            with suppress(OSError):
                os.sched_setaffinity(self.process.pid, cores[number::workers])
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


class LocalScheduler:
    """Processes of this machine, each with its device and its share of the processor's cores."""

    def __init__(self, plan: Plan):
        self._plan, self._devices = plan, plan.batch.deal_devices()
        self._lock = threading.Lock()
        self._workers: list[_Worker] = []
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
                elif outcome.death and count > 1:
                    lost.append(outcome.case)
                else:
                    yield outcome
            for case in lost:
                worker = self._start(0, 1)
                yield worker.make(case)
                worker.close()
        finally:
            self._end()

    def _serve(
        self, number: int, waiting: Iterator[Case], outcomes: queue.SimpleQueue[Outcome | Exception | None]
    ) -> None:
        """Give one worker a case after another, and a new one where it has ended."""
        worker: _Worker | None = None
        try:
            while (case := self._next_case(waiting)) is not None:
                if worker is None or worker.has_ended:
                    worker = self._start(number, len(self._devices))
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

    def _start(self, number: int, workers: int) -> _Worker:
        worker = _Worker(self._plan, number, self._devices[number], workers)
        with self._lock:
            self._workers = [other for other in self._workers if not other.has_ended] + [worker]
        return worker

    def _end(self) -> None:
        """End the workers that still work, and wait until their unfinished folders are removed."""
        with self._lock:
            self._is_ending = True
            left = [worker.process for worker in self._workers if not worker.has_ended]
        for process in left:
            process.terminate()
        for process in left:
            try:
                process.wait(_SECONDS_TO_END)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
