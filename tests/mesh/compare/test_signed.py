"""Signed distances: known bodies, the winding number as another opinion, and the figures of `compare_meshes`."""

from __future__ import annotations

import numpy as np
import pytest
from sample_meshes import ball, box, torus

import clrecon
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh import Mesh
from clrecon.mesh.compare.signed import SignedDistance, measure_distance, measure_vertex_distances


def winding(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How often a surface goes round each point, by the solid angles of its triangles (Van Oosterom, Strackee 1983)."""
    a, b, c = (vertices[triangles[:, i]][None] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    top = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
    low = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return (2.0 * np.arctan2(top, low)).sum(axis=1) / (4.0 * np.pi)


@pytest.mark.parametrize("body", ["torus", "spikes", "box", "hollow"])
def test_the_sign_is_that_of_the_winding_number(body: str) -> None:
    random = np.random.default_rng(5)
    vertices, triangles = box() if body in ("box", "hollow") else torus()
    if body == "spikes":
        vertices = vertices * (1.0 + 0.35 * random.random((len(vertices), 1)))
    if body == "hollow":  # an inner wall, which faces the cavity
        inner, faces = box((0.25, 0.25, 0.25), (0.5, 0.5, 0.5))
        triangles = np.concatenate([triangles, faces[:, ::-1] + len(vertices)])
        vertices = np.concatenate([vertices, inner])
    vertices, triangles = vertices + (0.0, 900.0, -1500.0), triangles.astype(np.uint32)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    room = 0.3 * (high - low)
    points = low - room + random.random((1500, 3)) * (high - low + 2.0 * room)
    distance = SignedDistance(vertices, triangles)(points)
    inside = winding(points, vertices, triangles) > 0.5
    assert np.array_equal(distance < 0.0, inside) and 50 < inside.sum() < 1450
    turned = SignedDistance(vertices, triangles[:, ::-1], outward=False)(points)
    np.testing.assert_allclose(turned, distance, rtol=0.0, atol=1e-9)


def test_signed_distance_is_exact_at_faces_edges_corners_and_the_surface() -> None:
    vertices, triangles = box()
    measure = SignedDistance(vertices, triangles.astype(np.uint32))
    points = np.array(
        [
            (0.5, 0.5, 0.5),
            (0.5, 0.5, 2.0),
            (0.5, -3.0, -4.0),
            (2.0, 2.0, 2.0),
            (0.9, 0.5, 0.5),
            (0.3, 0.2, 1.0),
            (0, 0, 0),
        ]
    )
    expected = [-0.5, 1.0, 5.0, np.sqrt(3.0), -0.1, 0.0, 0.0]
    assert measure(points) == pytest.approx(expected, abs=1e-12)
    assert not np.signbit(measure(points)[5:]).any()


def test_ball_in_a_ball_has_signed_distances_of_the_gap() -> None:
    """Vertices lie on the spheres, and the triangles up to 0.02 mm within them."""
    small, large = (Mesh(*ball(radius, 60)) for radius in (10.0, 12.0))
    found = clrecon.measure_distance(small, large, 5000)
    there, back = found.to_reference_signed_mm, found.from_reference_signed_mm
    assert there is not None and back is not None and found.warnings == []
    for figure in ("mean", "p5", "median", "p95", "min", "max"):
        assert getattr(there, figure) == pytest.approx(-2.0, abs=0.03)
        assert getattr(back, figure) == pytest.approx(2.0, abs=0.03)
    assert (there.outside_share, back.outside_share) == (0.0, 1.0)
    assert there.sd < 0.01 and found.hausdorff_mm == pytest.approx(2.0, abs=0.03)
    distances, signed = measure_vertex_distances(large, small)
    assert signed and distances == pytest.approx(2.0, abs=0.03)


def test_the_figures_without_sign_are_those_of_compare_meshes() -> None:
    one = Mesh(*torus())
    other = one.transformed([[1.0, 0.02, 0, 0.7], [0, 1.1, 0, 0], [0, 0, 1, -0.4], [0, 0, 0, 1]])
    found, wanted = measure_distance(one, other, 4000), clrecon.compare_meshes(one, other, 4000)
    assert found.hausdorff_mm == pytest.approx(wanted.max_mm, rel=1e-9)
    for side in ("to_reference_mm", "from_reference_mm"):
        assert dict(found[side]) == pytest.approx(dict(wanted[side]), rel=1e-9)
    assert (found.hd95_mm, found.assd_mm) == pytest.approx((wanted.hd95_mm, wanted.assd_mm), rel=1e-9)


def test_an_open_mesh_gives_no_sign_and_an_inside_out_one_is_turned_back() -> None:
    vertices, triangles = box()
    whole, opened, turned = (Mesh(vertices, each) for each in (triangles, triangles[1:], triangles[:, ::-1]))
    shifted = Mesh(0.5 * vertices + 0.25, triangles)
    found = measure_distance(shifted, opened, 100, names=("a.stl", "b.stl"))
    assert found.to_reference_signed_mm is None and found.from_reference_signed_mm is not None
    assert found.warnings == ["b.stl is not closed (3 edges not in two triangles): distances from it have no sign"]
    assert measure_vertex_distances(shifted, opened)[1] is False
    found = measure_distance(shifted, turned, 100)
    assert "inside out" in found.warnings[0]
    assert found.to_reference_signed_mm == measure_distance(shifted, whole, 100).to_reference_signed_mm
    mixed = triangles.copy()
    mixed[0] = mixed[0, ::-1]
    found = measure_distance(whole, Mesh(vertices, mixed), 100)
    assert "do not agree" in found.warnings[0] and found.to_reference_signed_mm is None


def test_what_cannot_be_measured_is_refused() -> None:
    mesh, empty = Mesh(*box()), Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.uint32))
    with pytest.raises(UsageError, match="at least 1 sample"):
        measure_distance(mesh, mesh, 0)
    with pytest.raises(NoSurfaceError, match="no triangles"):
        measure_distance(mesh, empty)
    with pytest.raises(NoSurfaceError, match="without area"):
        measure_distance(empty, mesh)
    with pytest.raises(UsageError, match="closed"):
        SignedDistance(mesh.vertices, mesh.triangles[1:])
