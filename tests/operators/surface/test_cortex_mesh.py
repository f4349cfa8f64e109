"""Surfaces moved onto the bone: where they lie, that nothing breaks, what is said and written of them."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from refusals import refused
from scipy.special import ndtr
from surface_volumes import MIDDLE as BALL
from surface_volumes import hollow_ball

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
from clrecon.operators.surface.cortex_mesh import CortexFit, calm_vertices, choose_shifts, find_turned, fit_walls
from clrecon.operators.surface.extract import extract_isosurface

MIDDLE = np.array([19.5, 19.0, 18.0])


@pytest.fixture(scope="module")
def shell() -> Volume:
    """A shell of bone 3 mm thick with its outer surface at 13 mm, blurred by 0.7 mm, with noise of 20 HU."""
    k, j, i = np.indices((38, 40, 41))
    far = np.sqrt((i - MIDDLE[0]) ** 2 + (j - MIDDLE[1]) ** 2 + (k - MIDDLE[2]) ** 2)
    outer, inner = ndtr((far - 13.0) / 0.7), ndtr((10.0 - far) / 0.7)
    values = 50.0 * outer + 200.0 * inner + 1000.0 * (1.0 - outer - inner)
    values += np.random.default_rng(3).normal(0.0, 20.0, far.shape)
    return Volume(np.rint(values).astype(np.int16), np.eye(4))


@pytest.fixture(scope="module")
def level(shell, device):
    return extract_isosurface(shell, 300.0, device=device).keep_largest()


@pytest.fixture(scope="module")
def fitted(level, shell, device):
    return clrecon.fit_cortex(level, shell, device=device)


def test_the_surface_lies_on_the_bone(level, fitted):
    before, after = (np.linalg.norm(mesh.vertices - MIDDLE, axis=1) - 13.0 for mesh in (level, fitted))
    assert before.mean() > 0.3
    # Blur moves the edge of a ball inwards, by 0.04 mm here: the square of its width over the radius.
    assert -0.08 < after.mean() < 0.02 and np.abs(after).mean() < 0.1
    assert np.median(fitted.values["thickness_mm"]) == pytest.approx(3.0, abs=0.3)
    error = fitted.values["error_mm"]
    assert (np.abs(after) < 1.96 * error).mean() > 0.93


def test_fitting_keeps_triangles_and_topology(level, fitted):
    assert np.array_equal(fitted.triangles, level.triangles)
    quality, old = fitted.quality(), level.quality()
    assert all(quality[name] == old[name] for name in ("closed", "manifold", "components", "euler_number"))
    assert len(find_self_intersections(fitted.vertices, fitted.triangles)) == 0


def test_report_of_a_fitted_cortex_counts_every_vertex(fitted, level):
    found = fitted.report["cortex"]
    assert found["moved"] and found["vertices"] == level.vertex_count
    assert sum(found[name] for name in ("fitted", "not_bone", "metal", "badly_fitted", "no_room")) == found["vertices"]
    assert found["fitted"] > 0.97 * found["vertices"]
    assert found["outside_mm"]["p5"] < found["outside_mm"]["mean"] < found["outside_mm"]["p95"]
    assert found["constants"]["cortex_hu"] == pytest.approx(1000.0, rel=0.05)
    assert 0.0 < found["bias_mm"] < 0.05
    json.dumps(found.as_dict(), allow_nan=False)
    assert "cortex" not in level.report


def test_triangles_that_would_turn_over_are_calmed(level):
    random = np.random.default_rng(4)
    wild = level.vertices + random.normal(0.0, 0.4, level.vertices.shape)
    fans = Fans(level.triangles, level.vertex_count)
    calm = calm_vertices(level.vertices, wild, level.triangles, fans)
    assert find_turned(level.vertices, wild, level.triangles).mean() > 0.05
    assert not find_turned(level.vertices, calm, level.triangles).any()
    same = calm_vertices(level.vertices, level.vertices, level.triangles, fans)
    assert np.array_equal(same, level.vertices)


def test_walls_that_thick_slices_hide_follow_their_neighbours():
    """A sheet of 9 x 9 vertices, three columns of them fitted: three more if they are hidden, else one."""
    rows, columns = np.indices((9, 9))
    corner = (9 * rows + columns)[:8, :8].ravel()
    triangles = np.concatenate([corner[:, None] + [0, 1, 10], corner[:, None] + [0, 10, 9]]).astype(np.uint32)
    states = np.where(columns < 3, 0, 3).astype(np.uint8).ravel()
    shift, error = np.where(states == 0, -0.5, 9.0).astype(np.float32), np.full(81, 0.1, np.float32)
    hidden = (states == 3) & (rows < 5).ravel()
    fit = CortexFit(None, (), states, hidden, shift, error, error, error)
    shifts = choose_shifts(fit, triangles, Fans(triangles, 81)).reshape(9, 9)
    np.testing.assert_allclose(shifts[:4], np.where(columns < 6, -0.5, 0.0)[:4], rtol=1e-6)
    np.testing.assert_allclose(shifts[6:], np.where(columns < 4, -0.5, 0.0)[6:], rtol=1e-6)


def test_thick_slices_are_fitted_again_along_the_normals_of_the_moved_surface(device):
    """Slices of 3 mm make steps of a ball: their field's normals are off where it is slanted."""
    volume = hollow_ball(thickness=1.5, spacing=(1.0, 1.0, 3.0))
    level = extract_isosurface(volume, 200.0, device=device)
    with DeviceVolume(volume, device=device) as resident:
        once = fit_walls(resident, level.vertices, level.normals, stopwatch=Stopwatch())
    shifts = choose_shifts(once, level.triangles, Fans(level.triangles, level.vertex_count))
    outer = np.linalg.norm(level.vertices - BALL, axis=1) > 11.5

    def mean_error(vertices):
        return np.abs(np.linalg.norm(vertices[outer] - BALL, axis=1) - 13.0).mean()

    twice = clrecon.fit_cortex(level, volume, device=device)
    assert mean_error(twice.vertices) < 0.9 * mean_error(level.vertices + shifts[:, None] * level.normals)


