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


def make_mesh_of(volume: Volume, *, iso_value: float) -> Mesh:
    """The surface of a volume of whole HU, as a job has it."""
    vertices, normals, triangles = extract_isosurface(volume, iso_value)
    report = {**choose_iso_rule(volume, iso_value).as_report(), "iso_level_hu": iso_value - 0.5}
    return Mesh(vertices, triangles, normals.astype(np.float32), report)


@pytest.mark.parametrize("without_table", [False, True], ids=["table there", "table taken away"])
def test_rail_left_out_as_no_bone_is_warned_of_with_remove_table_where_the_table_is_there(without_table):
    k, j, i = np.indices((36, 24, 36))
    hu = np.where((abs(i - 28) < 4) & (abs(j - 12) < 4), 1500.0, 0.0)  # a rail, the same in all slices
    hu[np.hypot(i - 11, j - 12) < 5 + 3 * np.sin(k / 4)] = 1000.0  # bone, a rod of changing radius
    volume = Volume(np.rint(hu).astype(np.int16), np.diag((1.0, 1.0, 2.0, 1.0)))
    mesh = make_mesh_of(volume, iso_value=300.0)
    labelled = label_components(mesh.triangles, mesh.vertex_count)

    surface = Surface(name="", iso_value=300.0)
    is_bone = find_bone(mesh, volume, surface, labelled, without_table=without_table, advice="")

    assert sorted(is_bone) == [False, True]
    (warning,) = mesh.report["warnings"]
    assert "1 component is as dense as bone but the same in all slices" in warning
    assert ": left out" in warning
    assert ("remove_table=True" in warning) != without_table


@pytest.mark.parametrize("remove_table", [False, True])
def test_bone_with_even_walls_is_warned_of_with_remove_table_where_it_is_not_set(remove_table):
    wall_hu = {"median": 400.0, "p90": 900.0, "p99": 1200.0}
    tenth_even = WallLook("bone", 0.5, contrast_share=0.1, metal_share=0.0, wall_hu=wall_hu, samples=1000)
    no_mesh = Mesh(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.uint32))
    part = Part(Surface(name="", iso_value=300.0), name="", mesh=no_mesh)
    part.facts["walls"] = tenth_even

    (warning,) = warn_of_walls([part], MeshSettings(keep="bone", remove_table=remove_table))

    assert "about 10 % is even beneath" in warning
    assert "a higher iso value parts them" in warning
    assert ("remove_table=True" in warning) != remove_table


FAILED_GATE = {"name": "hu_known", "ok": False, "text": "no HU"}


def judge_walls_of_a_block(gates: list[dict]) -> tuple[Part, list[str]]:
    """Judge the surface of an even block of 380 in a volume with these gates; return it and the warnings."""
    voxels = np.zeros((40, 40, 40), np.int16)
    voxels[10:30, 10:30, 10:30] = 380
    volume = Volume(voxels, np.eye(4), {"gates": gates})
    part = Part(Surface(name="", iso_value=190.0), name="", mesh=make_mesh_of(volume, iso_value=190.0))
    settings = MeshSettings(half_way="auto")
    judge_surfaces([part], volume, settings, lambda part: label_components(part.mesh.triangles, part.mesh.vertex_count))
    return part, warn_of_walls([part], settings)


def test_even_block_of_380_hu_is_warned_of_as_no_bone():
    _, warnings = judge_walls_of_a_block(gates=[])
    (warning,) = warnings
    assert "nothing here looks like bone" in warning


@pytest.mark.parametrize("name", ["hu_known", "hu_scale"])
def test_even_block_is_not_judged_where_values_are_not_known_to_be_hu(name):
    """On another scale 380 may be bone."""
    part, warnings = judge_walls_of_a_block(gates=[{**FAILED_GATE, "name": name}])

    assert part.facts["walls"] is None
    assert warnings == []


def keep_bone_of_a_ball(gates: list[dict]) -> tuple[list[bool], list[str]]:
    """Find bone in a ball of 1000 in a volume with these gates; return which components are bone, and the warnings."""
    hu = np.where(np.linalg.norm(np.indices((24, 24, 24)) - 11.5, axis=0) < 8, 1000, 0)
    volume = Volume(hu.astype(np.int16), np.eye(4), {"gates": gates})
    mesh = make_mesh_of(volume, iso_value=500.0)
    labelled = label_components(mesh.triangles, mesh.vertex_count)
    is_bone = find_bone(mesh, volume, Surface(name="", iso_value=500.0), labelled, advice="")
    return is_bone.tolist(), mesh.report.get("warnings", [])


def test_bone_kept_by_values_that_are_not_known_to_be_hu_is_warned_of():
    is_bone, (warning,) = keep_bone_of_a_ball(gates=[FAILED_GATE])

    assert is_bone == [True]
    assert "bone was told by walls of 600 HU" in warning
    assert "(hu_known)" in warning


def test_bone_kept_by_hu_has_no_warning():
    assert keep_bone_of_a_ball(gates=[]) == ([True], [])
