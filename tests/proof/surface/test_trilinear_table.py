"""The derived rows of cells with decided faces and interiors: surfaces stay closed and manifold whatever is decided."""

from __future__ import annotations

import functools
from collections import Counter
from typing import Any

import pytest
from derive_mc_tables import pack_trilinear_tables

from clrecon.proof.surface.case_table import (
    CORNERS,
    EDGES,
    FACES,
    FACES_OF_EDGE,
    case_loops,
    case_table,
    find_ambiguous_faces,
)
from clrecon.proof.surface.trilinear_table import (
    CELL_VERTEX,
    MAX_TRILINEAR_TRIANGLES,
    CellState,
    cell_state,
    find_regions,
    find_states,
    ring_corners,
)


@functools.cache
def all_states() -> list[CellState]:
    """Every case with every decision on its faces."""
    return [state for case in range(256) for state in find_states(case)]


@functools.cache
def all_rows() -> list[Any]:
    """(state, tunnel or None, row) of every row of the table."""
    plain: list[Any] = [(state, None, state.plain) for state in all_states()]
    return plain + [(state, tunnel, row) for state in all_states() for tunnel, row in state.tunnels]


def directed_edges(triangles) -> Counter:
    return Counter(edge for a, b, c in triangles for edge in ((a, b), (b, c), (c, a)))


def loop_edges(loops) -> set:
    return {(loop[n - 1], loop[n]) for loop in loops for n in range(len(loop))}


def test_table_has_656_states_of_cells_and_160_tunnels():
    assert len(all_states()) == 656  # 256 cases with each decision on their ambiguous faces
    assert len(all_rows()) - len(all_states()) == 160


def test_rows_of_the_table_have_at_most_22_triangles():
    assert max(len(row.triangles) for _, _, row in all_rows()) == MAX_TRILINEAR_TRIANGLES == 22


def test_tunnels_of_the_table_are_those_of_marching_cubes_33_in_all_their_positions():
    """By inside or outside corners, the loops of the cell and the lengths of those that the tube joins."""
    found: Counter = Counter()
    for state, tunnel, _ in all_rows():
        if tunnel is not None:
            corners = min(state.case.bit_count(), 8 - state.case.bit_count())
            loops = len(case_loops(state.case, state.joined))
            found[(corners, loops, *sorted(map(len, tunnel.loops)))] += 1
    assert found == {
        (2, 2, 3, 3): 8,  # case 4.2
        (3, 2, 3, 4): 48,  # 6.1.2
        (3, 2, 3, 6): 16,  # 7.4.2
        (4, 2, 4, 4): 24,  # 10.1.2
        (4, 2, 3, 5): 48,  # 12.1.2
        (4, 3, 3, 6): 16,  # 13.5.2
    }


def test_states_of_ambiguous_faces_are_those_of_marching_cubes_33():
    """Loops of the states with ambiguous faces, by inside or outside corners and ambiguous faces."""
    found: Counter = Counter()
    for state in all_states():
        faces = len(find_ambiguous_faces(state.case))
        if faces:
            corners = min(state.case.bit_count(), 8 - state.case.bit_count())
            found[corners, faces, tuple(sorted(map(len, case_loops(state.case, state.joined))))] += 1
    assert found == {
        (2, 1, (3, 3)): 24,  # 3.1
        (2, 1, (6,)): 24,  # 3.2
        (3, 1, (3, 4)): 48,  # 6.1
        (3, 1, (7,)): 48,  # 6.2
        (3, 3, (3, 3, 3)): 16,  # 7.1
        (3, 3, (3, 6)): 48 + 16,  # 7.2, 7.4
        (3, 3, (9,)): 48,  # 7.3
        (4, 2, (4, 4)): 12,  # 10.1
        (4, 2, (3, 5)): 48,  # 12.1
        (4, 2, (8,)): 12 + 48,  # 10.2, 12.2
        (4, 6, (3, 3, 3, 3)): 4,  # 13.1
        (4, 6, (3, 3, 6)): 24 + 8,  # 13.2, 13.5
        (4, 6, (3, 9)): 48,  # 13.3
        (4, 6, (12,)): 8 + 24,  # 13.4, and faces that no trilinear field has
        (4, 6, (6, 6)): 12,  # such faces too
    }


def test_every_row_fills_its_loops_and_nothing_else():
    for state, _, row in all_rows():
        directed = directed_edges(row.triangles)
        assert max(directed.values(), default=1) == 1
        free = {edge for edge in directed if edge[::-1] not in directed}
        assert free == loop_edges(case_loops(state.case, state.joined)), (state.case, state.joined)


