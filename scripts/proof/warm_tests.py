"""Runs chosen tests again and again, each time in a fork of a process that has imported what is not under test.

`WarmTests` is the side of `mutate_python.py`; run as a program, this file is the process that forks.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import resource
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytest

PYTEST_OPTIONS = ("-x", "-q", "-p", "no:cacheprovider", "--tb=line", "-m", "not slow and not fuzz")
MEMORY_BYTES = 16 * 2**30
"""Address space of a run: a change can ask for any amount of memory."""


@dataclass(frozen=True)
class Run:
    """Tests to run.

    stages: Names of tests, in order.  A stage begins when the one before has passed: only its files are collected.
    cpu_s: Processor time that each stage may take, in seconds: a loop without end is seen in the first tests.
    wall_s: Seconds after which the run is ended, however little the processor had to do.
    folder: For pytest's temporary folders.
    said: File for the output.
    """

    stages: list[list[str]]
    cpu_s: list[float]
    wall_s: float
    folder: str
    said: str


@dataclass(frozen=True)
class Outcome:
    """What came of a run.

    status: Exit status of pytest, or minus the signal that ended the run.  ``-SIGXCPU``: it took more processor time
    than it may.  ``-SIGALRM``: it was ended after `Run.wall_s`; nothing is known of it then.
    cpu_s: Processor time that it took, in seconds, without that of processes left behind.
    """

    status: int
    cpu_s: float


class Chooser:
    """Runs the tests of a list in its order.  A test that is no longer collected is left out."""

    def __init__(self, wanted: Sequence[str]):
        self.order = {test: number for number, test in enumerate(wanted)}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep and sort."""
        items[:] = sorted(
            (item for item in items if item.nodeid in self.order), key=lambda item: self.order[item.nodeid]
        )


class WarmTests:
    """A process that waits with imported modules and runs tests in forks of itself.

    root: Folder in which tests run.
    environment: Variables of the process.
    modules: Modules to import before the first fork.  None of them may be what is changed.
    """

    def __init__(self, root: Path, environment: dict[str, str], modules: Sequence[str]):
        self.process = subprocess.Popen(
            [sys.executable, __file__],
            cwd=root,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._ask(list(modules))

    def _ask(self, question: Any) -> Any:
        assert self.process.stdin is not None and self.process.stdout is not None
        try:
            self.process.stdin.write(json.dumps(question) + "\n")
            self.process.stdin.flush()
            answer = self.process.stdout.readline()
        except BrokenPipeError:  # it ended before it was asked
            answer = ""
        if not answer:
            raise ChildProcessError(f"the process that runs the tests has ended ({self.process.wait()})")
        return json.loads(answer)

    def run(self, run: Run) -> Outcome:
        """Run tests in a fork."""
        return Outcome(**self._ask(asdict(run)))

    def close(self) -> None:
        """End the process; may be called twice."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


def import_all(names: Sequence[str]) -> None:
    """Import modules; one that cannot be imported by itself is left to the tests."""
    for name in names:
        with contextlib.suppress(Exception):
            importlib.import_module(name)


def run_stages(run: Run) -> int:
    """Run pytest stage by stage until a test fails; returns its last exit status."""
    said = os.open(run.said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for number, target in ((nothing, 0), (said, 1), (said, 2)):
        os.dup2(number, target)
    for limit, value in ((resource.RLIMIT_AS, MEMORY_BYTES), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(limit, (value, value))
    status, most = 0, math.ceil(sum(run.cpu_s)) + 5
    for tests, cpu_s in zip(run.stages, run.cpu_s, strict=True):
        resource.setrlimit(resource.RLIMIT_CPU, (min(math.ceil(time.process_time() + cpu_s), most), most))
        files = dict.fromkeys(test.partition("::")[0] for test in tests)
        status = int(pytest.main([*PYTEST_OPTIONS, f"--basetemp={run.folder}", *files], plugins=[Chooser(tests)]))
        if status not in (0, 5):
            break
    return status


def run_in_fork(run: Run) -> Outcome:
    """Run tests in a fork, and end what they leave behind."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    child = os.fork()
    if child == 0:
        status = 70
        try:
            os.setsid()
            status = run_stages(run)
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(status)
    late = not has_ended(child, run.wall_s)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    took = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if late:
        code = -signal.SIGALRM
    elif code == -signal.SIGKILL and took >= sum(run.cpu_s):
        code = -signal.SIGXCPU
    return Outcome(code, took)


def has_ended(child: int, limit_s: float) -> bool:
    """Wait for a child that stays a zombie: its group can still be ended.  False if it is not ended in time."""
    descriptor = os.pidfd_open(child)
    try:
        return bool(select.select([descriptor], [], [], limit_s)[0])
    finally:
        os.close(descriptor)


def main() -> None:
    """Import the modules of the first line, then answer each further line, a `Run`, with its `Outcome`."""
    # Answers have a file of their own: what modules print as they are imported is none.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    sys.path[0] = os.getcwd()  # as in `python -m pytest`
    import_all(json.loads(sys.stdin.readline()))
    print(json.dumps(None), file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(asdict(run_in_fork(Run(**json.loads(line))))), file=answers, flush=True)


if __name__ == "__main__":
    main()
