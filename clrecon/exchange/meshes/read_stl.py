"""STL, binary and text: corners of facets, which are joined where they coincide.

Own code because the frame is in the header, which common readers drop, and because a harmed count must not take memory.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.clouds.raw_cloud import say_cut
from clrecon.exchange.coordinates import find_places
from clrecon.exchange.meshes.plain_lines import MARK, plain_lines
from clrecon.exchange.meshes.raw_mesh import RawMesh
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text

_HEAD = 84
_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
_PIECE = 1 << 16
"""Facets that are read at a time."""

_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t]*$", re.MULTILINE | re.IGNORECASE)
_END = re.compile(rb"^[ \t]*end[ \t]?facet\b", re.MULTILINE | re.IGNORECASE)


def read(path: Path) -> RawMesh:
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
                said = re.search(rb"SPACE=(\w+)", head[:80])
                return _make(corners, said)
            if head.removeprefix(MARK).lstrip()[:5].lower() != b"solid":
                raise RefusedInputError(
                    f"{name} is cut or corrupt: {count:,} triangles take {_HEAD + _FACET.itemsize * count:,} bytes, it"
                    f" has {size:,}"
                )
            text = plain_lines(head + stream.read())
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        raise say_cut(name, error) from error
    found = _VERTEX.findall(text)
    if len(found) % 3 or len(found) != 3 * len(_END.findall(text)):
        raise RefusedInputError(f"{name} is cut or corrupt: {len(found):,} vertices are not those of whole facets")
    try:
        numbers = np.array(found, dtype="S40").astype(np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise say_cut(name, error) from error
    return _make(numbers, re.search(rb"SPACE=(\w+)", text[:1024]))


def _make(corners: NDArray[np.floating], said: re.Match[bytes] | None) -> RawMesh:
    vertices, triangles = join_corners(corners.reshape(-1, 3))
    return RawMesh("STL", vertices, triangles, space=None if said is None else said[1].decode("ascii", "replace"))


def join_corners(corners: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Join corners that coincide.

    corners: ndarray, shape (3 m, 3)

    Returns:
    vertices: ndarray, shape (n, 3). In the order in which they occur first.
    triangles: ndarray, shape (m, 3), int64
    """
    first, place = find_places(corners)
    return corners[first], place.reshape(-1, 3)
