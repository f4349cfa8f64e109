"""More bytes than the header's pixels take: padding, further elements, or a picture that would come out wrong."""

from __future__ import annotations

import os
import struct

import numpy as np
import pytest
from dicom_series import Plan, edit_value, make_dataset, save_dataset, write_series
from enhanced_image import make_enhanced
from hostile_bytes import COMPRESSED, NATIVE, make_series, reads_less_than, save_bytes
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
)
from refusals import refused
from variants import daily

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.headers import surplus

NAME = "IM{:04d}".format
PLAN = Plan(shape=(3, 8, 10), name=NAME)
SYNTAXES = [ExplicitVRLittleEndian, ImplicitVRLittleEndian, ExplicitVRBigEndian, DeflatedExplicitVRLittleEndian]
TEXT = "it was sent as text"


def write_slices(folder, change=None, *, syntax=ExplicitVRLittleEndian, plan=PLAN):
    """The slices of a plan, by default 3 of 8 rows and 10 columns of 16 bits, in any transfer syntax."""
    plan = Plan(**{**vars(plan), "syntax": syntax})

    def swap_and_change(ds, k):
        if syntax == ExplicitVRBigEndian:
            ds.PixelData = plan.stored(k).astype(">i2").tobytes()
        if change is not None:
            change(ds, k)

    write_series(folder, plan, swap_and_change)
    return plan


def assert_refused_with(folder, *words):
    with pytest.raises(RefusedInputError) as caught:
        read_volume(folder)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def append_to_pixels(extra):
    return lambda ds, k: setattr(ds, "PixelData", ds.PixelData + extra)


# --- within the pixel data ---
@pytest.mark.parametrize("syntax", SYNTAXES)
def test_zeros_behind_the_pixels_are_taken_as_padding_with_a_warning(tmp_path, syntax):
    plan = write_slices(tmp_path, append_to_pixels(bytes(96)), syntax=syntax)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    text = "Pixel Data has 256 bytes, 10 x 8 x 16 bit take 160: the rest is zeros, taken as padding (all slices)"
    assert text in volume.report["warnings"]


@pytest.mark.parametrize("syntax", SYNTAXES)
def test_other_bytes_behind_the_pixels_refuse_the_series(tmp_path, syntax):
    write_slices(tmp_path, append_to_pixels(bytes(40) + b"\1\0"), syntax=syntax)
    words = "IM0000: Pixel Data has 202 bytes, 10 x 8 x 16 bit take 160: more pixels than the header says"
    assert_refused_with(tmp_path, words, "force=True")
    assert any(words in problem for problem in list_series(tmp_path).series[0].problems)


@pytest.mark.parametrize("syntax", SYNTAXES)
def test_other_bytes_behind_the_pixels_are_left_out_with_force_and_a_warning(tmp_path, syntax):
    plan = write_slices(tmp_path, append_to_pixels(bytes(40) + b"\1\0"), syntax=syntax)
    volume = read_volume(tmp_path, force=True)
    assert np.array_equal(volume.voxels, plan.hu())
    assert any("the rest was left out on demand (all slices)" in warning for warning in volume.report["warnings"])


@pytest.mark.parametrize(
    "elements",
    [{"Columns": 9}, {"Rows": 7}, {"BitsAllocated": 8, "BitsStored": 8, "HighBit": 7}],
    ids=["columns", "rows", "bits"],
)
def test_series_with_more_pixels_than_its_header_says_is_refused(tmp_path, elements):
    write_slices(tmp_path, lambda ds, k: ds.update(elements))
    assert_refused_with(tmp_path, "Pixel Data has 160 bytes", "more pixels than the header says")


DISC = np.where(np.hypot(*(np.mgrid[:32, :32] - 15.5)) < 12, 1000 + 20 * np.arange(32), 0).astype("u2")
"""Zeros around it: the bytes that one column less leaves over are zeros, only the picture tells them from padding."""


def write_disc(folder, *, columns, pixels):
    """Three slices of 32 rows whose headers name so many columns of 16 bits; each has the bytes `pixels`."""

    def change(ds, k):
        ds.PixelData = pixels
        ds.Columns = columns

    write_series(folder, Plan(shape=(3, 32, 32), name=NAME, signed=False, intercept=-1024), change)


