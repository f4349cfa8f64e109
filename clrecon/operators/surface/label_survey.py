"""Survey of a label map: the box of each label, and the number of faces that its voxels share with other labels.

The host side of cl/surface/label_survey.cl; if the device has no room for the whole map, numpy computes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import DeviceMemoryError
from clrecon.labels import LabelMap
from clrecon.labels.enclosed import count_faces
from clrecon.labels.solid import Box, find_boxes
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    describe_shortage,
    download,
    launch,
    load_program,
    memory_limits,
    upload,
)
from clrecon.operators.resident.voxel_types import label_variants


def prepare_survey(device: Device, label_dtype: DTypeLike = np.uint8) -> Program:
    """Build the kernels for labels of this type."""
    return load_program(device, "surface/label_survey.cl", label_variants(label_dtype))


def survey_labels(
    labels: LabelMap, device: Device, memory: int | None, stopwatch: Stopwatch
) -> tuple[dict[int, Box], NDArray[np.integer[Any]]]:
    """Return the box (k, j, i) of each label and the samples around it, and the table of `count_faces`.

    labels: Label map with at least one label.
    memory: Bytes that may be taken on the device; None is all that it has.
    """
    try:
        surveyed = _survey(labels, device, memory, stopwatch)
    except DeviceMemoryError:
        surveyed = None  # without room on the device, numpy computes it
    if surveyed is not None:
        return surveyed
    voxels, size = labels.voxels, labels.numbers[-1] + 1
    none = np.zeros((size, 2), np.uint32)
    faces = count_faces(voxels) if len(labels.numbers) > 1 else none
    return find_boxes(voxels, labels.numbers, (0, 0, 0)), faces


def _survey(
    labels: LabelMap, device: Device, memory: int | None, stopwatch: Stopwatch
) -> tuple[dict[int, Box], NDArray[np.integer[Any]]] | None:
    """Compute the same on the device; None if it has no room."""
    voxels, size = labels.voxels, labels.numbers[-1] + 1
    boxes, faces = np.empty((size, 6), np.int32), np.zeros((size, 2), np.uint32)
    touch = len(labels.numbers) > 1
    needs = {"labels": voxels.nbytes, "boxes": boxes.nbytes, "faces": faces.nbytes}
    if describe_shortage(memory_limits(device, memory), needs):
        return None
    with stopwatch.timed("build"):
        program = prepare_survey(device, voxels.dtype)
    with stopwatch.timed("upload"):
        map_d = upload(device, voxels)
    boxes_d, faces_d = allocate(device, boxes.nbytes), allocate(device, faces.nbytes)
    ni, nj, nk = labels.shape_ijk
    grid: dict[str, Any] = {"map": map_d, "ni": ni, "nj": nj, "nk": nk}
    with stopwatch.running(device):
        launch(device, program["clear_survey"], size, stopwatch=stopwatch, boxes=boxes_d, faces=faces_d, labels=size)
        launch(device, program["find_boxes"], nj * nk, stopwatch=stopwatch, boxes=boxes_d, **grid)
        if touch:
            launch(device, program["count_faces"], nj * nk, stopwatch=stopwatch, faces=faces_d, **grid)
    return _widen(download(device, boxes, boxes_d), labels.numbers, (ni, nj, nk)), download(device, faces, faces_d)


def _widen(table: NDArray[np.int32], numbers: Sequence[int], shape_ijk: tuple[int, int, int]) -> dict[int, Box]:
    """Widen the boxes of a table of lowest and highest i, j, k by one sample each way, within the map."""
    boxes: dict[int, Box] = {}
    for number in numbers:
        low, high = np.maximum(table[number, :3] - 1, 0), np.minimum(table[number, 3:] + 2, shape_ijk)
        i, j, k = (slice(int(begin), int(end)) for begin, end in zip(low, high, strict=True))
        boxes[number] = (k, j, i)
    return boxes
