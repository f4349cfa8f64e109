"""Binary STL: an 80-byte header, a count, 50 bytes a triangle.

3D Slicer reads the frame from the header (``SPACE=LPS``).  A header that begins with ``solid`` would be taken for the
text variant.  Own code because VTK, which can set the header, writes to a named file only and deletes it when the
disk is full, and trimesh leaves the header empty, builds the file in memory and took five times as long.
"""

from __future__ import annotations

import struct
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.writers.content import Content, refuse_file

__all__ = ["estimate", "verify", "write"]

_HEAD = 84
_FACET = np.dtype([("floats", "V48"), ("attribute", "<u2")])
_CHUNK = 1 << 14
"""Facets a piece: what a piece needs stays in the processor's cache."""
_AHEAD = 4
"""Pieces that may be packed before they are written: bounds the memory."""


def _header(content: Content) -> bytes:
    return f"clrecon SPACE={content.space} UNIT=mm".encode("ascii").ljust(80, b" ")


def estimate(content: Content) -> int:
    """Size of the file in bytes, exactly."""
    return _HEAD + _FACET.itemsize * len(content.triangles)


def write(stream: BinaryIO, content: Content) -> None:
    """Write facets with unit normals from their corners; the normal of a facet without area is zero."""
    stream.write(_header(content) + struct.pack("<I", len(content.triangles)))
    starts = range(0, len(content.triangles), _CHUNK)
    with ThreadPoolExecutor(max_workers=2) as pool:  # numpy works outside the interpreter's lock
        waiting: deque[Future[NDArray[np.uint8]]] = deque()
        for start in starts:
            waiting.append(pool.submit(_pack_facets, content, start))
            if len(waiting) > _AHEAD:
                stream.write(waiting.popleft().result().data)
        while waiting:
            stream.write(waiting.popleft().result().data)


def _pack_facets(content: Content, start: int) -> NDArray[np.uint8]:
    """The bytes of one piece of facets."""
    triangles = content.triangles[start : start + _CHUNK]
    count = len(triangles)
    piece = np.empty((count, 4, 3), dtype="<f4")  # normal, then three corners
    piece[:, 1:] = content.vertices.take(triangles, axis=0)
    p = piece[:, 2] - piece[:, 1]
    q = piece[:, 3] - piece[:, 1]
    normal = piece[:, 0]
    normal[:, 0] = p[:, 1] * q[:, 2] - p[:, 2] * q[:, 1]
    normal[:, 1] = p[:, 2] * q[:, 0] - p[:, 0] * q[:, 2]
    normal[:, 2] = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    length = np.sqrt(np.einsum("ij,ij->i", normal, normal))
    length[length == 0.0] = 1.0
    normal /= length[:, None]
    normal += np.float32(0)  # no -0
    facets = np.zeros(count, dtype=_FACET)
    facets["floats"] = piece.reshape(count, 12).view("V48")[:, 0]
    return facets.view(np.uint8)


def verify(path: Path, content: Content) -> None:
    """Check header, count and size of a finished file."""
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    if head[:80] != _header(content) or len(head) != _HEAD:
        raise refuse_file("in the header", repr(head[:80]), repr(_header(content)))
    (count,) = struct.unpack("<I", head[80:])
    if count != len(content.triangles):
        raise refuse_file("triangles", count, len(content.triangles))
    if path.stat().st_size != estimate(content):
        raise refuse_file("bytes", path.stat().st_size, estimate(content))
