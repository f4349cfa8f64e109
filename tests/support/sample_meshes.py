"""Small meshes whose figures are known: vertices (n, 3) float64 and triangles (m, 3), outward."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from clrecon.geometry import Volume
from clrecon.mesh import Mesh

Arrays = tuple[np.ndarray, np.ndarray]

CUBE_FACES = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
"""Corner number: bits 0, 1, 2 are x, y, z; each face is counter-clockwise from outside."""


def box(low: Sequence[float] = (0.0, 0.0, 0.0), *, size: Sequence[float] = (1.0, 1.0, 1.0)) -> Arrays:
    """A box of 8 vertices and 12 triangles from its lowest corner on."""
    corners = np.array([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)], dtype=np.float64)
    triangles = [[a, b, c] for a, b, c, d in CUBE_FACES] + [[a, c, d] for a, b, c, d in CUBE_FACES]
    return np.array(low) + corners * np.array(size), np.array(triangles)


def torus(*, rings: int = 15, sides: int = 8, major: float = 20.0, minor: float = 6.0) -> Arrays:
    """A torus about z: 2 * rings * sides triangles, `major` mm to the middle of its tube of `minor` mm."""
    u, v = np.meshgrid(np.arange(rings), np.arange(sides), indexing="ij")
    a, b = 2 * np.pi * u.ravel() / rings, 2 * np.pi * v.ravel() / sides
    radius = major + minor * np.cos(b)
    vertices = np.column_stack([radius * np.cos(a), radius * np.sin(a), minor * np.sin(b)])

    def number(i: Any, j: Any) -> Any:
        return (i % rings * sides + j % sides).ravel()

    one, two, three, four = number(u, v), number(u + 1, v), number(u + 1, v + 1), number(u, v + 1)
    return vertices, np.concatenate([np.column_stack([one, two, three]), np.column_stack([one, three, four])])


def ball(radius: float, *, rings: int = 90) -> Arrays:
    """Return a ball about the origin whose vertices lie on the sphere, `rings` bands from pole to pole."""
    polar = np.linspace(0.0, np.pi, rings + 1)[1:-1, None]
    around = np.linspace(0.0, 2.0 * np.pi, 2 * rings, endpoint=False)
    bands = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0.0 * around], -1)
    vertices = radius * np.concatenate([[(0.0, 0.0, 1.0)], bands.reshape(-1, 3), [(0.0, 0.0, -1.0)]])
    width, last = 2 * rings, len(vertices) - 1
    one = 1 + np.arange(width)
    two = 1 + (np.arange(width) + 1) % width
    caps = [np.stack([0 * one, one, two], axis=1)]
    for band in range(rings - 2):
        a, b = one + band * width, two + band * width
        caps += [np.stack([a, a + width, b], axis=1), np.stack([b, a + width, b + width], axis=1)]
    caps.append(np.stack([0 * one + last, two + (rings - 2) * width, one + (rings - 2) * width], axis=1))
    return vertices, np.concatenate(caps)


def torus_volume_ml(*, rings: int = 15, sides: int = 8, major: float = 20.0, minor: float = 6.0) -> float:
    """Volume within the triangles of `torus`, from its cross sections: independent of the divergence theorem.

    Between two neighbouring half planes lies the ruled solid whose quads are cut along one diagonal; summed over the
    tetrahedra from the axis it is the sum over quads of determinants, here taken with numpy's general routine.
    """
    vertices, triangles = torus(rings=rings, sides=sides, major=major, minor=minor)
    return float(np.linalg.det(vertices[triangles]).sum() / 6000.0)


def moebius(pieces: int = 11) -> Arrays:
    """A Moebius strip, which is no closed surface and has one side."""
    angle = np.arange(pieces) * 2 * np.pi / pieces
    vertices = [
        [(10 + side * np.cos(a / 2)) * np.cos(a), (10 + side * np.cos(a / 2)) * np.sin(a), side * np.sin(a / 2)]
        for a in angle
        for side in (-2.0, 2.0)
    ]
    triangles = []
    for piece in range(pieces):
        a, b = 2 * piece, 2 * piece + 1
        c, d = (2 * piece + 2, 2 * piece + 3) if piece < pieces - 1 else (1, 0)  # joined with a half turn
        triangles += [[a, c, b], [b, c, d]]
    return np.array(vertices), np.array(triangles)


def join(*meshes: Arrays) -> Arrays:
    """Several meshes as one, vertices not shared."""
    vertices, triangles, count = [], [], 0
    for points, faces in meshes:
        vertices.append(points)
        triangles.append(faces + count)
        count += len(points)
    return np.concatenate(vertices), np.concatenate(triangles)


def weld(mesh: Arrays) -> Arrays:
    """Vertices at one place become one."""
    vertices, number = np.unique(mesh[0], axis=0, return_inverse=True)
    return vertices, number.reshape(-1)[mesh[1]]


def sphere(centre: Sequence[float] = (0.0, 0.0, 0.0), *, radius: float = 10.0, rounds: int = 2) -> Arrays:
    """Octahedron, each triangle cut in four `rounds` times, corners pushed out to the sphere."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
    upper = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4]])
    lower = np.array([[2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    triangles = np.concatenate([upper, lower])
    for _ in range(rounds):
        a, b, c = vertices[triangles].transpose(1, 0, 2)
        ab, bc, ca = a + b, b + c, c + a
        ab, bc, ca = (edge / np.linalg.norm(edge, axis=1, keepdims=True) for edge in (ab, bc, ca))
        soup = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]).transpose(0, 2, 1, 3).reshape(-1, 3)
        vertices, number = np.unique(soup.round(12), axis=0, return_inverse=True)
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
        triangles = number.reshape(-1, 3)
    return np.array(centre) + radius * vertices, triangles


def ordered_soup(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Triangles as corner coordinates, free of the order of vertices and triangles; the winding stays.

    Every triangle begins with its smallest corner; shape (m, 9).
    """
    corners = np.asarray(vertices)[np.asarray(triangles)]
    turned = []
    for triangle in corners:
        first = min(range(3), key=lambda corner: tuple(triangle[corner]))
        turned.append(np.roll(triangle, -first, axis=0).ravel())
    soup = np.array(turned).reshape(-1, 9)
    return soup[np.lexsort(soup.T[::-1])]


class LongTable:
    """Has a length and nothing else: what does not refuse it fails at once, and needs no memory."""

    def __init__(self, rows: int):
        self.rows = rows

    def __len__(self) -> int:
        return self.rows


SHEARED = np.array([[0.7, 0.1, 0.2, -25.0], [-0.1, 0.9, 0.4, -30.0], [0.0, 0.05, 2.5, -84.0], [0, 0, 0, 1.0]])
"""Affine of a volume in which no step is along an axis."""


def placed(mesh: Arrays, on: Volume) -> Mesh:
    """A mesh in index coordinates, in the mm of a volume."""
    return Mesh(on.ijk_to_lps(mesh[0]), mesh[1])
