"""Components found on the device equal the twin's and scipy's, whatever the mesh and the device."""

from __future__ import annotations

import math

import numpy as np
import pytest
from refusals import refused
from variants import daily

import clrecon
from clrecon.errors import DeviceError, DeviceMemoryError, UsageError
from clrecon.geometry import Volume
from clrecon.mesh import connectivity
from clrecon.opencl import upload
from clrecon.opencl.arrays import copy_buffer
from clrecon.operators.primitives import union_find as components
from clrecon.operators.primitives.union_find import hook_in_rounds, label_components
from clrecon.proof.volumes import volume_twins as twin

AFFINE = np.diag((0.5, 0.7, 2.5, 1.0))


def random_triangles(*, vertices: int, triangles: int) -> np.ndarray:
    """Random triangles, some of them with one vertex two or three times."""
    return np.random.default_rng(7).integers(0, vertices, (triangles, 3)).astype(np.uint32)


def strip(vertices: int) -> np.ndarray:
    """A strip of triangles: its vertices are one path."""
    return np.arange(vertices - 2, dtype=np.uint32)[:, None] + np.arange(3, dtype=np.uint32)


def assert_components_equal(device, triangles: np.ndarray, vertex_count: int, other=twin.label_components) -> int:
    """Count and labels are those of another implementation, the twin or scipy's; return the count."""
    count, labels = label_components(device, triangles, vertex_count)
    expected_count, expected = other(triangles, vertex_count)
    assert count == expected_count
    assert labels.dtype == np.int64
    np.testing.assert_array_equal(labels, expected)
    return count


def test_labelling_components_leaves_the_triangles_as_they_are(device):
    triangles = random_triangles(vertices=65, triangles=22)
    before = triangles.copy()
    label_components(device, triangles, 65)
    np.testing.assert_array_equal(triangles, before)


@pytest.mark.every_device
@pytest.mark.parametrize("vertices", [1, 2, 31, 63, 64, 65, 1023, 1024, 1025])
@pytest.mark.parametrize("share", [0.1, 0.35, 3.0])
def test_components_of_random_triangles_equal_the_twin(device, vertices, share):
    triangles = random_triangles(vertices=vertices, triangles=max(1, int(share * vertices)))
    assert_components_equal(device, triangles, vertices)


ORDERS = pytest.mark.parametrize("order", daily(1, ["ascending", "descending", "shuffled"]))


LONG = 3001


def long_strip(order: str) -> np.ndarray:
    """Triangles whose `LONG` vertices are one path: chains of labels are as long as they can be."""
    number = {
        "ascending": np.arange(LONG),
        "descending": np.arange(LONG)[::-1],
        "shuffled": np.random.default_rng(3).permutation(LONG),
    }[order].astype(np.uint32)
    return number[strip(LONG)]


@ORDERS
def test_a_long_strip_is_one_component(device, order):
    assert assert_components_equal(device, long_strip(order), LONG) == 1


@ORDERS
def test_a_long_strip_without_every_seventh_triangle_is_one_component_of_the_twin(device, order):
    """The others still join all vertices."""
    triangles = long_strip(order)
    assert assert_components_equal(device, triangles[np.arange(len(triangles)) % 7 != 6], LONG) == 1


@ORDERS
def test_pieces_of_a_long_strip_are_the_components_of_the_twin(device, order):
    """Four triangles of each seven: pieces of six vertices, one between two unused."""
    triangles = long_strip(order)
    pieces = math.ceil(len(triangles) / 7)  # the last one of fewer triangles
    assert assert_components_equal(device, triangles[np.arange(len(triangles)) % 7 < 4], LONG) == pieces


@pytest.mark.parametrize("centre", [0, 500, 1000])
def test_a_fan_is_one_component_whatever_the_number_of_its_centre(device, centre):
    rim = np.delete(np.arange(1001, dtype=np.uint32), centre)
    triangles = np.column_stack([np.full(500, centre, np.uint32), rim[0::2], rim[1::2]])
    assert assert_components_equal(device, triangles, 1001) == 1


@pytest.mark.parametrize("basins", [5, 20, 200, 2000])
def test_a_chain_of_roots_is_one_component(device, basins):
    """0 - n - 1 - n+1 - 2 ...: the first round leaves the roots 0, 1, 2 ..., each of which hooks to the one before."""
    path = np.arange(2 * basins).reshape(2, basins).T.ravel().astype(np.uint32)
    edges = np.column_stack([path[:-1], path[1:], path[1:]])
    assert assert_components_equal(device, edges, 2 * basins) == 1


def test_a_device_that_hooks_without_end_is_refused_after_a_thousand_passes(device):
    def hook_again(labels_d, hooked_d, flags_d, number):
        copy_buffer(device, upload(device, np.array([0, number], np.uint32)), flags_d, 8)

    labels_d, other_d = (upload(device, np.zeros(4, np.uint32)) for _ in range(2))
    with refused(DeviceError, 1000, "passes"):
        hook_in_rounds(device, labels_d, other_d, n=4, hook=hook_again)


