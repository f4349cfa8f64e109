"""Typed and checked access to the raw values of one file.

pydicom converts "1,5", "nan" or a wrong count of numbers without an error.  Here a decimal string must be the requested
count of finite numbers with a decimal point; else a `ValueProblem` names the tag.
"""

from __future__ import annotations

import math
import re
import struct
from functools import lru_cache
from typing import Literal

from clrecon.dicom.parse.elements import DicomElements
from clrecon.errors import RefusedInputError
from clrecon.system.text import escape_text

_TAGS = {
    "SpecificCharacterSet": 0x00080005,
    "ImageType": 0x00080008,
    "SOPClassUID": 0x00080016,
    "AcquisitionDate": 0x00080022,
    "ContentDate": 0x00080023,
    "AcquisitionTime": 0x00080032,
    "ContentTime": 0x00080033,
    "Modality": 0x00080060,
    "SeriesDescription": 0x0008103E,
    "PatientID": 0x00100020,
    "AnatomicalOrientationType": 0x00102210,
    "SliceThickness": 0x00180050,
    "KVP": 0x00180060,
    "SpacingBetweenSlices": 0x00180088,
    "ConvolutionKernel": 0x00181210,
    "TriggerTime": 0x00181060,
    "PatientPosition": 0x00185100,
    "TemporalPositionIdentifier": 0x00200100,
    "AcquisitionNumber": 0x00200012,
    "StudyInstanceUID": 0x0020000D,
    "SeriesInstanceUID": 0x0020000E,
    "SeriesNumber": 0x00200011,
    "InstanceNumber": 0x00200013,
    "ImagePositionPatient": 0x00200032,
    "ImageOrientationPatient": 0x00200037,
    "FrameOfReferenceUID": 0x00200052,
    "ImagesInAcquisition": 0x00201002,
    "NumberOfSeriesRelatedInstances": 0x00201209,
    "SamplesPerPixel": 0x00280002,
    "PhotometricInterpretation": 0x00280004,
    "NumberOfFrames": 0x00280008,
    "FrameIncrementPointer": 0x00280009,
    "Rows": 0x00280010,
    "Columns": 0x00280011,
    "PixelSpacing": 0x00280030,
    "BitsAllocated": 0x00280100,
    "BitsStored": 0x00280101,
    "HighBit": 0x00280102,
    "PixelRepresentation": 0x00280103,
    "PixelPaddingValue": 0x00280120,
    "PixelPaddingRangeLimit": 0x00280121,
    "FloatPixelPaddingValue": 0x00280122,
    "DoubleFloatPixelPaddingValue": 0x00280123,
    "FloatPixelPaddingRangeLimit": 0x00280124,
    "DoubleFloatPixelPaddingRangeLimit": 0x00280125,
    "RescaleIntercept": 0x00281052,
    "RescaleSlope": 0x00281053,
    "RescaleType": 0x00281054,
    "LossyImageCompression": 0x00282110,
    "ModalityLUTSequence": 0x00283000,
    "GridFrameOffsetVector": 0x3004000C,
}
WANTED_TAGS = tuple(_TAGS.values())
_DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


_TEXT_VRS = frozenset("AE AS CS DA DS DT IS LO LT PN SH ST TM UC UI UR UT".split())

# The slices of a series repeat most values byte for byte: results are cached, so they are neither checked nor stored
# again.
_KNOWN_VALUES = 2048
_KNOWN_BYTES = 128  # longer values are decoded each time, to keep the cache small


def decode_text(raw: bytes) -> str:
    """Decode text without padding: spaces, and NUL at the end.  Inside the text NUL stands for a lost character."""
    return raw.decode("latin-1").rstrip(" \0").lstrip(" ")


def _decode_decimals(raw: bytes) -> tuple[float, ...]:
    """Decode finite numbers with a decimal point, separated by backslashes; empty if one of them is malformed.

    NUL is accepted as padding after the last number only: in the place of a minus sign it would change the sign.
    """
    parts = [part.strip(" ") for part in raw.rstrip(b"\0").decode("latin-1").split("\\")]
    if not all(map(_DECIMAL.fullmatch, parts)):
        return ()
    numbers = tuple(map(float, parts))
    return numbers if all(map(math.isfinite, numbers)) else ()


_known_text = lru_cache(_KNOWN_VALUES)(decode_text)
_known_decimals = lru_cache(_KNOWN_VALUES)(_decode_decimals)


@lru_cache(_KNOWN_VALUES)
def _known_word(raw: bytes) -> str:
    return escape_text(decode_text(raw))


def _count_places(number: str) -> int:
    mantissa, _, exponent = number.strip().upper().partition("E")
    return len(mantissa.partition(".")[2]) - int(exponent or 0)


@lru_cache(_KNOWN_VALUES)
def _share_counts(*counts: int) -> tuple[int, ...]:
    return counts


@lru_cache(_KNOWN_VALUES)
def _share_pairs(*pairs: tuple[str, str]) -> tuple[tuple[str, str], ...]:
    return pairs


def _place(keyword: str) -> str:
    tag = _TAGS[keyword]
    return f"{keyword} ({tag >> 16:04X},{tag & 0xFFFF:04X})"


class ValueProblem(RefusedInputError):
    """One value of a header is missing or wrong."""


