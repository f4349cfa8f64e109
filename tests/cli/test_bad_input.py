"""Every wrong input: its exit code, one clear line, nothing on stdout and no output file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ct_files import INSIDE_HU, sphere_voxels, write_series
from printed_text import Printer

import clrecon.operators.surface.extraction
from clrecon.cli.main import main

PNG = bytes.fromhex("89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b55")


@pytest.fixture
def no_device_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    """These inputs are refused before a device computes anything: any machine will do."""
    monkeypatch.setattr(clrecon.operators, "choose_device", lambda name=None: object())
    monkeypatch.setattr(clrecon.operators.surface.extraction, "prepare_isosurface", lambda device: None)


@pytest.fixture
def target(tmp_path: Path) -> Path:
    """The path of a mesh in an empty folder."""
    folder = tmp_path / "out folder"
    folder.mkdir()
    return folder / "bone.stl"


def check_one_line_of_error(
    arguments: list[str], target: Path, printed: Printer, *, code: int, fact: str | float
) -> None:
    """Run a command that ends with `code`, one line with `fact`, and nothing written beside `target`."""
    found = main(arguments)
    said = printed()
    assert found == code, said
    assert (said.output_lines, said.error_lines) == (0, 1)
    said.assert_error("error", fact)
    if target.parent.is_dir():
        assert list(target.parent.iterdir()) == []


def make_empty_folder(folder: Path) -> None:
    folder.mkdir()


def make_text_files(folder: Path) -> None:
    folder.mkdir()
    (folder / "notes.txt").write_text("no image here\n" * 50)
    (folder / "IM0001").write_text("x")


def make_picture(folder: Path) -> None:
    folder.mkdir()
    (folder / "picture.png").write_bytes(PNG)


def make_cut_slices(folder: Path) -> None:
    write_series(folder)
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes()[:-700])  # of the 1,550 bytes of 25 x 31 pixels


def make_one_slice(folder: Path) -> None:
    write_series(folder, sphere_voxels()[8:9])


def make_two_series_of_one_size(folder: Path) -> None:
    write_series(folder, number=1)
    write_series(folder, number=2)


def make_mr_series(folder: Path) -> None:
    write_series(folder, modality="MR")


def make_nothing(folder: Path) -> None:
    assert not folder.exists()


@pytest.mark.parametrize(
    ("make_input", "code", "fact"),
    [
        (make_nothing, 2, "exist"),
        (make_empty_folder, 2, "DICOM"),
        (make_text_files, 2, "DICOM"),
        (make_picture, 2, "DICOM"),
        (make_cut_slices, 4, "s1_000.dcm"),
        (make_one_slice, 4, "slice"),
        (make_two_series_of_one_size, 4, "--series"),
        (make_mr_series, 2, "MR"),
    ],
)
@pytest.mark.usefixtures("no_device_needed")
def test_mesh_of_an_input_without_a_usable_ct_series_is_refused_in_one_line_and_writes_nothing(
    make_input: Any, code: int, fact: str, tmp_path: Path, target: Path, printed: Printer
) -> None:
    folder = tmp_path / "ein ordner mit ä"
    make_input(folder)
    report = target.with_suffix(".json")
    check_one_line_of_error(
        ["mesh", str(folder), "-o", str(target), "--report", str(report)], target, printed, code=code, fact=fact
    )


@pytest.mark.usefixtures("no_device_needed")
def test_slices_that_end_early_are_refused_and_an_older_mesh_stays(tmp_path: Path, target: Path) -> None:
    make_cut_slices(tmp_path / "ct")
    target.write_bytes(b"the old mesh")
    assert main(["mesh", str(tmp_path / "ct"), "-o", str(target)]) == 4
    assert target.read_bytes() == b"the old mesh"
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="the superuser may read everything")
@pytest.mark.usefixtures("no_device_needed")
def test_folder_without_permission_is_refused(tmp_path: Path, target: Path, printed: Printer) -> None:
    folder = write_series(tmp_path / "ct")
    folder.chmod(0)
    try:
        check_one_line_of_error(["mesh", str(folder), "-o", str(target)], target, printed, code=2, fact="read")
    finally:
        folder.chmod(0o700)


def test_iso_value_above_all_voxels_is_refused_with_the_highest_of_the_scan(
    device: Any, tmp_path: Path, target: Path, printed: Printer
) -> None:
    folder = write_series(tmp_path / "ct")
    arguments = ["mesh", str(folder), "-o", str(target), "--hu", "900", "--device", str(device.index)]
    check_one_line_of_error(arguments, target, printed, code=2, fact=INSIDE_HU)


def test_volume_of_one_value_is_refused(device: Any, tmp_path: Path, target: Path, printed: Printer) -> None:
    folder = write_series(tmp_path / "ct", np.full((4, 9, 7), -1000, np.int16))
    arguments = ["mesh", str(folder), "-o", str(target), "--device", str(device.index)]
    check_one_line_of_error(arguments, target, printed, code=4, fact=4 * 9 * 7)  # all of its voxels


def test_unknown_device_is_refused_by_the_mesh_command(
    device: Any, tmp_path: Path, target: Path, printed: Printer
) -> None:
    arguments = ["mesh", str(tmp_path), "-o", str(target), "--device", "abacus"]
    check_one_line_of_error(arguments, target, printed, code=5, fact="abacus")


@pytest.mark.parametrize(
    ("output", "code", "fact"),
    [
        ("missing/bone.stl", 6, "missing"),
        (".", 3, "extension"),
        ("bone", 3, "extension"),
        ("bone.doc", 3, "doc"),
        ("folder.stl", 6, "folder"),
        ("a" * 300 + ".stl", 6, "long"),
    ],
)
def test_output_that_cannot_be_written_is_refused_before_the_input_is_looked_for(
    output: str, code: int, fact: str, tmp_path: Path, printed: Printer
) -> None:
    (tmp_path / "folder.stl").mkdir()
    before = sorted(tmp_path.iterdir())
    assert main(["mesh", str(tmp_path / "no input"), "-o", str(tmp_path / output)]) == code
    said = printed()
    assert (said.output_lines, said.error_lines) == (0, 1)
    said.assert_error(fact)
    assert sorted(tmp_path.iterdir()) == before


def test_report_in_a_missing_folder_is_refused(tmp_path: Path, target: Path, printed: Printer) -> None:
    report = str(tmp_path / "nowhere" / "report.json")
    arguments = ["mesh", str(tmp_path), "-o", str(target), "--report", report]
    check_one_line_of_error(arguments, target, printed, code=6, fact="nowhere")


def test_report_named_as_the_mesh_is_refused(tmp_path: Path, target: Path, printed: Printer) -> None:
    arguments = ["mesh", str(tmp_path), "-o", str(target), "--report", str(target)]
    check_one_line_of_error(arguments, target, printed, code=3, fact="same")


@pytest.mark.parametrize(
    ("extra", "fact"),
    [
        (["--hu", "nan"], "finite"),
        (["--hu", "abc"], "abc"),
        (["--hu", "200,,300"], "200,,300"),
        (["--hu", "200,200"], "twice"),
        (["--hu", "300", "--preset", "skin"], "--preset"),
        (["--preset", "bones"], "bones"),
        (["--keep-largest", "0"], "components"),
        (["--min-volume", "-1"], "ml"),
        (["--seed", "1,2"], "1,2"),
        (["--seed", "-1,2,x"], "-1,2,x"),
        (["--seed", "1,2,inf"], "three"),
        (["--space", "mni"], "mni"),
        (["--colour"], "--label-color"),
        (["-q", "-v"], "-q/--quiet"),
    ],
)
def test_wrong_option_of_mesh_is_refused_in_one_line_with_exit_code_3(
    extra: list[str], fact: str, tmp_path: Path, target: Path, printed: Printer
) -> None:
    check_one_line_of_error(["mesh", str(tmp_path), "-o", str(target), *extra], target, printed, code=3, fact=fact)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "no command given"),
        (["polish"], "no command 'polish': use one of mesh, "),
        (["mesh"], "required: INPUT, -o/--output (see: clrecon mesh --help)"),
        (["--nonsense"], "unrecognized"),
        (["phantom", "out", "--spacing", "1", "2"], "expected 3 arguments"),
    ],
)
def test_wrong_command_is_refused_in_one_line_with_exit_code_3(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 3
    captured = capsys.readouterr()
    assert captured.out == ""
    assert words in captured.err
    assert len(captured.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("make_input", "code", "words"),
    [
        (make_empty_folder, 2, "no DICOM"),
        (make_mr_series, 2, "MR"),
        (make_one_slice, 4, "slice"),
        (make_cut_slices, 4, "s1_0"),
    ],
)
def test_info_of_an_input_without_a_usable_ct_series_is_refused(
    make_input: Any, code: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_input(tmp_path / "in")
    assert main(["info", str(tmp_path / "in")]) == code
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("clrecon: error: ")
    assert words in last
