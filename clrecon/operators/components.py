"""Connected components of a triangle mesh: the host side of cl/components/union_find.cl."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.kernels import Program, Stopwatch, allocate, download, launch, load_program, upload
from clrecon.opencl import Device, check_budget
from clrecon.operators.compaction import LARGEST_SCAN, exclusive_scan

__all__ = ["label_components"]

LARGEST_MESH = 2**32 - 1
"""Triangles that 32 bits can count."""


def label_components(
    device: Device, triangles: ArrayLike, vertex_count: int, *, stopwatch: Stopwatch | None = None
) -> tuple[int, NDArray[np.int64]]:
    """Number the components of a mesh: triangles that share a vertex belong to one.

    Parameters
    ----------
    device : Device
    triangles : array_like, shape (m, 3), uint32
        Indices of vertices.
    vertex_count : int
    stopwatch : Stopwatch, optional
        Where the time of the kernels goes.

    Returns
    -------
    count : int
        Number of components; vertices that no triangle uses are none.
    labels : ndarray, shape (vertex_count,), int64
        Component of each vertex, numbered in order of the first vertex; -1 for unused vertices.  The same on every
        device, and what `clrecon.mesh.connectivity.label_components` returns.

    Raises
    ------
    UsageError
        A triangle refers to a vertex that is not there, or there are more than 2^31 vertices or 2^32 - 1 triangles.
    DeviceError
        Not enough memory, or the device fails.
    """
    faces = np.ascontiguousarray(triangles, dtype=np.uint32).reshape(-1, 3)
    _check_mesh(faces, vertex_count)
    if len(faces) == 0:
        return 0, np.full(vertex_count, -1, dtype=np.int64)
    vertices = 4 * vertex_count
    check_budget(
        device,
        {
            "triangles": faces.nbytes,
            "labels": vertices,
            "labels of the round before": vertices,
            "component offsets": vertices,
            "component numbers": vertices,
        },
    )
    program = load_program(device, "components/union_find.cl")
    faces_d = upload(device, faces)
    labels_d, spare_d = _find_roots(device, program, faces_d, len(faces), vertex_count, stopwatch)
    n = np.uint32(vertex_count)
    launch(device, program["flag_roots"], vertex_count, labels_d, spare_d, n, stopwatch=stopwatch)
    roots = exclusive_scan(device, spare_d, vertex_count, stopwatch=stopwatch)
    numbers_d = allocate(device, vertices)
    launch(
        device, program["number_components"], vertex_count,
        labels_d, roots.offsets_d, numbers_d, n, stopwatch=stopwatch,
    )  # fmt: skip
    numbers = download(device, np.empty(vertex_count, dtype=np.int32), numbers_d)
    return roots.total, numbers.astype(np.int64)


def _check_mesh(triangles: NDArray[np.uint32], vertex_count: int) -> None:
    if not 0 <= vertex_count <= LARGEST_SCAN or len(triangles) > LARGEST_MESH:
        raise UsageError(
            f"a mesh of {vertex_count:,} vertices and {len(triangles):,} triangles:"
            f" components are found in up to {LARGEST_SCAN:,} and {LARGEST_MESH:,}"
        )
    if triangles.size and int(triangles.max()) >= vertex_count:
        raise UsageError(f"a triangle refers to vertex {int(triangles.max())}, the mesh has {vertex_count} vertices")


def _find_roots(
    device: Device, program: Program, faces_d: Any, face_count: int, vertex_count: int, stopwatch: Stopwatch | None
) -> tuple[Any, Any]:
    """Rounds of hooking and jumping; returns the labels, all of them roots, and a buffer of the same size."""
    n, m = np.uint32(vertex_count), np.uint32(face_count)
    labels_d, other_d, flags_d = (allocate(device, 4 * size) for size in (vertex_count, vertex_count, 2))
    flags = np.empty(2, dtype=np.uint32)
    launch(device, program["clear_labels"], vertex_count, other_d, flags_d, n, stopwatch=stopwatch)
    launch(device, program["hook_corners"], face_count, faces_d, other_d, m, stopwatch=stopwatch)
    for number in map(np.uint32, count(1)):
        launch(device, program["jump_labels"], vertex_count, other_d, labels_d, flags_d, n, number, stopwatch=stopwatch)
        if download(device, flags, flags_d)[0] == number:
            labels_d, other_d = other_d, labels_d
            continue
        launch(device, program["copy_labels"], vertex_count, labels_d, other_d, n, stopwatch=stopwatch)
        launch(
            device, program["hook_labels"], face_count,
            faces_d, labels_d, other_d, flags_d, m, number, stopwatch=stopwatch,
        )  # fmt: skip
        if download(device, flags, flags_d)[1] != number:
            break
    return labels_d, other_d
