"""The self-test: every operator is compared with its numpy twin on the device that will be used, on small volumes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import ClreconError, DeviceError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.opencl import Device, download, upload
from clrecon.operators.primitives.compact import compact
from clrecon.operators.primitives.scan import exclusive_scan
from clrecon.operators.primitives.union_find import label_components
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.labels import extract_labels
from clrecon.reference.primitives import compact as compact_twin
from clrecon.reference.primitives import scan as scan_twin
from clrecon.reference.primitives import union_find as components_twin
from clrecon.reference.surface import extract as isosurface_twin
from clrecon.reference.surface import labels as label_twin

__all__ = ["run_selftest"]

VERTEX_TOLERANCE_VOXEL = 1e-4
"""Largest difference of device (float32) and twin (float64), in units of the smallest voxel edge."""

OBLIQUE = np.array([[0.7, 0.1, 0.05, -250.0], [-0.1, 0.5, 0.2, -300.0], [0.0, 0.05, 2.5, -846.0], [0.0, 0.0, 0.0, 1.0]])
"""An affine that is anisotropic, oblique and sheared, far from the origin."""


def _random_integers(shape: tuple[int, ...], dtype: str, high: int) -> NDArray[Any]:
    return np.random.default_rng(20).integers(0, high, shape).astype(dtype)


def _check_scan(device: Device) -> str:
    for n in (1, 63, 64, 65, 1023, 1024, 1025, 70_001):
        counts = _random_integers((n,), "uint32", 9)
        expected, total = scan_twin.exclusive_scan(counts)
        scanned = exclusive_scan(device, upload(device, counts), n)
        offsets = download(device, np.empty(n, dtype=np.uint32), scanned.offsets_d)
        if scanned.total != total or not np.array_equal(offsets, expected):
            raise DeviceError(f"wrong sums of {n} elements")
    return "8 sizes from 1 to 70,001 equal"


def _check_compaction(device: Device) -> str:
    for words in (1, 7, 8, 9, 513, 4001):
        mask = _random_integers((words,), "uint32", 2**32) & _random_integers((words,), "uint32", 2**31)
        expected = compact_twin.compact(mask)
        compacted = compact(device, upload(device, mask), words)
        positions = download(device, np.empty(compacted.count, dtype=np.uint32), compacted.positions_d)
        if not np.array_equal(positions, expected):
            raise DeviceError(f"wrong positions in a mask of {words} words")
    return "6 masks from 1 to 4,001 words equal"


def _check_components(device: Device) -> str:
    for vertices, triangles in ((64, 30), (5000, 1900), (5000, 9000)):
        mesh = _random_integers((triangles, 3), "uint32", vertices)
        count, labels = components_twin.label_components(mesh, vertices)
        found, numbers = label_components(device, mesh, vertices)
        if found != count or not np.array_equal(numbers, labels):
            raise DeviceError(f"wrong components of {triangles} triangles: {found} of {count}")
    return "3 meshes from 30 to 9,000 triangles equal"


def _check_isosurface(device: Device) -> str:
    worst = 0.0
    cases = (
        ((7, 9, 33), "int16", 3.0, True, OBLIQUE),
        ((6, 5, 70), "uint8", 2.0, False, OBLIQUE @ np.diag((-1.0, 1.0, 1.0, 1.0))),
        ((5, 6, 31), "float32", 2.5, True, np.diag((0.5, 0.7, 2.5, 1.0))),
    )
    for shape, dtype, iso_value, closed, affine in cases:
        volume = Volume(_random_integers(shape, dtype, 6), affine)
        vertices, _, triangles = isosurface_twin.extract_isosurface(volume, iso_value, closed=closed)
        mesh = extract_isosurface(volume, iso_value, device=device, closed=closed)
        resolved = extract_isosurface(volume, iso_value, device=device, closed=closed, topology="trilinear")
        expected = isosurface_twin.extract_isosurface(volume, iso_value, closed=closed, topology="trilinear")[2]
        if not np.array_equal(mesh.triangles, triangles) or not np.array_equal(resolved.triangles, expected):
            raise DeviceError(f"wrong triangles for {dtype} voxels")
        distance = float(np.abs(mesh.vertices - vertices).max()) / min(volume.spacing)
        if not distance <= VERTEX_TOLERANCE_VOXEL:
            allowed = f"allowed {VERTEX_TOLERANCE_VOXEL:g}"
            raise DeviceError(f"vertices {distance:.2g} voxel off for {dtype} voxels, {allowed}")
        worst = max(worst, distance)
    return f"3 volumes: triangles equal, vertices within {worst:.1e} voxel"


def _check_labels(device: Device) -> str:
    worst = 0.0
    for closed, solid in ((True, False), (False, True)):
        volume = Volume(_random_integers((7, 8, 37), "int16", 6), OBLIQUE)
        blocks = _random_integers((3, 3, 13), "uint16", 4).repeat(3, 0).repeat(3, 1).repeat(3, 2)[:7, :8, :37]
        numbers = (1, 2, 3)
        inside = label_twin.find_solid(volume, blocks, 3.0, closed=closed, solid=numbers if solid else ())
        meshes = extract_labels(volume, LabelMap(blocks, OBLIQUE), 3.0, device=device, closed=closed, solid=solid)
        for number in numbers:
            vertices, _, triangles = label_twin.extract_label(volume, inside, number, 3.0, closed=closed)
            if number not in meshes or not np.array_equal(meshes[number].triangles, triangles):
                raise DeviceError(f"wrong triangles of label {number}")
            worst = max(worst, float(np.abs(meshes[number].vertices - vertices).max()) / min(volume.spacing))
    if not worst <= VERTEX_TOLERANCE_VOXEL:
        raise DeviceError(f"vertices of labels {worst:.2g} voxel off, allowed {VERTEX_TOLERANCE_VOXEL:g}")
    return f"6 labels: triangles equal, vertices within {worst:.1e} voxel"


CHECKS: tuple[tuple[str, Callable[[Device], str]], ...] = (
    ("exclusive_scan", _check_scan),
    ("compact", _check_compaction),
    ("extract_isosurface", _check_isosurface),
    ("label_components", _check_components),
    ("extract_labels", _check_labels),
)


def run_selftest(device: Device) -> Iterator[dict[str, Any]]:
    """Check every operator on `device` and yield each result at once.

    Yields
    ------
    dict
        ``operator`` (str), ``passed`` (bool), ``detail`` (str: what was compared, or what is wrong) and
        ``seconds`` (float, kernel builds included).
    """
    for operator, check in CHECKS:
        start = time.perf_counter()
        try:
            passed, detail = True, check(device)
        except ClreconError as error:  # a device that computes wrongly can raise any error
            passed, detail = False, str(error)
        yield {
            "operator": operator,
            "passed": passed,
            "detail": detail,
            "seconds": round(time.perf_counter() - start, 3),
        }