@pytest.mark.parametrize("hidden", [1, 3])
def test_columns_that_the_header_hides_are_refused_though_the_picture_ends_in_zeros(tmp_path, hidden):
    named = 32 - hidden
    write_disc(tmp_path, columns=named, pixels=DISC.tobytes())
    has, takes = 32 * 32 * 2, named * 32 * 2
    assert_refused_with(tmp_path, f"Pixel Data has {has} bytes, {named} x 32 x 16 bit take {takes}",
                  "rows are more alike with 32 columns")  # fmt: skip


@pytest.mark.parametrize("padded", [1, 3])
def test_picture_that_fits_its_columns_is_read_before_zeros_of_padding(tmp_path, padded):
    kept = DISC[:, : 32 - padded]
    write_disc(tmp_path, columns=32 - padded, pixels=kept.tobytes() + bytes(32 * 2 * padded))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels[0], kept.astype(int) - 1024)
    assert "the rest is zeros, taken as padding" in volume.report["warnings"][0]


def test_byte_of_padding_behind_an_odd_number_of_pixels_is_not_warned_of(tmp_path):
    plan = Plan(shape=(3, 5, 7), name=NAME, bits_stored=8, signed=False)

    def change(ds, k):
        ds.BitsAllocated = 8
        ds["PixelData"].VR = "OB"
        ds.PixelData = bytes(range(220, 255)) + b"\0"

    write_series(tmp_path, plan, change)
    assert read_volume(tmp_path).report["warnings"] == []


def test_pixel_data_that_the_file_cuts_behind_the_pixels_is_refused_unless_forced(tmp_path):
    """All that the header asks for is there, but the file ends within its pixel data."""
    plan = write_slices(tmp_path, append_to_pixels(bytes(96)))
    for file in tmp_path.iterdir():
        file.write_bytes(file.read_bytes()[:-50])
    assert_refused_with(tmp_path, "Pixel Data has 256 bytes, 10 x 8 x 16 bit take 160, 206 are there: the file is cut")
    assert np.array_equal(read_volume(tmp_path, force=True).voxels, plan.hu())


@pytest.mark.parametrize("syntax", SYNTAXES[:2])
def test_zeros_behind_frames_are_taken_as_padding_with_a_warning(tmp_path, syntax):
    ds = make_enhanced(Plan(**{**vars(PLAN), "syntax": syntax}))
    ds.PixelData += bytes(64)
    save_dataset(ds, tmp_path / "one")
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, PLAN.hu())
    text = "Pixel Data has 544 bytes, 3 x 10 x 8 x 16 bit take 480: the rest is zeros, taken as padding (all slices)"
    assert text in volume.report["warnings"]


@pytest.mark.parametrize("syntax", SYNTAXES[:2])
def test_more_frames_than_the_header_says_are_refused(tmp_path, syntax):
    ds = make_enhanced(Plan(**{**vars(PLAN), "syntax": syntax}))
    ds.PixelData += bytes(64)
    ds.NumberOfFrames = 2
    ds.PerFrameFunctionalGroupsSequence = ds.PerFrameFunctionalGroupsSequence[:2]
    save_dataset(ds, tmp_path / "one")
    assert_refused_with(tmp_path, "2 x 10 x 8 x 16 bit take 320: more pixels than the header says")


# --- behind the pixel data ---
def element(tag, vr, value, syntax):
    """The bytes of an element with a long head in a transfer syntax."""
    order = ">" if syntax == ExplicitVRBigEndian else "<"
    head = struct.pack(order + "HH", tag >> 16, tag & 0xFFFF)
    if syntax == ImplicitVRLittleEndian:
        return head + struct.pack("<L", len(value)) + value
    return head + vr + struct.pack(order + "HL", 0, len(value)) + value


def append(folder, data):
    """Put bytes behind each file of a folder."""
    for file in folder.iterdir():
        file.write_bytes(file.read_bytes() + data)


@pytest.mark.parametrize("syntax", SYNTAXES[:3])
def test_elements_behind_the_pixels_are_left_out_without_a_warning(tmp_path, syntax):
    plan = write_slices(tmp_path, syntax=syntax)
    private = element(0x7FE10010, b"OB", b"MAKER ", syntax) + element(0x7FE11010, b"OB", b"\n" * 50, syntax)
    append(tmp_path, private + element(0xFFFCFFFC, b"OB", bytes(30), syntax))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu()) and volume.report["warnings"] == []


