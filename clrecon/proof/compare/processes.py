"""The processes of a comparison: one after another for methods, whose memory is their own; side by side for measures.
They are told and tell plain values, and arrays in files of a folder; a crash of one becomes words.
"""

from __future__ import annotations

import json
import queue
import subprocess
import threading
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.proof.timing import usable_cores
from clrecon.rendering.views.camera import Camera
from clrecon.system.processes import describe_end, start_with

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


def run_in_process(request: Request) -> dict[str, Any]:
    """Run a method in a process of its own, and return what `clrecon.proof.compare.child.run_method` tells."""
    process = start_with(_METHOD, _SUBJECT, request.as_dict())
    assert process.stdout is not None
    try:
        answer = process.stdout.read()
        process.wait()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    try:
        answer_record: dict[str, Any] = json.loads(answer)
    except ValueError:
        return {"state": "failed", "kind": "Crash", "error": describe_end(process.returncode), "hung": False}
    return answer_record


def measure_in_processes(data: Mapping[str, Any], methods: Mapping[str, int]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure products, a process a core; yield names with figures, see `Judge`, or ``reasons``."""
    parts = _share(methods, min(usable_cores(), _MOST_JUDGES))
    lines: queue.Queue[tuple[int, bytes]] = queue.Queue()
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for number, part in enumerate(parts):
            process = start_with(_JUDGE, _SUBJECT, {**data, "methods": part})
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
                yield name, {"reasons": {"all": describe_end(processes[number].returncode)}}
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
