"""GLB, the binary glTF 2.0 (Khronos): a node with a mesh for each part, no textures.

The buffer holds the vertices in patient millimetres without change, so that nothing is lost.  Far from the origin,
where float32 is too coarse, the centre of their bounds is subtracted, and the matrix adds it again.  The matrix of the
node maps them to the frame that glTF prescribes (metres, right-handed, Y up, the front facing +Z):

    (X, Y, Z) = 0.001 (L, S, -P)

The head is up and the face is towards the viewer.  The matrix is a rotation times a scale, which keeps the winding.
``asset.extras`` has the inverse matrix (column-major, as glTF writes matrices), the frame, the unit and the
certificate.  Own code, because this matrix and the extras matter most and the format takes only a page.

The reader takes the meshes of a scene, placed by their nodes, of any program.  Ours name the patient frame, and the
matrix from the scene to it.  In files of others the scene is as glTF has it, of a patient who stands: (L, P, S) = 1000
(X, -Z, Y) mm.  There corners that coincide are joined, as vertices are split where normals or colours have an edge.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.content import BONE_COLOR, Assembly, Content, check_same, parts_of, refuse_file
from clrecon.exchange.coordinates import find_places
from clrecon.exchange.raw_content import MOST_LEVELS, Part, PlacedShapes, RawMesh, Shape, numbers_of, say_cut
from clrecon.system.paths import open_regular
from clrecon.system.pieces import list_distinct, local_origin
from clrecon.system.text import escape_text

_NAMELESS = "surface"
"""Name of a node and mesh that have no other."""

_METRES_PER_MM = 0.001
_FLOAT, _UINT32 = 5126, 5125
_VERTEX_DATA, _INDEX_DATA = 34962, 34963
_JSON_CHUNK, _BINARY_CHUNK = b"JSON", b"BIN\0"

_SCENE_FROM_LPS = np.array(((1, 0, 0), (0, 0, 1), (0, -1, 0)), dtype=np.float64)
"""Rows X, Y, Z of the scene in terms of L, P, S."""


def _column_major(rotation: np.ndarray, scale: float, origin: np.ndarray | None = None) -> list[float]:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    if origin is not None:
        matrix[:3, 3] = matrix[:3, :3] @ origin
    return [float(value) + 0.0 for value in matrix.T.ravel()]  # + 0.0 turns -0 into 0


def _origin(content: Content) -> np.ndarray:
    """Return the point that the vertices in the buffer are relative to, mm."""
    return np.rint(local_origin(content.vertices)) if content.is_double else np.zeros(3)


def _positions(content: Content) -> np.ndarray:
    vertices = content.vertices - _origin(content) if content.is_double else content.vertices
    return np.ascontiguousarray(vertices, dtype="<f4")


def _document(content: Content | Assembly) -> dict[str, Any]:
    parts = parts_of(content)
    first = parts[0]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    start = 0
    nodes, meshes = [], []
    materials = []
    for number, part in enumerate(parts):
        primitive, start = _describe_part(part, number, start, views, accessors)
        rotation = _SCENE_FROM_LPS @ part.to_lps
        name = part.name or _NAMELESS
        nodes.append({"name": name, "mesh": number, "matrix": _column_major(rotation, _METRES_PER_MM, _origin(part))})
        meshes.append({"name": name, "primitives": [primitive]})
        color = [*BONE_COLOR, 1.0] if part.color is None else [_linear(value) for value in part.color] + [1.0]
        look = {"baseColorFactor": color, "metallicFactor": 0.0, "roughnessFactor": 0.6}
        # Visible from both sides: a surface that is open at the border of the scan shows its inside.
        materials.append({"name": part.name or "bone", "doubleSided": True, "pbrMetallicRoughness": look})
    extras: dict[str, Any] = {
        "SPACE": first.space,
        "unit": "mm",
        f"matrix_to_{first.space}_mm": _column_major((_SCENE_FROM_LPS @ first.to_lps).T, 1.0 / _METRES_PER_MM),
    }
    if first.iso_value_hu is not None:
        extras["iso_value_hu"] = first.iso_value_hu
    if first.inside is not None:
        extras["inside"] = first.inside
    if first.certificate:
        extras["certificate"] = list(first.certificate)
    if names := dict.fromkeys(chain(*(part.values for part in parts))):
        extras["values"] = list(names)
    return {
        "asset": {"version": "2.0", "generator": "clrecon", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(parts)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }


def _linear(value: float) -> float:
    """Return a value of sRGB as glTF wants it: linear."""
    linear = value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
    return round(linear, 6)


def _describe_part(
    content: Content, number: int, start: int, views: list[dict[str, Any]], accessors: list[dict[str, Any]]
) -> tuple[dict[str, Any], int]:
    """Add the views and accessors of a mesh that begins at byte `start`; return its primitive, and where it ends."""

    def add(kind: str, count: int, component: int = _FLOAT, target: int = _VERTEX_DATA, **limits: list[float]) -> int:
        nonlocal start
        length = 4 * _WIDTHS[kind] * count
        view = len(views)
        views.append({"buffer": 0, "byteOffset": start, "byteLength": length, "target": target})
        accessors.append({"bufferView": view, "componentType": component, "count": count, "type": kind, **limits})
        start += length
        return view

    low, high = (
        np.float32(end - _origin(content)) for end in (content.vertices.min(axis=0), content.vertices.max(axis=0))
    )
    count = len(content.vertices)
    attributes = {"POSITION": add("VEC3", count, min=low.tolist(), max=high.tolist())}
    if content.normals is not None:
        attributes["NORMAL"] = add("VEC3", count)
    for name in content.values:
        attributes[f"_{name.upper()}"] = add("SCALAR", count)
    indices = add("SCALAR", content.triangles.size, _UINT32, _INDEX_DATA)
    return {"attributes": attributes, "indices": indices, "material": number, "mode": 4}, start


def _json_chunk(content: Content | Assembly) -> bytes:
    text = json.dumps(_document(content), separators=(",", ":"), allow_nan=False).encode("ascii")
    return text.ljust(-(-len(text) // 4) * 4)


def _binary_length(content: Content | Assembly) -> int:
    return sum(
        (12 + 4 * len(part.values)) * len(part.vertices)
        + (0 if part.normals is None else part.normals.nbytes)
        + part.triangles.nbytes
        for part in parts_of(content)
    )


def estimate(content: Content | Assembly) -> int:
    return 12 + 8 + len(_json_chunk(content)) + 8 + _binary_length(content)


def write(stream: BinaryIO, content: Content | Assembly) -> None:
    """Write header, JSON chunk and binary chunk; each part is a multiple of four bytes long without padding."""
    text = _json_chunk(content)
    stream.write(struct.pack("<4sII", b"glTF", 2, 20 + len(text) + 8 + _binary_length(content)))
    stream.write(struct.pack("<I4s", len(text), _JSON_CHUNK) + text)
    stream.write(struct.pack("<I4s", _binary_length(content), _BINARY_CHUNK))
    for part in parts_of(content):
        stream.write(_positions(part).data)
        if part.normals is not None:
            stream.write(np.ascontiguousarray(part.normals, dtype="<f4").data)
        for values in part.values.values():
            # glTF knows no NaN: a vertex without a number has -1.
            stream.write(np.ascontiguousarray(np.where(np.isfinite(values), values, -1.0), dtype="<f4").data)
        stream.write(np.ascontiguousarray(part.triangles, dtype="<u4").data)


def verify(path: Path, content: Content | Assembly) -> None:
    size = path.stat().st_size
    check_same("bytes", size, estimate(content))
    with path.open("rb") as stream:
        magic, _, length, text_length, kind = struct.unpack("<4sIII4s", stream.read(20))
        check_same("in the header", (magic, length, kind), (b"glTF", size, _JSON_CHUNK))
        text = stream.read(text_length)
        binary = struct.unpack("<I4s", stream.read(8))
    if text != _json_chunk(content):
        raise refuse_file("bytes of JSON differ", len(text), "none")
    check_same("in the second chunk", binary, (_binary_length(content), _BINARY_CHUNK))


_LONGEST_JSON = 1 << 26
_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
_TRIANGLES = 4
_FOR_LOOKS = ("KHR_materials_", "KHR_texture_", "KHR_lights_")
"""Extensions without which places stay the same."""
_LPS_FROM_SCENE = np.array([(1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 0.001)]) * 1000.0


class _File:
    def __init__(self, document: dict[str, Any], binary: bytes):
        self.document, self.binary = document, binary

    def entry(self, kind: str, number: Any) -> dict[str, Any]:
        entries = self.document.get(kind, [])
        if type(number) is not int or not 0 <= number < len(entries) or not isinstance(entries[number], dict):
            raise ValueError(f"{kind} has no number {number!r:.40}")
        item: dict[str, Any] = entries[number]
        return item

    def values(self, number: Any, width: int, kinds: str) -> NDArray[Any]:
        """Return the values of an accessor, shape (count, width)."""
        accessor = self.entry("accessors", number)
        form = _TYPES.get(accessor.get("componentType", 0), "")
        if _WIDTHS.get(accessor.get("type", "")) != width or form[1:2] not in tuple(kinds) or "sparse" in accessor:
            raise ValueError(f"accessor {number} is not of the plain kind that is read")
        view = self.entry("bufferViews", accessor.get("bufferView"))
        if view.get("buffer") != 0 or "uri" in self.entry("buffers", 0):
            raise ValueError("its data are in another file")
        item = np.dtype(form).itemsize
        count, stride = _read_count(accessor, "count"), _read_count(view, "byteStride") or width * item
        start, inside = _read_count(view, "byteOffset"), _read_count(accessor, "byteOffset")
        last = inside + stride * (count - 1) + width * item
        if count and (last > _read_count(view, "byteLength") or start + last > len(self.binary)):
            raise ValueError(f"accessor {number} goes on behind the end of its data")
        shape, strides = (count, width), (stride, item)
        return np.ndarray(shape, form, self.binary, start + inside, strides) if count else np.zeros(shape, form)


def read_mesh(path: Path) -> RawMesh:
    """Read the triangles of a GLB file; those of each node are a part."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            file = _split_chunks(stream.read(), name)
        return _collect_mesh(file, name)
    except (
        OSError, ValueError, TypeError, AttributeError, KeyError, OverflowError, MemoryError, RecursionError,
    ) as error:  # fmt: skip
        raise say_cut(name, error) from error


