"""Surfaces made slab by slab, and what is the same."""

from __future__ import annotations

from typing import Any

import numpy as np

from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.slabs import SampleGrid
from clrecon.system.arguments import Topology


def extract_in_slabs(
    volume: Any,
    iso_value: Any,
    device: Any,
    *,
    slices: int,
    closed: bool = True,
    topology: Topology = "separated",
    **options: Any,
) -> Any:
    """The surface of a volume whose slabs have so many slices at most."""
    resident = DeviceVolume(volume, device=device)
    rule = choose_iso_rule(volume, iso_value, closed=closed, topology=topology, **options)
    resident.most_slices[SampleGrid(volume, rule).kind] = slices
    return extract_isosurface(resident, iso_value, closed=closed, topology=topology, **options)


def assert_same(mesh: Any, expected: Any) -> None:
    """Assert that two meshes are equal bit by bit."""
    assert np.array_equal(mesh.triangles, expected.triangles)
    assert np.array_equal(mesh.vertices, expected.vertices)
    assert np.array_equal(mesh.normals, expected.normals)
