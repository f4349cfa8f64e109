"""``clrecon batch``: the files of each case, the table, what a second run leaves alone, and who is named nowhere."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ct_files import find_words, write_series
from label_files import write_nifti

from clrecon.cli.main import main
from clrecon.errors import PARTLY_DONE
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
    """A folder with the manifest m.csv, and out/ with three balls, A, B and C, and the case "gone" without a scan."""
    folder = write_cohort(tmp_path_factory.mktemp("cohort"))
    assert main(["batch", str(folder / "m.csv"), "-o", str(folder / "out"), "--hu", "0", "-q"]) == PARTLY_DONE
    return folder


def test_case_without_a_scan_is_refused_and_the_others_are_done(cohort: Path) -> None:
    rows = read_rows(cohort / "out")
    assert [*rows] == ["A", "B", "gone", "C"]
    assert [row["status"] for row in rows.values()] == ["done", "done", "refused", "done"]
    assert rows["gone"]["error"] == "NoDicomError"
    assert sorted(path.name for path in (cohort / "out" / "gone").iterdir()) == ["case.json"]


def test_case_without_a_scan_is_named_with_its_input(tmp_path: Path, printed: Any) -> None:
    (tmp_path / "m.csv").write_text("case,input\ngone,nowhere-4711\n")
    assert main(["batch", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out")]) == PARTLY_DONE
    printed().assert_error("gone", "nowhere-4711")


def test_mesh_of_a_case_is_that_of_the_mesh_command(cohort: Path, tmp_path: Path) -> None:
    assert main(["mesh", str(cohort / "ball2"), "-o", str(tmp_path / "b.stl"), "--hu", "0", "-q"]) == 0
    assert (cohort / "out" / "B" / "mesh.stl").read_bytes() == (tmp_path / "b.stl").read_bytes()


def test_report_of_a_case_has_the_sizes_of_its_files(cohort: Path) -> None:
    folder = cohort / "out" / "C"

    files = json.loads((folder / "case.json").read_text())["files"]

    assert {file["name"]: file["bytes"] for file in files} == {
        name: (folder / name).stat().st_size for name in ("mesh.stl", "picture.png")
    }


def test_report_of_a_case_has_the_volume_and_gates_of_its_mesh(cohort: Path) -> None:
    mesh = json.loads((cohort / "out" / "C" / "case.json").read_text())["mesh"]

    radius_cm = 0.5  # in voxels of 1 mm: measured 3.6 % less
    assert mesh["volume_ml"] == pytest.approx(4 / 3 * np.pi * radius_cm**3, rel=0.05)
    assert {gate["name"] for gate in mesh["gates"]} >= {"closed", "manifold"}


def test_report_of_a_case_has_the_facts_of_its_scan_and_of_the_run(cohort: Path) -> None:
    report = json.loads((cohort / "out" / "C" / "case.json").read_text())

    assert report["volume"]["slices"] == 12 + 4 * 3  # of the third ball
    assert report["volume"]["series"]["uid_hash"] is None
    assert {"seconds", "peak_memory_bytes", "version", "device", "warnings"} <= {*report}


def test_row_of_a_case_in_the_table_has_the_figures_of_its_report(cohort: Path) -> None:
    row = read_rows(cohort / "out")["A"]
    report = json.loads((cohort / "out" / "A" / "case.json").read_text())

    assert int(row["triangles"]) == report["mesh"]["triangles"]
    assert int(row["slices"]) == report["volume"]["slices"]
    assert float(row["volume_ml"]) == pytest.approx(report["mesh"]["volume_ml"], abs=1e-6)  # six decimals


def test_case_with_cloud_and_two_views_without_a_mesh_has_these_files_and_the_cloud_of_the_command(
    cohort: Path, tmp_path: Path
) -> None:
    (tmp_path / "m.csv").write_text(f"case,input,hu,cloud\nA,{cohort / 'ball1'},0,ply\n")
    options = ["--no-mesh", "--view", "left,anterior"]

    assert main(["batch", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out"), "--hu", "50", "-q", *options]) == 0

    files = files_of(tmp_path / "out" / "A")
    assert {*files} == {"case.json", "cloud.ply", "picture_anterior.png", "picture_left.png"}
    assert json.loads(files["case.json"])["mesh"]["triangles"] > 0
    cloud = tmp_path / "cloud.ply"
    assert main(["cloud", str(cohort / "ball1"), "-o", str(cloud), "--hu", "0", "--normals", "-q"]) == 0
    assert files["cloud.ply"] == cloud.read_bytes()


def test_cloud_of_two_levels_is_refused_before_any_case(cohort: Path, tmp_path: Path, printed: Any) -> None:
    (tmp_path / "m.csv").write_text(f"case,input\nA,{cohort / 'ball1'}\n")
    command = ["batch", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out"), "--hu", "0,50", "--cloud", "ply"]
    assert main(command) == 3
    printed().assert_error("--cloud", "--hu")
    assert not (tmp_path / "out").exists()


@dataclass
class Batch:
    """A folder with a manifest of four cases, and its output."""

    folder: Path

    def run(self, *options: str, hu: str = "0") -> int:
        return main(["batch", str(self.folder / "m.csv"), "-o", str(self.folder / "out"), "--hu", hu, *options])


@pytest.fixture
def whole_batch(cohort: Path, tmp_path: Path) -> Batch:
    """Three balls that were made, and a case without a scan."""
    return Batch(shutil.copytree(cohort, tmp_path / "cohort"))


@pytest.mark.seconds
def test_part_of_a_batch_writes_its_cases_and_no_table(tmp_path: Path) -> None:
    batch = Batch(write_cohort(tmp_path))

    assert batch.run("--part", "1/2", "--no-picture", "-q") == PARTLY_DONE

    # Of A, B, gone and C the first and the third.
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["A", "gone"]


@pytest.mark.seconds
def test_resume_makes_missing_and_changed_cases_and_ends_with_the_files_of_a_whole_run(
    whole_batch: Batch, printed: Any
) -> None:
    output = whole_batch.folder / "out"
    whole = {name: data for name, data in files_of(output).items() if name.endswith((".stl", ".png"))}
    assert len(whole) == 2 * 3  # a mesh and a picture of each ball
    shutil.rmtree(output / "B")
    (output / "A" / "mesh.stl").write_bytes(b"cut")
    printed()

    assert whole_batch.run("--resume", "--json") == PARTLY_DONE

    report = printed().report()
    assert (report["cases"], report["made"], report["kept"]) == (4, 3, 1)  # the case that is gone is tried again
    resumed = files_of(output)
    assert {name: resumed[name] for name in whole} == whole


@pytest.mark.seconds
def test_resume_of_a_whole_batch_keeps_its_cases_and_tries_refused_ones_again(whole_batch: Batch, printed: Any) -> None:
    printed()

    assert whole_batch.run("--resume", "--json") == PARTLY_DONE

    report = printed().report()
    assert (report["made"], report["kept"], report["statuses"]) == (1, 3, {"done": 3, "refused": 1})


@pytest.mark.seconds
def test_resume_with_another_setting_makes_all_cases(whole_batch: Batch, printed: Any) -> None:
    printed()

    assert whole_batch.run("--resume", "--json", hu="250") == PARTLY_DONE

    report = printed().report()
    assert (report["made"], report["kept"]) == (4, 0)


@pytest.mark.seconds
def test_retry_makes_refused_cases_again_and_leaves_done_ones_as_they_are(whole_batch: Batch, printed: Any) -> None:
    folder = whole_batch.folder
    before = files_of(folder / "out" / "A")
    (folder / "ball1").rename(folder / "ball4")  # the scan of the case that was gone
    printed()

    assert whole_batch.run("--retry", "--json", hu="400") == 0

    report = printed().report()
    assert (report["made"], report["kept"], report["statuses"]) == (1, 3, {"done": 4})
    assert files_of(folder / "out" / "A") == before


@pytest.mark.seconds
@pytest.mark.parametrize(
    ("status", "made", "kept"), [("refused", 1, 3), ("missing", 1, 4), ("missing,refused", 2, 3), ("failed", 0, 4)]
)
def test_retry_of_a_status_makes_the_cases_that_have_it_and_keeps_those_that_are_there(
    whole_batch: Batch, printed: Any, status: str, made: int, kept: int
) -> None:
    """Three are done, `gone` is refused, `later` has never run."""
    with (whole_batch.folder / "m.csv").open("a") as table:
        table.write("later,ball1\n")
    printed()
    assert whole_batch.run("--retry", status, "--json") == PARTLY_DONE
    report = printed().report()
    assert (report["made"], report["kept"]) == (made, kept)


def test_retry_of_a_part_whose_cases_are_done_succeeds(whole_batch: Batch, printed: Any) -> None:
    printed()
    assert whole_batch.run("--retry", "--part", "1/4", "--json") == 0  # case A alone
    assert printed().report()["statuses"] == {"done": 1}


def test_collect_names_cases_that_were_not_made(whole_batch: Batch, printed: Any) -> None:
    (whole_batch.folder / "m.csv").write_text("case,input\nA,ball1\nlater,ball2\nnever,ball3\n")
    printed()
    assert whole_batch.run("--collect") == PARTLY_DONE
    printed().assert_error(2, 3, "later", "never")  # 2 of 3 cases


def test_collect_lists_a_case_that_was_not_made_as_missing_and_makes_none(whole_batch: Batch, printed: Any) -> None:
    output = whole_batch.folder / "out"
    (whole_batch.folder / "m.csv").write_text("case,input\nA,ball1\nlater,ball2\n")
    before = files_of(output / "A")
    printed()

    assert whole_batch.run("--collect", "--json") == PARTLY_DONE

    assert printed().report()["statuses"] == {"done": 1, "missing": 1}
    assert read_rows(output)["later"]["status"] == "missing"
    assert not (output / "later").exists()
    assert files_of(output / "A") == before


def test_existing_cases_stay_with_no_clobber(cohort: Path, printed: Any) -> None:
    before = files_of(cohort / "out")
    assert main(["batch", str(cohort / "m.csv"), "-o", str(cohort / "out"), "--no-clobber"]) == 6
    printed().assert_error(4, "A")  # cases that exist, and the first of them
    assert files_of(cohort / "out") == before


@pytest.fixture(scope="module")
def labelled_batch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of two cases of a cube of 400 HU: `with` a label map of its two halves of 108 voxels, and `without`."""
    folder = tmp_path_factory.mktemp("labelled")
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    voxels = np.zeros((12, 12, 12), np.int16)
    voxels[3:9, 3:9, 3:9] = 400
    labels = np.zeros(voxels.shape, np.uint8)
    labels[3:6, 3:9, 3:9] = 1
    labels[6:9, 3:9, 3:9] = 2
    write_nifti(folder / "ct.nii", voxels, affine)
    write_nifti(folder / "l.nii", labels, affine)
    (folder / "m.csv").write_text("case,input,labels\nwith,ct.nii,l.nii\nwithout,ct.nii,\n")
    assert main(["batch", str(folder / "m.csv"), "-o", str(folder / "out"), "--hu", "200", "-q"]) == 0
    return folder / "out"


