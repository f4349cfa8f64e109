"""Wavefront OBJ, text, with the frame, the unit, the iso value and the certificate in comments.

Own code because vtkOBJWriter has no comments and reports success on a full disk, and trimesh builds the text in memory.
Coordinates have nine digits, enough to get back the same float32, and fifteen far from the origin; normals have six
decimals.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from clrecon.exchange.content import Assembly, Content, parts_of, refuse_file
from clrecon.system.pieces import chunks

_CHUNK = 1 << 14
_PIECE = 1 << 22


def _header(content: Content | Assembly) -> bytes:
    remarks = parts_of(content)[0].remarks
    return "".join(f"# {remark}\n" for remark in remarks).encode("ascii")


def estimate(content: Content | Assembly) -> int:
    """Estimate the size of the file in bytes."""
    parts = parts_of(content)
    digits = len(str(sum(len(part.vertices) for part in parts)))
    return len(_header(content)) + sum(_estimate_part(part, digits) for part in parts)


def _estimate_part(content: Content, digits: int) -> int:
    color = 0 if content.color is None else 18
    if content.normals is None:
        return (30 + color) * len(content.vertices) + (3 * digits + 5) * len(content.triangles)
    return (58 + color) * len(content.vertices) + (6 * digits + 11) * len(content.triangles)


def write(stream: BinaryIO, content: Content | Assembly) -> None:
    """Write vertices, normals (if there are any) and faces; indices count from 1 and go on from object to object.

    Each mesh of several is an object by its name.  Colours stand behind the coordinates of vertices, as MeshLab,
    Blender and others read and write them: a file of materials would be a second file.
    """
    stream.write(_header(content))
    before = normals_before = 1
    for number, part in enumerate(parts_of(content), start=1):
        if isinstance(content, Assembly):
            stream.write(f"o {_name(part, number)}\n".encode("ascii"))
        _write_part(stream, part, before, normals_before)
        before += len(part.vertices)
        normals_before += 0 if part.normals is None else len(part.normals)


def _name(part: Content, number: int) -> str:
    """Return the name of an object: one word of ASCII, as some readers take no more."""
    words = (part.name or f"object {number}").encode("ascii", "replace").decode("ascii").split()
    return "_".join(words) or f"object_{number}"


def _write_part(stream: BinaryIO, part: Content, before: int, normals_before: int) -> None:
    color = "" if part.color is None else " " + " ".join(f"{value:.4f}" for value in part.color)
    line = f"v {part.number} {part.number} {part.number}{color}\n"
    # One % for many lines takes two thirds of the time of one % for each line.
    for where in chunks(len(part.vertices), _CHUNK):
        rows = part.vertices[where]
        stream.write((line * len(rows) % tuple(rows.ravel().tolist())).encode("ascii"))
    face = "f %d %d %d\n"
    if part.normals is not None:
        face = "f %d//%d %d//%d %d//%d\n"
        for where in chunks(len(part.normals), _CHUNK):
            rows = part.normals[where]
            stream.write(("vn %.6f %.6f %.6f\n" * len(rows) % tuple(rows.ravel().tolist())).encode("ascii"))
    for where in chunks(len(part.triangles), _CHUNK):
        corners = part.triangles[where].astype(np.int64) + before
        if part.normals is not None:
            corners = np.stack((corners, corners - before + normals_before), axis=2)
        stream.write((face * len(corners) % tuple(corners.ravel().tolist())).encode("ascii"))


def verify(path: Path, content: Content | Assembly) -> None:
    """Check the header and count the lines of a finished file."""
    parts = parts_of(content)
    expected = {
        "vertices": (b"\nv ", sum(len(part.vertices) for part in parts)),
        "normals": (b"\nvn ", sum(0 if part.normals is None else len(part.normals) for part in parts)),
        "triangles": (b"\nf ", sum(len(part.triangles) for part in parts)),
        "objects": (b"\no ", len(parts) if isinstance(content, Assembly) else 0),
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
