"""Options for methods of marching cubes: what they make and print, and what does not go together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_text import Printer
from variants import daily

from clrecon.cli.main import main
from clrecon.jobs.mesh.settings import METHOD_NAMES
from clrecon.operators.surface.methods import METHODS


@pytest.fixture(scope="module")
def bones(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A large and a small block of bone and a crumb, in a NIfTI file."""
    nibabel = pytest.importorskip("nibabel")
    voxels = np.full((40, 30, 20), -1000, np.int16)  # (i, j, k)
    voxels[4:24, 5:25, 3:17] = 600
    voxels[30:38, 5:15, 5:15] = 600
    voxels[28, 28, 2] = 600
    folder = tmp_path_factory.mktemp("bones")
    nibabel.save(nibabel.Nifti1Image(voxels, np.diag((-1.0, -1.0, 2.0, 1.0))), folder / "bones.nii.gz")
    labels = np.zeros(voxels.shape, np.uint8)
    labels[33:35, 8:12, 8:12] = 7
    labels[30, 5, 5] = 7
    nibabel.save(nibabel.Nifti1Image(labels, np.diag((-1.0, -1.0, 2.0, 1.0))), folder / "labels.nii.gz")
    return folder


def run(bones: Path, out: Path, *options: str) -> tuple[int, dict[str, Any]]:
    report = out / "report.json"
    code = main(["mesh", str(bones / "bones.nii.gz"), "-o", str(out / "a.stl"), "--report", str(report), *options])
    return code, json.loads(report.read_text()) if report.exists() else {}


def test_the_names_are_those_of_the_table() -> None:
    assert tuple(METHODS) == METHOD_NAMES


def test_seeds_choose_and_are_reported(bones: Path, tmp_path: Path, printed: Printer, device: Any) -> None:
    code, report = run(bones, tmp_path, "--grow-from", "auto", "-v")
    said = printed()
    assert code == 0
    assert report["method"] == "i-mc" and report["grow_from"] == ["auto"] and report["vertex_rule"] == "linear"
    assert report["components"] == 2 and report["growing"]["components"] == 3
    cells = report["cells"]
    assert cells["all"] == 41 * 31 * 21 and cells["active"] == cells["grown"] + 8
    said.assert_output(cells["visited"], cells["active"], cells["all"], 2, 3, 8)
    assert report["meshes"][0]["growing"] == report["growing"]


def test_points_and_labels_choose_one(bones: Path, tmp_path: Path, device: Any) -> None:
    point, label, ras = tmp_path / "point", tmp_path / "label", tmp_path / "ras"
    for folder in (point, label, ras):
        folder.mkdir()
    _, by_point = run(bones, point, "--grow-from", "30,10,20")
    _, by_label = run(bones, label, "--grow-from", "label:7", "--labels", str(bones / "labels.nii.gz"))
    _, by_ras = run(bones, ras, "--grow-from=-30,-10,20", "--space", "ras")
    assert by_point["growing"]["from"] == ["30,10,20"] and by_ras["triangles"] == by_point["triangles"]
    assert by_label["meshes"][0]["label"] is None and by_label["growing"]["from"] == ["label label_7"]
    assert (point / "a.stl").read_bytes() == (label / "a.stl").read_bytes()
    assert by_point["components"] == 1 and by_point["cells"] == by_label["cells"]


@pytest.mark.parametrize("method", daily(2, ["t-mc-soup", "skimage", "s-mc", "g-mc"]))
def test_mesh_is_written_by_every_other_method(method: str, bones: Path, tmp_path: Path, device: Any) -> None:
    if method == "skimage":
        pytest.importorskip("skimage")
    more = ["--decimate", "0.3"] if method in ("s-mc", "g-mc") else []
    code, report = run(bones, tmp_path, "--method", method, *more)
    assert code == 0 and report["method"] == method
    assert report["volume_ml"] == pytest.approx(2e-3 * (20 * 20 * 14 + 8 * 10 * 10), rel=0.1)
    assert (report["refinement"] is not None) == bool(more)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--method", "mc33"], "there is no --method mc33: it is one of t-mc, i-mc, g-mc, s-mc, t-mc-soup, skimage"),
        (["--method", "t-mc", "--grow-from", "auto"], "--method t-mc makes the whole surface: leave --grow-from out"),
        (["--grow-from", "auto", "--topology", "trilinear"], "leave out --topology trilinear"),
        (["--grow-from", "spine"], "'spine' is neither auto nor X,Y,Z in mm nor label:NAME"),
        (["--grow-from", "label:"], "--grow-from is auto, X,Y,Z in mm or label:NAME"),
        (["--grow-from", "1,2,nan"], "a seed is a point of three numbers in mm"),
        (["--grow-from", "label:7"], "needs its label map: give its file with --labels"),
        (["--grow-from", "500,0,0"], "seed 500,0,0 lies outside of the volume, which runs from x "),
        (["--vertex-rule", "midpoint"], "--vertex-rule is one of linear, golden, golden-search, not 'midpoint'"),
        (["--vertex-rule", "golden", "--topology", "trilinear"], "exclude each other"),
        (["--method", "skimage", "--below", "100"], "--method skimage takes one iso value"),
        (["--method", "skimage", "--vertex-rule", "golden"], "leave --vertex-rule golden out"),
        (["--method", "g-mc", "--max-deviation", "0.1"], "--method g-mc collapses without a bound"),
        (["--method", "i-mc", "--labels", "LABELS"], "labels pick the cells of their surfaces"),
        (["--grow-from", "label:7", "--labels", "LABELS", "--label", "7"], "leave the labels for meshes out"),
    ],
)
def test_methods_and_options_that_exclude_each_other_are_refused_in_one_line(
    options: list[str], words: str, bones: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], device: Any
) -> None:
    given = [str(bones / "labels.nii.gz") if option == "LABELS" else option for option in options]
    try:
        code, _ = run(bones, tmp_path, *given)
    except SystemExit as error:
        code = int(error.code or 0)
    said = capsys.readouterr().err
    assert code == 3 and words in said
    assert list(tmp_path.iterdir()) == []
