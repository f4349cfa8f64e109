"""The self-test as a whole: its checks run in processes of their own, so that a driver that crashes or hangs becomes
words.

The process runs this module.  It writes a line of JSON for each thing that it does: ``{"check": name}`` before a check,
``{"doing": words}`` before a kernel is built or launched, ``{"warnings": texts}`` of the device after a check, and the
result of the check as `run_check` returns it.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

from clrecon.errors import ClreconError
from clrecon.opencl import Device, choose_unchecked, list_devices
from clrecon.proof.checking import Check
from clrecon.proof.points import cloud_checks, voxel_checks
from clrecon.proof.rays import layer_checks, ray_checks
from clrecon.proof.surface import decimation_checks, surface_checks
from clrecon.proof.timing import usable_cores
from clrecon.proof.volumes import volume_checks
from clrecon.system.processes import start_with
from clrecon.system.progress import Progress, device_seconds, ignore_progress
from clrecon.system.records import name_schema

CHECKS: tuple[Check, ...] = (
    *volume_checks.PRIMITIVE_CHECKS,
    *volume_checks.BRICK_CHECKS,
    *surface_checks.SURFACE_CHECKS,
    *decimation_checks.CROSSING_CHECKS,
    *surface_checks.LABEL_CHECKS,
    *decimation_checks.DISTANCE_CHECKS,
    *surface_checks.CORTEX_CHECKS,
    *decimation_checks.SMOOTHING_CHECKS,
    *ray_checks.LEAP_CHECKS,
    *ray_checks.PICTURE_CHECKS,
    *layer_checks.CHECKS,
    *volume_checks.SHEET_CHECKS,
    *volume_checks.FILTER_CHECKS,
    *cloud_checks.GRID_CHECKS,
    *voxel_checks.BAND_CHECKS,
    *volume_checks.MASK_CHECKS,
    *cloud_checks.FIELD_CHECKS,
    *cloud_checks.FILTER_CHECKS,
    *cloud_checks.CLUSTER_CHECKS,
    *voxel_checks.POINT_CHECKS,
)


MOST_PROCESSES = 4
"""Each of them takes a second to begin, and has the twins on a core of its own."""


def run_selftest(
    device: Device, checks: Sequence[Check], *, silent_seconds: float, processes: int | None = None
) -> Generator[dict[str, Any], None, None]:
    """Run checks on `device` in processes of their own, side by side, and yield each result of `run_check` at once.

    After a crash the checks that are left to a process run in a new one.  After a hang, `silent_seconds` without a
    line, they count as failed: each of them would take as long.  By default there is a process for each core, up to
    four.
    """
    many = min(processes or usable_cores(), MOST_PROCESSES, len(checks))
    if many <= 1:
        yield from _run_part(device, checks, silent_seconds, [], threading.Event())
        return
    messages: queue.Queue[dict[str, Any] | BaseException | None] = queue.Queue()
    children: list[_Child] = []
    is_over = threading.Event()

    def run(part: Sequence[Check]) -> None:
        try:
            for result in _run_part(device, part, silent_seconds, children, is_over):
                messages.put(result)
        except BaseException as error:  # raised again by the thread that waits
            messages.put(error)
        messages.put(None)

    threads = [threading.Thread(target=run, args=(checks[n::many],), daemon=True) for n in range(many)]
    try:
        for thread in threads:
            thread.start()
        running = many
        while running:
            line = messages.get()
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
            yield _failed(left[0], child.describe_end(), child.seconds)
            left = left[1:]
            if child.hangs:
                for check in left:
                    yield _failed(check, "not run: the driver hangs", 0.0)
                return


def _failed(check: Check, detail: str, seconds: float) -> dict[str, Any]:
    return {"operator": check.name, "passed": False, "detail": detail, "seconds": round(seconds, 3)}


class _Child:
    def __init__(self, device: Device, checks: Sequence[Check]):
        self.hangs = False
        self._device = device
        self._doing = "its start"
        self._since = time.perf_counter()
        self._silent = 0.0
        request = {"device": device.index, "checks": [check.name for check in checks]}
        self._process = start_with(("-m", "clrecon.proof.run"), "kernels are checked", request)
        self._lines: queue.Queue[bytes] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def __enter__(self) -> _Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        self._process.kill()
        self._process.wait()

    def _read(self) -> None:
        for line in self._process.stdout or ():
            self._lines.put(line)
        self._lines.put(b"")

    def results(self, silent_seconds: float) -> Iterator[dict[str, Any]]:
        while True:
            try:
                line = self._lines.get(timeout=silent_seconds)
            except queue.Empty:
                self.hangs, self._silent = True, silent_seconds
                return
            if not line:
                self._process.wait()
                return
            message = json.loads(line)
            if "operator" in message:
                yield message
            elif "warnings" in message:
                for text in message["warnings"]:
                    if text not in self._device.warnings:
                        self._device.remark(text)
            elif "check" in message:
                self._doing, self._since = "the preparation of its data", time.perf_counter()
            else:
                self._doing = message["doing"]

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._since

    def describe_end(self) -> str:
        if self.hangs:
            return f"the driver hangs: nothing for {self._silent:g} s in {self._doing}"
        code = self._process.returncode
        if code < 0:
            name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
            return f"the driver crashed with {name} in {self._doing}"
        return f"the process of the test ended with exit code {code} in {self._doing}"


def run_check(device: Device, check: Check) -> dict[str, Any]:
    """Run one check; return ``operator``, ``passed``, ``detail`` (what was compared or is wrong) and ``seconds``."""
    start = time.perf_counter()
    try:
        passed, detail = True, check.run(device)
    except (ClreconError, ArithmeticError, LookupError, ValueError, MemoryError, ImportError) as error:
        # A device that computes wrongly hands sizes and places to the host that lead to any of these.
        words = str(error) if isinstance(error, ClreconError) else f"{type(error).__name__}: {error}"
        passed, detail = False, words
    return {
        "operator": check.name,
        "passed": passed,
        "detail": detail,
        "seconds": round(time.perf_counter() - start, 3),
    }


def main() -> None:
    """Run the checks that are named in the JSON object on stdin, on the device that it names by its index."""
    lines = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # a driver may print

    def tell_line(**line: Any) -> None:
        lines.write(json.dumps(line) + "\n")

    request = json.load(sys.stdin)
    device = list_devices()[request["device"]]
    device.trace = lambda doing: tell_line(doing=doing)
    for check in CHECKS:
        if check.name in request["checks"]:
            tell_line(check=check.name)
            result = run_check(device, check)
            if device.known_good is not None:  # after its last result the process may be ended
                device.known_good.record()
            tell_line(warnings=device.warnings)
            tell_line(**result)


def run_device_selftest(
    name: str | None = None,
    *,
    checks: Sequence[Check] = CHECKS,
    progress: Progress | None = None,
    tell: Callable[[dict[str, Any], dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Compare every kernel with its twin, in a process of its own.

    `tell` is called with the device and each result, as they are returned, as soon as it is there.

    Return ``{"device": {...}, "passed": bool, "operators": [{"operator", "passed", "detail", "seconds"}], "warnings":
    [text]}``.
    """
    progress = progress or ignore_progress
    device = choose_unchecked(name)
    results: list[dict[str, Any]] = []
    progress("selftest", 0, len(checks))
    for result in run_selftest(device, checks, silent_seconds=min(device_seconds(), threading.TIMEOUT_MAX)):
        results.append(result)
        if tell is not None:
            tell(device.describe(), result)
        progress("selftest", len(results), len(checks))
    rank = {check.name: n for n, check in enumerate(checks)}
    results.sort(key=lambda result: rank.get(result["operator"], len(rank)))  # processes run side by side
    passed = bool(results) and all(result["passed"] for result in results)
    facts = {"device": device.describe(), "passed": passed, "operators": results, "warnings": device.warnings}
    return name_schema("selftest", facts)


if __name__ == "__main__":
    main()