def test_components_are_numbered_by_their_smallest_vertex_and_unused_vertices_have_none(device):
    """Vertices 1 and 8, 3 alone, and 4, 5, 7 and 9."""
    triangles = np.array([[9, 4, 7], [3, 3, 3], [8, 1, 1], [5, 9, 9]], dtype=np.uint32)
    count, labels = label_components(device, triangles, 11)
    assert count == 3
    assert labels.tolist() == [-1, 0, -1, 1, 2, 2, -1, 2, 0, 2, -1]


def test_labels_of_components_do_not_depend_on_the_order_of_triangles_and_corners(device):
    triangles = random_triangles(vertices=400, triangles=160)
    shuffled = np.random.default_rng(1).permuted(np.random.default_rng(2).permutation(triangles), axis=1)
    _, expected = label_components(device, triangles, 400)
    _, labels = label_components(device, shuffled, 400)
    np.testing.assert_array_equal(labels, expected)


@pytest.mark.parametrize("density", [0.03, 0.2, 0.5])
def test_components_of_noisy_surfaces_equal_scipy(device, density):
    voxels = (np.random.default_rng(11).random((20, 33, 40)) < density).astype(np.int16)
    mesh = clrecon.extract_isosurface(Volume(voxels, AFFINE), 1, device=device)
    assert_components_equal(device, mesh.triangles, mesh.vertex_count, other=connectivity.label_components)


def test_sheets_through_one_cell_are_two_components(device):
    """Two voxels across the diagonal of a cell share its cells and no vertex: one component of cells, two surfaces."""
    voxels = np.zeros((4, 4, 4), np.int16)
    voxels[1, 1, 1] = voxels[2, 2, 2] = 10
    mesh = clrecon.extract_isosurface(Volume(voxels, np.eye(4)), 5, device=device)
    count, _ = label_components(device, mesh.triangles, mesh.vertex_count)
    assert count == 2


@pytest.mark.every_device
@pytest.mark.parametrize("group", daily(1, [1, 16]))
def test_components_on_devices_with_small_work_groups_equal_the_twin(device, group, monkeypatch):
    monkeypatch.setattr(device, "max_work_group_size", group)
    assert_components_equal(device, random_triangles(vertices=500, triangles=200), 500)


@pytest.mark.oclgrind
def test_components_of_a_small_strip_and_a_chain_of_roots_equal_the_twin(device):
    """A shuffled strip takes several rounds, a row of basins several passes; unused vertices and one alone."""
    number = np.random.default_rng(6).permutation(70).astype(np.uint32)
    path = 70 + np.arange(40).reshape(2, 20).T.ravel()
    edges = np.column_stack([path[:-1], path[1:], path[1:]])
    triangles = np.concatenate([number[strip(60)], [[number[61]] * 3], edges]).astype(np.uint32)
    assert_components_equal(device, triangles, vertex_count=70 + 40 + 2)


@pytest.mark.parametrize("triangles", [np.empty((0, 3), np.uint32), []], ids=["empty array", "empty list"])
@pytest.mark.parametrize("vertices", [0, 3])
def test_mesh_without_triangles_has_no_components(device, triangles, vertices):
    count, labels = label_components(device, triangles, vertices)
    assert count == 0
    assert labels.tolist() == [-1] * vertices


@pytest.mark.parametrize(
    ("triangle", "vertices", "vertex"), [([0, 1, 5], 5, 5), ([0, 0, 0], 0, 0)], ids=["beyond the last", "of none"]
)
def test_vertices_that_are_not_there_are_refused(device, triangle, vertices, vertex):
    with refused(UsageError, vertex, "vertex"):
        label_components(device, np.array([triangle], np.uint32), vertices)


def test_components_of_more_vertices_than_31_bits_count_are_refused(device):
    with refused(UsageError, "components"):
        label_components(device, np.zeros((1, 3), np.uint32), 2**31 + 1)


def test_a_device_too_small_for_components_is_refused_before_memory_is_taken(device, monkeypatch):
    monkeypatch.setattr(device, "memory_bytes", 16_000)
    monkeypatch.setattr(components.ocl, "allocate", lambda *_: pytest.fail("memory was taken"))
    with refused(DeviceMemoryError, "component", "offsets", 16_000):
        label_components(device, random_triangles(vertices=1000, triangles=10), 1000)


def test_too_little_memory_allowed_for_components_is_refused(device):
    with refused(DeviceMemoryError, "components", "labels", 15_000):
        label_components(device, random_triangles(vertices=1000, triangles=10), 1000, memory=15_000)


@pytest.mark.release
def test_components_of_bone_in_a_real_scan_equal_scipy(device, real_data):
    volume = clrecon.read_volume(real_data / "thoracic_0p8mm")
    mesh = clrecon.extract_isosurface(volume, 226, device=device)
    found = assert_components_equal(device, mesh.triangles, mesh.vertex_count, other=connectivity.label_components)
    assert found > 1000, "too few components to compare"
