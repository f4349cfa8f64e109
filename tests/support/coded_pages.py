"""What a page of `clrecon.exchange.page` shows, decoded as its script does it: the twin of the coding."""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.exchange.page import BLOCK, NORMAL_SCALE, STEPS, CodedSurface, unpack_planes
from clrecon.exchange.page_slices import PackedSlices

Float64Array = NDArray[np.float64]


def decode_surface(coded: CodedSurface) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices in mm, normals and triangles, as a page shows them."""
    data = unpack_planes(coded)
    n = coded.vertices
    positions = unfold(join_planes(data[: 6 * n], 3, np.uint16), np.uint16)
    turned = unfold(join_planes(data[6 * n : 8 * n], 2, np.uint8), np.uint8).view(np.int8)
    m = 3 * coded.triangles
    lags = data[8 * n : 8 * n + m]
    folded = join_planes(data[8 * n + m : 8 * n + 5 * m], 1, np.uint32)[:, 0].astype(np.int64)
    indices = join_corners(lags, (folded >> 1) ^ -(folded & 1))
    if m and (indices.min() < 0 or indices.max() >= n):
        raise ValueError("the surface has indices without a vertex")
    vertices = np.array(coded.low_mm) + positions.astype(np.float64) * np.array(coded.step_mm)
    return vertices, fold_octahedron(turned / NORMAL_SCALE), indices.reshape(-1, 3).astype(np.uint32)


def join_corners(lags: NDArray[np.uint8], changes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return indices of which each is so far from the one that lies so many back, with 0 from the next new vertex."""
    indices: list[int] = []
    new = 0
    for lag, change in zip(lags.tolist(), changes.tolist(), strict=True):
        if lag > len(indices):
            raise ValueError("the surface has indices without a vertex")
        indices.append((indices[-lag] if lag else new) + change)
        new = max(new, indices[-1] + 1)
    return np.array(indices, dtype=np.int64)


def fold_octahedron(places: Float64Array) -> NDArray[np.float32]:
    """Return the unit vectors (n, 3) of places (n, 2) of a square from -1 to 1."""
    height = 1.0 - np.abs(places).sum(axis=1, keepdims=True)
    normals = np.hstack([places - np.sign(places) * np.maximum(-height, 0.0), height])
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)


def decode_values(facts: dict[str, Any], coded: CodedSurface) -> dict[str, NDArray[np.float64]]:
    """Return the numbers in mm at the vertices of a page by name, NaN where none is known."""
    planes = unpack_planes(coded)[8 * coded.vertices + 15 * coded.triangles :]
    codes = unfold(join_planes(planes, coded.columns, np.uint16), np.uint16).T
    return {
        column["name"]: np.where(own == STEPS, np.nan, column["low"] + column["step"] * own)
        for column, own in zip(facts.get("values", ()), codes, strict=True)
    }


def parse_slices(page: bytes) -> PackedSlices | None:
    """Return the slices that a page of `compose_page` holds, if it has some."""
    blocks = dict(BLOCK.findall(page.decode("utf-8")))
    if "slices" not in blocks:
        return None
    return PackedSlices(json.loads(blocks["facts"])["slices"], base64.b64decode(blocks["slices"], validate=True))


def unfold(folded: NDArray[Any], unsigned: type[np.integer[Any]]) -> NDArray[Any]:
    """Return the rows whose differences a page has."""
    return np.cumsum((folded >> 1) ^ -(folded & 1), axis=0, dtype=unsigned)


def join_planes(planes: NDArray[np.uint8], columns: int, kind: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    stacked = planes.reshape(np.dtype(kind).itemsize, columns, -1)
    return sum((plane.astype(kind) << kind(8 * byte) for byte, plane in enumerate(stacked)), np.zeros((), kind)).T


def unpack_slices(facts: dict[str, Any], data: bytes) -> Float64Array:
    """Return the HU (nk, nj, ni) of packed slices, as a page shows them."""
    ni, nj, nk = facts["shape"]
    planes = np.frombuffer(zlib.decompress(data, wbits=16 + zlib.MAX_WBITS), np.uint8).reshape(2, nk, nj, ni)
    folded = planes[0].astype(np.int32) | (planes[1].astype(np.int32) << 8)
    values = np.cumsum((folded >> 1) ^ -(folded & 1), axis=2)
    return np.asarray(facts["low_hu"] + facts["step_hu"] * values, dtype=np.float64)
