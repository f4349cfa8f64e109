"""Triangles that cut each other beside two peers: CGAL counts the same, TetGen takes a decimated surface."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances

from clrecon.mesh import Mesh
from clrecon.mesh.intersections import find_self_intersections
from clrecon.mesh.refine.decimation import decimate_mesh

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("seed", range(4))
def test_cgal_finds_the_same_pairs_of_triangles_that_cut_each_other(seed):
    cgal = pytest.importorskip("igl.copyleft.cgal", reason="needs libigl with CGAL (GPL), not a dependency")
    random = np.random.default_rng(seed)
    vertices = random.uniform(0.0, 10.0, (50, 3)).astype(np.float32)
    triangles = np.array([random.choice(50, 3, replace=False) for _ in range(80)], np.uint32)

    corners = triangles.astype(np.int64)
    _, _, theirs, *_ = cgal.remesh_self_intersections(vertices.astype(float), corners, detect_only=True)
    ours = find_self_intersections(vertices, triangles)

    assert len(ours) > 100  # pairs; measured 672 to 871
    assert {frozenset(pair) for pair in ours.tolist()} == {frozenset(pair) for pair in theirs.tolist()}


def test_tetgen_fills_a_decimated_surface_with_tetrahedra_of_its_volume():
    """TetGen refuses a surface whose triangles cut each other."""
    tetgen = pytest.importorskip("tetgen", reason="needs TetGen (AGPL), not a dependency")
    vertices, triangles = samples.sphere(radius=1.0, rounds=5)
    radii = 20.0 + np.random.default_rng(1).normal(scale=0.1, size=len(vertices))
    small = decimate_mesh(Mesh(vertices * radii[:, None], triangles), fraction=0.9, max_deviation_mm=0.5)

    generator = tetgen.TetGen(small.vertices.astype(float), small.triangles.astype(np.int32))
    nodes, tetrahedra = generator.tetrahedralize(plc=True, quality=False)[:2]

    edges = nodes[tetrahedra[:, 1:4]] - nodes[tetrahedra[:, :1]]
    volume_ml = abs(np.linalg.det(edges).sum()) / 6 / 1000  # a tetrahedron is a sixth of its parallelepiped
    assert volume_ml == pytest.approx(small.quality()["volume_ml"], rel=tolerances.PEER_MEASURE)
