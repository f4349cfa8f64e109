"""The check of a device at its first use: the surface of a ball; `clrecon selftest` checks every kernel."""

from __future__ import annotations

import json
import sys

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import ClreconError, DeviceMemoryError, DeviceTimeoutError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.opencl import Device, list_devices
from clrecon.operators.surface.extract import extract_isosurface

SIZE = 72
"""Voxels along each side: more than 500 work-items in every pass, and several words in a row."""

RADIUS = 31.3
CENTRE = (35.2, 35.9, 34.6)
"""Of the ball, in voxels: no symmetry."""

STEEPNESS = 64.0
"""HU per voxel: the field is the distance to the ball's surface."""

_SURFACE_VOXEL = 0.03
"""Largest distance of a vertex from the ball: rounding of HU, and chords of the linear field; measured 0.012."""

NORMAL = 0.03
"""Largest difference of a normal from the direction to the centre; measured 0.015."""

VOLUME_SHARE = 2e-3
"""Largest difference of the enclosed volume, as a share; measured 7e-4."""


def check_ball(device: Device) -> str:
    """Extract the surface of a ball and compare it; return what is wrong, empty if nothing is."""
    k, j, i = np.ogrid[:SIZE, :SIZE, :SIZE]
    distance = np.sqrt((i - CENTRE[0]) ** 2 + (j - CENTRE[1]) ** 2 + (k - CENTRE[2]) ** 2)
    volume = Volume(np.rint(STEEPNESS * (RADIUS - distance)).astype(np.int16), np.eye(4))
    try:
        mesh = extract_isosurface(volume, 0.5, device=device)
        if mesh.report["slabs"] != 1:  # wrong sums look like a lack of memory
            return "a ball of 0.7 MB was made in parts"
    except DeviceTimeoutError:
        raise
    except DeviceMemoryError:
        return ""  # a device that is full is no wrong one: what follows meets the same
    except (ClreconError, ArithmeticError, LookupError, ValueError) as error:
        return str(error)
    return _compare_mesh(mesh)


def _compare_mesh(mesh: Mesh) -> str:
    vertices, triangles = mesh.vertices.astype(np.float64), mesh.triangles.astype(np.int64)
    if not len(triangles) or triangles.max(initial=0) >= len(vertices):
        return (
            f"a ball of {len(vertices):,} vertices and {len(triangles):,} triangles, some of them beyond the vertices"
        )
    outward = vertices - CENTRE
    away = np.abs(np.linalg.norm(outward, axis=1) - RADIUS)
    if not away.max() <= _SURFACE_VOXEL:
        wrong = int(np.count_nonzero(~(away <= _SURFACE_VOXEL)))
        return f"{wrong:,} of {len(away):,} vertices of a ball lie beside it"
    assert mesh.normals is not None
    turned = np.abs(mesh.normals - outward / np.linalg.norm(outward, axis=1)[:, None]).max(axis=1)
    if not turned.max() <= NORMAL:
        wrong = int(np.count_nonzero(~(turned <= NORMAL)))
        return f"{wrong:,} of {len(turned):,} normals of a ball point elsewhere"
    open_edges = _count_open_edges(triangles, len(vertices))
    if open_edges or len(triangles) != 2 * len(vertices) - 4:
        return f"the surface of a ball has {open_edges:,} open edges and {len(triangles):,} triangles"
    corners = outward[triangles]
    volume = np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    share = volume / (4.0 / 3.0 * np.pi * RADIUS**3)
    return "" if abs(share - 1.0) <= VOLUME_SHARE else f"the surface of a ball encloses {share:.3g} of its volume"


def _count_open_edges(triangles: NDArray[np.int64], vertices: int) -> int:
    """Count the edges that are not passed once each way."""
    begin, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    _, edges = np.unique(np.minimum(begin, end) * vertices + np.maximum(begin, end), return_inverse=True)
    return int(np.count_nonzero((np.bincount(edges) != 2) | (np.bincount(edges, np.sign(end - begin)) != 0.0)))


def main(index: str) -> None:
    """Check a device in a process of its own; the last line that it prints is the answer as JSON."""
    device = list_devices()[int(index)]
    device.fault = ""  # what the check asks of the device is no first use
    print(json.dumps(check_ball(device)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
