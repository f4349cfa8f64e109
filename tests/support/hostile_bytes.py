"""Hostile DICOM files: a corpus, the places of the elements in its bytes, and changes that know what they hit."""

from __future__ import annotations

import contextlib
import functools
import io
import os
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dicom_series import Plan, make_dataset
from enhanced_image import make_enhanced
from pydicom.dataset import Dataset
from pydicom.filereader import data_element_generator
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGLSLossless,
    RLELossless,
)

META_START = 132
SLICES = 3
PLAN: dict[str, Any] = {"shape": (SLICES, 3, 4)}


@dataclass(frozen=True)
class Element:
    """Bytes ``start`` to ``value`` are the head (tag, VR, length), ``value`` to ``end`` the value."""

    start: int
    value: int
    end: int
    vr: str | None


@dataclass(frozen=True)
class Seed:
    """One file of the corpus, and the files of the series that it belongs to."""

    name: str
    data: bytes
    series: tuple[bytes, ...]

    @functools.cached_property
    def plain(self) -> bytes:
        """The file, a deflated data set inflated behind its meta header."""
        return self.data if self.deflated_from < 0 else self._inflate()

    @functools.cached_property
    def deflated_from(self) -> int:
        return _meta_end(self.data) if DeflatedExplicitVRLittleEndian.encode() in self.data[:1000] else -1

    def _inflate(self) -> bytes:
        start = self.deflated_from
        return self.data[:start] + zlib.decompressobj(-zlib.MAX_WBITS).decompress(self.data[start:], 1 << 24)

    @functools.cached_property
    def elements(self) -> list[Element]:
        return find_elements(self.plain)

    def pack(self, plain: bytes) -> bytes:
        """The changed `plain` as a file again."""
        if self.deflated_from < 0:
            return plain
        packer = zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS)
        start = self.deflated_from
        return plain[:start] + packer.compress(plain[start:]) + packer.flush()


def _meta_end(data: bytes) -> int:
    length = struct.unpack_from("<L", data, META_START + 8)[0]
    return META_START + 12 + length


def find_elements(data: bytes) -> list[Element]:
    """Places of the elements of the meta header and of the first level of the data set; empty where it has none."""
    if data[128:META_START] != b"DICM":
        return []
    found: list[tuple[int, int, str | None]] = []
    file = io.BytesIO(data)
    file.seek(META_START)
    with warnings.catch_warnings(), contextlib.suppress(Exception):  # of a broken file, what comes before the fault
        warnings.simplefilter("ignore")
        start = _walk(file, False, True, found, lambda tag, vr, length: tag >> 16 != 2)
        implicit = not data[start + 4 : start + 6].isalpha()
        little = data[start : start + 2] != b"\x00\x08"
        _walk(file, implicit, little, found, None)
    if not found:
        return []
    ends = [start for start, _, _ in found[1:]] + [len(data)]
    return [Element(start, value, end, vr) for (start, value, vr), end in zip(found, ends, strict=True) if value <= end]


def _walk(
    file: Any, implicit: bool, little: bool, found: list[tuple[int, int, str | None]], stop: Callable[..., bool] | None
) -> int:
    start = file.tell()
    for element in data_element_generator(file, implicit, little, stop_when=stop):
        value = int(getattr(element, "value_tell", 0) or getattr(element, "file_tell", 0))
        long = not implicit and element.VR in ("OB", "OW", "OF", "OD", "OL", "OV", "SQ", "UN", "UC", "UR", "UT")
        head = value - (12 if long else 8)
        found.append((head, value, element.VR))
        start = file.tell()
    return start


# --- the corpus ---
def _encode(ds: Dataset, syntax: str) -> Dataset:
    if syntax in (RLELossless, JPEG2000Lossless, JPEGLSLossless):
        ds["PixelData"].VR = "OW"
        ds.compress(syntax, generate_instance_uid=False)
    return ds


def save_bytes(ds: Dataset) -> bytes:
    """The bytes of the file of a data set."""
    file = io.BytesIO()
    ds.save_as(file, enforce_file_format=True)
    return file.getvalue()


NATIVE = {
    "explicit": ExplicitVRLittleEndian,
    "implicit": ImplicitVRLittleEndian,
    "big endian": ExplicitVRBigEndian,
    "deflated": DeflatedExplicitVRLittleEndian,
}
COMPRESSED = {"RLE": RLELossless, "JPEG 2000": JPEG2000Lossless, "JPEG-LS": JPEGLSLossless}


