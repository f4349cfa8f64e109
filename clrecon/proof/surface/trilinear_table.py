"""Triangles of a cell whose ambiguous faces and interior are resolved as in the trilinear field; derived, not typed.

Cases, corners, edges and faces are those of `clrecon.proof.surface.case_table`. The case leaves open:

- each ambiguous face: whether its two diagonal inside corners are joined on it (the asymptotic decider), and
- the interior: whether a tunnel runs through it.  Corners of one sign that the faces leave apart can be joined inside
  the cell.  Two loops then bound one tube in place of two discs.

A tunnel runs along a diagonal of the cell, from corner p to corner 7 - p.  It joins two regions of one sign: whatever
the axis, the cell's edge at p reaches the first and the edge at 7 - p the second, and between them lies one region of
the other sign that the two remaining edges along that axis reach, and that goes round the diagonal, so that it contains
neither of its ends.  This gives 160 tunnels: those of the cases 4.2, 6.1.2, 7.4.2, 10.1.2, 12.1.2 and 13.5.2 of
Chernyaev.

A disc is cut into triangles by chords that lie in no face, as in the case table, whose triangles are taken where
the loops are the same (or those of the complement, turned round).  Some loops of 8, all of 9 and some of 12 edges have
no such chords: they take a fan around one vertex inside the cell.  A tube is cut at its waist, a hexagon of six
vertices inside the cell: the surface of every trilinear field with a tunnel holds a hexagon of straight lines along
the axes, whose corners are six of the eight corners of a box, all but the two on the tunnel's diagonal.

So no chord and no inner vertex of a cell lies in a face or affects a neighbour.  Surfaces are manifold whatever the
decisions are, as long as both cells of a face decide alike.

Twin of the cell decisions of cl/surface/trilinear.cl, by which the trilinear field joins corners inside a cell:

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

References: Nielson and Hamann 1991 (faces); Chernyaev 1995 (interiors); Grosso 2016 (the hexagon).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clrecon.proof.surface.case_table import (
    CORNERS,
    EDGES,
    FACES,
    FACES_OF_EDGE,
    Triangle,
    case_loops,
    case_table,
    find_ambiguous_faces,
)

CELL_VERTEX = 12
"""Numbers in a triangle from here on are vertices inside the cell; lower numbers are edges."""

MAX_TRILINEAR_TRIANGLES = 22
"""Most triangles of a cell: case 13.5.2."""

Loop = tuple[int, ...]


@dataclass(frozen=True)
class Tunnel:
    """A tube between corners `diagonal` and ``7 - diagonal``, loops at its ends; joins inside corners if `inside`."""

    inside: bool
    diagonal: int
    loops: tuple[Loop, Loop]

    @property
    def code(self) -> int:
        """Code of the tunnel, 0 to 7, for tables."""
        return int(self.inside) + 2 * self.diagonal


@dataclass(frozen=True)
class Row:
    """Triangles of a cell, as triples of edges and, from `CELL_VERTEX` on, of vertices inside the cell.

    A triangle with a central vertex (`cell_vertices` is 1) starts with it.  The six of a tunnel are numbered as
    `ring_corners` has them.
    """

    triangles: tuple[Triangle, ...]
    cell_vertices: int = 0
    diagonal: int = 0


@dataclass(frozen=True)
class CellState:
    """A case with decided faces: its row without a tunnel, and one row for each possible tunnel."""

    case: int
    joined: int
    plain: Row
    tunnels: tuple[tuple[Tunnel, Row], ...]

    def row(self, code: int | None) -> Row:
        """Return the row for the tunnel of that code; the row without a tunnel for None or an impossible tunnel."""
        return next((row for tunnel, row in self.tunnels if tunnel.code == code), self.plain)


def ring_corners(diagonal: int) -> list[int]:
    """Return the corners of the box that are a tunnel's vertices, in order."""
    return [corner for corner in range(8) if corner not in (diagonal, 7 - diagonal)]


