"""GLB, the binary glTF 2.0 (Khronos): one mesh, one node, no textures.

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

from clrecon.exchange.content import Content, refuse_file
from clrecon.system.pieces import local_origin

__all__ = ["estimate", "verify", "write"]

_METRES_PER_MM = 0.001
_FLOAT, _UINT32 = 5126, 5125
_VERTEX_DATA, _INDEX_DATA = 34962, 34963
_JSON_CHUNK, _BINARY_CHUNK = b"JSON", b"BIN\0"
_BONE_COLOUR = [0.89, 0.86, 0.78, 1.0]

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


def _document(content: Content) -> dict[str, Any]:
    low, high = (
        np.float32(end - _origin(content)) for end in (content.vertices.min(axis=0), content.vertices.max(axis=0))
    )
    count, indices = len(content.vertices), content.triangles.size
    attributes = {"POSITION": 0}
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 12 * count, "target": _VERTEX_DATA}]
    accessors: list[dict[str, Any]] = [
        {
            "bufferView": 0,
            "componentType": _FLOAT,
            "count": count,
            "type": "VEC3",
            "min": low.tolist(),
            "max": high.tolist(),
        }
    ]
    if content.normals is not None:
        attributes["NORMAL"] = 1
        views.append({"buffer": 0, "byteOffset": 12 * count, "byteLength": 12 * count, "target": _VERTEX_DATA})
        accessors.append({"bufferView": 1, "componentType": _FLOAT, "count": count, "type": "VEC3"})
    start = 12 * count * len(views)
    views.append({"buffer": 0, "byteOffset": start, "byteLength": 4 * indices, "target": _INDEX_DATA})
    accessors.append({"bufferView": len(views) - 1, "componentType": _UINT32, "count": indices, "type": "SCALAR"})
    rotation = _SCENE_FROM_LPS @ content.to_lps
    extras: dict[str, Any] = {
        "SPACE": content.space,
        "unit": "mm",
        f"matrix_to_{content.space}_mm": _column_major(rotation.T, 1.0 / _METRES_PER_MM),
    }
    if content.iso_value_hu is not None:
        extras["iso_value_hu"] = content.iso_value_hu
    if content.inside is not None:
        extras["inside"] = content.inside
    if content.certificate:
        extras["certificate"] = list(content.certificate)
    material = {"baseColorFactor": _BONE_COLOUR, "metallicFactor": 0.0, "roughnessFactor": 0.6}
    primitive = {"attributes": attributes, "indices": len(views) - 1, "material": 0, "mode": 4}
    return {
        "asset": {"version": "2.0", "generator": "clrecon", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "surface", "mesh": 0, "matrix": _column_major(rotation, _METRES_PER_MM, _origin(content))}],
        "meshes": [{"name": "surface", "primitives": [primitive]}],
        # Visible from both sides: a surface that is open at the border of the scan shows its inside.
        "materials": [{"name": "bone", "doubleSided": True, "pbrMetallicRoughness": material}],
        "buffers": [{"byteLength": start + 4 * indices}],
        "bufferViews": views,
        "accessors": accessors,
    }


def _json_chunk(content: Content) -> bytes:
    text = json.dumps(_document(content), separators=(",", ":"), allow_nan=False).encode("ascii")
    return text.ljust(-(-len(text) // 4) * 4)


def _binary_length(content: Content) -> int:
    normals = 0 if content.normals is None else content.normals.nbytes
    return 12 * len(content.vertices) + normals + content.triangles.nbytes


def estimate(content: Content) -> int:
    """Return the exact size of the file in bytes."""
    return 12 + 8 + len(_json_chunk(content)) + 8 + _binary_length(content)


def write(stream: BinaryIO, content: Content) -> None:
    """Write header, JSON chunk and binary chunk; each part is a multiple of four bytes long without padding."""
    text = _json_chunk(content)
    stream.write(struct.pack("<4sII", b"glTF", 2, 20 + len(text) + 8 + _binary_length(content)))
    stream.write(struct.pack("<I4s", len(text), _JSON_CHUNK) + text)
    stream.write(struct.pack("<I4s", _binary_length(content), _BINARY_CHUNK))
    stream.write(_positions(content).data)
    if content.normals is not None:
        stream.write(np.ascontiguousarray(content.normals, dtype="<f4").data)
    stream.write(np.ascontiguousarray(content.triangles, dtype="<u4").data)


def verify(path: Path, content: Content) -> None:
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
