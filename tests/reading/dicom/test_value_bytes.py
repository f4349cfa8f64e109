"""NUL within numbers, and elements that stand twice or out of order: never another number in silence."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from dicom_series import (
    Plan,
    edit_value,
    element_bytes,
    find_element,
    insert_after,
    make_dataset,
    save_dataset,
    write_series,
)
from enhanced_image import make_enhanced
from pydicom.dataset import Dataset
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian

from clrecon.errors import RefusedInputError
from clrecon.reading import read_volume
from clrecon.reading.dicom.parse.values import decode_text

PLAN = Plan(shape=(4, 5, 6), origin=(-98.0, 31.25, -400.0), name="IM{:04d}".format)


def assert_refused(folder, *words, **options):
    with pytest.raises(RefusedInputError) as caught:
        read_volume(folder, **options)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value) and str(caught.value).isprintable()


# --- NUL ---
@pytest.mark.parametrize(
    ("keyword", "old", "new"),
    [
        ("ImagePositionPatient", b"-98", b"\x0098"),
        ("ImagePositionPatient", b"-98", b"-9\0"),
        ("ImagePositionPatient", b"-98.0\\", b"-98.0\0"),
        ("RescaleIntercept", b"-1024", b"\x001024"),
        ("PixelSpacing", b"0.7", b"\x00.7"),
        ("PixelSpacing", b"0.7\\", b"0.7\0\\"),
        ("RescaleSlope", b"1", b"\x001"),
        ("ImageOrientationPatient", b"1.0\\0.0", b"1.0\\\x00.0"),
    ],
)
def test_number_with_a_nul_within_is_refused(tmp_path, keyword, old, new):
    write_series(tmp_path, PLAN)
    for file in tmp_path.iterdir():
        edit_value(file, keyword, lambda value: value.replace(old, new, 1))
    assert new in file.read_bytes()
    assert_refused(tmp_path, f"{keyword} (", "\\x00", "expected")


def test_nul_in_place_of_the_sign_of_one_position_is_refused_with_its_slice(tmp_path):
    """Without the sign x of that slice would be +98 in place of -98."""
    write_series(tmp_path, PLAN)
    edit_value(tmp_path / "IM0003", "ImagePositionPatient", lambda value: b"\0" + value[1:])
    assert_refused(tmp_path, "IM0003: ImagePositionPatient (0020,0032) is '\\x0098")


@pytest.mark.parametrize("padding", [b"\0", b"\0\0\0"], ids=["one", "three"])
def test_nul_behind_the_last_number_is_taken_as_padding_with_a_warning(tmp_path, padding):
    write_series(tmp_path, PLAN)
    for file in tmp_path.iterdir():
        edit_value(file, "PixelSpacing", lambda value: value.rstrip(b" ") + padding)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, PLAN.hu())
    text = "PixelSpacing (0028,0030) ends with NUL, taken as padding: its last digit may be lost (all slices)"
    assert text in volume.report["warnings"]


def test_nul_behind_text_is_taken_as_padding_without_a_warning(tmp_path):
    write_series(tmp_path, PLAN)
    for file in tmp_path.iterdir():
        edit_value(file, "RescaleType", lambda value: b"HU\0\0")
        edit_value(file, "Modality", lambda value: b"CT\0 ")
    report = read_volume(tmp_path).report
    assert report["rescale"]["type"] == "HU"
    assert report["warnings"] == []


@pytest.mark.parametrize(("raw", "text"), [(b"CT\0", "CT"), (b" CT ", "CT"), (b"\0CT", "\0CT"), (b"C\0T\0", "C\0T")])
def test_text_keeps_a_nul_that_is_no_padding(raw, text):
    assert decode_text(raw) == text


def test_rescale_type_with_a_nul_before_it_fails_the_gate_of_hu(tmp_path):
    write_series(tmp_path, PLAN)
    for file in tmp_path.iterdir():
        edit_value(file, "RescaleType", lambda value: b"\0HU ")
    gates = {gate["name"]: gate["ok"] for gate in read_volume(tmp_path).report["gates"]}
    assert gates["hu_known"] is False


# --- twice ---
@pytest.mark.parametrize("implicit", [False, True])
@pytest.mark.parametrize(
    ("keyword", "value"),
    [
        ("PixelSpacing", b"7\\7 "),
        ("PixelSpacing", b""),
        ("ImagePositionPatient", b"1\\2\\3 "),
        ("ImageOrientationPatient", b"0\\1\\0\\1\\0\\0 "),
        ("RescaleIntercept", b"0 "),
        ("RescaleSlope", b"2 "),
        ("Rows", b"\4\0"),
        ("Columns", b"\5\0"),
        ("BitsStored", b"\x0c\0"),
        ("SeriesInstanceUID", b"1.2\0"),
    ],
)
def test_series_with_two_values_of_one_element_is_refused(tmp_path, keyword, value, implicit):
    plan = Plan(**{**vars(PLAN), "syntax": ImplicitVRLittleEndian} if implicit else vars(PLAN))
    write_series(tmp_path, plan)
    for file in tmp_path.iterdir():
        insert_after(file, keyword, element_bytes(keyword, value, implicit=implicit), implicit=implicit)
    assert_refused(tmp_path, f"IM0000: {keyword} (", "is there twice, with two values")


def test_two_values_of_one_element_apart_from_each_other_are_refused(tmp_path):
    write_series(tmp_path, PLAN)
    for file in tmp_path.iterdir():
        insert_after(file, "Modality", element_bytes("PixelSpacing", b"7\\7 "))
    assert_refused(tmp_path, "PixelSpacing (0028,0030) is there twice, with two values")


def test_one_slice_with_two_positions_refuses_the_series_by_its_name(tmp_path):
    write_series(tmp_path, PLAN)
    insert_after(tmp_path / "IM0003", "ImagePositionPatient", element_bytes("ImagePositionPatient", b"-98\\31\\-390"))
    assert_refused(tmp_path, "IM0003: ImagePositionPatient (0020,0032) is there twice", "may belong to it")


def test_the_same_value_of_an_element_twice_is_read_with_a_warning(tmp_path):
    write_series(tmp_path, PLAN)
    for file in tmp_path.iterdir():
        data = file.read_bytes()
        start, _, end = find_element(data, "PixelSpacing")
        insert_after(file, "PixelSpacing", data[start:end])
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, PLAN.hu())
    assert volume.report["warnings"] == ["PixelSpacing (0028,0030) is there twice, with the same value (all slices)"]


def test_description_with_two_values_is_read_with_a_warning(tmp_path):
    write_series(tmp_path, PLAN)
    for file in tmp_path.iterdir():
        insert_after(file, "SeriesDescription", element_bytes("SeriesDescription", b"thorax"))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, PLAN.hu())
    assert volume.report["warnings"] == [
        "SeriesDescription (0008,103E) is there twice, with two values: the last is taken (all slices)"
    ]


def test_elements_out_of_the_order_of_tags_are_read_with_a_warning(tmp_path):
    write_series(tmp_path, PLAN)
    for file in tmp_path.iterdir():
        data = file.read_bytes()
        start, _, end = find_element(data, "PixelSpacing")
        modality = find_element(data, "Modality")[0]
        file.write_bytes(data[:modality] + data[start:end] + data[modality:start] + data[end:])
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, PLAN.hu())
    text = "Modality (0008,0060) is not in the order of tags: taken all the same (all slices)"
    assert text in volume.report["warnings"]  # and of each element that it was put before


def test_file_with_two_transfer_syntaxes_is_refused(tmp_path):
    save_dataset(make_dataset(PLAN, 0), tmp_path / "a")
    insert_after(tmp_path / "a", "TransferSyntaxUID", element_bytes("TransferSyntaxUID", b"1.2.840.10008.1.2\0"))
    assert_refused(tmp_path, "a: TransferSyntaxUID (0002,0010) is there twice, with two values")


def open_sequences(ds: Dataset) -> None:
    """Give all sequences and items no length, so that they take what is put into them."""
    for element in ds:
        if element.VR == "SQ":
            element.is_undefined_length = True
            for item in element.value:
                item.is_undefined_length_sequence_item = True
                open_sequences(item)


def write_frames(path: Path, syntax: str, change: Callable[[bytes], bytes]) -> None:
    """An enhanced image; the position of its last frame stands twice, the second time as `change` gives it."""
    ds = make_enhanced(Plan(**{**vars(PLAN), "syntax": syntax}))
    open_sequences(ds)
    save_dataset(ds, path)
    data, implicit = path.read_bytes(), syntax == ImplicitVRLittleEndian
    head = element_bytes("ImagePositionPatient", b"", implicit=implicit)[: 4 if implicit else 6]
    place = data.rindex(head)
    length = int.from_bytes(data[place + len(head) : place + 8], "little")
    element = data[place : place + 8 + length]
    path.write_bytes(data[:place] + element + change(element) + data[place + len(element) :])


BOTH_ENCODINGS = pytest.mark.parametrize(
    "syntax", [ImplicitVRLittleEndian, ExplicitVRLittleEndian], ids=["implicit", "explicit"]
)


@BOTH_ENCODINGS
def test_position_twice_with_one_value_within_functional_groups_is_read_with_a_warning(tmp_path, syntax):
    write_frames(tmp_path / "one", syntax, lambda element: element)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, PLAN.hu())
    text = "ImagePositionPatient (0020,0032) is there twice in one item, with the same value (all slices)"
    assert text in volume.report["warnings"]


@BOTH_ENCODINGS
def test_position_twice_with_two_values_within_functional_groups_is_refused(tmp_path, syntax):
    write_frames(tmp_path / "one", syntax, lambda element: element.replace(b"-98", b"+98"))
    assert_refused(
        tmp_path, "ImagePositionPatient (0020,0032) is there twice in an item of (0020,9113), with two values"
    )


def test_sequence_of_positions_twice_within_functional_groups_is_refused(tmp_path):
    write_frames(tmp_path / "one", ExplicitVRLittleEndian, lambda element: b"")
    data = (tmp_path / "one").read_bytes()
    end = struct.pack("<HHL", 0xFFFE, 0xE00D, 0) + struct.pack("<HHL", 0xFFFE, 0xE0DD, 0)
    start = data.rindex(b"\x20\0\x13\x91SQ")
    stop = data.index(end, start) + len(end)
    again = data[start:stop].replace(b"-98", b"+98")
    (tmp_path / "one").write_bytes(data[:stop] + again + data[stop:])
    assert_refused(tmp_path, "PlanePositionSequence (0020,9113) is there twice in an item of (5200,9230)")
