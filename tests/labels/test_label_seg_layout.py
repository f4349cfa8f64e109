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


def header_with(kind="LABELMAP", bits=8, syntax=ExplicitVRLittleEndian, **values):
    """A SEG of frames of 10 x 10 pixels."""
    data_set = Dataset()
    data_set.SegmentationType, data_set.Rows, data_set.Columns, data_set.BitsAllocated = kind, 10, 10, bits
    data_set.file_meta = FileMetaDataset()
    data_set.file_meta.TransferSyntaxUID = syntax
    for keyword, value in values.items():
        setattr(data_set, keyword, value)
    return data_set


def layout_of(kind, *, rows, columns, frames, bits):
    return _Layout(kind, rows, columns, frames, bits)


@pytest.mark.parametrize(
    ("kind", "bits", "syntax", "least_bytes"),
    [
        pytest.param("LABELMAP", 8, ExplicitVRLittleEndian, 3 * 100, id="bytes"),
        pytest.param("LABELMAP", 16, ExplicitVRLittleEndian, 3 * 200, id="two bytes a pixel"),
        pytest.param("BINARY", 8, ExplicitVRLittleEndian, 3 * 100, id="binary in bytes"),
        pytest.param("BINARY", 1, ExplicitVRLittleEndian, 38, id="bits: 8 x 38 are 304"),
        pytest.param("LABELMAP", 8, RLELossless, 5, id="RLE, at most 64 from one: 320"),
    ],
)
def test_header_of_three_frames_is_read_from_a_file_that_can_hold_their_pixels(kind, bits, syntax, least_bytes):
    data_set = header_with(kind, bits, syntax, NumberOfFrames=3)
    assert _read_layout(data_set, "a.dcm", file_bytes=least_bytes) == layout_of(
        kind, rows=10, columns=10, frames=3, bits=bits
    )
    with refused(RefusedInputError, "a.dcm", 10):
        _read_layout(data_set, "a.dcm", file_bytes=least_bytes - 1)


def test_segmentation_that_does_not_say_its_number_of_frames_has_one():
    assert _read_layout(header_with(), "a.dcm", file_bytes=100).frames == 1


@pytest.mark.parametrize(("kind", "bits"), [("BINARY", 16), ("LABELMAP", 1), ("LABELMAP", 32)])
def test_bits_a_pixel_that_the_kind_of_segmentation_does_not_have_are_refused(kind, bits):
    with refused(RefusedInputError, 1, bits):
        _read_layout(header_with(kind, bits), "a.dcm", file_bytes=1000)


@pytest.mark.parametrize("frames", [0, 1_000_001])
def test_number_of_frames_outside_of_one_to_a_million_is_refused(frames):
    with refused(RefusedInputError, frames):
        _read_layout(header_with(NumberOfFrames=frames), "a.dcm", file_bytes=1_000_001 * 100)


def test_a_million_frames_are_accepted():
    assert _read_layout(header_with(NumberOfFrames=1_000_000), "a.dcm", file_bytes=1_000_000 * 100).frames == 1_000_000


def test_pixels_of_one_bit_are_read_over_the_ends_of_bytes_to_the_last_bit():
    # 3 frames of 3 x 3 pixels are 27 bits: 4 bytes; the second frame begins at bit 9.
    data = bytes([0b11111111, 0b00000011, 0b00000000, 0b00000100])
    layout = layout_of("BINARY", rows=3, columns=3, frames=3, bits=1)
    pixels = _FramePixels(header_with("BINARY", bits=1, PixelData=data), layout, "a.dcm")
    frames = [pixels.read(frame).ravel().tolist() for frame in range(3)]
    assert frames == [[1] * 9, [1] + [0] * 8, [0] * 8 + [1]]


def test_pixels_of_one_bit_that_lack_their_last_byte_are_refused():
    layout = layout_of("BINARY", rows=3, columns=3, frames=3, bits=1)  # 27 bits need 4 bytes
    with refused(RefusedInputError, 3, "frames"):
        _FramePixels(header_with("BINARY", bits=1, PixelData=bytes(3)), layout, "a.dcm")


TWO_RLE_FRAMES = encapsulate([bytes(66), bytes(66)])


@pytest.mark.parametrize(("bits", "frames"), [(1, 2), (8, 1), (8, 3)], ids=["bits", "one too many", "one too few"])
def test_compressed_frames_of_bits_or_of_another_number_than_stated_are_refused(bits, frames):
    data_set = header_with("BINARY", bits, RLELossless, PixelData=TWO_RLE_FRAMES)
    with pytest.raises(ValueError, match=f"compressed frames of {bits} bits|frame"):
        _FramePixels(data_set, layout_of("BINARY", rows=3, columns=3, frames=frames, bits=bits), "a.dcm")


