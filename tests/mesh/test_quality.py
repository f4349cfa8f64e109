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


def test_quality_of_a_box_far_from_the_origin_has_every_figure_of_a_sound_mesh():
    quality = measure(samples.box(low=FAR, size=(2.0, 3.0, 5.5)))
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
        "area_mm2": pytest.approx(2 * (2.0 * 3.0 + 3.0 * 5.5 + 5.5 * 2.0), rel=tolerances.MESH_VOLUME),
        "volume_ml": pytest.approx(2.0 * 3.0 * 5.5 / 1000.0, rel=tolerances.MESH_VOLUME),
        "outward": True,
        "bounds_mm": [FAR.tolist(), (FAR + (2.0, 3.0, 5.5)).tolist()],
        "self_intersections": None,
    }


def test_torus_has_one_handle():
    quality = measure(samples.torus())
    assert figures(quality, "closed", "manifold", "euler_number", "genus", "components") == (True, True, 0, 1, 1)


def test_counts_are_whole_numbers_as_in_json():
    quality = measure(samples.torus())
    assert {type(quality[name]) for name in ("euler_number", "genus", "components")} == {int}  # 1, not 1.0


def test_volume_of_a_torus_is_the_sum_of_its_tetrahedra():
    radii_mm = {"major": 20.0, "minor": 6.0}
    volume_ml = measure(samples.torus(**radii_mm))["volume_ml"]
    assert volume_ml == pytest.approx(samples.torus_volume_ml(**radii_mm), rel=tolerances.MESH_VOLUME)
    # The triangles lie inside of the round torus: measured 0.87 of its volume.
    round_ml = 2 * np.pi**2 * radii_mm["major"] * radii_mm["minor"] ** 2 / 1000.0
    assert 0.8 * round_ml < volume_ml < round_ml


@pytest.fixture
def two_spheres_and_a_cavity():
    """Quality of spheres of 10 and 7 mm, with a cavity of 4 mm in the first."""
    large = samples.sphere((-30, 5, 2), radius=10)
    small = samples.sphere((40, 0, 0), radius=7)
    vertices, triangles = samples.sphere((-30, 5, 2), radius=4)
    cavity = (vertices, triangles[:, ::-1])
    return measure(samples.join(large, small, cavity))


def test_two_spheres_and_a_cavity_are_three_closed_components_without_a_handle(two_spheres_and_a_cavity):
    names = ("closed", "manifold", "components", "euler_number", "genus")
    assert figures(two_spheres_and_a_cavity, *names) == (True, True, 3, 3 * 2, 0)


def test_volume_of_a_cavity_is_taken_off_and_its_area_is_added(two_spheres_and_a_cavity):
    unit = measure(samples.sphere(radius=1))
    volume_ml = unit["volume_ml"] * (10**3 + 7**3 - 4**3)
    area_mm2 = unit["area_mm2"] * (10**2 + 7**2 + 4**2)
    assert two_spheres_and_a_cavity["volume_ml"] == pytest.approx(volume_ml, rel=tolerances.MESH_VOLUME)
    assert two_spheres_and_a_cavity["area_mm2"] == pytest.approx(area_mm2, rel=tolerances.MESH_VOLUME)


def test_inside_out_mesh_is_sound_but_not_outward_and_has_a_negative_volume():
    vertices, triangles = samples.box(FAR)
    quality = measure((vertices, triangles[:, ::-1]))
    assert figures(quality, "closed", "manifold", "oriented", "outward") == (True, True, True, False)
    assert quality["volume_ml"] == pytest.approx(-0.001)  # a cube of 1 mm


def test_a_missing_face_leaves_three_boundary_edges_an_euler_number_of_1_and_no_genus():
    vertices, triangles = samples.sphere()
    quality = measure((vertices, np.delete(triangles, 17, axis=0)))  # 17: any face
    names = ("closed", "manifold", "boundary_edges", "euler_number", "genus")
    assert figures(quality, *names) == (False, True, 3, 1, None)


