"""Binary little-endian PLY with the frame, the unit, the iso value and the certificate in comments.

Own code because vtkPLYWriter reports success on a full disk, and trimesh has no comments.  Indices are declared ``int``
and not ``uint``, because every reader knows ``int``: at most 2**31 vertices.

A cloud has vertices alone and no element ``face``: readers were seen that take a file with an empty one for a mesh of
nothing.  HU is the property ``scalar_HU`` of type ``float`` and a distance ``scalar_distance_mm``: CloudCompare takes
only names with ``scalar_`` by itself, and Open3D skips ``short``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError
from clrecon.exchange.content import Content, PointContent, refuse_file
from clrecon.system.pieces import chunks

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])
_CHUNK = 1 << 14


def _header(content: PointContent) -> bytes:
    coordinate = "double" if content.is_double else "float"
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {remark}" for remark in content.remarks),
        f"element vertex {len(content.vertices)}",
        *(f"property {coordinate} {name}" for name in ("x", "y", "z")),
        *(f"property float {name}" for name in ("nx", "ny", "nz") if content.normals is not None),
        *(["property float scalar_HU"] if content.hu is not None else []),
        *(["property int label"] if content.labels is not None else []),
        *(["property float scalar_distance_mm"] if _distances(content) is not None else []),
        *(f"property uchar {name}" for name in ("red", "green", "blue") if _color(content) is not None),
    ]
    if isinstance(content, Content):
        lines += [f"element face {len(content.triangles)}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def _distances(content: PointContent) -> NDArray[np.float32] | None:
    return content.distances if isinstance(content, Content) else None


def _color(content: PointContent) -> NDArray[np.uint8] | None:
    """Return red, green and blue of a mesh that has a colour, or of each of its vertices."""
    if isinstance(content, Content) and content.vertex_colors is not None:
        return content.vertex_colors
    if not isinstance(content, Content) or content.color is None:
        return None
    return np.rint(255.0 * np.array(content.color)).astype(np.uint8)


def _columns(content: PointContent) -> dict[str, tuple[NDArray[Any], str, tuple[int, ...]]]:
    """Return the values of a vertex, in the order of the file: array, type and shape of each."""
    columns: dict[str, tuple[NDArray[Any], str, tuple[int, ...]]] = {
        "position": (content.vertices, "<f8" if content.is_double else "<f4", (3,))
    }
    if content.normals is not None:
        columns["normal"] = (content.normals, "<f4", (3,))
    if content.hu is not None:
        columns["hu"] = (content.hu, "<f4", ())
    if content.labels is not None:
        columns["label"] = (content.labels, "<i4", ())
    if (distances := _distances(content)) is not None:
        columns["distance"] = (distances, "<f4", ())
    if (color := _color(content)) is not None:
        columns["color"] = (np.broadcast_to(color, (len(content.vertices), 3)), "u1", (3,))
    return columns


def _vertex(content: PointContent) -> np.dtype[Any]:
    return np.dtype([(name, form, shape) for name, (_, form, shape) in _columns(content).items()])


def estimate(content: PointContent) -> int:
    """Return the exact size of the file in bytes."""
    rows = _vertex(content).itemsize * len(content.vertices)
    faces = len(content.triangles) if isinstance(content, Content) else 0
    return len(_header(content)) + rows + _FACE.itemsize * faces


def write(stream: BinaryIO, content: PointContent) -> None:
    """Write vertices, with what is known of each, and the faces of a mesh."""
    if len(content.vertices) > 2**31:
        raise OutputError(f"{len(content.vertices)} vertices are too many for a PLY file, at most {2**31}")
    stream.write(_header(content))
    columns = _columns(content)
    rows = np.empty(_CHUNK, dtype=_vertex(content))
    for where in chunks(len(content.vertices), _CHUNK):
        piece = rows[: where.stop - where.start]
        for name, (values, _, _) in columns.items():
            piece[name] = values[where]
        stream.write(piece.view(np.uint8).data)
    if isinstance(content, Content):
        _write_faces(stream, content.triangles)


def _write_faces(stream: BinaryIO, triangles: NDArray[np.uint32]) -> None:
    faces = np.empty(_CHUNK, dtype=_FACE)
    faces["count"] = 3
    for where in chunks(len(triangles), _CHUNK):
        part = faces[: where.stop - where.start]
        part["corners"] = triangles[where]
        stream.write(part.view(np.uint8).data)


def verify(path: Path, content: PointContent) -> None:
    """Check header (with its counts) and size of a finished file."""
    expected = _header(content)
    with path.open("rb") as stream:
        found = stream.read(len(expected))
    if found != expected:
        raise refuse_file("in the header", repr(found), repr(expected))
    if path.stat().st_size != estimate(content):
        raise refuse_file("bytes", path.stat().st_size, estimate(content))
