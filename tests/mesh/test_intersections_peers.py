"""Triangles that cut each other beside two peers: CGAL counts the same, TetGen takes a decimated surface."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh import Mesh
from clrecon.mesh.intersections import find_self_intersections
from clrecon.mesh.refine.decimation import decimate_mesh

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("seed", range(4))
def test_cgal_finds_the_same_pairs(seed):
    cgal = pytest.importorskip("igl.copyleft.cgal", reason="needs libigl with CGAL (GPL), not a dependency")
    random = np.random.default_rng(seed)
    places = random.uniform(0.0, 10.0, (50, 3)).astype(np.float32)
    triangles = np.array([random.choice(50, 3, replace=False) for _ in range(80)], np.uint32)
    theirs = cgal.remesh_self_intersections(places.astype(float), triangles.astype(np.int64), detect_only=True)[2]
    found = find_self_intersections(places, triangles)
    assert {tuple(sorted(pair)) for pair in found.tolist()} == {tuple(sorted(pair)) for pair in theirs.tolist()}
    assert len(found) > 100


def test_tetgen_fills_a_decimated_surface():
    tetgen = pytest.importorskip("tetgen", reason="needs TetGen (AGPL), not a dependency")
    vertices, triangles = samples.sphere((0, 0, 0), 1.0, 5)
    lengths = 20.0 + np.random.default_rng(1).normal(scale=0.1, size=len(vertices))
    small = decimate_mesh(Mesh(vertices * lengths[:, None], triangles), 0.9, 0.5)
    nodes, cells = tetgen.TetGen(small.vertices.astype(float), small.triangles.astype(np.int32)).tetrahedralize(
        plc=True, quality=False
    )[:2]
    volume = np.linalg.det(nodes[cells[:, 1:4]] - nodes[cells[:, :1]]).sum() / 6000.0
    assert abs(volume) == pytest.approx(small.quality()["volume_ml"], rel=1e-5)
