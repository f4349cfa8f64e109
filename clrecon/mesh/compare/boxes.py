"""Whether triangles meet boxes: the exact test by separating axes.

Reference: Akenine-Moller 2001, "Fast 3D triangle-box overlap testing", Journal of Graphics Tools 6(1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def meets_box(corners: NDArray[np.float64], half: float) -> NDArray[np.bool_]:
    """Mark triangles that meet a cube around the origin, its faces included.

    Two convex bodies are apart exactly where their shadows on one of 13 lines are: the normals of the cube's faces, the
    normal of the triangle, and the cross products of its edges with those of the cube.

    corners: ndarray, shape (n, 3, 3), float64. Triangle, corner, axis; each triangle relative to the middle of its
        cube.
    half: Half the length of the cube's edges.

    Returns: ndarray, shape (n,), bool
    """
    x = np.ascontiguousarray(corners.transpose(1, 2, 0))  # corner, axis, triangle
    meets = ((x.min(axis=0) <= half) & (x.max(axis=0) >= -half)).all(axis=0)
    edges = x[[1, 2, 0]] - x
    normal = np.cross(edges[0], edges[1], axis=0)
    meets &= np.abs(np.einsum("an,an->n", normal, x[0])) <= half * np.abs(normal).sum(axis=0)
    for edge in range(3):
        third = x[(edge + 2) % 3]
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            # The shadow of both ends of the edge is one point.
            eu, ev = edges[edge, u], edges[edge, v]
            one = eu * x[edge, v] - ev * x[edge, u]
            other = eu * third[v] - ev * third[u]
            reach = half * (np.abs(eu) + np.abs(ev))
            meets &= (np.minimum(one, other) <= reach) & (np.maximum(one, other) >= -reach)
    return np.asarray(meets)
