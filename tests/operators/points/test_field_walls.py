"""Walls without points equal their twin, and tell how much of a cloud's volume a hole has cost."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_shapes import cube_cloud, sphere_cloud

from clrecon import PointCloud, reconstruct_surface
from clrecon.operators.points.reconstruct import find_walls


def find_walls_of(near, negative, inside):
    """The walls of masks of nodes, shape (nz, ny, nx)."""
    return find_walls(pack_bits(near), pack_bits(negative), pack_bits(inside), nx=inside.shape[2])


def pack_bits(mask):
    words = -(-mask.shape[2] // 32)
    padded = np.zeros((*mask.shape[:2], 32 * words), bool)
    padded[:, :, : mask.shape[2]] = mask
    return np.packbits(padded, axis=2, bitorder="little").view(np.uint32)


def find_walls_slowly(
    near: np.ndarray, negative: np.ndarray, inside: np.ndarray, cube: int
) -> dict[tuple[int, int, int], tuple[int, int, float]]:
    """Count the faces between inner and outer nodes, and those that no points support.

    A face is supported where both nodes are near and the field has two signs there.  Where it has one, the signs of far
    nodes have come through a hole in the cloud and stopped at the points of the other side: a wall.

    Return by cube (z, y, x) of `cube` nodes, that of their lower node: faces, walls, and the volume that these walls
    enclose in cubes of the spacing, by the divergence of x - c, their mean place c.
    """
    faces: dict[tuple[int, int, int], int] = {}
    walls: dict[tuple[int, int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        for lower in np.argwhere(np.ones(near.shape, bool)):
            upper = lower + step
            if upper[axis] == near.shape[axis] or inside[tuple(lower)] == inside[tuple(upper)]:
                continue
            z, y, x = (int(place) // cube for place in lower)
            faces[z, y, x] = faces.get((z, y, x), 0) + 1
            if not (near[tuple(lower)] and near[tuple(upper)] and negative[tuple(lower)] != negative[tuple(upper)]):
                towards = -step if inside[tuple(lower)] else step
                walls.setdefault((z, y, x), []).append((lower + 0.5 * step, towards.astype(float)))
    result = {}
    for key, count in faces.items():
        seen = walls.get(key, [])
        middle = np.mean([at for at, _ in seen], axis=0) if seen else np.zeros(3)
        result[key] = (count, len(seen), sum(float((at - middle) @ normal) for at, normal in seen) / 3.0)
    return result


@pytest.mark.parametrize("shape", [(1, 1, 1), (4, 5, 31), (3, 4, 32), (33, 4, 33), (5, 34, 40), (32, 3, 8)])
def test_walls_at_random_equal_their_twin(shape):
    rng = np.random.default_rng(sum(shape))
    near, negative, inside = (rng.random(shape) < share for share in (0.8, 0.5, 0.4))
    found = find_walls_of(near, negative, inside)
    expected = find_walls_slowly(near, negative, inside, cube=32)
    assert found.faces.sum() == sum(faces for faces, _, _ in expected.values())
    for place, (faces, walls, enclosed) in expected.items():
        assert (found.faces[place], found.walls[place]) == (faces, walls)
        assert found.enclosed[place] == pytest.approx(enclosed, abs=1e-9)  # float64


BODY = np.ones((20, 20, 20), bool)
NO_NODE = ~BODY


@pytest.fixture
def walls_of_a_void():
    """Of a box of 6 x 8 x 10 nodes without points within a body of 20 nodes, which lies in one cube of 32."""
    inside = BODY.copy()
    inside[4:10, 5:13, 6:16] = False
    return find_walls_of(near=inside, negative=NO_NODE, inside=inside)


def test_the_walls_of_a_void_without_support_enclose_its_volume(walls_of_a_void):
    assert walls_of_a_void.lost == pytest.approx(6 * 8 * 10)


def test_all_faces_of_a_void_without_support_are_walls(walls_of_a_void):
    assert walls_of_a_void.faces.sum() == walls_of_a_void.walls.sum() == 2 * (6 * 8 + 8 * 10 + 6 * 10)
    assert walls_of_a_void.share == 1.0


def test_the_only_cube_with_walls_is_the_worst(walls_of_a_void):
    assert walls_of_a_void.worst(3) == [(0, 0, 0)]


HALF = np.repeat(np.arange(20) >= 10, 20 * 20).reshape(20, 20, 20)
"""The upper half of a body of 20 nodes: one flat face of 400."""


def test_a_flat_wall_encloses_nothing():
    walls = find_walls_of(near=HALF, negative=NO_NODE, inside=HALF)
    assert walls.lost == pytest.approx(0.0)


def test_a_face_with_support_is_no_wall():
    """All nodes are near points, and those of the upper half on their negative side."""
    supported = find_walls_of(near=BODY, negative=HALF, inside=HALF)
    assert supported.faces.sum() == 20 * 20
    assert supported.walls.sum() == 0
    assert supported.worst(3) == []


SPACING_MM = 0.65


def balls(*, holes):
    """Twelve balls of 7 mm, 20 mm apart, the first around the origin; so many have a hole of 2.6 mm at the top."""
    points, normals = [], []
    for number in range(12):
        cloud = sphere_cloud(2600, radius=7.0, seed=number)
        if number < holes:
            cloud = cloud.select(np.flatnonzero(np.linalg.norm(cloud.points - (0, 0, 7.0), axis=1) > 2.6))
        points.append(cloud.points + np.float32([20.0 * (number % 4), 20.0 * (number // 4), 0.0]))
        normals.append(cloud.normals)
    return PointCloud(np.concatenate(points), np.concatenate(normals))


@pytest.fixture(scope="module")
def whole_balls(device):
    """The surface of twelve balls."""
    return reconstruct_surface(balls(holes=0), SPACING_MM, device=device)


@pytest.fixture(scope="module")
def one_open_ball(device):
    """The surface of twelve balls, of which the one around the origin has a hole."""
    return reconstruct_surface(balls(holes=1), SPACING_MM, device=device)


def test_balls_without_holes_have_no_lost_volume_and_no_warning(whole_balls):
    report = whole_balls.report
    assert (report["warnings"], report["open_cubes"], report["lost_share"]) == ([], [], 0.0)
    assert report["wall_share"] < 0.002  # measured 0.0008


def test_one_open_ball_of_twelve_is_warned_of_with_its_place(one_open_ball):
    report = one_open_ball.report
    assert report["votes_against_share"] < 0.05  # eleven sound balls outvote the open one
    (warning,) = report["warnings"]
    half_a_cube_mm = 16 * SPACING_MM  # of 32 nodes
    assert f"are walls that no points support, most of it within {half_a_cube_mm:.1f} mm of" in warning
    worst, *_ = report["open_cubes"]
    assert np.linalg.norm(worst["centre_mm"]) < 20.0  # the open ball is the one around the origin
    assert worst["wall_share"] > 1.0 / 3.0  # the share a cube is listed from; measured 0.47


def test_the_volume_that_an_open_ball_loses_is_reported_within_half_of_it(whole_balls, one_open_ball):
    lost = 1.0 - one_open_ball.quality().volume_ml / whole_balls.quality().volume_ml
    assert lost > 0.02  # warned of from 0.003 on; measured 0.072
    assert one_open_ball.report["lost_share"] == pytest.approx(lost, rel=0.5)  # measured 0.16 below


@pytest.mark.parametrize(
    ("cloud", "spacing"),
    [(sphere_cloud(12_000, radius=20.0), 0.65), (cube_cloud(13_000, edge=30.0), 0.64)],
    ids=["ball", "cube"],
)
def test_holes_of_one_millimetre_are_bridged_without_a_warning(device, cloud, spacing):
    """Eight of them; a bridge is as long as two spacings, 1.3 mm."""
    rng = np.random.default_rng(5)
    keep = np.ones(len(cloud), bool)
    for centre in cloud.points[rng.integers(0, len(cloud), 8)]:
        keep &= np.linalg.norm(cloud.points - centre, axis=1) > 1.0

    report = reconstruct_surface(cloud.select(np.flatnonzero(keep)), spacing, device=device).report

    assert report["wall_share"] < 0.03  # measured 0.002 for the ball, 0.016 for the cube
    assert report["lost_share"] == 0.0
    assert report["warnings"] == []


def plate_in_lines():
    """A plate of 3 x 24 x 34 mm whose faces are sampled in lines 4.25 mm apart, as with slices far apart."""
    thickness, gap, n = 3.0, 4.25, 6000
    rng = np.random.default_rng(1)
    side, rim = (np.where(np.arange(count) % 2, 1.0, -1.0) for count in (n, 1000))
    zero, through = np.zeros(1000), thickness * rng.uniform(-0.5, 0.5, 1000)
    lines, along = gap * rng.integers(-4, 5, n), rng.uniform(-12.0, 12.0, n)
    faces = np.stack([side * thickness / 2.0, along, lines], axis=1)
    rims = np.stack([through, 12.0 * rim, gap * rng.integers(-4, 5, 1000)], axis=1)
    ends = np.stack([through, rng.uniform(-12.0, 12.0, 1000), 4.0 * gap * rim], axis=1)
    normals = [np.stack([side, 0.0 * side, 0.0 * side], axis=1), np.stack([zero, rim, zero], axis=1)]
    normals.append(np.stack([zero, zero, rim], axis=1))
    return PointCloud(np.concatenate([faces, rims, ends]), np.concatenate(normals))


PLATE_ML = 24 * 34 * 3 / 1000


def test_lost_volume_is_warned_of_where_lines_lie_farther_apart_than_nodes_bridge(device):
    """The outside reaches in between lines 4.25 mm apart, where no vote is against it."""
    mesh = reconstruct_surface(plate_in_lines(), spacing=1.2, bridge=2.5, device=device)
    assert mesh.quality().volume_ml < 0.5 * PLATE_ML  # measured 0.34 of it
    assert mesh.report["votes_against_share"] < 0.001  # measured none
    assert mesh.report["wall_share"] > 0.4  # measured 0.48
    assert mesh.report["lost_share"] > 0.2  # measured 0.38
    assert "of the volume are lost" in mesh.report["warnings"][0]


def test_plate_of_lines_that_nodes_bridge_keeps_its_volume_without_a_warning_of_walls(device):
    """Lines 4.25 mm apart are within 2.5 mm of every node between them."""
    mesh = reconstruct_surface(plate_in_lines(), spacing=2.5, bridge=2.5, device=device)
    assert mesh.quality().volume_ml == pytest.approx(PLATE_ML, rel=0.12)  # nodes 2.5 mm apart in a plate of 3 mm
    assert mesh.report["wall_share"] < 0.05  # measured 0.022
    assert not any("walls" in text for text in mesh.report["warnings"])