def test_volume_of_an_open_surface_does_not_depend_on_its_place():
    vertices, triangles = samples.box(size=(2, 2, 2))
    opened = np.delete(triangles, 4, axis=0)
    here = measure((vertices, opened))["volume_ml"]
    there = measure((vertices + (4096, -8192, 512), opened))["volume_ml"]
    assert there == here == pytest.approx(0.008 * 11 / 12)  # pyramids from the centre over 11 of 12 equal faces


def test_a_mesh_with_a_flipped_face_is_closed_but_neither_oriented_nor_manifold():
    vertices, triangles = samples.torus()
    triangles[40] = triangles[40, ::-1]  # 40: any face
    quality = measure((vertices, triangles))
    assert figures(quality, "closed", "oriented", "manifold", "genus") == (True, False, False, None)
    assert figures(quality, "nonmanifold_edges", "nonmanifold_vertices", "boundary_edges") == (0, 0, 0)


def test_moebius_strip_is_neither_oriented_nor_manifold_and_has_one_boundary():
    quality = measure(samples.moebius(pieces=11))
    assert figures(quality, "oriented", "manifold", "closed", "euler_number") == (False, False, False, 0)
    # Each of the 11 pieces has an edge on either side of the strip.
    assert figures(quality, "nonmanifold_edges", "nonmanifold_vertices", "boundary_edges") == (0, 0, 2 * 11)


def test_boxes_that_share_a_corner_are_closed_and_not_manifold_at_one_vertex():
    quality = measure(samples.weld(samples.join(samples.box(), samples.box(low=(1, 1, 1)))))
    assert quality["vertices"] == 2 * 8 - 1
    assert figures(quality, "closed", "oriented", "nonmanifold_edges", "nonmanifold_vertices") == (True, True, 0, 1)
    assert figures(quality, "manifold", "components", "genus") == (False, 1, None)


def test_two_triangles_that_share_one_corner_alone_are_not_manifold():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]
    quality = measure((vertices, [[0, 1, 2], [0, 3, 4]]))
    assert figures(quality, "nonmanifold_vertices", "manifold", "boundary_edges", "components") == (1, False, 6, 1)


def test_boxes_that_share_an_edge_are_not_manifold_and_not_closed():
    quality = measure(samples.weld(samples.join(samples.box(), samples.box(low=(1, 1, 0)))))
    assert figures(quality, "nonmanifold_edges", "closed", "manifold", "boundary_edges") == (1, False, False, 0)
    assert quality["genus"] is None


def test_duplicate_faces_are_counted_whatever_the_order_of_their_corners():
    vertices, triangles = samples.box()
    turned, reversed_corners, same = triangles[3:4, [1, 2, 0]], triangles[3:4, ::-1], triangles[7:8]
    quality = measure((vertices, np.concatenate([triangles, turned, reversed_corners, same])))
    assert figures(quality, "duplicate_faces", "closed", "manifold", "oriented") == (3, False, False, False)


def test_faces_whose_corners_lie_in_a_line_or_at_one_place_are_counted_as_without_area():
    vertices, triangles = samples.box(FAR)
    on_an_edge = vertices[0] + [0.5, 0, 0]  # vertex 8: half way from vertex 0 to 1
    at_a_corner = vertices[0]  # vertex 9
    flat = [[0, 8, 1], [0, 9, 1], [2, 2, 3]]
    quality = measure((np.concatenate([vertices, [on_an_edge, at_a_corner]]), np.concatenate([triangles, flat])))
    assert figures(quality, "zero_area_faces", "manifold", "unused_vertices") == (3, False, 0)


def test_face_with_one_vertex_twice_has_no_area_and_is_not_manifold():
    vertices, triangles = samples.box()
    quality = measure((vertices, np.concatenate([np.delete(triangles, 0, axis=0), [[4, 4, 5]]])))
    assert quality["manifold"] is False
    assert quality["zero_area_faces"] == 1


def test_unused_vertices_are_counted_and_are_no_components():
    vertices, triangles = samples.box()
    with_two_more = np.concatenate([[[9.0, 9, 9]], vertices, [[8.0, 8, 8]]])
    quality = measure((with_two_more, triangles + 1))
    assert figures(quality, "unused_vertices", "components", "euler_number", "genus") == (2, 1, 2, 0)


