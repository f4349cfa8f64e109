"""Volumes far from the origin of their frame: right to 1e-3 mm at 1e5 mm and better, from the device to the file."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import tolerances
from coded_pages import decode_surface

import clrecon
from clrecon.exchange.coordinates import find_coincident
from clrecon.exchange.formats import FORMATS, describe_rounding
from clrecon.exchange.page import parse_page, read_facts
from clrecon.geometry import Volume
from clrecon.geometry.vertices import FAR_MM, find_vertex_origin, float32_step
from clrecon.labels import LabelMap
from clrecon.mesh import Mesh
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.labels import extract_labels
from clrecon.proof.surface import extract as twin

OBLIQUE = np.array([[0.5, 0.05, 0.1, -12.0], [-0.05, 0.7, 0.3, -14.0], [0.0, 0.1, 1.25, -19.0], [0, 0, 0, 1.0]])
FAR = np.array([1e5, -1e5, 5e4])
CENTRE_IJK = np.array([24.3, 19.1, 15.2])
RADIUS_MM = 8.0


def make_sphere(shift=(0.0, 0.0, 0.0), dtype="int16") -> Volume:
    """The distance field of a sphere, 0 HU on it, 1000 HU more a mm inward."""
    affine = OBLIQUE.copy()
    affine[:3, 3] += shift
    k, j, i = np.mgrid[:30, :40, :50]
    steps = np.stack([i, j, k], axis=-1) - CENTRE_IJK
    distance = np.linalg.norm(steps @ OBLIQUE[:3, :3].T, axis=-1)
    return Volume(np.clip(1000.0 * (RADIUS_MM - distance), -1000, 3000).astype(dtype), affine)


@pytest.mark.parametrize("topology", ["separated", "trilinear"])
@pytest.mark.parametrize("shift", [FAR, (0.0, 5000.0, 0.0), (-8e5, 3.25, 1e6)], ids=str)
def test_surface_of_a_shifted_volume_is_the_shifted_surface_in_float64(device, shift, topology):
    near = extract_isosurface(make_sphere(), 0.5, device=device, topology=topology)
    far = extract_isosurface(make_sphere(shift), 0.5, device=device, topology=topology)
    assert (near.vertices.dtype, far.vertices.dtype) == (np.float32, np.float64)
    assert np.array_equal(near.triangles, far.triangles)
    assert np.array_equal(near.normals, far.normals)
    assert np.abs(far.vertices - shift - near.vertices).max() <= tolerances.FAR_VERTEX_MM


@pytest.mark.parametrize(("shift", "warned"), [(FAR, True), ((0.0, 0.0, 0.0), False)], ids=["far", "near"])
def test_vertices_in_float64_are_warned_of(device, shift, warned):
    warnings = extract_isosurface(make_sphere(shift), 0.5, device=device).report["warnings"]
    assert any("vertices are float64" in text for text in warnings) == warned


@pytest.mark.every_device
def test_vertices_far_from_the_origin_lie_on_their_sphere(device):
    volume = make_sphere(FAR, dtype="float32")
    mesh = extract_isosurface(volume, 0.0, device=device)
    centre = volume.ijk_to_lps(CENTRE_IJK[None])[0]
    radius = np.linalg.norm(mesh.vertices - centre, axis=1)
    assert np.abs(radius - RADIUS_MM).max() <= tolerances.SPHERE_DISTANCE_FIELD_VOXEL * max(volume.spacing)


@pytest.mark.every_device
def test_surface_far_from_the_origin_equals_the_twin(device):
    volume = make_sphere(FAR, dtype="float32")
    mesh = extract_isosurface(volume, 0.0, device=device)
    vertices, normals, triangles = twin.extract_isosurface(volume, 0.0)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= tolerances.FAR_VERTEX_MM
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL


def test_slabs_of_a_far_volume_give_the_same_mesh(device):
    volume = make_sphere(FAR)
    whole = extract_isosurface(volume, 0.5, device=device)
    with clrecon.SurfaceExtractor(volume, device=device, memory=140_000) as extractor:
        assert extractor.forecast()["slabs"] > 1
        parts = extractor.extract(0.5)
    assert np.array_equal(whole.vertices, parts.vertices)
    assert np.array_equal(whole.triangles, parts.triangles)


def test_labels_far_from_the_origin_are_as_exact_as_near_it(device):
    volume, near = make_sphere(FAR), make_sphere()
    numbers = (volume.voxels > -500).astype(np.uint8)
    far_label = extract_labels(volume, LabelMap(numbers, volume.affine), 1, device=device)[1]
    near_label = extract_labels(near, LabelMap(numbers, near.affine), 1, device=device)[1]
    assert far_label.vertices.dtype == np.float64
    assert np.abs(far_label.vertices - FAR - near_label.vertices).max() <= tolerances.FAR_VERTEX_MM


STEP_BOUND_MM = 2.5e-4


def volume_that_reaches(height: float) -> Volume:
    """The sphere, shifted along z so that the volume with a voxel around it ends at this height, mm."""
    reach = make_sphere().ijk_to_lps(list(itertools.product((-1, 50), (-1, 40), (-1, 30))))[:, 2].max()
    return make_sphere((0.0, 0.0, height - reach))


def test_volumes_are_far_from_where_steps_of_float32_pass_their_bound():
    assert float32_step(FAR_MM - 1.0) < STEP_BOUND_MM < float32_step(FAR_MM)


@pytest.mark.parametrize(("more_mm", "has_origin"), [(-0.01, False), (0.01, True)], ids=["below", "beyond"])
def test_vertices_count_from_an_origin_near_a_volume_that_reaches_beyond_the_bound(more_mm, has_origin):
    assert (find_vertex_origin(volume_that_reaches(FAR_MM + more_mm)) is not None) == has_origin


def test_vertices_of_a_volume_below_the_bound_are_float32(device):
    below = volume_that_reaches(FAR_MM - 0.01)
    assert extract_isosurface(below, 0.5, device=device).vertices.dtype == np.float32


def test_vertices_of_a_volume_beyond_the_bound_are_float64_from_an_origin_of_whole_millimetres(device):
    beyond = make_sphere((0.0, 0.0, FAR_MM))  # the sphere too lies beyond, not its volume alone
    origin = find_vertex_origin(beyond)
    assert np.array_equal(origin, np.rint(origin))  # adding it is exact to 1e-11 mm
    assert extract_isosurface(beyond, 0.5, device=device).vertices.dtype == np.float64


@pytest.fixture(scope="module")
def near_and_far(device):
    """The surface of the sphere near the origin, and that of the one at `FAR`."""
    return tuple(extract_isosurface(make_sphere(shift), 0.5, device=device) for shift in ((0, 0, 0), FAR))


def refine(mesh: Mesh) -> Mesh:
    return clrecon.decimate_mesh(clrecon.smooth_mesh(mesh), fraction=0.7)


@pytest.mark.parametrize("change", [lambda mesh: mesh, refine], ids=["extracted", "refined"])
def test_a_far_mesh_has_the_measures_of_a_near_one(near_and_far, change):
    near, far = (change(mesh) for mesh in near_and_far)
    assert far.vertices.dtype == np.float64
    expected, found = near.quality(), far.quality()
    for name in ("volume_ml", "area_mm2"):
        assert found[name] == pytest.approx(expected[name], rel=1e-8), name  # measured 3e-9
    for name in ("closed", "manifold", "outward", "components", "zero_area_faces", "triangles"):
        assert found[name] == expected[name], name
    assert np.abs(np.subtract(found["bounds_mm"], expected["bounds_mm"]) - FAR).max() < 2e-6  # mm; measured 7e-7


def test_smoothing_moves_a_far_mesh_by_a_quarter_of_its_shortest_voxel_step_at_most(near_and_far):
    _, far = near_and_far
    distances = clrecon.compare_meshes(clrecon.smooth_mesh(far), far)
    assert 0.0 < distances["max_mm"] <= 0.25 * min(make_sphere(FAR).spacing)  # measured 0.04 of 0.126 mm


# --- files ---
@pytest.fixture(scope="module")
def far_mesh() -> Mesh:
    """The sphere at `FAR`, by the twin."""
    vertices, normals, triangles = twin.extract_isosurface(make_sphere(FAR), 0.5)
    return Mesh(vertices, triangles, normals)


def read_back(path, space):
    """Vertices in LPS mm, in the order of the file, and triangles, by other libraries than ours if they read it."""
    if path.suffix == ".vtp":
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

        reader = vtkXMLPolyDataReader()
        reader.SetFileName(str(path))
        reader.Update()
        points = vtk_to_numpy(reader.GetOutput().GetPoints().GetData())
        faces = vtk_to_numpy(reader.GetOutput().GetPolys().GetConnectivityArray()).reshape(-1, 3)
    elif path.suffix == ".html":
        points, _, faces = decode_surface(parse_page(path.read_bytes())[1])
        return points, faces  # of a page always in LPS; `space` is the frame of the places that it shows
    else:
        trimesh = pytest.importorskip("trimesh")
        scene = trimesh.load_scene(path, process=False, maintain_order=True).to_mesh()
        points, faces = np.asarray(scene.vertices), np.asarray(scene.faces)
    if path.suffix == ".glb":
        return 1000.0 * np.column_stack([points[:, 0], -points[:, 2], points[:, 1]]), faces
    return points * (1 if space == "lps" else np.array([-1, -1, 1])), faces


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", sorted(set(FORMATS) - {".stl", ".html"}))
def test_files_of_a_far_mesh_hold_its_vertices_exactly(far_mesh, extension, space, tmp_path):
    path = tmp_path / f"far{extension}"
    assert far_mesh.save(path, space) == path.stat().st_size
    points, faces = read_back(path, space)
    off = np.abs(points[faces] - far_mesh.vertices[far_mesh.triangles])
    assert off.max() <= tolerances.FAR_FILE_MM
    assert describe_rounding(far_mesh, extension) == []


@pytest.mark.parametrize("space", ["lps", "ras"])
def test_stl_of_a_far_mesh_is_rounded_to_float32_with_a_warning(far_mesh, space, tmp_path):
    """Of vertices that rounding joins one goes on by a step."""
    path = tmp_path / "far.stl"
    assert far_mesh.save(path, space) == path.stat().st_size
    points, faces = read_back(path, space)
    off = np.abs(points[faces] - far_mesh.vertices[far_mesh.triangles])
    joined = np.isin(far_mesh.triangles, find_coincident(far_mesh.vertices.astype(np.float32)))
    step = float32_step(1e5)
    assert off[~joined].max() <= 0.5 * step  # rounded to the nearest step
    assert off[joined].max(initial=0.0) <= 1.5 * step  # and one step on
    (warning,) = describe_rounding(far_mesh, ".stl")
    assert "steps of 0.0078 mm" in warning


@pytest.mark.parametrize("space", ["lps", "ras"])
def test_page_of_a_far_mesh_holds_its_vertices_to_a_micrometre(far_mesh, space, tmp_path):
    path = tmp_path / "far.html"
    assert far_mesh.save(path, space) == path.stat().st_size
    points, faces = read_back(path, space)
    off = np.abs(points[faces] - far_mesh.vertices[far_mesh.triangles])
    rounding_of_float64 = 1.001
    assert off.max() <= rounding_of_float64 * read_facts(path)["half_step_mm"] <= 0.001  # measured 0.00012 mm


@pytest.mark.parametrize(
    ("vertices", "dtype"),
    [
        ([[0.0, 0, 0], [4095.0, 0, 0], [0, 1, 0]], np.float32),
        ([[0.0, 0, 0], [-4096.0, 0, 0], [0, 1, 0]], np.float64),
        (np.float32([[0, 0, 0], [1e5, 0, 0], [0, 1, 0]]), np.float32),
    ],
    ids=["near", "far", "far, given as float32"],
)
def test_vertices_of_a_mesh_beyond_4096_mm_are_kept_in_float64_unless_given_in_float32(vertices, dtype):
    assert Mesh(vertices, [[0, 1, 2]]).vertices.dtype == dtype


def test_stl_of_a_near_mesh_has_no_warning():
    assert describe_rounding(Mesh([[0.0, 0, 0], [4095.0, 0, 0], [0, 1, 0]], [[0, 1, 2]]), ".stl") == []
