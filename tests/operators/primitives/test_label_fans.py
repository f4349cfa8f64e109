"""Faults of meshes found from the fans of a device equal those that the host finds from all triangles."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.errors import DeviceMemoryError
from clrecon.geometry import Volume
from clrecon.mesh.connectivity import find_topology
from clrecon.operators.primitives.union_find import label_fans
from clrecon.proof.volumes import volume_twins as twin


def cones(rim: int) -> np.ndarray:
    """A closed surface of two cones: their tips, the last vertices, are in `rim` triangles each."""
    around, ahead = np.arange(rim), np.roll(np.arange(rim), -1)
    upper = np.column_stack([np.full(rim, rim), around, ahead])
    return np.concatenate([upper, np.column_stack([np.full(rim, rim + 1), ahead, around])]).astype(np.uint32)


@pytest.mark.oclgrind
@pytest.mark.every_device
def test_vertices_without_a_closed_fan_equal_the_twin(device):
    """Cones with tips of 2 to 17 triangles, one of them open, a fin, a face twice, faces with a vertex twice."""
    parts, count = [], 0
    for rim in (2, 3, 5, 16, 17):
        parts.append(cones(rim) + np.uint32(count))
        count += rim + 2
    odd = [[count, count + 1, count + 2]] * 2 + [[0, 1, count + 3], [5, 5, 6], [7, 7, 7]]
    triangles = np.concatenate([parts[0], parts[1], parts[2][1:], *parts[3:], odd]).astype(np.uint32)
    (components, labels), irregular = label_fans(device, triangles, count + 6)
    expected_components, expected_labels = twin.label_components(triangles, count + 6)
    assert components == expected_components
    np.testing.assert_array_equal(labels, expected_labels)
    assert irregular.tolist() == twin.find_irregular(triangles, count + 6)


@pytest.mark.parametrize(("rim", "tips"), [(2, 2), (3, 0), (16, 0), (17, 2)], ids=["2", "3", "16", "17 triangles"])
def test_only_tips_of_three_to_sixteen_triangles_are_regular(device, rim, tips):
    _, irregular = label_fans(device, cones(rim), rim + 2)
    assert (irregular >= rim).sum() == tips


def with_faults(triangles: np.ndarray) -> np.ndarray:
    """Gaps, faces twice, faces turned round, a fin, and faces with a vertex twice and three times."""
    changed = np.concatenate([triangles[7:], triangles[400:410], triangles[500:503, ::-1]])
    changed[50:53] = changed[50:53, ::-1]
    changed[60, 2] = changed[900, 1]
    changed[70, 2], changed[80] = changed[70, 1], changed[80, 0]
    return changed


def joined(triangles: np.ndarray) -> np.ndarray:
    """Every 90th vertex becomes its neighbour by number: sheets touch at vertices, and edges get many faces."""
    return np.where(triangles % 90 == 0, triangles + 1, triangles).astype(np.uint32)


def assert_topology_is_that_of_the_host(device, triangles: np.ndarray) -> None:
    count = int(triangles.max()) + 3
    expected = find_topology(triangles, count)
    topology = find_topology(triangles, count, label_fans(device, triangles, count))
    for field in fields(expected):
        if field.name not in ("labelled", "opposite"):
            assert getattr(topology, field.name) == getattr(expected, field.name), field.name
    assert topology.labelled[0] == expected.labelled[0]
    np.testing.assert_array_equal(topology.labelled[1], expected.labelled[1])


@pytest.mark.parametrize("change", [np.asarray, with_faults, joined])
@pytest.mark.parametrize("closed", [True, False], ids=["closed", "open"])
@pytest.mark.parametrize("topology", ["separated", "trilinear"])
def test_topology_of_a_noisy_surface_from_fans_is_that_of_the_host(device, topology, closed, change):
    voxels = (np.random.default_rng(11).random((12, 20, 24)) < 0.3).astype(np.int16)
    volume = Volume(voxels, np.eye(4))
    mesh = clrecon.extract_isosurface(volume, 1, closed=closed, topology=topology, device=device)
    assert_topology_is_that_of_the_host(device, change(mesh.triangles))


@pytest.mark.parametrize(
    "triangles",
    [np.random.default_rng(3).integers(0, 300, (900, 3)).astype(np.uint32), cones(2), cones(40)],
    ids=["random", "back to back", "long fans"],
)
def test_topology_of_odd_triangles_from_fans_is_that_of_the_host(device, triangles):
    assert_topology_is_that_of_the_host(device, triangles)


def test_too_little_memory_for_links_of_corners_is_refused(device):
    triangles = np.random.default_rng(3).integers(0, 1000, (1000, 3)).astype(np.uint32)
    with refused(DeviceMemoryError, "links", 30_000):
        label_fans(device, triangles, 1000, memory=30_000)