def test_quality_of_an_empty_mesh_is_zeros_open_and_without_bounds():
    quality = measure(([], []))
    assert figures(quality, "vertices", "triangles", "closed", "manifold", "components") == (0, 0, False, False, 0)
    assert figures(quality, "area_mm2", "volume_ml", "bounds_mm", "outward") == (0.0, 0.0, None, False)


def test_quality_does_not_depend_on_the_order_of_vertices_faces_and_corners():
    rng = np.random.default_rng(5)
    vertices, triangles = samples.join(samples.torus(), samples.sphere((60, 3, 1)))
    new_number = rng.permutation(len(vertices))
    moved = np.empty_like(vertices)
    moved[new_number] = vertices
    turned = np.array([np.roll(row, rng.integers(3)) for row in new_number[triangles]])

    one, other = measure((vertices, triangles)), measure((moved, rng.permutation(turned)))

    assert other == {name: pytest.approx(value) if type(value) is float else value for name, value in one.items()}


def test_quality_of_a_mesh_that_is_measured_in_pieces_is_that_of_the_whole():
    rings, sides = 250, 131  # 65,500 triangles; a piece holds 16,384
    quality = measure(samples.torus(rings=rings, sides=sides))
    assert figures(quality, "triangles", "closed", "manifold", "genus") == (2 * rings * sides, True, True, 1)
    expected_ml = samples.torus_volume_ml(rings=rings, sides=sides)
    assert quality["volume_ml"] == pytest.approx(expected_ml, rel=tolerances.MESH_VOLUME)


def test_a_triangle_that_names_a_missing_vertex_is_refused():
    with refused(UsageError, 3, "vertex"):
        measure_quality(np.zeros((3, 3), np.float32), np.array([[0, 1, 3]], np.uint32))


@pytest.mark.parametrize("edge", [[0, 1], [1, 2], [2, 0]], ids=["first", "second", "third"])
def test_shortest_edge_is_measured_wherever_it_stands_in_its_triangle(edge):
    """One edge of a triangle of the box shrinks to 1/64: it is the shortest, 2 to 6.3 mm before."""
    vertices, triangles = samples.box(size=(2.0, 3.0, 5.5))
    low, high = triangles[7, edge]
    towards = (vertices[high] - vertices[low]) / 64
    vertices[high] = vertices[low] + towards
    expected = np.linalg.norm(towards)
    assert measure((vertices, triangles))["shortest_edge_mm"] == pytest.approx(expected, rel=tolerances.MESH_VOLUME)


def test_an_empty_mesh_has_no_shortest_edge():
    assert measure(([], []))["shortest_edge_mm"] is None


@pytest.mark.parametrize(
    "limit", [1, 40, 100_000, 1_000_000], ids=["all equal", "many equal", "of 17 bits", "few equal"]
)
def test_order_by_number_is_a_stable_sort(limit):
    numbers = np.random.default_rng(limit).integers(0, limit, 20_000)
    np.testing.assert_array_equal(order_by_number(numbers), np.argsort(numbers, kind="stable"))


@pytest.fixture
def glued_spheres():
    """Triangles and vertex count of six spheres; each after the first shares a random vertex with the first."""
    rng = np.random.default_rng(11)
    spheres = 6
    vertices, triangles = samples.join(*[samples.sphere(rounds=1)] * spheres)
    of_a_sphere = len(vertices) // spheres
    number = np.arange(len(vertices))
    for start in of_a_sphere * np.arange(1, spheres):
        number[start + rng.integers(of_a_sphere)] = rng.integers(of_a_sphere)
    return rng.permutation(number[triangles]).astype(np.uint32), len(vertices)


def test_split_vertices_are_the_same_by_neighbouring_half_edges_and_by_joined_corners(glued_spheres):
    triangles, count = glued_spheres
    edges = find_edges(triangles, count)
    opposite = opposite_half_edges(triangles, edges)
    by_half_edges = find_split_vertices(triangles, count, edges, opposite)
    by_corners = find_split_vertices(triangles, count, edges)
    assert 3 <= len(by_corners) <= 5  # one of 18 vertices was drawn for each of five spheres, some perhaps twice
    np.testing.assert_array_equal(by_half_edges, by_corners)


