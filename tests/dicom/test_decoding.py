"""Compressed frames: every syntax bit for bit, frames found in every legal layout, hostile codestreams refused.

Rows of the fault list that are tested here: 38 (bombs), 40 (garbage), 41 (unknown syntaxes), 42 (big endian).
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
from dicom_series import Plan, make_dataset, save_dataset, write_series
from pydicom.data import get_testdata_file
from pydicom.encaps import encapsulate, encapsulate_extended
from pydicom.uid import ExplicitVRBigEndian

from clrecon.dicom import codecs, codestream, decoder_process, encapsulated, read_volume, stored
from clrecon.dicom.decoder_pool import DecoderPool
from clrecon.dicom.elements import read_elements
from clrecon.dicom.header import read_headers
from clrecon.dicom.stored import StoredPixels
from clrecon.dicom.values import WANTED_TAGS
from clrecon.errors import RefusedInputError

imagecodecs = pytest.importorskip("imagecodecs")
rle = pytest.importorskip("rle.rle")

ROWS, COLUMNS = 31, 45
JPEG = "1.2.840.10008.1.2.4."
RLE = "1.2.840.10008.1.2.5"
IMAGES = np.random.default_rng(3).integers(0, 4096, (4, ROWS, COLUMNS)).astype(np.uint16)


def encode_rle(image):
    rows, columns = image.shape
    return bytes(rle.encode_frame(image.tobytes(), rows, columns, 1, 8 * image.itemsize, "<"))


def encode_jpeg_2000(image, **options):
    return bytes(imagecodecs.jpeg2k_encode(image, level=0, reversible=True, codecformat="j2k", **options))


ENCODERS = {
    **{f"JPEG lossless {n}": (JPEG + "57", lambda image, n=n: encode_lossless(image, n)) for n in range(1, 8)},
    "JPEG lossless first order": (JPEG + "70", lambda image: encode_lossless(image, 1)),
    "JPEG-LS": (JPEG + "80", lambda image: bytes(imagecodecs.jpegls_encode(image))),
    "JPEG 2000": (JPEG + "90", encode_jpeg_2000),
    "HTJ2K": (JPEG + "201", lambda image: bytes(imagecodecs.htj2k_encode(image))),
    "HTJ2K RPCL": (JPEG + "202", lambda image: bytes(imagecodecs.htj2k_encode(image))),
    "RLE": (RLE, encode_rle),
}


def encode_lossless(image, predictor, bits=16):
    return bytes(imagecodecs.jpeg8_encode(image, lossless=True, predictor=predictor, bitspersample=bits))


@pytest.fixture
def base(tmp_path):
    """A valid header to start from."""
    write_series(tmp_path / "base", Plan(shape=(1, ROWS, COLUMNS)))
    (header,) = read_headers(tmp_path / "base" / "slice000.dcm")
    return header


def make_headers(base, path, syntax, frames=1, **changes):
    """Headers of the frames of a file that holds nothing but encapsulated pixel data."""
    changes = {"rows": ROWS, "columns": COLUMNS, "signed": False, **changes}
    header = dataclasses.replace(
        base,
        file=path,
        name=path.name,
        frames=frames,
        transfer_syntax=syntax,
        pixel_offset=0,
        pixel_length=-1,
        file_bytes=path.stat().st_size,
        **changes,
    )
    return [dataclasses.replace(header, frame=n) for n in range(frames)]


def load(headers):
    with StoredPixels(headers) as source:
        return [source.load(header, np.zeros((header.rows, header.columns), np.int16)) for header in headers]


def item(data: bytes) -> bytes:
    return struct.pack("<HHL", 0xFFFE, 0xE000, len(data)) + data


END = struct.pack("<HHL", 0xFFFE, 0xE0DD, 0)


def even(data: bytes) -> bytes:
    return data + b"\0" * (len(data) % 2)


@pytest.fixture
def place(base, tmp_path):
    """Write bytes as a file of encapsulated pixel data and load its frames."""

    def write_and_load(data, syntax=JPEG + "90", frames=1, **changes):
        path = tmp_path / "pixels"
        path.write_bytes(data)
        return load(make_headers(base, path, syntax, frames, **changes))

    return write_and_load


@pytest.mark.parametrize("name", ENCODERS)
def test_lossless_codecs_give_back_every_bit(place, name):
    syntax, encode = ENCODERS[name]
    (pixels,) = place(encapsulate([encode(IMAGES[0])]) + END, syntax)
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
    with pytest.raises(RefusedInputError, match=r"4\.80 needs a decoder that is not installed: pip install pyjpegls"):
        codecs.choose_decoder(JPEG + "80")


@pytest.mark.parametrize("name", ["JPEG lossless 6", "JPEG-LS", "JPEG 2000", "RLE"])
def test_signed_values_and_eight_bits(place, name):
    syntax, encode = ENCODERS[name]
    signed = (IMAGES[0].astype(np.int16) - 2000) * 7
    (pixels,) = place(encapsulate([encode(signed.view(np.uint16))]) + END, syntax, signed=True)
    assert pixels.dtype == np.int16 and np.array_equal(pixels, signed)
    narrow = (IMAGES[0] % 256).astype(np.uint8)
    data = encode_lossless(narrow, 6, 8) if name.startswith("JPEG lossless") else encode(narrow)
    (pixels,) = place(encapsulate([data]) + END, syntax, bits_allocated=8, bits_stored=8, high_bit=7)
    assert pixels.dtype == np.uint8 and np.array_equal(pixels, narrow)
    if name != "RLE":  # 8 bits of a codestream in a cell of 16
        (pixels,) = place(encapsulate([data]) + END, syntax, bits_stored=8, high_bit=7)
        assert pixels.dtype == np.uint16 and np.array_equal(pixels, narrow)


def test_values_whose_sign_cannot_be_told_are_refused(place):
    low, high = IMAGES[0] % 2048, IMAGES[0]
    for syntax, encode in (
        (JPEG + "70", lambda image: encode_lossless(image, 1, 12)),
        (JPEG + "90", lambda image: encode_jpeg_2000(image, bitspersample=12)),
    ):
        (pixels,) = place(encapsulate([encode(low)]) + END, syntax, signed=True)
        assert np.array_equal(pixels, low)
        with pytest.raises(RefusedInputError, match="12 bits and no sign, the header says 16 bits with one"):
            place(encapsulate([encode(high)]) + END, syntax, signed=True)
        # With 12 bits stored the highest bit is the sign; it is extended later, with the unused bits.
        (pixels,) = place(encapsulate([encode(high)]) + END, syntax, signed=True, bits_stored=12, high_bit=11)
        assert np.array_equal(pixels & 0xFFF, high)


# --- frames in a file ---


@pytest.mark.parametrize("table", [True, False])
@pytest.mark.parametrize("pieces", [1, 3])
@pytest.mark.parametrize("name", ["JPEG-LS", "JPEG 2000", "RLE"])
def test_frames_are_found_in_every_layout(place, name, pieces, table):
    if name == "RLE" and pieces > 1:
        pytest.skip("an RLE frame is one fragment")
    syntax, encode = ENCODERS[name]
    data = encapsulate([encode(image) for image in IMAGES], fragments_per_frame=pieces, has_bot=table) + END
    for pixels, image in zip(place(data, syntax, 4), IMAGES, strict=True):
        assert np.array_equal(pixels, image)


def test_an_extended_offset_table_is_not_needed(place):
    data, _, _ = encapsulate_extended([encode_jpeg_2000(image) for image in IMAGES])
    assert np.array_equal(place(data + END, frames=4), IMAGES)


def test_one_frame_in_many_fragments_and_as_jp2(place):
    data = encode_jpeg_2000(IMAGES[0])
    (pixels,) = place(encapsulate([data], fragments_per_frame=5, has_bot=False) + END)
    assert np.array_equal(pixels, IMAGES[0])
    wrapped = bytes(imagecodecs.jpeg2k_encode(IMAGES[0], level=0, reversible=True, codecformat="jp2"))
    (pixels,) = place(encapsulate([wrapped]) + END)
    assert np.array_equal(pixels, IMAGES[0])


@pytest.mark.parametrize(
    ("fragments", "frames", "table", "words"),
    [
        (1, 2, b"", "truncated: 2 frames expected, 1 fragments found"),
        (0, 1, b"", "truncated: there are no compressed pixels"),
        (3, 2, b"", "2 frames expected, 3 found in 3 fragments"),
        (2, 1, b"", "1 frame expected, 2 found in 2 fragments"),
        (3, 2, struct.pack("<2L", 0, 9), "2 frames expected, 3 found in 3 fragments"),
        (3, 2, struct.pack("<2L", 8, 0), "2 frames expected, 3 found in 3 fragments"),
    ],
)
def test_frames_that_cannot_be_told_apart_are_refused(place, fragments, frames, table, words):
    data = item(table) + item(even(encode_jpeg_2000(IMAGES[0]))) * fragments + END
    with pytest.raises(RefusedInputError, match=words):
        place(data, frames=frames)


def test_damaged_items_are_refused(place, monkeypatch):
    frame = even(encode_jpeg_2000(IMAGES[0]))
    whole = item(b"") + item(frame)
    with pytest.raises(RefusedInputError, match="pixels: truncated: the compressed pixels have no end mark"):
        place(whole)
    with pytest.raises(RefusedInputError, match=rf"truncated: {len(frame)} bytes of .* expected, {len(frame) - 4} "):
        place(whole[:-4])
    with pytest.raises(RefusedInputError, match=r"no item of compressed pixels where one is expected \(0000,0000\)"):
        place(item(b"") + bytes(50))
    monkeypatch.setattr(encapsulated, "MAX_FRAGMENTS", 3)
    with pytest.raises(RefusedInputError, match="in more than 3 fragments"):
        place(item(b"") * 5 + END)


class CountingFile(io.BytesIO):
    """How much is read of a file."""

    count = 0

    def read(self, size=-1):
        data = super().read(size)
        CountingFile.count += len(data)
        return data


def test_items_are_walked_once_and_nothing_else_is_read(monkeypatch, base, tmp_path):
    data = encapsulate([bytes(1000)] * 500, has_bot=False) + END
    file = CountingFile(data)
    frames = encapsulated.find_frames(file, 0, len(data), 500, RLE)
    assert CountingFile.count == 502 * 8
    assert encapsulated.read_pieces(file, frames[499]) == bytes(1000)
    assert CountingFile.count == 502 * 8 + 1000
    path = tmp_path / "pixels"
    path.write_bytes(encapsulate([encode_rle(image) for image in IMAGES]) + END)
    calls = []
    monkeypatch.setattr(stored, "find_frames", lambda *a: calls.append(a) or encapsulated.find_frames(*a))
    assert np.array_equal(load(make_headers(base, path, RLE, 4)), IMAGES)
    assert len(calls) == 1


def test_frames_of_plain_and_deflated_files(base, tmp_path, monkeypatch):
    head, pixels = b"head" * 5, IMAGES.tobytes()
    plain = tmp_path / "plain"
    plain.write_bytes(head + pixels)
    headers = make_headers(base, plain, "1.2.840.10008.1.2.1", 4)
    headers = [dataclasses.replace(header, pixel_offset=20, pixel_length=len(pixels)) for header in headers]
    assert np.array_equal(load(headers), IMAGES)

    deflated = tmp_path / "deflated"
    deflater = zlib.compressobj(wbits=-15)
    deflated.write_bytes(b"meta" + deflater.compress(head + pixels) + deflater.flush())
    headers = [dataclasses.replace(header, file=deflated, inflate_from=4) for header in headers]
    calls = []
    inflate = stored._inflate_data_set
    monkeypatch.setattr(stored, "_inflate_data_set", lambda *a: calls.append(a) or inflate(*a))
    assert np.array_equal(load(headers), IMAGES)
    assert len(calls) == 1


# --- hostile codestreams ---


def cut_end(data):
    return data[:-2] + b"\0\0"


@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        ("JPEG 2000", lambda d: b"\xff\xd8" + d[2:], "is no JPEG 2000 codestream"),
        ("JPEG 2000", lambda d: d[:8] + struct.pack(">2L", 65535, 65535) + d[16:], "is 65535 x 65535, the header"),
        ("JPEG 2000", lambda d: d[:40] + b"\0\x03" + d[42:], "has 3 components, a CT slice has one"),
        ("JPEG 2000", lambda d: d[:42] + b"\x1f" + d[43:], "has 32 bits a pixel, the header allocates 16"),
        ("JPEG 2000", lambda d: d[:43] + b"\2\2" + d[45:], "fewer samples than pixels"),
        ("JPEG 2000", cut_end, "truncated: the compressed frame has no end mark"),
        ("JPEG-LS", cut_end, "truncated: the compressed frame has no end mark"),
        ("JPEG-LS", lambda d: d.replace(b"\xff\xf7", b"\xff\xc3", 1), "is no JPEG-LS codestream"),
        ("JPEG lossless 1", lambda d: d.replace(b"\xff\xc3", b"\xff\xc1", 1), "is no JPEG lossless codestream"),
        ("JPEG lossless 1", lambda d: b"\xff\xd8" + b"\xff" * 5000, "is no JPEG lossless codestream"),
        ("JPEG 2000", lambda d: d[:80] + bytes(len(d) - 82) + d[-2:], "do not decode"),
        ("RLE", lambda d: d[:40], "shorter than the head of an RLE frame"),
        ("RLE", lambda d: struct.pack("<L", 3) + d[4:], "has 3 segments, 2 expected"),
        ("RLE", lambda d: d[:8] + struct.pack("<L", 10**9) + d[12:], "damaged table of segments"),
        ("RLE", lambda d: d[:4] + struct.pack("<L", 0) + d[8:], "damaged table of segments"),
        ("RLE", lambda d: d[: struct.unpack("<L", d[8:12])[0] + 10], "truncated: an RLE segment of 10 bytes for 1395"),
        ("RLE", lambda d: d[:-200], "do not decode"),
    ],
)
def test_rows_38_and_40_codestreams_that_lie_or_are_cut(place, name, spoil, words):
    syntax, encode = ENCODERS[name]
    data = item(b"") + item(even(spoil(encode(IMAGES[0])))) + END
    with pytest.raises(RefusedInputError, match=f"^pixels: .*({words})"):
        place(data, syntax)


def test_row_38_small_bytes_for_a_large_frame_are_a_bomb(place):
    """In the head of codestream and header alike: the size is the same lie."""
    data = encode_jpeg_2000(IMAGES[0])
    data = data[:8] + struct.pack(">2L", 65535, 65535) + data[16:]
    with pytest.raises(RefusedInputError, match=r"bytes would unfold to 8589672450, more than 1000 times as many"):
        codestream.read_codestream(data, JPEG + "90", 65535, 65535, 16)
    air = np.zeros((512, 512), np.uint16)
    (pixels,) = place(encapsulate([encode_jpeg_2000(air)]) + END, rows=512, columns=512)
    assert not pixels.any()


@pytest.mark.parametrize("name", ["JPEG-LS", "JPEG 2000", "JPEG lossless 1", "RLE", "HTJ2K"])
def test_row_40_random_damage_is_refused_or_decodes_to_the_declared_size(base, tmp_path, name):
    random = np.random.default_rng(11)
    syntax, encode = ENCODERS[name]
    good = even(encode(IMAGES[0]))
    frames = []
    for _ in range(20):
        bad = bytearray(good)
        for where in random.integers(0, len(bad), 8):
            bad[where] = random.integers(256)
        frames.append(bytes(bad))
    path = tmp_path / "pixels"
    path.write_bytes(item(b"") + b"".join(map(item, [good, *frames])) + END)
    headers = make_headers(base, path, syntax, 21)
    refused = 0
    with StoredPixels(headers) as source:
        for header in headers[1:]:
            try:
                pixels = source.load(header, np.zeros((ROWS, COLUMNS), np.int16))
            except RefusedInputError:
                refused += 1
            else:
                assert pixels.shape == (ROWS, COLUMNS) and pixels.dtype == np.uint16
        assert np.array_equal(source.load(headers[0], np.zeros((ROWS, COLUMNS), np.int16)), IMAGES[0])
    assert refused > 0


def test_row_40_the_file_that_does_not_decode_is_named(tmp_path):
    plan = Plan(shape=(3, ROWS, COLUMNS), signed=False)
    for k in range(3):
        ds = make_dataset(plan, k)
        ds.file_meta.TransferSyntaxUID = RLE
        frame = bytearray(encode_rle(plan.stored(k)))
        if k == 1:
            frame = frame[:-30]
        ds.PixelData = encapsulate([bytes(frame)])
        ds["PixelData"].VR = "OB"
        save_dataset(ds, tmp_path / f"{k}.dcm")
    with pytest.raises(
        RefusedInputError, match=rf"^1\.dcm: the compressed pixels \(transfer syntax {RLE}\) do not dec"
    ):
        read_volume(tmp_path)


@pytest.mark.parametrize(
    ("uid", "name"),
    [
        ("1.2.840.113619.5.2", "implicit VR big endian, private to GE"),
        ("1.2.840.10008.1.2.8.1", "Deflated Image Frame Compression"),
        (JPEG + "94", "JPIP Referenced"),
        (JPEG + "102", "MPEG-4 AVC/H.264 High Profile / Level 4.1"),
        (JPEG + "50", r"JPEG Baseline \(Process 1\)"),
        ("1.2.3.4.5", "private or unknown"),
    ],
)
def test_row_41_other_transfer_syntaxes_are_named(tmp_path, uid, name):
    plan = write_series(tmp_path, Plan(shape=(2, 5, 6)))
    for k in range(2):
        file = tmp_path / plan.name(k)
        data = file.read_bytes()
        old = b"1.2.840.10008.1.2.1\0"
        start = data.index(b"\x02\0\x10\0UI") + 6
        assert data[start + 2 : start + 22] == old
        new = even(uid.encode())
        file.write_bytes(data[:start] + struct.pack("<H", len(new)) + new + data[start + 22 :])
    with pytest.raises(RefusedInputError, match=rf"transfer syntax {uid} \({name}.*\) cannot be decoded: convert"):
        read_volume(tmp_path)


# --- files of others ---

COMPRESSED = (
    "693_J2KI.dcm J2K_pixelrep_mismatch.dcm JPEG2000.dcm JPEGLSNearLossless_08.dcm JPEGLSNearLossless_16.dcm "
    "MR_small_RLE.dcm MR_small_jp2klossless.dcm MR_small_jpeg_ls_lossless.dcm rtdose_rle.dcm rtdose_rle_1frame.dcm"
).split()
PLAIN = "CT_small.dcm MR_small_bigendian.dcm MR_small_implicit.dcm MR_small_padded.dcm image_dfl.dcm rtdose.dcm".split()


def load_file(base, path, ds):
    elements = read_elements(path, WANTED_TAGS)
    first = dataclasses.replace(
        base,
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


@pytest.mark.parametrize("name", [*COMPRESSED, *PLAIN])
def test_pydicoms_files_give_pydicoms_pixels(base, name):
    found = get_testdata_file(name, download=False)
    if found is None:
        pytest.skip(f"pydicom has no {name} here")
    path = Path(found)
    ds = pydicom.dcmread(path)
    pixels = load_file(base, path, ds)
    assert np.array_equal(drop_unused_bits(pixels, ds), ds.pixel_array)
    assert pixels.any()


@pytest.mark.parametrize("ending", ["90", "91", "80", "81", "57", "70", "5"])
def test_another_library_gives_the_same_pixels(base, real_data, ending):
    """SimpleITK (GDCM), which decodes with code of its own."""
    itk = pytest.importorskip("SimpleITK")
    (path,) = (real_data / "transfer_syntaxes").glob(f"CTImage*.{ending}.dcm")
    ds = pydicom.dcmread(path)
    other = itk.GetArrayFromImage(itk.ReadImage(str(path)))[0]
    pixels = load_file(base, path, ds)
    assert np.array_equal(pixels.astype(int) * int(ds.RescaleSlope) + int(ds.RescaleIntercept), other)


def test_row_42_big_endian(tmp_path):
    plan = Plan(shape=(2, 5, 6), syntax=ExplicitVRBigEndian)
    for k in range(2):
        ds = make_dataset(plan, k)
        ds.PixelData = plan.stored(k).byteswap().tobytes()
        save_dataset(ds, tmp_path / plan.name(k))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())
