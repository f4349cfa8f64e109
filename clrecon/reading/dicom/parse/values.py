"""Typed and checked access to the raw values of one file, and of the items of its nested sequences.

pydicom converts "1,5", "nan" or a wrong count of numbers without an error.  Here a decimal string must be the requested
count of finite numbers with a decimal point; else a `ValueProblem` names the tag.

Of sequences only the tags that a schema names are read; all others are skipped by their length, with limits of depth
and of items.  pydicom reads them by recursion and makes a data set of every item: slow for thousands of frames, and a
nest of some hundred levels ends in a RecursionError.

Source: DICOM PS3.5 7.5 (nesting of data sets), 6.2.2 (UN holds implicit VR little endian).
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal

from clrecon.errors import RefusedInputError
from clrecon.reading.dicom.parse.plain import DicomElements
from clrecon.system.text import escape_text

RESCALE_TYPES = frozenset("HU HU_MOD OD US MGML Z_EFF ED EDW PCT".split())
"""Defined terms of RescaleType (PS3.3 C.11.1.1.2)."""

MODALITIES = frozenset(
    """
    ANN AR AS ASMT AU BDUS BI BMD CD CF CFM CP CR CS CT CTPROTOCOL DD DF DG DM DMS DOC DS DX EC ECG EEG EMG EOG EPS ES
    FA FID FS GM HC HD IO IOL IVOCT IVUS KER KO LEN LP LS M3D MA MG MR MS NM OAM OCT OP OPM OPR OPT OPTBSV OPTENF OPV
    OSS OT PA PLAN POS PR PT PX REG RESP RF RG RTDOSE RTIMAGE RTINTENT RTPLAN RTRAD RTRECORD RTSEGANN RTSTRUCT RWV SEG
    SM SMR SR SRF ST STAIN TEXTUREMAP TG TH US VA VF VM XA XAPROTOCOL XC
    """.split()
)
"""Defined terms of Modality, with retired ones (PS3.3 C.7.3.1.1.1)."""

OTHER_TERM = "other"


def name_term(term: str, defined: frozenset[str]) -> str:
    """Return the term itself if it is defined or empty, else `OTHER_TERM`: free text could be a person's name."""
    return term if term in defined or not term else OTHER_TERM


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
    "ReconstructionDiameter": 0x00181100,
    "ConvolutionKernel": 0x00181210,
    "TriggerTime": 0x00181060,
    "PatientPosition": 0x00185100,
    "TemporalPositionIdentifier": 0x00200100,
    "AcquisitionNumber": 0x00200012,
    "StudyInstanceUID": 0x0020000D,
    "SeriesInstanceUID": 0x0020000E,
    "SeriesNumber": 0x00200011,
    "InstanceNumber": 0x00200013,
    "PatientOrientation": 0x00200020,
    "ImagePositionPatient": 0x00200032,
    "ImageOrientationPatient": 0x00200037,
    "FrameOfReferenceUID": 0x00200052,
    "ImagesInAcquisition": 0x00201002,
    "SliceLocation": 0x00201041,
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


def _name_field(keyword: str) -> str:
    tag = _TAGS[keyword]
    return f"{keyword} ({tag >> 16:04X},{tag & 0xFFFF:04X})"


class ValueProblem(RefusedInputError):
    """One value of a header is missing or wrong."""


class Values:
    """Typed access to raw elements; every accessor checks what it returns, and adds doubts about it to `warnings`."""

    def __init__(self, elements: DicomElements):
        self.elements = elements
        self.warnings: list[str] = []
        self.byte_order: Literal["little", "big"] = "little" if elements.little_endian else "big"

    def __contains__(self, keyword: str) -> bool:
        return self.text(keyword) != ""

    def wrong(self, keyword: str, expected: str) -> ValueProblem:
        tag = _TAGS[keyword]
        field_name = _name_field(keyword)
        if keyword not in self and not self.elements.values.get(tag):
            return ValueProblem(f"{field_name} is missing or empty, expected {expected}")
        raw = self.elements.values[tag]
        vr = self.elements.vrs.get(tag)
        binary = vr in ("US", "SS", "UL") or (vr is None and keyword in _BINARY)
        number = int.from_bytes(raw, self.byte_order)
        shown = str(number) if binary else f"'{escape_text(decode_text(raw))}'"
        return ValueProblem(f"{field_name} is {shown}, expected {expected}")

    def text(self, keyword: str) -> str:
        raw = self.elements.values.get(_TAGS[keyword], b"")
        return _known_text(raw) if len(raw) <= _KNOWN_BYTES else decode_text(raw)

    def word(self, keyword: str) -> str:
        """Return the text as one safe line."""
        raw = self.elements.values.get(_TAGS[keyword], b"")
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
            self.warnings.append(f"{_name_field(keyword)} ends with NUL, taken as padding: its last digit may be lost")
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