def test_spheres_that_share_vertices_have_no_duplicate_faces(glued_spheres):
    triangles, count = glued_spheres
    opposite = opposite_half_edges(triangles, find_edges(triangles, count))
    assert count_duplicate_faces(triangles, count) == 0
    assert count_duplicate_faces(triangles, count, opposite) == 0


@pytest.fixture
def sphere_with_three_copied_faces():
    """Triangles and vertex count of a sphere of 32 faces; the last three are a copy of face 5 and two of face 9."""
    vertices, triangles = samples.sphere(rounds=1)
    copies = [triangles[[5]][:, (2, 0, 1)], triangles[[9]][:, (2, 0, 1)], triangles[[9]][:, (1, 0, 2)]]
    return np.concatenate([triangles, *copies]).astype(np.uint32), len(vertices)


def test_duplicate_faces_are_found_with_the_faces_that_they_repeat(sphere_with_three_copied_faces):
    assert find_duplicate_faces(*sphere_with_three_copied_faces).tolist() == [5, 9, 32, 33, 34]


def test_each_face_that_repeats_another_counts_once(sphere_with_three_copied_faces):
    assert count_duplicate_faces(*sphere_with_three_copied_faces) == 3


def test_a_sphere_has_no_duplicate_faces():
    vertices, triangles = samples.sphere(rounds=1)
    assert len(find_duplicate_faces(triangles.astype(np.uint32), len(vertices))) == 0


def test_a_double_cone_with_200_faces_at_each_tip_is_manifold():
    rim = 200
    angle = 2 * np.pi * np.arange(rim) / rim
    vertices = np.concatenate([[[0, 0, 1], [0, 0, -1]], np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])])
    upper, lower = 0, 1
    here = np.arange(rim) + 2
    there = np.roll(here, -1)
    triangles = [[upper, a, b] for a, b in zip(here, there, strict=True)]
    triangles += [[lower, b, a] for a, b in zip(here, there, strict=True)]
    quality = measure((vertices, triangles))
    assert figures(quality, "closed", "manifold", "genus", "outward") == (True, True, 0, True)


def test_two_triangles_back_to_back_are_closed_duplicates_without_volume():
    quality = measure(([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [2, 1, 0]]))
    assert figures(quality, "duplicate_faces", "closed", "oriented", "volume_ml") == (1, True, True, 0.0)


def test_edges_between_the_highest_vertex_numbers_are_counted():
    """Two triangles with one edge in common: 5 edges, 4 of them in one triangle only."""
    last = 2**32 - 2
    edges = find_edges(np.array([[0, last - 1, last], [last, last - 1, 1]], np.uint32), last + 1)
    assert (edges.count, edges.boundary, edges.nonmanifold, edges.oriented) == (5, 4, 0, True)


@pytest.mark.parametrize(
    ("second_at", "coincident", "open_edges"),
    [((2, 2, 0), 0, 0), ((1, 1, 0), 2 * 2, 1), ((1, 1, 1), 2 * 1, 0)],
    ids=["apart", "common edge", "common corner"],
)
def test_vertices_at_one_place_are_joined_before_a_surface_is_called_closed(second_at, coincident, open_edges):
    """Two closed cubes of 1 mm: STL would join vertices at one place, and put a common edge into four faces."""
    quality = measure(samples.join(samples.box(), samples.box(low=second_at)))
    assert figures(quality, "boundary_edges", "nonmanifold_edges") == (0, 0)
    assert figures(quality, "coincident_vertices", "open_edges_by_place") == (coincident, open_edges)
    assert quality["closed"] == (open_edges == 0)


def test_unused_vertices_are_not_coincident_with_used_ones():
    vertices, triangles = samples.box()
    quality = Mesh(np.concatenate([vertices, vertices]), triangles).quality()
    assert (quality["coincident_vertices"], quality["open_edges_by_place"], quality["closed"]) == (0, 0, True)


@pytest.mark.parametrize(("count", "kind"), [(2**31 - 1, np.int32), (2**31, np.int64), (2**31 + 1, np.int64)])
def test_numbers_of_half_edges_take_the_smallest_type_that_holds_them(count, kind):
    assert _index_type(count) == kind
