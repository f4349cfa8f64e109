"""Values at vertices, such as thickness and error, of smoothed and decimated meshes."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh import Mesh
from clrecon.mesh.refine.quadric import collapse_quadric
from clrecon.mesh.refine.smoothing import smooth_mesh
from clrecon.mesh.triangles import vertex_normals
from clrecon.operators.surface.decimation import decimate_mesh

pytestmark = pytest.mark.unit


@pytest.mark.parametrize(
    "refine",
    [
        pytest.param(lambda mesh: smooth_mesh(mesh, max_deviation_mm=0.05), id="smooth"),
        pytest.param(lambda mesh: decimate_mesh(mesh, 0.7, 0.05), id="decimate"),
        pytest.param(lambda mesh: collapse_quadric(mesh, 0.7), id="quadric"),
    ],
)
def test_vertices_of_a_refined_mesh_have_the_values_of_their_place(refine):
    mesh = Mesh(*samples.ball(10.0, rings=40))
    mesh.values = {"thickness_mm": (5.0 + mesh.vertices[:, 2] / 10.0).astype(np.float32)}
    refined = refine(mesh)
    # edges of the ball are below 2 mm long, and the value changes by 0.1 a millimetre
    np.testing.assert_allclose(refined.values["thickness_mm"], 5.0 + refined.vertices[:, 2] / 10.0, atol=0.1)


def test_the_error_of_a_refined_vertex_grows_by_its_way_along_the_normal():
    vertices, triangles = samples.ball(10.0, rings=40)
    rough = Mesh(vertices * (1.0 + 0.02 * (np.arange(len(vertices)) % 2))[:, None], triangles)
    errors = np.full(len(vertices), 0.03, np.float32)
    errors[0] = np.nan  # no bone there
    rough.values = {"error_mm": errors}
    smoothed = smooth_mesh(rough, max_deviation_mm=0.2)
    ways = ((smoothed.vertices - rough.vertices) * vertex_normals(rough.vertices, rough.triangles)).sum(axis=1)
    assert np.abs(ways).max() > 0.1
    np.testing.assert_allclose(smoothed.values["error_mm"][1:], np.hypot(0.03, ways[1:]), rtol=1e-5)
    assert np.isnan(smoothed.values["error_mm"][0])
