"""PLY: binary little-endian to write, with frame, unit, iso value and certificate in comments; of any kind to read.

Own code because vtkPLYWriter reports success on a full disk, and trimesh has no comments.  Indices are declared ``int``
and not ``uint``, because every reader knows ``int``: at most 2**31 vertices.

A cloud has vertices alone and no element ``face``: readers were seen that take a file with an empty one for a mesh of
nothing.  HU is the property ``scalar_HU`` of type ``float``, other numbers at vertices are ``scalar_distance_mm`` or
``scalar_thickness_mm``: CloudCompare takes only names with ``scalar_`` by itself, and Open3D skips ``short``.

The readers take ASCII and binary of either byte order, the element ``vertex`` with properties of any number, and of
meshes ``face`` with lists of three corners: Open3D leaves out properties, trimesh comments and VTK both, and a harmed
header must not take memory: it is short, its counts are compared with the size of the file.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError, RefusedInputError
from clrecon.exchange.content import Content, PointContent, check_same
from clrecon.exchange.raw_content import Part, RawCloud, RawMesh, numbers_of, read_remarks, say_cut
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.paths import open_regular
from clrecon.system.pieces import chunks
from clrecon.system.text import escape_text

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
        *(f"property float scalar_{name}" for name in content.values),
        *(f"property uchar {name}" for name in ("red", "green", "blue") if _color(content) is not None),
    ]
    if isinstance(content, Content):
        lines += [f"element face {len(content.triangles)}", "property list uchar int vertex_indices"]
        lines += [f"property float scalar_{name}" for name in content.face_values]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


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
    for name, values in content.values.items():
        columns[f"scalar_{name}"] = (values, "<f4", ())
    if (color := _color(content)) is not None:
        columns["color"] = (np.broadcast_to(color, (len(content.vertices), 3)), "u1", (3,))
    return columns


def _vertex(content: PointContent) -> np.dtype[Any]:
    return np.dtype([(name, form, shape) for name, (_, form, shape) in _columns(content).items()])


def _face(content: Content) -> np.dtype[Any]:
    numbers = [(f"scalar_{name}", "<f4") for name in content.face_values]
    return np.dtype([("count", "u1"), ("corners", "<i4", (3,)), *numbers])


def estimate(content: PointContent) -> int:
    rows = _vertex(content).itemsize * len(content.vertices)
    faces = _face(content).itemsize * len(content.triangles) if isinstance(content, Content) else 0
    return len(_header(content)) + rows + faces


def write(stream: BinaryIO, content: PointContent) -> None:
    _write_head(stream, content)
    _write_vertices(stream, content)
    if isinstance(content, Content):
        _write_faces(stream, content)


def write_pieces(stream: BinaryIO, whole: Content, pieces: Iterable[Content]) -> None:
    """Write what `write` writes, a piece at a time: its vertices and its faces go to two places of the file."""
    _write_head(stream, whole)
    next_vertex = stream.tell()
    next_face = next_vertex + _vertex(whole).itemsize * len(whole.vertices)
    for piece in pieces:
        stream.seek(next_vertex)
        _write_vertices(stream, piece)
        next_vertex = stream.tell()
        stream.seek(next_face)
        _write_faces(stream, piece)
        next_face = stream.tell()


def _write_head(stream: BinaryIO, content: PointContent) -> None:
    if len(content.vertices) > 2**31:
        raise OutputError(f"{len(content.vertices)} vertices are too many for a PLY file, at most {2**31}")
    stream.write(_header(content))


def _write_vertices(stream: BinaryIO, content: PointContent) -> None:
    columns = {name: values for name, (values, _, _) in _columns(content).items()}
    _write_rows(stream, np.empty(_CHUNK, dtype=_vertex(content)), columns, len(content.vertices))


def _write_faces(stream: BinaryIO, content: Content) -> None:
    faces = np.empty(_CHUNK, dtype=_face(content))
    faces["count"] = 3
    numbers = {f"scalar_{name}": values for name, values in content.face_values.items()}
    _write_rows(stream, faces, {"corners": content.triangles, **numbers}, len(content.triangles))


def _write_rows(stream: BinaryIO, rows: NDArray[Any], columns: Mapping[str, NDArray[Any]], count: int) -> None:
    """Write `count` rows of columns by way of `rows`, which hold those of a chunk."""
    for lines in chunks(count, _CHUNK):
        piece = rows[: lines.stop - lines.start]
        for name, values in columns.items():
            piece[name] = values[lines]
        stream.write(piece.view(np.uint8).data)


def verify(path: Path, content: PointContent) -> None:
    expected = _header(content)
    with path.open("rb") as stream:
        check_same("in the header", stream.read(len(expected)), expected)
    check_same("bytes", path.stat().st_size, estimate(content))


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
    """An element: rows, numbers by name, lists by name (types of count and entries), numbers before the first list."""

    name: str
    count: int
    types: dict[str, str] = field(default_factory=dict)
    lists: dict[str, tuple[str, str]] = field(default_factory=dict)
    leading: int = 0


@dataclass
class Header:
    """What a header says; `order` is that of the bytes, "" in text files."""

    order: str
    elements: list[Element]
    comments: list[str]


def read_cloud(path: Path) -> RawCloud:
    """Read the vertices of a PLY file; other elements, such as faces, are left out with a warning."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            header = read_header(stream, name)
            vertex = skip_to_vertices(stream, header, name)
            if header.order:
                columns = read_binary(stream, header, vertex, name, path.stat().st_size)
            else:
                columns = read_text(stream, vertex, name, path.stat().st_size)
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        raise say_cut(name, error) from error
    others = [f"{each.count:,} of '{escape_text(each.name)}'" for each in header.elements if each.name != "vertex"]
    return RawCloud(
        "PLY",
        np.stack([columns.pop(axis) for axis in ("x", "y", "z")], axis=1),
        columns,
        warnings=[f"elements left out: {', '.join(others)}"] if others else [],
        has_faces=_count_faces(header) > 0,
        **read_remarks(header.comments),
    )


