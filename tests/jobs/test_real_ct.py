"""The main job on real CT: the affine that independent readers agree on, and the surface that VTK finds."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tolerances
from scipy.spatial import cKDTree

from clrecon.geometry import AIR_HU
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.reading import read_volume

HU = 226

# (folder, origin, spacing) as two independent readers have them
SERIES = [
    ("lumbar_4p25mm", (-250.0, -250.0, -846.25), (0.976562, 0.976562, 4.25)),
    # every day this scan is meshed by the test below
    pytest.param("thoracic_0p8mm", (-169.399994, -165.0, -280.0), (0.644531, 0.644531, 0.8), marks=pytest.mark.release),
]


@cache
def contour_with_vtk(folder: Path) -> tuple[np.ndarray, np.ndarray, cKDTree]:
    """Flying edges over the same voxels in one layer of air, mapped through the same affine; once for all devices."""
    volume = read_volume(folder)
    pyvista = pytest.importorskip("pyvista")
    padded = np.pad(volume.voxels, 1, constant_values=AIR_HU)
    image = pyvista.ImageData(dimensions=padded.shape[::-1], origin=(-1, -1, -1))
    image["hu"] = padded.ravel()
    contour = image.contour([HU - 0.5], method="flying_edges", compute_normals=False, compute_scalars=False)
    points = volume.ijk_to_lps(contour.points)
    return points, contour.regular_faces, cKDTree(points)


def enclosed_ml(points: np.ndarray, faces: np.ndarray) -> float:
    """The volume within a closed mesh, in ml."""
    points = points - points.mean(axis=0)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6000.0)


@pytest.fixture(scope="module")
def mesh_of(real_data, device, tmp_path_factory):
    """A function that meshes a series once; returns the STL and the report."""

    @cache
    def make(folder):
        output = tmp_path_factory.mktemp("real") / "bone.stl"
        report = output.with_suffix(".json")
        make_mesh(real_data / folder, output, MeshSettings(iso_value=HU, device=device), report_path=report)
        return output, json.loads(report.read_text())

    return make


@pytest.mark.release
@pytest.mark.parametrize(("folder", "origin", "spacing"), SERIES, ids=["lumbar_4p25mm", "thoracic_0p8mm"])
def test_affine_of_a_real_series_is_that_of_independent_readers(mesh_of, folder, origin, spacing):
    _, report = mesh_of(folder)

    expected = np.diag((*spacing, 1.0))
    expected[:3, 3] = origin
    assert np.abs(np.array(report["affine_ijk_to_lps_mm"]) - expected).max() < 1e-5  # these have six decimals


@pytest.mark.release
@pytest.mark.parametrize(("folder", "origin", "spacing"), SERIES, ids=["lumbar_4p25mm", "thoracic_0p8mm"])
def test_mesh_of_a_real_series_is_closed_with_the_triangles_and_volume_of_vtk(
    real_data, mesh_of, folder, origin, spacing
):
    _, report = mesh_of(folder)

    points, faces, _ = contour_with_vtk(real_data / folder)
    assert report["closed"] and report["manifold"]
    assert report["triangles"] == len(faces)
    assert report["volume_ml"] == pytest.approx(enclosed_ml(points, faces), rel=tolerances.VTK_VOLUME)


@pytest.mark.release
@pytest.mark.parametrize(("folder", "origin", "spacing"), SERIES, ids=["lumbar_4p25mm", "thoracic_0p8mm"])
def test_vertices_of_a_real_series_lie_on_those_of_vtk(real_data, mesh_of, folder, origin, spacing):
    trimesh = pytest.importorskip("trimesh")
    output, _ = mesh_of(folder)

    points, _, points_tree = contour_with_vtk(real_data / folder)
    vertices = np.unique(trimesh.load_mesh(output, process=False).vertices, axis=0)
    most_mm = tolerances.VTK_SURFACE_HD95_VOXEL * min(spacing)
    # From vertex to vertex: no less than to the surface.
    assert np.percentile(points_tree.query(vertices)[0], 95) <= most_mm
    assert np.percentile(cKDTree(vertices).query(points)[0], 95) <= most_mm


@pytest.mark.release
def test_trilinear_topology_of_a_real_scan_is_closed_with_nearly_the_triangles_and_volume_of_the_default(
    real_data, device
):
    """The two differ in few cells."""
    volume = read_volume(real_data / "thoracic_0p8mm")

    separated, trilinear = (
        extract_isosurface(volume, HU, device=device, topology=topology).quality()
        for topology in ("separated", "trilinear")
    )

    assert trilinear["closed"] and trilinear["manifold"]
    assert trilinear["zero_area_faces"] == 0
    assert trilinear["euler_number"] != separated["euler_number"]
    assert trilinear["triangles"] == pytest.approx(separated["triangles"], rel=tolerances.TOPOLOGY_SHARE)
    assert trilinear["volume_ml"] == pytest.approx(separated["volume_ml"], rel=tolerances.TOPOLOGY_SHARE)