def make_series(syntax: str) -> tuple[bytes, ...]:
    """The files of a small series in one transfer syntax."""
    native = syntax in NATIVE.values()
    size = {"shape": (SLICES, 32, 32)} if syntax in COMPRESSED.values() else PLAN  # encoders refuse tiny images
    plan = Plan(syntax=syntax if native else ExplicitVRLittleEndian, **size)
    files = []
    for k in range(plan.shape[0]):
        ds = make_dataset(plan, k)
        ds.PixelPaddingValue, ds.SpecificCharacterSet = 7, "ISO_IR 100"
        if syntax == ExplicitVRBigEndian:
            ds.PixelData = plan.stored(k).astype(">i2").tobytes()
        files.append(save_bytes(_encode(ds, syntax)))
    return tuple(files)


def make_phases() -> tuple[bytes, ...]:
    """Two phases of a padded stack with uneven gaps, a copy of a slice, and a localizer."""
    files = []
    for phase in (1, 2):
        plan = Plan(slope=phase, offsets={2: 0.4}, **PLAN)
        for k in (0, 1, 2, 2):
            ds = make_dataset(plan, k)
            ds.AcquisitionNumber, ds.AcquisitionTime = phase, f"1200{phase}0"
            ds.PixelPaddingValue, ds.PixelPaddingRangeLimit = 905, 907
            files.append(save_bytes(ds))
    scout = make_dataset(Plan(angles=(0, 90, 90), **PLAN), 0)
    scout.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
    return (*files, save_bytes(scout))


@functools.cache
def phantom_seeds() -> dict[str, Seed]:
    """Files of small series in each transfer syntax, by name."""
    seeds = {}
    for name, syntax in (NATIVE | COMPRESSED).items():
        files = make_series(syntax)
        seeds[name] = Seed(name, files[1], files)
    for name, syntax in (("enhanced", ExplicitVRLittleEndian), ("enhanced, implicit", ImplicitVRLittleEndian)):
        data = save_bytes(make_enhanced(Plan(syntax=syntax, **PLAN), slopes=(1, 2, 3)))
        seeds[name] = Seed(name, data, (data,))
    return seeds


@functools.cache
def pydicom_seeds() -> dict[str, Seed]:
    """Every file that comes with pydicom itself; nothing is downloaded."""
    import pydicom.data

    folder = Path(pydicom.data.__file__).parent
    files = [file for part in ("test_files", "charset_files") for file in sorted((folder / part).rglob("*"))]
    seeds = {}
    for file in files:
        if file.is_file() and os.path.getsize(file) < 1 << 20:
            data = file.read_bytes()
            seeds[str(file.relative_to(folder))] = Seed(file.name, data, (data,))
    return seeds


# --- what is done to them ---
VRS = [
    b"SQ", b"UN", b"OB", b"OW", b"US", b"UL", b"DS", b"IS", b"UI", b"LO", b"FD", b"AT", b"PN", b"\0\0",
    b"zz", b"\xff\xff",
]  # fmt: skip
LENGTHS = [0, 1, 2, 3, 5, 7, 0x7FFF, 0xFFFE, 0xFFFF, 0x10000, 0x7FFFFFFF, 0xFFFFFFFE, 0xFFFFFFFF]
TEXTS = [
    b"", b" ", b"\0", b"0", b"-1", b"nan", b"inf", b"1e400", b"-1e-400", b"1,5", b"abc", b"1\\2", b"0\\0", b"\\" * 9,
    b"1\\0\\0\\0\\1\\0", b"0\\0\\0\\0\\0\\0", b"1e6\\1e6\\1e6", b"9" * 16, b"9" * 300, b"2147483647", b"99999999999999",
    b"MONOCHROME1", b"PALETTE COLOR", b"LOCALIZER", b"DERIVED\\SECONDARY\\MIP", b"CT", b"MR",
    b"ISO 2022 IR 87", b"GB18030",    b"\x1b[31m", b"../../x", b"\n\r\t", b"\xff\xfe\xfd", b"\x1b$B\x1b(J", b"CON",
]  # fmt: skip
UIDS = [uid.encode() for uid in (*NATIVE.values(), *COMPRESSED.values(), "1.2.840.10008.1.2.4.50", "1.2.3", "x" * 64)]
UIDS += [b"1.2.840.10008.5.1.4.1.1.2.1", b"1.2.840.10008.5.1.4.1.1.2.2", b"1.2.840.10008.1.3.10"]
NUMBERS = [struct.pack(f"<{code}", value) for code, value in (
    ("H", 0), ("H", 1), ("H", 7), ("H", 8), ("H", 12), ("H", 0x7FFF), ("H", 0x8000), ("H", 0xFFFF),
    ("L", 0), ("L", 0x7FFFFFFF), ("L", 0xFFFFFFFF), ("d", float("nan")), ("d", 1e308),
)]  # fmt: skip
TAGS = [struct.pack("<HH", tag >> 16, tag & 0xFFFF) for tag in (
    0x00020010, 0x00080060, 0x00280008, 0x00280010, 0x00280030, 0x00200032, 0x00200037, 0x52009230, 0x52009229,
    0x00280100, 0x00280103, 0x7FE00010, 0x7FE00008, 0x7FE00001, 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD, 0, 0xFFFFFFFF,
)]  # fmt: skip
ITEM, ITEM_END, SEQUENCE_END = (struct.pack("<HHL", 0xFFFE, code, 0) for code in (0xE000, 0xE00D, 0xE0DD))
OPEN_ITEM = struct.pack("<HHL", 0xFFFE, 0xE000, 0xFFFFFFFF)
OPEN_SEQUENCE = struct.pack("<HH2sHL", 0x0008, 0x1140, b"SQ", 0, 0xFFFFFFFF)
BLOBS = [
    ITEM, ITEM_END, SEQUENCE_END, OPEN_ITEM, OPEN_SEQUENCE,
    OPEN_SEQUENCE + SEQUENCE_END,
    (OPEN_SEQUENCE + OPEN_ITEM) * 30 + (ITEM_END + SEQUENCE_END) * 30,
    (OPEN_SEQUENCE + OPEN_ITEM) * 400,
    struct.pack("<HH2sHL", 0x0009, 0x1001, b"UN", 0, 0xFFFFFFFF) + OPEN_ITEM + ITEM_END + SEQUENCE_END,
    struct.pack("<HH2sHL", 0x0009, 0x1001, b"OB", 0, 0x7FFFFFFE),
    struct.pack("<HH2sH", 0x0009, 0x0010, b"LO", 3) + b"odd",
    b"\0" * 64, b"\xff" * 64,
]  # fmt: skip


