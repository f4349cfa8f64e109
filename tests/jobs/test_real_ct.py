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
    points = points - points.mean(axis=0)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6000.0)


@pytest.mark.release
@pytest.mark.parametrize(("folder", "origin", "spacing"), SERIES, ids=["lumbar_4p25mm", "thoracic_0p8mm"])
def test_real_series_mesh_like_vtk_in_the_true_place(real_data, device, tmp_path, folder, origin, spacing):
    trimesh = pytest.importorskip("trimesh")
    output, report_path = tmp_path / "bone.stl", tmp_path / "report.json"
    make_mesh(real_data / folder, output, MeshSettings(iso_value=HU, device=device), report_path=report_path)
    report = json.loads(report_path.read_text())
    expected_affine = np.diag((*spacing, 1.0))
    expected_affine[:3, 3] = origin
    assert np.abs(np.array(report["affine_ijk_to_lps_mm"]) - expected_affine).max() < 1e-5
    assert report["closed"] and report["manifold"]

    points, faces, points_tree = contour_with_vtk(real_data / folder)
    written = trimesh.load_mesh(output, process=False)
    vertices = np.unique(written.vertices, axis=0)
    voxel = min(spacing)
    both_ways = [points_tree.query(vertices)[0], cKDTree(vertices).query(points)[0]]
    for distances in both_ways:  # vertex to vertex: no less than to the surface
        assert np.percentile(distances, 95) <= tolerances.VTK_SURFACE_HD95_VOXEL * voxel
    assert report["triangles"] == len(faces)
    assert report["volume_ml"] == pytest.approx(enclosed_ml(points, faces), rel=tolerances.VTK_VOLUME)


@pytest.mark.release
def test_real_ct_stays_sound_with_the_topology_of_the_trilinear_field(real_data, device):
    """Few cells differ: the two surfaces have nearly the same triangles and volume."""
    volume = read_volume(real_data / "thoracic_0p8mm")
    meshes = [
        extract_isosurface(volume, HU, device=device, topology=topology) for topology in ("separated", "trilinear")
    ]
    default, resolved = (mesh.quality() for mesh in meshes)
    assert resolved["closed"] and resolved["manifold"] and resolved["zero_area_faces"] == 0
    assert resolved["euler_number"] != default["euler_number"]
    assert resolved["triangles"] == pytest.approx(default["triangles"], rel=tolerances.TOPOLOGY_SHARE)
    assert resolved["volume_ml"] == pytest.approx(default["volume_ml"], rel=tolerances.TOPOLOGY_SHARE)