def test_sums_over_triangles_are_twice_those_over_neighbours(level):
    fans, some = Fans(level.triangles, level.vertex_count + 1), np.array([4, 7, level.vertex_count, 90])
    values = np.random.default_rng(1).normal(size=(level.vertex_count + 1, 2))
    for vertex, found in zip(some, fans.sums(values, level.triangles, some), strict=True):
        own = level.triangles[(level.triangles == vertex).any(axis=1)]
        beside = np.setdiff1d(own, [vertex])
        np.testing.assert_allclose(found, len(own) * values[vertex] + 2.0 * values[beside].sum(axis=0), atol=1e-12)


def test_values_go_with_their_vertices_into_parts_and_files(fitted, tmp_path):
    assert clrecon.Mesh(fitted.vertices, fitted.triangles).values == {}
    part = fitted.split()[0]
    assert np.array_equal(part.values["thickness_mm"], fitted.values["thickness_mm"])
    ply = tmp_path / "a.ply"
    fitted.save(ply)
    head, _, data = ply.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in head.splitlines() if line.startswith(b"property float")]
    assert names[-2:] == ["scalar_thickness_mm", "scalar_error_mm"]
    rows = np.frombuffer(data, "<f4", fitted.vertex_count * len(names)).reshape(-1, len(names))
    assert np.array_equal(rows[:, -2], fitted.values["thickness_mm"], equal_nan=True)
    assert np.array_equal(clrecon.read_mesh(ply).vertices, fitted.vertices)
    vtp = tmp_path / "a.vtp"
    fitted.save(vtp)
    assert b'Name="thickness_mm"' in vtp.read_bytes() and b'Name="error_mm"' in vtp.read_bytes()
    assert np.array_equal(clrecon.read_mesh(vtp).vertices, fitted.vertices)


def test_glb_holds_values_without_nan(fitted, tmp_path):
    glb = tmp_path / "a.glb"
    fitted.values["error_mm"][:3] = np.nan
    fitted.save(glb)
    raw = glb.read_bytes()
    length = struct.unpack("<I", raw[12:16])[0]
    document = json.loads(raw[20 : 20 + length])
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    view = document["bufferViews"][document["accessors"][attributes["_ERROR_MM"]]["bufferView"]]
    begin = 28 + length + view["byteOffset"]
    found = np.frombuffer(raw, "<f4", fitted.vertex_count, begin)
    assert (found[:3] == -1.0).all() and np.array_equal(found[3:], fitted.values["error_mm"][3:])
    assert np.allclose(clrecon.read_mesh(glb).vertices, fitted.vertices, atol=1e-4)


def test_fitting_refuses_soft_scans_and_surfaces_below_a_level(shell, level, device):
    soft = shell.with_voxels(np.full(shell.shape, 40, np.int16))
    with refused(NoSurfaceError, "walls", "bone"):
        clrecon.fit_cortex(level, soft, device=device)
    below = extract_isosurface(shell, 300.0, below=True, device=device)
    with refused(UsageError, "level", "below"):
        clrecon.fit_cortex(below, shell, device=device)


def run(*arguments) -> int:
    from clrecon.cli.main import main

    return main(["mesh", *map(str, arguments)])


