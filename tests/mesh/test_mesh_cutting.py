"""Meshes cut by planes, met by rays, searched for near points; the step of voxels that goes with them."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon import Mesh, decimate_mesh
from clrecon.errors import NoSurfaceError, UsageError

CORNERS = np.array([(x, y, z) for z in (0, 4) for y in (0, 2) for x in (0, 1)], np.float64)
SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
TRIANGLES = np.array([half for a, b, c, d in SIDES for half in ((a, b, c), (a, c, d))])
AFAR = np.array([5e6, -3e6, 1e6])


def box(move: np.ndarray | float = 0.0) -> Mesh:
    """A box of 1 x 2 x 4 mm at zero, with the height of each vertex as a value."""
    made = Mesh(CORNERS + move, TRIANGLES, report={"affine_ijk_to_lps_mm": np.diag([0.5, 0.7, 2.0, 1.0]).tolist()})
    made.values["height"] = CORNERS[:, 2].astype(np.float32)
    return made


@pytest.mark.parametrize("move", [0.0, AFAR], ids=["near", "afar"])
def test_a_clipped_solid_is_closed_and_has_the_volume_of_its_part(move: np.ndarray | float) -> None:
    mesh = box(move)
    part = mesh.clip(np.array([0.3, 9.0, 1.0]) + move, (0, 0, 7))
    quality = part.quality()
    assert quality.closed and quality.manifold and quality.oriented
    assert part.volume == pytest.approx(6.0) and part.area == pytest.approx(4.0 + 18.0)
    np.testing.assert_allclose(part.values["height"], part.vertices[:, 2] - np.broadcast_to(move, 3)[2], atol=1e-6)
    assert part.report == mesh.report and part.values["height"].min() == 1.0


@pytest.mark.parametrize("length", [1e-320, 1e-200, 1e200])
def test_the_length_of_a_normal_or_direction_is_of_no_matter(length: float) -> None:
    assert box().clip((0, 0, 1), (0, 0, length)).volume == pytest.approx(6.0)
    assert box().ray((0.4, 0.7, 1), (0, 0, length))[0, 2] == pytest.approx(4.0)


def test_an_open_cut_lacks_its_cap_alone() -> None:
    part = box().clip((0, 0, 1), (0, 0, -1), capped=False)
    assert part.area == pytest.approx(2.0 + 6.0) and part.quality().boundary_edges == 8
    with refused(UsageError, "capped=False", "mesh"):
        part.clip((0, 1, 0), (0, 1, 0))
    assert part.clip((0, 1, 0), (0, 1, 0), capped=False).area == pytest.approx(4.0)


def test_numbers_at_faces_follow_a_cut_and_a_cap_has_none() -> None:
    mesh = box(AFAR)
    mesh.face_values["side"] = np.repeat(np.arange(6.0), 2)
    for capped in (True, False):
        part = mesh.clip(AFAR + (0.3, 0.2, 1.0), (0, 0.1, 1), capped=capped)
        corners = (part.vertices - AFAR)[part.triangles]
        known = part.face_values["side"]
        for side, (axis, place) in {1: (2, 4), 2: (1, 0), 3: (1, 2), 4: (0, 0), 5: (0, 1)}.items():
            np.testing.assert_array_equal(known == side, np.isclose(corners[:, :, axis], place).all(axis=1))
        assert np.isnan(known).any() == capped and 0 not in known
    assert np.isnan(mesh.clip(AFAR + (0, 0, -3), (0, 0, 1)).face_values["side"]).sum() == 0


def test_planes_beside_a_mesh_leave_it_or_are_refused() -> None:
    assert box().clip((0, 0, -3), (0, 0, 1)).volume == pytest.approx(8.0)
    with refused(NoSurfaceError, 3, "mesh"):
        box().clip((0, 0, 7), (0, 0, 1))
    assert box().section((0, 0, 7), (0, 0, 1)) == []


def test_a_section_is_the_outline_in_the_plane() -> None:
    (outline,) = box(AFAR).section(AFAR + (0, 0, 1.5), (0, 0, 1))
    assert np.array_equal(outline[0], outline[-1]) and np.allclose(outline[:, 2], AFAR[2] + 1.5)
    x, y = (outline - AFAR)[:, :2].T
    assert abs(x[:-1] @ y[1:] - x[1:] @ y[:-1]) / 2.0 == pytest.approx(2.0)
    assert np.linalg.norm(np.diff(outline, axis=0), axis=1).sum() == pytest.approx(6.0)
    half = box().clip((0.5, 0, 0), (1, 0, 0), capped=False)
    (line,) = half.section((0, 0, 1), (0, 0, 1))
    assert sorted(line[[0, -1]].tolist()) == [[0.5, 0.0, 1.0], [0.5, 2.0, 1.0]]


def test_nearest_points_and_first_hits_lie_on_the_surface() -> None:
    mesh = box(AFAR)
    nearest, distances, rows = mesh.closest_points([AFAR + (0.5, 1.0, 9.0), AFAR + (0.9, 1.0, 2.0)])
    np.testing.assert_allclose(nearest - AFAR, [[0.5, 1.0, 4.0], [1.0, 1.0, 2.0]], atol=1e-9)
    np.testing.assert_allclose(distances, [5.0, 0.1], atol=1e-9)
    assert rows[0] in (2, 3) and rows[1] in (10, 11)
    hits = mesh.ray([AFAR + (0.4, 0.7, 1.0), AFAR + (0.4, 0.7, 99.0), AFAR + (3, 3, 3)], (0, 0, 5))
    np.testing.assert_allclose(hits[0] - AFAR, [0.4, 0.7, 4.0], atol=1e-9)
    assert np.isnan(hits[1:]).all() and box().ray((0.4, 0.7, -1e4), (0, 0, 1e-3))[0, 2] == pytest.approx(0.0, abs=1e-9)


def test_triangles_that_cut_each_other_are_found() -> None:
    assert len(box().self_intersections()) == 0
    through = Mesh([(0, 0, 0), (2, 0, 0), (0, 2, 0), (0.5, 0.5, -1), (0.5, 0.5, 1), (9, 9, 0)], [(0, 1, 2), (3, 4, 5)])
    assert through.self_intersections().tolist() == [[0, 1]]


WRONG = {
    "no normal": (lambda mesh: mesh.clip((0, 0, 1), (0, 0, 0)), "the normal of a plane has length 0"),
    "NaN": (lambda mesh: mesh.section((0, 0, np.nan), (0, 0, 1)), "point must be three finite numbers"),
    "two points": (lambda mesh: mesh.clip([(0, 0, 1)] * 2, (0, 0, 1)), r"point must be three .*shape \(2, 3\)"),
    "text": (lambda mesh: mesh.ray("here", (0, 0, 1)), "start must be numbers, not 'here'"),
    "other numbers": (lambda mesh: mesh.ray([(0, 0, 1)] * 2, [(0, 0, 1)] * 3), "2 starts and 3 directions"),
    "no points": (lambda mesh: mesh.closest_points([]), "points must be three finite numbers each"),
    "empty mesh": (lambda _: Mesh([], []).closest_points((0, 0, 0)), "the mesh has no triangle"),
    "nothing to cut": (lambda _: Mesh([], []).section((0, 0, 0), (0, 0, 1)), "the mesh has no triangle"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_plane_or_point_is_refused(name: str) -> None:
    call, words = WRONG[name]
    with pytest.raises(UsageError, match=words):
        call(box())  # type: ignore[no-untyped-call]


def test_the_step_of_the_voxels_stays_with_a_mesh() -> None:
    mesh = box()
    assert mesh.voxel_mm == 0.5 and Mesh(CORNERS, TRIANGLES).voxel_mm is None
    turned = mesh.transformed([[0, -1, 0, 7], [1, 0, 0, 0], [0, 0, 3, 0], [0, 0, 0, 1]])
    assert turned.voxel_mm == pytest.approx(0.5) and "affine_ijk_to_lps_mm" not in turned.report
    assert turned.transformed(np.diag([2, 2, 2, 1])).voxel_mm == pytest.approx(1.0)
    for back in (
        Mesh.from_pyvista(mesh.to_pyvista()),
        Mesh.from_trimesh(mesh.to_trimesh()),
        mesh.clip((0, 0, 1), (0, 0, 1)),
    ):
        assert back.voxel_mm == 0.5 and decimate_mesh(back, 0.1).triangle_count <= back.triangle_count
