"""Shapes of a file at their places: what readers of files with objects and transforms share."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clrecon.exchange.meshes.raw_mesh import Part

MOST_LEVELS = 32
"""Most levels of objects within objects; more are refused, as is an object within itself."""

MOST_SHAPES = 10_000
"""Most shapes of a file: a few lines of objects within objects can ask for any number."""

_MOST_CORNERS = 1 << 30
"""Most corners of triangles: as for `MOST_SHAPES`."""

_SNAP = 1e-12
"""Numbers of a rotation this close to a whole one are that: two matrices that undo each other change no vertex."""


@dataclass(frozen=True)
class Shape:
    """Triangles in a frame of their own.

    vertices: ndarray, shape (n, 3), float32 or float64
    triangles: ndarray, shape (m, 3), integer. Perhaps of vertices that are not there.
    normals: ndarray, shape (n, 3), float32, or None
    """

    vertices: NDArray[np.floating]
    triangles: NDArray[np.integer]
    normals: NDArray[np.float32] | None = None


@dataclass
class PlacedShapes:
    """Collects shapes at their places."""

    parts: list[Part] = field(default_factory=list)
    _vertices: list[NDArray[np.floating]] = field(default_factory=list)
    _triangles: list[NDArray[np.int64]] = field(default_factory=list)
    _normals: list[NDArray[np.float32] | None] = field(default_factory=list)
    _count: int = 0
    _corners: int = 0
    _steps: int = 0

    def count_step(self) -> None:
        """Count an object that was looked at; ValueError where that does not end."""
        self._steps += 1
        if self._steps > 10 * MOST_SHAPES:
            raise ValueError(f"more than {10 * MOST_SHAPES:,} objects within objects")

    def add(self, shape: Shape, matrix: NDArray[np.float64], part: Part) -> None:
        """Add a shape that `matrix`, shape (4, 4), places; a mirror turns its triangles round."""
        self._corners += max(shape.triangles.size, shape.vertices.size)
        if len(self.parts) == MOST_SHAPES or self._corners > _MOST_CORNERS:
            raise ValueError(f"more than {MOST_SHAPES:,} shapes or {_MOST_CORNERS:,} corners")
        if not np.isfinite(matrix).all() or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
            raise ValueError("a transform that is no affine of finite numbers")
        turn = matrix[:3, :3]
        whole = np.rint(turn)
        turn = np.where(np.abs(turn - whole) <= _SNAP * max(1.0, float(np.abs(turn).max())), whole, turn)
        determinant = np.linalg.det(turn)
        if determinant == 0.0:
            raise ValueError("a transform that makes everything flat")
        is_moved = not (np.array_equal(turn, np.eye(3)) and not matrix[:3, 3].any())
        vertices = shape.vertices @ turn.T + matrix[:3, 3] if is_moved else shape.vertices
        triangles = shape.triangles if determinant > 0.0 else shape.triangles[:, ::-1]
        self._vertices.append(vertices)
        # A number that no vertex has must not become one of the next shape.
        wrong = (triangles < 0) | (triangles >= len(vertices))
        if wrong.any():
            raise ValueError(f"a triangle refers to vertex {int(triangles[wrong][0]):,} of {len(vertices):,}")
        self._triangles.append(triangles.astype(np.int64) + self._count)
        self._normals.append(_turned(shape.normals, np.linalg.inv(turn).T if is_moved else None))
        self._count += len(vertices)
        self.parts.append(part)

    def joined(self) -> Shape:
        """Return all shapes as one; with normals where each of them has some."""
        if not self.parts:
            return Shape(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
        normals = [each for each in self._normals if each is not None]
        return Shape(
            np.concatenate(self._vertices),
            np.concatenate(self._triangles),
            np.concatenate(normals) if len(normals) == len(self._normals) else None,
        )


def _turned(normals: NDArray[np.float32] | None, turn: NDArray[np.float64] | None) -> NDArray[np.float32] | None:
    if normals is None or turn is None:
        return normals
    turned = normals @ turn.T
    length = np.linalg.norm(turned, axis=1, keepdims=True)
    return np.divide(turned, length, out=np.zeros_like(turned), where=length > 0).astype(np.float32)
