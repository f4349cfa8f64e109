"""Surfaces moved onto the bone: where they lie, that nothing breaks, what is said and written of them."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from refusals import refused
from scipy.special import ndtr
from surface_volumes import MIDDLE, hollow_ball

import clrecon
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.make import _try_steps
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.mesh.connectivity import Fans
from clrecon.mesh.intersections import find_self_intersections
from clrecon.opencl import Stopwatch
from clrecon.opencl.launching import launch
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface import cortex, decimation
from clrecon.operators.surface.cortex_fit import BADLY_FITTED, FITTED, NOT_BONE, CortexFit, fit_walls
from clrecon.operators.surface.cortex_mesh import calm_vertices, choose_shifts, doubt_lone_vertices, find_turned
from clrecon.operators.surface.extract import extract_isosurface

RADIUS = 13.0  # of the outer surface of the shell, mm


@pytest.fixture(scope="module")
def shell() -> Volume:
    """A shell of bone 3 mm thick with its outer surface at 13 mm, blurred by 0.7 mm, with noise of 20 HU."""
    k, j, i = np.indices((38, 40, 41))
    far = np.sqrt((i - MIDDLE[0]) ** 2 + (j - MIDDLE[1]) ** 2 + (k - MIDDLE[2]) ** 2)
    outer, inner = ndtr((far - RADIUS) / 0.7), ndtr((RADIUS - 3.0 - far) / 0.7)
    values = 50.0 * outer + 200.0 * inner + 1000.0 * (1.0 - outer - inner)
    values += np.random.default_rng(3).normal(0.0, 20.0, far.shape)
    return Volume(np.rint(values).astype(np.int16), np.eye(4))


@pytest.fixture(scope="module")
def level_mesh(shell, device):
    """The surface of the shell at 300 HU, which lies outside of the bone."""
    return extract_isosurface(shell, 300.0, device=device).keep_largest()


@pytest.fixture(scope="module")
def fitted(level_mesh, shell, device):
    """The same, moved onto the bone."""
    return clrecon.fit_cortex(level_mesh, shell, device=device)


def from_bone(mesh) -> np.ndarray:
    """Signed distances of the vertices from the outer surface of the shell, mm."""
    return np.linalg.norm(mesh.vertices - MIDDLE, axis=1) - RADIUS


def test_fitted_surface_lies_on_the_bone_and_that_of_a_level_outside(level_mesh, fitted):
    assert from_bone(level_mesh).mean() > 0.3  # mm; measured 0.48
    # Blur moves the edge of a ball inwards by its variance over the radius; that of interpolation is a sixth.
    assert from_bone(fitted).mean() == pytest.approx(-1.0 / 6.0 / RADIUS, abs=0.02)  # mm; measured 0.007 off
    assert np.abs(from_bone(fitted)).mean() < 0.1  # mm; measured 0.04


def test_fitted_surface_knows_the_thickness_of_its_wall(fitted):
    assert np.median(fitted.values["thickness_mm"]) == pytest.approx(3.0, abs=0.3)  # mm; measured 2.92


def test_errors_of_a_fitted_surface_hold_93_percent_of_its_distances_from_the_bone(fitted):
    """Standard errors: 1.96 of them hold 95 % of a normal distribution."""
    assert (np.abs(from_bone(fitted)) < 1.96 * fitted.values["error_mm"]).mean() > 0.93  # measured 1


def test_errors_of_a_block_hold_three_quarters_of_the_distances_at_its_rims(device):
    """Blur rounds the rims of bone of 16 mm; a fit along one normal sees its wall as flat."""
    turn = np.array([[0.8, 0.6, 0.0], [-0.48, 0.64, 0.6], [0.36, -0.48, 0.8]])
    along = np.einsum("ab,bkji->akji", turn, np.indices((32, 32, 32))[::-1] - 15.5)
    inside = np.prod(ndtr((along + 8.0) / 0.7) - ndtr((along - 8.0) / 0.7), axis=0)
    values = 50.0 + 950.0 * inside + np.random.default_rng(1).normal(0.0, 10.0, inside.shape)
    volume = Volume(np.rint(values).astype(np.int16), np.eye(4))

    mesh = clrecon.fit_cortex(extract_isosurface(volume, 300.0, device=device), volume, device=device)

    beyond = np.abs((mesh.vertices - 15.5) @ turn.T) - 8.0
    away = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    at_rim = (np.sort(beyond, axis=1)[:, 1] > -1.5) & np.isfinite(mesh.values["error_mm"])
    held = np.abs(away) < 1.96 * mesh.values["error_mm"]
    assert at_rim.sum() > 500  # of 2,300 vertices
    assert held[at_rim].mean() > 0.75  # measured 0.81; 0.39 by the fits alone


def test_fitting_keeps_triangles_and_topology_without_self_intersections(level_mesh, fitted):
    assert np.array_equal(fitted.triangles, level_mesh.triangles)
    quality, before = fitted.quality(), level_mesh.quality()
    for name in ("closed", "manifold", "components", "euler_number"):
        assert quality[name] == before[name], name
    assert len(find_self_intersections(fitted.vertices, fitted.triangles)) == 0


def test_report_of_a_fitted_cortex_counts_the_vertices_of_each_state(fitted, level_mesh):
    report = fitted.report["cortex"]
    states = ("fitted", "not_bone", "metal", "badly_fitted", "no_room")
    assert report["vertices"] == level_mesh.vertex_count == sum(report[state] for state in states)
    assert report["fitted"] > 0.97 * report["vertices"]  # measured all


def test_report_of_a_fitted_cortex_has_its_distances_bias_and_density(fitted):
    report = fitted.report["cortex"]
    assert report["moved"]
    assert report["outside_mm"]["p5"] < report["outside_mm"]["mean"] < report["outside_mm"]["p95"]
    assert 0.0 < report["bias_mm"] < 0.05  # measured 0.014
    assert report["constants"]["cortex_hu"] == pytest.approx(1000.0, rel=0.05)  # measured 1015


def test_report_of_a_fitted_cortex_is_valid_json(fitted):
    report = fitted.report["cortex"].as_dict()
    assert json.loads(json.dumps(report, allow_nan=False)).keys() == report.keys()


def test_mesh_that_is_fitted_gets_no_report_of_a_cortex(fitted, level_mesh):
    assert "cortex" in fitted.report
    assert "cortex" not in level_mesh.report


def test_triangles_that_would_turn_over_are_moved_less(level_mesh):
    random = np.random.default_rng(4)
    wild = level_mesh.vertices + random.normal(0.0, 0.4, level_mesh.vertices.shape)
    assert find_turned(level_mesh.vertices, wild, level_mesh.triangles).mean() > 0.05  # measured 0.27
    fans = Fans(level_mesh.triangles, level_mesh.vertex_count)
    calm = calm_vertices(level_mesh.vertices, wild, level_mesh.triangles, fans)
    assert not find_turned(level_mesh.vertices, calm, level_mesh.triangles).any()


def test_vertices_that_stay_are_left_as_they_are(level_mesh):
    fans = Fans(level_mesh.triangles, level_mesh.vertex_count)
    same = calm_vertices(level_mesh.vertices, level_mesh.vertices, level_mesh.triangles, fans)
    assert np.array_equal(same, level_mesh.vertices)


def sheet_of_triangles() -> np.ndarray:
    """Two triangles for each square of 9 x 9 vertices."""
    corner = np.arange(81).reshape(9, 9)[:8, :8].ravel()
    return np.concatenate([corner[:, None] + [0, 1, 10], corner[:, None] + [0, 10, 9]]).astype(np.uint32)


def test_vertex_without_bone_follows_its_wall_only_where_most_around_it_are_fitted():
    """Of a sheet of 9 x 9 vertices the last three columns are no bone, and one vertex within the others."""
    states = np.full((9, 9), FITTED, np.uint8)
    states[:, 6:] = states[4, 2] = NOT_BONE
    unused = np.full(81, -0.5, np.float32)
    names = ("thickness_mm", "error_mm", "room_mm", "shift_mm")
    fit = CortexFit(None, (), states.ravel(), np.zeros(81, bool), spread_mm=-unused, **dict.fromkeys(names, unused))
    triangles, fans = sheet_of_triangles(), Fans(sheet_of_triangles(), 81)

    doubt_lone_vertices(fit, triangles, fans)

    within = slice(1, 8)  # whose neighbours are all there
    assert np.argwhere(fit.states.reshape(9, 9)[within] == BADLY_FITTED).tolist() == [[3, 2]]
    shifts = choose_shifts(fit, triangles, fans).reshape(9, 9)[within]
    np.testing.assert_allclose(shifts, np.where(np.arange(9) < 6, -0.5, 0.0) + np.zeros((7, 1)), rtol=1e-6)  # float32


def test_hidden_walls_follow_their_fitted_neighbours_three_vertices_far_and_others_one():
    """A sheet of 9 x 9 vertices, the first three columns fitted by -0.5 mm; the others of the first 5 rows hidden."""
    rows, columns = np.indices((9, 9))
    triangles = sheet_of_triangles()
    is_fitted = (columns < 3).ravel()
    unused = np.full(81, np.nan, np.float32)
    fit = CortexFit(
        constants=None, own_cortex_hu=(), states=np.where(is_fitted, FITTED, BADLY_FITTED).astype(np.uint8),
        hidden=~is_fitted & (rows < 5).ravel(), shift_mm=np.where(is_fitted, -0.5, 9.0).astype(np.float32),
        spread_mm=np.full(81, 0.1, np.float32),
        **dict.fromkeys(("thickness_mm", "error_mm", "room_mm"), unused),
    )  # fmt: skip

    shifts = choose_shifts(fit, triangles, Fans(triangles, 81)).reshape(9, 9)

    np.testing.assert_allclose(shifts[:4], np.where(columns < 3 + 3, -0.5, 0.0)[:4], rtol=1e-6)  # float32
    np.testing.assert_allclose(shifts[6:], np.where(columns < 3 + 1, -0.5, 0.0)[6:], rtol=1e-6)  # float32


def test_second_fit_of_thick_slices_is_nearer_to_the_bone_than_the_first(device):
    """Slices of 3 mm make steps of a ball: normals of their field are off where it is slanted.

    A second fit follows those of the moved surface.
    """
    volume = hollow_ball(thickness=1.5, spacing=(1.0, 1.0, 3.0))
    mesh = extract_isosurface(volume, 200.0, device=device)
    with DeviceVolume(volume, device=device) as resident:
        once = fit_walls(resident, mesh.vertices, mesh.normals, stopwatch=Stopwatch())
    shifts = choose_shifts(once, mesh.triangles, Fans(mesh.triangles, mesh.vertex_count))
    outer = np.linalg.norm(mesh.vertices - MIDDLE, axis=1) > RADIUS - 1.5

    def mean_error(vertices):
        return np.abs(np.linalg.norm(vertices[outer] - MIDDLE, axis=1) - RADIUS).mean()

    twice = clrecon.fit_cortex(mesh, volume, device=device)
    # In mm; measured 0.166 and 0.202.
    assert mean_error(twice.vertices) < 0.9 * mean_error(mesh.vertices + shifts[:, None] * mesh.normals)


@pytest.mark.parametrize("of_all", [False, True], ids=["of some", "of all"])
def test_sums_over_fans_are_those_of_each_vertex_and_twice_those_of_its_neighbours(level_mesh, of_all):
    """A vertex is in each of its triangles, a neighbour in two of them; the last vertex has none."""
    vertices = level_mesh.vertex_count + 1
    fans, chosen = Fans(level_mesh.triangles, vertices), np.array([4, 7, vertices - 1, 90])
    values = np.random.default_rng(1).normal(size=(vertices, 2))
    asked = np.arange(vertices) if of_all else chosen
    sums = fans.sums(values, level_mesh.triangles, asked)
    assert len(sums) == len(asked)
    for vertex, found in zip(chosen, sums[chosen] if of_all else sums, strict=True):
        around = level_mesh.triangles[(level_mesh.triangles == vertex).any(axis=1)]
        neighbours = np.setdiff1d(around, [vertex])
        expected = len(around) * values[vertex] + 2.0 * values[neighbours].sum(axis=0)
        np.testing.assert_allclose(found, expected, atol=1e-12)  # sums of some ten numbers in float64


def test_mesh_of_arrays_has_no_values(fitted):
    assert clrecon.Mesh(fitted.vertices, fitted.triangles).values == {}


def test_values_of_a_fitted_surface_go_into_its_components(fitted):
    (component,) = fitted.split()
    assert np.array_equal(component.values["thickness_mm"], fitted.values["thickness_mm"])


def test_ply_of_a_fitted_surface_holds_its_vertices_and_values(fitted, tmp_path):
    path = tmp_path / "a.ply"
    fitted.save(path)
    head, _, data = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in head.splitlines() if line.startswith(b"property float")]
    rows = np.frombuffer(data, "<f4", fitted.vertex_count * len(names)).reshape(-1, len(names))
    thickness = rows[:, names.index("scalar_thickness_mm")]
    assert np.array_equal(thickness, fitted.values["thickness_mm"], equal_nan=True)
    assert "scalar_error_mm" in names
    assert np.array_equal(clrecon.read_mesh(path).vertices, fitted.vertices)


def test_vtp_of_a_fitted_surface_holds_its_vertices_and_names_its_values(fitted, tmp_path):
    path = tmp_path / "a.vtp"
    fitted.save(path)
    written = path.read_bytes()
    assert b'Name="thickness_mm"' in written
    assert b'Name="error_mm"' in written
    assert np.array_equal(clrecon.read_mesh(path).vertices, fitted.vertices)


def test_glb_of_a_fitted_surface_holds_minus_one_for_values_of_nan(fitted, tmp_path):
    path = tmp_path / "a.glb"
    fitted.values["error_mm"][:3] = np.nan
    fitted.save(path)

    raw = path.read_bytes()
    json_bytes = struct.unpack("<I", raw[12:16])[0]  # after a header of 12 bytes; then 8 bytes of each chunk's head
    document = json.loads(raw[20 : 20 + json_bytes])
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["_ERROR_MM"]]
    begin = 20 + json_bytes + 8 + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    found = np.frombuffer(raw, "<f4", fitted.vertex_count, begin)
    assert found[:3].tolist() == [-1.0] * 3
    assert np.array_equal(found[3:], fitted.values["error_mm"][3:])


def test_values_of_a_fitted_surface_are_read_back_from_glb(fitted, tmp_path):
    fitted.values["error_mm"][:3] = np.nan
    fitted.save(tmp_path / "a.glb")
    read = clrecon.read_mesh(tmp_path / "a.glb")
    for name in ("thickness_mm", "error_mm"):
        assert np.array_equal(read.values[name], fitted.values[name], equal_nan=True)


def test_glb_keeps_minus_one_among_other_negative_numbers(fitted, tmp_path):
    fitted.values["away_mm"] = np.resize(np.array([-1.0, -2.0, 3.0], np.float32), fitted.vertex_count)
    fitted.save(tmp_path / "a.glb")
    del fitted.values["away_mm"]
    assert clrecon.read_mesh(tmp_path / "a.glb").values["away_mm"][:3].tolist() == [-1.0, -2.0, 3.0]


def test_glb_of_a_fitted_surface_holds_its_vertices(fitted, tmp_path):
    fitted.save(tmp_path / "a.glb")
    assert np.allclose(clrecon.read_mesh(tmp_path / "a.glb").vertices, fitted.vertices, atol=1e-4)  # metres in float32


def test_fitting_in_a_scan_without_bone_is_refused(shell, level_mesh, device):
    soft = shell.with_voxels(np.full(shell.shape, 40, np.int16))
    with refused(NoSurfaceError, "walls", "bone"):
        clrecon.fit_cortex(level_mesh, soft, device=device)


def test_fitting_of_a_surface_below_a_level_is_refused(shell, device):
    below = extract_isosurface(shell, 300.0, below=True, device=device)
    with refused(UsageError, "level", "below"):
        clrecon.fit_cortex(below, shell, device=device)


def run_mesh_command(*arguments) -> int:
    from clrecon.cli.main import main

    return main(["mesh", *map(str, arguments)])


@pytest.fixture
def ct_file(shell, tmp_path):
    """The file of the shell."""
    shell.save(tmp_path / "ct.nii.gz")
    return tmp_path / "ct.nii.gz"


def read_report(path):
    return json.loads(path.read_text("utf-8"))


def test_command_with_surface_cortex_moves_the_vertices_onto_the_bone_and_says_so(ct_file, tmp_path, printed):
    report_file = tmp_path / "a.json"
    output = ("-o", tmp_path / "a.ply", "--report", report_file)
    assert run_mesh_command(ct_file, *output, "--surface", "cortex") == 0
    assert "vertices are fitted to the bone" in printed().everything
    report = read_report(report_file)
    assert report["cortex"]["moved"]
    assert report["seconds"]["cortex"] > 0.0
    assert report["iso_distance"] is None  # the surface is no longer one of a level


def test_command_without_surface_cortex_says_how_far_the_surface_lies_outside_of_the_bone(ct_file, tmp_path, printed):
    report_file = tmp_path / "a.json"
    assert run_mesh_command(ct_file, "-o", tmp_path / "a.ply", "--report", report_file) == 0
    assert "outside of the bone" in printed().everything
    cortex_report = read_report(report_file)["cortex"]
    assert not cortex_report["moved"]
    assert cortex_report["outside_mm"]["mean"] > 0.2  # mm; measured 1.04


@pytest.mark.parametrize("labels", [False, True], ids=["scan", "labels"])
def test_the_trial_run_launches_the_kernels_of_the_cortex_and_of_crossings(labels, device, monkeypatch):
    launched = set()

    def note_launch(opened, kernel, *more, **arguments):
        launched.add(kernel.name)
        launch(opened, kernel, *more, **arguments)

    for module in (cortex, decimation.ocl):
        monkeypatch.setattr(module, "launch", note_launch)
    choice = LabelChoice("labels.nii.gz") if labels else None
    _try_steps(device, MeshSettings(surface="cortex", labels=choice))
    assert {"sample_profiles", "fit_profiles", "enter_triangles", "mark_crossings"} <= launched


def test_mesh_for_printing_with_surface_cortex_has_the_volume_of_the_bone(ct_file, tmp_path, printed):
    """A ball of 13 mm, once its marrow is filled; 200 HU makes it more than 10 % larger."""
    path = tmp_path / "a.stl"
    assert run_mesh_command(ct_file, "-o", path, "--for", "print", "--surface", "cortex") == 0, printed()
    ball_ml = 4.0 / 3.0 * np.pi * RADIUS**3 / 1000
    assert clrecon.read_mesh(path).quality()["volume_ml"] == pytest.approx(ball_ml, rel=0.02)  # measured 0.006 less


def dry_shell(shell: Volume) -> Volume:
    """The same shell in air, with air within it."""
    dry = shell.voxels.astype(float)
    dry = np.where(dry < 500, -1000.0 + 3.0 * (dry - 50.0), dry)
    return shell.with_voxels(np.clip(dry, -1010, 1100).astype(np.int16))


def test_cortex_of_a_dry_specimen_at_200_hu_is_warned_of_with_a_lower_level(shell, tmp_path, printed):
    """A thin wall would be lost."""
    dry_shell(shell).save(tmp_path / "dry.nii.gz")
    assert run_mesh_command(tmp_path / "dry.nii.gz", "-o", tmp_path / "a.ply", "--surface", "cortex") == 0
    text = printed().everything
    assert "dry specimen" in text
    assert "stay below 200 HU" in text
    assert "--hu -200 finds them" in text


@pytest.mark.parametrize(
    ("is_dry", "level"), [(True, ["--hu", "-200"]), (False, [])], ids=["dry, low level", "patient"]
)
def test_cortex_is_not_warned_of_at_a_low_level_or_in_a_patient(shell, tmp_path, printed, is_dry, level):
    (dry_shell(shell) if is_dry else shell).save(tmp_path / "ct.nii.gz")
    assert run_mesh_command(tmp_path / "ct.nii.gz", "-o", tmp_path / "a.ply", "--surface", "cortex", *level) == 0
    assert "dry specimen" not in printed().everything


@pytest.fixture
def soft_ct(shell, tmp_path):
    """The file of a scan whose highest HU are 250."""
    soft = shell.with_voxels(np.where(shell.voxels > 500, 250, shell.voxels // 2).astype(np.int16))
    soft.save(tmp_path / "ct.nii.gz")
    return tmp_path / "ct.nii.gz"


def test_report_of_a_scan_without_bone_says_why_it_has_no_cortex(soft_ct, tmp_path, printed):
    assert run_mesh_command(soft_ct, "-o", tmp_path / "a.stl", "--report", tmp_path / "a.json") == 0
    cortex_report = read_report(tmp_path / "a.json")["cortex"]
    assert list(cortex_report) == ["reason"]
    assert "no walls of bone" in cortex_report["reason"]
    assert "of the bone (" not in printed().everything


def test_surface_cortex_of_a_scan_without_bone_is_refused_without_a_file(soft_ct, tmp_path, printed):
    assert run_mesh_command(soft_ct, "-o", tmp_path / "a.stl", "--surface", "cortex") == 2
    printed().assert_error("walls", "bone")
    assert not (tmp_path / "a.stl").exists()


@pytest.mark.release
def test_command_with_surface_cortex_moves_the_vertices_of_a_label(shell, ct_file, tmp_path):
    labels = tmp_path / "labels.nii.gz"
    shell.with_voxels((shell.voxels > 300).astype(np.uint8)).save(labels)
    output = ("-o", tmp_path / "a.stl", "--report", tmp_path / "a.json")
    assert run_mesh_command(ct_file, *output, "--labels", labels, "--surface", "cortex") == 0
    report = read_report(tmp_path / "a.json")
    assert report["meshes"][0]["label_number"] == 1
    assert report["cortex"]["moved"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--surface", "nets"], "it is hu, cortex or mask"),
        (["--surface", "mask"], "that of labels"),
        (["--surface", "cortex", "--below", "-400"], "outer surface of bone"),
        (["--surface", "cortex", "--hu", "100:300"], "outer surface of bone"),
        (["--surface", "cortex", "--method", "skimage"], "vertices of one mesh"),
    ],
)
def test_options_that_do_not_go_with_a_cortex_are_refused(options, words, tmp_path, printed):
    assert run_mesh_command(tmp_path, "-o", tmp_path / "a.stl", *options) == 3
    assert words in printed().everything
