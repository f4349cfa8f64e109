"""The vertebrae job and its command: files that appear together, exit codes, no patient in what is written."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from PIL import Image
from printed_text import Printer
from web_servers import Archive, running

from clrecon.cli.main import main
from clrecon.labels import read_labels, resample_labels
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.reading import read_volume
from clrecon.spine.regions import WEIGHTS

pytest.importorskip("nibabel")


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A phantom of three vertebrae, L1 to L3, in voxels of 2.2 x 2.2 x 2.5 mm."""
    folder = tmp_path_factory.mktemp("vertebrae") / "ct"
    write_phantom(folder, PhantomSettings(levels="L1-L3", facet_gap_mm=0.0, size=(96, 96), spacing=(2.2, 2.2, 2.5)))
    return folder


@pytest.fixture(scope="module")
def written(scan: Path) -> Path:
    """The folder of one run: label map, picture, report."""
    folder = scan.parent / "written"
    folder.mkdir()
    given = ["vertebrae", str(scan), "-o", str(folder / "a.nii.gz"), "--report", str(folder / "a.json"), "-q"]
    assert main(given) == 0
    return folder


@pytest.mark.seconds
def test_vertebrae_are_numbered_in_the_written_label_map_and_the_report(written: Path) -> None:
    labels = read_labels(written / "a.nii.gz")
    report = json.loads((written / "a.json").read_text())

    assert sorted(path.name for path in written.iterdir()) == ["a.json", "a.nii.gz", "a.png"]
    assert labels.names == {1: "vertebra_1", 2: "vertebra_2", 3: "vertebra_3"}
    assert [one["number"] for one in report["vertebrae"]] == [1, 2, 3]
    assert (report["written"], report["low_confidence"], len(report["discs"])) == (3, 0, 2)


def test_reported_volume_of_each_vertebra_is_that_of_its_voxels(written: Path) -> None:
    labels = read_labels(written / "a.nii.gz")
    report = json.loads((written / "a.json").read_text())

    voxel_ml = 2.2 * 2.2 * 2.5 / 1000
    volumes = {one["number"]: one["volume_ml"] for one in report["vertebrae"]}
    expected = {number: labels.counts[number] * voxel_ml for number in (1, 2, 3)}
    assert volumes == pytest.approx(expected, rel=1e-3)  # reports have 3 decimals


def test_report_of_vertebrae_has_no_hash_of_the_series_and_warnings_once(written: Path) -> None:
    report = json.loads((written / "a.json").read_text())

    assert report["volume"]["series"]["uid_hash"] is None
    assert "warnings" in report
    assert "warnings" not in report["volume"]


