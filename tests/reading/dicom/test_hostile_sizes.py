"""Lengths that lie, and files that are nearly all hole: what is read of them, and kept in memory, is bounded."""

from __future__ import annotations

import os
import struct

import numpy as np
import pytest
from dicom_series import Plan, make_dataset, save_dataset, write_series
from pydicom.encaps import encapsulate
from pydicom.uid import DeflatedExplicitVRLittleEndian, JPEG2000Lossless
from refusals import refused
from variants import daily

from clrecon.errors import RefusedInputError
from clrecon.reading import read_volume
from clrecon.reading.dicom.parse import elements, plain
from clrecon.reading.dicom.parse import elements as careful
from clrecon.reading.dicom.pixels.stored import StoredPixels

SAMPLES_PER_PIXEL = b"\x28\0\x02\0"
UNDEFINED = 0xFFFFFFFF


def element(group, number, vr, length):
    return struct.pack("<HH2sHL", group, number, vr, 0, length)


def spoil(folder, data, behind=b"", size=None):
    """Put `data` before SamplesPerPixel of a slice; the rest of it, `behind` or a hole comes after."""
    write_series(folder)
    path = folder / "slice003.dcm"
    whole = path.read_bytes()
    place = whole.index(SAMPLES_PER_PIXEL)
    path.write_bytes(whole[:place] + data + (behind if size else whole[place:]))
    if size:
        os.truncate(path, size)
    return path


@pytest.mark.parametrize("vr", daily(1, [b"OB", b"UN"]), ids=str)
def test_the_end_of_a_value_is_not_looked_for_in_all_of_a_large_file(tmp_path, monkeypatch, vr):
    spoil(tmp_path, element(0x27, 0x1001, vr, UNDEFINED), size=1 << 36)
    monkeypatch.setattr(careful, "READ_LIMIT", 1 << 17)  # seconds, else
    with pytest.raises(RefusedInputError, match=r"slice003\.dcm: (its header takes more|cannot be parsed)"):
        read_volume(tmp_path)


def test_a_value_of_gigabytes_is_not_read(tmp_path):
    spoil(tmp_path, element(0x28, 0x1053, b"UT", 0xF0000000), size=1 << 33)
    with refused(RefusedInputError, "slice003.dcm", 4194304):
        read_volume(tmp_path)


def test_no_more_of_a_deflated_file_is_read_than_its_header_takes(tmp_path, monkeypatch):
    monkeypatch.setattr(elements, "LONG_PREFIX_BYTES", 300)
    monkeypatch.setattr(elements, "PREFIX_BYTES", 300)
    plan = write_series(tmp_path, Plan(syntax=DeflatedExplicitVRLittleEndian))
    os.truncate(tmp_path / "slice003.dcm", 1 << 36)
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.release
@pytest.mark.seconds
def test_long_sequences_are_stepped_over_without_objects(tmp_path, monkeypatch):
    """What contours and segments are: pydicom takes 50 times their size for them."""
    item = struct.pack("<HHL", 0xFFFE, 0xE000, UNDEFINED) + struct.pack("<HH2sH", 9, 0x1001, b"LO", 2) + b"ab"
    item += struct.pack("<HHL", 0xFFFE, 0xE00D, 0)
    end = struct.pack("<HHL", 0xFFFE, 0xE0DD, 0)
    path = spoil(tmp_path, element(0x27, 0x1001, b"SQ", UNDEFINED) + 20_000 * item + end)
    assert path.stat().st_size > elements.LONG_PREFIX_BYTES
    monkeypatch.setattr(careful, "READ_LIMIT", elements.LONG_PREFIX_BYTES + 1000)
    assert read_volume(tmp_path).voxels.shape == (7, 5, 6)
    monkeypatch.setattr(plain, "DEEPEST", 0)  # left to the careful parser, of which too much is asked
    with refused(RefusedInputError, "slice003.dcm", "header"):
        read_volume(tmp_path)


def write_compressed(path, frame):
    ds = make_dataset(Plan(), 3)
    ds.file_meta.TransferSyntaxUID = JPEG2000Lossless
    ds.PixelData = encapsulate([frame])
    ds["PixelData"].VR, ds["PixelData"].is_undefined_length = "OB", True
    save_dataset(ds, path)
    return path.read_bytes()


def test_row_38_a_compressed_frame_of_gigabytes_is_not_read(tmp_path):
    write_series(tmp_path)
    path = tmp_path / "slice003.dcm"
    start = b"\xff\x4f\xff\x51"
    data = write_compressed(path, start + bytes(100))
    place, length = data.index(start), 0xF0000000
    with open(path, "wb") as file:
        file.write(data[: place - 4] + struct.pack("<L", length) + start)
        file.seek(place + length)
        file.write(struct.pack("<HHL", 0xFFFE, 0xE0DD, 0))
    with refused(RefusedInputError, "slice003.dcm", 4026531840, 60):
        read_volume(tmp_path)


def test_row_38_empty_fragments_are_counted(tmp_path):
    write_series(tmp_path)
    path = tmp_path / "slice003.dcm"
    start = b"\xff\x4f\xff\x51"
    data = write_compressed(path, start + bytes(100))
    place = data.index(start) - 8
    path.write_bytes(data[:place] + 5000 * struct.pack("<HHL", 0xFFFE, 0xE000, 0) + data[place:])
    with refused(RefusedInputError, "slice003.dcm", 2000):
        read_volume(tmp_path)


def test_no_memory_is_an_error_of_the_file(tmp_path, monkeypatch):
    def fail(self, header, stored):
        raise MemoryError

    monkeypatch.setattr(StoredPixels, "_inflate", fail)
    write_series(tmp_path, Plan(syntax=DeflatedExplicitVRLittleEndian))
    with refused(RefusedInputError, "memory"):
        read_volume(tmp_path)
