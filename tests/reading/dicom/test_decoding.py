"""Compressed frames: every syntax bit for bit, and frames found in every legal layout.

Row 42 of the fault list (big endian) is tested here.
"""

from __future__ import annotations

import dataclasses
import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pydicom
import pytest
from compressed_frames import (
    COLUMNS,
    ENCODERS,
    END,
    IMAGES,
    JPEG,
    RLE,
    ROWS,
    encode_jpeg_2000,
    encode_lossless,
    encode_rle,
    even,
    imagecodecs,
    item,
    load,
    make_header,
    make_headers,
    place,
)
from dicom_series import Plan, make_dataset, save_dataset
from pydicom.data import get_testdata_file
from pydicom.encaps import encapsulate, encapsulate_extended
from pydicom.uid import ExplicitVRBigEndian, ExplicitVRLittleEndian
from refusals import refused
from variants import daily

from clrecon.errors import RefusedInputError
from clrecon.reading import read_volume
from clrecon.reading.dicom.parse import transfer_syntaxes
from clrecon.reading.dicom.parse import transfer_syntaxes as codecs
from clrecon.reading.dicom.parse.elements import read_elements
from clrecon.reading.dicom.parse.values import WANTED_TAGS
from clrecon.reading.dicom.pixels import decoder_process, stored
from clrecon.reading.dicom.pixels.decoder_pool import DecoderPool


@pytest.mark.parametrize("name", daily(5, ENCODERS))
def test_pixels_of_every_lossless_coding_are_decoded_bit_for_bit(tmp_path, name):
    syntax, encode = ENCODERS[name]
    (pixels,) = place(tmp_path, encapsulate([encode(IMAGES[0])]) + END, syntax)
    assert pixels.dtype == np.uint16
    assert np.array_equal(pixels, IMAGES[0])


@pytest.mark.parametrize("decoder", decoder_process.DECODERS)
def test_every_decoder_gives_the_pixels_that_were_encoded(decoder):
    """Which one is taken depends on what is installed."""
    name = {
        "openjpeg": "JPEG 2000",
        "imagecodecs jpeg_2000": "JPEG 2000",
        "jpeg_ls": "JPEG-LS",
        "imagecodecs jpeg_ls": "JPEG-LS",
        "rle": "RLE",
        "imagecodecs jpeg": "JPEG lossless 4",
    }[decoder]
    pytest.importorskip(decoder.split()[0])
    out = np.zeros((ROWS, COLUMNS), np.uint16)
    with DecoderPool([decoder], out.nbytes) as pool:
        _, encode = ENCODERS[name]
        pool.decode(encode(IMAGES[1]), decoder, out)
    assert np.array_equal(out, IMAGES[1])


