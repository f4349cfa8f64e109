"""The marching-cubes case table, derived and not typed.

A cell has eight corners; bit b of its case says whether corner b is inside (>= iso value), and the (x, y, z) of
corner b are the bits 0, 1, 2 of b.  The twelve edges are numbered by axis: edges 0-3 run along x, 4-7 along y,
8-11 along z; within an axis by the two remaining coordinates, the lower axis counting first.

For each case: walk every face counter-clockwise as seen from outside the cell; every run of inside corners gives
one directed segment from the edge where the run is entered to the edge where it is left.  On a face with
two diagonal inside corners this keeps the two apart, and the neighbouring cell, which walks the same face the
other way round, does the same: surfaces have no holes.  The segments chain to loops, and each loop is cut into
a fan from an apex whose chords leave the cell's faces, so no two cells can make the same triangle edge inside a
face: surfaces are manifold.  Of the fans that are left, a case takes those that enclose the volume nearest to that
of the trilinear field between corners of 0 and 1: cases and their complements then err to opposite sides, and the
volume of a surface has no bias to one of them.  A loop of seven edges runs around a face whose two inside corners
are kept apart, where the trilinear field joins them and is no guide: it takes the fan with the smallest inside, which
keeps the sheets apart within the cell too.  With this rule every case encloses the volume that it has in VTK.

Reference: Lorensen and Cline 1987 (the cases); the derivation by face runs follows Viskores and VTK in spirit.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray

CORNERS = tuple(((b & 1), (b >> 1) & 1, (b >> 2) & 1) for b in range(8))
"""(x, y, z) of corner b."""

MAX_TRIANGLES = 5


def _derive_edges() -> tuple[tuple[int, int, int], ...]:
    """Return (axis, lower corner, upper corner) of each edge."""
    edges = []
    for axis in range(3):
        for corner in range(8):
            if not corner >> axis & 1:
                edges.append((axis, corner, corner | 1 << axis))
    return tuple(edges)


EDGES = _derive_edges()

_EDGE_OF_CORNERS = {frozenset((low, high)): number for number, (_, low, high) in enumerate(EDGES)}


def _derive_faces() -> tuple[tuple[int, ...], ...]:
    """Return the corners of each face, counter-clockwise as seen from outside the cell."""
    faces: list[tuple[int, ...]] = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        faces.append((0, v, u | v, u))
        faces.append(tuple(corner | 1 << axis for corner in (0, u, u | v, v)))
    return tuple(faces)


FACES = _derive_faces()
"""The corners of face 2 axis (lower) and 2 axis + 1 (upper), counter-clockwise as seen from outside the cell."""

FACES_OF_EDGE = tuple(
    frozenset(number for number, face in enumerate(FACES) if low in face and high in face) for _, low, high in EDGES
)


def find_ambiguous_faces(case: int) -> list[int]:
    """Return the faces of a case whose inside corners are two diagonal ones."""
    return [
        number
        for number, face in enumerate(FACES)
        if case >> face[0] & 1 == case >> face[2] & 1 != case >> face[1] & 1 == case >> face[3] & 1
    ]


def _face_segments(case: int, joined: int) -> dict[int, int]:
    """Return the directed segments of a case: from the edge where a run of inside corners begins to where it ends."""
    segments: dict[int, int] = {}
    for number, face in enumerate(FACES):
        starts, stops = [], []
        inside = [bool(case >> corner & 1) for corner in face]
        for start in range(4):
            if not inside[start] or inside[start - 1]:
                continue
            stop = start
            while inside[(stop + 1) % 4]:
                stop += 1
            starts.append(_EDGE_OF_CORNERS[frozenset((face[start - 1], face[start]))])
            stops.append(_EDGE_OF_CORNERS[frozenset((face[stop % 4], face[(stop + 1) % 4]))])
        if joined >> number & 1:
            stops.reverse()
        segments.update(zip(starts, stops, strict=True))
    return segments


def case_loops(case: int, joined: int = 0) -> list[list[int]]:
    """Return the closed loops of edges of a case, each counter-clockwise as seen from outside (< iso value); bit f of
    `joined`: the two diagonal inside corners of face f are joined on it.
    """
    segments = _face_segments(case, joined)
    loops = []
    while segments:
        first = min(segments)
        loop, edge = [first], segments.pop(first)
        while edge != first:
            loop.append(edge)
            edge = segments.pop(edge)
        loops.append(loop)
    return loops


Triangle = tuple[int, int, int]


def _find_fans(loop: list[int]) -> list[list[Triangle]]:
    """Return the ways to cut a loop into triangles from an apex whose chords lie in no face of the cell."""
    fans = []
    for turn in range(len(loop)):
        apex, *rest = loop[turn:] + loop[:turn]
        if all(not FACES_OF_EDGE[apex] & FACES_OF_EDGE[edge] for edge in rest[1:-1]):
            fans.append([(apex, rest[n], rest[n + 1]) for n in range(len(rest) - 1)])
    return fans


_TWICE_MIDDLES = np.array([np.add(CORNERS[low], CORNERS[high]) for _, low, high in EDGES])
"""Twice the middle of each edge: whole numbers, so that volumes below are exact."""


def _enclosed_volume(triangles: list[Triangle]) -> int:
    """Return 48 times the volume between triangles through the middles of their edges and the cell's corner 0."""
    a, b, c = (_TWICE_MIDDLES[[triangle[n] for triangle in triangles]] for n in range(3))
    return int(np.einsum("ij,ij->", a, np.cross(b, c)))


