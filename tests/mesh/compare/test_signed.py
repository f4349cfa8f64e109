"""Signed distances: known bodies, the winding number as another opinion, and the figures of `compare_meshes`."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from sample_meshes import Arrays, ball, box, torus

import clrecon
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh import Mesh
from clrecon.mesh.compare.signed import SignedDistance, measure_distance, measure_vertex_distances


def winding_number(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How often a surface goes round each point, by the solid angles of its triangles (Van Oosterom, Strackee 1983)."""
    a, b, c = (vertices[triangles[:, i]][None] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    top = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
    low = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return (2.0 * np.arctan2(top, low)).sum(axis=1) / (4.0 * np.pi)


def spiky_torus() -> Arrays:
    vertices, triangles = torus()
    return vertices * (1.0 + 0.35 * np.random.default_rng(5).random((len(vertices), 1))), triangles


def hollow_box() -> Arrays:
    """A cube of 1 mm with a cavity of half a millimetre, whose wall faces the cavity."""
    (outer, outer_faces), (inner, inner_faces) = box(), box((0.25, 0.25, 0.25), size=(0.5, 0.5, 0.5))
    return np.concatenate([outer, inner]), np.concatenate([outer_faces, inner_faces[:, ::-1] + len(outer)])


@pytest.fixture(params=[torus, spiky_torus, box, hollow_box])
def body_and_points(request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices and triangles of a body far from the origin, and 1500 random points in and around it."""
    vertices, triangles = request.param()
    vertices = vertices + (0.0, 900.0, -1500.0)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    around = 0.3 * (high - low)
    points = np.random.default_rng(6).uniform(low - around, high + around, (1500, 3))
    return vertices, triangles.astype(np.uint32), points


def test_distances_are_negative_where_the_winding_number_says_inside(
    body_and_points: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    vertices, triangles, points = body_and_points
    is_inside = winding_number(points, vertices, triangles) > 0.5
    enough = 50  # measured 95 to 369 points inside
    assert enough < is_inside.sum() < len(points) - enough, "points inside and outside"
    np.testing.assert_array_equal(SignedDistance(vertices, triangles)(points) < 0.0, is_inside)


def test_an_inside_out_surface_that_is_said_to_be_so_has_the_same_signed_distances(
    body_and_points: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    vertices, triangles, points = body_and_points
    distances = SignedDistance(vertices, triangles)(points)
    inside_out = SignedDistance(vertices, triangles[:, ::-1], outward=False)(points)
    np.testing.assert_allclose(inside_out, distances, rtol=0.0, atol=tolerances.FLOAT64_PLACE_MM)


DISTANCES_OF_A_CUBE_OF_1_MM = {
    "centre": ((0.5, 0.5, 0.5), -0.5),
    "inside, near a face": ((0.9, 0.5, 0.5), -0.1),
    "over a face": ((0.5, 0.5, 2.0), 1.0),
    "beside an edge": ((0.5, -3.0, -4.0), 5.0),
    "beyond a corner": ((2.0, 2.0, 2.0), np.sqrt(3.0)),
}


@pytest.mark.parametrize(("point", "distance"), DISTANCES_OF_A_CUBE_OF_1_MM.values(), ids=DISTANCES_OF_A_CUBE_OF_1_MM)
def test_signed_distance_to_faces_edges_and_corners_is_exact(point: tuple[float, ...], distance: float) -> None:
    vertices, triangles = box()
    measure = SignedDistance(vertices, triangles.astype(np.uint32))
    assert measure(np.array([point])) == pytest.approx([distance], abs=tolerances.NEAREST_MM)


def test_signed_distance_on_a_face_and_at_a_corner_is_zero_and_not_negative_zero() -> None:
    vertices, triangles = box()
    distances = SignedDistance(vertices, triangles.astype(np.uint32))(np.array([(0.3, 0.2, 1.0), (0.0, 0.0, 0.0)]))
    assert distances == pytest.approx([0.0, 0.0], abs=tolerances.NEAREST_MM)
    assert not np.signbit(distances).any()


@pytest.fixture(scope="module")
def small_and_large_ball() -> tuple[Mesh, Mesh]:
    """Balls of 10 and 12 mm about one centre, of the same rings: their triangles lie within the spheres alike."""
    return Mesh(*ball(10.0, rings=60)), Mesh(*ball(12.0, rings=60))


GAP_MM = 12.0 - 10.0


def test_every_figure_of_a_ball_in_a_larger_one_is_the_gap_negative_inside(
    small_and_large_ball: tuple[Mesh, Mesh],
) -> None:
    distance = clrecon.measure_distance(*small_and_large_ball, samples=5000)
    to_large, to_small = distance.to_reference_signed_mm, distance.from_reference_signed_mm
    assert to_large is not None
    assert to_small is not None
    for figure in ("mean", "p5", "median", "p95", "min", "max"):
        assert getattr(to_large, figure) == pytest.approx(-GAP_MM, abs=tolerances.TWO_BALLS_MM), figure
        assert getattr(to_small, figure) == pytest.approx(GAP_MM, abs=tolerances.TWO_BALLS_MM), figure
    assert distance.hausdorff_mm == pytest.approx(GAP_MM, abs=tolerances.TWO_BALLS_MM)


def test_a_ball_in_a_larger_one_has_no_share_outside_and_the_larger_one_all(
    small_and_large_ball: tuple[Mesh, Mesh],
) -> None:
    distance = clrecon.measure_distance(*small_and_large_ball, samples=5000)
    assert distance.to_reference_signed_mm.outside_share == 0.0  # type: ignore[union-attr]
    assert distance.from_reference_signed_mm.outside_share == 1.0  # type: ignore[union-attr]


def test_an_even_gap_between_closed_balls_has_nearly_no_spread_and_no_warning(
    small_and_large_ball: tuple[Mesh, Mesh],
) -> None:
    distance = clrecon.measure_distance(*small_and_large_ball, samples=5000)
    assert distance.to_reference_signed_mm.sd < tolerances.TWO_BALLS_MM  # type: ignore[union-attr]
    assert distance.warnings == []


def test_each_vertex_of_the_larger_ball_has_the_gap_as_its_signed_distance(
    small_and_large_ball: tuple[Mesh, Mesh],
) -> None:
    small, large = small_and_large_ball
    distances, is_signed = measure_vertex_distances(large, small)
    assert is_signed
    assert distances == pytest.approx(GAP_MM, abs=tolerances.TWO_BALLS_MM)


def test_the_figures_without_sign_are_those_of_compare_meshes() -> None:
    mesh = Mesh(*torus())
    sheared = mesh.transformed([[1.0, 0.02, 0, 0.7], [0, 1.1, 0, 0], [0, 0, 1, -0.4], [0, 0, 0, 1]])
    signed, unsigned = (measure(mesh, sheared, samples=4000) for measure in (measure_distance, clrecon.compare_meshes))
    assert dict(signed.to_reference_mm) == pytest.approx(dict(unsigned.to_reference_mm))
    assert dict(signed.from_reference_mm) == pytest.approx(dict(unsigned.from_reference_mm))
    assert signed.hausdorff_mm == pytest.approx(unsigned.max_mm)
    assert signed.hd95_mm == pytest.approx(unsigned.hd95_mm)
    assert signed.assd_mm == pytest.approx(unsigned.assd_mm)


CORNERS, FACES = box()
INNER_BOX = Mesh(0.5 * CORNERS + 0.25, FACES)
"""A cube of half a millimetre in the middle of the cube of 1 mm."""


def test_distances_from_an_open_mesh_have_no_sign_and_a_warning_names_its_file() -> None:
    opened = Mesh(CORNERS, FACES[1:])
    distance = measure_distance(INNER_BOX, opened, samples=100, names=("a.stl", "b.stl"))
    assert distance.to_reference_signed_mm is None
    assert distance.from_reference_signed_mm is not None
    assert distance.warnings == ["b.stl is not closed (3 edges not in two triangles): distances from it have no sign"]


def test_distances_of_vertices_from_an_open_mesh_are_said_to_have_no_sign() -> None:
    _, is_signed = measure_vertex_distances(INNER_BOX, Mesh(CORNERS, FACES[1:]))
    assert is_signed is False


def test_an_inside_out_mesh_is_measured_as_if_turned_back_and_a_warning_says_so() -> None:
    distance = measure_distance(INNER_BOX, Mesh(CORNERS, FACES[:, ::-1]), samples=100)
    outward = measure_distance(INNER_BOX, Mesh(CORNERS, FACES), samples=100)
    (warning,) = distance.warnings
    assert "inside out" in warning
    assert distance.to_reference_signed_mm == outward.to_reference_signed_mm


def test_distances_from_a_mesh_with_a_flipped_triangle_have_no_sign_and_a_warning_says_why() -> None:
    mixed = FACES.copy()
    mixed[0] = mixed[0, ::-1]
    distance = measure_distance(INNER_BOX, Mesh(CORNERS, mixed), samples=100)
    (warning,) = distance.warnings
    assert "do not agree" in warning
    assert distance.to_reference_signed_mm is None


WHOLE_BOX, NO_TRIANGLES = Mesh(CORNERS, FACES), Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.uint32))


@pytest.mark.parametrize(
    ("mesh", "reference", "samples", "error", "words"),
    [
        (WHOLE_BOX, WHOLE_BOX, 0, UsageError, "at least 1 sample"),
        (WHOLE_BOX, NO_TRIANGLES, 100, NoSurfaceError, "no triangles"),
        (NO_TRIANGLES, WHOLE_BOX, 100, NoSurfaceError, "the mesh has no triangles"),
    ],
    ids=["no samples", "reference without triangles", "mesh without triangles"],
)
def test_a_distance_without_samples_or_triangles_is_refused(
    mesh: Mesh, reference: Mesh, samples: int, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        measure_distance(mesh, reference, samples)


def test_signed_distances_from_an_open_surface_are_refused() -> None:
    with refused(UsageError, "closed"):
        SignedDistance(CORNERS, FACES[1:])