def test_compressed_frames_of_bytes_in_the_stated_number_are_accepted():
    data_set = header_with("BINARY", 8, RLELossless, PixelData=TWO_RLE_FRAMES)
    layout = layout_of("BINARY", rows=3, columns=3, frames=2, bits=8)
    assert len(_FramePixels(data_set, layout, "a.dcm")._fragments) == 2


def test_pixels_of_two_bytes_are_read_lowest_byte_first():
    data = struct.pack("<12H", *range(300, 312))
    layout = layout_of("LABELMAP", rows=2, columns=3, frames=2, bits=16)
    pixels = _FramePixels(header_with(bits=16, PixelData=data), layout, "a.dcm")
    assert pixels.read(1).tolist() == [[306, 307, 308], [309, 310, 311]]


def element_in_sequences(*keywords, twice):
    """A value in sequences, with a second value of the same element behind it if `twice`."""
    *sequences, last = keywords
    data = element_bytes(last, b"1 ") + (element_bytes(last, b"2 ") if twice else b"")
    for keyword in reversed(sequences):
        tag = int(tag_for_keyword(keyword) or 0)
        item = struct.pack("<HHL", 0xFFFE, 0xE000, len(data)) + data
        data = struct.pack("<HH2sHL", tag >> 16, tag & 0xFFFF, b"SQ", 0, len(item)) + item
    return META + data


ELEMENTS_OF_FRAMES = [
    ("PlanePositionSequence", "ImagePositionPatient"),
    ("PlaneOrientationSequence", "ImageOrientationPatient"),
    *(("PixelMeasuresSequence", name) for name in ("SliceThickness", "SpacingBetweenSlices", "PixelSpacing")),
    ("SegmentIdentificationSequence", "ReferencedSegmentNumber"),
]
ELEMENTS = [
    *((name,) for name in ("FrameOfReferenceUID", "NumberOfFrames", "Rows", "Columns", "BitsAllocated", "BitsStored")),
    ("SegmentationType",),
    ("SegmentSequence", "SegmentNumber"),
    ("SegmentSequence", "SegmentLabel"),
    *(("SharedFunctionalGroupsSequence", *element) for element in ELEMENTS_OF_FRAMES),
    *(("PerFrameFunctionalGroupsSequence", *element) for element in ELEMENTS_OF_FRAMES),
]
"""Sequences from outside in, and the element in the innermost."""


@pytest.mark.parametrize("keywords", ELEMENTS, ids=lambda keywords: "-".join(keywords[-2:]))
def test_element_that_places_or_names_segments_is_refused_where_it_occurs_twice(keywords):
    _check_elements(element_in_sequences(*keywords, twice=False), "a.dcm", implicit=False)
    with refused(RefusedInputError, "a.dcm", "DICOM", keywords[-1]):
        _check_elements(element_in_sequences(*keywords, twice=True), "a.dcm", implicit=False)


def test_elements_of_a_file_beyond_four_gigabytes_are_not_read():
    class FourGigabytesAndOne(bytes):
        def __len__(self) -> int:
            return 2**32 + 1

    with refused(RefusedInputError, "a.dcm", 2**32):
        _check_elements(FourGigabytesAndOne(META), "a.dcm", implicit=False)


def test_elements_of_a_file_are_read_up_to_the_most_bytes():
    content = META + element_bytes("Rows", b"\1\0")
    _check_elements(content, "a.dcm", implicit=False, most=len(content))
    with refused(RefusedInputError, "a.dcm", len(content) - 1):
        _check_elements(content, "a.dcm", implicit=False, most=len(content) - 1)


def test_data_set_of_a_file_is_parsed_up_to_the_most_bytes(tmp_path: Path):
    data_set = Dataset()
    data_set.preamble, data_set.file_meta = bytes(128), FileMetaDataset()
    data_set.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data_set.save_as(tmp_path / "a.dcm", enforce_file_format=False)
    size = (tmp_path / "a.dcm").stat().st_size
    with pytest.raises(RefusedInputError, match="is DICOM but no segmentation"):  # parsed
        segmentation._parse_dataset(tmp_path / "a.dcm", "a.dcm", size)
    with pytest.raises(RefusedInputError, match=f"is larger than {size - 1:,} bytes"):
        segmentation._parse_dataset(tmp_path / "a.dcm", "a.dcm", size - 1)
