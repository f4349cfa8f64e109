"""Lengths that lie, and files that are nearly all hole: what is read of them, and kept in memory, is bounded."""

from __future__ import annotations

import os
import struct

import numpy as np
import pytest
from dicom_series import Plan, make_dataset, save_dataset, write_series
from hostile_bytes import reads_less_than
from pydicom.encaps import encapsulate
from pydicom.uid import DeflatedExplicitVRLittleEndian, JPEG2000Lossless
from refusals import refused
from variants import daily

from clrecon.errors import RefusedInputError
from clrecon.reading import read_volume
from clrecon.reading.dicom.parse import elements
from clrecon.reading.dicom.pixels import stored

GIB = 1 << 30  # prefixes of 16 and 256 MiB are read, of the deflated slice twice: measured 0.29 and 0.59 GB
SAMPLES_PER_PIXEL = b"\x28\0\x02\0"
UNDEFINED = 0xFFFFFFFF


def element(group, number, vr, length):
    """The head of an element, explicit and little-endian."""
    return struct.pack("<HH2sHL", group, number, vr, 0, length)


def spoil(folder, data, size=None):
    """Put `data` before SamplesPerPixel of slice003.dcm; the rest of it comes after, or a hole up to `size` bytes."""
    plan = write_series(folder)
    path = folder / "slice003.dcm"
    whole = path.read_bytes()
    place = whole.index(SAMPLES_PER_PIXEL)
    path.write_bytes(whole[:place] + data + (b"" if size else whole[place:]))
    if size:
        os.truncate(path, size)
    return plan


@pytest.mark.seconds
@pytest.mark.parametrize("vr", daily(1, [b"OB", b"UN"]), ids=str)
def test_value_of_undefined_length_in_a_file_of_64_gib_is_refused_without_reading_all(tmp_path, vr):
    spoil(tmp_path, element(0x27, 0x1001, vr, UNDEFINED), size=64 * GIB)
    with reads_less_than(GIB), refused(RefusedInputError, "slice003.dcm"):
        read_volume(tmp_path)


def test_text_of_gigabytes_is_refused_without_reading_all(tmp_path):
    spoil(tmp_path, element(0x28, 0x1053, b"UT", 0xF0000000), size=8 * GIB)
    with reads_less_than(GIB), refused(RefusedInputError, "slice003.dcm", elements.READ_LIMIT):
        read_volume(tmp_path)


def test_deflated_slice_in_a_file_of_64_gib_is_read_without_reading_all(tmp_path):
    def lengthen(ds, k):
        ds.private_block(0x27, "OWN", create=True).add_new(1, "OB", np.random.default_rng(k).bytes(300_000))

    plan = write_series(tmp_path, Plan(syntax=DeflatedExplicitVRLittleEndian), lengthen)
    os.truncate(tmp_path / "slice003.dcm", 64 * GIB)
    with reads_less_than(GIB):
        assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.release
@pytest.mark.seconds
def test_slice_with_a_sequence_of_200_000_items_is_read(tmp_path):
    """What contours and segments are: pydicom takes 50 times their size for them."""
    item = struct.pack("<HHL", 0xFFFE, 0xE000, UNDEFINED) + struct.pack("<HH2sH", 9, 0x1001, b"LO", 2) + b"ab"
    item += struct.pack("<HHL", 0xFFFE, 0xE00D, 0)
    end = struct.pack("<HHL", 0xFFFE, 0xE0DD, 0)
    long = element(0x27, 0x1001, b"SQ", UNDEFINED) + 200_000 * item + end
    assert len(long) > elements.READ_LIMIT
    plan = spoil(tmp_path, long)
    assert read_volume(tmp_path).voxels.shape == plan.shape


def nested_sequence_of_items(count):
    """A sequence of so many items within nine others."""
    start, end = struct.pack("<HHL", 0xFFFE, 0xE000, UNDEFINED), struct.pack("<HHL", 0xFFFE, 0xE00D, 0)
    item = start + struct.pack("<HH2sH", 9, 0x1001, b"LO", 2) + b"ab" + end
    head, tail = element(0x27, 0x1001, b"SQ", UNDEFINED), struct.pack("<HHL", 0xFFFE, 0xE0DD, 0)
    return 9 * (head + start) + head + count * item + tail + 9 * (end + tail)


def test_slice_with_a_sequence_of_100_items_deep_in_others_is_read(tmp_path):
    plan = spoil(tmp_path, nested_sequence_of_items(100))
    assert read_volume(tmp_path).voxels.shape == plan.shape


@pytest.mark.release
@pytest.mark.seconds
def test_slice_with_a_sequence_of_200_000_items_deep_in_others_is_refused(tmp_path):
    """It is left to the careful parser, which makes objects of items."""
    spoil(tmp_path, nested_sequence_of_items(200_000))
    with refused(RefusedInputError, "slice003.dcm"):
        read_volume(tmp_path)


def write_compressed(path, frame):
    """Write a slice of 5 x 6 pixels of 16 bits with `frame` as its JPEG 2000, and return the bytes of the file."""
    ds = make_dataset(Plan(shape=(7, 5, 6)), 3)
    ds.file_meta.TransferSyntaxUID = JPEG2000Lossless
    ds.PixelData = encapsulate([frame])
    ds["PixelData"].VR, ds["PixelData"].is_undefined_length = "OB", True
    save_dataset(ds, path)
    return path.read_bytes()


@pytest.mark.fault_row(38)
def test_compressed_frame_of_gigabytes_for_60_bytes_of_pixels_is_refused(tmp_path):
    write_series(tmp_path)
    path = tmp_path / "slice003.dcm"
    start = b"\xff\x4f\xff\x51"
    data = write_compressed(path, start + bytes(100))
    place, length = data.index(start), 0xF0000000
    with open(path, "wb") as file:
        file.write(data[: place - 4] + struct.pack("<L", length) + start)
        file.seek(place + length)
        file.write(struct.pack("<HHL", 0xFFFE, 0xE0DD, 0))
    pixel_bytes = 5 * 6 * 2
    with refused(RefusedInputError, "slice003.dcm", length, pixel_bytes):
        read_volume(tmp_path)


@pytest.mark.fault_row(38)
def test_frame_of_5000_empty_fragments_is_refused(tmp_path):
    write_series(tmp_path)
    path = tmp_path / "slice003.dcm"
    start = b"\xff\x4f\xff\x51"
    data = write_compressed(path, start + bytes(100))
    place = data.index(start) - 8
    path.write_bytes(data[:place] + 5000 * struct.pack("<HHL", 0xFFFE, 0xE000, 0) + data[place:])
    most = 2 * 1000  # a thousand for each frame, of which there is one, and as many beside them
    with refused(RefusedInputError, "slice003.dcm", most):
        read_volume(tmp_path)


def test_deflated_series_for_which_memory_runs_out_is_refused(tmp_path, monkeypatch):
    def fail(read, most, step):
        raise MemoryError

    monkeypatch.setattr(stored, "inflate", fail)
    write_series(tmp_path, Plan(syntax=DeflatedExplicitVRLittleEndian))
    with refused(RefusedInputError, "memory"):
        read_volume(tmp_path)
