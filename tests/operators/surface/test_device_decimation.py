"""Decimation on a device: lanes, memory, and every access to it."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.mesh import Mesh
from clrecon.mesh.compare.distances import SurfaceDistance
from clrecon.operators.surface.decimation import decimate_mesh


def rough_sphere(rounds: int) -> Mesh:
    vertices, triangles = samples.sphere(centre=(0, 0, 0), radius=20.0, rounds=rounds)
    return Mesh((vertices + np.random.default_rng(2).normal(0.0, 0.1, vertices.shape)).astype(np.float32), triangles)


def test_one_lane_and_eight_leave_the_same_triangles(device, monkeypatch):
    mesh = rough_sphere(4)
    small = decimate_mesh(mesh, fraction=0.8, max_deviation_mm=0.15, device=device)
    lanes = "1" if device.kernel_variants["LANES"] == "8" else "8"
    monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": lanes})
    other = decimate_mesh(mesh, fraction=0.8, max_deviation_mm=0.15, device=device)
    np.testing.assert_array_equal(small.triangles, other.triangles)
    np.testing.assert_array_equal(small.vertices, other.vertices)


@pytest.mark.oclgrind
def test_small_sphere_loses_a_third_of_its_triangles_within_the_bound(device):
    mesh = rough_sphere(3)
    small = decimate_mesh(mesh, fraction=0.33, max_deviation_mm=1.0, device=device)
    assert small.triangle_count == pytest.approx(0.67 * mesh.triangle_count, abs=2)  # a collapse takes two
    assert SurfaceDistance(small.vertices, small.triangles)(mesh.vertices.astype(float)).max() <= 1.0


def test_too_little_memory_is_refused(device):
    with refused(DeviceError, "100,000"):
        decimate_mesh(rough_sphere(3), fraction=0.5, max_deviation_mm=0.3, device=device, memory=100_000)
