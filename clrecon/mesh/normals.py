"""Normals of vertices, computed from the faces around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.triangles import corner_edges, cross_product


def vertex_normals(vertices: NDArray[np.floating], triangles: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Return the mean of the face normals, weighted by the angle of each face at the vertex.

    These normals do not depend on how the surface is divided into triangles (Thuermer and Wuethrich 1998).

    vertices: ndarray, shape (n, 3), float32 or float64
    triangles: ndarray, shape (m, 3), uint32

    Returns: ndarray, shape (n, 3), float32. Unit vectors; (0, 0, 1) where a vertex has no face or its faces cancel.
    """
    total = np.zeros((3, len(vertices)))
    for where, _, p, q in corner_edges(vertices, triangles, np.zeros(3)):
        cross = cross_product(p, q)
        twice_area = np.sqrt(np.einsum("ij,ij->j", cross, cross))
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = np.where(twice_area > 0.0, cross / twice_area, 0.0)
        third = q - p
        dots = (
            np.einsum("ij,ij->j", p, q),
            -np.einsum("ij,ij->j", p, third),
            np.einsum("ij,ij->j", q, third),
        )
        corners = triangles[where].T
        low = int(corners.min())
        size = int(corners.max()) - low + 1
        for corner, dot in zip(corners, dots, strict=True):
            angle = np.arctan2(twice_area, dot)
            for axis in range(3):
                total[axis, low : low + size] += np.bincount(corner - low, cross[axis] * angle, size)
    length = np.sqrt(np.einsum("ij,ij->j", total, total))
    flat = length == 0.0
    total[:, flat] = np.array([[0.0], [0.0], [1.0]])
    length[flat] = 1.0
    return np.ascontiguousarray((total / length).T, dtype=np.float32)
