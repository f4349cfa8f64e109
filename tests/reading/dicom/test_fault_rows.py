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


@pytest.mark.fault_row(15)
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
def test_position_or_orientation_that_is_no_place_in_all_slices_is_refused(tmp_path, keyword, text, fact):
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


@pytest.mark.fault_row(17)
@pytest.mark.parametrize("flips_kji", list(np.ndindex(2, 2, 2)), ids=str)
def test_object_lies_in_its_place_with_any_axes_reversed(tmp_path, flips_kji):
    """Left-handed orders too: each HU at its LPS place, once."""
    hu = np.arange(3 * 4 * 5).reshape(3, 4, 5)
    place_of_hu = {int(hu[k, j, i]): (10.0 + i, 20.0 + j, 30.0 + k) for k, j, i in np.ndindex(hu.shape)}
    flip_k, flip_j, flip_i = flips_kji
    directions = [(1 - 2 * flip_i, 0, 0), (0, 1 - 2 * flip_j, 0), (0, 0, 1 - 2 * flip_k)]
    origin = (10 + 4 * flip_i, 20 + 3 * flip_j, 30 + 2 * flip_k)
    reversed_hu = hu[tuple(slice(None, None, -1) if flip else slice(None) for flip in flips_kji)]
    stack_of(directions, origin, reversed_hu, tmp_path)

    volume = read_volume(tmp_path)

    assert np.linalg.det(volume.affine[:3, :3]) > 0  # right-handed, in whatever order the axes were
    ijk = np.array(list(np.ndindex(volume.voxels.shape)))[:, ::-1]
    expected = np.array([place_of_hu[int(value)] for value in volume.voxels.ravel()])
    assert np.abs(volume.ijk_to_lps(ijk) - expected).max() < AFFINE_MM


def write_dicomdir(path, file_ids):
    """A DICOMDIR with an image record for each of these ReferencedFileIDs."""
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


@pytest.fixture
def folder_of_traps(tmp_path):
    """A series among a DICOMDIR, links out, in a circle and to nothing, a pipe and a socket; another series outside."""
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
    yield plan, inside
    listener.close()


@pytest.mark.fault_row(43)
def test_series_among_links_pipes_and_sockets_is_read_without_opening_them(folder_of_traps):
    plan, folder = folder_of_traps
    volume = read_volume(folder)
    assert np.array_equal(volume.voxels, plan.hu())
    assert len(list_series(folder).series) == 1  # not that outside
    assert volume.report["files"]["skipped"] == {
        "DICOMDIR": 1,
        "link out of the folder": 2,
        "link inside the folder": 1,
        "link to a file that is not there": 2,
        "not a regular file": 2,
    }
    assert "2 skipped: link out of the folder" in volume.report["warnings"]


@pytest.mark.fault_row(43)
@pytest.mark.parametrize("name", ["a", "pipe.dcm", "s"], ids=["link in a circle", "pipe", "socket"])
def test_link_in_a_circle_pipe_and_socket_are_refused_by_themselves(folder_of_traps, name):
    _, folder = folder_of_traps
    with refused(NoDicomError, "regular"):
        read_volume(folder / name)


@pytest.mark.fault_row(43)
@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="there is no device that never ends")
def test_device_is_refused_without_reading_it():
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


def one_after_the_other(first, second):
    """Two changes of a data set, one after the other."""

    def change(ds, k):
        first(ds, k)
        second(ds, k)

    return change


HOSTILE_TEXT = pytest.mark.parametrize("text", daily(2, HOSTILE_TEXTS.values()), ids=HOSTILE_TEXTS)


@pytest.mark.fault_row(45)
@HOSTILE_TEXT
@pytest.mark.parametrize("keyword", HOSTILE_FIELDS)
def test_hostile_text_in_an_element_is_escaped_in_the_listing_and_kept_out_of_the_report(tmp_path, keyword, text):
    utf8 = set_values(SpecificCharacterSet="ISO_IR 192")
    write_series(tmp_path, Plan(**PLAN), one_after_the_other(set_raw(keyword, text), utf8))
    series = list_series(tmp_path).series[0]
    for line in (*series.warnings, *series.problems, series.description, series.modality):
        assert line.isprintable()
        assert len(line) < 400  # measured 64, of the text of 300 letters too
    report = json.dumps(read_volume(tmp_path).report)
    is_term = keyword in ("RescaleType", "ConvolutionKernel")  # reports quote these
    assert is_term or ("passwd" not in report and "title" not in report)


@pytest.mark.fault_row(45)
@HOSTILE_TEXT
def test_hostile_text_in_a_refusal_is_one_printable_line(tmp_path, text):
    two_phases, no_ct = tmp_path / "phases", tmp_path / "modality"
    write_series(two_phases, Plan(**PLAN), set_raw("ConvolutionKernel", text))
    write_series(two_phases, Plan(slope=2, name="p{}".format, **PLAN), set_raw("ConvolutionKernel", "B30f"))
    write_series(no_ct, Plan(**PLAN), set_raw("Modality", text))
    for folder in (two_phases, no_ct):
        with pytest.raises(ClreconError) as refusal:
            read_volume(folder)
        assert_one_line(refusal.value, letters=10_000)


@pytest.mark.fault_row(45)
@HOSTILE_TEXT
def test_command_info_prints_hostile_texts_escaped_and_writes_no_file(tmp_path, monkeypatch, printed, text):
    monkeypatch.chdir(tmp_path)
    for keyword in HOSTILE_FIELDS:
        write_series(tmp_path / "ct" / keyword, Plan(**PLAN), set_raw(keyword, text))
        main(["info", str(tmp_path / "ct" / keyword)])
    lines = printed().everything.splitlines()
    assert len(lines) > len(HOSTILE_FIELDS)
    assert all(line.isprintable() and "\u202e" not in line for line in lines)
    assert list(tmp_path.iterdir()) == [tmp_path / "ct"]


@pytest.mark.fault_row(45)
def test_hostile_transfer_syntax_is_escaped_in_the_refusal(tmp_path):
    for k, data in enumerate(phantom_seeds()["RLE"].series):
        (tmp_path / f"{k}").write_bytes(data.replace(b"1.2.840.10008.1.2.5\0", b"\x1b[31m8.10008.1.2.5\n "))
    with refused(RefusedInputError, "x1b") as caught:
        read_volume(tmp_path)
    assert_one_line(caught.value)
