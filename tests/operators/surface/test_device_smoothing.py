"""Smoothing on a device has the bits of its twin, whatever the surface."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from flat_sheets import sheet

import clrecon
from clrecon.mesh import Mesh
from clrecon.mesh.refine.smoothing import Filter, Rings, sinc_terms
from clrecon.operators.surface import smoothing
from clrecon.operators.surface.smoothing import DeviceFilter


def rough(vertices: np.ndarray, seed: int = 1) -> np.ndarray:
    """Vertices with noise of 0.1 mm, in float32."""
    return (vertices + np.random.default_rng(seed).normal(0.0, 0.1, vertices.shape)).astype(np.float32)


def assert_steps_have_bits_of_twin(
    device: object, vertices: np.ndarray, triangles: np.ndarray, iterations: int
) -> None:
    """Bends, normals and steps of the vertices have the same bits by the device and by the host."""
    rings = Rings.of(triangles.astype(np.uint32), len(vertices))
    on_device, on_host = DeviceFilter(device, rings), Filter(rings)
    for found, expected in zip(on_device.measure_bends(vertices), on_host.measure_bends(vertices), strict=True):
        np.testing.assert_array_equal(found, expected)
    bends, _ = on_host.measure_bends(vertices)
    expected = on_host.find_steps(bends, sinc_terms(iterations))
    assert expected.any()
    np.testing.assert_array_equal(on_device.find_steps(bends, sinc_terms(iterations)), expected)


@pytest.mark.every_device
@pytest.mark.parametrize("iterations", [1, 2, 20, 300])
def test_steps_have_the_bits_of_the_twin(device, iterations):
    vertices, triangles = samples.sphere(centre=(0, 0, 0), radius=20.0, rounds=4)
    assert_steps_have_bits_of_twin(device, rough(vertices), triangles, iterations)


@pytest.mark.every_device
@pytest.mark.parametrize("size", [7, 8, 9, 31])
def test_open_surfaces_of_all_sizes_are_smoothed_to_the_bits_of_the_twin(device, size):
    vertices, triangles = sheet(size)
    assert_steps_have_bits_of_twin(device, rough(vertices), triangles, iterations=5)


@pytest.mark.oclgrind
def test_small_surface_is_smoothed_to_the_bits_of_the_twin(device):
    """A closed surface whose vertices have four and six neighbours, and an open one."""
    vertices, triangles = samples.join(samples.sphere(rounds=1), sheet(4))
    assert_steps_have_bits_of_twin(device, rough(vertices), triangles, iterations=3)


def rough_spheres_that_nearly_touch(origin: float) -> Mesh:
    """Two rough spheres 0.4 mm apart, a speck and a vertex without triangles, so many mm from the origin along x."""
    ball, faces = samples.sphere(centre=(0, 0, 0), radius=5.0, rounds=4)
    speck, its_faces = samples.box(low=(0.0, 9.0, 0.0), size=(0.2, 0.2, 0.2))
    beside = rough(ball, seed=2) + [10.4, 0, 0]
    vertices, triangles = samples.join((rough(ball), faces), (beside, faces), (speck, its_faces))
    return Mesh(np.concatenate([vertices, [[1.0, 2.0, 3.0]]]) + [origin, 0.0, 0.0], triangles)


@pytest.mark.parametrize(("origin", "dtype"), [(0.0, np.float32), (1e4, np.float64)], ids=["near", "far"])
def test_a_smoothed_mesh_is_the_same_with_a_device_and_without(device, origin, dtype):
    mesh = rough_spheres_that_nearly_touch(origin)
    assert mesh.vertices.dtype == dtype
    options = {"iterations": 20, "max_deviation_mm": 0.25}
    with_device, without = clrecon.smooth_mesh(mesh, **options, device=device), clrecon.smooth_mesh(mesh, **options)
    np.testing.assert_array_equal(with_device.vertices, without.vertices)
    np.testing.assert_array_equal(with_device.normals, without.normals)
    assert with_device.report == without.report


def test_smoothing_takes_two_fifths_off_the_roughness(device):
    mesh = rough_spheres_that_nearly_touch(origin=0.0)
    report = clrecon.smooth_mesh(mesh, iterations=20, max_deviation_mm=0.25, device=device).report
    roughness = report["refinement"]["smooth"]
    assert roughness["roughness_after_mm"] < 0.6 * roughness["roughness_before_mm"]  # measured 0.29 of it


def test_a_mesh_is_smoothed_by_the_host_where_the_device_has_no_room(device, monkeypatch):
    vertices, triangles = samples.sphere(centre=(0, 0, 0), radius=20.0, rounds=3)
    mesh = Mesh(rough(vertices), triangles)
    expected = clrecon.smooth_mesh(mesh, iterations=5, max_deviation_mm=0.25, device=device)
    monkeypatch.setattr(smoothing.ocl, "describe_shortage", lambda *_: "no room")
    monkeypatch.setattr(smoothing.ocl, "launch", None)
    by_host = clrecon.smooth_mesh(mesh, iterations=5, max_deviation_mm=0.25, device=device)
    np.testing.assert_array_equal(by_host.vertices, expected.vertices)
