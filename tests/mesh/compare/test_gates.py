"""Gates: which of them a fault fails, and what they say."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances

from clrecon.mesh import Mesh
from clrecon.mesh.compare.distances import MeshDistance, compare_meshes
from clrecon.mesh.compare.mesh_gates import judge_label_volume, judge_mesh
from clrecon.mesh.triangles import enclosed_ml
from clrecon.system.records import Gate, failed_gates

pytestmark = pytest.mark.unit

NAMES = {"closed", "manifold", "oriented", "outward", "zero_area_faces", "duplicate_faces", "self_intersections"}


def names_of_failed(gates: list[Gate]) -> set[str]:
    return {gate["name"] for gate in gates if gate["ok"] is False}


def judge_quality(arrays: samples.Arrays, closed: bool = True) -> list[Gate]:
    """The gates of the quality of a mesh of these vertices and triangles."""
    return judge_mesh(Mesh(*arrays).quality(), closed=closed)


def sphere_with_a_hole() -> samples.Arrays:
    vertices, triangles = samples.sphere()
    return vertices, np.delete(triangles, 17, axis=0)  # 17: any face


def test_a_sound_mesh_passes_every_gate_of_quality_that_was_measured():
    gates = judge_quality(samples.torus())
    assert {gate["name"] for gate in gates} == NAMES
    assert failed_gates(gates) == []
    assert [gate["name"] for gate in gates if gate["ok"] is not True] == ["self_intersections"]  # not looked for


def test_a_gate_has_name_measure_bound_unit_verdict_and_text():
    for gate in (gates := judge_quality(samples.torus())):
        assert set(gate) == {"name", "measured", "bound", "unit", "ok", "text"}
    assert len(gates) == len(NAMES)


def test_a_hole_fails_the_gate_closed_alone_and_says_how_many_edges_are_open():
    gates = judge_quality(sphere_with_a_hole())
    assert names_of_failed(gates) == {"closed"}
    assert failed_gates(gates) == ["gate closed failed: edges with one triangle only: 3, none allowed"]


def test_a_hole_fails_no_gate_where_the_surface_may_be_open():
    assert names_of_failed(judge_quality(sphere_with_a_hole(), closed=False)) == set()


def test_a_surface_that_may_be_open_has_no_gates_on_being_closed_and_outward():
    vertices, triangles = sphere_with_a_hole()
    gates = judge_quality((vertices, triangles[:, ::-1]), closed=False)
    assert {gate["name"] for gate in gates} == NAMES - {"closed", "outward"}
    assert names_of_failed(gates) == set()


def test_an_inside_out_mesh_fails_the_gate_outward_alone():
    vertices, triangles = samples.torus()
    assert names_of_failed(judge_quality((vertices, triangles[:, ::-1]))) == {"outward"}


def test_an_inside_out_mesh_passes_where_it_may_be_the_wall_of_a_cavity():
    vertices, triangles = samples.torus()
    inside_out = Mesh(vertices, triangles[:, ::-1]).quality()
    assert names_of_failed(judge_mesh(inside_out, outward=False)) == set()


def test_a_flipped_face_fails_the_gates_manifold_and_oriented():
    vertices, triangles = samples.torus()
    triangles[40] = triangles[40, ::-1]  # 40: any face
    assert names_of_failed(judge_quality((vertices, triangles))) == {"manifold", "oriented"}


def test_two_boxes_that_share_one_vertex_fail_the_gate_manifold_alone():
    boxes = samples.weld(samples.join(samples.box(), samples.box((1, 1, 1))))
    assert names_of_failed(judge_quality(boxes)) == {"manifold"}


def test_faces_without_area_fail_their_gate():
    vertices, triangles = samples.box()
    with_corner_0_again = np.concatenate([vertices, vertices[:1]])
    flat = [[0, 8, 1], [8, 0, 1]]
    gates = judge_quality((with_corner_0_again, np.concatenate([triangles, flat])))
    assert "zero_area_faces" in names_of_failed(gates)


def test_a_face_that_is_there_twice_fails_its_gate():
    vertices, triangles = samples.box()
    gates = judge_quality((vertices, np.concatenate([triangles, triangles[:1]])))
    assert "duplicate_faces" in names_of_failed(gates)


def compare_spheres(*, radius_mm: float) -> MeshDistance:
    """A sphere against one of 10 mm about the same centre."""
    sphere, reference = (Mesh(*samples.sphere(radius=radius, rounds=4)) for radius in (radius_mm, 10.0))
    return compare_meshes(sphere, reference, samples=2000)


@pytest.mark.parametrize(
    ("radius_mm", "failing"),
    [
        (10.004, set()),
        (10.012, set()),
        (9.98, {"volume_change"}),
        (10.15, {"volume_change", "deviation_mean"}),
        (10.3, {"volume_change", "deviation_mean", "deviation_p95"}),
    ],
    ids=["0.1 % of volume", "0.4 % of volume", "0.6 % of volume", "0.15 mm", "0.3 mm"],
)
def test_deviation_fails_the_gates_whose_bounds_it_exceeds(radius_mm, failing):
    """0.5 % of volume; in voxels of 1 mm a mean of 0.1 mm, and 0.25 mm for 95 %."""
    gates = judge_mesh(deviation=compare_spheres(radius_mm=radius_mm), voxel_mm=1.0)
    assert {gate["name"] for gate in gates} == {"volume_change", "deviation_mean", "deviation_p95"}
    assert names_of_failed(gates) == failing


@pytest.mark.parametrize(("voxel_mm", "failing"), [(2.0, {"deviation_mean"}), (4.0, set())])
def test_bounds_of_deviation_grow_with_the_voxel_and_an_open_surface_has_none_on_volume(voxel_mm, failing):
    """0.3 mm are 0.15 and 0.075 voxels."""
    gates = judge_mesh(deviation=compare_spheres(radius_mm=10.3), voxel_mm=voxel_mm, closed=False)
    assert names_of_failed(gates) == failing


@pytest.mark.parametrize(
    ("p95", "mean", "failing"),
    [(0.25, 0.1, set()), (0.26, 0.1, {"iso_distance_p95"}), (0.25, 0.11, {"iso_distance_mean"})],
    ids=["at both bounds", "95 % beyond", "mean beyond"],
)
def test_distance_from_the_iso_surface_fails_the_gate_whose_bound_it_exceeds(p95, mean, failing):
    measured = {"surface_voxel": {"p95": p95, "mean": mean}, "not_found": 0}
    assert names_of_failed(judge_mesh(iso_distance=measured)) == failing


EXACT, ROUGH = {"p95": 0.0, "mean": 0.0}, {"p95": 0.3, "mean": 0.2}


@pytest.mark.parametrize(
    ("vertices", "surface", "extracted", "fails"),
    [
        (EXACT, ROUGH, True, False),
        (EXACT, ROUGH, False, False),
        (ROUGH, EXACT, False, False),
        (ROUGH, EXACT, True, True),
    ],
    ids=["exact vertices, extracted", "exact vertices, refined", "exact surface, refined", "rough vertices, extracted"],
)
def test_an_extracted_mesh_is_judged_by_its_vertices_and_a_refined_one_by_what_lies_nearer(
    vertices, surface, extracted, fails
):
    """Flat triangles leave out noise of the voxels; few triangles have vertices off what is round."""
    measured = {"vertices_voxel": vertices, "surface_voxel": surface, "not_found": 0}
    assert bool(names_of_failed(judge_mesh(iso_distance=measured, extracted=extracted))) == fails


NEAR_METAL = {
    "surface_voxel": {"p95": 0.3, "mean": 0.2},
    "not_found": 0,
    "near_metal_share": 0.375,
    "away_from_metal_voxel": {"p95": 0.2, "mean": 0.11},
}


def test_distances_away_from_metal_are_judged_and_those_with_it_are_said():
    _, p95, mean = judge_mesh(iso_distance=NEAR_METAL)
    assert (p95["measured"], p95["ok"]) == (0.2, True)
    assert (mean["measured"], mean["ok"]) == (0.11, False)
    with_metal = "(without 38 % of the surface near metal (above 2000 HU), with it 0.3)"
    assert p95["text"].endswith(f", 95 % of it {with_metal}: 0.2 voxel, at most 0.25")


def test_a_mesh_mostly_near_metal_is_judged_whole_and_the_share_near_metal_is_said():
    mostly = {**NEAR_METAL, "near_metal_share": 0.625, "away_from_metal_voxel": None}
    _, p95, mean = judge_mesh(iso_distance=mostly)
    assert (p95["measured"], p95["ok"], mean["ok"]) == (0.3, False, False)
    assert "(62 % of the surface near metal (above 2000 HU))" in p95["text"]


LABEL_ML = 63.0


@pytest.mark.parametrize(
    ("mesh_ml", "ok"),
    [(LABEL_ML * 0.851, True), (LABEL_ML * 0.849, False), (LABEL_ML * 1.149, True), (LABEL_ML * 1.151, False)],
)
def test_label_volume_fails_beyond_15_percent_either_way(mesh_ml, ok):
    assert judge_label_volume(mesh_ml, LABEL_ML)["ok"] is ok


def test_the_gate_on_label_volume_measures_the_change_in_percent():
    assert judge_label_volume(LABEL_ML * 1.149, LABEL_ML)["measured"] == pytest.approx(14.9)


def test_a_failed_gate_on_label_volume_says_both_volumes_and_the_advice():
    gate = judge_label_volume(24.0, LABEL_ML, advice="fill it")
    assert gate["text"] == "the mesh has 24 ml, the label 63 ml (-61.9 %, at most 15 % either way): fill it"


def test_a_passed_gate_on_label_volume_gives_no_advice():
    assert "fill it" not in judge_label_volume(LABEL_ML, LABEL_ML, advice="fill it")["text"]


def test_label_volume_of_an_open_mesh_is_not_judged():
    assert judge_label_volume(None, LABEL_ML)["ok"] is None


def test_enclosed_volume_is_that_of_the_quality_and_negative_inside_out():
    mesh = Mesh(*samples.torus())
    volume_ml = pytest.approx(mesh.quality()["volume_ml"], rel=tolerances.FLOAT64_SHARE)
    assert enclosed_ml(mesh.vertices, mesh.triangles) == volume_ml
    assert -enclosed_ml(mesh.vertices, mesh.triangles[:, ::-1]) == volume_ml


def test_closed_boxes_that_are_open_once_joined_along_an_edge_fail_the_gate_closed_alone():
    gates = judge_quality(samples.join(samples.box(), samples.box((1, 1, 0))))
    assert names_of_failed(gates) == {"closed"}
    (text,) = failed_gates(gates)
    assert "once vertices at one place are joined" in text


MEASURED = {"mean": 0.01, "rms": 0.02, "p95": 0.03, "max": 0.1}


@pytest.mark.parametrize(
    ("surface", "not_found", "verdicts"),
    [(MEASURED, 0, [True, True, True]), (MEASURED, 1, [False, True, True]), (None, 20, [False, None, None])],
    ids=["all reach it", "one does not", "none does"],
)
def test_a_point_that_reaches_no_iso_surface_fails_the_gate_on_finding_it_alone(surface, not_found, verdicts):
    gates = judge_mesh(iso_distance={"surface_voxel": surface, "not_found": not_found})
    assert [gate["name"] for gate in gates] == ["iso_distance_found", "iso_distance_p95", "iso_distance_mean"]
    assert [gate["ok"] for gate in gates] == verdicts


def test_a_gate_that_was_not_measured_has_its_bound_alone():
    (not_looked_for,) = (gate for gate in judge_quality(samples.box()) if gate["name"] == "self_intersections")
    assert (not_looked_for["bound"], not_looked_for["measured"], not_looked_for["unit"]) == (0, None, None)


def test_a_voxel_length_without_a_deviation_has_no_gate():
    assert judge_mesh(voxel_mm=1.0) == []


def test_a_deviation_without_a_voxel_length_has_no_gate():
    assert judge_mesh(deviation=compare_spheres(radius_mm=10.3)) == []
