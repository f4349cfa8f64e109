"""What the header of a SEG may say, with data sets made by hand: sizes to the byte, elements that occur twice."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from dicom_series import element_bytes
from pydicom import Dataset
from pydicom.datadict import tag_for_keyword
from pydicom.dataset import FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.uid import ExplicitVRLittleEndian, RLELossless
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.labels import segmentation
from clrecon.labels.segmentation import _check_elements, _FramePixels, _Layout, _read_layout

META = bytes(128) + b"DICM" + struct.pack("<HH2sHL", 2, 0, b"UL", 4, 0)


def header(kind="LABELMAP", bits=8, syntax=ExplicitVRLittleEndian, **values):
    found = Dataset()
    found.SegmentationType, found.Rows, found.Columns, found.BitsAllocated = kind, 10, 10, bits
    found.file_meta = FileMetaDataset()
    found.file_meta.TransferSyntaxUID = syntax
    for keyword, value in values.items():
        setattr(found, keyword, value)
    return found


@pytest.mark.parametrize(
    ("kind", "bits", "syntax", "least"),
    [
        ("LABELMAP", 8, ExplicitVRLittleEndian, 300),
        ("LABELMAP", 16, ExplicitVRLittleEndian, 600),
        ("BINARY", 8, ExplicitVRLittleEndian, 300),
        ("BINARY", 1, ExplicitVRLittleEndian, 38),  # eight pixels a byte: 304
        ("LABELMAP", 8, RLELossless, 5),  # at most 64 bytes from one: 320
    ],
)
def test_a_file_holds_at_least_its_pixels(kind, bits, syntax, least):
    data_set = header(kind, bits, syntax, NumberOfFrames=3)
    assert _read_layout(data_set, "a.dcm", least) == _Layout(kind, 10, 10, 3, bits)
    with refused(RefusedInputError, "a.dcm", 10):
        _read_layout(data_set, "a.dcm", least - 1)


def test_segmentation_without_a_number_of_frames_has_one():
    assert _read_layout(header(), "a.dcm", 100).frames == 1


@pytest.mark.parametrize(("kind", "bits"), [("BINARY", 16), ("LABELMAP", 1), ("LABELMAP", 32)])
def test_bits_are_those_of_the_kind(kind, bits):
    with refused(RefusedInputError, 1, bits):
        _read_layout(header(kind, bits), "a.dcm", 1000)


@pytest.mark.parametrize("frames", [0, 1_000_001])
def test_frames_are_counted_from_one_to_a_million(frames):
    with refused(RefusedInputError, frames):
        _read_layout(header(NumberOfFrames=frames), "a.dcm", 1000)
    assert _read_layout(header(NumberOfFrames=1_000_000), "a.dcm", 10**8).frames == 1_000_000


def test_pixels_fill_their_bytes_to_the_last_bit():
    # 3 frames of 3 x 3 pixels are 27 bits: 4 bytes; the second frame begins at bit 9.
    data = bytes([0xFF, 0x03, 0x00, 0x04])
    layout = _Layout("BINARY", 3, 3, 3, 1)
    pixels = _FramePixels(header("BINARY", 1, PixelData=data), layout, "a.dcm")
    assert [pixels.read(frame).ravel().tolist() for frame in range(3)] == [[1] * 9, [1] + [0] * 8, [0] * 8 + [1]]
    with refused(RefusedInputError, 3, "frames"):
        _FramePixels(header("BINARY", 1, PixelData=data[:3]), layout, "a.dcm")


@pytest.mark.parametrize(("bits", "frames"), [(1, 2), (8, 1), (8, 3)])
def test_compressed_frames_are_as_many_as_said_and_of_whole_bytes(bits, frames):
    data = header("BINARY", bits, RLELossless, PixelData=encapsulate([bytes(66), bytes(66)]))
    with pytest.raises(ValueError, match=f"compressed frames of {bits} bits|frame"):
        _FramePixels(data, _Layout("BINARY", 3, 3, frames, bits), "a.dcm")
    sound = header("BINARY", 8, RLELossless, PixelData=encapsulate([bytes(66), bytes(66)]))
    assert len(_FramePixels(sound, _Layout("BINARY", 3, 3, 2, 8), "a.dcm")._fragments) == 2


def test_pixels_of_two_bytes_come_lowest_byte_first():
    data = struct.pack("<12H", *range(300, 312))
    pixels = _FramePixels(header(bits=16, PixelData=data), _Layout("LABELMAP", 2, 3, 2, 16), "a.dcm")
    assert pixels.read(1).tolist() == [[306, 307, 308], [309, 310, 311]]


def nested(*keywords, twice):
    """A value in sequences, with a second value of the same element behind it if `twice`."""
    *sequences, last = keywords
    data = element_bytes(last, b"1 ") + (element_bytes(last, b"2 ") if twice else b"")
    for keyword in reversed(sequences):
        tag = int(tag_for_keyword(keyword) or 0)
        item = struct.pack("<HHL", 0xFFFE, 0xE000, len(data)) + data
        data = struct.pack("<HH2sHL", tag >> 16, tag & 0xFFFF, b"SQ", 0, len(item)) + item
    return META + data


PLACES = [
    ("PlanePositionSequence", "ImagePositionPatient"),
    ("PlaneOrientationSequence", "ImageOrientationPatient"),
    *(("PixelMeasuresSequence", name) for name in ("SliceThickness", "SpacingBetweenSlices", "PixelSpacing")),
    ("SegmentIdentificationSequence", "ReferencedSegmentNumber"),
]


@pytest.mark.parametrize(
    "keywords",
    [
        *(
            (name,)
            for name in (
                *("FrameOfReferenceUID", "NumberOfFrames", "Rows", "Columns", "BitsAllocated", "BitsStored"),
                "SegmentationType",
            )
        ),
        ("SegmentSequence", "SegmentNumber"),
        ("SegmentSequence", "SegmentLabel"),
        *(("SharedFunctionalGroupsSequence", *place) for place in PLACES),
        *(("PerFrameFunctionalGroupsSequence", *place) for place in PLACES),
    ],
    ids=lambda keywords: "-".join(keywords[-2:]),
)
def test_elements_that_place_and_name_segments_occur_once(keywords):
    _check_elements(nested(*keywords, twice=False), "a.dcm", implicit=False)
    with refused(RefusedInputError, "a.dcm", "DICOM", keywords[-1]):
        _check_elements(nested(*keywords, twice=True), "a.dcm", implicit=False)


def test_files_beyond_four_gigabytes_are_not_read(tmp_path: Path):
    class Long(bytes):
        def __len__(self) -> int:
            return 2**32 + 1

    with pytest.raises(RefusedInputError, match="a.dcm is larger than 4,294,967,296 bytes"):
        _check_elements(Long(META), "a.dcm", implicit=False)
    content = META + element_bytes("Rows", b"\1\0")
    _check_elements(content, "a.dcm", implicit=False, most=len(content))
    data_set = Dataset()
    data_set.preamble, data_set.file_meta = bytes(128), FileMetaDataset()
    data_set.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data_set.save_as(tmp_path / "a.dcm", enforce_file_format=False)
    size = (tmp_path / "a.dcm").stat().st_size
    for most, words in ((size, "is DICOM but no segmentation"), (size - 1, f"is larger than {size - 1:,} bytes")):
        with pytest.raises(RefusedInputError, match=words):
            segmentation._parse_dataset(tmp_path / "a.dcm", "a.dcm", most)
