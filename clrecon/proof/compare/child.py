"""The processes of methods: each runs one, draws what it made, and writes figures as JSON and arrays as files."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

from clrecon.errors import ClreconError, DeviceError
from clrecon.jobs.run import peak_memory_bytes, to_json
from clrecon.opencl import has_hung_commands
from clrecon.operators import choose_device
from clrecon.proof.compare.makers import Scene, draw, make_timed, time_small
from clrecon.proof.compare.methods import COMPARED
from clrecon.proof.compare.processes import COPIES, Request, load_volume, save_arrays, save_mesh, tell_crash
from clrecon.system.processes import end_process
from clrecon.system.progress import time_limit

LONG_SECONDS = 1.0
"""No further warm run begins after so many seconds of them."""


_END_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""


def run_method(request: Request) -> dict[str, Any]:
    """Run a method: first, warm, its picture; its arrays are files of the request's folder afterwards.

    Return its ``state`` ("done", "failed" or "declined"), and with "done" the figures, see
    `_measure_method`; else ``error``, what kind it is of, and why.
    """
    try:
        with time_limit(request.timeout):
            return {"state": "done", "error": None, "kind": None, **_measure_method(request)}
    except ClreconError as error:
        state = "failed" if isinstance(error, DeviceError) else "declined"  # it works, and not on this scan
        return {"state": state, "kind": type(error).__name__, "error": str(error), "hung": has_hung_commands()}
    except MemoryError:
        return {"state": "failed", "kind": "MemoryError", "error": "out of memory"}
    except Exception as error:  # a library's own: one row of the table, and no end of the others
        return {"state": "failed", "kind": type(error).__name__, "error": f"{type(error).__name__}: {error}"}


def _measure_method(request: Request) -> dict[str, Any]:
    folder, name = Path(request.folder), request.method
    scene = Scene(load_volume(folder), request, None)
    before = peak_memory_bytes()
    opened = _open_device(scene) if COMPARED[name].on_device else 0.0
    result = make_timed(scene)
    first = result.seconds
    first["build"] += opened
    runs: list[dict[str, float]] = []
    while len(runs) < request.repeat and sum(map(_total, runs)) < LONG_SECONDS:
        del result  # two results at once would count as the memory of one
        result = make_timed(scene)
        runs.append(result.seconds)
    peak = peak_memory_bytes()
    if scene.device is None and COMPARED[name].makes != "picture":  # it draws the mesh
        _open_device(scene)
    product = result.product
    pictures: dict[str, Any] = {}
    for view in request.views():
        if name == "rays-cpu" and view == "along":
            continue
        for seconds in (first, *runs[:1]) if view == "view" else ({},):
            start = perf_counter()
            pictures[view] = draw(scene, product, view)
            if COMPARED[name].makes != "picture":
                seconds["draw"] = perf_counter() - start
    for seconds in runs[1:]:
        seconds["draw"] = runs[0]["draw"]
    small = [time_small(scene) for _ in range(2)] if name == "rays" else None
    if name == "rays-cpu":
        small = [_total(first), min(map(_total, runs))]
    save_arrays(folder, name, **pictures)
    report = result.report
    return {
        "first": first,
        "warm": runs,
        "kernel_seconds": dict(report.get("kernel_seconds", {})),
        "small": small,
        "memory_bytes": peak,
        "memory_before_bytes": before,
        "cells": report.get("cells"),
        "growing": report.get("growing"),
        "warnings": [str(text) for text in report.get("warnings", ())],
        "hung": False,
        **_save(folder, name, product),
    }


def _total(seconds: dict[str, float]) -> float:
    return sum(seconds.values())


def _save(folder: Path, name: str, product: Any) -> dict[str, Any]:
    """Write the arrays of a mesh or a cloud, and count them."""
    makes = COMPARED[name].makes
    if makes == "mesh":
        save_mesh(folder, name, product)
        return {"vertices": product.vertex_count, "triangles": product.triangle_count, "points": None}
    if makes == "cloud":
        save_arrays(folder, name, points=product.points)
        return {"vertices": None, "triangles": None, "points": len(product)}
    return {"vertices": None, "triangles": None, "points": None}


def _open_device(scene: Scene) -> float:
    start = perf_counter()
    scene.device = choose_device(scene.request.device)
    _ = scene.device.queue
    return perf_counter() - start


def main() -> None:
    """Run the methods that lines of JSON on stdin name, and answer each with a line of JSON on stdout.

    Each runs in a copy of this process, which has loaded the modules already, or one alone where there are no copies.
    """
    lines = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # a driver may print
    for line in sys.stdin:
        if COPIES and (copy := os.fork()):
            code = os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])
            if code:
                lines.write(to_json(tell_crash(code), indent=None) + "\n")
            continue
        if COPIES:
            ctypes.CDLL(None).prctl(_END_WITH_PARENT, signal.SIGKILL)
        data = json.loads(line)
        request = Request(**{**data, "size": tuple(data["size"])})
        lines.write(to_json(run_method(request), indent=None) + "\n")
        end_process()


if __name__ == "__main__":
    main()
