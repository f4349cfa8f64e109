"""The self-test as a whole: its checks run in processes of their own, so that a driver that crashes or hangs becomes
words.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Iterator, Sequence
from typing import IO, Any

from clrecon.errors import DeviceError
from clrecon.jobs.selftest.check import Check
from clrecon.opencl import Device

COMMAND = ("-m", "clrecon.jobs.selftest.child")

MOST_PROCESSES = 4
"""Each of them takes a second to begin, and has the twins on a core of its own."""


def run_selftest(
    device: Device, checks: Sequence[Check], *, silent_seconds: float, processes: int | None = None
) -> Generator[dict[str, Any], None, None]:
    """Run checks on `device` in processes of their own, side by side, and yield each result at once.

    After a crash the checks that are left to a process run in a new one.  After a hang they count as failed: each of
    them would take as long.

    silent_seconds: Time without a line after which a process counts as hanging.
    processes: Default: one for each core of this computer, up to four.

    Yields: As `clrecon.jobs.selftest.child.run_check`.
    """
    many = min(processes or _count_cores(), MOST_PROCESSES, len(checks))
    if many <= 1:
        yield from _run_part(device, checks, silent_seconds, [], threading.Event())
        return
    told: queue.Queue[dict[str, Any] | BaseException | None] = queue.Queue()
    children: list[_Child] = []
    is_over = threading.Event()

    def run(part: Sequence[Check]) -> None:
        try:
            for result in _run_part(device, part, silent_seconds, children, is_over):
                told.put(result)
        except BaseException as error:  # raised again by the thread that waits
            told.put(error)
        told.put(None)

    threads = [threading.Thread(target=run, args=(checks[n::many],), daemon=True) for n in range(many)]
    try:
        for thread in threads:
            thread.start()
        running = many
        while running:
            line = told.get()
            if isinstance(line, BaseException):
                raise line
            if line is None:
                running -= 1
            else:
                yield line
    finally:
        is_over.set()
        for child in children:
            child.end()
        for thread in threads:
            thread.join()


def _count_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _run_part(
    device: Device, checks: Sequence[Check], silent_seconds: float, children: list[_Child], is_over: threading.Event
) -> Iterator[dict[str, Any]]:
    """Run checks one after the other; `children` gets each process that is started, until `is_over`."""
    left = list(checks)
    while left and not is_over.is_set():
        with _Child(device, left) as child:
            children.append(child)
            if is_over.is_set():  # since it was started
                return
            for result in child.results(silent_seconds):
                left = left[1:]
                yield result
            if not left or is_over.is_set():
                return
            words = child.describe_end()
            yield _failed(left[0], words, child.seconds)
            left = left[1:]
            if child.hangs:
                for check in left:
                    yield _failed(check, "not run: the driver hangs", 0.0)
                return


def _failed(check: Check, detail: str, seconds: float) -> dict[str, Any]:
    return {"operator": check.name, "passed": False, "detail": detail, "seconds": round(seconds, 3)}


class _Child:
    """The process, and what it said last."""

    def __init__(self, device: Device, checks: Sequence[Check]):
        self.hangs = False
        self._device = device
        self._doing = "its start"
        self._since = time.perf_counter()
        self._silent = 0.0
        if getattr(sys, "frozen", False) or not sys.executable:
            raise DeviceError("the self-test needs a Python interpreter to start, and this program has none")
        try:
            self._process = subprocess.Popen(
                [sys.executable, *COMMAND],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            raise DeviceError(f"no process can be started for the self-test: {error.strerror or error}") from error
        assert self._process.stdin is not None and self._process.stdout is not None
        request = {"device": device.index, "checks": [check.name for check in checks]}
        try:
            self._process.stdin.write(json.dumps(request).encode())
            self._process.stdin.close()
        except OSError:  # it has ended already: `results` tells
            pass
        self._lines: queue.Queue[bytes] = queue.Queue()
        threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True).start()

    def __enter__(self) -> _Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.wait()

    def _read(self, stream: IO[bytes]) -> None:
        for line in stream:
            self._lines.put(line)
        self._lines.put(b"")

    def results(self, silent_seconds: float) -> Iterator[dict[str, Any]]:
        """Yield results until the process ends or hangs."""
        while True:
            try:
                line = self._lines.get(timeout=silent_seconds)
            except queue.Empty:
                self.hangs, self._silent = True, silent_seconds
                return
            if not line:
                self._process.wait()
                return
            told = json.loads(line)
            if "operator" in told:
                yield told
            elif "warnings" in told:
                for text in told["warnings"]:
                    if text not in self._device.warnings:
                        self._device.remark(text)
            elif "check" in told:
                self._doing, self._since = "the preparation of its data", time.perf_counter()
            else:
                self._doing = told["doing"]

    @property
    def seconds(self) -> float:
        """Seconds since the last check began."""
        return time.perf_counter() - self._since

    def describe_end(self) -> str:
        """Describe how the process ended, and in what."""
        if self.hangs:
            return f"the driver hangs: nothing for {self._silent:g} s in {self._doing}"
        code = self._process.returncode
        if code < 0:
            name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
            return f"the driver crashed with {name} in {self._doing}"
        return f"the process of the test ended with exit code {code} in {self._doing}"
