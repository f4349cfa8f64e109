"""Options for methods of marching cubes: what they make and print, and what does not go together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_text import Printer
from variants import daily_rows

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


def mesh_bones(bones: Path, out: Path, *options: str) -> tuple[int, dict[str, Any]]:
    report = out / "report.json"
    code = main(["mesh", str(bones / "bones.nii.gz"), "-o", str(out / "a.stl"), "--report", str(report), *options])
    return code, json.loads(report.read_text()) if report.exists() else {}


def test_names_of_methods_in_settings_are_those_of_the_table_of_methods() -> None:
    assert tuple(METHODS) == METHOD_NAMES


@pytest.fixture
def grown(bones: Path, tmp_path: Path, printed: Printer, device: Any) -> tuple[dict[str, Any], Any]:
    """The report of a mesh grown from seeds that are found by themselves, and what was printed."""
    code, report = mesh_bones(bones, tmp_path, "--grow-from", "auto", "-v")
    assert code == 0
    return report, printed()


def test_mesh_grown_from_seeds_found_by_themselves_keeps_two_blocks_and_leaves_the_crumb(
    grown: tuple[dict[str, Any], Any],
) -> None:
    report, _ = grown
    assert (report["method"], report["grow_from"], report["vertex_rule"]) == ("i-mc", ["auto"], "linear")
    assert (report["components"], report["growing"]["components"]) == (2, 3)


def test_report_and_words_of_a_grown_mesh_count_its_cells(grown: tuple[dict[str, Any], Any]) -> None:
    report, said = grown
    cells = report["cells"]

    of_the_crumb = 8  # about a single voxel
    assert cells["all"] == 41 * 31 * 21  # of 40 x 30 x 20 voxels in a layer of air
    assert cells["active"] == cells["grown"] + of_the_crumb
    assert report["meshes"][0]["growing"] == report["growing"]
    said.assert_output(cells["visited"], cells["active"], cells["all"], 2, 3, of_the_crumb)


def test_mesh_grown_from_a_point_is_that_grown_from_a_label_about_it(bones: Path, tmp_path: Path, device: Any) -> None:
    point, label = tmp_path / "point", tmp_path / "label"
    point.mkdir()
    label.mkdir()

    _, by_point = mesh_bones(bones, point, "--grow-from", "30,10,20")
    _, by_label = mesh_bones(bones, label, "--grow-from", "label:7", "--labels", str(bones / "labels.nii.gz"))

    assert by_point["components"] == 1  # the small block
    assert (by_point["growing"]["from"], by_label["growing"]["from"]) == (["30,10,20"], ["label label_7"])
    assert by_label["meshes"][0]["label"] is None  # it is no mesh of the label
    assert by_point["cells"] == by_label["cells"]
    assert (point / "a.stl").read_bytes() == (label / "a.stl").read_bytes()


def test_point_in_ras_grows_the_mesh_of_the_point_in_lps(bones: Path, tmp_path: Path, device: Any) -> None:
    _, in_lps = mesh_bones(bones, tmp_path, "--grow-from", "30,10,20")
    _, in_ras = mesh_bones(bones, tmp_path, "--grow-from=-30,-10,20", "--space", "ras")
    assert in_ras["triangles"] == in_lps["triangles"]


@pytest.mark.parametrize(
    ("method", "options"),
    daily_rows(
        2, [("t-mc-soup", []), ("skimage", []), ("s-mc", ["--decimate", "0.3"]), ("g-mc", ["--decimate", "0.3"])]
    ),
)
def test_mesh_of_every_other_method_has_the_volume_of_the_blocks(
    method: str, options: list[str], bones: Path, tmp_path: Path, device: Any
) -> None:
    if method == "skimage":
        pytest.importorskip("skimage")

    code, report = mesh_bones(bones, tmp_path, "--method", method, *options)

    assert (code, report["method"]) == (0, method)
    # From centre to centre a voxel less, and on either side a quarter: 200 HU on the way from 600 to -1000.
    blocks_ml = (19.5 * 19.5 * 13.5 + 7.5 * 9.5 * 9.5) * 2 / 1000  # voxels of 2 cubic mm
    assert report["volume_ml"] == pytest.approx(blocks_ml, rel=0.004)  # edges are cut: measured 0.16 % less
    assert (report["refinement"] is not None) == bool(options)


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
def test_method_and_option_that_exclude_each_other_are_refused(
    options: list[str], words: str, bones: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], device: Any
) -> None:
    given = [str(bones / "labels.nii.gz") if option == "LABELS" else option for option in options]
    try:
        code, _ = mesh_bones(bones, tmp_path, *given)
    except SystemExit as error:
        code = int(error.code or 0)
    said = capsys.readouterr().err
    assert code == 3 and words in said
    assert list(tmp_path.iterdir()) == []
