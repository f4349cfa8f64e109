"""Compressed frames that lie, are cut or are garbage: rows 38, 40 and 41 of the fault list."""

from __future__ import annotations

import struct

import numpy as np
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
    encode_rle,
    even,
    item,
    make_headers,
)
from compressed_frames import place as write_and_load
from dicom_series import Plan, make_dataset, save_dataset, write_series
from pydicom.encaps import encapsulate
from refusals import refused
from variants import daily

from clrecon.errors import RefusedInputError
from clrecon.reading import read_volume
from clrecon.reading.dicom.pixels import stored
from clrecon.reading.dicom.pixels.stored import StoredPixels


def cut_end(data):
    return data[:-2] + b"\0\0"


# In the head of a JPEG 2000 codestream: columns and rows at byte 8, components at 40, bits at 42, sampling at 43.
# In that of an RLE frame: the number of segments, and then the start of each.
@pytest.mark.fault_row(38, 40)
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
        (
            "RLE",
            lambda d: d[: struct.unpack("<L", d[8:12])[0] + 10],
            f"an RLE segment of 10 bytes for {ROWS * COLUMNS}",
        ),
        ("RLE", lambda d: d[:-200], "do not decode"),
    ],
)
def test_codestream_that_contradicts_its_header_or_is_cut_is_refused(tmp_path, name, spoil, words):
    syntax, encode = ENCODERS[name]
    data = item(b"") + item(even(spoil(encode(IMAGES[0])))) + END
    with pytest.raises(RefusedInputError, match=f"^pixels: .*({words})"):
        write_and_load(tmp_path, data, syntax)


@pytest.mark.fault_row(38)
def test_codestream_far_too_small_for_its_size_is_refused(tmp_path):
    """Head of codestream and header have the same lie."""
    data = encode_jpeg_2000(IMAGES[0])
    data = data[:8] + struct.pack(">2L", 65535, 65535) + data[16:]
    frame_bytes, most_times = 65535 * 65535 * 2, 1000
    with refused(RefusedInputError, frame_bytes, most_times):
        stored.read_codestream(data, JPEG + "90", rows=65535, columns=65535, bits_allocated=16)


def test_codestream_of_air_alone_is_decoded_though_it_is_small(tmp_path):
    air = np.zeros((512, 512), np.uint16)
    (pixels,) = write_and_load(tmp_path, encapsulate([encode_jpeg_2000(air)]) + END, rows=512, columns=512)
    assert not pixels.any()


@pytest.mark.fault_row(40)
@pytest.mark.parametrize("name", daily(3, ["JPEG-LS", "JPEG 2000", "JPEG lossless 1", "RLE", "HTJ2K"]))
def test_frame_with_random_damage_is_refused_or_decodes_to_its_size_and_harms_no_other(tmp_path, name):
    random = np.random.default_rng(11)
    syntax, encode = ENCODERS[name]
    good = even(encode(IMAGES[0]))
    damaged = []
    for _ in range(20):
        frame = bytearray(good)
        for position in random.integers(0, len(frame), size=8):
            frame[position] = random.integers(256)
        damaged.append(bytes(frame))
    path = tmp_path / "pixels"
    path.write_bytes(item(b"") + b"".join(map(item, [good, *damaged])) + END)
    headers = make_headers(path, syntax, frames=1 + len(damaged))

    refusals = 0
    with StoredPixels(headers) as source:
        for header in headers[1:]:
            try:
                pixels = source.load(header, np.zeros((ROWS, COLUMNS), np.int16))
            except RefusedInputError:
                refusals += 1
            else:
                assert pixels.shape == (ROWS, COLUMNS)
                assert pixels.dtype == np.uint16
        assert np.array_equal(source.load(headers[0], np.zeros((ROWS, COLUMNS), np.int16)), IMAGES[0])
    assert refusals > 0


@pytest.mark.fault_row(40)
def test_slice_that_does_not_decode_is_refused_by_its_name(tmp_path):
    plan = Plan(shape=(3, ROWS, COLUMNS), signed=False)
    for k in range(3):
        ds = make_dataset(plan, k)
        ds.file_meta.TransferSyntaxUID = RLE
        frame = encode_rle(plan.stored(k))
        ds.PixelData = encapsulate([frame[:-30] if k == 1 else frame])
        ds["PixelData"].VR = "OB"
        save_dataset(ds, tmp_path / f"{k}.dcm")
    with refused(RefusedInputError, "1.dcm", RLE):
        read_volume(tmp_path)


@pytest.mark.fault_row(41)
@pytest.mark.parametrize(
    ("uid", "name"),
    [
        ("1.2.840.113619.5.2", "GE"),
        ("1.2.840.10008.1.2.8.1", "Deflated"),
        (JPEG + "94", "JPIP"),
        (JPEG + "102", "MPEG-4"),
        (JPEG + "50", "Baseline"),
        ("1.2.3.4.5", "unknown"),
    ],
)
def test_transfer_syntax_that_is_not_read_is_refused_by_its_uid_and_name(tmp_path, uid, name):
    plan = write_series(tmp_path, Plan(shape=(2, 5, 6)))
    for k in range(2):
        file = tmp_path / plan.name(k)
        data = file.read_bytes()
        old = b"1.2.840.10008.1.2.1\0"
        start = data.index(b"\x02\0\x10\0UI") + 6
        assert data[start + 2 : start + 22] == old
        new = even(uid.encode())
        file.write_bytes(data[:start] + struct.pack("<H", len(new)) + new + data[start + 22 :])
    with refused(RefusedInputError, uid, name):
        read_volume(tmp_path)
