"""The processes of a comparison: one after another for methods, whose memory is their own; side by side for measures.
They are told and tell plain values, and arrays in files of a folder; a crash of one becomes words.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.proof.timing import usable_cores
from clrecon.rendering.views.camera import Camera
from clrecon.system.processes import describe_end, start_python, start_with

_VOXELS, _PLACE = "voxels.npy", "place.npz"


@dataclass(frozen=True)
class Request:
    """What a process does with a method and the volume in `folder`, `repeat` warm runs; `along`: view for the paper."""

    method: str
    folder: str
    iso_value: float
    closed: bool
    device: int
    memory: int | None
    repeat: int
    timeout: float
    camera: dict[str, Any]
    size: tuple[int, int]
    along: dict[str, Any] | None = None

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def views(self) -> dict[str, tuple[Camera, tuple[int, int]]]:
        """Return the pictures that are drawn: the name of each, its camera, and its size."""
        views = {"view": (Camera(**self.camera), (self.size[0], self.size[1]))}
        if self.along is not None:
            width, height = self.along["size"]
            views["along"] = Camera(**self.along["camera"]), (width, height)
        return views


def save_volume(folder: Path, volume: Volume) -> None:
    """Write voxels and place of a volume, and nothing of its report."""
    np.save(folder / _VOXELS, volume.voxels, allow_pickle=False)
    geometry = {"affine": volume.affine}
    if volume.uneven:
        geometry["positions"] = volume.slice_origins()
    np.savez(folder / _PLACE, **geometry)  # type: ignore[arg-type]


def load_volume(folder: Path) -> Volume:
    """Read what `save_volume` wrote, into memory."""
    voxels = np.load(folder / _VOXELS, allow_pickle=False)
    with np.load(folder / _PLACE, allow_pickle=False) as geometry:
        return Volume(voxels, geometry["affine"], None, geometry["positions"] if "positions" in geometry else None)


def save_arrays(folder: Path, name: str, **arrays: NDArray[Any] | None) -> None:
    """Write the arrays of a method; those that are None are left out."""
    for role, array in arrays.items():
        if array is not None:
            np.save(folder / f"{name}-{role}.npy", array, allow_pickle=False)


def load_array(folder: Path, name: str, role: str) -> NDArray[Any] | None:
    """Read one of them; None if it was left out."""
    path = folder / f"{name}-{role}.npy"
    return np.load(path, allow_pickle=False) if path.exists() else None


def save_mesh(folder: Path, name: str, mesh: Mesh) -> None:
    save_arrays(folder, name, vertices=mesh.vertices, triangles=mesh.triangles, normals=mesh.normals)


def load_mesh(folder: Path, name: str) -> Mesh | None:
    vertices, triangles = (load_array(folder, name, what) for what in ("vertices", "triangles"))
    if vertices is None or triangles is None:
        return None
    return Mesh(vertices, triangles, load_array(folder, name, "normals"))


_METHOD = ("-m", "clrecon.proof.compare.child")
_JUDGE = ("-m", "clrecon.proof.compare.judge")
_SUBJECT = "methods are compared"

_MOST_JUDGES = 4

COPIES = sys.platform == "linux"
"""Whether a process can go on as a copy; elsewhere the system's libraries may not work in one, or there are none."""


def tell_crash(code: int) -> dict[str, Any]:
    """Return what a process would have told that ended with an exit code instead."""
    return {"state": "failed", "kind": "Crash", "error": describe_end(code), "hung": False}


@contextlib.contextmanager
def open_methods() -> Iterator[Callable[[Request], dict[str, Any]]]:
    """Yield a function that runs a method in a process of its own: see `clrecon.proof.compare.child.run_method`."""
    running: list[subprocess.Popen[bytes]] = []

    def run(request: Request) -> dict[str, Any]:
        if not running:
            running.append(start_python(_METHOD, _SUBJECT))
        (process,) = running
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(OSError):  # it has ended already: its answer is missing
            process.stdin.write(json.dumps(request.as_dict()).encode() + b"\n")
            process.stdin.flush()
        answer = process.stdout.readline()
        if not answer or not COPIES:
            running.remove(process)
            process.communicate()
        return json.loads(answer) if answer else tell_crash(process.returncode)

    try:
        yield run
    finally:
        for process in running:
            process.kill()
            process.communicate()


MEASURES = {"quality": 2, "slices": 4, "cells": 4, "surfaces": 6, "truth": 3, "points": 1}
"""What is measured, and about how long each takes beside the others."""


def measure_in_processes(data: Mapping[str, Any], methods: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure products, a process a core; yield names with figures, see `Judge`, and ``reasons``.

    Each process takes some measures of all products, so that what it needs of scan and reference is made once.
    """
    parts = _share(MEASURES, min(usable_cores(), _MOST_JUDGES))
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for part in parts:
            processes.append(start_with(_JUDGE, _SUBJECT, {**data, "methods": list(methods), "measures": part}))
        for method in methods:
            figures: dict[str, Any] = {"reasons": {}}
            for process in processes:
                assert process.stdout is not None
                line = process.stdout.readline()
                answer = json.loads(line) if line else {"reasons": {"all": describe_end(process.wait())}}
                figures |= {**answer, "reasons": figures["reasons"] | answer["reasons"]}
            yield method, figures
    finally:
        for process in processes:
            with process:
                process.kill()


def _share(loads: Mapping[str, int], most: int) -> list[list[str]]:
    """Share out to at most so many processes, the largest first, each to the one with the least to do."""
    parts: list[list[str]] = [[] for _ in range(min(most, len(loads)))]
    for name in sorted(loads, key=lambda name: -loads[name]):
        min(parts, key=lambda part: sum(map(loads.__getitem__, part))).append(name)
    return parts