@pytest.mark.seconds
def test_case_with_a_label_map_has_a_mesh_of_each_label_and_a_table_of_their_statistics(labelled_batch: Path) -> None:
    assert sorted(path.name for path in (labelled_batch / "with").iterdir()) == [
        "case.json", "labels.csv", "mesh_label_1.stl", "mesh_label_2.stl", "picture.png",
    ]  # fmt: skip
    assert not (labelled_batch / "without" / "labels.csv").exists()


@pytest.mark.seconds
def test_statistics_of_labels_are_in_the_report_of_the_case_and_the_table_of_the_cohort(labelled_batch: Path) -> None:
    with (labelled_batch / "cohort_labels.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    report = json.loads((labelled_batch / "with" / "case.json").read_text())

    assert [(row["case"], row["number"], float(row["mean_hu"])) for row in rows] == [
        ("with", "1", 400.0), ("with", "2", 400.0),
    ]  # fmt: skip
    voxel_ml = 2.0**3 / 1000
    assert [label["ml"] for label in report["labels"]] == [pytest.approx(108 * voxel_ml)] * 2


def test_case_that_fails_a_strict_gate_has_status_gate_and_keeps_its_mesh(tmp_path: Path) -> None:
    # A slice is missing, which --allow-gaps reads and a gate of the scan marks.
    write_phantom(tmp_path / "ct", PhantomSettings(kind="sphere", size=(24, 24), slices=16, noise=0.0, missing=(7,)))
    (tmp_path / "m.csv").write_text("case,input\na,ct\n")
    command = ["batch", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out"), "--hu", "300", "--allow-gaps", "-q"]
    assert main([*command, "--strict"]) == PARTLY_DONE
    assert read_rows(tmp_path / "out")["a"]["status"] == "gate"
    assert (tmp_path / "out" / "a" / "mesh.stl").exists()


def test_files_and_words_of_a_batch_do_not_name_the_patient(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder, output = tmp_path / "scan of Jolanthe", tmp_path / "out"
    write_series(folder, number=1)
    (folder / "broken.dcm").write_bytes(b"\0" * 128 + b"DICM")
    write_series(folder / "more", number=2)

    main(["batch", str(folder), "-o", str(output), "--hu", "0", "-v"])

    streams = "".join(capfd.readouterr()).encode()
    files = files_of(output)
    assert {"series-001", "series-002"} <= {path.name for path in output.iterdir()}
    assert find_words(b"\n".join([*(name.encode() for name in files), streams, *files.values()])) == []
