"""Twin of the cell decisions of cl/surface/trilinear.cl: how the trilinear field joins corners inside a cell.

All decisions use whole numbers, so that every device and both cells of a face decide alike.  The heights of the corners
above the iso level, rounded to float32 once, are scaled by a power of two to whole numbers: to 30 bits for a face, by
the largest of its four corners; to 18 bits for the interior, by the largest of the eight.  For voxels of 8 and 16 bits
at an iso level between integers this is exact.  Whether a corner is inside is told by its bit in the case, never by its
height.

Face (Nielson and Hamann 1991): the diagonal corners a, c are joined when the bilinear field is of their sign at its
saddle: ``a c > b d``.  A saddle at the level itself keeps the inside corners apart.

Interior: in the plane at height t between two faces the field is bilinear with corners that are linear in t, and
``Q(t) = a(t) c(t) - b(t) d(t)`` is a parabola.  Where signs alternate around the plane, Q > 0 joins a and c in it,
Q < 0 joins b and d.  Corners that no face joins are joined in the cell when Q changes its sign twice while signs
alternate, that is when its discriminant is above 0 and signs alternate at its vertex.  Any of the three axes gives the
same answer.  The two roots of Q along each axis are planes that hold two straight lines of the surface each: the
sides of the box whose corners are the waist of the tunnel (Grosso 2016).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.proof.surface.case_table import CORNERS, EDGES, FACES, find_ambiguous_faces
from clrecon.proof.surface.trilinear_table import CELL_VERTEX, Row, cell_state, ring_corners

FACE_BITS = 30
CELL_BITS = 18
NEWTON_STEPS = 3
FLAT_SQUARE = 2.0**24
"""Squared gradient below which no Newton step is taken: a 32nd of the largest height per step, or less."""


def scale_heights(heights: Sequence[float], bits: int) -> list[int]:
    """Scale the sizes of float32 numbers to whole numbers below 2^bits by one power of two, rounded towards 0."""
    words = [int(word) for word in np.abs(np.asarray(heights, dtype=np.float32)).view(np.uint32)]
    exponents = [max(word >> 23, 1) for word in words]
    mantissas = [(word & 0x7FFFFF) | (0x800000 if word >> 23 else 0) for word in words]
    largest = max(exponents)
    return [
        mantissa << 32 >> min(56 - bits + largest - exponent, 63)
        for mantissa, exponent in zip(mantissas, exponents, strict=True)
    ]


def decide_faces(case: int, heights: Sequence[float]) -> int:
    """Return the mask of the ambiguous faces that join their diagonal inside corners, by heights over the level."""
    joined = 0
    for face in find_ambiguous_faces(case):
        a, b, c, d = scale_heights([heights[corner] for corner in FACES[face]], FACE_BITS)
        inside, outside = (a * c, b * d) if case >> FACES[face][0] & 1 else (b * d, a * c)
        joined |= (inside > outside) << face
    return joined


@dataclass(frozen=True)
class Parabola:
    """Q of the planes across one axis: ``Q(t) = a t^2 + b t + c``, whole numbers."""

    a: int
    b: int
    discriminant: int


def _columns(axis: int) -> tuple[int, int, int, int]:
    """Return the lower corners of the four edges along an axis, counter-clockwise as seen from above."""
    u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
    return 0, u, u | v, v


def _find_parabola(values: Sequence[int], axis: int) -> Parabola:
    low = [values[corner] for corner in _columns(axis)]
    rise = [values[corner | 1 << axis] - values[corner] for corner in _columns(axis)]
    a = rise[0] * rise[2] - rise[1] * rise[3]
    b = low[0] * rise[2] + low[2] * rise[0] - low[1] * rise[3] - low[3] * rise[1]
    c = low[0] * low[2] - low[1] * low[3]
    return Parabola(a, b, b * b - 4 * a * c)


def _sign_values(case: int, heights: Sequence[float]) -> list[int]:
    """Return the heights as whole numbers of `CELL_BITS` bits with the signs of the case."""
    sizes = scale_heights(heights, CELL_BITS)
    return [size if case >> corner & 1 else -size for corner, size in enumerate(sizes)]


def decide_interior(values: Sequence[int]) -> int | None:
    """Return the code of the tunnel of a cell, by heights as whole numbers, if its faces allow one, or None."""
    z = _find_parabola(values, 2)
    if z.a == 0 or z.discriminant <= 0:
        return None
    # The vertex of the parabola is at `top / bottom`.
    top, bottom = (-z.b if z.a > 0 else z.b), 2 * abs(z.a)
    if not 0 < top < bottom:
        return None
    at_vertex = [values[corner] * bottom + (values[corner | 4] - values[corner]) * top for corner in _columns(2)]
    if at_vertex[0] > 0 and at_vertex[2] > 0 and at_vertex[1] < 0 and at_vertex[3] < 0:
        inside = z.a < 0
    elif at_vertex[0] < 0 and at_vertex[2] < 0 and at_vertex[1] > 0 and at_vertex[3] > 0:
        inside = z.a > 0
    else:
        return None
    # each axis tells which of its columns the tunnel joins
    corner = sum((_find_parabola(values, axis).a > 0) << axis for axis in range(3))
    return int(inside) + 2 * min(corner, 7 - corner)


def find_row(case: int, heights: Sequence[float]) -> Row:
    """Return the triangles of a cell, whose heights over the iso level are float32."""
    state = cell_state(case, decide_faces(case, heights))
    return state.row(decide_interior(_sign_values(case, heights)) if state.tunnels else None)


def _field_at(values: Sequence[int], point: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return the trilinear field and its gradient per step at a point of the cell."""
    weights = np.array([[1.0 - p, p] for p in point])
    value, gradient = 0.0, np.zeros(3)
    for corner, upper in enumerate(CORNERS):
        x, y, z = (weights[axis, upper[axis]] for axis in range(3))
        value += x * y * z * values[corner]
        signs = [1.0 if side else -1.0 for side in upper]
        gradient += values[corner] * np.array([signs[0] * y * z, x * signs[1] * z, x * y * signs[2]])
    return value, gradient