def has_faces(path: Path) -> bool:
    """True for a file whose header counts faces."""
    with open_regular(path) as stream:
        return _count_faces(read_header(stream, escape_text(path.name))) > 0


def _count_faces(header: Header) -> int:
    return sum(each.count for each in header.elements if each.name == "face")


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
        element.leading = element.leading if element.lists else len(element.types)
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
            if missing or element.lists:
                fault = "a list" if element.lists else f"no {', '.join(missing)}"
                raise RefusedInputError(f"the vertices of {name} have {fault}: x, y, z and single numbers are needed")
            return element
        if element.lists and element.count:
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
    row = np.dtype([(own, header.order + kind) for own, kind in vertex.types.items()])
    _check_room(vertex, row.itemsize, file_bytes - stream.tell(), name)
    columns = {own: np.empty(vertex.count, kind) for own, kind in vertex.types.items()}
    for start in range(0, vertex.count, _PIECE):
        rows = np.frombuffer(stream.read(row.itemsize * min(_PIECE, vertex.count - start)), dtype=row)
        for column, values in columns.items():
            values[start : start + len(rows)] = rows[column]
    return columns


def read_text(stream: BinaryIO, vertex: Element, name: str, file_bytes: int) -> dict[str, NDArray[Any]]:
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


_CORNERS = ("vertex_indices", "vertex_index")


