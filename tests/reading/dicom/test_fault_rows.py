"""Rows of the list of faults that no test of its own subject holds; tests/support/fault_rows.py has all of them."""

from __future__ import annotations

import json
import os
import socket

import numpy as np
import pytest
from dicom_series import Plan, save_dataset, set_raw, set_values, write_series
from hostile_bytes import phantom_seeds
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import ExplicitVRLittleEndian, MediaStorageDirectoryStorage
from refusals import assert_one_line, refused
from tolerances import AFFINE_MM
from variants import daily

from clrecon.cli.main import main
from clrecon.errors import ClreconError, NoDicomError, RefusedInputError
from clrecon.reading import list_series, read_volume

PLAN = {"shape": (4, 3, 5)}
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:pydicom")  # it writes what no one should


@pytest.mark.parametrize(
    ("keyword", "text", "fact"),
    [
        ("ImageOrientationPatient", "0\\0\\0\\0\\0\\0", "1"),
        ("ImageOrientationPatient", "nan\\0\\0\\0\\1\\0", "nan\\0\\0\\0\\1\\0"),
        ("ImageOrientationPatient", "", "missing"),
        ("ImagePositionPatient", "nan\\0\\0", "nan\\0\\0"),
        ("ImagePositionPatient", "1\\2", "1\\2"),
        ("ImagePositionPatient", "", "missing"),
    ],
)
def test_row_15_places_without_sense_in_all_slices_are_refused(tmp_path, keyword, text, fact):
    write_series(tmp_path, Plan(**PLAN), set_raw(keyword, text))
    with refused(RefusedInputError, keyword, fact, "slice000.dcm"):
        read_volume(tmp_path)


def stack_of(directions, origin, hu, folder):
    """Write `hu` (k, j, i) with rows, columns and slices along the given directions (3, 3), 1 mm apart."""
    plan = Plan(shape=hu.shape, pixel_spacing=(1.0, 1.0))
    row, column, step = (np.array(direction, dtype=float) for direction in directions)

    def change(ds, k):
        ds.ImageOrientationPatient = [*row, *column]
        ds.ImagePositionPatient = [round(v, 6) for v in np.array(origin, dtype=float) + k * step]
        ds.PixelData = (hu[k] + 1024).astype("<i2").tobytes()

    write_series(folder, plan, change)


def test_row_17_object_lies_in_its_place_however_it_is_stored(tmp_path):
    """Every axis reversed, left-handed orders too: the same HU at the same LPS places."""
    hu = np.arange(3 * 4 * 5).reshape(3, 4, 5)
    expected = {int(hu[k, j, i]): (10.0 + i, 20.0 + j, 30.0 + k) for k, j, i in np.ndindex(hu.shape)}
    for number, signs in enumerate(np.ndindex(2, 2, 2)):
        flips = tuple(slice(None, None, -1) if sign else slice(None) for sign in signs)
        directions = [(1 - 2 * signs[2], 0, 0), (0, 1 - 2 * signs[1], 0), (0, 0, 1 - 2 * signs[0])]
        origin = (10 + 4 * signs[2], 20 + 3 * signs[1], 30 + 2 * signs[0])
        stack_of(directions, origin, hu[flips], tmp_path / f"{number}")
        volume = read_volume(tmp_path / f"{number}")
        assert np.linalg.det(volume.affine[:3, :3]) > 0
        kji = np.array(list(np.ndindex(volume.voxels.shape)))
        truth = np.array([expected[int(value)] for value in volume.voxels.ravel()])
        assert np.abs(volume.ijk_to_lps(kji[:, ::-1]) - truth).max() < AFFINE_MM


def write_dicomdir(path, file_ids):
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds.file_meta.MediaStorageSOPClassUID = MediaStorageDirectoryStorage
    ds.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
    records = []
    for file_id in file_ids:
        record = Dataset()
        record.DirectoryRecordType, record.ReferencedFileID = "IMAGE", file_id
        records.append(record)
    ds.DirectoryRecordSequence = Sequence(records)
    save_dataset(ds, path)


