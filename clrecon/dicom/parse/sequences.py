"""Raw values of the items of nested sequences, only for the tags that a schema names.

pydicom reads sequences by recursion and makes a data set of every item: slow for thousands of frames, and a nest of
some hundred levels ends in a RecursionError.  This walk reads only wanted elements, skips all others by their length,
and is limited in depth and in number of items.

Source: DICOM PS3.5 7.5 (nesting of data sets), 6.2.2 (UN holds implicit VR little endian).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from clrecon.dicom.parse.values import ValueProblem

Schema = Mapping[int, Any]
"""Maps a wanted tag to None for a value, or to the schema of its items for a sequence."""

DEPTH_LIMIT = 64
PIXEL_GROUP = 0x7FE00000
UNDEFINED_LENGTH = 0xFFFFFFFF
ITEM, ITEM_END, SEQUENCE_END = 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD
LONG_VRS = frozenset((b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"))
VR_NAMES = {name.encode(): name for name in "AE AS AT CS DA DS DT FD FL IS LO SH SL SS TM UI UL US".split()}


@dataclass(slots=True)
class Item:
    """The wanted elements of one item (or of the whole data set).

    values: Tag to undecoded value, of those that are not empty.
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
    """Read the wanted values and sequences of one data set, up to its pixel data.

    data: Bytes that hold the data set from `start` on; may end within its pixel data.
    implicit, little_endian: Encoding of the data set.
    items_limit: Most items that all wanted sequences may hold together.
    """
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

    def read_head(self, place: int, end: int, encoding: _Encoding) -> tuple[int, bytes, int, int]:
        """Return tag, VR (empty in implicit VR), length, and the offset of the value."""
        if place + 8 > end:
            raise ValueProblem("a sequence ends within the head of an element")
        if encoding.implicit:
            group, element, length = encoding.implicit_head.unpack_from(self.data, place)
            return group << 16 | element, b"", length, place + 8
        group, element, vr, length = encoding.explicit_head.unpack_from(self.data, place)
        tag = group << 16 | element
        if group == 0xFFFE:
            return tag, b"", encoding.length.unpack_from(self.data, place + 4)[0], place + 8
        if vr in LONG_VRS:
            if place + 12 > end:
                raise ValueProblem("a sequence ends within the head of an element")
            return tag, vr, encoding.length.unpack_from(self.data, place + 8)[0], place + 12
        if not (0x41 <= vr[0] <= 0x5A and 0x41 <= vr[1] <= 0x5A):
            raise ValueProblem(f"the element ({group:04X},{element:04X}) has no VR within explicit VR")
        return tag, vr, length, place + 8

    def read_data_set(
        self, place: int, end: int, schema: Schema, encoding: _Encoding, where: str, *, top: bool = False
    ) -> tuple[Item, int]:
        """Read the elements up to `end`, or to the delimiter of an item; also return the offset after them."""
        item = Item()
        seen: dict[int, bytes] = {}
        while place < end:
            if top and end - place < 8:
                break
            tag, vr, length, place = self.read_head(place, end, encoding)
            if tag == ITEM_END or top and tag >= PIXEL_GROUP:
                break
            inner = schema.get(tag)
            if tag in item.sequences:
                raise ValueProblem(f"{name_tag(tag)} is there twice" + (f" in an item of {where}" if where else ""))
            if inner is not None and (length == UNDEFINED_LENGTH or vr in (b"SQ", b"UN", b"")):
                inside = _UNKNOWN if vr == b"UN" else encoding
                item.sequences[tag], place = self.read_items(place, end, length, inner, inside, _place(tag))
            elif length == UNDEFINED_LENGTH:
                place = self.skip(place, end, _UNKNOWN if vr == b"UN" else encoding)
            else:
                stop = place + length
                if stop > end:
                    raise ValueProblem(
                        f"the element {_place(tag)} needs {length} bytes, {end - place} are left"
                        + (f" in {where}" if where else "")
                    )
                if inner is None and tag in schema:
                    value = self.data[place:stop]
                    self.compare(seen, tag, value, where)
                    if value:
                        item.values[tag], item.vrs[tag] = value, VR_NAMES.get(vr)
                place = stop
        return item, place

    def compare(self, seen: dict[int, bytes], tag: int, value: bytes, where: str) -> None:
        """Refuse a second, different value of a tag in one item: nobody can tell which was meant."""
        if tag not in seen:
            seen[tag] = value
        elif seen[tag] == value:
            self.repeated.add(tag)
        else:
            inside = f" in an item of {where}" if where else ""
            raise ValueProblem(f"{name_tag(tag)} is there twice{inside}, with two values")

    def read_items(
        self, place: int, end: int, length: int, schema: Schema, encoding: _Encoding, where: str
    ) -> tuple[list[Item], int]:
        """Read the items of a sequence; also return the offset after it."""
        delimited = length == UNDEFINED_LENGTH
        stop = end if delimited else place + length
        if stop > end:
            raise ValueProblem(f"the sequence {where} needs {length} bytes, {end - place} are left")
        items: list[Item] = []
        while place < stop:
            tag, _, item_length, place = self.read_item_head(place, stop, encoding, where)
            if tag == SEQUENCE_END and delimited:
                return items, place
            if tag != ITEM:
                raise ValueProblem(f"the sequence {where} holds {_place(tag)} in place of an item")
            if self.items_left == 0:
                raise ValueProblem(f"the sequences hold more than {self.items_limit} items")
            self.items_left -= 1
            item_stop = stop if item_length == UNDEFINED_LENGTH else place + item_length
            if item_stop > stop:
                raise ValueProblem(
                    f"item {len(items) + 1} of {where} needs {item_length} bytes, {stop - place} are left"
                )
            item, place = self.read_data_set(place, item_stop, schema, encoding, where)
            items.append(item)
            if item_length != UNDEFINED_LENGTH:
                place = item_stop
        if delimited:
            raise ValueProblem(f"the sequence {where} has no end")
        return items, place

    def read_item_head(self, place: int, end: int, encoding: _Encoding, where: str) -> tuple[int, bytes, int, int]:
        if place + 8 > end:
            raise ValueProblem(f"the sequence {where} ends within an item")
        group, element, length = encoding.implicit_head.unpack_from(self.data, place)
        return group << 16 | element, b"", length, place + 8

    def skip(self, place: int, end: int, encoding: _Encoding) -> int:
        """Skip a sequence of undefined length; return the offset after it."""
        open_parts: list[tuple[bool, _Encoding]] = [(True, encoding)]  # is it a sequence (or an item of one), encoding
        while open_parts:
            in_sequence, inside = open_parts[-1]
            if in_sequence:
                tag, vr, length, place = self.read_item_head(place, end, inside, "of undefined length")
                if tag == SEQUENCE_END:
                    open_parts.pop()
                    continue
                if tag != ITEM:
                    raise ValueProblem(f"a sequence of undefined length holds {_place(tag)} in place of an item")
            else:
                tag, vr, length, place = self.read_head(place, end, inside)
                if tag == ITEM_END:
                    open_parts.pop()
                    continue
            if length != UNDEFINED_LENGTH:
                place += length
            else:
                open_parts.append((not in_sequence, _UNKNOWN if vr == b"UN" else inside))
                if len(open_parts) > 2 * DEPTH_LIMIT:
                    raise ValueProblem(f"sequences are nested too deep (more than {DEPTH_LIMIT} levels)")
        return place


def decode_number(raw: bytes, form: str, little_endian: bool) -> float | int | None:
    """Decode one binary number in a format of `struct`; None if the number of bytes does not fit."""
    layout = ("<" if little_endian else ">") + form
    return struct.unpack(layout, raw)[0] if len(raw) == struct.calcsize(layout) else None


def name_tag(tag: int) -> str:
    """Keyword and tag for a message."""
    from pydicom.datadict import keyword_for_tag

    return f"{keyword_for_tag(tag)} {_place(tag)}".lstrip()


def _place(tag: int) -> str:
    return f"({tag >> 16:04X},{tag & 0xFFFF:04X})"