def read_mesh(path: Path) -> RawMesh:
    """Read the triangles of a PLY file, its vertices with their normals, and the numbers ``scalar_NAME`` at both."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            header = read_header(stream, name)
            vertex = skip_to_vertices(stream, header, name)
            face = _find_faces(header, vertex, name)
            size = path.stat().st_size
            if header.order:
                columns = read_binary(stream, header, vertex, name, size)
                triangles, at_faces = _read_faces(stream, header, face, name, size)
            else:
                text = stream.read()
                columns = read_text(io.BytesIO(text), vertex, name, size)
                triangles, at_faces = _read_lines(io.BytesIO(text), vertex, face, name)
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        raise say_cut(name, error) from error
    points = np.stack([columns.pop(axis) for axis in ("x", "y", "z")], axis=1)
    cloud = RawCloud("PLY", points, columns)
    normals = cloud.normals()
    remarks = read_remarks(header.comments)
    color = _one_color(columns)
    parts = [] if color is None else [Part("", len(triangles), color)]
    values, face_values = (
        numbers_of({own[7:]: column for own, column in each.items() if own.startswith("scalar_")})
        for each in (columns, at_faces)
    )
    others = [own for own in face.types if not own.startswith("scalar_")]
    warnings = [f"numbers at faces left out: {escape_text(', '.join(others))}"] if others else []
    return RawMesh(
        "PLY", points, triangles, normals,
        warnings=warnings + cloud.warnings, parts=parts, values=values, face_values=face_values, **remarks,
    )  # fmt: skip


def _one_color(columns: Mapping[str, NDArray[Any]]) -> tuple[float, float, float] | None:
    rgb = [columns.get(name) for name in ("red", "green", "blue")]
    values = [
        each[0] / 255.0 for each in rgb if each is not None and each.dtype == np.uint8 and len(np.unique(each)) == 1
    ]
    return (float(values[0]), float(values[1]), float(values[2])) if len(values) == 3 else None


def _find_faces(header: Header, vertex: Element, name: str) -> Element:
    """Return the element of the faces, which has to follow that of the vertices."""
    position = header.elements.index(vertex) + 1
    face = header.elements[position] if position < len(header.elements) else None
    if face is None or face.name != "face":
        raise RefusedInputError(f"{name} has no faces after its vertices: it is no mesh, perhaps a cloud of points")
    if len(face.lists) != 1 or not set(face.lists) <= set(_CORNERS):
        known = escape_text(", ".join(face.lists)) or "no list"
        raise RefusedInputError(f"the faces of {name} have {known}: one list, of vertices, is read")
    return face


Faces = tuple[NDArray[Any], dict[str, NDArray[Any]]]
"""Triangles, and the numbers at them by name."""


def _read_faces(stream: BinaryIO, header: Header, face: Element, name: str, size: int) -> Faces:
    row = _face_row(face, *next(iter(face.lists.values())), face.types, header.order)
    left = size - stream.tell()
    if face.count * row.itemsize > left:
        raise RefusedInputError(
            f"{name} is cut or corrupt: {face.count:,} triangles of {row.itemsize} bytes cannot come from"
            f" {left:,} bytes"
        )
    return _take_faces(np.frombuffer(stream.read(row.itemsize * face.count), dtype=row), face, name)


def _read_lines(text: BinaryIO, vertex: Element, face: Element, name: str) -> Faces:
    if face.count == 0:
        return np.zeros((0, 3), np.int64), {}
    row = _face_row(face, "i8", "i8", dict.fromkeys(face.types, "f8"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about empty lines
        rows = np.loadtxt(
            io.TextIOWrapper(text, encoding="latin-1"), comments=None, ndmin=1, dtype=row, skiprows=vertex.count,
            max_rows=face.count, usecols=range(len(face.types) + 4),
        )  # fmt: skip
    if len(rows) != face.count:
        raise RefusedInputError(f"{name} is cut or corrupt: {face.count:,} faces are needed, it has {len(rows):,}")
    return _take_faces(rows, face, name)


def _face_row(face: Element, count: str, corner: str, numbers: Mapping[str, str], order: str = "") -> np.dtype[Any]:
    leading = [(f"own {name}", order + kind) for name, kind in numbers.items()]
    corners = [("count", order + count), ("corners", order + corner, (3,))]
    return np.dtype([*leading[: face.leading], *corners, *leading[face.leading :]])


def _take_faces(rows: NDArray[Any], face: Element, name: str) -> Faces:
    wrong = np.flatnonzero(rows["count"] != 3)
    if len(wrong):
        raise RefusedInputError(
            f"face {int(wrong[0]):,} of {name} has {int(rows['count'][wrong[0]])} corners: only triangles are read"
        )
    triangles = np.ascontiguousarray(rows["corners"]).astype(np.int64)
    return triangles, {own: rows[f"own {own}"] for own in face.types}
