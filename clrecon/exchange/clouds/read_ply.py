"""PLY of any program: ASCII, binary of either byte order; the element ``vertex`` with properties of any number.

Own code because Open3D leaves out properties, trimesh comments and VTK both, and because a harmed header must not take
memory: it is short, its counts are compared with the size of the file.
"""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.clouds.raw_cloud import RawCloud, read_remarks, say_cut
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEAD = 1 << 16
"""Most bytes of a header; ours have some 20,000 at most."""
_MOST_PROPERTIES = 256
_PIECE = 1 << 16
"""Points that are read at a time."""


@dataclass
class Element:
    """An element of a file: its rows, their numbers by name, and their lists by name (types of count and entries)."""

    name: str
    count: int
    types: dict[str, str] = field(default_factory=dict)
    lists: dict[str, tuple[str, str]] = field(default_factory=dict)

    @property
    def has_list(self) -> bool:
        """True where rows have no fixed length."""
        return bool(self.lists)


@dataclass
class Header:
    """What a header says; `order` is that of the bytes, "" in text files."""

    order: str
    elements: list[Element]
    comments: list[str]


def read(path: Path) -> RawCloud:
    """Read the vertices of a PLY file; other elements, such as faces, are left out with a warning."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            header = read_header(stream, name)
            vertex = skip_to_vertices(stream, header, name)
            if header.order:
                found = read_binary(stream, header, vertex, name, path.stat().st_size)
            else:
                found = read_text(stream, vertex, name, path.stat().st_size)
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        raise say_cut(name, error) from error
    others = [f"{each.count:,} of '{escape_text(each.name)}'" for each in header.elements if each.name != "vertex"]
    return RawCloud(
        "PLY",
        np.stack([found.pop(axis) for axis in ("x", "y", "z")], axis=1),
        found,
        warnings=[f"elements left out: {', '.join(others)}"] if others else [],
        **read_remarks(header.comments),
    )


def read_header(stream: BinaryIO, name: str) -> Header:
    """Read the header; the stream then stands behind it."""
    start = stream.read(_LONGEST_HEAD)
    end = re.search(rb"(?:^|\n)end_header[ \t]*(?:\r\n|\n|\r)", start)
    if end is None:
        raise RefusedInputError(f"{name} is cut or corrupt: its first {len(start):,} bytes have no line 'end_header'")
    stream.seek(end.end())
    lines = start[: end.start()].decode("latin-1").replace("\r", "").split("\n")
    header = Header("?", [], [])
    for number, line in enumerate(lines[1:], 2):
        word, _, rest = line.strip().partition(" ")
        if word == "comment":
            header.comments.append(rest)
        elif word == "format" and rest.split()[:1] and rest.split()[0] in _FORMATS:
            header.order = _FORMATS[rest.split()[0]]
        elif word == "element" and re.fullmatch(r"\S+ +\d{1,18}", rest.strip()):
            header.elements.append(Element(rest.split()[0], int(rest.split()[1])))
        elif word == "property" and header.elements:
            _add_property(header.elements[-1], rest.split(), number, name)
        elif word not in ("", "obj_info"):
            raise RefusedInputError(f"{name} is corrupt in line {number} of its header: '{escape_text(line)}'")
    if header.order == "?":
        raise RefusedInputError(f"{name} is corrupt: its header has no line 'format' that is known")
    return header


def _add_property(element: Element, words: list[str], number: int, name: str) -> None:
    if len(words) == 4 and words[0] == "list" and words[1] in _TYPES and words[2] in _TYPES:
        element.lists[words[3]] = _TYPES[words[1]], _TYPES[words[2]]
        return
    if len(words) != 2 or words[0] not in _TYPES or words[1] in element.types:
        raise RefusedInputError(
            f"{name} is corrupt in line {number} of its header: 'property {escape_text(' '.join(words))}'"
        )
    if len(element.types) == _MOST_PROPERTIES:
        raise RefusedInputError(f"{name} has more than {_MOST_PROPERTIES} properties of '{escape_text(element.name)}'")
    element.types[words[1]] = _TYPES[words[0]]


def skip_to_vertices(stream: BinaryIO, header: Header, name: str) -> Element:
    """Move the stream to the first vertex and return the element."""
    for element in header.elements:
        if element.name == "vertex":
            missing = [axis for axis in ("x", "y", "z") if axis not in element.types]
            if missing or element.has_list:
                fault = "a list" if element.has_list else f"no {', '.join(missing)}"
                raise RefusedInputError(f"the vertices of {name} have {fault}: x, y, z and single numbers are needed")
            return element
        if element.has_list and element.count:
            raise RefusedInputError(f"{name} has lists of '{escape_text(element.name)}' before its vertices: not read")
        if header.order:
            stream.seek(element.count * sum(int(kind[1]) for kind in element.types.values()), io.SEEK_CUR)
        else:
            for _ in range(element.count):
                if not stream.readline(_LONGEST_HEAD):
                    raise RefusedInputError(f"{name} is cut: it ends before its vertices")
    raise RefusedInputError(f"{name} has no element 'vertex' in its header")


def _check_room(vertex: Element, row_bytes: int, left: int, name: str) -> None:
    if vertex.count * row_bytes > left:
        raise RefusedInputError(
            f"{name} is cut or corrupt: {vertex.count:,} vertices of {row_bytes} bytes or more cannot come from"
            f" {max(left, 0):,} bytes"
        )


def read_binary(
    stream: BinaryIO, header: Header, vertex: Element, name: str, file_bytes: int
) -> dict[str, NDArray[Any]]:
    """Read the columns of vertices from a binary file."""
    row = np.dtype([(own, header.order + kind) for own, kind in vertex.types.items()])
    _check_room(vertex, row.itemsize, file_bytes - stream.tell(), name)
    columns = {own: np.empty(vertex.count, kind) for own, kind in vertex.types.items()}
    for start in range(0, vertex.count, _PIECE):
        rows = np.frombuffer(stream.read(row.itemsize * min(_PIECE, vertex.count - start)), dtype=row)
        for own, values in columns.items():
            values[start : start + len(rows)] = rows[own]
    return columns


def read_text(stream: BinaryIO, vertex: Element, name: str, file_bytes: int) -> dict[str, NDArray[Any]]:
    """Read the columns of vertices from a text file."""
    _check_room(vertex, 2 * len(vertex.types), file_bytes - stream.tell() + 1, name)
    if vertex.count == 0:
        return {own: np.zeros(0) for own in vertex.types}
    text = io.TextIOWrapper(stream, encoding="latin-1")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about empty lines
        table = np.loadtxt(text, comments=None, ndmin=2, dtype=np.float64, max_rows=vertex.count)
    if table.shape != (vertex.count, len(vertex.types)):
        raise RefusedInputError(
            f"{name} is cut or corrupt: {vertex.count:,} lines of {len(vertex.types)} numbers are needed, it has"
            f" {table.shape[0]:,} of {table.shape[1]}"
        )
    return {own: table[:, place].astype(kind) for place, (own, kind) in enumerate(vertex.types.items())}