def _split_chunks(data: bytes, name: str) -> _File:
    if data[:4] != b"glTF" or len(data) < 20:
        raise RefusedInputError(f"{name} is no GLB file: it does not begin with the mark of one")
    version, length, text_length = (int.from_bytes(data[at : at + 4], "little") for at in (4, 8, 12))
    if version != 2:
        raise RefusedInputError(f"{name} is glTF {version}: version 2 is read")
    if length != len(data) or text_length > min(length - 20, _LONGEST_JSON) or data[16:20] != b"JSON":
        raise ValueError(f"{length:,} bytes are needed with {text_length:,} of JSON, it has {len(data):,}")
    document = json.loads(data[20 : 20 + text_length])
    if not isinstance(document, dict):
        raise ValueError("its JSON is no object")
    start = 20 + text_length
    size = int.from_bytes(data[start : start + 4], "little")
    if len(data) > start and (data[start + 4 : start + 8] != b"BIN\0" or start + 8 + size > len(data)):
        raise ValueError("its second chunk is no binary data of its length")
    return _File(document, data[start + 8 : start + 8 + size])


def _collect_mesh(file: _File, name: str) -> RawMesh:
    document = file.document
    needed = [text for text in document.get("extensionsRequired", ()) if not str(text).startswith(_FOR_LOOKS)]
    if needed:
        raise RefusedInputError(f"{name} needs the extension {escape_text(str(needed[0]))}, which is not read")
    extras = document.get("asset", {}).get("extras", {})
    extras = extras if isinstance(extras, dict) else {}
    space = extras.get("SPACE")
    to_patient = _LPS_FROM_SCENE
    if isinstance(space, str) and f"matrix_to_{space}_mm" in extras:
        to_patient = _matrix(extras[f"matrix_to_{space}_mm"])
    else:
        space = None
    shapes, left_out = PlacedShapes(), 0

    names = {f"_{name.upper()}": name for name in extras.get("values", ()) if isinstance(name, str)}

    def visit(number: Any, above: NDArray[np.float64], level: int) -> None:
        nonlocal left_out
        if level > MOST_LEVELS:
            raise ValueError("nodes within themselves")
        shapes.count_step()
        node = file.entry("nodes", number)
        matrix = above @ _place_of(node)
        if "mesh" in node:
            left_out += _add_mesh(file, node, matrix, shapes, names, joins=space is None)
        for child in node.get("children", ()):
            visit(child, matrix, level + 1)

    for number in _roots(file):
        visit(number, to_patient, 0)
    mesh = shapes.joined()
    iso_value = extras.get("iso_value_hu")
    lines = extras.get("certificate", ())
    return RawMesh(
        "GLB",
        mesh.vertices,
        mesh.triangles,
        mesh.normals,
        space,
        iso_value if isinstance(iso_value, float | int) else None,
        [line for line in lines if isinstance(line, str)],
        [f"elements left out: {left_out:,} sets of points or lines"] if left_out else [],
        "m",
        shapes.parts,
        mesh.values,
    )


