"""Volumes far from the origin of their frame: right to 1e-3 mm at 1e5 mm and better, from the device to the file."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances

import clrecon
from clrecon.exchange.coordinates import find_coincident
from clrecon.exchange.formats import FORMATS, describe_rounding
from clrecon.exchange.page import decode_surface, parse_page, read_facts
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
def test_vertices_are_those_at_the_origin_and_the_shift(device, shift, topology):
    near = extract_isosurface(make_sphere(), 0.5, device=device, topology=topology)
    far = extract_isosurface(make_sphere(shift), 0.5, device=device, topology=topology)
    assert (near.vertices.dtype, far.vertices.dtype) == (np.float32, np.float64)
    assert np.array_equal(near.triangles, far.triangles)
    assert np.array_equal(near.normals, far.normals)
    assert np.abs(far.vertices - shift - near.vertices).max() <= tolerances.FAR_VERTEX_MM
    assert [text for text in far.report["warnings"] if "vertices are float64" in text]
    assert not [text for text in near.report["warnings"] if "float64" in text]


@pytest.mark.every_device
def test_vertices_lie_on_the_sphere_and_on_the_twin(device):
    volume = make_sphere(FAR, "float32")
    mesh = extract_isosurface(volume, 0.0, device=device)
    centre = volume.ijk_to_lps(CENTRE_IJK[None])[0]
    radius = np.linalg.norm(mesh.vertices - centre, axis=1)
    assert np.abs(radius - RADIUS_MM).max() <= tolerances.SPHERE_DISTANCE_FIELD_VOXEL * max(volume.spacing)
    vertices, normals, triangles = twin.extract_isosurface(volume, 0.0)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= tolerances.FAR_VERTEX_MM
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL


def test_slabs_give_the_same_mesh(device):
    volume = make_sphere(FAR)
    whole = extract_isosurface(volume, 0.5, device=device)
    with clrecon.SurfaceExtractor(volume, device=device, memory=140_000) as extractor:
        assert extractor.forecast()["slabs"] > 1
        parts = extractor.extract(0.5)
    assert np.array_equal(whole.vertices, parts.vertices) and np.array_equal(whole.triangles, parts.triangles)


def test_labels_far_from_the_origin_are_as_exact_as_near_it(device):
    volume, near = make_sphere(FAR), make_sphere()
    numbers = (volume.voxels > -500).astype(np.uint8)
    far_label = extract_labels(volume, LabelMap(numbers, volume.affine), 1, device=device)[1]
    near_label = extract_labels(near, LabelMap(numbers, near.affine), 1, device=device)[1]
    assert far_label.vertices.dtype == np.float64
    assert np.abs(far_label.vertices - FAR - near_label.vertices).max() <= tolerances.FAR_VERTEX_MM


def test_the_bound_is_where_steps_of_float32_pass_it(device):
    """A volume that stays below 4096 mm with its border keeps the path, and the bits, that it had."""
    volume = make_sphere()
    reach = np.abs(volume.ijk_to_lps([(-1, -1, -1), (50, 40, 30)])).max()
    below = make_sphere((0.0, 0.0, FAR_MM - reach - 40.0))
    above = make_sphere((0.0, 0.0, FAR_MM))
    assert find_vertex_origin(below) is None and find_vertex_origin(above) is not None
    assert float32_step(FAR_MM - 1.0) < 2.5e-4 < float32_step(FAR_MM)
    assert extract_isosurface(below, 0.5, device=device).vertices.dtype == np.float32
    assert extract_isosurface(above, 0.5, device=device).vertices.dtype == np.float64
    origin = find_vertex_origin(above)
    assert np.array_equal(origin, np.rint(origin))  # whole mm: adding it is exact to 1e-11 mm


def test_far_meshes_are_measured_and_refined_as_near_ones(device):
    near, far = (extract_isosurface(make_sphere(shift), 0.5, device=device) for shift in ((0, 0, 0), FAR))
    for one, other in ((near, far), *([(clrecon.decimate_mesh(clrecon.smooth_mesh(m), 0.7) for m in (near, far))])):
        assert other.vertices.dtype == np.float64
        expected, found = one.quality(), other.quality()
        for name in ("volume_ml", "area_mm2"):
            assert found[name] == pytest.approx(expected[name], rel=1e-6), name
        for name in ("closed", "manifold", "outward", "components", "zero_area_faces", "triangles"):
            assert found[name] == expected[name], name
        assert np.abs(np.subtract(found["bounds_mm"], expected["bounds_mm"]) - FAR).max() < 1e-3
    parts = clrecon.compare_meshes(clrecon.smooth_mesh(far), far)
    assert 0.0 < parts["max_mm"] <= 0.25 * 0.51


# --- files ---
@pytest.fixture(scope="module")
def far_mesh() -> Mesh:
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
@pytest.mark.parametrize("extension", sorted(FORMATS))
def test_files_hold_what_the_mesh_does(far_mesh, extension, space, tmp_path):
    path = tmp_path / f"far{extension}"
    assert far_mesh.vertices.dtype == np.float64
    assert far_mesh.save(path, space) == path.stat().st_size
    points, faces = read_back(path, space)
    warnings = describe_rounding(far_mesh, extension)
    expected = far_mesh.vertices[far_mesh.triangles]
    off = np.abs(points[faces] - expected)
    if extension == ".stl":
        meeting = np.isin(far_mesh.triangles, find_coincident(far_mesh.vertices.astype(np.float32)))
        assert off[~meeting].max() <= 0.5 * float32_step(1e5)
        assert off[meeting].max(initial=0.0) <= 1.5 * float32_step(1e5)  # rounding joins them: one goes on by a step
        assert "steps of 0.0078 mm" in warnings[0]
    elif extension == ".html":
        assert off.max() <= 1.001 * read_facts(path)["half_step_mm"] <= 0.001
    else:
        assert off.max() <= tolerances.FAR_FILE_MM
        assert warnings == []


def test_near_meshes_have_no_warning_and_float32():
    mesh = Mesh([[0.0, 0, 0], [4095.0, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    assert mesh.vertices.dtype == np.float32 and describe_rounding(mesh, ".stl") == []
    assert Mesh(np.float32([[0, 0, 0], [1e5, 0, 0], [0, 1, 0]]), [[0, 1, 2]]).vertices.dtype == np.float32
    assert Mesh([[0.0, 0, 0], [-4096.0, 0, 0], [0, 1, 0]], [[0, 1, 2]]).vertices.dtype == np.float64
