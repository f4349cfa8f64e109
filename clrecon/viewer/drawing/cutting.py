"""Meshes and clouds cut by planes; the cut of a mesh stays open, as in pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh import Mesh
from clrecon.rendering.views.clip import Clip
from clrecon.viewer.drawing.coarse import select_triangles


def cut_mesh(mesh: Mesh, clip: Clip) -> Mesh:
    """Return the part of a mesh within a clip; triangles across a plane are cut at it."""
    for plane in clip.planes:
        mesh = _cut(mesh, plane)
    return mesh


def _cut(mesh: Mesh, plane: NDArray[np.float64]) -> Mesh:
    """Cut by one plane.

    Of a triangle across the plane one corner is alone on its side.  Turned so that it comes first, the triangle is cut
    along two of its edges, and what is kept is a triangle or the rest, made of two.
    """
    heights = mesh.vertices @ plane[:3] - plane[3]
    inside = heights >= 0.0
    corners = inside[mesh.triangles]
    count = corners.sum(axis=1)
    if (count == 3).all():
        return mesh
    across = mesh.triangles[(count == 1) | (count == 2)].astype(np.int64)
    kept = corners[(count == 1) | (count == 2)]
    alone = np.argmax(np.where((kept.sum(axis=1) == 1)[:, None], kept, ~kept), axis=1)
    turned = np.take_along_axis(across, (alone[:, None] + np.arange(3)) % 3, axis=1)
    edges = np.sort(turned[:, [0, 1, 0, 2]].reshape(-1, 2), axis=1)
    keys, which = np.unique(edges[:, 0] * mesh.vertex_count + edges[:, 1], return_inverse=True)
    first, second = keys // mesh.vertex_count, keys % mesh.vertex_count
    share = (heights[first] / (heights[first] - heights[second]))[:, None]

    def between(values: NDArray) -> NDArray:
        return np.concatenate([values, (values[first] + share * (values[second] - values[first])).astype(values.dtype)])

    cuts = which.reshape(-1, 2) + mesh.vertex_count
    is_corner = kept.sum(axis=1) == 1
    a, b, c = turned.T
    p, q = cuts.T
    made = [
        mesh.triangles[count == 3],
        np.stack([a, p, q], axis=1)[is_corner],
        np.stack([p, b, c], axis=1)[~is_corner],
        np.stack([p, c, q], axis=1)[~is_corner],
    ]
    triangles = np.concatenate(made).astype(np.uint32)
    normals = None if mesh.normals is None else between(mesh.normals)
    joined = Mesh(between(mesh.vertices), triangles, normals, dict(mesh.report), trusted=True)
    return select_triangles(joined, np.ones(len(triangles), np.bool_))
