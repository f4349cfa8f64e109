"""The vertebrae job and its command: files that appear together, exit codes, no patient in what is written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from printed_text import Printer

from clrecon.cli.main import main
from clrecon.labels import read_labels, resample_labels
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.reading import read_volume

pytest.importorskip("nibabel")


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
def test_a_run_writes_map_picture_and_report(written: Path) -> None:
    from PIL import Image

    assert sorted(path.name for path in written.iterdir()) == ["a.json", "a.nii.gz", "a.png"]
    report = json.loads((written / "a.json").read_text())
    labels = read_labels(written / "a.nii.gz")
    assert labels.names == {1: "vertebra_1", 2: "vertebra_2", 3: "vertebra_3"}
    assert [one["number"] for one in report["vertebrae"]] == list(labels.numbers)
    assert (report["low_confidence"], report["written"], len(report["discs"])) == (0, 3, 2)
    voxel_ml = 2.2 * 2.2 * 2.5 / 1000
    for one in report["vertebrae"]:
        assert one["volume_ml"] == pytest.approx(labels.counts[one["number"]] * voxel_ml, rel=1e-3)
    assert "warnings" not in report["volume"] and report["volume"]["series"]["uid_hash"] is None
    with Image.open(written / "a.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape[0] > 300
    yellow = (np.abs(pixels - [255, 230, 0]).max(axis=2) < 10).any(axis=1)
    rows = np.flatnonzero(yellow)
    assert len(np.split(rows, np.flatnonzero(np.diff(rows) > 20) + 1)) >= 2  # one line a disc at least


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


def test_without_a_landmark_the_command_says_how_to_name_levels(
    scan: Path, written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.nii.gz"
    assert main(["vertebrae", str(scan), "-o", str(path)]) == 0
    assert "numbers, counted from the head" in capsys.readouterr().out
    mesh = ["mesh", str(scan), "-o", str(tmp_path / "a.stl"), "--labels"]
    assert main([*mesh, str(path), "--label", "L3"]) == 3
    assert "1 vertebra_1, 2 vertebra_2, 3 vertebra_3. These are numbers and no levels" in capsys.readouterr().err
    assert main(["vertebrae", str(scan), "-o", str(path), "--first", "l1"]) == 0
    assert "numbers, counted from the head" not in capsys.readouterr().out
    assert read_labels(path).names == {20: "L1", 21: "L2", 22: "L3"}
    assert np.array_equal(
        np.where(read_labels(path).voxels, read_labels(path).voxels - 19, 0), read_labels(written / "a.nii.gz").voxels
    )


def test_the_segmentation_is_the_same_map(scan: Path, written: Path, tmp_path: Path) -> None:
    report = json.loads((written / "a.json").read_text())
    point = ",".join(str(value) for value in report["vertebrae"][1]["centre_mm"])
    path, picture = tmp_path / "s.dcm", tmp_path / "other.png"
    assert (
        main(["vertebrae", str(scan), "-o", str(path), "--picture", str(picture), "--name-at", f"{point}=L2", "-q"])
        == 0
    )
    assert sorted(one.name for one in tmp_path.iterdir()) == ["other.png", "s.dcm"]
    named = read_labels(path)
    assert named.names == {20: "L1", 21: "L2", 22: "L3"}
    taken = resample_labels(named, read_volume(scan))
    assert taken.exact
    assert np.array_equal(np.where(taken.voxels, taken.voxels - 19, 0), read_labels(written / "a.nii.gz").voxels)
    assert str(pydicom.dcmread(path).PatientName) == "" and b"PHANTOM" not in path.read_bytes()


@pytest.mark.seconds
def test_vertebrae_of_low_confidence_are_left_out_with_exit_code_8(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from clrecon.spine import split

    def doubt(piece: Any, *given: Any) -> dict[str, tuple[float, str]]:
        low = piece.upper is not None and piece.upper.is_disc and piece.lower is not None and piece.lower.is_disc
        value = 0.0 if low else 1.0
        return {
            "volume": (value, "a doubt of the test"),
            "arch": (value, "a greater one"),
            "line": (0.9, "a small one"),
        }

    monkeypatch.setattr(split, "judge", doubt)
    given = ["vertebrae", str(scan), "-o", str(tmp_path / "a.nii.gz")]
    assert main(given) == 8
    told = capsys.readouterr()
    assert (
        "vertebra_2 has low confidence (0.42) and is not in the label map: a greater one; a doubt of the test"
        in told.err
    )
    assert "1 of low confidence" in told.out
    assert read_labels(tmp_path / "a.nii.gz").numbers == (1, 3)
    assert main([*given, "--keep-unsure"]) == 8
    assert "is in the label map all the same" in capsys.readouterr().err
    assert read_labels(tmp_path / "a.nii.gz").numbers == (1, 2, 3)


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
def test_wrong_usage_is_one_line_and_writes_nothing(
    extra: list[str], code: int, words: str, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["vertebrae", str(scan), *extra, "-q"]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert list(tmp_path.iterdir()) == []


def test_a_scan_that_is_not_dicom_has_no_segmentation(written: Path, tmp_path: Path, printed: Printer) -> None:
    assert main(["vertebrae", str(written / "a.nii.gz"), "-o", str(tmp_path / "a.dcm")]) == 3
    printed().assert_error("NIfTI")


def test_existing_picture_of_vertebrae_stays_with_no_clobber(scan: Path, tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "a.png").write_text("mine")
    assert main(["vertebrae", str(scan), "-o", str(tmp_path / "a.nii.gz"), "--no-clobber"]) == 6
    printed().assert_error("a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