def find_regions(case: int, joined: int) -> list[int]:
    """Return for each corner the lowest corner that it is joined to on the cell's boundary."""
    region = list(range(8))

    def join_corners(a: int, b: int) -> None:
        low, high = sorted((region[a], region[b]))
        region[:] = [low if r == high else r for r in region]

    for _, low, high in EDGES:
        if case >> low & 1 == case >> high & 1:
            join_corners(low, high)
    for face in find_ambiguous_faces(case):
        a, b, c, d = FACES[face]
        first_joined = (joined >> face & 1) == (case >> a & 1)
        join_corners(*((a, c) if first_joined else (b, d)))
    return region


def _find_tunnels(case: int, joined: int) -> list[Tunnel]:
    """Return the tunnels that a state can have, by the rule at the head of this module."""
    region = find_regions(case, joined)
    inside = {corner: bool(case >> corner & 1) for corner in range(8)}
    loops = [tuple(loop) for loop in case_loops(case, joined)]
    tunnels = []
    for start, first, last in product(range(4), set(region), set(region)):
        if first == last or inside[first] != inside[last]:
            continue
        end = 7 - start
        around = {r for r in region if inside[r] != inside[first]} - {region[start], region[end]}
        for axis in (1, 2, 4):
            ends = ({region[corner], region[corner ^ axis]} for corner in (start, end))
            if not all(wanted in reached for wanted, reached in zip((first, last), ends, strict=True)):
                break
            others = {corner & ~axis for corner in range(8)} - {start & ~axis, end & ~axis}
            for corner in others:
                around &= {region[corner], region[corner | axis]}
        else:
            for middle in around:
                ends_at = [_loop_between(loops, region, middle, side) for side in (first, last)]
                tunnels.append(Tunnel(inside[first], start, (ends_at[0], ends_at[1])))
    return tunnels


def _loop_between(loops: list[Loop], region: list[int], a: int, b: int) -> Loop:
    candidates = [loop for loop in loops if {region[corner] for corner in EDGES[loop[0]][1:]} == {a, b}]
    (loop,) = candidates
    return loop


@cache
def _cut_disc(loop: Loop) -> tuple[tuple[Triangle, ...], ...]:
    """Return all ways to cut a loop into triangles by chords that lie in no face of the cell."""
    if len(loop) == 3:
        return ((loop,),)  # type: ignore[return-value]
    ways: list[tuple[Triangle, ...]] = []
    for apex in range(1, len(loop) - 1):
        parts: list[tuple[tuple[Triangle, ...], ...]] = []
        for part in (loop[: apex + 1], loop[apex:]):
            if len(part) == 2:
                parts.append(((),))
            elif FACES_OF_EDGE[part[0]] & FACES_OF_EDGE[part[-1]]:
                parts.append(())
            else:
                parts.append(_cut_disc(part))
        ways.extend((*before, (loop[0], loop[apex], loop[-1]), *after) for before, after in product(*parts))
    return tuple(ways)


def _place_vertex(vertex: int, diagonal: int = 0) -> tuple[int, int, int]:
    """Return the place of a vertex in a model cell of 20 units: edges at their middles, a tunnel's box 6 units wide."""
    if vertex >= CELL_VERTEX:
        x, y, z = CORNERS[ring_corners(diagonal)[vertex - CELL_VERTEX]]
        return 7 + 6 * x, 7 + 6 * y, 7 + 6 * z
    _, low, high = EDGES[vertex]
    x, y, z = (10 * (a + b) for a, b in zip(CORNERS[low], CORNERS[high], strict=True))
    return x, y, z


def _squared_length(a: int, b: int, diagonal: int = 0) -> int:
    return sum((p - q) ** 2 for p, q in zip(_place_vertex(a, diagonal), _place_vertex(b, diagonal), strict=True))


def _squared_chords(triangles: Iterable[Triangle]) -> int:
    return sum(_squared_length(a, b) + _squared_length(b, c) + _squared_length(c, a) for a, b, c in triangles)


def _known_discs(case: int) -> dict[Loop, tuple[Triangle, ...]]:
    """Return the loops of a case and of its complement, turned round, with the triangles of the case table."""
    known = {}
    for source, turned in ((255 - case, True), (case, False)):
        for loop in case_loops(source):
            triangles = tuple(t for t in case_table()[source] if set(t) <= set(loop))
            if turned:
                loop = [loop[0], *loop[:0:-1]]
                triangles = tuple((c, b, a) for a, b, c in triangles)
            known[_from_lowest(loop)] = triangles
    return known


