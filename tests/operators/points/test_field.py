"""The field around a cloud equals its twin, and so do the signs of all nodes."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_shapes import cube_cloud, fetch_mask, fetch_masks, sphere_cloud, twin_field
from refusals import refused
from tolerances import TWIN_FIELD_MM

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.opencl import memory_limits, upload
from clrecon.opencl.buffers import raw
from clrecon.operators.points.field import MOST_NODES, FieldSettings, Masks, NodeField, decide_signs, plan_nodes
from clrecon.operators.points.grid import plan_grid
from clrecon.points.cloud import PointCloud
from clrecon.proof.points import field as twin


def scattered_cloud(n):
    """Random points in a box of 9 x 7 x 8 mm, with random normals."""
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud((rng.random((n, 3)) - 0.5) * (9.0, 7.0, 8.0), normals)


def assert_field_equals_twin(device, cloud, settings):
    """The masks, the signs and the volume of a field are those of the twin."""
    field = NodeField(device, cloud, cloud.normals, settings)
    expected, near, core = twin_field(cloud, field.nodes, settings)
    found_near, found_core, negative = fetch_masks(field.masks)
    np.testing.assert_array_equal(found_near, near)
    np.testing.assert_array_equal(found_core, core)
    clear = near & (np.abs(np.where(near, expected.value, 0.0)) > TWIN_FIELD_MM)
    np.testing.assert_array_equal(negative[clear], expected.value[clear] <= 0.0)
    assert not negative[~near].any()
    signs = decide_signs(field.masks, field.limits, settings.rounds)
    decided = twin.decide_signs(near, core, negative, settings.rounds)
    np.testing.assert_array_equal(fetch_mask(field.masks, signs.inside_d), decided.inside)
    assert (signs.votes, signs.against, signs.regions) == (decided.votes, decided.against, decided.regions)
    assert signs.outside_is_inside == decided.inside[0, 0, 0]
    volume = field.fill(signs)
    far = float(np.float32(settings.bridge))
    filled = twin.fill_nodes(expected, near, decided, far, 1e-6 * settings.spacing)
    np.testing.assert_allclose(volume, filled, atol=TWIN_FIELD_MM, rtol=0.0)
    np.testing.assert_array_equal(volume > 0.0, decided.inside)


def settings_of_spacing(spacing, *, reach=2.0, smoothing=0.1, bridge=2.0):
    """Lengths of a field in mm from shares of its spacing."""
    return FieldSettings(spacing, reach * spacing, smoothing * spacing, bridge * spacing)


@pytest.mark.parametrize(
    ("reach", "smoothing", "bridge"), [(2.0, 0.1, 2.0), (3.0, 1000.0, 1.5), (4.0, 1.0, 1.0), (2.6, 0.1, 2.5)]
)
def test_field_of_a_sphere_equals_the_twin(device, reach, smoothing, bridge):
    settings = settings_of_spacing(0.6, reach=reach, smoothing=smoothing, bridge=bridge)
    assert_field_equals_twin(device, sphere_cloud(700, radius=4.0), settings)


@pytest.mark.parametrize("n", [1, 2, 3, 60, 255, 256, 257, 1000])
def test_field_of_points_with_random_normals_equals_the_twin(device, n):
    assert_field_equals_twin(device, scattered_cloud(n), settings_of_spacing(0.8))


@pytest.mark.oclgrind
def test_field_of_a_small_sphere_equals_the_twin(device):
    assert_field_equals_twin(device, sphere_cloud(150, radius=2.5), settings_of_spacing(0.9))


def test_a_point_at_the_end_of_its_cell_reaches_the_first_nodes_of_the_next_brick(device):
    """Cells begin 0.002 mm below the lowest point and are 2 mm long: the second point is 0.0003 mm below the next one.

    Nodes begin 4.5 mm below the lowest point; along z a brick has four, and the third brick begins at 3.5 mm, which is
    1.5023 mm above the second point and within its reach.
    """
    cloud = PointCloud([[0.0, 0.0, 0.0], [0.5, 0.5, 1.9977]], np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    settings = FieldSettings(1.0, reach=1.5025, smoothing=0.1, bridge=3.5)
    assert_field_equals_twin(device, cloud, settings)

    field = NodeField(device, cloud, cloud.normals, settings)
    assert field.nodes.bricks == (2, 3, 3) and field.nodes.corner.tolist() == [-4.5, -4.5, -4.5]
    near, _, _ = fetch_masks(field.masks)
    third_brick = near[8:]
    assert np.argwhere(third_brick).tolist() == [[0, 5, 5]]  # k, j, i of the node at (0.5, 0.5, 3.5)


def test_field_around_600_points_in_one_place_equals_the_twin(device):
    """The kernel gathers 256 points of a brick at a time."""
    sphere = sphere_cloud(300, radius=3.0)
    points = np.concatenate([np.full((600, 3), (0.3, 0.1, -0.2)), sphere.points])
    normals = np.concatenate([np.tile((0.0, 0.6, 0.8), (600, 1)), sphere.normals])
    assert_field_equals_twin(device, PointCloud(points, normals), settings_of_spacing(0.7))


@pytest.mark.parametrize("length", [6.1, 6.2, 14.2, 25.0])
def test_field_of_nodes_around_whole_bricks_and_words_equals_the_twin(device, length):
    """Nodes along x on both sides of a brick of 8 and of a word of 32."""
    cloud = cube_cloud(500, edge=2.0)
    stretched = PointCloud(cloud.points * (length, 1.0, 1.0), cloud.normals)
    assert_field_equals_twin(device, stretched, settings_of_spacing(0.8, bridge=1.25))


@pytest.mark.parametrize("rounds", [0, 1, 4])
@pytest.mark.parametrize(("seed", "share_near"), list(enumerate((0.1, 0.5, 0.7, 0.9, 0.99, 0.6))))
def test_signs_of_random_masks_equal_the_twin(device, seed, share_near, rounds):
    rng = np.random.default_rng(seed)
    shape = (8 * int(rng.integers(1, 9)), 4 * int(rng.integers(1, 4)), 4 * int(rng.integers(1, 4)))  # whole bricks
    near = rng.random(shape[::-1]) < share_near
    core, negative = near & (rng.random(near.shape) < 0.4), near & (rng.random(near.shape) < 0.5)
    near[0, 0, 0] = core[0, 0, 0] = negative[0, 0, 0] = False  # the first node is outside of everything
    masks = put_masks(device, near, core, negative)

    signs = decide_signs(masks, memory_limits(device), rounds)

    expected = twin.decide_signs(near, core, negative, rounds)
    np.testing.assert_array_equal(fetch_mask(masks, signs.inside_d), expected.inside)
    assert (signs.votes, signs.against, signs.regions) == (expected.votes, expected.against, expected.regions)


def put_masks(device, *arrays):
    """The masks near, core and negative on the device, from arrays (nz, ny, nx)."""
    masks = Masks(device, arrays[0].shape[::-1])
    for name, array in zip(("near_d", "core_d", "negative_d"), arrays, strict=True):
        padded = np.zeros((*array.shape[:2], 32 * masks.words), dtype=bool)
        padded[:, :, : array.shape[2]] = array
        packed = np.packbits(padded, axis=2, bitorder="little")
        buffer = masks.make()
        write(device, buffer, upload(device, packed), packed.nbytes)
        setattr(masks, name, buffer)
    return masks


def write(device, to_d, from_d, size):
    import pyopencl

    pyopencl.enqueue_copy(device.queue, raw(to_d), raw(from_d), byte_count=size).wait()


def test_field_filled_in_slabs_is_that_of_the_whole_bit_for_bit(device):
    cloud, settings = sphere_cloud(3000, radius=12.0), settings_of_spacing(0.5)
    whole = NodeField(device, cloud, cloud.normals, settings)
    assert len(whole.slabs) == 1
    expected = whole.fill(decide_signs(whole.masks, whole.limits, settings.rounds))

    point_bytes = 3 * 4  # of float32
    needs = whole.grid.nbytes + whole.nbytes + point_bytes * len(cloud)
    parts = NodeField(device, cloud, cloud.normals, settings, memory=needs + expected.nbytes // 6)
    assert len(parts.slabs) > 2
    parts_signs = decide_signs(parts.masks, whole.limits, settings.rounds)
    assert np.array_equal(parts.fill(parts_signs), expected)


def test_memory_below_a_layer_of_bricks_is_refused_with_what_is_needed(device):
    cloud = sphere_cloud(3000, radius=12.0)
    with refused(DeviceMemoryError, "surface", "cloud", 200_000):
        NodeField(device, cloud, cloud.normals, settings_of_spacing(0.5), memory=200_000)


@pytest.fixture(scope="module")
def sphere_nodes():
    """A sphere of 5 mm, lengths of a field, and the nodes planned around it."""
    cloud, settings = sphere_cloud(500, radius=5.0), settings_of_spacing(0.7, bridge=2.3)
    return cloud, settings, plan_nodes(plan_grid(cloud, edge=1.4), settings)


def test_nodes_reach_beyond_the_points_by_the_bridge_and_a_node(sphere_nodes):
    cloud, settings, nodes = sphere_nodes
    first = nodes.affine[:3, 3]
    last = first + settings.spacing * (np.array(nodes.shape) - 1)
    margin = settings.bridge + 0.99 * settings.spacing  # but for rounding
    assert (cloud.points.min(axis=0) - first > margin).all()
    assert (last - cloud.points.max(axis=0) > margin).all()


def test_nodes_fill_whole_bricks_of_8_x_4_x_4(sphere_nodes):
    _, _, nodes = sphere_nodes
    assert [size % brick for size, brick in zip(nodes.shape, (8, 4, 4), strict=True)] == [0, 0, 0]


FAR_CORNERS = np.array([(0, 0, 0), (900, 900, 900)], np.float32)


def test_too_many_nodes_are_refused_with_the_most_allowed():
    with refused(UsageError, MOST_NODES, "nodes"):
        plan_nodes(plan_grid(FAR_CORNERS, edge=1.0), settings_of_spacing(0.5))


def test_nearly_as_many_nodes_as_allowed_are_planned():
    """Some 1210 nodes 0.75 mm apart along each side of 900 mm."""
    nodes = plan_nodes(plan_grid(FAR_CORNERS, edge=1.5), settings_of_spacing(0.75))
    assert 1200**3 < nodes.count <= MOST_NODES