def _roots(file: _File) -> list[Any]:
    """Return the nodes of the scene that is shown; without scenes those that are no child."""
    if file.document.get("scenes"):
        return list(file.entry("scenes", file.document.get("scene", 0)).get("nodes", ()))
    nodes = file.document.get("nodes", [])
    children = set(chain(*(node.get("children", ()) for node in nodes)))
    return [number for number in range(len(nodes)) if number not in children]


def _add_mesh(
    file: _File,
    node: dict[str, Any],
    matrix: NDArray[np.float64],
    shapes: PlacedShapes,
    names: Mapping[str, str],
    *,
    joins: bool,
) -> int:
    """Add the triangles of a mesh, with the numbers in `names`; return how many of its primitives are none."""
    mesh = file.entry("meshes", node["mesh"])
    name = str(node.get("name") or mesh.get("name") or "")
    if not joins and name == _NAMELESS:
        name = ""
    left_out = 0
    for primitive in mesh.get("primitives", ()):
        mode = primitive.get("mode", _TRIANGLES)
        if mode < _TRIANGLES:
            left_out += 1
            continue
        if mode != _TRIANGLES or primitive.get("targets"):
            raise ValueError("triangle strips, fans and morph targets are not read")
        attributes = primitive["attributes"]
        vertices = file.values(attributes["POSITION"], 3, "f")
        normals = file.values(attributes["NORMAL"], 3, "f") if "NORMAL" in attributes else None
        if normals is not None and len(normals) != len(vertices):
            raise ValueError(f"{len(normals):,} normals for {len(vertices):,} vertices")
        triangles = np.arange(len(vertices))
        if "indices" in primitive:
            triangles = file.values(primitive["indices"], 1, "u").ravel().astype(np.int64)
        if len(triangles) % 3:
            raise ValueError(f"{len(triangles):,} corners are not those of whole triangles")
        columns = {
            name: _known_of(file.values(attributes[attribute], 1, "f")[:, 0])
            for attribute, name in names.items()
            if attribute in attributes
        }
        if any(len(column) != len(vertices) for column in columns.values()):
            raise ValueError(f"not one number for each of {len(vertices):,} vertices")
        shape = Shape(vertices, triangles.reshape(-1, 3), normals, numbers_of(columns))
        shapes.add(
            _joined(shape) if joins else shape, matrix, Part(name, len(shape.triangles), _color(file, primitive))
        )
    return left_out


