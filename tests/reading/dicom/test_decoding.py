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
from pydicom.uid import ExplicitVRBigEndian
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
def test_lossless_codecs_give_back_every_bit(tmp_path, name):
    syntax, encode = ENCODERS[name]
    (pixels,) = place(tmp_path, encapsulate([encode(IMAGES[0])]) + END, syntax)
    assert pixels.dtype == np.uint16 and np.array_equal(pixels, IMAGES[0])


@pytest.mark.parametrize("decoder", decoder_process.DECODERS)
def test_every_decoder_of_a_format_gives_the_same(decoder):
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
        pool.decode(ENCODERS[name][1](IMAGES[1]), decoder, out)
    assert np.array_equal(out, IMAGES[1])


def test_a_decoder_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with refused(RefusedInputError, "decoder", "installed"):
        codecs.choose_decoder(JPEG + "80")


@pytest.mark.parametrize("name", ["JPEG lossless 6", "JPEG-LS", "JPEG 2000", "RLE"])
def test_signed_values_and_eight_bits_are_decoded(tmp_path, name):
    syntax, encode = ENCODERS[name]
    signed = (IMAGES[0].astype(np.int16) - 2000) * 7
    (pixels,) = place(tmp_path, encapsulate([encode(signed.view(np.uint16))]) + END, syntax, signed=True)
    assert pixels.dtype == np.int16 and np.array_equal(pixels, signed)
    narrow = (IMAGES[0] % 256).astype(np.uint8)
    data = encode_lossless(narrow, 6, 8) if name.startswith("JPEG lossless") else encode(narrow)
    (pixels,) = place(tmp_path, encapsulate([data]) + END, syntax, bits_allocated=8, bits_stored=8, high_bit=7)
    assert pixels.dtype == np.uint8 and np.array_equal(pixels, narrow)
    if name != "RLE":  # 8 bits of a codestream in a cell of 16
        (pixels,) = place(tmp_path, encapsulate([data]) + END, syntax, bits_stored=8, high_bit=7)
        assert pixels.dtype == np.uint16 and np.array_equal(pixels, narrow)


TWELVE_SIGNED_BITS = {
    "JPEG lossless": (JPEG + "70", lambda image: encode_lossless(image, 1, 12)),
    "JPEG 2000": (JPEG + "90", lambda image: encode_jpeg_2000(image, bitspersample=12)),
}
"""Codestreams of 12 bits without a sign, in pixels whose header says 16 bits with one."""


@pytest.mark.parametrize("name", TWELVE_SIGNED_BITS)
def test_values_whose_sign_cannot_be_told_are_refused(tmp_path, name):
    syntax, encode = TWELVE_SIGNED_BITS[name]
    with refused(RefusedInputError, 12, 16):
        place(tmp_path, encapsulate([encode(IMAGES[0])]) + END, syntax, signed=True)


@pytest.mark.parametrize("name", TWELVE_SIGNED_BITS)
def test_values_below_the_doubtful_sign_are_decoded(tmp_path, name):
    syntax, encode = TWELVE_SIGNED_BITS[name]
    low = IMAGES[0] % 2048  # 11 bits
    (pixels,) = place(tmp_path, encapsulate([encode(low)]) + END, syntax, signed=True)
    assert np.array_equal(pixels, low)


@pytest.mark.parametrize("name", TWELVE_SIGNED_BITS)
def test_all_twelve_stored_bits_of_signed_values_are_kept(tmp_path, name):
    """The bits above them get the sign later."""
    syntax, encode = TWELVE_SIGNED_BITS[name]
    data = encapsulate([encode(IMAGES[0])]) + END
    (pixels,) = place(tmp_path, data, syntax, signed=True, bits_stored=12, high_bit=11)
    assert np.array_equal(pixels & 0xFFF, IMAGES[0])


# --- frames in a file ---


@pytest.mark.parametrize("table", [True, False])
@pytest.mark.parametrize("pieces", [1, 3])
@pytest.mark.parametrize("name", ["JPEG-LS", "JPEG 2000", "RLE"])
def test_frames_are_found_in_every_layout(tmp_path, name, pieces, table):
    if name == "RLE" and pieces > 1:
        pytest.skip("an RLE frame is one fragment")
    syntax, encode = ENCODERS[name]
    data = encapsulate([encode(image) for image in IMAGES], fragments_per_frame=pieces, has_bot=table) + END
    for pixels, image in zip(place(tmp_path, data, syntax, 4), IMAGES, strict=True):
        assert np.array_equal(pixels, image)


def test_an_extended_offset_table_is_not_needed(tmp_path):
    data, _, _ = encapsulate_extended([encode_jpeg_2000(image) for image in IMAGES])
    assert np.array_equal(place(tmp_path, data + END, frames=4), IMAGES)