def test_row_43_nothing_out_of_the_folder_is_opened(tmp_path):
    outside, inside = tmp_path / "outside", tmp_path / "in"
    write_series(outside, Plan(series=2, shape=(9, 3, 5)))
    plan = write_series(inside / "x.dcm", Plan(**PLAN))
    write_dicomdir(inside / "DICOMDIR", [["..", "outside", "slice000.dcm"], str(outside / "slice001.dcm")])
    os.symlink(outside, inside / "link to folder")
    os.symlink(outside / "slice000.dcm", inside / "link.dcm")
    os.symlink(inside, inside / "x.dcm" / "loop")
    os.symlink("b", inside / "a")
    os.symlink("a", inside / "b")
    os.mkfifo(inside / "pipe.dcm")
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(os.path.relpath(inside / "s"))
    try:
        volume = read_volume(inside)
        skipped = volume.report["files"]["skipped"]
        assert np.array_equal(volume.voxels, plan.hu()) and len(list_series(inside).series) == 1
        assert skipped["DICOMDIR"] == 1 and skipped["link out of the folder"] == 2
        assert skipped["link inside the folder"] == 1 and skipped["not a regular file"] == 2
        assert skipped["link to a file that is not there"] == 2
        assert "2 skipped: link out of the folder" in volume.report["warnings"]
        for name in ("a", "pipe.dcm", "s"):
            with refused(NoDicomError, "regular"):
                read_volume(inside / name)
    finally:
        listener.close()


@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="there is no device that never ends")
def test_row_43_a_device_is_not_read():
    with refused(NoDicomError, "regular"):
        read_volume("/dev/zero")


HOSTILE_TEXTS = {
    "up": "../../etc/x",
    "absolute": "/etc/passwd",
    "nul": "a\0b",
    "line": "a\nclrecon: error: made up",
    "ansi": "\x1b[2J\x1b]0;title\x07",
    "long": "x" * 300,
    "device name": "CON",
    "right to left": "a\u202etxt.exe".encode().decode("latin-1"),
    "percent": "%s%n{0}{x}",
}
HOSTILE_FIELDS = "SeriesDescription SeriesInstanceUID StudyInstanceUID ConvolutionKernel PatientID RescaleType".split()


def both(first, second):
    """Two changes of a data set, one after the other."""

    def change(ds, k):
        first(ds, k)
        second(ds, k)

    return change


@pytest.mark.parametrize("text", daily(2, HOSTILE_TEXTS.values()), ids=HOSTILE_TEXTS)
def test_row_45_hostile_texts_are_escaped_and_name_no_file(tmp_path, monkeypatch, printed, text):
    folder, utf8 = tmp_path / "ct", set_values(SpecificCharacterSet="ISO_IR 192")
    monkeypatch.chdir(tmp_path)
    for keyword in HOSTILE_FIELDS:
        write_series(folder / keyword, Plan(**PLAN), both(set_raw(keyword, text), utf8))
        told = json.dumps(read_volume(folder / keyword).report)
        entry = list_series(folder / keyword).series[0]
        for line in (*entry.warnings, *entry.problems, entry.description, entry.modality):
            assert line.isprintable() and len(line) < 400
        assert "passwd" not in told and "title" not in told or keyword in ("RescaleType", "ConvolutionKernel")
    # Two phases and a broken modality: the texts come out in refusals.
    write_series(folder / "phases", Plan(**PLAN), set_raw("ConvolutionKernel", text))
    write_series(folder / "phases", Plan(slope=2, name="p{}".format, **PLAN), set_raw("ConvolutionKernel", "B30f"))
    write_series(folder / "modality", Plan(**PLAN), set_raw("Modality", text))
    for name in ("phases", "modality"):
        with pytest.raises(ClreconError) as caught:
            read_volume(folder / name)
        assert_one_line(caught.value, letters=10_000)
    for name in (*HOSTILE_FIELDS, "phases"):
        main(["info", str(folder / name)])
    shown = printed().everything
    assert all(line.isprintable() for line in shown.splitlines()) and "\u202e" not in shown
    assert [path.name for path in tmp_path.iterdir()] == ["ct"]


def test_row_45_a_hostile_transfer_syntax_is_escaped(tmp_path):
    for k, data in enumerate(phantom_seeds()["RLE"].series):
        (tmp_path / f"{k}").write_bytes(data.replace(b"1.2.840.10008.1.2.5\0", b"\x1b[31m8.10008.1.2.5\n "))
    with refused(RefusedInputError, "x1b") as caught:
        read_volume(tmp_path)
    assert_one_line(caught.value)
