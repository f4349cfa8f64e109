"""Wavefront OBJ, text, with the frame, the unit, the iso value and the certificate in comments.

Own code because vtkOBJWriter has no comments and reports success on a full disk, and trimesh builds the text in memory.
Coordinates have nine digits, enough to get back the same float32, and fifteen far from the origin; normals have six
decimals.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from clrecon.exchange.content import Content, refuse_file
from clrecon.system.pieces import chunks

__all__ = ["estimate", "verify", "write"]

_CHUNK = 1 << 14
_PIECE = 1 << 22


def _header(content: Content) -> bytes:
    return "".join(f"# {remark}\n" for remark in content.remarks).encode("ascii")


def estimate(content: Content) -> int:
    """Estimate the size of the file in bytes."""
    digits = len(str(len(content.vertices)))
    head = len(_header(content))
    if content.normals is None:
        return head + 30 * len(content.vertices) + (3 * digits + 5) * len(content.triangles)
    return head + 58 * len(content.vertices) + (6 * digits + 11) * len(content.triangles)


def write(stream: BinaryIO, content: Content) -> None:
    """Write vertices, normals (if there are any) and faces; indices count from 1."""
    stream.write(_header(content))
    line = f"v {content.number} {content.number} {content.number}\n"
    # One % for many lines takes two thirds of the time of one % for each line.
    for where in chunks(len(content.vertices), _CHUNK):
        rows = content.vertices[where]
        stream.write((line * len(rows) % tuple(rows.ravel().tolist())).encode("ascii"))
    face = "f %d %d %d\n"
    if content.normals is not None:
        face = "f %d//%d %d//%d %d//%d\n"
        for where in chunks(len(content.normals), _CHUNK):
            rows = content.normals[where]
            stream.write(("vn %.6f %.6f %.6f\n" * len(rows) % tuple(rows.ravel().tolist())).encode("ascii"))
    for where in chunks(len(content.triangles), _CHUNK):
        corners = content.triangles[where].astype(np.int64) + 1
        if content.normals is not None:
            corners = np.repeat(corners, 2, axis=1)
        stream.write((face * len(corners) % tuple(corners.ravel().tolist())).encode("ascii"))


def verify(path: Path, content: Content) -> None:
    """Check the header and count the lines of a finished file."""
    expected = {
        "vertices": (b"\nv ", len(content.vertices)),
        "normals": (b"\nvn ", 0 if content.normals is None else len(content.normals)),
        "triangles": (b"\nf ", len(content.triangles)),
    }
    counts = dict.fromkeys(expected, 0)
    header = _header(content)
    with path.open("rb") as stream:
        found = stream.read(len(header))
        if found != header:
            raise refuse_file("in the header", repr(found), repr(header))
        tail = b"\n"
        while piece := stream.read(_PIECE):
            for words, (mark, _) in expected.items():
                # A pattern may cross the border of two pieces: all of its bytes but one are carried over, so it is
                # counted once.
                counts[words] += (tail[-(len(mark) - 1) :] + piece).count(mark)
            tail = piece[-3:]
    for words, (_, count) in expected.items():
        if counts[words] != count:
            raise refuse_file(words, counts[words], count)
    if tail[-1:] != b"\n":
        raise refuse_file("at the end", repr(tail), "a line end")