def _place_centre(row: Row, values: Sequence[int], margin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of the surrounding vertices, moved to the surface by some Newton steps."""
    around = []
    for centre, edge, _ in row.triangles:
        if centre == CELL_VERTEX:
            axis, low, high = EDGES[edge]
            rise = values[high] - values[low]
            point = np.array(CORNERS[low], dtype=np.float64)
            point[axis] = 0.5 if rise == 0 else np.clip(-values[low] / rise, margin[axis], 1.0 - margin[axis])
            around.append(point)
    point = np.mean(around, axis=0)
    for _ in range(NEWTON_STEPS):
        value, gradient = _field_at(values, point)
        square = float(gradient @ gradient)
        if square >= FLAT_SQUARE:
            point = np.clip(point - gradient * (value / square), margin, 1.0 - margin)
    return np.asarray(point)


def _place_waist(row: Row, values: Sequence[int], margin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners of the box between the roots of the parabolas, a margin from the faces, two wide."""
    sides = np.empty((3, 2))
    for axis in range(3):
        q = _find_parabola(values, axis)
        half = math.sqrt(max(q.discriminant, 0)) / (2 * abs(q.a)) if q.a else 0.0
        middle = -q.b / (2 * q.a) if q.a else 0.5
        half = min(max(half, margin[axis]), 0.5 - margin[axis])
        middle = min(max(middle, margin[axis] + half), 1.0 - margin[axis] - half)
        sides[axis] = middle - half, middle + half
    corners = [CORNERS[corner] for corner in ring_corners(row.diagonal)]
    return np.array([[sides[axis, upper[axis]] for axis in range(3)] for upper in corners])


def place_cell_vertices(
    row: Row, case: int, heights: Sequence[float], margin: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the vertices inside a cell, at least a margin (3,) from the faces, and the gradients of the trilinear
    field there, both (n, 3), in steps (x, y, z) from corner 0.

    The gradients are up to a common factor; (1, 1, 1) where they vanish.
    """
    values = _sign_values(case, heights)
    if row.cell_vertices == 1:
        points = _place_centre(row, values, margin)[None]
    else:
        points = _place_waist(row, values, margin)[: row.cell_vertices]
    gradients = np.array([_field_at(values, point)[1] for point in points]).reshape(-1, 3)
    gradients[~gradients.any(axis=1)] = 1.0
    return points, gradients
