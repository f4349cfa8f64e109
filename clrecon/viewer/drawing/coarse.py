"""Coarse meshes that are drawn in place of large ones while anything moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh import Mesh
from clrecon.mesh.triangles import vertex_normals

TRIANGLES_A_CELL = 2.0
"""Triangles that a surface leaves in each cell that it passes through."""


def coarsen_mesh(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh with about as many triangles: vertices that share a cell become one, in their mean place.

    It is for pictures alone: thin walls close up, and it is not manifold (Rossignac and Borrel 1993).
    """
    vertices = mesh.vertices.astype(np.float64)
    cell = float(np.sqrt(TRIANGLES_A_CELL * mesh.area / triangles))
    low = vertices.min(axis=0)
    counts = np.floor(np.ptp(vertices, axis=0) / max(cell, 1e-9)).astype(np.int64) + 1
    i, j, k = np.floor((vertices - low) / max(cell, 1e-9)).astype(np.int64).T
    _, group = np.unique((k * counts[1] + j) * counts[0] + i, return_inverse=True)
    group = group.ravel()
    sizes = np.bincount(group)
    places = np.stack([np.bincount(group, vertices[:, axis]) / sizes for axis in range(3)], axis=1)
    joined = group[mesh.triangles]
    a, b, c = joined.T
    kept = joined[(a != b) & (b != c) & (c != a)]
    points = places.astype(mesh.vertices.dtype)
    used = kept.astype(np.uint32)
    return Mesh(points, used, vertex_normals(points, used), dict(mesh.report), trusted=True)


def select_triangles(mesh: Mesh, kept: NDArray[np.bool_]) -> Mesh:
    """Return the mesh with some of its triangles, and the vertices that they need."""
    triangles = mesh.triangles[kept]
    used = np.zeros(mesh.vertex_count, np.bool_)
    used[triangles] = True
    numbers = np.cumsum(used, dtype=np.int64) - 1
    normals = None if mesh.normals is None else mesh.normals[used]
    return Mesh(
        mesh.vertices[used], numbers[triangles].astype(np.uint32), normals, dict(mesh.report), trusted=True
    )  # fmt: skip
