"""``clrecon batch``: the files of each case, the table, what a second run leaves alone, and who is named nowhere."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ct_files import find_words, write_series
from label_files import write_nifti

from clrecon.cli.main import main
from clrecon.proof.phantom import PhantomSettings, write_phantom


def read_rows(output: Path) -> dict[str, dict[str, str]]:
    with (output / "cohort.csv").open(newline="", encoding="utf-8") as stream:
        return {row["case"]: row for row in csv.DictReader(stream)}


def files_of(output: Path) -> dict[str, bytes]:
    return {str(path.relative_to(output)): path.read_bytes() for path in output.rglob("*") if path.is_file()}


def write_cohort(folder: Path) -> Path:
    """Write three balls of different sizes and a manifest that names a fourth, which is not there."""
    for number in (1, 2, 3):
        settings = PhantomSettings(
            kind="sphere", size=(24, 24), slices=12 + 4 * number, spacing=(1.0, 1.0, 1.0), radius_mm=5.0, noise=0.0
        )
        write_phantom(folder / f"ball{number}", settings)
    (folder / "m.csv").write_text("case,input\nA,ball1\nB,ball2\ngone,ball4\nC,ball3\n")
    return folder


@pytest.fixture(scope="module")
def cohort(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_cohort(tmp_path_factory.mktemp("cohort"))
    assert main(["batch", str(folder / "m.csv"), "-o", str(folder / "out"), "--hu", "0", "-q"]) == 8
    return folder


def test_one_bad_case_stops_no_other(cohort: Path) -> None:
    rows = read_rows(cohort / "out")
    assert [*rows] == ["A", "B", "gone", "C"]
    assert [row["status"] for row in rows.values()] == ["done", "done", "refused", "done"]
    assert rows["gone"]["error"] == "NoDicomError"
    assert sorted(path.name for path in (cohort / "out" / "gone").iterdir()) == ["case.json"]


def test_refused_case_is_told_with_what_its_input_lacks(tmp_path: Path, printed: Any) -> None:
    (tmp_path / "m.csv").write_text("case,input\ngone,nowhere-4711\n")
    assert main(["batch", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out")]) == 8
    printed().assert_error("gone", "nowhere-4711")


def test_mesh_of_a_case_is_that_of_the_mesh_command(cohort: Path, tmp_path: Path) -> None:
    assert main(["mesh", str(cohort / "ball2"), "-o", str(tmp_path / "b.stl"), "--hu", "0", "-q"]) == 0
    assert (cohort / "out" / "B" / "mesh.stl").read_bytes() == (tmp_path / "b.stl").read_bytes()


def test_report_of_a_case_names_its_files_and_holds_mesh_certificate_and_gates(cohort: Path) -> None:
    report = json.loads((cohort / "out" / "C" / "case.json").read_text())
    folder = cohort / "out" / "C"
    assert {file["name"]: file["bytes"] for file in report["files"]} == {
        name: (folder / name).stat().st_size for name in ("mesh.stl", "picture.png")
    }
    assert report["mesh"]["volume_ml"] == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=0.05)
    assert {gate["name"] for gate in report["mesh"]["gates"]} >= {"closed", "manifold"}
    assert report["volume"]["slices"] == 24 and report["volume"]["series"]["uid_hash"] is None
    assert {"seconds", "peak_memory_bytes", "version", "device", "warnings"} <= {*report}


def test_figures_of_the_table_are_those_of_the_reports(cohort: Path) -> None:
    row = read_rows(cohort / "out")["A"]
    report = json.loads((cohort / "out" / "A" / "case.json").read_text())
    assert int(row["triangles"]) == report["mesh"]["triangles"] and int(row["slices"]) == 16
    assert float(row["volume_ml"]) == pytest.approx(report["mesh"]["volume_ml"], abs=1e-6)


@pytest.mark.seconds
def test_resume_makes_what_is_missing_or_changed_and_ends_with_the_same_bytes(
    cohort: Path, tmp_path: Path, printed: Any
) -> None:
    folder = write_cohort(tmp_path)
    command = ["batch", str(folder / "m.csv"), "-o", str(folder / "out"), "--hu", "0"]
    assert main([*command, "--part", "1/2", "-q"]) == 8  # A and the case that is gone
    assert not (folder / "out" / "cohort.csv").exists()
    (folder / "out" / "A" / "mesh.stl").write_bytes(b"cut")
    printed()
    assert main([*command, "--resume", "--json"]) == 8
    report = printed().report()
    assert (report["cases"], report["made"], report["kept"]) == (4, 4, 0)  # of the case that is gone no file tells
    assert main([*command, "--resume", "--json"]) == 8
    report = printed().report()
    assert (report["made"], report["kept"], report["statuses"]) == (1, 3, {"done": 3, "refused": 1})
    meshes = {name: data for name, data in files_of(cohort / "out").items() if name.endswith((".stl", ".png"))}
    assert {name: data for name, data in files_of(folder / "out").items() if name in meshes} == meshes
    assert main([*command[:-1], "250", "--resume", "--json"]) == 8
    assert printed().report()["kept"] == 0


@pytest.mark.seconds
def test_retry_makes_failed_cases_alone(cohort: Path, tmp_path: Path, printed: Any) -> None:
    folder = write_cohort(tmp_path)
    command = ["batch", str(folder / "m.csv"), "-o", str(folder / "out"), "--no-picture", "--no-measure"]
    assert main([*command, "--hu", "300", "-q"]) == 8
    before = files_of(folder / "out" / "A")
    (folder / "ball1").rename(folder / "ball4")
    printed()
    assert main([*command, "--hu", "400", "--retry", "--json"]) == 0
    report = printed().report()
    assert (report["made"], report["kept"], report["statuses"]) == (1, 3, {"done": 4})
    assert files_of(folder / "out" / "A") == before


def test_collect_names_what_is_missing_and_makes_nothing(cohort: Path, tmp_path: Path, printed: Any) -> None:
    (cohort / "more.csv").write_text("case,input\nA,ball1\nlater,ball2\n")
    before = files_of(cohort / "out" / "A")
    assert main(["batch", str(cohort / "more.csv"), "-o", str(cohort / "out"), "--collect", "--json"]) == 8
    assert printed().report()["statuses"] == {"done": 1, "missing": 1}
    assert read_rows(cohort / "out")["later"]["status"] == "missing"
    assert files_of(cohort / "out" / "A") == before
    assert main(["batch", str(cohort / "m.csv"), "-o", str(cohort / "out"), "--collect", "-q"]) == 8


def test_existing_cases_stay_with_no_clobber(cohort: Path, printed: Any) -> None:
    before = files_of(cohort / "out")
    assert main(["batch", str(cohort / "m.csv"), "-o", str(cohort / "out"), "--no-clobber"]) == 6
    printed().assert_error(4, "A")
    assert files_of(cohort / "out") == before


@pytest.mark.seconds
def test_labels_of_a_row_give_meshes_and_statistics(tmp_path: Path) -> None:
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    voxels = np.zeros((12, 12, 12), np.int16)
    voxels[3:9, 3:9, 3:9] = 400
    labels = np.zeros(voxels.shape, np.uint8)
    labels[3:6, 3:9, 3:9] = 1
    labels[6:9, 3:9, 3:9] = 2
    write_nifti(tmp_path / "ct.nii", voxels, affine)
    write_nifti(tmp_path / "l.nii", labels, affine)
    (tmp_path / "m.csv").write_text("case,input,labels\nwith,ct.nii,l.nii\nwithout,ct.nii,\n")
    output = tmp_path / "out"
    assert main(["batch", str(tmp_path / "m.csv"), "-o", str(output), "--hu", "200", "-q"]) == 0
    assert sorted(path.name for path in (output / "with").iterdir()) == [
        "case.json", "labels.csv", "mesh_label_1.stl", "mesh_label_2.stl", "picture.png",
    ]  # fmt: skip
    assert not (output / "without" / "labels.csv").exists()
    with (output / "cohort_labels.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["case"], row["number"], float(row["mean_hu"])) for row in rows] == [
        ("with", "1", 400.0), ("with", "2", 400.0),
    ]  # fmt: skip
    report = json.loads((output / "with" / "case.json").read_text())
    assert [label["ml"] for label in report["labels"]] == [pytest.approx(108 * 0.008)] * 2


def test_strict_gates_are_a_status_of_their_own(tmp_path: Path) -> None:
    write_phantom(tmp_path / "ct", PhantomSettings(kind="sphere", size=(24, 24), slices=16, noise=0.0, missing=(7,)))
    (tmp_path / "m.csv").write_text("case,input\na,ct\n")
    command = ["batch", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out"), "--hu", "300", "--allow-gaps", "-q"]
    assert main([*command, "--strict"]) == 8
    assert read_rows(tmp_path / "out")["a"]["status"] == "gate"
    assert (tmp_path / "out" / "a" / "mesh.stl").exists()


def test_no_file_of_a_batch_and_no_word_names_the_patient(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_series(tmp_path / "scan of Jolanthe", number=1)
    (tmp_path / "scan of Jolanthe" / "broken.dcm").write_bytes(b"\0" * 128 + b"DICM")
    write_series(tmp_path / "scan of Jolanthe" / "more", number=2)
    output = tmp_path / "out"
    main(["batch", str(tmp_path / "scan of Jolanthe"), "-o", str(output), "--hu", "0", "-v"])
    streams = "".join(capfd.readouterr())
    assert {"series-001", "series-002"} <= {path.name for path in output.iterdir()}
    names = "\n".join(files_of(output)).encode()
    tables = [data for name, data in files_of(output).items() if "broken" not in name]
    assert find_words(names + streams.encode() + b"\n".join(tables)) == []