def test_one_frame_in_many_fragments_or_as_jp2_is_decoded(tmp_path):
    data = encode_jpeg_2000(IMAGES[0])
    (pixels,) = place(tmp_path, encapsulate([data], fragments_per_frame=5, has_bot=False) + END)
    assert np.array_equal(pixels, IMAGES[0])
    wrapped = bytes(imagecodecs.jpeg2k_encode(IMAGES[0], level=0, reversible=True, codecformat="jp2"))
    (pixels,) = place(tmp_path, encapsulate([wrapped]) + END)
    assert np.array_equal(pixels, IMAGES[0])


@pytest.mark.parametrize(
    ("fragments", "frames", "table", "words"),
    [
        (1, 2, b"", (2, 1)),
        (0, 1, b"", ("compressed",)),
        (3, 2, b"", (2, 3)),
        (2, 1, b"", (1, 2)),
        (3, 2, struct.pack("<2L", 0, 9), (2, 3)),
        (3, 2, struct.pack("<2L", 8, 0), (2, 3)),
    ],
)
def test_frames_that_cannot_be_told_apart_are_refused(tmp_path, fragments, frames, table, words):
    data = item(table) + item(even(encode_jpeg_2000(IMAGES[0]))) * fragments + END
    with refused(RefusedInputError, *words):
        place(tmp_path, data, frames=frames)


def test_damaged_items_are_refused(tmp_path):
    frame = even(encode_jpeg_2000(IMAGES[0]))
    whole = item(b"") + item(frame)
    with refused(RefusedInputError, "pixels", "truncated", "mark"):
        place(tmp_path, whole)
    with refused(RefusedInputError, "truncated", len(frame), len(frame) - 4):
        place(tmp_path, whole[:-4])
    with refused(RefusedInputError, "0000,0000"):
        place(tmp_path, item(b"") + bytes(50))
    with refused(RefusedInputError, 2000, "fragments"):  # of one frame
        place(tmp_path, item(b"") * 2500 + END)


class CountingFile(io.BytesIO):
    """How much is read of a file."""

    count = 0

    def read(self, size=-1):
        data = super().read(size)
        CountingFile.count += len(data)
        return data


def test_items_are_walked_once_and_nothing_else_is_read(monkeypatch, tmp_path):
    data = encapsulate([bytes(1000)] * 500, has_bot=False) + END
    file = CountingFile(data)
    frames = transfer_syntaxes.find_frames(file, 0, len(data), 500, RLE)
    assert CountingFile.count == 502 * 8
    assert transfer_syntaxes.read_pieces(file, frames[499]) == bytes(1000)
    assert CountingFile.count == 502 * 8 + 1000
    path = tmp_path / "pixels"
    path.write_bytes(encapsulate([encode_rle(image) for image in IMAGES]) + END)
    calls = []
    monkeypatch.setattr(stored, "find_frames", lambda *a: calls.append(a) or transfer_syntaxes.find_frames(*a))
    assert np.array_equal(load(make_headers(path, RLE, 4)), IMAGES)
    assert len(calls) == 1


def test_frames_of_plain_and_deflated_files_are_found(tmp_path, monkeypatch):
    head, pixels = b"head" * 5, IMAGES.tobytes()
    plain = tmp_path / "plain"
    plain.write_bytes(head + pixels)
    headers = make_headers(plain, "1.2.840.10008.1.2.1", 4)
    headers = [dataclasses.replace(header, pixel_offset=20, pixel_length=len(pixels)) for header in headers]
    assert np.array_equal(load(headers), IMAGES)

    deflated = tmp_path / "deflated"
    deflater = zlib.compressobj(wbits=-15)
    deflated.write_bytes(b"meta" + deflater.compress(head + pixels) + deflater.flush())
    headers = [dataclasses.replace(header, file=deflated, inflate_from=4) for header in headers]
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
def test_pydicoms_files_give_pydicoms_pixels(tmp_path, name):
    found = get_testdata_file(name, download=False)
    if found is None:
        pytest.skip(f"pydicom has no {name} here")
    path = Path(found)
    ds = pydicom.dcmread(path)
    pixels = load_file(tmp_path, path, ds)
    assert np.array_equal(drop_unused_bits(pixels, ds), ds.pixel_array)
    assert pixels.any()


@pytest.mark.parametrize("ending", daily(2, ["90", "91", "80", "81", "57", "70", "5"]))
def test_another_library_gives_the_same_pixels(tmp_path, real_data, ending):
    """SimpleITK (GDCM), which decodes with code of its own."""
    itk = pytest.importorskip("SimpleITK")
    (path,) = (real_data / "transfer_syntaxes").glob(f"CTImage*.{ending}.dcm")
    ds = pydicom.dcmread(path)
    other = itk.GetArrayFromImage(itk.ReadImage(str(path)))[0]
    pixels = load_file(tmp_path, path, ds)
    assert np.array_equal(pixels.astype(int) * int(ds.RescaleSlope) + int(ds.RescaleIntercept), other)


def test_row_42_big_endian_pixels_are_read(tmp_path):
    plan = Plan(shape=(2, 5, 6), syntax=ExplicitVRBigEndian)
    for k in range(2):
        ds = make_dataset(plan, k)
        ds.PixelData = plan.stored(k).byteswap().tobytes()
        save_dataset(ds, tmp_path / plan.name(k))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())
