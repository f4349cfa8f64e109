"""Table that touches bone is one component with it: warnings of ``keep="bone"`` say what takes it away first."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.jobs.mesh.bone import find_bone, judge_surfaces, warn_of_walls
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import Part, Surface
from clrecon.mesh import Mesh
from clrecon.mesh.compare.walls import WallLook
from clrecon.mesh.connectivity import label_components
from clrecon.proof.surface.extract import extract_isosurface


@pytest.mark.parametrize("without_table", [False, True])
def test_rails_that_are_left_out_are_warned_of(without_table):
    k, j, i = np.indices((36, 24, 36))
    hu = np.where((abs(i - 28) < 4) & (abs(j - 12) < 4), 1500.0, 0.0)
    hu[np.hypot(i - 11, j - 12) < 5 + 3 * np.sin(k / 4)] = 1000.0
    volume = Volume(np.rint(hu).astype(np.int16), np.diag((1.0, 1.0, 2.0, 1.0)))
    vertices, normals, triangles = extract_isosurface(volume, 300.0)
    report = {**choose_iso_rule(volume, 300.0).as_report(), "iso_level_hu": 299.5}
    mesh = Mesh(vertices, triangles, normals.astype(np.float32), report)
    labelled = label_components(mesh.triangles, mesh.vertex_count)
    bone = find_bone(mesh, volume, Surface(300.0, ""), labelled, without_table=without_table, advice="")
    assert bone.sum() == 1 and len(bone) == 2
    (said,) = mesh.report["warnings"]
    assert "1 component is as dense as bone but the same in all slices" in said and ": left out" in said
    assert ("remove_table=True" in said) != without_table


@pytest.mark.parametrize("remove_table", [False, True])
def test_walls_that_are_even_beneath_advise_to_remove_the_table(remove_table):
    walls = WallLook("bone", 0.5, 0.1, 0.0, {"median": 400.0, "p90": 900.0, "p99": 1200.0}, 1000)
    part = Part(Surface(300.0, ""), "", Mesh(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.uint32)))
    part.facts["walls"] = walls
    (said,) = warn_of_walls([part], MeshSettings(keep="bone", remove_table=remove_table))
    assert "about 10 % is even beneath" in said and "a higher iso value parts them" in said
    assert ("remove_table=True" in said) != remove_table


@pytest.mark.parametrize("failed", ["hu_known", "hu_scale", None])
def test_walls_are_judged_by_hu_where_values_are_hu(failed):
    """A plate of 380 is even beneath, as contrast medium is in HU; on another scale it may be bone."""
    voxels = np.zeros((40, 40, 40), np.int16)
    voxels[10:30, 10:30, 10:30] = 380
    volume = Volume(voxels, np.eye(4))
    if failed:
        volume.report["gates"] = [{"name": failed, "ok": False, "text": "no HU"}]
    vertices, normals, triangles = extract_isosurface(volume, 190.0)
    report = {**choose_iso_rule(volume, 190.0).as_report(), "iso_level_hu": 189.5}
    part = Part(Surface("", 190.0), "", Mesh(vertices, triangles, normals.astype(np.float32), report))
    settings = MeshSettings(half_way="auto")
    judge_surfaces([part], volume, settings, lambda mesh: label_components(mesh.triangles, mesh.vertex_count))
    said = warn_of_walls([part], settings)
    assert ([], None) == (said, part.facts["walls"]) if failed else "nothing here looks like bone" in said[0]


@pytest.mark.parametrize("failed", ["hu_known", None])
def test_bone_that_is_kept_by_values_that_are_no_hu_says_so(failed):
    hu = np.where(np.linalg.norm(np.indices((24, 24, 24)) - 11.5, axis=0) < 8, 1000, 0)
    volume = Volume(hu.astype(np.int16), np.eye(4))
    if failed:
        volume.report["gates"] = [{"name": failed, "ok": False, "text": "no HU"}]
    vertices, normals, triangles = extract_isosurface(volume, 500.0)
    report = {**choose_iso_rule(volume, 500.0).as_report(), "iso_level_hu": 499.5}
    mesh = Mesh(vertices, triangles, normals.astype(np.float32), report)
    labelled = label_components(mesh.triangles, mesh.vertex_count)
    assert find_bone(mesh, volume, Surface("", 500.0), labelled, advice="").tolist() == [True]
    said = mesh.report.get("warnings", [])
    assert ["bone was told by walls of 600 HU" in one and "(hu_known)" in one for one in said] == [True] * bool(failed)
