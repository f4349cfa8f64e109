"""STL: binary to write (an 80-byte header, a count, 50 bytes a triangle), binary and text to read.

3D Slicer reads the frame from the header (``SPACE=LPS``).  A header that begins with ``solid`` would be taken for the
text variant.  Own code because VTK, which can set the header, writes to a named file only and deletes it when the disk
is full, and trimesh leaves the header empty, builds the file in memory and took five times as long.

The reader joins the corners of facets where they coincide: common ones drop the frame in the header, and a harmed count
must not take memory.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.content import Content, check_same, refuse_file
from clrecon.exchange.coordinates import find_places, rounded_apart
from clrecon.exchange.raw_content import MARK, RawMesh, plain_lines, say_cut
from clrecon.system.paths import open_regular
from clrecon.system.pieces import chunks, deal_in_order
from clrecon.system.text import escape_text

_HEAD = 84
_FACET_BYTES = 50
"""Bytes of a facet: normal, three corners and two unused bytes."""
_CHUNK = 1 << 14
"""Facets in a piece, so that its data stay in the processor's cache."""


def _header(content: Content) -> bytes:
    return f"clrecon SPACE={content.space} UNIT=mm".encode("ascii").ljust(80, b" ")


def estimate(content: Content) -> int:
    return _HEAD + _FACET_BYTES * len(content.triangles)


def write(stream: BinaryIO, content: Content) -> None:
    """Write facets with unit normals computed from their corners; the normal of a facet without area is zero."""
    _write_head(stream, content)
    # Readers join vertices that coincide: where rounding brings vertices together, the surface would become open.
    _write_facets(stream, rounded_apart(content.vertices), content.triangles)


def write_pieces(stream: BinaryIO, whole: Content, pieces: Iterable[Content]) -> None:
    """Write what `write` writes of float32 vertices, a piece at a time; triangles wait for vertices of the next one."""
    _write_head(stream, whole)
    first, before = 0, replace(whole, vertices=whole.vertices[:0], triangles=whole.triangles[:0])
    for piece in pieces:
        vertices = np.concatenate([before.vertices, piece.vertices])
        _write_facets(stream, vertices, before.triangles - np.uint32(first))
        first, before = first + len(before.vertices), piece
    _write_facets(stream, before.vertices, before.triangles - np.uint32(first))


def _write_head(stream: BinaryIO, content: Content) -> None:
    stream.write(_header(content) + struct.pack("<I", len(content.triangles)))


def _write_facets(stream: BinaryIO, vertices: NDArray[np.float32], triangles: NDArray[np.uint32]) -> None:
    coordinates = [np.ascontiguousarray(vertices[:, axis]) for axis in range(3)]
    packers = [partial(_pack_facets, coordinates)] * 2  # numpy releases the interpreter's lock
    with closing(deal_in_order(packers, (triangles[piece] for piece in chunks(len(triangles), _CHUNK)))) as packed:
        stream.writelines(packed)


def _pack_facets(coordinates: list[NDArray[np.float32]], triangles: NDArray[np.uint32]) -> bytearray:
    """Return the bytes of one piece of facets.  All arithmetic is on whole columns: twice as fast as on rows."""
    a, b, c = (
        [axis.take(corner) for axis in coordinates] for corner in np.ascontiguousarray(triangles.T)
    )  # corners, each as x, y, z
    p = [b[axis] - a[axis] for axis in range(3)]
    q = [c[axis] - a[axis] for axis in range(3)]
    normal = [p[axis - 2] * q[axis - 1] - p[axis - 1] * q[axis - 2] for axis in range(3)]
    length = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    length[length == 0.0] = 1.0
    zero = np.float32(0)
    packed = bytearray(_FACET_BYTES * len(triangles))
    for position, column in enumerate([*(part / length + zero for part in normal), *a, *b, *c]):  # + 0 turns -0 into 0
        np.ndarray(len(triangles), "<f4", packed, 4 * position, (_FACET_BYTES,))[:] = column
    return packed


def verify(path: Path, content: Content) -> None:
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    if head[:80] != _header(content) or len(head) != _HEAD:
        raise refuse_file("in the header", repr(head[:80]), repr(_header(content)))
    (count,) = struct.unpack("<I", head[80:])
    check_same("triangles", count, len(content.triangles))
    check_same("bytes", path.stat().st_size, estimate(content))


_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
_PIECE = 1 << 16
"""Facets that are read at a time."""

_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t]*$", re.MULTILINE | re.IGNORECASE)
_END = re.compile(rb"^[ \t]*end[ \t]?facet\b", re.MULTILINE | re.IGNORECASE)


def read_mesh(path: Path) -> RawMesh:
    """Read an STL file; one whose length is that of its count is binary, whatever it begins with."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            size = path.stat().st_size
            head = stream.read(_HEAD)
            count = int.from_bytes(head[80:84], "little")
            if len(head) == _HEAD and size == _HEAD + _FACET.itemsize * count:
                corners = np.empty((count, 3, 3), np.float32)
                for start in range(0, count, _PIECE):
                    rows = np.frombuffer(stream.read(_FACET.itemsize * min(_PIECE, count - start)), dtype=_FACET)
                    corners[start : start + len(rows)] = rows["corners"]
                return _make_mesh(corners, re.search(rb"SPACE=(\w+)", head[:80]))
            if head.removeprefix(MARK).lstrip()[:5].lower() != b"solid":
                raise RefusedInputError(
                    f"{name} is cut or corrupt: {count:,} triangles take {_HEAD + _FACET.itemsize * count:,} bytes, it"
                    f" has {size:,}"
                )
            text = plain_lines(head + stream.read())
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        raise say_cut(name, error) from error
    hits = _VERTEX.findall(text)
    if len(hits) % 3 or len(hits) != 3 * len(_END.findall(text)):
        raise RefusedInputError(f"{name} is cut or corrupt: {len(hits):,} vertices are not those of whole facets")
    try:
        numbers = np.array(hits, dtype="S40").astype(np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise say_cut(name, error) from error
    return _make_mesh(numbers, re.search(rb"SPACE=(\w+)", text[:1024]))


def _make_mesh(corners: NDArray[np.floating], space: re.Match[bytes] | None) -> RawMesh:
    vertices, triangles = join_corners(corners.reshape(-1, 3))
    return RawMesh("STL", vertices, triangles, space=None if space is None else space[1].decode("ascii", "replace"))


def join_corners(corners: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Join corners (3 m, 3) that coincide; vertices stand in the order in which they occur first."""
    first, inverse = find_places(corners)
    return corners[first], inverse.reshape(-1, 3)
