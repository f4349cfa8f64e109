"""A surface as the bytes of a page, and back: the twin of what ``page.js`` does.

Vertices are numbered in the order of their first use, so that most indices are near to the highest one so far.
Positions are 16-bit steps within the bounding box.  Differences of neighbours are small; signs are folded into the
lowest bit (zigzag), and bytes of equal weight stand together (byte planes), which deflate packs best: planes of x, y, z
of the positions (low bytes, then high bytes), of x, y, z of the normals, and four of the indices.
"""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

STEPS = 65_535
"""Steps of a coordinate along a side of the bounding box."""

_NORMAL_SCALE = 127.0
_LEVEL = 6
"""Of deflate: 9 takes four times as long, for files 1.5 % smaller."""


@dataclass(frozen=True, eq=False)
class CodedSurface:
    """A surface as a page holds it.

    vertices, triangles: Counts; vertices that no triangle uses are left out.
    low_mm, step_mm: Lowest corner of the bounding box, and the step of a coordinate along each axis.
    data: gzip of the byte planes.
    """

    vertices: int
    triangles: int
    low_mm: tuple[float, ...]
    step_mm: tuple[float, ...]
    data: bytes

    @property
    def half_step_mm(self) -> float:
        """Largest distance along an axis that the page moves a vertex."""
        return 0.5 * max(self.step_mm)


def encode_surface(
    vertices: NDArray[np.floating], normals: NDArray[np.float32], triangles: NDArray[np.integer]
) -> CodedSurface:
    """Code a surface of at least one triangle.

    vertices: ndarray, shape (n, 3). mm.
    normals: ndarray, shape (n, 3), float32. Unit vectors.
    triangles: ndarray, shape (m, 3), integer. Their order stays.
    """
    order, corners = _renumber(triangles, len(vertices))
    places = vertices[order].astype(np.float64)
    low, high = places.min(axis=0), places.max(axis=0)
    step = (high - low) / STEPS
    scaled = (places - low) / np.where(step > 0.0, step, 1.0)
    positions = np.clip(np.rint(scaled), 0, STEPS).astype(np.uint16)
    turned = np.rint(_NORMAL_SCALE * np.clip(normals[order], -1.0, 1.0)).astype(np.int8)
    highest = np.maximum.accumulate(corners)
    codes = (np.concatenate(([0], highest[:-1] + 1)) - corners).astype(np.uint32)
    planes = [
        *_planes(_fold(positions, np.uint16, np.int16), 2),
        *_planes(_fold(turned.view(np.uint8), np.uint8, np.int8), 1),
        *_planes(codes[:, None], 4),
    ]
    return CodedSurface(
        len(order),
        len(triangles),
        tuple(float(value) for value in low),
        tuple(float(value) for value in step),
        gzip.compress(b"".join(planes), _LEVEL, mtime=0),
    )


def decode_surface(coded: CodedSurface) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices in mm, normals (not of unit length: as they were rounded) and triangles, as a page shows them."""
    try:
        data = np.frombuffer(gzip.decompress(coded.data), np.uint8)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"the data of the surface cannot be unpacked: {error}") from error
    n, corners = coded.vertices, 3 * coded.triangles
    if len(data) != 9 * n + 4 * corners:
        raise ValueError(f"the surface has {len(data):,} bytes, {9 * n + 4 * corners:,} expected")
    positions = _unfold(_join(data[: 6 * n], 3, np.uint16), np.uint16)
    turned = _unfold(_join(data[6 * n : 9 * n], 3, np.uint8), np.uint8).view(np.int8)
    codes = _join(data[9 * n :], 1, np.uint32)[:, 0].astype(np.int64)
    # A code of 0 is a vertex that was not there before: the highest so far is the number of these, less one.
    new = np.cumsum(codes == 0)
    indices = np.concatenate(([0], new[:-1])) - codes
    if len(indices) and (indices.min() < 0 or indices.max() >= n):
        raise ValueError("the surface has indices without a vertex")
    vertices = np.array(coded.low_mm) + positions.astype(np.float64) * np.array(coded.step_mm)
    normals = (turned / np.float32(_NORMAL_SCALE)).astype(np.float32)
    return vertices, normals, indices.reshape(-1, 3).astype(np.uint32)


def _renumber(triangles: NDArray[np.integer], count: int) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Return the used vertices in the order of their first use, and the corners as numbers in that order."""
    corners = triangles.reshape(-1).astype(np.int64)
    first = np.full(count, -1, dtype=np.int64)
    first[corners[::-1]] = np.arange(len(corners) - 1, -1, -1)  # of equal indices the last assignment stays
    used = np.flatnonzero(first >= 0)
    order = used[np.argsort(first[used], kind="stable")]
    number = np.empty(count, dtype=np.int64)
    number[order] = np.arange(len(order))
    return order, number[corners]


def _fold(values: NDArray[Any], unsigned: type[np.integer[Any]], signed: type[np.integer[Any]]) -> NDArray[Any]:
    """Return differences of neighbouring rows with the sign in the lowest bit."""
    first = np.zeros((1, values.shape[1]), dtype=unsigned)
    changes = np.diff(values, axis=0, prepend=first).view(signed)
    bits = 8 * changes.itemsize
    return ((changes << 1) ^ (changes >> (bits - 1))).view(unsigned)


def _unfold(folded: NDArray[Any], unsigned: type[np.integer[Any]]) -> NDArray[Any]:
    """Return the rows whose differences `_fold` gave."""
    changes = (folded >> 1) ^ -(folded & 1)
    return np.cumsum(changes, axis=0, dtype=unsigned)


def _planes(values: NDArray[Any], count: int) -> list[bytes]:
    """Return `count` planes of bytes, the lowest first, of each column in turn."""
    return [((values >> (8 * byte)) & 0xFF).astype(np.uint8).T.tobytes() for byte in range(count)]


def _join(planes: NDArray[np.uint8], columns: int, kind: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """Return the rows of which `_planes` made bytes."""
    stacked = planes.reshape(np.dtype(kind).itemsize, columns, -1)
    return sum((plane.astype(kind) << kind(8 * byte) for byte, plane in enumerate(stacked)), np.zeros((), kind)).T
