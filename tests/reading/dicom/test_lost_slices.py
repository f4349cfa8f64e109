"""A slice lost at an end of the stack leaves no hole: what may be left of it is a reason to refuse, not a warning."""

from __future__ import annotations

import os

import numpy as np
import pytest
from dicom_series import Plan, make_dataset, save_dataset, set_values, write_series
from pydicom.uid import MRImageStorage
from refusals import refused

from clrecon.errors import NoDicomError, RefusedInputError
from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.series import scan
from clrecon.reading.dicom.series import scan as disk

CORRUPT = bytes(128) + b"DICM" + b"\xff" * 50
APART = Plan(name="{}/image".format)
"""Every slice in a folder of its own."""


def check_refused(folder, words, number=1):
    """Refused in one line that names `words`, also in the listing."""
    with pytest.raises(RefusedInputError, match=r"may belong to it \(restore or remove them\): ") as caught:
        read_volume(folder, number)
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert any(words in problem for problem in list_series(folder).series[number - 1].problems)


@pytest.fixture
def deny(monkeypatch):
    """Makes a file or folder one that the system does not let us read, for the superuser too."""

    def make_unreadable(path):
        read_start, scandir = disk.read_start, os.scandir

        def read_or_deny(file):
            if file == str(path):
                raise PermissionError(13, "Permission denied")
            return read_start(file)

        def scan_or_deny(folder):
            if os.fspath(folder) == str(path):
                raise PermissionError(13, "Permission denied")
            return scandir(folder)

        monkeypatch.setattr(disk, "read_start", read_or_deny)
        monkeypatch.setattr(scan.os, "scandir", scan_or_deny)

    return make_unreadable


@pytest.mark.parametrize("cut", ["slice000.dcm", "slice003.dcm", "slice006.dcm"])
def test_cut_file_beside_the_slices_refuses_the_series(tmp_path, cut):
    write_series(tmp_path)
    (tmp_path / cut).write_bytes((tmp_path / cut).read_bytes()[:600])
    check_refused(tmp_path, f"{cut}: ends within")


def test_file_that_cannot_be_opened_refuses_the_series(tmp_path, deny):
    write_series(tmp_path)
    deny(tmp_path / "slice006.dcm")
    check_refused(tmp_path, "slice006.dcm: not readable")
    assert list_series(tmp_path).skipped == {"not readable": 1}


def test_folder_that_cannot_be_read_refuses_the_series(tmp_path, deny):
    write_series(tmp_path, APART)
    deny(tmp_path / "6")
    check_refused(tmp_path, "6: folder not readable")


def test_unreadable_files_alone_are_no_dicom(tmp_path, deny):
    write_series(tmp_path, Plan(shape=(1, 5, 6)))
    deny(tmp_path / "slice000.dcm")
    with refused(NoDicomError, "file", "readable", 1):
        read_volume(tmp_path)


@pytest.mark.parametrize("length", [0, 1, 127, 128, 131, 132, 300, 700])
@pytest.mark.parametrize("name", ["{}/image", "{}/image.dcm"])
def test_cut_slice_in_a_folder_of_its_own_refuses_the_series(tmp_path, name, length):
    plan = write_series(tmp_path, Plan(name=name.format))
    file = tmp_path / plan.name(6)
    file.write_bytes(file.read_bytes()[:length])
    check_refused(tmp_path, f"{file.name}: ")


@pytest.mark.parametrize("plan", [Plan(name="ct/{}".format), APART], ids=["one folder", "folders"])
def test_a_corrupt_file_apart_from_all_slices_refuses_the_series(tmp_path, plan):
    write_series(tmp_path, plan)
    (tmp_path / "bad").write_bytes(CORRUPT)
    check_refused(tmp_path, "bad: ")


@pytest.mark.parametrize(
    "change", [None, set_values(Modality="MR", SOPClassUID=MRImageStorage)], ids=["another CT", "MR"]
)
def test_a_corrupt_file_among_slices_of_another_series_is_counted(tmp_path, change):
    plan = write_series(tmp_path / "ct")
    write_series(tmp_path / "other", Plan(series=2, shape=(3, 5, 6)), change)
    (tmp_path / "other" / "bad").write_bytes(CORRUPT)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["files"] == {"found": 11, "used": 7, "skipped": {"corrupt": 1}}
    assert volume.report["warnings"][0] == "1 corrupt file skipped"
    if change is None:
        check_refused(tmp_path, "bad: ", number=2)
    save_dataset(make_dataset(plan, 6), tmp_path / "other" / "moved")
    (tmp_path / "ct" / plan.name(6)).unlink()
    check_refused(tmp_path, "bad: ")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("slice007.dcm", b"", "slice007.dcm: named like DICOM but is none"),
        ("slice007.DCM", b"\x07" * 5000, "slice007.DCM: named like DICOM but is none"),
        ("x.ima", b"version https://git-lfs", "x.ima: named like DICOM but is none"),
        ("x.Dic", b"x", "x.Dic: named like DICOM but is none"),
        ("x.dicom", bytes(500), "x.dicom: named like DICOM but is none"),
        ("x.dcm", bytes(100), "x.dcm: cut within the preamble"),
        ("IM0007", bytes(1), "IM0007: cut within the preamble"),
        ("IM0007", bytes(128) + b"DIC", "IM0007: cut within the preamble"),
        ("IM0007", b"", None),
        ("IM0007", b"x", None),
        ("IM0007", bytes(132), None),
        ("notes.txt", b"no image", None),
        ("._slice000.dcm", b"\x00\x05\x16\x07" + bytes(200), None),
        ("._slice000.dcm", b"y" * 200, "._slice000.dcm: named like DICOM but is none"),
    ],
)
def test_file_that_may_be_left_of_a_slice_refuses_the_series(tmp_path, name, content, words):
    plan = write_series(tmp_path / "ct")
    (tmp_path / "ct" / name).write_bytes(content)
    if words:
        check_refused(tmp_path, words)
    else:
        assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())
    (tmp_path / "ct" / name).rename(tmp_path / name)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["files"]["skipped"] == {"not DICOM": 1}
    assert volume.report["warnings"] == ([f"1 skipped: {words.split(': ')[1]}"] if words else [])
    with refused(NoDicomError, "DICOM", 1):
        read_volume(tmp_path / name)
