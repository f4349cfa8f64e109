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

References: Nielson and Hamann 1991 (faces); Chernyaev 1995 (interiors); Grosso 2016 (the hexagon).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import product

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

    def join(a: int, b: int) -> None:
        low, high = sorted((region[a], region[b]))
        region[:] = [low if r == high else r for r in region]

    for _, low, high in EDGES:
        if case >> low & 1 == case >> high & 1:
            join(low, high)
    for face in find_ambiguous_faces(case):
        a, b, c, d = FACES[face]
        first_joined = (joined >> face & 1) == (case >> a & 1)
        join(*((a, c) if first_joined else (b, d)))
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
    found = [loop for loop in loops if {region[corner] for corner in EDGES[loop[0]][1:]} == {a, b}]
    (loop,) = found
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


def _place(vertex: int, diagonal: int = 0) -> tuple[int, int, int]:
    """Return the place of a vertex in a model cell of 20 units: edges at their middles, a tunnel's box 6 units wide."""
    if vertex >= CELL_VERTEX:
        x, y, z = CORNERS[ring_corners(diagonal)[vertex - CELL_VERTEX]]
        return 7 + 6 * x, 7 + 6 * y, 7 + 6 * z
    _, low, high = EDGES[vertex]
    x, y, z = (10 * (a + b) for a, b in zip(CORNERS[low], CORNERS[high], strict=True))
    return x, y, z


def _squared_length(a: int, b: int, diagonal: int = 0) -> int:
    return sum((p - q) ** 2 for p, q in zip(_place(a, diagonal), _place(b, diagonal), strict=True))


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
