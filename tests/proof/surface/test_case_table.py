"""The derived case table has the properties that make surfaces closed and manifold."""

from __future__ import annotations

from collections import Counter
from itertools import product

import numpy as np
import pytest
from derive_mc_tables import pack_case_table

from clrecon.proof.surface.case_table import CORNERS, EDGES, MAX_TRIANGLES, case_loops, case_table

FACES = [frozenset(c for c in range(8) if CORNERS[c][axis] == side) for axis in range(3) for side in (0, 1)]
MIDDLES = np.array([(np.array(CORNERS[low]) + CORNERS[high]) / 2 for _, low, high in EDGES])


def is_crossed(case: int, edge: int) -> bool:
    _, low, high = EDGES[edge]
    return (case >> low & 1) != (case >> high & 1)


def test_there_are_256_cases_of_820_triangles_and_at_most_5_each():
    sizes = [len(triangles) for triangles in case_table()]
    assert len(sizes) == 256
    assert sum(sizes) == 820
    assert max(sizes) == MAX_TRIANGLES == 5


def test_loops_of_every_case_pass_each_crossed_edge_once():
    used = {case: Counter(edge for loop in case_loops(case) for edge in loop) for case in range(256)}
    assert used == {case: {edge: 1 for edge in range(12) if is_crossed(case, edge)} for case in range(256)}


def test_corners_of_the_triangles_of_every_case_are_its_crossed_edges():
    corners = [{edge for triangle in triangles for edge in triangle} for triangles in case_table()]
    assert corners == [{edge for edge in range(12) if is_crossed(case, edge)} for case in range(256)]


def count_triangle_edges(case: int) -> Counter:
    """How many triangles of a case have each edge, from one crossed edge of the cell to another, in that direction."""
    return Counter(edge for a, b, c in case_table()[case] for edge in ((a, b), (b, c), (c, a)))


def face_segments(case: int, face: frozenset) -> set:
    """Directed triangle edges of a case that lie in a face and are not shared inside the case."""
    directed = count_triangle_edges(case)
    on_face = {edge for edge in range(12) if {EDGES[edge][1], EDGES[edge][2]} <= face}
    return {(a, b) for a, b in directed if a in on_face and b in on_face and (b, a) not in directed}


@pytest.mark.parametrize("axis", range(3))
def test_surfaces_of_two_neighbouring_cells_meet_on_their_common_face_in_every_case(axis):
    """Whatever the states of two cells that share a face, the segments on it are each other's reverse."""
    lower_corners = [c for c in range(8) if CORNERS[c][axis] == 0]
    upper_corners = [c | 1 << axis for c in lower_corners]
    lower_face, upper_face = frozenset(lower_corners), frozenset(upper_corners)
    opposite = {edge: edges_across(edge, axis) for edge in range(12) if {EDGES[edge][1], EDGES[edge][2]} <= lower_face}

    # what the upper of two cells draws on the common face, its lower one, reversed and with the edges of the lower cell
    of_upper_cell: dict = {}
    for case in range(256):
        state = tuple(case >> c & 1 for c in lower_corners)
        reversed_segments = frozenset((opposite[b], opposite[a]) for a, b in face_segments(case, lower_face))
        of_upper_cell.setdefault(state, set()).add(reversed_segments)

    for case in range(256):
        state = tuple(case >> c & 1 for c in upper_corners)
        assert of_upper_cell[state] == {frozenset(face_segments(case, upper_face))}


def edges_across(edge: int, axis: int) -> int:
    """The edge of the upper face that lies opposite `edge` of the lower face."""
    own, low, high = EDGES[edge]
    return EDGES.index((own, low | 1 << axis, high | 1 << axis))


def test_no_inner_triangle_edge_of_any_case_lies_in_a_face_of_the_cell():
    """Else the neighbour could have the same chord, and the edge four triangles."""
    for case in range(256):
        directed = count_triangle_edges(case)
        assert max(directed.values(), default=1) == 1, case
        for a, b in directed:
            if (b, a) in directed:
                corners = {EDGES[a][1], EDGES[a][2]}, {EDGES[b][1], EDGES[b][2]}
                assert not any(corners[0] <= face and corners[1] <= face for face in FACES), case


@pytest.mark.parametrize("corner", range(8))
def test_one_corner_inside_gives_a_triangle_that_looks_away_from_it(corner):
    ((a, b, c),) = case_table()[1 << corner]
    normal = np.cross(MIDDLES[b] - MIDDLES[a], MIDDLES[c] - MIDDLES[a])
    assert normal @ (MIDDLES[a] - CORNERS[corner]) > 0.0