def _volume_at_faces(case: int) -> int:
    """Return 48 times the volume between the inside parts of the cell's faces and the cell's corner 0."""
    volume = 0
    for axis in range(3):
        inside = [corner for corner in range(8) if corner >> axis & 1 and case >> corner & 1]
        apart = len(inside) == 2 and (inside[0] ^ inside[1]).bit_count() == 2
        volume += 4 if apart else (0, 2, 8, 14, 16)[len(inside)]
    return volume


_LONGEST_LOOP = 7
_SAMPLES = 16


@lru_cache(maxsize=1)
def _corner_weights() -> NDArray[np.int64]:
    """Return the trilinear weights (8, samples) of the corners at the middles of 16^3 parts of the cell, times 32^3."""
    upper = 2 * np.arange(_SAMPLES) + 1
    weights = (2 * _SAMPLES - upper, upper)
    return np.array([np.einsum("i,j,k->ijk", weights[x], weights[y], weights[z]).ravel() for x, y, z in CORNERS])


def _trilinear_volume(case: int) -> Fraction:
    """Return the share of the cell where the trilinear field of corners 0 (outside) and 1 (inside) is over 1/2."""
    field = sum((_corner_weights()[corner] for corner in range(8) if case >> corner & 1), np.int64(0))
    half = (2 * _SAMPLES) ** 3 // 2
    return Fraction(int(np.sum(field > half) + np.sum(field >= half)), 2 * _SAMPLES**3)


def _choose_triangles(case: int) -> tuple[Triangle, ...]:
    """Choose the fans of a case by the rule at the head of this module; the first of equal ones."""
    loops = case_loops(case)
    choices: list[list[Triangle]] = [list(chain(*fans)) for fans in product(*map(_find_fans, loops))]
    if not loops:
        return ()
    if len(loops[0]) == _LONGEST_LOOP:
        smallest = min(choices, key=_enclosed_volume)
        return tuple(smallest)
    wanted = _trilinear_volume(case)

    def error(triangles: list[Triangle]) -> Fraction:
        return abs(Fraction(_volume_at_faces(case) + _enclosed_volume(triangles), 48) - wanted)

    # a case and its complement that are cut alike sort alike
    nearest = min(
        choices, key=lambda triangles: (error(triangles), sorted(tuple(sorted(triangle)) for triangle in triangles))
    )
    return tuple(nearest)


@lru_cache(maxsize=1)
def case_table() -> tuple[tuple[Triangle, ...], ...]:
    """Return for each of the 256 cases its triangles as triples of edge numbers."""
    return tuple(_choose_triangles(case) for case in range(256))