def sequence_of_undefined_length(syntax):
    """Head, item and ends of a sequence."""
    head = element(0xFFFAFFFA, b"SQ", b"", syntax)[:-4] + b"\xff" * 4
    item = struct.pack("<HHL", 0xFFFE, 0xE000, 0xFFFFFFFF) + element(0x04000005, b"OB", b"ab", syntax)
    ends = struct.pack("<HHLHHL", 0xFFFE, 0xE00D, 0, 0xFFFE, 0xE0DD, 0)
    return head, item, ends


@pytest.mark.parametrize("syntax", SYNTAXES[:2])
def test_sequence_behind_the_pixels_is_left_out(tmp_path, syntax):
    plan = write_slices(tmp_path, syntax=syntax)
    append(tmp_path, b"".join(sequence_of_undefined_length(syntax)))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.parametrize("syntax", SYNTAXES[:2])
def test_cut_sequence_behind_the_pixels_is_refused(tmp_path, syntax):
    write_slices(tmp_path, syntax=syntax)
    head, _, _ = sequence_of_undefined_length(syntax)
    append(tmp_path, head[:-4])
    assert_refused_with(tmp_path, "bytes behind the pixel data are no elements of DICOM")


@pytest.mark.parametrize("syntax", SYNTAXES[:3])
@pytest.mark.parametrize("fault", ["junk", "short", "falling", "pixels again", "behind the padding", "too long", "one"])
def test_bytes_behind_the_pixels_that_are_no_element_are_refused(tmp_path, syntax, fault):
    write_slices(tmp_path, syntax=syntax)
    padding = element(0xFFFCFFFC, b"OB", b"ab", syntax)
    append(tmp_path, {
        "junk": bytes(range(200, 250)),
        "short": b"\xfc\xff\xfc\xff",
        "falling": element(0x7FE11010, b"OB", b"ab", syntax) + element(0x00280030, b"OB", b"7\\7 ", syntax),
        "pixels again": element(0x7FE00010, b"OW", bytes(160), syntax),
        "behind the padding": padding + element(0xFFFFFFFF, b"OB", b"ab", syntax),
        "too long": padding[:-1],
        "one": b"\1",
    }[fault])  # fmt: skip
    assert_refused_with(tmp_path, "IM0000: ", "bytes behind the pixel data are no elements of DICOM")


def test_zeros_behind_the_element_of_pixels_are_refused_unless_forced(tmp_path):
    plan = write_slices(tmp_path)
    append(tmp_path, bytes(512))
    assert_refused_with(tmp_path, "IM0000: 512 zero bytes behind the pixel data", "force=True")
    volume = read_volume(tmp_path, force=True)
    assert np.array_equal(volume.voxels, plan.hu())
    assert "512 zero bytes behind the pixel data: left out on demand (all slices)" in volume.report["warnings"]


# --- sent as text ---
NOISY = Plan(shape=(3, 80, 80), name=NAME)
NOISY_SLICE_BYTES = 2 * 80 * 80


def put_noise(ds, k):
    """Pixels for a slice of `NOISY`, among which line ends of both kinds are."""
    values = np.random.default_rng(k).integers(0, 4000, 80 * 80)
    values[::50] = int.from_bytes(b"\r\n", "little")
    ds.PixelData = values.astype("<i2").tobytes()


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian])
@pytest.mark.parametrize(("old", "new"), [(b"\n", b"\r\n"), (b"\r\n", b"\n"), (b"\r", b"\r\n")])
@pytest.mark.parametrize("whole", [True, False])
def test_series_whose_line_ends_were_changed_as_of_text_is_refused(tmp_path, syntax, old, new, whole):
    write_slices(tmp_path, put_noise, syntax=syntax, plan=NOISY)
    for file in tmp_path.iterdir():
        data = file.read_bytes()
        start = 132 if whole else len(data) - NOISY_SLICE_BYTES
        file.write_bytes(data[:start] + data[start:].replace(old, new))
    facts = {b"\n": ("text",), b"\r\n": ("truncated", NOISY_SLICE_BYTES), b"\r": ("elements", "DICOM")}
    with refused(RefusedInputError, *("IM0000",) if whole else facts[old]):
        read_volume(tmp_path)


