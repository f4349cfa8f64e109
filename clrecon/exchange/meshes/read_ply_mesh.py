"""PLY meshes: the element ``vertex``, and ``face`` with lists of three corners."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.clouds.raw_cloud import RawCloud, read_remarks, say_cut
from clrecon.exchange.clouds.read_ply import Element, Header, read_binary, read_header, read_text, skip_to_vertices
from clrecon.exchange.meshes.raw_mesh import Part, RawMesh
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text

_CORNERS = ("vertex_indices", "vertex_index")


def read(path: Path) -> RawMesh:
    """Read the vertices, their normals and the triangles of a PLY file."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            header = read_header(stream, name)
            vertex = skip_to_vertices(stream, header, name)
            face = _find_faces(header, vertex, name)
            size = path.stat().st_size
            if header.order:
                found = read_binary(stream, header, vertex, name, size)
                triangles = _read_faces(stream, header, face, name, size)
            else:
                text = stream.read()
                found = read_text(io.BytesIO(text), vertex, name, size)
                triangles = _read_lines(io.BytesIO(text), vertex, face, name)
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        raise say_cut(name, error) from error
    points = np.stack([found.pop(axis) for axis in ("x", "y", "z")], axis=1)
    cloud = RawCloud("PLY", points, found)
    normals = cloud.normals()
    said = read_remarks(header.comments)
    color = _one_color(found)
    parts = [] if color is None else [Part("", len(triangles), color)]
    return RawMesh("PLY", points, triangles, normals, warnings=cloud.warnings, parts=parts, **said)


def _one_color(columns: Mapping[str, NDArray[Any]]) -> tuple[float, float, float] | None:
    """Return the colour that all vertices have."""
    own = [columns.get(name) for name in ("red", "green", "blue")]
    values = [
        each[0] / 255.0 for each in own if each is not None and each.dtype == np.uint8 and len(np.unique(each)) == 1
    ]
    return (float(values[0]), float(values[1]), float(values[2])) if len(values) == 3 else None


def _find_faces(header: Header, vertex: Element, name: str) -> Element:
    """Return the element of the faces, which has to follow that of the vertices."""
    place = header.elements.index(vertex) + 1
    face = header.elements[place] if place < len(header.elements) else None
    if face is None or face.name != "face":
        raise RefusedInputError(f"{name} has no faces after its vertices: it is no mesh, perhaps a cloud of points")
    if len(face.lists) != 1 or not set(face.lists) <= set(_CORNERS) or face.types:
        known = escape_text(", ".join((*face.lists, *face.types)))
        raise RefusedInputError(f"the faces of {name} have {known}: one list of vertices alone is read")
    return face


def _read_faces(stream: BinaryIO, header: Header, face: Element, name: str, size: int) -> NDArray[Any]:
    ((count, corner),) = face.lists.values()
    row = np.dtype([("count", header.order + count), ("corners", header.order + corner, (3,))])
    left = size - stream.tell()
    if face.count * row.itemsize > left:
        raise RefusedInputError(
            f"{name} is cut or corrupt: {face.count:,} triangles of {row.itemsize} bytes cannot come from"
            f" {left:,} bytes"
        )
    rows = np.frombuffer(stream.read(row.itemsize * face.count), dtype=row)
    _check_triangles(rows["count"], name)
    return np.ascontiguousarray(rows["corners"]).astype(np.int64)


def _read_lines(text: BinaryIO, vertex: Element, face: Element, name: str) -> NDArray[Any]:
    if face.count == 0:
        return np.zeros((0, 3), np.int64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about empty lines
        table = np.loadtxt(
            io.TextIOWrapper(text, encoding="latin-1"), comments=None, ndmin=2, dtype=np.int64, skiprows=vertex.count,
            max_rows=face.count,
        )  # fmt: skip
    if len(table) != face.count or table.shape[1] != 4:
        raise RefusedInputError(f"{name} is cut or corrupt, or has faces that are not triangles")
    _check_triangles(table[:, 0], name)
    return table[:, 1:]


def _check_triangles(counts: NDArray[Any], name: str) -> None:
    wrong = np.flatnonzero(counts != 3)
    if len(wrong):
        raise RefusedInputError(
            f"face {int(wrong[0]):,} of {name} has {int(counts[wrong[0]])} corners: only triangles are read"
        )
