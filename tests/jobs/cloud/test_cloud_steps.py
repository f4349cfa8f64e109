"""Steps of ``clrecon cloud``: filters, normals, thinning, a surface, and what a step may take."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloud_scans import AFFINE, BAND, make_voxels, run_with_report
from label_files import write_nrrd
from printed_text import Printer
from refusals import refused

import clrecon
from clrecon.errors import RefusedInputError
from clrecon.jobs.cloud.job import CloudFiles, make_cloud
from clrecon.jobs.cloud.settings import STEPS, CloudSettings, Clustering
from clrecon.jobs.presets import DEFAULT_PRESET, PRESETS

pytestmark = pytest.mark.first_device


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two balls, a plate, and lone voxels; see `make_voxels`."""
    path = tmp_path_factory.mktemp("cloud") / "scan.nrrd"
    write_nrrd(path, make_voxels(), AFFINE)
    return path


FILTERED = ("--normals", "--denoise", "bilateral", "--outliers", "3", "--points", "shell", "--hu", "250")


def test_cloud_without_outliers_filtered_with_normals_is_that_of_the_functions(
    device: Any, scan: Path, tmp_path: Path
) -> None:
    run_with_report(tmp_path, device, scan, *FILTERED)
    volume = clrecon.read_volume(scan)
    cloud = clrecon.extract_points(volume, 250, kind="shell", device=device)
    cloud = clrecon.remove_outliers(cloud, deviations=3.0, device=device).cloud
    cloud = clrecon.denoise_points(cloud, device=device).cloud
    cloud = clrecon.estimate_normals(cloud, volume=volume, device=device).cloud
    written = clrecon.read_points(tmp_path / "out.npz")
    assert np.array_equal(written.points, cloud.points)
    assert np.array_equal(written.normals, cloud.normals)


def test_steps_of_a_filtered_cloud_are_reported_in_their_order(
    scan: Path, tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(scan, *FILTERED, "--report", str(tmp_path / "r.json"), output="out.npz") == 0
    report = json.loads((tmp_path / "r.json").read_text())
    steps = [step["step"] for step in report["steps"]]
    assert steps == ["points", "outliers", "bilateral", "normals"] == sorted(steps, key=list(STEPS).index)
    assert report["removed"]["outlier"] > 0
    assert [gate["name"] for gate in report["gates"]] == ["points_kept_outliers"]
    printed().assert_output("rms", "oriented", "gradient")


def test_doubtful_normals_of_far_slices_are_warned_of(
    tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    write_nrrd(tmp_path / "far.nrrd", make_voxels()[::6], AFFINE @ np.diag([1.0, 1.0, 6.0, 1.0]))
    options = ["--points", "shell", "--hu", "250", "--normals", "--report", str(tmp_path / "r.json")]
    assert cloud_command(tmp_path / "far.nrrd", *options) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    share = report["steps"][-1]["doubtful"] / report["points"]
    said = f"normals ({100.0 * share:.0f} %) are doubtful and follow the HU alone"
    assert share > 0.1 and said in capsys.readouterr().err  # measured 0.31 in slices 6 mm apart
    assert any(said in warning and "(--points surface)" in warning for warning in report["warnings"])


def test_points_of_a_surface_keep_the_normals_of_its_field_where_normals_are_asked_for(
    scan: Path, tmp_path: Path, cloud_command: Any
) -> None:
    assert cloud_command(scan, output="a.ply") == 0
    assert cloud_command(scan, "--normals", output="b.ply") == 0

    of_field, asked_for = (clrecon.read_points(tmp_path / name).normals for name in ("a.ply", "b.ply"))
    assert np.array_equal(of_field, asked_for)


def test_points_of_a_surface_that_were_moved_have_no_normals(scan: Path, tmp_path: Path, cloud_command: Any) -> None:
    assert cloud_command(scan, "--denoise", "bilateral") == 0
    assert clrecon.read_points(tmp_path / "out.ply").normals is None


THINNED = ("--spacing", "1.2", "--denoise", "grid")


def test_thinned_cloud_and_its_surface_are_those_of_the_functions(device: Any, scan: Path, tmp_path: Path) -> None:
    report = run_with_report(tmp_path, device, scan, *THINNED, "--surface", str(tmp_path / "out.stl"))
    cloud = clrecon.extract_points(clrecon.read_volume(scan), PRESETS[DEFAULT_PRESET].iso_value, device=device)
    cloud = clrecon.remove_sparse_cells(cloud, device=device).cloud
    cloud = clrecon.thin_points(cloud, 1.2, device=device).cloud
    assert np.array_equal(clrecon.read_points(tmp_path / "out.npz").points, cloud.points)
    mesh = clrecon.reconstruct_surface(cloud, device=device)
    triangles_in_file = ((tmp_path / "out.stl").stat().st_size - 84) // 50  # binary STL: header of 84 bytes, 50 each
    assert report["surface"]["triangles"] == mesh.triangle_count == triangles_in_file


def test_report_of_a_thinned_cloud_with_surface_has_steps_and_outputs(device: Any, scan: Path, tmp_path: Path) -> None:
    report = run_with_report(tmp_path, device, scan, *THINNED, "--surface", str(tmp_path / "out.stl"))
    assert [step["step"] for step in report["steps"]] == ["points", "sparse cells", "spacing"]
    assert [output["what"] for output in report["outputs"]] == ["cloud", "surface"]


def test_steps_of_a_thinned_cloud_with_surface_are_printed(
    scan: Path, tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(scan, *THINNED, "--surface", str(tmp_path / "out.stl")) == 0
    printed().assert_output("closed", "sparse", "spacing")


@pytest.fixture
def noisy_scan(tmp_path: Path) -> Path:
    """A cube of 4 x 4 x 4 voxels among more lone voxels than it has."""
    voxels = np.zeros((24, 24, 24), np.int16)
    voxels[::3, ::3, ::3] = 500
    voxels[5:9, 5:9, 5:9] = 500
    write_nrrd(tmp_path / "scan.nrrd", voxels, np.eye(4))
    return tmp_path / "scan.nrrd"


LOSSY = ("--hu", BAND, "--cluster", "eps=1.5,min=5")


def test_clustering_that_takes_more_than_half_of_the_points_as_noise_is_refused_and_writes_nothing(
    noisy_scan: Path, tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(noisy_scan, *LOSSY) == 4

    printed().assert_error("points", "half", "--allow-point-loss")
    assert {path.name for path in tmp_path.iterdir()} == {"scan.nrrd"}


def test_clustering_that_takes_more_than_half_of_the_points_is_done_with_a_warning_where_it_is_allowed(
    noisy_scan: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(noisy_scan, *LOSSY, "--allow-point-loss") == 0
    printed().assert_error("half", "allowed")


def test_clustering_that_takes_too_much_is_refused_from_python_with_the_parameter(
    noisy_scan: Path, device: Any, tmp_path: Path
) -> None:
    clusters = Clustering(eps=1.5, min_samples=5)
    settings = CloudSettings(hu=(200, 3000), clusters=clusters, device=str(device.index))
    with refused(RefusedInputError, "allow_point_loss=True"):
        make_cloud(noisy_scan, CloudFiles(tmp_path / "b.ply"), settings)
