"""GLB, the binary glTF 2.0 (Khronos): a node with a mesh for each part, no textures.

The buffer holds the vertices in patient millimetres without change, so that nothing is lost.  Far from the origin,
where float32 is too coarse, the centre of their bounds is subtracted, and the matrix adds it again.  The matrix of the
node maps them to the frame that glTF prescribes (metres, right-handed, Y up, the front facing +Z):

    (X, Y, Z) = 0.001 (L, S, -P)

The head is up and the face is towards the viewer.  The matrix is a rotation times a scale, which keeps the winding.
``asset.extras`` has the inverse matrix (column-major, as glTF writes matrices), the frame, the unit and the
certificate.  Own code, because this matrix and the extras matter most and the format takes only a page.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from clrecon.exchange.content import BONE_COLOR, Assembly, Content, parts_of, refuse_file
from clrecon.system.pieces import local_origin

NAMELESS = "surface"
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
    """Return the vertices of the buffer, float32."""
    vertices = content.vertices - _origin(content) if content.is_double else content.vertices
    return np.ascontiguousarray(vertices, dtype="<f4")


def _document(content: Content | Assembly) -> dict[str, Any]:
    parts = parts_of(content)
    first = parts[0]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    start = 0
    nodes, meshes, materials = [], [], []
    for number, part in enumerate(parts):
        primitive, start = _describe_part(part, number, start, views, accessors)
        rotation = _SCENE_FROM_LPS @ part.to_lps
        name = part.name or NAMELESS
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
    low, high = (
        np.float32(end - _origin(content)) for end in (content.vertices.min(axis=0), content.vertices.max(axis=0))
    )
    count, indices = len(content.vertices), content.triangles.size
    attributes = {"POSITION": len(views)}
    views.append({"buffer": 0, "byteOffset": start, "byteLength": 12 * count, "target": _VERTEX_DATA})
    accessors.append(
        {
            "bufferView": len(views) - 1,
            "componentType": _FLOAT,
            "count": count,
            "type": "VEC3",
            "min": low.tolist(),
            "max": high.tolist(),
        }
    )
    start += 12 * count
    if content.normals is not None:
        attributes["NORMAL"] = len(views)
        views.append({"buffer": 0, "byteOffset": start, "byteLength": 12 * count, "target": _VERTEX_DATA})
        accessors.append({"bufferView": len(views) - 1, "componentType": _FLOAT, "count": count, "type": "VEC3"})
        start += 12 * count
    views.append({"buffer": 0, "byteOffset": start, "byteLength": 4 * indices, "target": _INDEX_DATA})
    accessors.append({"bufferView": len(views) - 1, "componentType": _UINT32, "count": indices, "type": "SCALAR"})
    primitive = {"attributes": attributes, "indices": len(views) - 1, "material": number, "mode": 4}
    return primitive, start + 4 * indices


def _json_chunk(content: Content | Assembly) -> bytes:
    text = json.dumps(_document(content), separators=(",", ":"), allow_nan=False).encode("ascii")
    return text.ljust(-(-len(text) // 4) * 4)


def _binary_length(content: Content | Assembly) -> int:
    return sum(
        12 * len(part.vertices) + (0 if part.normals is None else part.normals.nbytes) + part.triangles.nbytes
        for part in parts_of(content)
    )


def estimate(content: Content | Assembly) -> int:
    """Return the exact size of the file in bytes."""
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
        stream.write(np.ascontiguousarray(part.triangles, dtype="<u4").data)


def verify(path: Path, content: Content | Assembly) -> None:
    """Check lengths, matrix and counts of a finished file."""
    size = path.stat().st_size
    if size != estimate(content):
        raise refuse_file("bytes", size, estimate(content))
    with path.open("rb") as stream:
        magic, _, length, text_length, kind = struct.unpack("<4sIII4s", stream.read(20))
        if (magic, length, kind) != (b"glTF", size, _JSON_CHUNK):
            raise refuse_file("in the header", (magic, length, kind), (b"glTF", size, _JSON_CHUNK))
        text = stream.read(text_length)
        binary = struct.unpack("<I4s", stream.read(8))
    if text != _json_chunk(content):
        raise refuse_file("bytes of JSON differ", len(text), "none")
    if binary != (_binary_length(content), _BINARY_CHUNK):
        raise refuse_file("in the second chunk", binary, (_binary_length(content), _BINARY_CHUNK))
