"""Quality figures on meshes whose figures are known, each defect by itself."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from refusals import refused

from clrecon.errors import UsageError
from clrecon.mesh import Mesh, measure_quality
from clrecon.mesh.connectivity import (
    _index_type,
    count_duplicate_faces,
    find_duplicate_faces,
    find_edges,
    find_split_vertices,
    opposite_half_edges,
    order_by_number,
)

pytestmark = pytest.mark.unit

FAR = np.array([-1250.5, 3071.25, -846.25])


def measure(arrays) -> dict:
    return Mesh(*arrays).quality()


def figures(quality: dict, *names: str) -> tuple:
    return tuple(quality[name] for name in names)


def test_a_box_far_from_the_origin_has_its_area_and_volume():
    quality = measure(samples.box(FAR, (2.0, 3.0, 5.5)))
    assert quality == {
        "vertices": 8,
        "triangles": 12,
        "closed": True,
        "manifold": True,
        "oriented": True,
        "boundary_edges": 0,
        "nonmanifold_edges": 0,
        "nonmanifold_vertices": 0,
        "components": 1,
        "euler_number": 2,
        "genus": 0,
        "coincident_vertices": 0,
        "open_edges_by_place": 0,
        "zero_area_faces": 0,
        "duplicate_faces": 0,
        "unused_vertices": 0,
        "shortest_edge_mm": 2.0,
        "area_mm2": pytest.approx(67.0, rel=tolerances.MESH_VOLUME),
        "volume_ml": pytest.approx(0.033, rel=tolerances.MESH_VOLUME),
        "outward": True,
        "bounds_mm": [FAR.tolist(), (FAR + (2.0, 3.0, 5.5)).tolist()],
        "self_intersections": None,
    }


def test_torus_has_one_handle():
    quality = measure(samples.torus())
    assert figures(quality, "closed", "manifold", "euler_number", "genus", "components") == (True, True, 0, 1, 1)
    assert {type(quality[name]) for name in ("euler_number", "genus", "components")} == {int}  # as in JSON: 1, not 1.0
    assert quality["volume_ml"] == pytest.approx(samples.torus_volume_ml(), rel=tolerances.MESH_VOLUME)
    # The triangles lie inside the torus (major 20, minor 6), less than a fifth of it is lost.
    exact = 2 * np.pi**2 * 20.0 * 6.0**2 / 1000.0
    assert 0.8 * exact < quality["volume_ml"] < exact


def test_quality_counts_two_spheres_and_a_cavity_with_its_volume():
    vertices, triangles = samples.join(
        samples.sphere((-30, 5, 2), 10), samples.sphere((40, 0, 0), 7), samples.sphere((-30, 5, 2), 4)
    )
    triangles[-128:] = triangles[-128:, ::-1]  # the wall of the cavity looks inward
    quality = measure((vertices, triangles))
    assert figures(quality, "closed", "manifold", "components", "euler_number", "genus") == (True, True, 3, 6, 0)
    one = measure(samples.sphere(radius=1))["volume_ml"]
    assert quality["volume_ml"] == pytest.approx(one * (10**3 + 7**3 - 4**3), rel=tolerances.MESH_VOLUME)
    assert quality["area_mm2"] == pytest.approx(measure(samples.sphere(radius=1))["area_mm2"] * (100 + 49 + 16))


def test_inside_out_mesh_has_a_negative_volume():
    vertices, triangles = samples.box(FAR)
    quality = measure((vertices, triangles[:, ::-1]))
    assert figures(quality, "closed", "manifold", "oriented", "outward") == (True, True, True, False)
    assert quality["volume_ml"] == pytest.approx(-0.001)


def test_a_hole_opens_the_mesh_and_changes_its_euler_number():
    vertices, triangles = samples.sphere()
    quality = measure((vertices, np.delete(triangles, 17, axis=0)))
    assert figures(quality, "closed", "manifold", "boundary_edges", "euler_number", "genus") == (
        False,
        True,
        3,
        1,
        None,
    )


def test_volume_of_an_open_surface_does_not_depend_on_its_place():
    vertices, triangles = samples.box((0, 0, 0), (2, 2, 2))
    opened = np.delete(triangles, 4, axis=0)
    here, there = measure((vertices, opened)), measure((vertices + (4096, -8192, 512), opened))
    assert there["volume_ml"] == here["volume_ml"] == pytest.approx(0.008 * 11 / 12)


def test_a_flipped_face_is_not_oriented_but_closed():
    vertices, triangles = samples.torus()
    triangles[40] = triangles[40, ::-1]
    quality = measure((vertices, triangles))
    assert figures(quality, "closed", "oriented", "manifold", "genus") == (True, False, False, None)
    assert figures(quality, "nonmanifold_edges", "nonmanifold_vertices", "boundary_edges") == (0, 0, 0)


def test_moebius_strip_cannot_be_oriented():
    quality = measure(samples.moebius())
    assert figures(quality, "oriented", "manifold", "closed", "euler_number") == (False, False, False, 0)
    assert figures(quality, "nonmanifold_edges", "nonmanifold_vertices", "boundary_edges") == (0, 0, 22)


def test_boxes_that_touch_in_a_corner_are_closed_and_not_manifold():
    quality = measure(samples.weld(samples.join(samples.box(), samples.box((1, 1, 1)))))
    assert figures(quality, "closed", "oriented", "nonmanifold_edges", "nonmanifold_vertices") == (True, True, 0, 1)
    assert figures(quality, "manifold", "components", "genus", "vertices") == (False, 1, None, 15)


def test_open_fans_that_touch_in_a_corner_are_not_manifold():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]
    quality = measure((vertices, [[0, 1, 2], [0, 3, 4]]))
    assert figures(quality, "nonmanifold_vertices", "manifold", "boundary_edges", "components") == (1, False, 6, 1)


def test_boxes_that_share_an_edge_are_not_manifold():
    quality = measure(samples.weld(samples.join(samples.box(), samples.box((1, 1, 0)))))
    assert figures(quality, "nonmanifold_edges", "closed", "manifold", "boundary_edges") == (1, False, False, 0)
    assert quality["genus"] is None


def test_duplicate_faces_are_counted_in_any_order():
    vertices, triangles = samples.box()
    more = np.concatenate([triangles, triangles[3:4, [1, 2, 0]], triangles[3:4, ::-1], triangles[7:8]])
    quality = measure((vertices, more))
    assert figures(quality, "duplicate_faces", "closed", "manifold", "oriented") == (3, False, False, False)


def test_faces_without_area_are_counted():
    vertices, triangles = samples.box(FAR)
    vertices = np.concatenate([vertices, vertices[:1] + [0.5, 0, 0], vertices[:1]])
    quality = measure((vertices, np.concatenate([triangles, [[0, 8, 1], [0, 9, 1], [2, 2, 3]]])))
    assert figures(quality, "zero_area_faces", "manifold", "unused_vertices") == (3, False, 0)


def test_face_with_one_vertex_twice_is_not_manifold():
    vertices, triangles = samples.box()
    quality = measure((vertices, np.concatenate([np.delete(triangles, 0, axis=0), [[4, 4, 5]]])))
    assert quality["manifold"] is False
    assert quality["zero_area_faces"] == 1


def test_unused_vertices_are_no_components():
    vertices, triangles = samples.box()
    quality = measure((np.concatenate([[[9.0, 9, 9]], vertices, [[8.0, 8, 8]]]), triangles + 1))
    assert figures(quality, "unused_vertices", "components", "euler_number", "genus") == (2, 1, 2, 0)


def test_empty_mesh_has_no_figures():
    quality = measure(([], []))
    assert figures(quality, "vertices", "triangles", "closed", "manifold", "components") == (0, 0, False, False, 0)
    assert figures(quality, "area_mm2", "volume_ml", "bounds_mm", "outward") == (0.0, 0.0, None, False)


def test_order_of_vertices_and_faces_does_not_matter():
    rng = np.random.default_rng(5)
    vertices, triangles = samples.join(samples.torus(), samples.sphere((60, 3, 1)))
    place = rng.permutation(len(vertices))
    moved = np.empty_like(vertices)
    moved[place] = vertices
    turned = np.array([np.roll(row, rng.integers(3)) for row in place[triangles]])
    one, other = measure((vertices, triangles)), measure((moved, rng.permutation(turned)))
    assert other == {name: pytest.approx(value) if type(value) is float else value for name, value in one.items()}
    assert one["genus"] == 1


def test_quality_of_a_mesh_of_several_pieces_is_right():
    quality = measure(samples.torus(250, 131))
    assert figures(quality, "triangles", "closed", "manifold", "genus") == (65500, True, True, 1)
    assert quality["volume_ml"] == pytest.approx(samples.torus_volume_ml(250, 131), rel=tolerances.MESH_VOLUME)


def test_wrong_index_is_refused():
    with refused(UsageError, 3, "vertex"):
        measure_quality(np.zeros((3, 3), np.float32), np.array([[0, 1, 3]], np.uint32))


def test_shortest_edge_is_measured():
    vertices, triangles = samples.box((0, 0, 0), (2.0, 3.0, 5.5))
    for low, high in triangles[7, [[0, 1], [1, 2], [2, 0]]]:
        near = vertices.copy()
        near[high] = near[low] + (near[high] - near[low]) / 64
        expected = min(
            np.linalg.norm(near[a] - near[b]) for a, b, _ in np.concatenate([triangles, triangles[:, [1, 2, 0]]])
        )
        assert measure((near, triangles))["shortest_edge_mm"] == pytest.approx(expected, rel=tolerances.MESH_VOLUME)
    assert measure(([], []))["shortest_edge_mm"] is None


@pytest.mark.parametrize("size", [1, 40, 100_000])
def test_order_by_number_is_a_stable_sort(size):
    numbers = np.random.default_rng(size).integers(0, size, 300)
    np.testing.assert_array_equal(order_by_number(numbers, size), np.argsort(numbers, kind="stable"))


def test_going_round_the_vertices_finds_what_joining_the_corners_finds():
    """Spheres glued in vertices at random: both ways of looking for split vertices, faces around them in any order."""
    rng = np.random.default_rng(11)
    vertices, triangles = samples.join(*[samples.sphere(rounds=1)] * 6)
    place = np.arange(len(vertices))
    for ball, (one, other) in enumerate(rng.integers(0, len(vertices) // 6, (5, 2)) + [0, len(vertices) // 6]):
        place[place == place[ball * len(vertices) // 6 + one]] = place[ball * len(vertices) // 6 + other]
    glued = rng.permutation(place[triangles]).astype(np.uint32)
    edges = find_edges(glued, len(vertices))
    opposite = opposite_half_edges(glued, edges)
    assert opposite is not None
    found = find_split_vertices(glued, len(vertices), edges, opposite)
    np.testing.assert_array_equal(found, find_split_vertices(glued, len(vertices), edges))
    assert 3 <= len(found) <= 5
    assert count_duplicate_faces(glued, len(vertices), opposite) == count_duplicate_faces(glued, len(vertices)) == 0


def test_all_faces_with_the_vertices_of_another_are_found():
    _, triangles = samples.sphere(rounds=1)
    triangles = np.concatenate([triangles, triangles[[5, 9]][:, (2, 0, 1)], triangles[[9]][:, (1, 0, 2)]]).astype(
        np.uint32
    )
    last = len(triangles) - 3
    assert find_duplicate_faces(triangles, int(triangles.max()) + 1).tolist() == [5, 9, last, last + 1, last + 2]
    assert count_duplicate_faces(triangles, int(triangles.max()) + 1) == 3
    assert len(find_duplicate_faces(triangles[:-3], int(triangles.max()) + 1)) == 0


def test_vertex_with_many_faces_is_manifold():
    top = np.column_stack([np.cos(np.arange(200) * np.pi / 100), np.sin(np.arange(200) * np.pi / 100), np.zeros(200)])
    ring, after = np.arange(200) + 2, (np.arange(200) + 1) % 200 + 2
    cone = [[0, a, b] for a, b in zip(ring, after, strict=True)] + [[1, b, a] for a, b in zip(ring, after, strict=True)]
    quality = measure((np.concatenate([[[0, 0, 1], [0, 0, -1]], top]), cone))
    assert figures(quality, "closed", "manifold", "genus", "outward") == (True, True, 0, True)


def test_two_triangles_back_to_back_are_duplicates_and_closed():
    quality = measure(([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [2, 1, 0]]))
    assert figures(quality, "duplicate_faces", "closed", "oriented", "volume_ml") == (1, True, True, 0.0)


def test_edges_between_the_highest_vertex_numbers_are_counted():
    last = 2**32 - 2
    edges = find_edges(np.array([[0, last - 1, last], [last, last - 1, 1]], np.uint32), last + 1)
    assert (edges.count, edges.boundary, edges.nonmanifold, edges.oriented) == (5, 4, 0, True)


def test_vertices_at_one_place_are_joined_before_a_surface_is_called_closed():
    """Two boxes that touch along an edge, each closed: STL makes one of them, with an edge in four faces."""
    apart = samples.join(samples.box(), samples.box((2, 2, 0)))
    edge = samples.join(samples.box(), samples.box((1, 1, 0)))
    corner = samples.join(samples.box(), samples.box((1, 1, 1)))
    for mesh, coincident, open_edges in ((apart, 0, 0), (edge, 4, 1), (corner, 2, 0)):
        quality = Mesh(*mesh).quality()
        assert (quality["boundary_edges"], quality["nonmanifold_edges"]) == (0, 0)
        assert (quality["coincident_vertices"], quality["open_edges_by_place"]) == (coincident, open_edges)
        assert quality["closed"] == (open_edges == 0)


def test_vertices_that_nothing_uses_do_not_count_by_place():
    vertices, triangles = samples.box()
    quality = Mesh(np.concatenate([vertices, vertices]), triangles).quality()
    assert (quality["coincident_vertices"], quality["open_edges_by_place"], quality["closed"]) == (0, 0, True)


def test_numbers_of_half_edges_take_the_smallest_type_that_holds_them():
    assert (_index_type(2**31 - 1), _index_type(2**31), _index_type(2**31 + 1)) == (np.int32, np.int64, np.int64)
