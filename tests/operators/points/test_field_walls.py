"""Walls without points equal their twin, and tell how much of a cloud's volume a hole has cost."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_shapes import cube_cloud, sphere_cloud

from clrecon import PointCloud, reconstruct_surface
from clrecon.operators.points.reconstruct import find_walls
from clrecon.proof.points import field as twin


def pack(mask):
    words = -(-mask.shape[2] // 32)
    padded = np.zeros((*mask.shape[:2], 32 * words), bool)
    padded[:, :, : mask.shape[2]] = mask
    return np.packbits(padded, axis=2, bitorder="little").view(np.uint32)


@pytest.mark.parametrize("shape", [(1, 1, 1), (4, 5, 31), (3, 4, 32), (33, 4, 33), (5, 34, 40), (32, 3, 8)])
def test_walls_at_random_equal_their_twin(shape):
    rng = np.random.default_rng(sum(shape))
    near, negative, inside = (rng.random(shape) < share for share in (0.8, 0.5, 0.4))
    found = find_walls(pack(near), pack(negative), pack(inside), shape[2])
    expected = twin.find_walls(near, negative, inside, 32)
    assert found.faces.sum() == sum(faces for faces, _, _ in expected.values())
    for place, (faces, walls, enclosed) in expected.items():
        assert (found.faces[place], found.walls[place]) == (faces, walls)
        assert found.enclosed[place] == pytest.approx(enclosed, abs=1e-9)


def test_the_walls_of_a_void_enclose_its_volume():
    """A box of 6 x 8 x 10 nodes without support within a body."""
    inside = np.ones((20, 20, 20), bool)
    inside[4:10, 5:13, 6:16] = False
    walls = find_walls(pack(inside), pack(inside & False), pack(inside), 20)
    assert walls.faces.sum() == walls.walls.sum() == 2 * (6 * 8 + 8 * 10 + 6 * 10)
    assert walls.lost == pytest.approx(6 * 8 * 10)
    assert (walls.share, walls.worst(3)) == (1.0, [(0, 0, 0)])


HALF = np.repeat(np.arange(20) >= 10, 400).reshape(20, 20, 20)
"""The upper half of a body of 20 nodes: one flat face of 400."""


def test_a_flat_wall_encloses_nothing():
    assert find_walls(pack(HALF), pack(HALF & False), pack(HALF), 20).lost == pytest.approx(0.0)


def test_a_face_with_support_is_no_wall():
    supported = find_walls(pack(HALF | True), pack(HALF), pack(HALF), 20)
    assert (supported.faces.sum(), supported.walls.sum(), supported.worst(3)) == (20 * 20, 0, [])


def balls(holes, radius=7.0, hole=2.6):
    """Twelve balls, of which so many have a hole at the top."""
    points, normals = [], []
    for number in range(12):
        cloud = sphere_cloud(2600, radius, seed=number)
        if number < holes:
            cloud = cloud.select(np.flatnonzero(np.linalg.norm(cloud.points - (0, 0, radius), axis=1) > hole))
        points.append(cloud.points + np.float32([20.0 * (number % 4), 20.0 * (number // 4), 0.0]))
        normals.append(cloud.normals)
    return PointCloud(np.concatenate(points), np.concatenate(normals))


@pytest.fixture(scope="module")
def whole_balls(device):
    return reconstruct_surface(balls(holes=0), 0.65, device=device)


@pytest.fixture(scope="module")
def one_open_ball(device):
    """The ball with the hole is the first, around the origin."""
    return reconstruct_surface(balls(holes=1), 0.65, device=device)


def test_balls_without_holes_are_not_warned_of(whole_balls):
    report = whole_balls.report
    assert (report["warnings"], report["open_cubes"], report["lost_share"]) == ([], [], 0.0)
    assert report["wall_share"] < 0.01


def test_one_open_ball_of_twelve_is_told_with_its_place(one_open_ball):
    report = one_open_ball.report
    assert report["votes_against_share"] < 0.05 and report["tries"] == 1  # outvoted: the share over all is not enough
    (warning,) = report["warnings"]
    assert "of the surface are walls that no points support, most of it within 10.4 mm of" in warning
    assert np.linalg.norm(report["open_cubes"][0]["centre_mm"]) < 20.0
    assert report["open_cubes"][0]["wall_share"] > 1.0 / 3.0


def test_the_share_that_an_open_ball_loses_is_told(whole_balls, one_open_ball):
    lost = 1.0 - one_open_ball.quality().volume_ml / whole_balls.quality().volume_ml
    assert lost > 0.02
    assert one_open_ball.report["lost_share"] == pytest.approx(lost, rel=0.5)


@pytest.mark.parametrize(("shape", "spacing"), [(sphere_cloud, 0.65), (cube_cloud, 0.64)])
def test_holes_that_are_bridged_are_sound(device, shape, spacing):
    cloud, rng = shape(), np.random.default_rng(5)
    keep = np.ones(len(cloud), bool)
    for centre in cloud.points[rng.integers(0, len(cloud), 8)]:
        keep &= np.linalg.norm(cloud.points - centre, axis=1) > 1.0
    report = reconstruct_surface(cloud.select(np.flatnonzero(keep)), spacing, device=device).report
    assert report["wall_share"] < 0.03 and report["lost_share"] == 0.0 and report["warnings"] == []


def plate(thickness=3.0, gap=4.25, n=6000):
    """A plate of 24 x 34 mm whose faces are sampled in lines, as with slices far apart."""
    rng = np.random.default_rng(1)
    side, rim = (np.where(np.arange(count) % 2, 1.0, -1.0) for count in (n, 1000))
    zero, through = np.zeros(1000), thickness * rng.uniform(-0.5, 0.5, 1000)
    lines, along = gap * rng.integers(-4, 5, n), rng.uniform(-12.0, 12.0, n)
    faces = np.stack([side * thickness / 2.0, along, lines], axis=1)
    rims = np.stack([through, 12.0 * rim, gap * rng.integers(-4, 5, 1000)], axis=1)
    ends = np.stack([through, rng.uniform(-12.0, 12.0, 1000), 4.0 * gap * rim], axis=1)
    normals = [np.stack([side, 0.0 * side, 0.0 * side], axis=1), np.stack([zero, rim, zero], axis=1)]
    normals.append(np.stack([zero, zero, rim], axis=1))
    return PointCloud(np.concatenate([faces, rims, ends]), np.concatenate(normals)), 24e-3 * 8.0 * gap * thickness


def test_lines_farther_apart_than_nodes_bridge_are_told(device):
    """The signs of the outside come in between the lines, where no vote is against them."""
    cloud, volume_ml = plate()
    mesh = reconstruct_surface(cloud, 1.2, bridge=2.5, device=device)
    assert mesh.quality().volume_ml < 0.5 * volume_ml
    assert mesh.report["votes_against_share"] < 0.001
    assert mesh.report["wall_share"] > 0.4 and mesh.report["lost_share"] > 0.2
    assert "of the volume are lost" in mesh.report["warnings"][0] and "at least" in mesh.report["warnings"][0]
    sound = reconstruct_surface(cloud, 2.5, bridge=2.5, device=device)
    assert sound.quality().volume_ml == pytest.approx(volume_ml, rel=0.12)
    assert sound.report["wall_share"] < 0.05 and not any("walls" in text for text in sound.report["warnings"])