def test_every_row_has_discs_and_at_most_one_tube():
    for state, tunnel, row in all_rows():
        directed = directed_edges(row.triangles)
        vertices = {vertex for edge in directed for vertex in edge}
        assert len([v for v in vertices if v >= CELL_VERTEX]) == row.cell_vertices
        euler = len(vertices) - len({frozenset(edge) for edge in directed}) + len(row.triangles)
        assert euler == len(case_loops(state.case, state.joined)) - (0 if tunnel is None else 2)


def test_no_inner_triangle_edge_of_a_row_lies_in_a_face_of_the_cell():
    """Else the neighbour could have the same chord, and the edge four triangles."""
    for state, _, row in all_rows():
        chords = set(directed_edges(row.triangles)) - loop_edges(case_loops(state.case, state.joined))
        for a, b in chords:
            if max(a, b) < CELL_VERTEX:
                assert not FACES_OF_EDGE[a] & FACES_OF_EDGE[b], (state.case, state.joined)


@pytest.mark.parametrize("axis", range(3))
def test_neighbours_agree_on_every_face_that_they_decide_alike(axis):
    """The segments on a face depend on its own corners and its own decision alone, and are the neighbour's reverse."""
    lower, upper = 2 * axis, 2 * axis + 1
    across = {EDGES.index((own, low, high)): EDGES.index((own, low | 1 << axis, high | 1 << axis))
              for own, low, high in EDGES if own != axis and not low >> axis & 1}  # fmt: skip
    seen: dict = {}
    for state in all_states():
        segments = loop_edges(case_loops(state.case, state.joined))
        for face, turned in ((lower, True), (upper, False)):
            corners = [corner for corner in range(8) if CORNERS[corner][axis] == (face == upper)]
            inside = tuple(state.case >> corner & 1 for corner in corners)
            on_face = {(a, b) for a, b in segments if all(face in FACES_OF_EDGE[e] for e in (a, b))}
            own = {(a, b) for a, b in on_face if EDGES[a][0] != axis and EDGES[b][0] != axis}
            if turned:
                own = {(across[b], across[a]) for a, b in own}
            ambiguous = inside in ((1, 0, 0, 1), (0, 1, 1, 0))
            decided = state.joined >> face & 1 if ambiguous else None
            seen.setdefault((inside, decided), set()).add(frozenset(own))
    assert len(seen) == 16 + 2
    assert all(len(found) == 1 for found in seen.values())


def test_rows_of_cells_without_joined_faces_are_those_of_the_case_table():
    for case in range(256):
        assert cell_state(case, 0).plain.triangles == case_table()[case]


def test_loops_of_a_case_with_all_faces_joined_are_those_of_its_complement_reversed():
    for case in range(256):
        every = sum(1 << face for face in find_ambiguous_faces(case))
        turned = {(b, a) for a, b in loop_edges(case_loops(255 - case, every))}
        assert turned == loop_edges(case_loops(case))


def test_inside_corners_across_a_face_are_one_region_only_if_the_face_joins_them():
    diagonal = 1 << FACES[0][0] | 1 << FACES[0][2]
    apart, joined = find_regions(diagonal, 0), find_regions(diagonal, 1)
    assert apart[FACES[0][0]] != apart[FACES[0][2]]
    assert joined[FACES[0][0]] == joined[FACES[0][2]]
    assert len(set(apart)) == 3
    assert len(set(joined)) == 2


def test_packed_trilinear_tables_have_every_row_of_the_table():
    """Words, from their lowest bits on.  A case: 16 of its first state, then its ambiguous faces.  A state: 16 of its
    first row, then two of each code of an interior, how many rows further on its row is.  A row: 16 of its first
    triangle, five of their number, three of its vertices inside, then its diagonal.  A triangle: five of each corner.
    """
    tables = pack_trilinear_tables()
    number = 0
    for case in range(256):
        first, faces = int(tables.cases[case]) & 0xFFFF, int(tables.cases[case]) >> 16
        assert [face for face in range(6) if faces >> face & 1] == find_ambiguous_faces(case)
        for n, state in enumerate(find_states(case)):
            assert first + n == number
            number += 1
            word = int(tables.states[first + n])
            for code in (None, *range(8)):
                further = 0 if code is None else word >> 16 + 2 * code & 3
                row = int(tables.rows[(word & 0xFFFF) + further])
                packed = tables.triangles[row & 0xFFFF :][: row >> 16 & 31]
                expected = state.row(code)
                assert [(int(t) & 31, int(t) >> 5 & 31, int(t) >> 10) for t in packed] == list(expected.triangles)
                assert (row >> 21 & 7, row >> 24) == (expected.cell_vertices, expected.diagonal)
    assert number == len(tables.states)


def test_ring_of_a_waist_has_the_six_corners_off_its_diagonal():
    for corner in range(4):  # of a diagonal to 7 - corner
        assert ring_corners(corner) == sorted(set(range(8)) - {corner, 7 - corner})