def test_surface_cortex_moves_the_vertices_of_the_command(shell, tmp_path, capsys):
    shell.save(tmp_path / "ct.nii.gz")
    given = (tmp_path / "ct.nii.gz", "-o", tmp_path / "a.ply", "--report", tmp_path / "a.json")
    assert run(*given, "--surface", "cortex") == 0
    assert "vertices lie on the bone" in capsys.readouterr().out
    report = json.loads((tmp_path / "a.json").read_text("utf-8"))
    assert report["cortex"]["moved"] and report["iso_distance"] is None and report["seconds"]["cortex"] > 0.0
    assert run(*given) == 0
    assert "outside of the bone" in capsys.readouterr().out
    report = json.loads((tmp_path / "a.json").read_text("utf-8"))
    assert not report["cortex"]["moved"] and report["cortex"]["outside_mm"]["mean"] > 0.2


@pytest.mark.parametrize("labels", [False, True])
def test_the_trial_run_launches_the_kernels_of_the_cortex(labels, device, monkeypatch):
    launched = set()

    def note(opened, kernel, *more, **arguments):
        launched.add(kernel.name)
        launch(opened, kernel, *more, **arguments)

    for module in (cortex, decimation.ocl):
        monkeypatch.setattr(module, "launch", note)
    choice = LabelChoice("labels.nii.gz") if labels else None
    _try_steps(device, MeshSettings(surface="cortex", labels=choice))
    assert {"sample_profiles", "fit_profiles", "enter_triangles", "mark_crossings"} <= launched


def test_a_print_lies_on_the_bone(shell, tmp_path, printed):
    """A ball with a radius of 13 mm, once marrow is filled; 200 HU makes it more than 10 % larger."""
    shell.save(tmp_path / "ct.nii.gz")
    given = (tmp_path / "ct.nii.gz", "-o", tmp_path / "a.stl", "--for", "print", "--surface", "cortex")
    assert run(*given) == 0, printed()
    ball = 4.0 * np.pi / 3e3 * 13.0**3
    assert clrecon.read_mesh(tmp_path / "a.stl").quality()["volume_ml"] == pytest.approx(ball, rel=0.02)


def test_a_dry_specimen_wants_a_low_level(shell, tmp_path, capsys):
    """The same shell in air, with air within it: at 200 HU a thin wall would be lost, which is said."""
    dry = shell.voxels.astype(float)
    dry = np.where(dry < 500, -1000.0 + 3.0 * (dry - 50.0), dry)
    shell.with_voxels(np.clip(dry, -1010, 1100).astype(np.int16)).save(tmp_path / "dry.nii.gz")
    shell.save(tmp_path / "ct.nii.gz")
    for name, level, warned in (("dry", [], True), ("dry", ["--hu", "-200"], False), ("ct", [], False)):
        given = (tmp_path / f"{name}.nii.gz", "-o", tmp_path / f"{name}{len(level)}.ply", "--surface", "cortex")
        assert run(*given, *level) == 0
        said = capsys.readouterr()
        assert ("dry specimen" in said.out + said.err) == warned
        assert not warned or "stay below 200 HU" in said.err and "--hu -200 finds them" in said.err


def test_cortex_of_a_scan_without_bone_says_its_reason(shell, tmp_path, capsys):
    soft = shell.with_voxels(np.where(shell.voxels > 500, 250, shell.voxels // 2).astype(np.int16))
    soft.save(tmp_path / "ct.nii.gz")
    given = (tmp_path / "ct.nii.gz", "-o", tmp_path / "a.stl", "--report", tmp_path / "a.json")
    assert run(*given) == 0
    report = json.loads((tmp_path / "a.json").read_text("utf-8"))
    assert list(report["cortex"]) == ["reason"] and "no walls of bone" in report["cortex"]["reason"]
    assert "of the bone (" not in capsys.readouterr().out
    (tmp_path / "a.stl").unlink()
    assert run(*given, "--surface", "cortex") == 2
    assert "no walls of bone" in capsys.readouterr().err and not (tmp_path / "a.stl").exists()


@pytest.mark.release
def test_a_label_lies_on_the_bone(shell, tmp_path):
    ct, labels = tmp_path / "ct.nii.gz", tmp_path / "labels.nii.gz"
    shell.save(ct)
    shell.with_voxels((shell.voxels > 300).astype(np.uint8)).save(labels)
    given = (ct, "-o", tmp_path / "a.stl", "--labels", labels, "--surface", "cortex", "--report", tmp_path / "a.json")
    assert run(*given) == 0
    report = json.loads((tmp_path / "a.json").read_text("utf-8"))
    assert report["meshes"][0]["label_number"] == 1 and report["cortex"]["moved"]


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
def test_cortex_options_without_sense_are_refused(options, words, tmp_path, capsys):
    assert run(tmp_path, "-o", tmp_path / "a.stl", *options) == 3
    assert words in capsys.readouterr().err
