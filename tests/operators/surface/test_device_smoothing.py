"""Smoothing on a device has the bits of its twin, whatever the surface."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from near_surfaces import sheet

import clrecon
from clrecon.mesh import Mesh
from clrecon.mesh.refine.smoothing import Filter, Rings, sinc_terms
from clrecon.operators.surface import smoothing
from clrecon.operators.surface.smoothing import DeviceFilter


def rough(vertices: np.ndarray, seed: int = 1) -> np.ndarray:
    return (vertices + np.random.default_rng(seed).normal(0.0, 0.1, vertices.shape)).astype(np.float32)


def has_same_bits(device: object, vertices: np.ndarray, triangles: np.ndarray, iterations: int) -> bool:
    rings = Rings.of(triangles.astype(np.uint32), len(vertices))
    bends: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    steps: list[np.ndarray] = []
    for each in (DeviceFilter(device, rings), Filter(rings)):
        for found, all_found in zip(each.measure_bends(vertices), (bends, normals), strict=True):
            all_found.append(found)
        steps.append(each.find_steps(bends[0], sinc_terms(iterations)))
    return all(np.array_equal(*both) for both in (bends, normals, steps))


@pytest.mark.every_device
@pytest.mark.parametrize("iterations", [1, 2, 20, 300])
def test_steps_have_the_bits_of_the_twin(device, iterations):
    vertices, triangles = samples.sphere((0, 0, 0), 20.0, 4)
    assert has_same_bits(device, rough(vertices), triangles, iterations)


@pytest.mark.every_device
@pytest.mark.parametrize("size", [7, 8, 9, 31])
def test_open_surfaces_of_all_sizes_are_smoothed_to_the_bits_of_the_twin(device, size):
    vertices, triangles = sheet(size)
    assert has_same_bits(device, rough(vertices), triangles, 5)


@pytest.mark.oclgrind
def test_small_surface_is_smoothed_to_the_bits_of_the_twin(device):
    vertices, triangles = samples.box()
    assert has_same_bits(device, rough(vertices), triangles, 3)


@pytest.mark.parametrize("scale", [1.0, 200.0])
def test_a_mesh_is_the_same_with_a_device_and_without(device, scale):
    """Two rough spheres that nearly touch, a speck and a vertex without triangles; near the origin and far from it."""
    ball, faces = samples.sphere((0, 0, 0), 5.0, 4)
    speck, its = samples.box((0.0, 9.0, 0.0), (0.2, 0.2, 0.2))
    parts = samples.join((rough(ball), faces), (rough(ball, 2) + [10.4, 0, 0], faces), (speck, its))
    vertices = np.concatenate([parts[0], [[1.0, 2.0, 3.0]]]) + [1e4 * (scale > 1.0), 0.0, 0.0]
    mesh = Mesh(vertices, parts[1])
    assert mesh.vertices.dtype == (np.float32 if scale == 1.0 else np.float64)
    own, other = clrecon.smooth_mesh(mesh, 20, 0.25, device=device), clrecon.smooth_mesh(mesh, 20, 0.25)
    np.testing.assert_array_equal(own.vertices, other.vertices)
    np.testing.assert_array_equal(own.normals, other.normals)
    assert own.report == other.report
    said = own.report["refinement"]["smooth"]
    assert said["roughness_after_mm"] < 0.6 * said["roughness_before_mm"]


def test_a_device_without_room_leaves_it_to_the_host(device, monkeypatch):
    vertices, triangles = samples.sphere((0, 0, 0), 20.0, 3)
    mesh = Mesh(rough(vertices), triangles)
    expected = clrecon.smooth_mesh(mesh, 5, 0.25, device=device)
    monkeypatch.setattr(smoothing.ocl, "describe_shortage", lambda *_: "no room")
    monkeypatch.setattr(smoothing.ocl, "launch", None)
    np.testing.assert_array_equal(clrecon.smooth_mesh(mesh, 5, 0.25, device=device).vertices, expected.vertices)