def _known_of(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return numbers with NaN for -1, which stands for it in columns without other numbers below 0."""
    is_signed = bool(((values < 0.0) & (values != -1.0)).any())
    return values if is_signed else np.where(values == -1.0, np.nan, values)


def _joined(shape: Shape) -> Shape:
    """Join corners that coincide; normals that differ there are left out."""
    if (shape.triangles >= len(shape.vertices)).any():
        raise ValueError(f"a triangle refers to vertex {int(shape.triangles.max()):,} of {len(shape.vertices):,}")
    used = list_distinct(shape.triangles)
    first, inverse = find_places(shape.vertices[used])
    number = np.zeros(len(shape.vertices), np.int64)
    number[used] = inverse
    normals = None if shape.normals is None else shape.normals[used]
    if normals is not None and np.array_equal(normals[first][inverse], normals):
        return Shape(shape.vertices[used][first], number[shape.triangles], normals[first])
    return Shape(shape.vertices[used][first], number[shape.triangles])


def _color(file: _File, primitive: dict[str, Any]) -> tuple[float, float, float] | None:
    """Return the colour of a primitive's material; glTF has it linear."""
    if "material" not in primitive:
        return None
    look = file.entry("materials", primitive["material"]).get("pbrMetallicRoughness", {})
    factor = look.get("baseColorFactor")
    if factor is None or factor[:3] == [*BONE_COLOR]:  # which ours have that have no colour
        return None
    linear = np.clip(np.array(factor[:3], dtype=np.float64), 0.0, 1.0)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    red, green, blue = (round(float(value), 4) for value in curved)
    return red, green, blue


def _place_of(node: dict[str, Any]) -> NDArray[np.float64]:
    """Return the matrix of a node: as it is, or of its translation, rotation and scale."""
    if "matrix" in node:
        return _matrix(node["matrix"])
    matrix = np.eye(4)
    x, y, z, w = (float(value) for value in node.get("rotation", (0, 0, 0, 1)))
    matrix[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _matrix(numbers: Any) -> NDArray[np.float64]:
    return np.array(numbers, dtype=np.float64).reshape(4, 4).T


def _read_count(entry: dict[str, Any], name: str) -> int:
    value = entry.get(name, 0)
    if type(value) is not int or not 0 <= value < 1 << 40:
        raise ValueError(f"{name} is {value!r:.40}")
    return value
