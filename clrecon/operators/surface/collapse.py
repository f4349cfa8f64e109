"""Collapses of edges in parallel rounds on a device, and triangles near another surface at all their points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.errors import UsageError
from clrecon.mesh.connectivity import Fans, find_used
from clrecon.mesh.refine.collapse import NONE, History, Pairing, Surface
from clrecon.opencl import Device

_STEP = 0.2
"""Least distance of the points of a new edge that are measured, in mean edges."""

RISE = 0.2
"""Height of a ridge of 90 degrees between points of the given surface, in mean edges: they lie twice as far apart.
With a half of it a fifth more collapses are undone, with the double one no fewer (a noisy chest).
"""

LONG = 1.0
"""Square of the length from which the middle of an edge is measured, in squares of the mean edge."""

_MOST_POINTS = 2**28 - 1
"""Most points of the given surface in lists: their numbers have 28 bits."""

Float32Array = NDArray[np.float32]
IntArray = NDArray[np.integer]


class DeviceCollapser:
    """The `clrecon.mesh.refine.collapse.Collapser` of a device.

    limit: Square of the distance, mm2, beyond which no point that is measured may lie.
    """

    def __init__(self, device: Device, surface: Surface, limit: float, memory: int | None = None):
        self._device, self._given = device, surface
        self._limit = float(limit)
        self._count, self._faces = len(surface.places), len(surface.triangles)
        if self._count + 4 * self._faces > _MOST_POINTS:
            raise UsageError(f"a mesh of {self._faces} triangles is too large to be decimated")
        self._program = ocl.load_program(device, "surface/collapse.cl", device.kernel_variants)
        self._within = ocl.load_program(device, "surface/within.cl", {"LANES": device.kernel_variants["LANES"]})
        self._ring = ocl.kernel_constant("surface/collapse.h", "MOST_RING")
        ocl.check_budget(device, self._needs(), memory)
        self._done = [0, 0]  # entries of rings, and collapses
        self._load()
        self._start()

    def _needs(self) -> dict[str, int]:
        """Return bytes by name, while edges collapse or, if that is more, while the result is checked."""
        vertices, faces = self._count, self._faces
        given = {"stars": 224 * vertices, "frames": 48 * faces, "faces around vertices": 16 * vertices + 24 * faces}
        collapses = {
            "points": 16 * (vertices + 4 * faces), "rings": 4 * self._ring * vertices, "quadrics": 48 * vertices,
            "half-edges": 31 * faces, "vertices": 65 * vertices,
        }  # fmt: skip
        check = {f"{name} of the result": size for name, size in given.items()} | {"triangles": 68 * faces}
        return given | max(collapses, check, key=lambda buffers: sum(buffers.values()))

    def _launch(self, kernel: str, items: int, /, **arguments: Any) -> None:
        ocl.launch(self._device, self._program[kernel], items, **arguments)

    def _upload(self, array: NDArray[Any]) -> Any:
        return ocl.upload(self._device, array, writable=True)

    def _load(self) -> None:
        device, given = self._device, self._given
        places = np.zeros((self._count, 4), np.float32)
        places[:, :3] = given.places
        self._surface = {
            "places": self._upload(places),
            "corners": self._upload(given.triangles.reshape(-1)),
            "opposite": self._upload(given.opposite),
        }
        self._leaving = self._upload(given.leaving)
        self._target: dict[str, Any] = {}
        self._present: dict[str, Any] = {}
        fans = given.fans.begin, given.fans.rows
        everything = np.arange(self._faces), np.arange(self._count)
        self._load_target(self._target, given.places, given.triangles, fans, *everything)
        self._ranks = {
            "octaves": ocl.allocate(device, 3 * self._faces),
            "quadrics": ocl.allocate(device, 48 * self._count),
        }
        self._lists = {
            "points": ocl.allocate(device, 16 * (self._count + 4 * self._faces)),
            "heads": ocl.allocate(device, 4 * self._faces),
        }
        self._firsts = self._upload(np.full(self._count, NONE, np.uint32))
        self._chosen = ocl.allocate(device, 4 * self._count)
        self._dirty = self._upload(np.ones(self._count, np.uint8))
        self._log = {
            "homes": self._upload(np.arange(self._count, dtype=np.uint32)),
            "earlier": ocl.allocate(device, 16 * self._count),
            "into": self._upload(np.full((self._count, 4), NONE, np.uint32)),
            "neighbours": ocl.allocate(device, 4 * self._ring * self._count),
        }

    def _bring(self, array: NDArray[Any], kind: Any) -> Any:
        return ocl.upload(self._device, array.astype(kind, copy=False) if len(array) else np.zeros(4, kind))

    def _load_target(
        self, target: dict[str, Any], places: Float32Array, corners: NDArray[np.uint32],
        fans: tuple[IntArray, IntArray], rows: IntArray, vertices: IntArray,
    ) -> None:  # fmt: skip
        """Bring a surface to the device to which distances are measured; some of its faces and vertices are new.

        corners: ndarray, shape (m, 3).
        fans: Where the faces around each vertex begin in the list of these, and the list.
        """
        if not target:
            target["frames"] = ocl.allocate(self._device, 48 * max(self._faces, 1))
            target["stars"] = ocl.allocate(self._device, 224 * max(self._count, 1))
        of_faces = {"places": self._bring(places, np.float32), "faces": self._bring(corners.reshape(-1), np.uint32)}
        fans_d = {name: self._bring(array, np.int32) for name, array in zip(("begin", "around"), fans, strict=True)}
        ocl.launch(
            self._device, self._within["frame_faces"], len(rows), **of_faces, frames=target["frames"],
            rows=self._bring(rows, np.uint32), count=len(rows),
        )  # fmt: skip
        ocl.launch(
            self._device, self._within["gather_stars"], len(vertices), **of_faces, **fans_d, stars=target["stars"],
            vertices=self._bring(vertices, np.uint32), count=len(vertices),
        )  # fmt: skip
        target |= {"first_places": of_faces["places"], "first_corners": of_faces["faces"], **fans_d}

    def _start(self) -> None:
        surface, leaving = self._surface, self._leaving
        self._launch(
            "sum_quadrics", self._count, **surface, leaving=leaving, quadrics=self._ranks["quadrics"], count=self._count
        )
        self._launch(
            "rank_edges", 3 * self._faces, **surface, **self._ranks, half_edges=3 * self._faces, most=self._limit
        )
        self._launch(
            "hang_points", self._faces, **surface, leaving=leaving, **self._lists, faces=self._faces, count=self._count,
            longest=LONG * self._given.mean_edge**2,
        )  # fmt: skip

    def octaves(self) -> NDArray[np.uint8]:
        return self._read(self._ranks["octaves"], np.uint8, 3 * self._faces)

    def look_at_standing(self) -> int:
        leaving = self._read(self._leaving, np.uint32, self._count)
        standing = np.flatnonzero(leaving != NONE).astype(np.uint32)
        self._standing = len(standing)
        self._vertices = ocl.upload(self._device, standing if len(standing) else np.zeros(1, np.uint32))
        return self._standing

    def run_round(self, number: int, octave: int, most: int) -> tuple[int, int]:
        of_edges = {name: self._surface[name] for name in ("corners", "opposite")} | {"octaves": self._ranks["octaves"]}
        of_edges |= {"firsts": self._firsts, "vertices": self._vertices, "items": self._standing}
        self._launch("find_first_edges", self._standing, **of_edges, leaving=self._leaving, dirty=self._dirty)
        counts = self._upload(np.array([0, *self._done], np.uint32))
        self._launch("select_edges", self._standing, **of_edges, chosen=self._chosen, counts=counts, limit=octave)
        items, chosen = self._standing // 2, self._chosen  # no two edges have an end in common
        if items > most:  # else none need be left out, and the host need not know how many there are
            edges = self._keep_first(most, counts)
            items, chosen = len(edges), self._upload(np.append(edges, np.uint32(NONE)))
            counts = self._upload(np.array([items, *self._done], np.uint32))
        self._launch(
            "collapse_edges", items, **self._surface, leaving=self._leaving, **self._ranks, dirty=self._dirty,
            **self._lists, **self._log, counts=counts, **self._target, chosen=chosen, count=self._count,
            number=number, limit=self._limit, most=self._limit, spacing=_STEP * self._given.mean_edge,
            rise=RISE * self._given.mean_edge,
        )  # fmt: skip
        selected, *self._done = (int(count) for count in self._read(counts, np.uint32, 3))
        return selected, self._done[1]

    def _keep_first(self, most: int, counts: Any) -> NDArray[np.uint32]:
        """Return the first of the selected edges by their numbers."""
        selected = int(self._read(counts, np.uint32, 3)[0])
        edges: NDArray[np.uint32] = np.sort(self._read(self._chosen, np.uint32, selected))[:most]
        return edges

    def _read(self, buffer: Any, kind: Any, *shape: int) -> NDArray[Any]:
        return ocl.download(self._device, np.empty(shape, kind), buffer)

    def finish(self) -> tuple[History, Pairing]:
        faces_at, below = (self._upload(np.full(self._faces, -1, np.int32)) for _ in range(2))
        self._launch(
            "pair_faces", self._faces, **self._lists, faces_at=faces_at, below=below, faces=self._faces,
            count=self._count,
        )  # fmt: skip
        read = self._read
        into, rounds, begin, size = read(self._log["into"], np.int32, self._count, 4).T
        history = History(
            into.copy(), rounds.copy(), read(self._log["earlier"], np.float32, self._count, 4)[:, :3],
            read(self._surface["places"], np.float32, self._count, 4)[:, :3].copy(), begin, size,
            read(self._log["neighbours"], np.int32, self._ring * self._count)[: self._done[0]],
        )  # fmt: skip
        homes = read(self._log["homes"], np.int32, self._count)
        pairing = Pairing(read(faces_at, np.int32, self._faces), read(below, np.int32, self._faces), homes)
        for buffers in (self._surface, self._ranks, self._lists, self._log):  # room for the result
            buffers.clear()
        return history, pairing

    def show_present(
        self, places: Float32Array, corners: NDArray[np.uint32], rows: IntArray, changed: IntArray
    ) -> None:
        fans = Fans(corners.take(rows, axis=0), self._count)
        around, vertices = (fans.begin, rows[fans.rows]), find_used(corners[changed], self._count)
        self._load_target(self._present, places, corners, around, changed, vertices)

    def find_near_faces(
        self, corners: Float32Array, hints: NDArray[np.int32], present: bool, limit: float
    ) -> NDArray[np.int32]:
        device = self._device
        if len(corners) == 0:
            return np.zeros((0, 4), np.int32)
        target = self._present if present else self._target
        witnesses, witnesses_d = ocl.empty_output(device, (len(corners), 4), np.int32)
        ocl.launch(
            device, self._within["find_near_faces"], len(corners),
            triangles=ocl.upload(device, corners), hints=ocl.upload(device, hints), places=target["first_places"],
            faces=target["first_corners"], begin=target["begin"], around=target["around"], frames=target["frames"],
            stars=target["stars"], witnesses=witnesses_d, limit=limit, count=len(corners),
        )  # fmt: skip
        return ocl.download(device, witnesses, witnesses_d)
