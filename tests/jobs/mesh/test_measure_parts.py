"""Parts measured with the help of a device have the figures of the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import clrecon
from clrecon.errors import DeviceMemoryError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.refinement import label_part, measure_parts
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import Part, Surface

VOXELS = (np.random.default_rng(5).random((32, 34, 36)) < 0.2).astype(np.int16)


@pytest.fixture
def measured_by_host(device: Any) -> Part:
    return measure(device, None)


def measure(device: Any, measuring: Any) -> Part:
    """Measure a surface of many components that is open at the border."""
    volume = Volume(VOXELS, np.diag((0.5, 0.7, 1.2, 1.0)))
    mesh = clrecon.extract_isosurface(volume, 1, closed=False, device=device)
    assert mesh.triangle_count > 50_000  # of fewer the host does all
    part = Part(Surface("", 1.0), "", mesh)
    measure_parts([part], volume, MeshSettings(iso_value=1.0), measuring)
    return part


def test_device_and_host_measure_the_same(device: Any, measured_by_host: Part) -> None:
    part = measure(device, device)
    assert part.quality == measured_by_host.quality
    assert part.quality is not None
    assert part.quality.boundary_edges > 1000
    assert part.facts == measured_by_host.facts
    np.testing.assert_array_equal(part.component_ml, measured_by_host.component_ml)
    assert part.mesh.report["warnings"] == []


def test_topology_found_with_the_components_is_not_looked_for_again(
    device: Any, measured_by_host: Part, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = Part(measured_by_host.surface, "", measured_by_host.mesh)
    count, labels = label_part(part, device, MeshSettings(), measure=True)

    monkeypatch.delattr("clrecon.operators.primitives.union_find.label_fans")
    measure_parts([part], Volume(VOXELS, np.diag((0.5, 0.7, 1.2, 1.0))), MeshSettings(iso_value=1.0), device)

    assert part.quality == measured_by_host.quality
    assert part.topology is None  # its memory is free
    assert (count, labels.tolist()) == (part.quality.components, label_part(part, device, MeshSettings())[1].tolist())


def test_mesh_that_does_not_fit_the_device_is_measured_by_the_host_with_a_warning(
    device: Any, measured_by_host: Part, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise DeviceMemoryError("too large")

    monkeypatch.setattr("clrecon.operators.primitives.union_find.label_fans", refuse)
    part = measure(device, device)
    assert part.mesh.report["warnings"] == ["too large: the mesh was measured without it"]
    assert part.quality == measured_by_host.quality


def test_volume_of_each_of_many_components_is_that_of_an_octahedron(device: Any) -> None:
    """16 x 16 x 16 voxels apart; of whole numbers the level lies half a step lower, 3/4 of the way to 0."""
    voxels = np.zeros((48, 48, 48), np.int16)
    voxels[1::3, 1::3, 1::3] = 2
    volume = Volume(voxels, np.diag((0.5, 0.7, 1.2, 1.0)))
    mesh = clrecon.extract_isosurface(volume, 1, device=device)
    part = Part(Surface("", 1.0), "", mesh)
    measure_parts([part], volume, MeshSettings(iso_value=1.0), device)
    octahedron_ml = 4.0 / 3.0 * 0.75**3 * 0.5 * 0.7 * 1.2 / 1000.0
    np.testing.assert_allclose(part.component_ml, np.full(16**3, octahedron_ml), rtol=1e-5)  # float32 coordinates
