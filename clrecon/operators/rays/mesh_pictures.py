"""Meshes with their looks, in the form in which a device draws them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.mesh import Mesh
from clrecon.mesh.normals import vertex_normals
from clrecon.operators.rays.triangles import MOST_TRIANGLES, MeshPart
from clrecon.rendering.pictures.mesh_look import MeshLook
from clrecon.system.text import format_digits

FARTHEST_MM = 1e9
"""Largest coordinate of a vertex: a thousand kilometres, as of cameras; products of two fit float32."""

SMALLEST_SIDE_MM = 1e-3
"""Least side of the box of an object, so that a camera has a direction to look in and a height."""


def mesh_corners(mesh: Mesh) -> Float64Array:
    """Return the lowest and the highest corner of the box around the triangles of a mesh, (2, 3) in LPS mm."""
    mesh.check()
    if not mesh.triangle_count:
        raise UsageError("the mesh has no triangles: there is nothing to show")
    used = np.zeros(mesh.vertex_count, dtype=bool)
    used[mesh.triangles.ravel()] = True
    vertices = mesh.vertices if used.all() else mesh.vertices[used]
    corners = np.array([vertices.min(axis=0), vertices.max(axis=0)], dtype=np.float64)
    if np.abs(mesh.vertices).max() > FARTHEST_MM:
        raise UsageError(
            f"vertices of the mesh lie up to {format_digits(np.abs(mesh.vertices).max())} mm from the origin:"
            f" pictures show what is within {FARTHEST_MM / 1e6:,.0f} kilometres"
        )
    return corners


def box_around(corners: Sequence[Float64Array] | NDArray[np.float64]) -> Grid:
    """Return the box of points as a grid of one voxel, which `Camera.fit` places a camera for.

    corners: array_like, shape (n, 3). LPS mm.
    """
    points = np.concatenate([np.atleast_2d(each) for each in corners])
    low, high = points.min(axis=0), points.max(axis=0)
    affine = np.diag([*np.maximum(high - low, SMALLEST_SIDE_MM), 1.0])
    affine[:3, 3] = 0.5 * (low + high)
    return Grid(np.zeros((1, 1, 1), np.int8), affine)


def make_part(mesh: Mesh, look: MeshLook) -> MeshPart:
    """Return a mesh with its look; what was checked by `mesh_corners` is not checked again."""
    if mesh.triangle_count > MOST_TRIANGLES:
        raise UsageError(f"a picture shows at most {MOST_TRIANGLES:,} triangles, the mesh has {mesh.triangle_count:,}")
    colors: NDArray[np.uint8] | None = None
    if look.vertex_colors is not None:
        given = np.asarray(look.vertex_colors)
        if len(given) != mesh.vertex_count:
            raise UsageError(f"{len(given)} colours for {mesh.vertex_count} vertices: one a vertex is needed")
        colors = np.full((len(given), 4), 255, np.uint8)
        colors[:, :3] = given
    vertices, base = mesh.vertices, np.zeros(3)
    if vertices.dtype != np.float32:
        base = np.rint(0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))
        vertices = (vertices - base).astype(np.float32)
    normals: NDArray[np.float32] | None = None
    if not look.flat and look.light.shades:
        normals = vertex_normals(mesh.vertices, mesh.triangles) if mesh.normals is None else mesh.normals
    planes = np.zeros((0, 4)) if look.clip is None else look.clip.planes
    return MeshPart(
        vertices, mesh.triangles, normals, tuple(look.rgb.tolist()), colors, look.opacity, look.light, planes, base
    )  # fmt: skip
