"""Gates: each fault fails its own gate and no other."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh import Mesh
from clrecon.mesh.compare.distances import compare_meshes
from clrecon.mesh.compare.mesh_gates import judge_label_volume, judge_mesh
from clrecon.mesh.triangles import enclosed_ml
from clrecon.system.records import Gate, failed_gates

pytestmark = pytest.mark.unit

NAMES = {"closed", "manifold", "oriented", "outward", "zero_area_faces", "duplicate_faces", "self_intersections"}


def failed(gates: list[dict]) -> set[str]:
    return {gate["name"] for gate in gates if gate["ok"] is False}


def of(arrays: samples.Arrays, closed: bool = True) -> list[Gate]:
    return judge_mesh(Mesh(*arrays).quality(), closed=closed)


def test_a_good_mesh_fails_none():
    gates = of(samples.torus())
    assert {gate["name"] for gate in gates} == NAMES
    assert failed(gates) == set()
    assert failed_gates(gates) == []
    assert all(set(gate) == {"name", "measured", "bound", "unit", "ok", "text"} for gate in gates)
    assert [gate["measured"] for gate in gates if gate["ok"] is None] == [None]  # self-intersections


def test_a_hole_fails_the_gate_closed_alone():
    vertices, triangles = samples.sphere()
    gates = of((vertices, np.delete(triangles, 17, axis=0)))
    assert failed(gates) == {"closed"}
    assert failed_gates(gates) == ["gate closed failed: edges with one triangle only: 3, none allowed"]
    assert failed(of((vertices, np.delete(triangles, 17, axis=0)), closed=False)) == set()


def test_an_open_surface_has_no_gate_on_what_it_encloses():
    vertices, triangles = samples.sphere()
    gates = of((vertices, triangles[1:, ::-1]), closed=False)
    assert failed(gates) == set()
    assert not {"closed", "outward"} & {gate["name"] for gate in gates}


def test_an_inside_out_mesh_fails_the_gate_outward_alone():
    vertices, triangles = samples.torus()
    inside_out = Mesh(vertices, triangles[:, ::-1]).quality()
    assert failed(judge_mesh(inside_out)) == {"outward"}
    assert failed(judge_mesh(inside_out, outward=False)) == set()


def test_a_flipped_face_fails_manifold_and_oriented():
    vertices, triangles = samples.torus()
    triangles[40] = triangles[40, ::-1]
    assert failed(of((vertices, triangles))) == {"manifold", "oriented"}


def test_a_shared_corner_fails_the_gate_manifold_alone():
    assert failed(of(samples.weld(samples.join(samples.box(), samples.box((1, 1, 1)))))) == {"manifold"}


def test_faces_without_area_and_doubled_faces_fail_their_gates():
    vertices, triangles = samples.box()
    flat = np.concatenate([vertices, vertices[:1]])
    assert failed(of((flat, np.concatenate([triangles, [[0, 8, 1], [8, 0, 1]]])))) >= {"zero_area_faces"}
    assert failed(of((vertices, np.concatenate([triangles, triangles[:1]])))) >= {"duplicate_faces"}


@pytest.mark.parametrize(
    ("radius", "expected"),
    [
        (10.004, set()),
        (10.012, set()),
        (9.98, {"volume_change"}),  # 0.6 % of volume
        (10.15, {"volume_change", "deviation_mean"}),
        (10.3, {"volume_change", "deviation_mean", "deviation_p95"}),
    ],
)
def test_deviation_fails_its_gates_by_its_size_in_voxels(radius, expected):
    one, other = (Mesh(*samples.sphere(radius=r, rounds=4)) for r in (radius, 10.0))
    gates = judge_mesh(deviation=compare_meshes(one, other, 2000), voxel_mm=1.0)
    assert len(gates) == 3
    assert failed(gates) == expected
    twice = judge_mesh(deviation=compare_meshes(one, other, 2000), voxel_mm=2.0, closed=False)
    assert failed(twice) == ({"deviation_mean"} if radius == 10.3 else set())


def test_vertices_off_the_iso_surface_fail_their_gates():
    def at(p95: float, mean: float) -> set[str]:
        return failed(judge_mesh(iso_distance={"surface_voxel": {"p95": p95, "mean": mean}, "not_found": 0}))

    assert (at(0.25, 0.1), at(0.26, 0.1), at(0.25, 0.11)) == (set(), {"iso_distance_p95"}, {"iso_distance_mean"})
    assert failed(judge_mesh(iso_distance={"surface_voxel": None, "not_found": 3})) == {"iso_distance_found"}
    rough = {"vertices_voxel": {"p95": 0.0, "mean": 0.0}, "surface_voxel": {"p95": 0.3, "mean": 0.2}, "not_found": 0}
    swapped = {"vertices_voxel": rough["surface_voxel"], "surface_voxel": rough["vertices_voxel"], "not_found": 0}
    assert failed(judge_mesh(iso_distance=rough, extracted=True)) == set() == failed(judge_mesh(iso_distance=rough))
    assert failed(judge_mesh(iso_distance=swapped)) == set() != failed(judge_mesh(iso_distance=swapped, extracted=True))


def test_distances_are_judged_away_from_metal_and_both_figures_are_said():
    figures = {"surface_voxel": {"p95": 0.3, "mean": 0.2}, "not_found": 0, "samples": {"vertices": 4000}}
    figures |= {"near_metal": 1500, "away_from_metal_voxel": {"p95": 0.2, "mean": 0.11}}
    _, p95, mean = judge_mesh(iso_distance=figures)
    assert (p95["measured"], p95["ok"], mean["measured"], mean["ok"]) == (0.2, True, 0.11, False)
    aside = "(without 1,500 of 4,000 vertices near metal (above 2000 HU), with them 0.3)"
    assert p95["text"].endswith(f", 95 % of it {aside}: 0.2 voxel, at most 0.25")
    _, p95, mean = judge_mesh(iso_distance={**figures, "near_metal": 2500, "away_from_metal_voxel": None})
    assert (p95["measured"], p95["ok"], mean["ok"]) == (0.3, False, False)
    assert "(2,500 of 4,000 vertices near metal (above 2000 HU))" in p95["text"]


def test_label_volume_fails_beyond_15_percent():
    assert judge_label_volume(24.0, 63.0, "fill it")["ok"] is False
    assert judge_label_volume(24.0, 63.0, "fill it")["text"] == (
        "the mesh has 24 ml, the label 63 ml (-61.9 %, at most 15 % either way): fill it"
    )
    near = judge_label_volume(63.0 * 1.149, 63.0, "fill it")
    assert near["ok"] is True and near["measured"] == pytest.approx(14.9) and "fill it" not in near["text"]
    assert judge_label_volume(63.0 * 1.151, 63.0)["ok"] is False
    assert judge_label_volume(None, 63.0)["ok"] is None


def test_enclosed_volume_is_that_of_the_quality():
    mesh = Mesh(*samples.torus())
    volume_ml = mesh.quality()["volume_ml"]
    assert enclosed_ml(mesh.vertices, mesh.triangles) == pytest.approx(volume_ml, rel=1e-12)
    assert enclosed_ml(mesh.vertices, mesh.triangles[:, ::-1]) == pytest.approx(-volume_ml, rel=1e-12)


def test_surface_that_joined_vertices_open_fails_the_gate_closed():
    gates = of(samples.join(samples.box(), samples.box((1, 1, 0))))
    assert failed(gates) == {"closed"}
    assert "once vertices at one place are joined" in failed_gates(gates)[0]


def test_points_that_reach_no_iso_surface_fail_their_gate():
    figures = {"mean": 0.01, "rms": 0.02, "p95": 0.03, "max": 0.1}
    for found, count in ((figures, 0), (figures, 1), (None, 20)):
        gates = judge_mesh(iso_distance={"surface_voxel": found, "not_found": count})
        assert [gate["name"] for gate in gates] == ["iso_distance_found", "iso_distance_p95", "iso_distance_mean"]
        assert failed(gates) == ({"iso_distance_found"} if count else set())
        assert gates[1]["ok"] is (True if found else None)


def test_what_was_not_measured_has_its_bound_and_no_gate_without_its_figure():
    not_looked_for = next(gate for gate in of(samples.box()) if gate["name"] == "self_intersections")
    assert (not_looked_for["bound"], not_looked_for["measured"], not_looked_for["unit"]) == (0, None, None)
    assert judge_mesh(voxel_mm=1.0) == []
    one = Mesh(*samples.box())
    assert judge_mesh(deviation=compare_meshes(one, one, 10)) == []
