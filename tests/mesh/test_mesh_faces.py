"""What a mesh says of itself in Python, its parts, and its way to pyvista and trimesh and back, in mm."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

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


def test_bounds_area_and_volume_of_a_box_are_in_mm() -> None:
    mesh = Mesh(*box((-3.0, 4.0, -800.0), (2.0, 3.0, 5.0)))
    assert mesh.bounds.tolist() == [[-3.0, 4.0, -800.0], [-1.0, 7.0, -795.0]]
    assert mesh.area == pytest.approx(2 * (2 * 3 + 3 * 5 + 5 * 2), rel=1e-6)
    assert mesh.volume == pytest.approx(2 * 3 * 5, rel=1e-6)


def test_volume_of_a_torus_is_that_of_its_tetrahedra_and_of_its_quality() -> None:
    ring = Mesh(*torus())
    assert ring.volume == pytest.approx(1000.0 * torus_volume_ml(), rel=1e-5)
    assert ring.volume == pytest.approx(1000.0 * ring.quality().volume_ml)


def test_volume_of_a_mesh_that_looks_inward_is_negative() -> None:
    ring = Mesh(*torus())
    assert Mesh(ring.vertices, ring.triangles[:, ::-1]).volume == pytest.approx(-ring.volume)


def test_an_empty_mesh_has_no_bounds_and_no_area() -> None:
    nothing = Mesh([], [])
    assert np.isnan(nothing.bounds).all()
    assert (nothing.area, nothing.volume) == (0.0, 0.0)


def test_parts_are_meshes_largest_first() -> None:
    ring, cube, cavity = parts = three_parts().components()
    assert [type(part) for part in parts] == [Mesh] * 3
    assert [part.triangle_count for part in parts] == [240, 12, 12]
    assert ring.volume == pytest.approx(1000.0 * torus_volume_ml(), rel=1e-4)
    assert [cube.volume, cavity.volume] == pytest.approx([8.0, -1.0], rel=1e-6)


def test_keep_largest_keeps_as_many_parts_as_asked() -> None:
    mesh = three_parts()
    assert [mesh.keep_largest(count).triangle_count for count in (1, 2, 3)] == [240, 252, 264]
    assert mesh.keep_largest().triangle_count == 240
    assert mesh.keep_largest(2).volume == pytest.approx(mesh.keep_largest().volume + 8.0, rel=1e-5)


def test_keep_largest_amends_a_copy_of_the_report() -> None:
    mesh = three_parts()
    assert mesh.keep_largest(3).report["a"] == 1
    assert mesh.report == {"a": 1}


def test_split_leaves_out_parts_below_a_volume() -> None:
    assert [part.triangle_count for part in three_parts().split(min_volume_ml=0.005)] == [240, 12]  # the cavity: 0.001


def test_split_keeps_the_part_nearest_to_a_seed() -> None:
    (cube,) = three_parts().split(seeds=[(0.0, 0.0, -1.0)])
    assert cube.volume == pytest.approx(8.0, rel=1e-6)


def test_keep_largest_of_no_part_is_refused() -> None:
    with refused(UsageError, "keep_largest", 1):
        three_parts().keep_largest(0)


def test_components_of_an_empty_mesh_are_refused() -> None:
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


def far_ball() -> Mesh:
    vertices, triangles = ball(5.0, 12)
    return Mesh(vertices + (30.0, -200.0, -900.0), triangles, vertices / 5.0)


def test_mesh_comes_back_from_pyvista_unchanged() -> None:
    mesh = far_ball()
    back = Mesh.from_pyvista(mesh.to_pyvista())
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.triangles, mesh.triangles)
    np.testing.assert_array_equal(back.normals, mesh.normals)
    assert not np.shares_memory(back.vertices, mesh.vertices)


def test_pyvista_measures_the_same_area_and_volume() -> None:
    mesh = far_ball()
    data = mesh.to_pyvista()
    assert (data.area, data.volume) == pytest.approx((mesh.area, mesh.volume), rel=1e-5)


@pytest.mark.parametrize("named", ["by the caller", "in the data"])
def test_pyvista_data_in_ras_are_turned(named: str) -> None:
    mesh = far_ball()
    data = pyvista.PolyData(mesh.vertices * (-1, -1, 1), mesh.to_pyvista().faces)
    if named == "in the data":
        data.field_data["SPACE"] = ["RAS"]
    turned = Mesh.from_pyvista(data, "ras" if named == "by the caller" else None)
    np.testing.assert_allclose(turned.vertices, mesh.vertices, atol=1e-5)
    assert turned.volume == pytest.approx(mesh.volume, rel=1e-5)
    assert turned.normals is None


def test_pyvista_data_whose_frame_contradicts_the_caller_are_refused() -> None:
    data = far_ball().to_pyvista()
    data.field_data["SPACE"] = ["RAS"]
    with refused(UsageError, "RAS", "LPS"):
        Mesh.from_pyvista(data, "lps")


def test_squares_of_pyvista_become_triangles() -> None:
    squares = Mesh.from_pyvista(pyvista.Cube(x_length=2.0))
    assert squares.triangle_count == 6 * 2
    assert squares.volume == pytest.approx(2.0 * 1.0 * 1.0, rel=1e-6)


def test_mesh_comes_back_from_trimesh_unchanged() -> None:
    mesh = three_parts()
    back = Mesh.from_trimesh(mesh.to_trimesh())
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.triangles, mesh.triangles)


def test_trimesh_measures_the_same_and_knows_unit_and_frame() -> None:
    mesh = three_parts()
    other = mesh.to_trimesh()
    assert (other.units, other.metadata["SPACE"]) == ("mm", "LPS")
    assert (other.area, other.volume) == pytest.approx((mesh.area, mesh.volume), rel=1e-6)
    np.testing.assert_allclose(other.bounds, mesh.bounds, atol=1e-6)
    assert len(other.split(only_watertight=False)) == 3


def test_a_trimesh_in_ras_is_turned() -> None:
    mesh = three_parts()
    other = mesh.to_trimesh()
    other.metadata["SPACE"] = "RAS"
    turned = Mesh.from_trimesh(other)
    np.testing.assert_array_equal(turned.vertices, mesh.vertices * np.float32([-1, -1, 1]))
    assert turned.volume == pytest.approx(mesh.volume, rel=1e-6)


def test_vertices_in_double_precision_come_back_from_trimesh_to_the_bit() -> None:
    far = Mesh(np.eye(3) + 1e5 + 1e-7, [[0, 1, 2]])  # float32 ends at 0.008 mm there
    assert far.vertices.dtype == np.float64
    np.testing.assert_array_equal(Mesh.from_trimesh(far.to_trimesh()).vertices, far.vertices)


def test_normals_go_to_trimesh() -> None:
    vertices, triangles = ball(1.0, 6)
    mesh = Mesh(vertices, triangles, vertices)
    np.testing.assert_allclose(mesh.to_trimesh().vertex_normals, mesh.normals, atol=1e-6)


def test_a_missing_trimesh_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with refused(UsageError, "to_trimesh", "package"):
        three_parts().to_trimesh()


def with_unit(unit: str) -> Any:
    made = trimesh.creation.box()
    made.units = unit
    return made


def with_frame(space: str) -> Any:
    made = trimesh.creation.box()
    made.metadata["SPACE"] = space
    return made


@pytest.mark.parametrize(
    ("convert", "facts"),
    [
        (lambda: Mesh.from_pyvista(pyvista.ImageData(dimensions=(2, 2, 2))), ("ImageData", "pyvista.PolyData")),
        (lambda: Mesh.from_pyvista(pyvista.PolyData(np.eye(3))), (3, "points")),
        (lambda: Mesh.from_trimesh(pyvista.Cube()), ("trimesh.Trimesh",)),
        (lambda: Mesh.from_trimesh(trimesh.Scene()), ("Scene",)),
        (lambda: Mesh.from_trimesh(with_unit("meters")), ("convert_units", "mm")),
        (lambda: Mesh.from_trimesh(trimesh.creation.box(), "xyz"), ("xyz",)),
        (lambda: Mesh.from_trimesh(with_frame("scanner")), ("scanner", "Trimesh")),
    ],
    ids=["image", "points", "pyvista as trimesh", "scene", "metres", "unknown frame", "unknown frame in the data"],
)
def test_what_is_no_mesh_is_refused(convert: Callable[[], Mesh], facts: tuple[str | int, ...]) -> None:
    with refused(UsageError, *facts):
        convert()
