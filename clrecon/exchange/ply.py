"""Binary little-endian PLY with the frame, the unit, the iso value and the certificate in comments.

Own code because vtkPLYWriter reports success on a full disk, and trimesh has no comments.  Indices are declared ``int``
and not ``uint``, because every reader knows ``int``: at most 2**31 vertices.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from clrecon.errors import OutputError
from clrecon.exchange.content import Content, refuse_file
from clrecon.system.pieces import chunks

__all__ = ["estimate", "verify", "write"]

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])
_CHUNK = 1 << 14


def _header(content: Content) -> bytes:
    coordinate = "double" if content.is_double else "float"
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {remark}" for remark in content.remarks),
        f"element vertex {len(content.vertices)}",
        *(f"property {coordinate} {name}" for name in ("x", "y", "z")),
        *(f"property float {name}" for name in ("nx", "ny", "nz") if content.normals is not None),
        f"element face {len(content.triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _vertex(content: Content) -> np.dtype[Any]:
    fields: list[tuple[str, str, tuple[int]]] = [("position", "<f8" if content.is_double else "<f4", (3,))]
    if content.normals is not None:
        fields.append(("normal", "<f4", (3,)))
    return np.dtype(fields)


def estimate(content: Content) -> int:
    """Return the exact size of the file in bytes."""
    rows = _vertex(content).itemsize * len(content.vertices)
    return len(_header(content)) + rows + _FACE.itemsize * len(content.triangles)


def write(stream: BinaryIO, content: Content) -> None:
    """Write vertices (with normals, if there are any) and faces."""
    if len(content.vertices) > 2**31:
        raise OutputError(f"{len(content.vertices)} vertices are too many for a PLY file, at most {2**31}")
    stream.write(_header(content))
    rows = np.empty(_CHUNK, dtype=_vertex(content))
    for where in chunks(len(content.vertices), _CHUNK):
        piece = rows[: where.stop - where.start]
        piece["position"] = content.vertices[where]
        if content.normals is not None:
            piece["normal"] = content.normals[where]
        stream.write(piece.view(np.uint8).data)
    faces = np.empty(_CHUNK, dtype=_FACE)
    faces["count"] = 3
    for where in chunks(len(content.triangles), _CHUNK):
        part = faces[: where.stop - where.start]
        part["corners"] = content.triangles[where]
        stream.write(part.view(np.uint8).data)


def verify(path: Path, content: Content) -> None:
    """Check header (with its counts) and size of a finished file."""
    expected = _header(content)
    with path.open("rb") as stream:
        found = stream.read(len(expected))
    if found != expected:
        raise refuse_file("in the header", repr(found), repr(expected))
    if path.stat().st_size != estimate(content):
        raise refuse_file("bytes", path.stat().st_size, estimate(content))
