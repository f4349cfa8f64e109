"""The processes of the job: one after another for methods, whose memory is their own; side by side for measures.

A crash of one becomes words.
"""

from __future__ import annotations

import json
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import IO, Any

from clrecon.errors import DeviceError
from clrecon.jobs.bench.machine import usable_cores
from clrecon.jobs.compare.request import Request

METHOD = ("-m", "clrecon.jobs.compare.child")
JUDGE = ("-m", "clrecon.jobs.compare.judge")

MOST_JUDGES = 4


def _start(command: Sequence[str], told: Mapping[str, Any]) -> subprocess.Popen[bytes]:
    """Start a process of this interpreter, and tell it what to do."""
    if getattr(sys, "frozen", False) or not sys.executable:
        raise DeviceError("methods are compared in processes of a Python interpreter, and this program has none")
    try:
        process = subprocess.Popen(
            [sys.executable, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError as error:
        raise DeviceError(f"no process can be started to compare methods: {error.strerror or error}") from error
    assert process.stdin is not None
    try:
        process.stdin.write(json.dumps(told).encode())
        process.stdin.close()
    except OSError:  # it has ended already: its answer is missing
        pass
    return process


def run_in_process(request: Request) -> dict[str, Any]:
    """Run a method in a process of its own, and return what `clrecon.jobs.compare.child.run_method` tells."""
    process = _start(METHOD, request.as_dict())
    assert process.stdout is not None
    try:
        answer = process.stdout.read()
        process.wait()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    try:
        told: dict[str, Any] = json.loads(answer)
    except ValueError:
        return {"state": "failed", "kind": "Crash", "error": _describe_end(process.returncode), "hung": False}
    return told


def _describe_end(code: int) -> str:
    """Describe how a process ended that said nothing."""
    if code >= 0:
        return f"its process ended with exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    more = ": out of memory, or ended by somebody" if name == "SIGKILL" else ""
    return f"its process crashed with {name}{more}"


def measure_in_processes(told: Mapping[str, Any], methods: Mapping[str, int]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure what methods made in a process a core, and yield the figures of each method.

    told: See `clrecon.jobs.compare.judge.Judge`.
    methods: Names, and how much there is to measure of each.

    Yields:
    figures: See `Judge.measure`; only ``reasons`` where the process ended before.
    """
    parts = _share(methods, min(usable_cores(), MOST_JUDGES))
    lines: queue.Queue[tuple[int, bytes]] = queue.Queue()
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for number, part in enumerate(parts):
            process = _start(JUDGE, {**told, "methods": part})
            processes.append(process)
            threading.Thread(target=_forward, args=(number, process.stdout, lines), daemon=True).start()
        running = len(processes)
        while running:
            number, line = lines.get()
            if line:
                figures = json.loads(line)
                parts[number].remove(figures["method"])
                yield figures.pop("method"), figures
                continue
            running -= 1
            processes[number].wait()
            for name in parts[number]:
                yield name, {"reasons": {"all": _describe_end(processes[number].returncode)}}
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _forward(number: int, stream: IO[bytes] | None, lines: queue.Queue[tuple[int, bytes]]) -> None:
    """Put the lines of a process into a queue, and an empty one at its end."""
    assert stream is not None
    with stream:
        for line in stream:
            lines.put((number, line))
    lines.put((number, b""))


def _share(methods: Mapping[str, int], most: int) -> list[list[str]]:
    """Share methods out to at most so many processes, the largest first, each to the one with the least to do."""
    parts: list[list[str]] = [[] for _ in range(max(1, min(most, len(methods))))]
    loads = [0] * len(parts)
    for name, load in sorted(methods.items(), key=lambda each: -each[1]):
        least = loads.index(min(loads))
        parts[least].append(name)
        loads[least] += load + 1
    return parts
