"""The XML of PolyData: the arrays of any program's VTP files, and no more of a harmed one than is there.

Own code because VTK crashes on harmed files: it follows offsets and counts wherever they lead.  Arrays may be text,
base64 or raw bytes after the XML, plain or packed by zlib (VTK's "XML file formats").
"""

from __future__ import annotations

import binascii
import re
import zlib
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.system.light_dataclass import dataclass
from clrecon.system.text import escape_text

_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4", "Int64": "i8",
    "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip
_ZLIB = "vtkZLibDataCompressor"
_MOST_BLOCKS = 1 << 24
_MOST_COMPONENTS = 64
LONGEST_TEXT = 1 << 20


@dataclass
class Document:
    root: ElementTree.Element
    appended: bytes
    base64: bool
    order: str
    header: np.dtype[Any]
    packed: bool


def parse_document(data: bytes, name: str) -> Document:
    head, mark, tail = data.partition(b"<AppendedData")
    if b"<!DOCTYPE" in head or b"<!ENTITY" in head:
        raise ValueError("it declares a document type, which VTP has not")
    start = tail.find(b"_") + 1
    root = ElementTree.fromstring(head + b"</VTKFile>" if mark else head)
    if root.tag != "VTKFile" or root.get("type") != "PolyData":
        raise RefusedInputError(f"{name} holds '{escape_text(str(root.get('type')))}' of VTK: PolyData are read")
    order = ">" if root.get("byte_order") == "BigEndian" else "<"
    compressor = root.get("compressor")
    if compressor not in (None, _ZLIB):
        raise RefusedInputError(f"{name} is packed by {escape_text(str(compressor))}: write it with {_ZLIB}, or plain")
    return Document(
        root,
        tail[start:] if mark else b"",
        b"base64" in tail[:start],
        order,
        np.dtype(order + ("u8" if root.get("header_type") == "UInt64" else "u4")),
        compressor is not None,
    )


def read_arrays(document: Document, piece: ElementTree.Element, kind: str, count: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers at the points or cells of a piece, (count, components) each."""
    elements = [array for array in piece.iterfind(f"{kind}/DataArray") if array.get("type") in _TYPES]
    return {array.get("Name", ""): read_numbers(document, array, count) for array in elements}


def read_fields(document: Document) -> tuple[dict[str, tuple[str, ...]], dict[str, NDArray[Any]]]:
    """Return the texts and the numbers of the field arrays."""
    texts: dict[str, tuple[str, ...]] = {}
    numbers: dict[str, NDArray[Any]] = {}
    for array in document.root.iterfind("PolyData/FieldData/*"):
        name = array.get("Name", "")
        count = read_count(array, "NumberOfTuples")
        if array.get("type") == "String":
            data = _bytes(document, array)[:LONGEST_TEXT]
            texts[name] = tuple(text.decode("utf-8", "replace") for text in data.split(b"\0")[:count])
        elif array.get("type") in _TYPES:
            numbers[name] = read_numbers(document, array, count).ravel()
    return texts, numbers


def read_count(element: ElementTree.Element, attribute: str) -> int:
    """Return a whole number of an element, 0 where it is not given."""
    value = element.get(attribute, "0")
    if not re.fullmatch(r"\d{1,15}", value):
        raise ValueError(f"{attribute} is '{value}'")
    return int(value)


def read_numbers(document: Document, array: ElementTree.Element, count: int, width: int | None = None) -> NDArray[Any]:
    """Return the values of a DataArray, shape (count, components)."""
    components = read_count(array, "NumberOfComponents") or 1
    kind = _TYPES.get(array.get("type", ""))
    if kind is None or components > _MOST_COMPONENTS or width not in (None, components):
        raise ValueError(f"an array of {components} components of type '{array.get('type')}'")
    if array.get("format") == "ascii":
        values = np.array((array.text or "").split(), dtype=np.float64).astype(kind)
    else:
        values = np.frombuffer(_bytes(document, array), dtype=document.order + kind).astype(kind)
    if values.size != count * components:
        raise ValueError(f"the array '{array.get('Name')}' has {values.size:,} numbers, {count * components:,} needed")
    return values.reshape(count, components)


def _bytes(document: Document, array: ElementTree.Element) -> bytes:
    form = array.get("format")
    if form == "ascii":
        return bytes(int(word) for word in (array.text or "").split())
    if form == "binary":
        return _unpack(document, _From64((array.text or "").strip().encode("ascii")))
    if form == "appended":
        rest = memoryview(document.appended)[read_count(array, "offset") :]
        return _unpack(document, _From64(bytes(rest)) if document.base64 else _Raw(rest))
    raise ValueError(f"an array of format '{form}'")


class _Raw:
    """Bytes as they are."""

    def __init__(self, data: memoryview):
        self._data, self._place = data, 0

    def take(self, count: int) -> bytes:
        if count > len(self._data) - self._place:
            raise ValueError(f"an array has {count:,} bytes and {len(self._data) - self._place:,} are there")
        self._place += count
        return bytes(self._data[self._place - count : self._place])

    def end_part(self) -> None:
        """End a part: nothing to do."""


class _From64:
    """Bytes in base64, in parts that each are padded to four characters."""

    def __init__(self, text: bytes):
        self._text, self._start, self._taken = text, 0, 0

    def take(self, count: int) -> bytes:
        first, last = self._taken // 3 * 4, -(-(self._taken + count) // 3) * 4
        if last > len(self._text) - self._start:
            raise ValueError(f"an array has {count:,} bytes and {len(self._text):,} characters are there")
        data = binascii.a2b_base64(self._text[self._start + first : self._start + last])
        skip = self._taken % 3
        self._taken += count
        if len(data) < skip + count:
            raise ValueError("base64 ends early")
        return data[skip : skip + count]

    def end_part(self) -> None:
        """Go on behind the padding."""
        self._start += -(-self._taken // 3) * 4
        self._taken = 0


def _unpack(document: Document, source: _Raw | _From64) -> bytes:
    """Return an array's bytes: after their number, or packed in blocks after the numbers of their bytes."""
    size = document.header.itemsize
    if not document.packed:
        return source.take(int(np.frombuffer(source.take(size), document.header)[0]))
    blocks, block_bytes, last_bytes = map(int, np.frombuffer(source.take(3 * size), document.header))
    if blocks > _MOST_BLOCKS:
        raise ValueError(f"an array of {blocks:,} blocks")
    packed = [int(length) for length in np.frombuffer(source.take(blocks * size), document.header)]
    source.end_part()
    parts = []
    for number, length in enumerate(packed):
        expected = last_bytes if last_bytes and number == blocks - 1 else block_bytes
        parts.append(zlib.decompressobj().decompress(source.take(length), expected + 1))
        if len(parts[-1]) != expected:
            raise ValueError(f"a block of {expected:,} bytes has {len(parts[-1]):,}")
    return b"".join(parts)