def test_two_diagonal_inside_corners_of_a_face_have_a_surface_each():
    case = 1 << 0 | 1 << 3
    assert len(case_loops(case)) == 2


def test_packed_case_table_has_every_triangle_of_the_table():
    """A word has four bits of the number of triangles, and then four of each of their edges."""
    for case, word in enumerate(pack_case_table()):
        word = int(word)
        edges = [word >> 4 * place & 15 for place in range(1, 16)]
        triangles = [tuple(edges[3 * n : 3 * n + 3]) for n in range(word & 15)]
        assert triangles == list(case_table()[case])


def test_corners_are_numbered_with_x_fastest_and_z_slowest():
    assert CORNERS == tuple((x, y, z) for z, y, x in product((0, 1), repeat=3))


def test_edges_are_numbered_by_their_axis_and_then_by_their_lower_corner():
    x_axis, y_axis, z_axis = range(3)
    assert [axis for axis, _, _ in EDGES] == [x_axis] * 4 + [y_axis] * 4 + [z_axis] * 4
    assert [(low, high) for axis, low, high in EDGES if axis == y_axis] == [(0, 2), (1, 3), (4, 6), (5, 7)]
    assert [(low, high) for axis, low, high in EDGES if axis == z_axis] == [(0, 4), (1, 5), (2, 6), (3, 7)]


def volume_inside(case: int) -> float:
    """Volume of the inside part of the cell, with the surface through the middles of the edges."""
    triangles = MIDDLES[np.array(case_table()[case], dtype=int).reshape(-1, 3)]
    volume = np.linalg.det(triangles).sum() / 6
    for axis in range(3):
        inside = [c for c in range(8) if c >> axis & 1 and case >> c & 1]
        diagonal = len(inside) == 2 and (inside[0] ^ inside[1]).bit_count() == 2
        volume += (1 / 4 if diagonal else (0, 1 / 8, 1 / 2, 7 / 8, 1)[len(inside)]) / 3
    return volume


def has_diagonal_face(case: int) -> bool:
    states = [[case >> c & 1 for c in sorted(face)] for face in FACES]
    return any(state in ([1, 0, 0, 1], [0, 1, 1, 0]) for state in states)


@pytest.mark.parametrize(
    ("case", "volume"),
    [
        pytest.param(0b00000000, 0, id="no corner"),
        pytest.param(0b00000001, 1 / 6 * (1 / 2) ** 3, id="one corner, a tetrahedron"),
        pytest.param(0b00000011, 1 / 2 * (1 / 2) ** 2, id="one edge, a prism"),
        pytest.param(0b00001111, 1 / 2, id="one face, half the cell"),
        pytest.param(0b11111111, 1, id="all corners"),
    ],
)
def test_case_of_corners_with_a_simple_body_inside_has_its_volume(case, volume):
    assert volume_inside(case) == pytest.approx(volume)


# at a face with diagonal corners the inside ones are kept apart, in the complement the others
def test_volumes_of_a_case_and_its_complement_add_up_to_the_cell():
    """Else every surface would enclose too much or too little: 0.1 % on bone, 0.5 % on thin parts."""
    cases = [case for case in range(128) if not has_diagonal_face(case)]
    sums = [volume_inside(case) + volume_inside(255 - case) for case in cases]
    assert sums == pytest.approx([1.0] * len(cases))


def test_every_case_encloses_the_volume_that_it_has_in_vtk():
    """A third opinion on the choice of fans; the first fan that is possible differs in 72 cases."""
    pyvista = pytest.importorskip("pyvista")
    image = pyvista.ImageData(dimensions=(2, 2, 2))
    for case in range(1, 255):
        image["inside"] = np.array([case >> c & 1 for c in range(8)], dtype=np.float32)
        contour = image.contour([0.5], method="flying_edges", compute_normals=False, compute_scalars=False)
        enclosed = np.linalg.det(contour.points.astype(np.float64)[contour.regular_faces]).sum() / 6
        triangles = MIDDLES[np.array(case_table()[case], dtype=int).reshape(-1, 3)]
        assert np.linalg.det(triangles).sum() / 6 == pytest.approx(enclosed, abs=1e-6), case  # float32
        assert len(triangles) == contour.n_cells, case
