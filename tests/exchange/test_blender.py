"""Blender, as its Python package bpy, imports a GLB of clrecon in place and in its true size."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from clrecon.mesh import Mesh

IMPORTING = """
import sys
import bpy
import numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
[bone] = [each for each in bpy.data.objects if each.type == "MESH"]
places = np.array([bone.matrix_world @ vertex.co for vertex in bone.data.vertices])
np.savez(sys.argv[2], places=places, triangles=[list(each.vertices) for each in bone.data.polygons])
"""


@pytest.mark.release
@pytest.mark.skipif(find_spec("bpy") is None, reason="bpy, Blender as a package, is not installed")
def test_blender_has_each_vertex_of_a_glb_in_place_in_metres(tmp_path: Path) -> None:
    mesh = Mesh(
        [[-46.2, -174.2, -442.4], [41.7, -90.2, -398.7], [10.0, -120.0, -380.0], [0.0, -100.0, -440.0]],
        [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
    )
    mesh.save(tmp_path / "bone.glb")

    subprocess.run([sys.executable, "-c", IMPORTING, tmp_path / "bone.glb", tmp_path / "seen.npz"], check=True)

    seen = np.load(tmp_path / "seen.npz")
    assert 1000.0 * seen["places"] == pytest.approx(mesh.vertices, abs=1e-3)  # float32 of metres: 3e-5 mm
    assert np.array_equal(np.sort(seen["triangles"]), np.sort(mesh.triangles))
