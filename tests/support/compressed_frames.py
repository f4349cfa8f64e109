"""Compressed frames of known pixels, and files that hold nothing but such frames."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dicom_series import Plan, write_series

from clrecon.reading.dicom.headers.header import SliceHeader, read_headers
from clrecon.reading.dicom.pixels.stored import StoredPixels

imagecodecs = pytest.importorskip("imagecodecs")
rle = pytest.importorskip("rle.rle")

ROWS, COLUMNS = 31, 45
JPEG = "1.2.840.10008.1.2.4."
RLE = "1.2.840.10008.1.2.5"
IMAGES = np.random.default_rng(3).integers(0, 4096, (4, ROWS, COLUMNS)).astype(np.uint16)


def encode_rle(image: np.ndarray) -> bytes:
    rows, columns = image.shape
    return bytes(rle.encode_frame(image.tobytes(), rows, columns, 1, 8 * image.itemsize, "<"))


def encode_jpeg_2000(image: np.ndarray, **options: Any) -> bytes:
    return bytes(imagecodecs.jpeg2k_encode(image, level=0, reversible=True, codecformat="j2k", **options))


def lossless_encoder(predictor: int) -> Callable[[np.ndarray], bytes]:
    return lambda image: encode_lossless(image, predictor)


ENCODERS: dict[str, tuple[str, Callable[[np.ndarray], bytes]]] = {
    **{f"JPEG lossless {n}": (JPEG + "57", lossless_encoder(n)) for n in range(1, 8)},
    "JPEG lossless first order": (JPEG + "70", lambda image: encode_lossless(image, 1)),
    "JPEG-LS": (JPEG + "80", lambda image: bytes(imagecodecs.jpegls_encode(image))),
    "JPEG 2000": (JPEG + "90", encode_jpeg_2000),
    "HTJ2K": (JPEG + "201", lambda image: bytes(imagecodecs.htj2k_encode(image))),
    "HTJ2K RPCL": (JPEG + "202", lambda image: bytes(imagecodecs.htj2k_encode(image))),
    "RLE": (RLE, encode_rle),
}


def encode_lossless(image: np.ndarray, predictor: int, *, bits: int = 16) -> bytes:
    return bytes(imagecodecs.jpeg8_encode(image, lossless=True, predictor=predictor, bitspersample=bits))


def make_header(folder: Path) -> SliceHeader:
    """A valid header to start from."""
    write_series(folder / "base", Plan(shape=(1, ROWS, COLUMNS)))
    headers = read_headers(folder / "base" / "slice000.dcm")
    assert isinstance(headers, list) and len(headers) == 1
    return headers[0]


def place(folder: Path, data: bytes, syntax: str = JPEG + "90", *, frames: int = 1, **changes: Any) -> list[np.ndarray]:
    """Write bytes as a file of encapsulated pixel data and load its frames."""
    path = folder / "pixels"
    path.write_bytes(data)
    return load(make_headers(path, syntax, frames=frames, **changes))


def make_headers(path: Path, syntax: str, *, frames: int = 1, **changes: Any) -> list[SliceHeader]:
    """Headers of the frames of a file that holds nothing but encapsulated pixel data."""
    changes = {"rows": ROWS, "columns": COLUMNS, "signed": False, **changes}
    header = dataclasses.replace(
        make_header(path.parent),
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


def load(headers: list[SliceHeader]) -> list[np.ndarray]:
    """The pixels of each header, decoded."""
    with StoredPixels(headers) as source:
        return [source.load(header, np.zeros((header.rows, header.columns), np.int16)) for header in headers]


def item(data: bytes) -> bytes:
    """An item of encapsulated pixel data."""
    return struct.pack("<HHL", 0xFFFE, 0xE000, len(data)) + data


END = struct.pack("<HHL", 0xFFFE, 0xE0DD, 0)


def even(data: bytes) -> bytes:
    """The bytes, and one more where their number is odd."""
    return data + b"\0" * (len(data) % 2)
