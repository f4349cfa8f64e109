"""Meshes cut by planes, met by rays, searched for near points; the step of voxels that goes with them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import tolerances
from refusals import refused

from clrecon import Mesh, decimate_mesh
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh.refine.decimation import BOUND_VOXEL

CORNERS = np.array([(x, y, z) for z in (0, 4) for y in (0, 2) for x in (0, 1)], np.float64)
SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
"""z = 0, z = 4, y = 0, y = 2, x = 0, x = 1; side n has the triangles 2 n and 2 n + 1."""
TRIANGLES = np.array([half for a, b, c, d in SIDES for half in ((a, b, c), (a, c, d))])
VOXEL_STEPS_MM = (0.5, 0.7, 2.0)
AFAR = np.array([5e6, -3e6, 1e6])
UP, DOWN = (0, 0, 1), (0, 0, -1)


def box_1x2x4(move: np.ndarray | float = 0.0) -> Mesh:
    """A box of 1 x 2 x 4 mm with its lowest corner at `move`, and the height of each vertex over it as a value."""
    mesh = Mesh(CORNERS + move, TRIANGLES, report={"affine_ijk_to_lps_mm": np.diag([*VOXEL_STEPS_MM, 1.0]).tolist()})
    mesh.values["height"] = CORNERS[:, 2].astype(np.float32)
    return mesh


near_and_afar = pytest.mark.parametrize("move", [0.0, AFAR], ids=["near", "afar"])


@near_and_afar
def test_a_clipped_solid_is_closed_and_has_area_and_volume_of_its_part(move: np.ndarray | float) -> None:
    upper = box_1x2x4(move).clip(np.array([0.3, 9.0, 1.0]) + move, UP)  # 3 of its 4 mm of height
    quality = upper.quality()
    assert quality.closed
    assert quality.manifold
    assert quality.oriented
    assert upper.volume == pytest.approx(1 * 2 * 3)
    assert upper.area == pytest.approx(2 * (1 * 2 + 2 * 3 + 3 * 1))


@near_and_afar
def test_numbers_at_vertices_are_interpolated_where_a_plane_cuts(move: np.ndarray | float) -> None:
    upper = box_1x2x4(move).clip(np.array([0.0, 0.0, 1.0]) + move, UP)
    heights = (upper.vertices - move)[:, 2]
    assert heights.min() == 1.0
    np.testing.assert_allclose(upper.values["height"], heights, atol=tolerances.FLOAT32_SHARE)


def test_a_clipped_mesh_keeps_its_report() -> None:
    assert box_1x2x4().clip((0, 0, 1), UP).report == box_1x2x4().report


tiny_to_huge = pytest.mark.parametrize("length", [1e-320, 1e-200, 1e200])


@tiny_to_huge
def test_a_clip_does_not_depend_on_the_length_of_the_normal(length: float) -> None:
    assert box_1x2x4().clip((0, 0, 1), (0, 0, length)).volume == pytest.approx(1 * 2 * 3)


@tiny_to_huge
def test_the_first_hit_does_not_depend_on_the_length_of_the_direction(length: float) -> None:
    np.testing.assert_allclose(box_1x2x4().ray((0.4, 0.7, 1), (0, 0, length)), [[0.4, 0.7, 4.0]])


def test_an_open_cut_has_all_faces_of_its_part_but_the_cap() -> None:
    lower = box_1x2x4().clip((0, 0, 1), DOWN, capped=False)
    assert lower.area == pytest.approx(1 * 2 + 2 * (1 + 2) * 1)  # the bottom, and four sides 1 mm high
    assert lower.quality().boundary_edges == 8  # the diagonal of each of four sides is cut too


def test_capping_a_cut_of_an_open_mesh_is_refused() -> None:
    opened = box_1x2x4().clip((0, 0, 1), DOWN, capped=False)
    with refused(UsageError, "capped=False", "mesh"):
        opened.clip((0, 1, 0), (0, 1, 0))


def test_an_open_mesh_is_cut_without_a_cap() -> None:
    opened = box_1x2x4().clip((0, 0, 1), DOWN, capped=False)
    half = opened.clip((0, 1, 0), (0, 1, 0), capped=False)
    assert half.area == pytest.approx((1 * 2 + 2 * (1 + 2) * 1) / 2)


def box_with_numbered_sides() -> Mesh:
    """The box afar; each triangle has the number of its side, from 0 to 5."""
    mesh = box_1x2x4(AFAR)
    mesh.face_values["side"] = np.repeat(np.arange(6.0), 2)
    return mesh


@pytest.mark.parametrize("capped", [True, False])
def test_faces_of_a_cut_mesh_keep_their_numbers_and_the_cap_has_none(capped: bool) -> None:
    upper = box_with_numbered_sides().clip(AFAR + (0.3, 0.2, 1.0), (0, 0.1, 1), capped=capped)
    corners = (upper.vertices - AFAR)[upper.triangles]
    number_of_face = upper.face_values["side"]

    axis_and_place_of_sides = {1: (2, 4), 2: (1, 0), 3: (1, 2), 4: (0, 0), 5: (0, 1)}  # 0, the bottom, is cut off
    for side, (axis, place) in axis_and_place_of_sides.items():
        lies_in_side = np.isclose(corners[:, :, axis], place).all(axis=1)
        np.testing.assert_array_equal(number_of_face == side, lies_in_side)
    assert 0 not in number_of_face
    assert np.isnan(number_of_face).any() == capped


def test_a_plane_that_cuts_nothing_off_leaves_every_face_its_number() -> None:
    whole = box_with_numbered_sides().clip(AFAR + (0, 0, -3), UP)
    assert sorted(whole.face_values["side"]) == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]


def test_a_plane_below_a_mesh_leaves_it_whole() -> None:
    assert box_1x2x4().clip((0, 0, -3), UP).volume == pytest.approx(1 * 2 * 4)


def test_a_plane_above_a_mesh_that_leaves_nothing_is_refused_with_its_distance() -> None:
    with refused(NoSurfaceError, 7 - 4, "mesh"):
        box_1x2x4().clip((0, 0, 7), UP)


def test_a_section_beside_a_mesh_has_no_line() -> None:
    assert box_1x2x4().section((0, 0, 7), UP) == []


def test_a_section_of_a_solid_is_its_closed_outline_in_the_plane() -> None:
    (outline,) = box_1x2x4(AFAR).section(AFAR + (0, 0, 1.5), UP)
    x, y, z = (outline - AFAR).T
    area = abs(x[:-1] @ y[1:] - x[1:] @ y[:-1]) / 2.0  # of a polygon, from its corners
    length = np.hypot(np.diff(x), np.diff(y)).sum()
    assert np.array_equal(outline[0], outline[-1])
    assert np.allclose(z, 1.5)
    assert (area, length) == pytest.approx((1 * 2, 2 * (1 + 2)))


def test_a_section_of_an_open_mesh_ends_at_its_borders() -> None:
    half = box_1x2x4().clip((0.5, 0, 0), (1, 0, 0), capped=False)  # open at x = 0.5
    (line,) = half.section((0, 0, 1), UP)
    assert sorted(line[[0, -1]].tolist()) == [[0.5, 0.0, 1.0], [0.5, 2.0, 1.0]]


def test_nearest_points_are_found_with_their_distance_and_triangle() -> None:
    over_the_top, inside = (0.5, 1.0, 9.0), (0.9, 1.0, 2.0)
    nearest, distances, rows = box_1x2x4(AFAR).closest_points([AFAR + over_the_top, AFAR + inside])
    np.testing.assert_allclose(nearest - AFAR, [[0.5, 1.0, 4.0], [1.0, 1.0, 2.0]], atol=tolerances.FLOAT64_PLACE_MM)
    np.testing.assert_allclose(distances, [5.0, 0.1], atol=tolerances.FLOAT64_PLACE_MM)
    assert (rows // 2).tolist() == [1, 5]  # the sides z = 4 and x = 1


def test_a_ray_from_inside_hits_the_surface_ahead() -> None:
    hits = box_1x2x4(AFAR).ray([AFAR + (0.4, 0.7, 1.0)], (0, 0, 5))
    np.testing.assert_allclose(hits - AFAR, [[0.4, 0.7, 4.0]], atol=tolerances.FLOAT64_PLACE_MM)


def test_a_ray_from_afar_hits_the_first_surface() -> None:
    hits = box_1x2x4().ray((0.4, 0.7, -1e4), (0, 0, 1e-3))
    np.testing.assert_allclose(hits, [[0.4, 0.7, 0.0]], atol=tolerances.FLOAT64_PLACE_MM)


def test_rays_behind_and_beside_a_mesh_hit_nothing() -> None:
    hits = box_1x2x4(AFAR).ray([AFAR + (0.4, 0.7, 99.0), AFAR + (3, 3, 3)], UP)
    assert np.isnan(hits).all()


def test_a_box_has_no_self_intersections() -> None:
    assert len(box_1x2x4().self_intersections()) == 0


def test_triangles_that_cut_each_other_are_found() -> None:
    flat, upright = [(0, 0, 0), (2, 0, 0), (0, 2, 0)], [(0.5, 0.5, -1), (0.5, 0.5, 1), (9, 9, 0)]
    assert Mesh(flat + upright, [(0, 1, 2), (3, 4, 5)]).self_intersections().tolist() == [[0, 1]]


WRONG = {
    "normal of length 0": (lambda mesh: mesh.clip((0, 0, 1), (0, 0, 0)), "the normal of a plane has length 0"),
    "point of NaN": (lambda mesh: mesh.section((0, 0, np.nan), (0, 0, 1)), "point must be three finite numbers"),
    "two points for one plane": (
        lambda mesh: mesh.clip([(0, 0, 1)] * 2, (0, 0, 1)),
        r"point must be three .*shape \(2, 3\)",
    ),
    "text for a start": (lambda mesh: mesh.ray("here", (0, 0, 1)), "start must be numbers, not 'here'"),
    "two starts and three directions": (
        lambda mesh: mesh.ray([(0, 0, 1)] * 2, [(0, 0, 1)] * 3),
        "2 starts and 3 directions",
    ),
    "no points": (lambda mesh: mesh.closest_points([]), "points must be three finite numbers each"),
    "empty mesh": (lambda _: Mesh([], []).closest_points((0, 0, 0)), "the mesh has no triangle"),
    "nothing to cut": (lambda _: Mesh([], []).section((0, 0, 0), (0, 0, 1)), "the mesh has no triangle"),
}


@pytest.mark.parametrize("name", WRONG)
def test_planes_points_and_meshes_that_cannot_be_used_are_refused(name: str) -> None:
    call, words = WRONG[name]
    with pytest.raises(UsageError, match=words):
        call(box_1x2x4())  # type: ignore[no-untyped-call]


def test_voxel_length_of_a_mesh_is_the_shortest_step_of_its_affine() -> None:
    assert box_1x2x4().voxel_mm == min(VOXEL_STEPS_MM)


def test_a_mesh_without_an_affine_has_no_voxel_length() -> None:
    assert Mesh(CORNERS, TRIANGLES).voxel_mm is None


def test_a_turned_mesh_keeps_its_voxel_length_but_not_its_affine() -> None:
    quarter_turn = [[0, -1, 0, 7], [1, 0, 0, 0], [0, 0, 3, 0], [0, 0, 0, 1]]  # steps of x and y keep their length
    turned = box_1x2x4().transformed(quarter_turn)
    assert turned.voxel_mm == pytest.approx(min(VOXEL_STEPS_MM))
    assert "affine_ijk_to_lps_mm" not in turned.report


def test_an_enlarged_mesh_has_an_enlarged_voxel_length() -> None:
    once = box_1x2x4().transformed(np.eye(4))
    assert once.transformed(np.diag([2, 2, 2, 1])).voxel_mm == pytest.approx(2 * min(VOXEL_STEPS_MM))


@pytest.mark.parametrize(
    "convert",
    [
        lambda mesh: Mesh.from_pyvista(mesh.to_pyvista()),
        lambda mesh: Mesh.from_trimesh(mesh.to_trimesh()),
        lambda mesh: mesh.clip((0, 0, 1), UP),
    ],
    ids=["pyvista", "trimesh", "clip"],
)
def test_the_voxel_length_stays_with_a_mesh_that_is_converted_or_cut_and_bounds_its_decimation(
    convert: Callable[[Mesh], Mesh],
) -> None:
    converted = convert(box_1x2x4())
    assert converted.voxel_mm == min(VOXEL_STEPS_MM)
    facts = decimate_mesh(converted, fraction=0.1).report["refinement"]["decimate"]
    assert facts["max_deviation_mm"] == BOUND_VOXEL * min(VOXEL_STEPS_MM)