def test_picture_of_vertebrae_has_a_yellow_line_for_each_disc_and_both_ends(written: Path) -> None:
    with Image.open(written / "a.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)

    assert pixels.shape[0] > 3 * 100  # 3 rows a mm of the spine from L1 to L3; 354 were measured
    yellow_rows = np.flatnonzero((np.abs(pixels - [255, 230, 0]).max(axis=2) < 10).any(axis=1))
    lines = 1 + np.count_nonzero(np.diff(yellow_rows) > 20)  # rows apart
    discs, ends = 2, 2
    assert lines == discs + ends


@pytest.mark.release
def test_front_and_back_come_from_the_affine_where_no_patient_position_is_stated(
    scan: Path, written: Path, tmp_path: Path
) -> None:
    silent = tmp_path / "silent"
    silent.mkdir()
    for path in scan.glob("*.dcm"):
        header = pydicom.dcmread(path)
        del header.PatientPosition
        header.save_as(silent / path.name)
    assert read_volume(silent).report["patient_position"] is None
    assert main(["vertebrae", str(silent), "-o", str(tmp_path / "a.nii.gz"), "-q"]) == 0
    assert np.array_equal(read_labels(tmp_path / "a.nii.gz").voxels, read_labels(written / "a.nii.gz").voxels)


def test_vertebrae_without_a_landmark_are_said_to_be_numbers_from_the_head(
    scan: Path, tmp_path: Path, printed: Printer
) -> None:
    assert main(["vertebrae", str(scan), "-o", str(tmp_path / "a.nii.gz")]) == 0
    printed().assert_output("numbers", "counted", "head")


def test_level_in_a_map_of_numbers_is_refused_and_they_are_listed(
    scan: Path, written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = ["--labels", str(written / "a.nii.gz"), "--label", "L3"]

    assert main(["mesh", str(scan), "-o", str(tmp_path / "a.stl"), *labels]) == 3

    assert "1 vertebra_1, 2 vertebra_2, 3 vertebra_3. These are numbers and no levels" in capsys.readouterr().err


NUMBER_OF_L1 = 20
"""In label maps; L2 and L3 follow."""


def test_vertebrae_with_a_first_level_are_the_same_voxels_with_the_names_of_levels(
    scan: Path, written: Path, tmp_path: Path, printed: Printer
) -> None:
    path = tmp_path / "a.nii.gz"

    assert main(["vertebrae", str(scan), "-o", str(path), "--first", "l1"]) == 0

    named = read_labels(path)
    assert named.names == {20: "L1", 21: "L2", 22: "L3"}
    from_1_on = np.where(named.voxels, named.voxels - (NUMBER_OF_L1 - 1), 0)
    assert np.array_equal(from_1_on, read_labels(written / "a.nii.gz").voxels)
    assert "counted from the head" not in printed().everything


@pytest.fixture(scope="module")
def segmentation(scan: Path, written: Path) -> Path:
    """The folder of a run on a zip file that wrote a DICOM SEG, with L2 named at its centre, and other.png.

    Beside it is stored.dcm, what an archive got.
    """
    folder = scan.parent / "segmentation"
    folder.mkdir()
    middle = json.loads((written / "a.json").read_text())["vertebrae"][1]["centre_mm"]
    name = f"{','.join(str(value) for value in middle)}=L2"
    packed = shutil.make_archive(str(scan.parent / "packed"), "zip", scan)
    command = ["vertebrae", packed, "-o", str(folder / "s.dcm"), "--picture", str(folder / "other.png"), "-q"]
    with running(Archive(scan)) as archive:
        assert main([*command, "--name-at", name, "--store", archive.study]) == 0
    [stored] = archive.stored()
    stored.save_as(scan.parent / "stored.dcm")
    return folder


def test_stored_map_of_vertebrae_is_the_file_with_the_patient_of_the_scan(scan: Path, segmentation: Path) -> None:
    stored, written = scan.parent / "stored.dcm", segmentation / "s.dcm"

    np.testing.assert_array_equal(read_labels(stored).voxels, read_labels(written).voxels)
    first = pydicom.dcmread(next(scan.glob("*.dcm")))
    assert pydicom.dcmread(stored).PatientName == first.PatientName != ""
    assert pydicom.dcmread(stored).SOPInstanceUID != pydicom.dcmread(written).SOPInstanceUID


def test_dicom_seg_of_vertebrae_has_the_voxels_of_the_nifti_map_with_the_names_of_levels(
    scan: Path, written: Path, segmentation: Path
) -> None:
    named = read_labels(segmentation / "s.dcm")

    assert named.names == {20: "L1", 21: "L2", 22: "L3"}
    on_the_scan = resample_labels(named, read_volume(scan))
    assert on_the_scan.exact
    from_1_on = np.where(on_the_scan.voxels, on_the_scan.voxels - (NUMBER_OF_L1 - 1), 0)
    assert np.array_equal(from_1_on, read_labels(written / "a.nii.gz").voxels)


def test_dicom_seg_of_vertebrae_does_not_name_the_patient(segmentation: Path) -> None:
    assert str(pydicom.dcmread(segmentation / "s.dcm").PatientName) == ""
    assert b"PHANTOM" not in (segmentation / "s.dcm").read_bytes()  # the name in the scan


def test_picture_of_vertebrae_has_the_given_name(segmentation: Path) -> None:
    assert sorted(path.name for path in segmentation.iterdir()) == ["other.png", "s.dcm"]


@pytest.fixture
def doubted_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    """The vertebra between two discs has two reasons for a low confidence, the others none."""
    from clrecon.spine import split

    def judge(piece: Any, *given: Any) -> dict[str, tuple[float, str]]:
        between = piece.upper is not None and piece.upper.is_disc and piece.lower is not None and piece.lower.is_disc
        value = 0.0 if between else 1.0
        return {
            "volume": (value, "a doubt of the test"),
            "arch": (value, "a greater one"),
            "line": (0.9, "a small one"),
        }

    monkeypatch.setattr(split, "judge", judge)


CONFIDENCE_OF_THE_DOUBTED = math.exp(-(WEIGHTS["volume"] + WEIGHTS["arch"] + (1.0 - 0.9) * WEIGHTS["line"]))


@pytest.mark.usefixtures("doubted_middle")
@pytest.mark.seconds
def test_vertebra_of_low_confidence_is_left_out_with_its_reasons_and_exit_code_8(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["vertebrae", str(scan), "-o", str(tmp_path / "a.nii.gz")]) == 8

    assert read_labels(tmp_path / "a.nii.gz").numbers == (1, 3)
    printed = capsys.readouterr()
    reasons = "is not in the label map: a greater one; a doubt of the test"
    assert f"vertebra_2 has low confidence ({CONFIDENCE_OF_THE_DOUBTED:.2f}) and {reasons}" in printed.err
    assert "1 of low confidence" in printed.out


@pytest.mark.usefixtures("doubted_middle")
@pytest.mark.seconds
def test_vertebra_of_low_confidence_is_kept_on_request_with_exit_code_8(
    scan: Path, tmp_path: Path, printed: Printer
) -> None:
    assert main(["vertebrae", str(scan), "-o", str(tmp_path / "a.nii.gz"), "--keep-unsure"]) == 8

    assert read_labels(tmp_path / "a.nii.gz").numbers == (1, 2, 3)
    printed().assert_error("vertebra_2", round(CONFIDENCE_OF_THE_DOUBTED, 2))


@pytest.mark.parametrize(
    ("extra", "code", "words"),
    [
        (["-o", "a.txt"], 3, ".nii.gz"),
        (["-o", ".dcm"], 3, ".nii.gz"),
        (["-o", "a.nii.gz", "--picture", "a.jpg"], 3, ".png"),
        (["-o", "a.nii.gz", "--report", "a.png"], 3, "same file"),
        (["-o", "no/a.nii.gz"], 6, "no"),
        (["-o", "a.nii.gz", "--seed", "1,2,3"], 3, "two at least"),
        (["-o", "a.nii.gz", "--name-at", "1,2,3"], 3, "X,Y,Z=L3"),
        (["-o", "a.nii.gz", "--name-at", "1,2,3=S7"], 3, "no vertebra"),
        (["-o", "a.nii.gz", "--name-at", "1,2,3000=L1"], 3, "no vertebra at"),
        (["-o", "a.nii.gz", "--hu", "nan"], 3, "HU"),
        (["-o", "a.nii.gz", "--first", "S1"], 3, "no vertebra 'S1'"),
        (["-o", "a.nii.gz", "--first", "L5"], 3, "3 vertebrae were found from L5"),
        (["-o", "a.nii.gz", "--first", "T1", "--name-at", "1,2,3=L1"], 3, "--first and --name-at both name levels"),
    ],
)
def test_wrong_usage_of_vertebrae_is_refused_in_one_line_and_writes_nothing(
    extra: list[str], code: int, words: str, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)

    assert main(["vertebrae", str(scan), *extra, "-q"]) == code

    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert list(tmp_path.iterdir()) == []


def test_dicom_seg_of_a_scan_that_is_not_dicom_is_refused(written: Path, tmp_path: Path, printed: Printer) -> None:
    assert main(["vertebrae", str(written / "a.nii.gz"), "-o", str(tmp_path / "a.dcm")]) == 3
    printed().assert_error("NIfTI")


def test_existing_picture_of_vertebrae_stays_with_no_clobber(scan: Path, tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "a.png").write_text("mine")
    assert main(["vertebrae", str(scan), "-o", str(tmp_path / "a.nii.gz"), "--no-clobber"]) == 6
    printed().assert_error("a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