class Values:
    """Typed access to raw elements; every accessor checks what it returns.

    warnings: Doubtful points of the numbers that were asked for.
    """

    def __init__(self, elements: DicomElements):
        self.elements = elements
        self.warnings: list[str] = []
        self.byte_order: Literal["little", "big"] = "little" if elements.little_endian else "big"

    def __contains__(self, keyword: str) -> bool:
        return self.text(keyword) != ""

    def wrong(self, keyword: str, expected: str) -> ValueProblem:
        tag = _TAGS[keyword]
        place = _place(keyword)
        if keyword not in self and not self.elements.values.get(tag):
            return ValueProblem(f"{place} is missing or empty, expected {expected}")
        raw = self.elements.values[tag]
        vr = self.elements.vrs.get(tag)
        binary = vr in ("US", "SS", "UL") or (vr is None and keyword in _BINARY)
        number = int.from_bytes(raw, self.byte_order)
        shown = str(number) if binary else f"'{escape_text(decode_text(raw))}'"
        return ValueProblem(f"{place} is {shown}, expected {expected}")

    def text(self, keyword: str) -> str:
        raw = self.elements.values.get(_TAGS[keyword])
        if raw is None:
            return ""
        return _known_text(raw) if len(raw) <= _KNOWN_BYTES else decode_text(raw)

    def word(self, keyword: str) -> str:
        """Return the text as one safe line."""
        raw = self.elements.values.get(_TAGS[keyword])
        if raw is None:
            return ""
        return _known_word(raw) if len(raw) <= _KNOWN_BYTES else escape_text(decode_text(raw))

    def pairs(self, keywords: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
        """Return keyword and value, as `word` returns it, of the elements that exist."""
        return _share_pairs(*((keyword, word) for keyword in keywords if (word := self.word(keyword))))

    def decimals(self, keyword: str, count: int) -> tuple[float, ...]:
        raw = self.elements.values.get(_TAGS[keyword], b"")
        numbers = _known_decimals(raw) if len(raw) <= _KNOWN_BYTES else _decode_decimals(raw)
        if len(numbers) != count:
            raise self.wrong(keyword, "a finite number" if count == 1 else f"{count} finite numbers")
        if raw[-1:] == b"\0":
            self.warnings.append(f"{_place(keyword)} ends with NUL, taken as padding: its last digit may be lost")
        return numbers

    def decimal_places(self, keyword: str) -> tuple[int, ...]:
        """Return how many digits each number of a text element has after its decimal point; below 0 for whole tens."""
        return _share_counts(*map(_count_places, self.text(keyword).split("\\")))

    def whole_or_none(self, keyword: str) -> int | None:
        text = self.text(keyword)
        return int(text) if re.fullmatch(r"[+-]?\d{1,12}", text) else None

    def unsigned(self, keyword: str, default: int | None = None) -> int:
        raw = self.elements.values.get(_TAGS[keyword], b"")
        if not raw and default is not None:
            return default
        if len(raw) != (4 if self.elements.vrs.get(_TAGS[keyword]) == "UL" else 2):
            raise self.wrong(keyword, "one unsigned number")
        return int.from_bytes(raw, self.byte_order)

    def padding(self, bits_allocated: int, bits_stored: int, signed: bool) -> tuple[int, int] | None:
        """Return the range of stored padding values.

        Some writers give these values with the VR of the other signedness, so the bits are read again in the pixel
        representation: US 63536 in signed 16-bit pixels is -2000, and US 2096 in pixels of 12 stored bits is -2000 too.
        """
        bounds = []
        for keyword in ("PixelPaddingValue", "PixelPaddingRangeLimit"):
            raw = self.elements.values.get(_TAGS[keyword], b"")
            if not raw:
                break
            vr = self.elements.vrs.get(_TAGS[keyword])
            if vr in _TEXT_VRS or len(raw) != 2 and (len(raw) != 4 or vr in ("US", "SS")):
                raise self.wrong(keyword, "one binary number")
            bound = int.from_bytes(raw, self.byte_order, signed=signed)
            if bits_allocated == 8 and not signed:
                bound &= 0xFF
            if signed:
                for bits in (bits_stored, bits_allocated):
                    if 1 << (bits - 1) <= bound < 1 << bits:
                        bound -= 1 << bits
                        break
            bounds.append(bound)
        return (min(bounds), max(bounds)) if bounds else None

    def float_padding(self, bits: int) -> tuple[float, float] | None:
        """Return the range of padding values of float pixels, NaN where that is the padding (PS3.3 C.7.6.24.1)."""
        prefix, form = ("Double", "d") if bits == 64 else ("", "f")
        bounds = []
        for keyword in (f"{prefix}FloatPixelPaddingValue", f"{prefix}FloatPixelPaddingRangeLimit"):
            raw = self.elements.values.get(_TAGS[keyword], b"")
            if not raw:
                break
            if len(raw) != bits // 8:
                raise self.wrong(keyword, "one floating point number")
            bounds.append(struct.unpack(("<" if self.byte_order == "little" else ">") + form, raw)[0])
        return (min(bounds), max(bounds)) if bounds else None

    def description(self) -> str:
        """Return SeriesDescription, decoded by its character set, as one safe line."""
        raw = self.elements.values.get(_TAGS["SeriesDescription"], b"").strip(b" \0")
        charset = self.text("SpecificCharacterSet")
        if raw.isascii() and b"\x1b" not in raw or not charset:
            return self.word("SeriesDescription")
        from pydicom.charset import convert_encodings, decode_bytes

        try:
            decoded = decode_bytes(raw, convert_encodings(charset.split("\\")), set())
        except (LookupError, ValueError, TypeError, AttributeError):
            decoded = raw.decode("latin-1")  # a wrong character set spoils the text, not the image
        return escape_text(decoded)


_BINARY = (
    "SamplesPerPixel Rows Columns BitsAllocated BitsStored HighBit PixelRepresentation "
    "PixelPaddingValue PixelPaddingRangeLimit"
).split()