def _from_lowest(loop: list[int] | Loop) -> Loop:
    start = loop.index(min(loop))
    return (*loop[start:], *loop[:start])


def _fill_discs(case: int, loops: list[Loop]) -> Row:
    known = _known_discs(case)
    triangles: list[Triangle] = []
    cell_vertices = 0
    for loop in loops:
        if loop in known:
            triangles += known[loop]
        elif ways := _cut_disc(loop):
            triangles += min(ways, key=_squared_chords)
        else:
            triangles += [(CELL_VERTEX, a, b) for a, b in zip(loop, (*loop[1:], loop[0]), strict=True)]
            cell_vertices += 1
    return Row(tuple(triangles), cell_vertices)


def _fill_strip(outer: Loop, inner: Loop, diagonal: int) -> tuple[int, tuple[Triangle, ...]]:
    """Make the strip between rings of equal direction with the shortest rungs; return their squared lengths too."""
    back = inner[::-1]
    n, m = len(outer), len(inner)
    best: tuple[int, tuple[Triangle, ...]] | None = None
    for turn in range(m):
        ring = back[turn:] + back[:turn]
        # Shortest path from rung (0, 0) to rung (n, m), where each step advances by one on one of the rings.
        ways: dict[tuple[int, int], tuple[int, tuple[Triangle, ...]]] = {(0, 0): (0, ())}
        for i, j in product(range(n + 1), range(m + 1)):
            a, b = outer[i % n], ring[-j % m]
            options = []
            if i and (i - 1, j) in ways:
                length, triangles = ways[i - 1, j]
                options.append((length, (*triangles, (outer[i - 1], a, b))))
            if j and (i, j - 1) in ways:
                length, triangles = ways[i, j - 1]
                options.append((length, (*triangles, (b, ring[-(j - 1) % m], a))))
            if options:
                length, triangles = min(options)
                ways[i, j] = (length + _squared_length(a, b, diagonal), triangles)
        best = ways[n, m] if best is None else min(best, ways[n, m])
    assert best is not None
    return best


def _fill_tunnel(case: int, loops: list[Loop], tunnel: Tunnel) -> Row:
    """Make a tube between two loops, cut at the hexagon, and discs for the other loops."""
    corners = ring_corners(tunnel.diagonal)
    around = [corners[0]]
    while len(around) < len(corners):
        around.append(next(c for c in corners if c not in around and (c ^ around[-1]).bit_count() == 1))
    ring = tuple(CELL_VERTEX + corners.index(corner) for corner in around)
    choices = []
    for waist in (ring, ring[::-1]):
        strips = [
            _fill_strip(tunnel.loops[0], waist, tunnel.diagonal),
            _fill_strip(tunnel.loops[1], waist[::-1], tunnel.diagonal),
        ]
        choices.append((sum(length for length, _ in strips), strips[0][1] + strips[1][1]))
    rest = _fill_discs(case, [loop for loop in loops if loop not in tunnel.loops])
    return Row(min(choices)[1] + rest.triangles, len(corners), tunnel.diagonal)


@cache
def cell_state(case: int, joined: int) -> CellState:
    """Return the rows of a case whose face f joins its diagonal inside corners where bit f of `joined` is set."""
    loops = [_from_lowest(loop) for loop in case_loops(case, joined)]
    tunnels = _find_tunnels(case, joined)
    return CellState(
        case, joined, _fill_discs(case, loops), tuple((tunnel, _fill_tunnel(case, loops, tunnel)) for tunnel in tunnels)
    )


def find_states(case: int) -> list[CellState]:
    """Return all states of a case; bit n of a state's number tells whether its n-th ambiguous face joins."""
    faces = find_ambiguous_faces(case)
    return [
        cell_state(case, sum(1 << face for n, face in enumerate(faces) if number >> n & 1))
        for number in range(1 << len(faces))
    ]


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