def test_coding_whose_decoder_is_not_installed_is_refused(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with refused(RefusedInputError, "decoder", "installed"):
        codecs.choose_decoder(JPEG + "80")  # JPEG-LS


CODINGS = pytest.mark.parametrize("name", ["JPEG lossless 6", "JPEG-LS", "JPEG 2000", "RLE"])


@CODINGS
def test_signed_pixels_are_decoded(tmp_path, name):
    syntax, encode = ENCODERS[name]
    signed = (IMAGES[0].astype(np.int16) - 2000) * 7
    (pixels,) = place(tmp_path, encapsulate([encode(signed.view(np.uint16))]) + END, syntax, signed=True)
    assert pixels.dtype == np.int16
    assert np.array_equal(pixels, signed)


def encode_8_bits(name):
    """Pixels of 8 bits, and their codestream."""
    pixels = (IMAGES[0] % 256).astype(np.uint8)
    if name == "JPEG lossless 6":
        return pixels, encode_lossless(pixels, predictor=6, bits=8)
    _, encode = ENCODERS[name]
    return pixels, encode(pixels)


@CODINGS
def test_pixels_of_8_bits_are_decoded(tmp_path, name):
    expected, data = encode_8_bits(name)
    syntax, _ = ENCODERS[name]
    (pixels,) = place(tmp_path, encapsulate([data]) + END, syntax, bits_allocated=8, bits_stored=8, high_bit=7)
    assert pixels.dtype == np.uint8
    assert np.array_equal(pixels, expected)


@pytest.mark.parametrize("name", ["JPEG lossless 6", "JPEG-LS", "JPEG 2000"])
def test_codestream_of_8_bits_is_decoded_into_16_allocated_ones(tmp_path, name):
    expected, data = encode_8_bits(name)
    syntax, _ = ENCODERS[name]
    (pixels,) = place(tmp_path, encapsulate([data]) + END, syntax, bits_stored=8, high_bit=7)
    assert pixels.dtype == np.uint16
    assert np.array_equal(pixels, expected)


TWELVE_SIGNED_BITS = {
    "JPEG lossless": (JPEG + "70", lambda image: encode_lossless(image, predictor=1, bits=12)),
    "JPEG 2000": (JPEG + "90", lambda image: encode_jpeg_2000(image, bitspersample=12)),
}
"""Codestreams of 12 bits without a sign, in pixels whose header says 16 bits with one."""


@pytest.mark.parametrize("name", TWELVE_SIGNED_BITS)
def test_codestream_without_a_sign_for_signed_pixels_of_more_bits_is_refused(tmp_path, name):
    syntax, encode = TWELVE_SIGNED_BITS[name]
    with refused(RefusedInputError, 12, 16):
        place(tmp_path, encapsulate([encode(IMAGES[0])]) + END, syntax, signed=True)


@pytest.mark.parametrize("name", TWELVE_SIGNED_BITS)
def test_codestream_without_a_sign_is_decoded_where_its_highest_bit_is_not_used(tmp_path, name):
    syntax, encode = TWELVE_SIGNED_BITS[name]
    low = IMAGES[0] % 2048  # 11 bits
    (pixels,) = place(tmp_path, encapsulate([encode(low)]) + END, syntax, signed=True)
    assert np.array_equal(pixels, low)


@pytest.mark.parametrize("name", TWELVE_SIGNED_BITS)
def test_codestream_of_all_twelve_stored_bits_of_signed_pixels_is_decoded(tmp_path, name):
    """The bits above them get the sign later."""
    syntax, encode = TWELVE_SIGNED_BITS[name]
    data = encapsulate([encode(IMAGES[0])]) + END
    (pixels,) = place(tmp_path, data, syntax, signed=True, bits_stored=12, high_bit=11)
    assert np.array_equal(pixels & 0xFFF, IMAGES[0])


# --- frames in a file ---


@pytest.mark.parametrize("table", [True, False])
@pytest.mark.parametrize("pieces", [1, 3])
@pytest.mark.parametrize("name", ["JPEG-LS", "JPEG 2000", "RLE"])
def test_compressed_frames_are_found_with_and_without_offsets_in_one_or_several_fragments(
    tmp_path, name, pieces, table
):
    if name == "RLE" and pieces > 1:
        pytest.skip("an RLE frame is one fragment")
    syntax, encode = ENCODERS[name]
    data = encapsulate([encode(image) for image in IMAGES], fragments_per_frame=pieces, has_bot=table) + END
    for pixels, image in zip(place(tmp_path, data, syntax, frames=4), IMAGES, strict=True):
        assert np.array_equal(pixels, image)


def test_compressed_frames_with_an_extended_offset_table_are_found(tmp_path):
    data, _, _ = encapsulate_extended([encode_jpeg_2000(image) for image in IMAGES])
    assert np.array_equal(place(tmp_path, data + END, frames=4), IMAGES)


def test_one_frame_in_five_fragments_is_decoded(tmp_path):
    data = encapsulate([encode_jpeg_2000(IMAGES[0])], fragments_per_frame=5, has_bot=False) + END
    (pixels,) = place(tmp_path, data)
    assert np.array_equal(pixels, IMAGES[0])


def test_frame_that_is_a_jp2_file_is_decoded(tmp_path):
    jp2 = bytes(imagecodecs.jpeg2k_encode(IMAGES[0], level=0, reversible=True, codecformat="jp2"))
    (pixels,) = place(tmp_path, encapsulate([jp2]) + END)
    assert np.array_equal(pixels, IMAGES[0])


@pytest.mark.parametrize(
    ("fragments", "frames", "table", "facts"),
    [
        pytest.param(1, 2, b"", (2, 1), id="2 frames in 1 fragment"),
        pytest.param(0, 1, b"", ("compressed",), id="no fragment"),
        pytest.param(3, 2, b"", (2, 3), id="2 frames in 3 fragments"),
        pytest.param(2, 1, b"", (1, 2), id="1 frame that ends in the first of 2"),
        pytest.param(3, 2, struct.pack("<2L", 0, 9), (2, 3), id="offset within a fragment"),
        pytest.param(3, 2, struct.pack("<2L", 8, 0), (2, 3), id="offsets that fall"),
    ],
)
def test_fragments_that_do_not_tell_their_frames_apart_are_refused(tmp_path, fragments, frames, table, facts):
    data = item(table) + item(even(encode_jpeg_2000(IMAGES[0]))) * fragments + END
    with refused(RefusedInputError, *facts):
        place(tmp_path, data, frames=frames)


FRAME = even(encode_jpeg_2000(IMAGES[0]))


@pytest.mark.parametrize(
    ("data", "facts"),
    [
        pytest.param(item(b"") + item(FRAME), ("pixels", "truncated", "mark"), id="no end mark"),
        pytest.param((item(b"") + item(FRAME))[:-4], ("truncated", len(FRAME), len(FRAME) - 4), id="cut"),
        pytest.param(item(b"") + bytes(50), ("0000,0000"), id="zeros in place of an item"),
        pytest.param(item(b"") * 2500 + END, (2000, "fragments"), id="2500 fragments of one frame"),
    ],
)
def test_compressed_pixels_with_damaged_items_are_refused(tmp_path, data, facts):
    with refused(RefusedInputError, *([facts] if isinstance(facts, str) else facts)):
        place(tmp_path, data)


class CountingFile(io.BytesIO):
    """Counts the bytes that are read of it."""

    count = 0

    def read(self, size=-1):
        data = super().read(size)
        self.count += len(data)
        return data


def test_frames_are_found_by_the_heads_of_their_items_alone():
    data = encapsulate([bytes(1000)] * 500, has_bot=False) + END
    file = CountingFile(data)
    frames = transfer_syntaxes.find_frames(file, start=0, file_bytes=len(data), frames=500, transfer_syntax=RLE)
    assert file.count == (1 + 500 + 1) * 8  # table, fragments and end mark
    assert transfer_syntaxes.read_pieces(file, frames[499]) == bytes(1000)
    assert file.count == (1 + 500 + 1) * 8 + 1000


def test_frames_of_a_file_are_found_once_for_all_of_them(monkeypatch, tmp_path):
    path = tmp_path / "pixels"
    path.write_bytes(encapsulate([encode_rle(image) for image in IMAGES]) + END)
    calls = []
    monkeypatch.setattr(stored, "find_frames", lambda *a: calls.append(a) or transfer_syntaxes.find_frames(*a))
    assert np.array_equal(load(make_headers(path, RLE, frames=4)), IMAGES)
    assert len(calls) == 1


def test_frames_of_an_uncompressed_file_are_read(tmp_path):
    pixels = IMAGES.tobytes()
    path = tmp_path / "plain"
    path.write_bytes(bytes(20) + pixels)
    headers = make_headers(path, ExplicitVRLittleEndian, frames=4)
    headers = [dataclasses.replace(header, pixel_offset=20, pixel_length=len(pixels)) for header in headers]
    assert np.array_equal(load(headers), IMAGES)


def test_frames_of_a_deflated_file_are_read_and_it_is_inflated_once(tmp_path, monkeypatch):
    pixels = IMAGES.tobytes()
    path = tmp_path / "deflated"
    deflater = zlib.compressobj(wbits=-15)
    path.write_bytes(b"meta" + deflater.compress(bytes(20) + pixels) + deflater.flush())
    headers = [
        dataclasses.replace(header, pixel_offset=20, pixel_length=len(pixels), inflate_from=4)
        for header in make_headers(path, ExplicitVRLittleEndian, frames=4)
    ]
    calls = []
    inflate = stored.inflate
    monkeypatch.setattr(stored, "inflate", lambda *a: calls.append(a) or inflate(*a))
    assert np.array_equal(load(headers), IMAGES)
    assert len(calls) == 1


# --- files of others ---

COMPRESSED = (
    "693_J2KI.dcm J2K_pixelrep_mismatch.dcm JPEG2000.dcm JPEGLSNearLossless_08.dcm JPEGLSNearLossless_16.dcm "
    "MR_small_RLE.dcm MR_small_jp2klossless.dcm MR_small_jpeg_ls_lossless.dcm rtdose_rle.dcm rtdose_rle_1frame.dcm"
).split()
PLAIN = "CT_small.dcm MR_small_bigendian.dcm MR_small_implicit.dcm MR_small_padded.dcm image_dfl.dcm rtdose.dcm".split()


def load_file(folder, path, ds):
    elements = read_elements(path, WANTED_TAGS)
    first = dataclasses.replace(
        make_header(folder),
        file=path,
        name=path.name,
        frames=int(ds.get("NumberOfFrames") or 1),
        rows=ds.Rows,
        columns=ds.Columns,
        bits_allocated=ds.BitsAllocated,
        bits_stored=ds.BitsStored,
        high_bit=ds.HighBit,
        signed=bool(ds.PixelRepresentation),
        **{
            name: getattr(elements, name)
            for name in "transfer_syntax little_endian pixel_offset pixel_length inflate_from file_bytes".split()
        },
    )
    return np.squeeze(load([dataclasses.replace(first, frame=n) for n in range(first.frames)]))


def drop_unused_bits(pixels, ds):
    unused = ds.BitsAllocated - ds.BitsStored
    return pixels << unused >> unused


@pytest.mark.parametrize("name", daily(5, [*COMPRESSED, *PLAIN]))
def test_files_of_pydicom_have_the_pixels_that_pydicom_reads(tmp_path, name):
    found = get_testdata_file(name, download=False)
    if found is None:
        pytest.skip(f"pydicom has no {name} here")
    path = Path(found)
    ds = pydicom.dcmread(path)
    pixels = load_file(tmp_path, path, ds)
    assert np.array_equal(drop_unused_bits(pixels, ds), ds.pixel_array)
    assert pixels.any()


@pytest.mark.parametrize("ending", daily(2, ["90", "91", "80", "81", "57", "70", "5"]))
def test_real_slice_has_the_hu_that_simpleitk_reads(tmp_path, real_data, ending):
    """SimpleITK (GDCM), which decodes with code of its own."""
    itk = pytest.importorskip("SimpleITK")
    (path,) = (real_data / "transfer_syntaxes").glob(f"CTImage*.{ending}.dcm")
    ds = pydicom.dcmread(path)
    other = itk.GetArrayFromImage(itk.ReadImage(str(path)))[0]
    pixels = load_file(tmp_path, path, ds)
    assert np.array_equal(pixels.astype(int) * int(ds.RescaleSlope) + int(ds.RescaleIntercept), other)


@pytest.mark.fault_row(42)
def test_big_endian_pixels_are_read(tmp_path):
    plan = Plan(shape=(2, 5, 6), syntax=ExplicitVRBigEndian)
    for k in range(2):
        ds = make_dataset(plan, k)
        ds.PixelData = plan.stored(k).byteswap().tobytes()
        save_dataset(ds, tmp_path / plan.name(k))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())
