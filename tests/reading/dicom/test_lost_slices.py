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


def assert_series_refused(folder, words, number=1):
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
    (tmp_path / cut).write_bytes((tmp_path / cut).read_bytes()[:600])  # within its header
    assert_series_refused(tmp_path, f"{cut}: ends within")


def test_file_that_cannot_be_opened_refuses_the_series(tmp_path, deny):
    write_series(tmp_path)
    deny(tmp_path / "slice006.dcm")
    assert_series_refused(tmp_path, "slice006.dcm: not readable")
    assert list_series(tmp_path).skipped == {"not readable": 1}


def test_folder_that_cannot_be_read_refuses_the_series(tmp_path, deny):
    write_series(tmp_path, APART)
    deny(tmp_path / "6")
    assert_series_refused(tmp_path, "6: folder not readable")


def test_folder_of_a_file_that_cannot_be_opened_alone_is_refused_as_no_dicom(tmp_path, deny):
    write_series(tmp_path, Plan(shape=(1, 5, 6)))
    deny(tmp_path / "slice000.dcm")
    with refused(NoDicomError, "file", "readable", 1):  # file looked at
        read_volume(tmp_path)


@pytest.mark.parametrize("length", [0, 1, 127, 128, 131, 132, 300, 700])
@pytest.mark.parametrize("name", ["{}/image", "{}/image.dcm"])
def test_cut_slice_in_a_folder_of_its_own_refuses_the_series(tmp_path, name, length):
    plan = write_series(tmp_path, Plan(name=name.format))
    file = tmp_path / plan.name(6)
    file.write_bytes(file.read_bytes()[:length])
    assert_series_refused(tmp_path, f"{file.name}: ")


@pytest.mark.parametrize("plan", [Plan(name="ct/{}".format), APART], ids=["one folder", "folders"])
def test_corrupt_file_in_a_folder_without_slices_refuses_the_series(tmp_path, plan):
    write_series(tmp_path, plan)
    (tmp_path / "bad").write_bytes(CORRUPT)
    assert_series_refused(tmp_path, "bad: ")


OTHER_SERIES = pytest.mark.parametrize(
    "change", [None, set_values(Modality="MR", SOPClassUID=MRImageStorage)], ids=["another CT", "MR"]
)


def write_beside_other_series(folder, change=None):
    """A series of 7 slices, and in a folder beside it another series of 3 with a corrupt file."""
    plan = write_series(folder / "ct", Plan(shape=(7, 5, 6)))
    write_series(folder / "other", Plan(series=2, shape=(3, 5, 6)), change)
    (folder / "other" / "bad").write_bytes(CORRUPT)
    return plan


@OTHER_SERIES
def test_corrupt_file_among_slices_of_another_series_is_skipped_with_a_warning(tmp_path, change):
    plan = write_beside_other_series(tmp_path, change)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["files"] == {"found": 7 + 3 + 1, "used": 7, "skipped": {"corrupt": 1}}
    assert volume.report["warnings"][0] == "1 corrupt file skipped"


def test_corrupt_file_among_slices_of_a_series_refuses_that_series(tmp_path):
    write_beside_other_series(tmp_path)
    assert_series_refused(tmp_path, "bad: ", number=2)


@OTHER_SERIES
def test_corrupt_file_beside_one_slice_of_a_series_refuses_it(tmp_path, change):
    plan = write_beside_other_series(tmp_path, change)
    save_dataset(make_dataset(plan, 6), tmp_path / "other" / "moved")
    (tmp_path / "ct" / plan.name(6)).unlink()
    assert_series_refused(tmp_path, "bad: ")


LEFT_OF_A_SLICE = [
    ("slice007.dcm", b"", "slice007.dcm: named like DICOM but is none"),
    ("slice007.DCM", b"\x07" * 5000, "slice007.DCM: named like DICOM but is none"),
    ("x.ima", b"version https://git-lfs", "x.ima: named like DICOM but is none"),
    ("x.Dic", b"x", "x.Dic: named like DICOM but is none"),
    ("x.dicom", bytes(500), "x.dicom: named like DICOM but is none"),
    ("x.dcm", bytes(100), "x.dcm: cut within the preamble"),
    ("IM0007", bytes(1), "IM0007: cut within the preamble"),
    ("IM0007", bytes(128) + b"DIC", "IM0007: cut within the preamble"),
    ("._slice000.dcm", b"y" * 200, "._slice000.dcm: named like DICOM but is none"),
]
NOT_LEFT_OF_A_SLICE = [
    ("IM0007", b""),
    ("IM0007", b"x"),
    ("IM0007", bytes(132)),
    ("notes.txt", b"no image"),
    ("._slice000.dcm", b"\x00\x05\x16\x07" + bytes(200)),
]
"""Names and contents of files beside slices named slice000.dcm and so on."""


@pytest.mark.parametrize(("name", "content", "words"), LEFT_OF_A_SLICE)
def test_file_that_may_be_left_of_a_slice_refuses_the_series(tmp_path, name, content, words):
    write_series(tmp_path / "ct")
    (tmp_path / "ct" / name).write_bytes(content)
    assert_series_refused(tmp_path, words)


@pytest.mark.parametrize(("name", "content"), NOT_LEFT_OF_A_SLICE)
def test_file_that_cannot_be_left_of_a_slice_is_skipped(tmp_path, name, content):
    plan = write_series(tmp_path / "ct")
    (tmp_path / "ct" / name).write_bytes(content)
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.parametrize(
    ("name", "content", "words"), [*LEFT_OF_A_SLICE, *((name, content, None) for name, content in NOT_LEFT_OF_A_SLICE)]
)
def test_file_above_the_folder_of_the_slices_is_skipped_with_a_warning_if_it_may_be_left_of_one(
    tmp_path, name, content, words
):
    plan = write_series(tmp_path / "ct")
    (tmp_path / name).write_bytes(content)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["files"]["skipped"] == {"not DICOM": 1}
    assert volume.report["warnings"] == ([f"1 skipped: {words.split(': ')[1]}"] if words else [])


@pytest.mark.parametrize(
    ("name", "content"), [*((name, content) for name, content, _ in LEFT_OF_A_SLICE), *NOT_LEFT_OF_A_SLICE]
)
def test_file_that_is_no_slice_is_refused_alone_as_no_dicom(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with refused(NoDicomError, "DICOM", 1):  # file looked at
        read_volume(tmp_path / name)