Schema = Mapping[int, Any]
"""Maps a wanted tag to None for a value, or to the schema of its items for a sequence."""

_DEPTH_LIMIT = 64
PIXEL_GROUP = 0x7FE00000
UNDEFINED_LENGTH = 0xFFFFFFFF
ITEM, ITEM_END, SEQUENCE_END = 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD
LONG_VRS = frozenset((b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"))
_VR_NAMES = {name.encode(): name for name in "AE AS AT CS DA DS DT FD FL IS LO SH SL SS TM UI UL US".split()}


@dataclass(slots=True)
class Item:
    """The wanted elements, by tag, of one item (or of the whole data set) that are not empty.

    vrs: Value representations of these elements; None in implicit VR.
    repeated: For the whole data set only: wanted tags that occur twice in one of its items, with the same value.
    """

    values: dict[int, bytes] = field(default_factory=dict)
    vrs: dict[int, str | None] = field(default_factory=dict)
    sequences: dict[int, list[Item]] = field(default_factory=dict)
    repeated: set[int] = field(default_factory=set, compare=False)


@dataclass(frozen=True)
class _Encoding:
    implicit: bool
    little: bool
    implicit_head: struct.Struct
    explicit_head: struct.Struct
    length: struct.Struct


def _make_encoding(implicit: bool, little: bool) -> _Encoding:
    order = "<" if little else ">"
    return _Encoding(
        implicit, little, struct.Struct(order + "HHL"), struct.Struct(order + "HH2sH"), struct.Struct(order + "L")
    )


_UNKNOWN = _make_encoding(implicit=True, little=True)


def read_sequences(
    data: bytes, start: int, schema: Schema, *, implicit: bool, little_endian: bool, items_limit: int
) -> Item:
    """Read wanted values and sequences, `items_limit` items together, from `start` to the pixel data."""
    walk = _Walk(data, items_limit)
    top, _ = walk.read_data_set(start, len(data), schema, _make_encoding(implicit, little_endian), "", top=True)
    top.repeated = walk.repeated
    return top


def skip_sequence(data: bytes, *, implicit: bool, little_endian: bool) -> int:
    """Return the bytes of a sequence of undefined length, from its first item to the end of its delimiter."""
    return _Walk(data, 0).skip(0, len(data), _make_encoding(implicit, little_endian))


class _Walk:
    def __init__(self, data: bytes, items_limit: int):
        self.data = data
        self.items_left = items_limit
        self.items_limit = items_limit
        self.repeated: set[int] = set()

    def read_head(self, position: int, end: int, encoding: _Encoding) -> tuple[int, bytes, int, int]:
        """Return tag, VR (empty in implicit VR), length, and the offset of the value."""
        if position + 8 > end:
            raise ValueProblem("a sequence ends within the head of an element")
        if encoding.implicit:
            group, element, length = encoding.implicit_head.unpack_from(self.data, position)
            return group << 16 | element, b"", length, position + 8
        group, element, vr, length = encoding.explicit_head.unpack_from(self.data, position)
        tag = group << 16 | element
        if group == 0xFFFE:
            return tag, b"", encoding.length.unpack_from(self.data, position + 4)[0], position + 8
        if vr in LONG_VRS:
            if position + 12 > end:
                raise ValueProblem("a sequence ends within the head of an element")
            return tag, vr, encoding.length.unpack_from(self.data, position + 8)[0], position + 12
        if not (0x41 <= vr[0] <= 0x5A and 0x41 <= vr[1] <= 0x5A):
            raise ValueProblem(f"the element ({group:04X},{element:04X}) has no VR within explicit VR")
        return tag, vr, length, position + 8

    def read_data_set(
        self, position: int, end: int, schema: Schema, encoding: _Encoding, context: str, *, top: bool = False
    ) -> tuple[Item, int]:
        """Read the elements up to `end`, or to the delimiter of an item; also return the offset after them."""
        item = Item()
        seen: dict[int, bytes] = {}
        while position < end:
            if top and end - position < 8:
                break
            tag, vr, length, position = self.read_head(position, end, encoding)
            if tag == ITEM_END or top and tag >= PIXEL_GROUP:
                break
            inner = schema.get(tag)
            if tag in item.sequences:
                raise ValueProblem(f"{name_tag(tag)} is there twice" + (f" in an item of {context}" if context else ""))
            if inner is not None and (length == UNDEFINED_LENGTH or vr in (b"SQ", b"UN", b"")):
                inside = _UNKNOWN if vr == b"UN" else encoding
                item.sequences[tag], position = self.read_items(position, end, length, inner, inside, _name_number(tag))
            elif length == UNDEFINED_LENGTH:
                position = self.skip(position, end, _UNKNOWN if vr == b"UN" else encoding)
            else:
                stop = position + length
                if stop > end:
                    raise ValueProblem(
                        f"the element {_name_number(tag)} needs {length} bytes, {end - position} are left"
                        + (f" in {context}" if context else "")
                    )
                if inner is None and tag in schema:
                    value = self.data[position:stop]
                    self.compare(seen, tag, value, context)
                    if value:
                        item.values[tag], item.vrs[tag] = value, _VR_NAMES.get(vr)
                position = stop
        return item, position

    def compare(self, seen: dict[int, bytes], tag: int, value: bytes, context: str) -> None:
        """Refuse a second, different value of a tag in one item: nobody can tell which was meant."""
        if tag not in seen:
            seen[tag] = value
        elif seen[tag] == value:
            self.repeated.add(tag)
        else:
            inside = f" in an item of {context}" if context else ""
            raise ValueProblem(f"{name_tag(tag)} is there twice{inside}, with two values")

    def read_items(
        self, position: int, end: int, length: int, schema: Schema, encoding: _Encoding, context: str
    ) -> tuple[list[Item], int]:
        """Read the items of a sequence; also return the offset after it."""
        delimited = length == UNDEFINED_LENGTH
        stop = end if delimited else position + length
        if stop > end:
            raise ValueProblem(f"the sequence {context} needs {length} bytes, {end - position} are left")
        items: list[Item] = []
        while position < stop:
            tag, _, item_length, position = self.read_item_head(position, stop, encoding, context)
            if tag == SEQUENCE_END and delimited:
                return items, position
            if tag != ITEM:
                raise ValueProblem(f"the sequence {context} holds {_name_number(tag)} in place of an item")
            if self.items_left == 0:
                raise ValueProblem(f"the sequences hold more than {self.items_limit} items")
            self.items_left -= 1
            item_stop = stop if item_length == UNDEFINED_LENGTH else position + item_length
            if item_stop > stop:
                raise ValueProblem(
                    f"item {len(items) + 1} of {context} needs {item_length} bytes, {stop - position} are left"
                )
            item, position = self.read_data_set(position, item_stop, schema, encoding, context)
            items.append(item)
            if item_length != UNDEFINED_LENGTH:
                position = item_stop
        if delimited:
            raise ValueProblem(f"the sequence {context} has no end")
        return items, position

    def read_item_head(self, position: int, end: int, encoding: _Encoding, context: str) -> tuple[int, bytes, int, int]:
        if position + 8 > end:
            raise ValueProblem(f"the sequence {context} ends within an item")
        group, element, length = encoding.implicit_head.unpack_from(self.data, position)
        return group << 16 | element, b"", length, position + 8

    def skip(self, position: int, end: int, encoding: _Encoding) -> int:
        """Skip a sequence of undefined length; return the offset after it."""
        open_parts: list[tuple[bool, _Encoding]] = [(True, encoding)]  # is it a sequence (or an item of one), encoding
        while open_parts:
            in_sequence, inside = open_parts[-1]
            if in_sequence:
                tag, vr, length, position = self.read_item_head(position, end, inside, "of undefined length")
                if tag == SEQUENCE_END:
                    open_parts.pop()
                    continue
                if tag != ITEM:
                    raise ValueProblem(f"a sequence of undefined length holds {_name_number(tag)} in place of an item")
            else:
                tag, vr, length, position = self.read_head(position, end, inside)
                if tag == ITEM_END:
                    open_parts.pop()
                    continue
            if length != UNDEFINED_LENGTH:
                position += length
            else:
                open_parts.append((not in_sequence, _UNKNOWN if vr == b"UN" else inside))
                if len(open_parts) > 2 * _DEPTH_LIMIT:
                    raise ValueProblem(f"sequences are nested too deep (more than {_DEPTH_LIMIT} levels)")
        return position


def decode_number(raw: bytes, form: str, little_endian: bool) -> float | int | None:
    """Decode one binary number in a format of `struct`; None if the number of bytes does not fit."""
    layout = ("<" if little_endian else ">") + form
    return struct.unpack(layout, raw)[0] if len(raw) == struct.calcsize(layout) else None


def name_tag(tag: int) -> str:
    from pydicom.datadict import keyword_for_tag

    return f"{keyword_for_tag(tag)} {_name_number(tag)}".lstrip()


def name_element(tag: int) -> str:
    """Keyword for a message; the tag of a private or unknown element."""
    return name_tag(tag).partition(" ")[0]


def _name_number(tag: int) -> str:
    return f"({tag >> 16:04X},{tag & 0xFFFF:04X})"