def apply_changes(seed: Seed, data: bytes, changes: Sequence[tuple[str, int, Any]]) -> bytes:
    """Apply changes to one file of the seed's series; the element at an index is found anew for each."""
    kin = Seed(seed.name, data, seed.series)
    plain = kin.plain
    for change in changes:
        plain = apply_change(plain, find_elements(plain), *change)
    return kin.pack(plain)


def apply_change(data: bytes, elements: list[Element], kind: str, index: int, what: Any) -> bytes:
    if kind == "cut":
        return data[: index * len(data) // 10_001]
    if kind == "bytes" or not elements:
        place = index * len(data) // 10_001
        extra = what if isinstance(what, bytes) else bytes([index % 256])
        return data[:place] + extra + data[place + len(extra) :]
    element = elements[index % len(elements)]
    before, head = data[: element.start], data[element.start : element.value]
    value, after = data[element.value : element.end], data[element.end :]
    if kind == "value":
        return before + _set_length(head, len(what) + len(what) % 2) + what + b" " * (len(what) % 2) + after
    if kind == "raw value":
        return before + head + what[: len(value)] + value[len(what) :] + after
    if kind == "length":
        length = max(len(value) + what[1], 0) if isinstance(what, tuple) else what
        return before + _set_length(head, length) + value + after
    if kind == "vr":
        return before + head[:4] + what + head[6:] + value + after
    if kind == "tag" and head[:4] not in (b"\x10\0\x10\0", b"\x10\0\x20\0"):  # a name stays a name
        return before + what + head[4:] + value + after
    if kind == "insert":
        return before + what + head + value + after
    if kind == "delete":
        return before + after
    if kind == "copy":
        other = elements[what % len(elements)]
        return data[: other.start] + head + value + data[other.start :]
    if kind == "to end":
        return before + after + head + value
    return data


def _set_length(head: bytes, length: int) -> bytes:
    if len(head) == 12:
        return head[:8] + struct.pack("<L", min(length, 0xFFFFFFFF))
    if head[4:6].isalpha():
        return head[:6] + struct.pack("<H", min(length, 0xFFFF))
    return head[:4] + struct.pack("<L", min(length, 0xFFFFFFFF))


def _count_bytes_read() -> int:
    """Bytes that this process has read so far; 0 on a system that does not say."""
    try:
        counters = Path("/proc/self/io").read_text(encoding="ascii")
    except OSError:
        return 0
    return int(counters.partition("rchar: ")[2].split()[0])


@contextlib.contextmanager
def reads_less_than(most: int) -> Iterator[None]:
    """Assert that fewer bytes are read in this process."""
    before = _count_bytes_read()
    yield
    assert _count_bytes_read() - before < most
