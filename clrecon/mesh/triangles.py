"""Areas and volumes of triangles, computed in pieces that fit the processor's cache."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clrecon.system.pieces import CHUNK, chunks, local_origin


def corner_edges(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], origin: NDArray[np.float64], size: int = CHUNK
) -> Iterator[tuple[slice, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the first corner of the triangles and the two edges from it, float64, `size` triangles at a time.

    Differences of float32 coordinates and their products are exact in float64.

    Yields:
    where: The triangles of this piece.
    corner, p, q: ndarray, shape (3, k), float64. One row each for x, y, z, mm; `corner` is relative to `origin`, `p` is
        the edge to the second corner, `q` to the third.
    """
    columns = np.ascontiguousarray(vertices.T.astype(np.float64))
    for where in chunks(len(triangles), size):
        a, b, c = triangles[where].T.astype(np.intp)
        # "clip" is three times as fast as numpy's default check; callers have checked the indices.
        corner, p, q = (np.take(columns, index, axis=1, mode="clip") for index in (a, b, c))
        p -= corner
        q -= corner
        corner -= origin[:, None]
        yield where, corner, p, q


def cross_product(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross product of vectors in columns, shape (3, k)."""
    cross = np.empty_like(p)
    cross[0] = p[1] * q[2] - p[2] * q[1]
    cross[1] = p[2] * q[0] - p[0] * q[2]
    cross[2] = p[0] * q[1] - p[1] * q[0]
    return cross


def cross_products(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], origin: NDArray[np.float64], size: int = CHUNK
) -> Iterator[tuple[slice, NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the first corner of the triangles and the cross product of the edges from it, float64, `size` at a time.

    The cross product c of the edges from the first corner a is twice the area times the outward normal, and a . c is
    six times the signed volume of the tetrahedron over the origin (divergence theorem). With float32 coordinates, c is
    zero exactly for triangles without area.

    Yields:
    where: The triangles of this piece.
    corner, cross: ndarray, shape (3, k), float64. One row each for x, y, z; `corner` is relative to `origin`, mm;
        `cross` is mm2.
    """
    for where, corner, p, q in corner_edges(vertices, triangles, origin, size):
        yield where, corner, cross_product(p, q)


def enclosed_ml(vertices: NDArray[np.floating], triangles: NDArray[np.uint32]) -> float:
    """Return the volume that a closed mesh encloses, in ml, signed: cavities count negative."""
    pieces = cross_products(vertices, triangles, local_origin(vertices))
    return float(sum(float(np.einsum("ij,ij->", corner, cross)) for _, corner, cross in pieces)) / 6000.0
