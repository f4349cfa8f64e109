"""What a mesh says of itself in Python, its parts, and its way to pyvista and trimesh and back, in mm."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused
from sample_meshes import ball, box, join, torus, torus_volume_ml

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh import Mesh

pyvista = pytest.importorskip("pyvista")
trimesh = pytest.importorskip("trimesh")


TORUS_FACES = 2 * 15 * 8
BOX_FACES = 2 * 6


def three_parts() -> Mesh:
    """Return a cube of 2 mm at the origin, a torus around (100, 0, -700), and a cavity of 1 mm in the cube."""
    ring, bands = torus(rings=15, sides=8)
    hollow, walls = box(low=(0.5, 0.5, 0.5), size=(1.0, 1.0, 1.0))
    cube = box(low=(0.0, 0.0, 0.0), size=(2.0, 2.0, 2.0))
    return Mesh(*join(cube, (ring + (100.0, 0.0, -700.0), bands), (hollow, walls[:, ::-1])), report={"a": 1})


def test_bounds_area_and_volume_of_a_box_are_in_mm() -> None:
    mesh = Mesh(*box(low=(-3.0, 4.0, -800.0), size=(2.0, 3.0, 5.0)))
    assert mesh.bounds.tolist() == [[-3.0, 4.0, -800.0], [-1.0, 7.0, -795.0]]
    assert mesh.area == pytest.approx(2 * (2 * 3 + 3 * 5 + 5 * 2), rel=tolerances.MESH_VOLUME)
    assert mesh.volume == pytest.approx(2 * 3 * 5, rel=tolerances.MESH_VOLUME)


def test_volume_of_a_torus_is_that_of_its_tetrahedra() -> None:
    ring = Mesh(*torus())
    assert ring.volume == pytest.approx(1000.0 * torus_volume_ml(), rel=tolerances.PEER_MEASURE)


def test_volume_of_a_mesh_is_that_of_its_quality_in_mm3() -> None:
    ring = Mesh(*torus())
    assert ring.volume == pytest.approx(1000.0 * ring.quality().volume_ml)


def test_volume_of_a_mesh_that_looks_inward_is_negative() -> None:
    ring = Mesh(*torus())
    assert Mesh(ring.vertices, ring.triangles[:, ::-1]).volume == pytest.approx(-ring.volume)


def test_an_empty_mesh_has_bounds_of_nan_and_no_area_or_volume() -> None:
    nothing = Mesh([], [])
    assert np.isnan(nothing.bounds).all()
    assert (nothing.area, nothing.volume) == (0.0, 0.0)


def test_components_are_meshes_the_largest_first() -> None:
    ring, cube, cavity = parts = three_parts().components()
    assert [type(part) for part in parts] == [Mesh] * 3
    assert ring.volume == pytest.approx(1000.0 * torus_volume_ml(), rel=tolerances.FAR_MEASURE)
    assert cube.volume == pytest.approx(2.0**3, rel=tolerances.MESH_VOLUME)
    assert cavity.volume == pytest.approx(-(1.0**3), rel=tolerances.MESH_VOLUME)


@pytest.mark.parametrize(
    ("number", "triangles"), [(1, TORUS_FACES), (2, TORUS_FACES + BOX_FACES), (3, TORUS_FACES + 2 * BOX_FACES)]
)
def test_keep_largest_keeps_as_many_parts_as_asked(number: int, triangles: int) -> None:
    assert three_parts().keep_largest(number).triangle_count == triangles


def test_keep_largest_keeps_one_part_where_no_number_is_given() -> None:
    assert three_parts().keep_largest().triangle_count == TORUS_FACES


def test_keep_largest_amends_a_copy_of_the_report() -> None:
    mesh = three_parts()
    kept = mesh.keep_largest(1)
    assert kept.report == {"a": 1, "components_found": 3, "components_kept": 1}
    assert mesh.report == {"a": 1}


def test_split_leaves_out_parts_below_a_volume() -> None:
    kept = three_parts().split(min_volume_ml=0.005)  # the cube has 0.008 ml, its cavity 0.001
    assert [part.triangle_count for part in kept] == [TORUS_FACES, BOX_FACES]


def test_split_keeps_the_part_nearest_to_a_seed() -> None:
    below_the_cube = (0.0, 0.0, -1.0)
    (cube,) = three_parts().split(seeds=[below_the_cube])
    assert cube.volume == pytest.approx(2.0**3, rel=tolerances.MESH_VOLUME)


def test_keep_largest_of_no_part_is_refused() -> None:
    with refused(UsageError, "keep_largest", 1):
        three_parts().keep_largest(0)


def test_components_of_an_empty_mesh_are_refused() -> None:
    with refused(NoSurfaceError, "empty"):
        Mesh([], []).components()


@pytest.mark.parametrize(
    ("vertices", "triangles", "facts"),
    [
        (np.eye(3), [[0, 1, 2], [0, 1, 7]], ("triangle", 1, "vertex", 7, 3)),
        (np.eye(3), [[1, 2, 3]], ("triangle", 0, "vertex", 3)),
        (np.zeros((0, 3)), [[0, 0, 0]], ("triangle", "vertex", 0)),
        ([[0, 0, 0], [0, np.nan, 0], [1, 1, 1]], [[0, 1, 2]], ("vertex", 1, "finite")),
        ([[0, 0, 0], [0, 0, np.inf], [1, 1, 1]], [], ("vertex", 1, "finite")),
        (np.eye(3), [0, 1, 2], ("triangles", "shape", 3)),
        (np.eye(3), [[0.0, 1.0, 2.0]], ("integers",)),
        (np.eye(3), [[True, False, True]], ("integers",)),
        (np.eye(3) * 1j, [[0, 1, 2]], ("vertices",)),
    ],
    ids=[
        "a corner of the second triangle is missing",
        "a corner of the first triangle is missing",
        "no vertices",
        "vertex of NaN",
        "vertex of infinity",
        "one row of corners",
        "corners are floats",
        "corners are truth values",
        "vertices are complex",
    ],
)
def test_a_mesh_of_triangles_or_vertices_that_cannot_be_is_refused(
    vertices: object, triangles: object, facts: tuple[str | int, ...]
) -> None:
    with refused(UsageError, *facts):
        Mesh(vertices, triangles)  # type: ignore[arg-type]


def far_ball() -> Mesh:
    """A ball of 5 mm about (30, -200, -900), with normals."""
    vertices, triangles = ball(radius=5.0, rings=12)
    return Mesh(vertices + (30.0, -200.0, -900.0), triangles, normals=vertices / 5.0)


def test_mesh_comes_back_from_pyvista_unchanged() -> None:
    mesh = far_ball()
    back = Mesh.from_pyvista(mesh.to_pyvista())
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.triangles, mesh.triangles)
    np.testing.assert_array_equal(back.normals, mesh.normals)


def test_mesh_from_pyvista_has_vertices_of_its_own() -> None:
    data = far_ball().to_pyvista()
    assert not np.shares_memory(Mesh.from_pyvista(data).vertices, np.asarray(data.points))


def test_pyvista_measures_the_same_area_and_volume() -> None:
    mesh = far_ball()
    data = mesh.to_pyvista()
    assert (data.area, data.volume) == pytest.approx((mesh.area, mesh.volume), rel=tolerances.PEER_MEASURE)


@pytest.mark.parametrize("named", ["by the caller", "in the data"])
def test_pyvista_data_in_ras_become_a_mesh_in_lps(named: str) -> None:
    mesh = far_ball()
    data = pyvista.PolyData(mesh.vertices * (-1, -1, 1), mesh.to_pyvista().faces)
    if named == "in the data":
        data.field_data["SPACE"] = ["RAS"]
    in_lps = Mesh.from_pyvista(data, "ras" if named == "by the caller" else None)
    np.testing.assert_array_equal(in_lps.vertices, mesh.vertices)
    assert in_lps.volume == pytest.approx(mesh.volume)


def test_pyvista_data_without_normals_become_a_mesh_without() -> None:
    mesh = far_ball()
    data = pyvista.PolyData(mesh.vertices, mesh.to_pyvista().faces)
    assert Mesh.from_pyvista(data, "lps").normals is None


def test_pyvista_data_whose_frame_contradicts_the_caller_are_refused() -> None:
    data = far_ball().to_pyvista()
    data.field_data["SPACE"] = ["RAS"]
    with refused(UsageError, "RAS", "LPS"):
        Mesh.from_pyvista(data, "lps")


def test_squares_of_pyvista_become_two_triangles_each() -> None:
    squares = Mesh.from_pyvista(pyvista.Cube(x_length=2.0))
    assert squares.triangle_count == 6 * 2
    assert squares.volume == pytest.approx(2.0 * 1.0 * 1.0, rel=tolerances.MESH_VOLUME)  # 1 mm where none is given


def test_mesh_comes_back_from_trimesh_unchanged() -> None:
    mesh = three_parts()
    back = Mesh.from_trimesh(mesh.to_trimesh())
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.triangles, mesh.triangles)


def test_trimesh_knows_unit_and_frame() -> None:
    other = three_parts().to_trimesh()
    assert (other.units, other.metadata["SPACE"]) == ("mm", "LPS")


def test_trimesh_measures_the_same_area_volume_bounds_and_number_of_parts() -> None:
    mesh = three_parts()
    other = mesh.to_trimesh()
    assert (other.area, other.volume) == pytest.approx((mesh.area, mesh.volume), rel=tolerances.MESH_VOLUME)
    np.testing.assert_array_equal(other.bounds, mesh.bounds)
    assert len(other.split(only_watertight=False)) == 3


def test_a_trimesh_in_ras_becomes_a_mesh_in_lps() -> None:
    mesh = three_parts()
    other = mesh.to_trimesh()
    other.metadata["SPACE"] = "RAS"
    turned = Mesh.from_trimesh(other)
    np.testing.assert_array_equal(turned.vertices, mesh.vertices * np.float32([-1, -1, 1]))
    assert turned.volume == pytest.approx(mesh.volume, rel=tolerances.MESH_VOLUME)


def test_trimesh_whose_units_were_set_to_none_is_taken_as_mm() -> None:
    other = trimesh.creation.box()
    other.units = None  # trimesh stores the text "none"
    assert Mesh.from_trimesh(other).volume == pytest.approx(1.0, rel=tolerances.MESH_VOLUME)  # a cube of 1 mm


def test_vertices_in_double_precision_come_back_from_trimesh_to_the_bit() -> None:
    far = Mesh(np.eye(3) + 1e5 + 1e-7, [[0, 1, 2]])  # a step of float32 is 0.008 mm there
    back = Mesh.from_trimesh(far.to_trimesh())
    assert back.vertices.dtype == np.float64
    np.testing.assert_array_equal(back.vertices, far.vertices)


def test_trimesh_has_the_normals_of_the_mesh() -> None:
    vertices, triangles = ball(radius=1.0, rings=6)
    mesh = Mesh(vertices, triangles, normals=vertices)
    np.testing.assert_allclose(mesh.to_trimesh().vertex_normals, mesh.normals, atol=tolerances.MESH_UNIT_NORMAL)


def test_to_trimesh_is_refused_where_the_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with refused(UsageError, "to_trimesh", "package"):
        three_parts().to_trimesh()


@pytest.mark.parametrize("name", ["a.vtu", "a.inp", "a.vtk"])
def test_files_of_meshio_have_the_vertices_and_triangles_of_a_mesh(name: str, tmp_path: Path) -> None:
    meshio = pytest.importorskip("meshio")
    mesh = three_parts()
    mesh.to_meshio().write(tmp_path / name)
    back = meshio.read(tmp_path / name)
    np.testing.assert_allclose(back.points, mesh.vertices, rtol=1e-7)  # text of 16 digits
    np.testing.assert_array_equal(back.cells_dict["triangle"], mesh.triangles)


def test_meshio_gets_normals_and_values_of_vertices_and_triangles() -> None:
    pytest.importorskip("meshio")
    vertices, triangles = ball(1.0)
    mesh = Mesh(vertices, triangles, normals=vertices)
    mesh.values["HU"] = np.arange(len(vertices), dtype=np.float32)
    mesh.face_values["wall"] = np.arange(len(triangles), dtype=np.float32)
    other = mesh.to_meshio()
    np.testing.assert_array_equal(other.point_data["Normals"], mesh.normals)
    np.testing.assert_array_equal(other.point_data["HU"], mesh.values["HU"])
    np.testing.assert_array_equal(other.cell_data_dict["wall"]["triangle"], mesh.face_values["wall"])


def test_to_meshio_is_refused_where_the_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "meshio", None)
    with refused(UsageError, "to_meshio", "package"):
        three_parts().to_meshio()


def box_of_trimesh(unit: str | None = None, space: str | None = None) -> Any:
    box_mesh = trimesh.creation.box()
    if unit is not None:
        box_mesh.units = unit
    if space is not None:
        box_mesh.metadata["SPACE"] = space
    return box_mesh


@pytest.mark.parametrize(
    ("convert", "facts"),
    [
        (lambda: Mesh.from_pyvista(pyvista.ImageData(dimensions=(2, 2, 2))), ("ImageData", "pyvista.PolyData")),
        (lambda: Mesh.from_pyvista(pyvista.PolyData(np.eye(3))), (3, "points")),
        (lambda: Mesh.from_trimesh(pyvista.Cube()), ("trimesh.Trimesh",)),
        (lambda: Mesh.from_trimesh(trimesh.Scene()), ("Scene",)),
        (lambda: Mesh.from_trimesh(box_of_trimesh(unit="meters")), ("convert_units", "mm")),
        (lambda: Mesh.from_trimesh(box_of_trimesh(), space="xyz"), ("xyz",)),
        (lambda: Mesh.from_trimesh(box_of_trimesh(space="scanner")), ("scanner", "Trimesh")),
    ],
    ids=["image", "points", "pyvista as trimesh", "scene", "metres", "unknown frame", "unknown frame in the data"],
)
def test_objects_of_libraries_that_are_no_mesh_in_mm_and_a_known_frame_are_refused(
    convert: Callable[[], Mesh], facts: tuple[str | int, ...]
) -> None:
    with refused(UsageError, *facts):
        convert()