@pytest.mark.parametrize("tail", [b"", element(0xFFFCFFFC, b"OB", bytes(5000), ExplicitVRLittleEndian)])
def test_frames_whose_line_ends_were_changed_as_of_text_are_refused(tmp_path, tail):
    ds = make_enhanced(NOISY)
    put_noise(ds, 1)
    ds.PixelData *= 3
    data = save_bytes(ds)
    head, pixels = data[: -3 * NOISY_SLICE_BYTES], data[-3 * NOISY_SLICE_BYTES :]
    for changed in (pixels.replace(b"\n", b"\r\n"), pixels.replace(b"\r\n", b"\n")):
        (tmp_path / "one").write_bytes(head + changed + tail)
        assert_refused_with(tmp_path, "one")


@pytest.mark.parametrize("name", [*COMPRESSED, "deflated"])
def test_compressed_slices_whose_line_ends_were_changed_as_of_text_are_refused(tmp_path, name):
    for k in range(3):
        ds = make_dataset(Plan(**{**vars(NOISY), "syntax": NATIVE.get(name, ExplicitVRLittleEndian)}), k)
        put_noise(ds, k)
        if name in COMPRESSED:
            ds.compress(COMPRESSED[name], generate_instance_uid=False)
        data = save_bytes(ds)
        assert data.count(b"\n") > 9  # bytes that the change meets; measured 38 and more
        (tmp_path / NAME(k)).write_bytes(data[:132] + data[132:].replace(b"\n", b"\r\n"))
    assert_refused_with(tmp_path, "IM000")


# --- compressed ---
def write_compressed_with_element(folder, name):
    """Compressed slices; an element of padding goes behind their pixels after the volume is read, which is returned."""
    for k, data in enumerate(make_series(COMPRESSED[name])):
        (folder / NAME(k)).write_bytes(data)
    whole = read_volume(folder).voxels
    append(folder, element(0xFFFCFFFC, b"OB", bytes(30), ExplicitVRLittleEndian))
    return whole


@pytest.mark.parametrize("name", daily(1, COMPRESSED))
def test_element_behind_compressed_pixels_is_left_out_without_a_warning(tmp_path, name):
    whole = write_compressed_with_element(tmp_path, name)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, whole)
    assert volume.report["warnings"] == []


@pytest.mark.parametrize("name", daily(1, COMPRESSED))
def test_bytes_behind_an_element_behind_compressed_pixels_are_refused(tmp_path, name):
    write_compressed_with_element(tmp_path, name)
    append(tmp_path, b"\1\2\3")
    assert_refused_with(tmp_path, "45 bytes behind the pixel data are no elements of DICOM")  # 42 of the element


@pytest.mark.parametrize("name", [*COMPRESSED, *NATIVE])
def test_slices_with_a_second_file_behind_them_are_refused(tmp_path, name):
    """The second is not read in silence: neither its pixels nor that it is there."""
    files = make_series((COMPRESSED | NATIVE)[name])
    for k, data in enumerate(files):
        (tmp_path / NAME(k)).write_bytes(data + files[0])
    assert_refused_with(tmp_path, "bytes behind the ")


@pytest.mark.parametrize("name", COMPRESSED)
@pytest.mark.parametrize(("keyword", "value"), [("Columns", 31), ("Rows", 31), ("Columns", 16)])
def test_compressed_pixels_of_another_size_are_refused(tmp_path, name, keyword, value):
    for k, data in enumerate(make_series(COMPRESSED[name])):
        (tmp_path / NAME(k)).write_bytes(data)
        edit_value(tmp_path / NAME(k), keyword, lambda old: struct.pack("<H", value))
    assert_refused_with(tmp_path, "IM000")


def test_slices_with_gigabytes_of_zeros_behind_them_are_refused_without_reading_all(tmp_path):
    """Zeros without end take no space on the disk, and neither time nor memory here."""
    write_slices(tmp_path)
    for file in tmp_path.iterdir():
        os.truncate(file, 64 << 30)
    with reads_less_than(10 << 20):  # a MiB of each is looked at; measured 3.2 MB of three
        assert_refused_with(tmp_path, "bytes behind the pixel data are no elements of DICOM")


def test_file_without_surplus_is_not_opened_again_and_one_with_it_is(tmp_path, monkeypatch):
    write_slices(tmp_path)

    def fail(*args):
        raise AssertionError("looked at a file that has no surplus")

    monkeypatch.setattr(surplus, "open_regular", fail)
    assert list_series(tmp_path).series[0].slices == 3
    append(tmp_path, b"\0\0")
    with refused(AssertionError, "surplus"):
        list_series(tmp_path)
