"""What a mesh says of itself in Python, its parts, and its way to pyvista and trimesh and back, in mm."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from refusals import refused
from sample_meshes import ball, box, torus, torus_volume_ml

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh import Mesh

pyvista = pytest.importorskip("pyvista")
trimesh = pytest.importorskip("trimesh")


def three_parts() -> Mesh:
    """Return a cube of 2 mm, a torus 100 mm to the left, and a cavity of 1 mm in the cube."""
    cube, faces = box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0))
    ring, bands = torus()
    hollow, walls = box((0.5, 0.5, 0.5))
    vertices = np.concatenate([cube, ring + (100.0, 0.0, -700.0), hollow])
    return Mesh(vertices, np.concatenate([faces, bands + 8, walls[:, ::-1] + 8 + len(ring)]), report={"a": 1})


def test_bounds_area_and_volume_are_in_mm() -> None:
    mesh = Mesh(*box((-3.0, 4.0, -800.0), (2.0, 3.0, 5.0)))
    assert mesh.bounds.tolist() == [[-3.0, 4.0, -800.0], [-1.0, 7.0, -795.0]]
    assert (mesh.area, mesh.volume) == pytest.approx((62.0, 30.0), rel=1e-6)
    ring = Mesh(*torus())
    assert ring.volume == pytest.approx(1000.0 * torus_volume_ml(), rel=1e-5)
    assert ring.volume == pytest.approx(1000.0 * ring.quality().volume_ml)
    assert Mesh(ring.vertices, ring.triangles[:, ::-1]).volume == pytest.approx(-ring.volume)
    nothing = Mesh([], [])
    assert np.isnan(nothing.bounds).all() and (nothing.area, nothing.volume) == (0.0, 0.0)


def test_parts_are_meshes_largest_first() -> None:
    mesh = three_parts()
    parts = mesh.components()
    assert [part.triangle_count for part in parts] == [240, 12, 12]
    assert [part.volume for part in parts[1:]] == pytest.approx([8.0, -1.0], rel=1e-6)
    assert all(type(part) is Mesh for part in parts)
    assert mesh.keep_largest().triangle_count == 240 and mesh.keep_largest(2).volume == pytest.approx(
        parts[0].volume + 8.0, rel=1e-5
    )
    whole = mesh.keep_largest(3)
    assert whole.triangle_count == mesh.triangle_count and mesh.report == {"a": 1} and whole.report["a"] == 1
    assert [part.triangle_count for part in mesh.split(min_volume_ml=0.005)] == [240, 12]
    (near,) = mesh.split(seeds=[(0.0, 0.0, -1.0)])
    assert near.volume == pytest.approx(8.0, rel=1e-6)
    with refused(UsageError, "keep_largest", 1):
        mesh.keep_largest(0)
    with refused(NoSurfaceError, "empty"):
        Mesh([], []).components()


@pytest.mark.parametrize(
    ("vertices", "triangles", "words"),
    [
        (np.eye(3), [[0, 1, 2], [0, 1, 7]], (1, 7, 3)),
        (np.eye(3), [[1, 2, 3]], (0,)),
        (np.zeros((0, 3)), [[0, 0, 0]], (0,)),
        ([[0, 0, 0], [0, np.nan, 0], [1, 1, 1]], [[0, 1, 2]], (1,)),
        ([[0, 0, 0], [0, 0, np.inf], [1, 1, 1]], [], (1,)),
        (np.eye(3), [0, 1, 2], (3,)),
        (np.eye(3), [[0.0, 1.0, 2.0]], ("integers",)),
        (np.eye(3), [[True, False, True]], ("integers",)),
        (np.eye(3) * 1j, [[0, 1, 2]], ("vertices",)),
    ],
)
def test_bad_triangles_are_refused_when_the_mesh_is_made(vertices: object, triangles: object, words: str) -> None:
    with refused(UsageError, *words):
        Mesh(vertices, triangles)  # type: ignore[arg-type]


def test_mesh_comes_back_from_pyvista_unchanged() -> None:
    vertices, triangles = ball(5.0, 12)
    mesh = Mesh(vertices + (30.0, -200.0, -900.0), triangles, vertices / 5.0)
    data = mesh.to_pyvista()
    back = Mesh.from_pyvista(data)
    assert np.array_equal(back.vertices, mesh.vertices) and np.array_equal(back.triangles, mesh.triangles)
    assert back.normals is not None and mesh.normals is not None and np.array_equal(back.normals, mesh.normals)
    assert (data.area, data.volume) == pytest.approx((mesh.area, mesh.volume), rel=1e-5)
    assert not np.shares_memory(back.vertices, mesh.vertices)
    turned = pyvista.PolyData(mesh.vertices * (-1, -1, 1), data.faces)
    found = Mesh.from_pyvista(turned, "ras")
    np.testing.assert_allclose(found.vertices, mesh.vertices, atol=1e-5)
    assert found.volume == pytest.approx(mesh.volume, rel=1e-5) and found.normals is None
    turned.field_data["SPACE"] = ["RAS"]
    np.testing.assert_allclose(Mesh.from_pyvista(turned).vertices, mesh.vertices, atol=1e-5)
    with refused(UsageError, "RAS", "LPS"):
        Mesh.from_pyvista(turned, "lps")
    squares = Mesh.from_pyvista(pyvista.Cube(x_length=2.0))
    assert (squares.triangle_count, squares.volume) == (12, pytest.approx(2.0, rel=1e-6))


def test_mesh_comes_back_from_trimesh_unchanged() -> None:
    mesh = three_parts()
    other = mesh.to_trimesh()
    assert (other.units, other.metadata["SPACE"]) == ("mm", "LPS")
    assert (other.area, other.volume) == pytest.approx((mesh.area, mesh.volume), rel=1e-6)
    np.testing.assert_allclose(other.bounds, mesh.bounds, atol=1e-6)
    assert len(other.split(only_watertight=False)) == 3
    back = Mesh.from_trimesh(other)
    assert np.array_equal(back.vertices, mesh.vertices) and np.array_equal(back.triangles, mesh.triangles)
    other.metadata["SPACE"] = "RAS"
    turned = Mesh.from_trimesh(other)
    assert np.array_equal(turned.vertices, mesh.vertices * np.float32([-1, -1, 1]))
    assert turned.volume == pytest.approx(mesh.volume, rel=1e-6)
    far = Mesh(np.eye(3) + 1e5 + 1e-7, [[0, 1, 2]])
    assert far.vertices.dtype == np.float64
    assert np.array_equal(Mesh.from_trimesh(far.to_trimesh()).vertices, far.vertices)
    with_normals = Mesh(*ball(1.0, 6), ball(1.0, 6)[0])
    np.testing.assert_allclose(with_normals.to_trimesh().vertex_normals, with_normals.normals, atol=1e-6)


def test_a_missing_trimesh_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with refused(UsageError, "to_trimesh", "package"):
        three_parts().to_trimesh()


def test_what_is_no_mesh_is_refused() -> None:
    with refused(UsageError, "ImageData", "pyvista.PolyData"):
        Mesh.from_pyvista(pyvista.ImageData(dimensions=(2, 2, 2)))
    with refused(UsageError, 3, "points"):
        Mesh.from_pyvista(pyvista.PolyData(np.eye(3)))
    with refused(UsageError, "trimesh.Trimesh"):
        Mesh.from_trimesh(pyvista.Cube())
    with refused(UsageError, "Scene"):
        Mesh.from_trimesh(trimesh.Scene())
    metres = trimesh.creation.box()
    metres.units = "meters"
    with refused(UsageError, "convert_units", "mm"):
        Mesh.from_trimesh(metres)
    with refused(UsageError, "xyz"):
        Mesh.from_trimesh(trimesh.creation.box(), "xyz")
    odd = trimesh.creation.box()
    odd.metadata["SPACE"] = "scanner"
    with refused(UsageError, "scanner", "Trimesh"):
        Mesh.from_trimesh(odd)
