"""Self-intersections: bodies that cut each other, against all pairs tried one by one."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import sample_meshes as samples
from variants import daily

from clrecon.mesh import Mesh, intersections
from clrecon.mesh.intersections import find_beside, find_changed_intersections, find_self_intersections
from clrecon.system.progress import Steps

pytestmark = pytest.mark.unit


def count_pairs(arrays: samples.Arrays) -> int:
    """Pairs of triangles that cut each other, as `find_self_intersections` has them."""
    mesh = Mesh(*arrays)
    return len(find_self_intersections(mesh.vertices, mesh.triangles))


def as_sets(pairs: np.ndarray) -> set[frozenset[int]]:
    """Pairs of triangles without their order."""
    return {frozenset(pair) for pair in pairs.tolist()}


def count_by_solving(vertices: np.ndarray, triangles: np.ndarray) -> int:
    """All pairs, all edges: solve for where the edge's line meets the plane of the face."""
    found = 0
    for a in range(len(triangles)):
        for b in range(a):
            common = set(triangles[a]) & set(triangles[b])
            found += any(
                _edge_meets(vertices[triangles[f]], vertices[triangles[e]], i)
                for f, e in ((a, b), (b, a))
                for i in range(3)
                if not common & {triangles[e][i], triangles[e][(i + 1) % 3]}
            )
    return found


def _edge_meets(face: np.ndarray, corners: np.ndarray, edge: int) -> bool:
    """Whether an edge passes through the face: both weights of its place and the share of the edge, solved for."""
    start, end = corners[edge], corners[(edge + 1) % 3]
    matrix = np.column_stack([face[1] - face[0], face[2] - face[0], start - end])
    if abs(np.linalg.det(matrix)) < 1e-12:
        return False
    u, v, t = np.linalg.solve(matrix, start - face[0])
    return bool(u > 0 and v > 0 and u + v < 1 and 0 < t < 1)


def count_exactly(vertices: np.ndarray, triangles: np.ndarray) -> int:
    """All pairs in fractions: each edge without a common corner is clipped to the other triangle and its plane."""
    points = [tuple(Fraction(float(x)) for x in vertex) for vertex in vertices]
    corners = [[points[vertex] for vertex in triangle] for triangle in triangles]
    corners = [triangle for triangle in corners if any(_cross(*triangle))]
    return sum(_meet_exactly(one, other) for a, one in enumerate(corners) for other in corners[:a])


def _meet_exactly(one, other) -> bool:
    """Triangles with a common edge meet where they are folded flat onto each other, others where an edge meets."""
    common = set(one) & set(other)
    if len(common) == 2:
        own, its = (next(corner for corner in triangle if corner not in common) for triangle in (one, other))
        u, v = sorted(common)
        flat = _dot(_cross(*one), _minus(its, one[0])) == 0
        return flat and _dot(_cross(u, v, own), _cross(u, v, its)) > 0
    return any(
        _edge_meets_exactly(triangle[i], triangle[(i + 1) % 3], face)
        for face, triangle in ((one, other), (other, one))
        for i in range(3)
        if len(common) < 3 and not common & {triangle[i], triangle[(i + 1) % 3]}
    )


def _edge_meets_exactly(start, end, face) -> bool:
    """Some share between 0 and 1 of the edge lies in the plane and on the inner side of all three edges."""
    normal, low, high = _cross(*face), Fraction(0), Fraction(1)
    planes = [(normal, face[0]), (tuple(-x for x in normal), face[0])]
    for a, b in zip(face, face[1:] + face[:1], strict=True):
        planes.append((_cross((0, 0, 0), normal, _minus(b, a)), a))
    for inward, point in planes:
        at, rise = _dot(inward, _minus(start, point)), _dot(inward, _minus(end, start))
        if rise == 0:
            if at < 0:
                return False
        elif rise > 0:
            low = max(low, -at / rise)
        else:
            high = min(high, -at / rise)
    return low <= high


def _minus(a, b):
    return tuple(x - y for x, y in zip(a, b, strict=True))


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def _cross(a, b, c):
    p, q = _minus(b, a), _minus(c, a)
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@pytest.mark.parametrize(
    "surface",
    [samples.torus(rings=60, sides=30), samples.sphere((300, -500, 20), radius=10, rounds=4), ([], [])],
    ids=["torus", "sphere", "empty"],
)
def test_a_surface_that_does_not_cut_itself_has_no_pairs(surface):
    assert count_pairs(surface) == 0


FLAT = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
UPRIGHT = [[1, 1, -1], [1, 1, 3], [2, 1, 3]]
"""A triangle that stands on its corner (1, 1, -1), below the face of FLAT."""


@pytest.mark.parametrize(
    ("raised_by", "pairs"),
    [(0.0, 1), (1.0, 1), (1.0 + 2.0**-20, 0)],
    ids=["cuts the face", "touches the face in a corner", "just above the face"],
)
def test_triangles_that_cut_or_touch_count_as_intersecting(raised_by, pairs):
    upright = np.array(UPRIGHT) + [0.0, 0.0, raised_by]
    assert count_pairs((np.concatenate([FLAT, upright]), [[0, 1, 2], [3, 4, 5]])) == pairs


def test_two_triangles_with_the_same_corners_do_not_count_as_intersecting():
    """Quality counts them as duplicate faces."""
    assert count_pairs((np.array(FLAT + FLAT, float), [[0, 1, 2], [3, 4, 5]])) == 0


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize(
    "centre_of_second", daily(1, [(3.1, 0.2, 0.3), (11.0, 4.0, -3.0), (19.5, 0.1, 0.2), (21.0, 0.0, 0.0)])
)
def test_two_spheres_have_as_many_pairs_as_edges_solved_for_faces(centre_of_second):
    """Both have a radius of 10: from centres 20 mm apart they do not meet."""
    vertices, triangles = samples.join(
        samples.sphere(rounds=2), samples.sphere(centre_of_second, radius=10.0, rounds=1)
    )
    vertices = vertices.astype(np.float32).astype(float)
    pairs = count_pairs((vertices, triangles))
    assert pairs == count_by_solving(vertices, triangles)
    assert (pairs > 0) == (centre_of_second[0] < 20)


def test_random_triangles_have_as_many_pairs_as_edges_solved_for_faces():
    rng = np.random.default_rng(9)
    count = 60
    sizes = rng.choice([0.3, 1.0, 4.0], (count, 1, 1))
    corners = rng.uniform(0, 10, (count, 1, 3)) + rng.normal(size=(count, 3, 3)) * sizes
    vertices = corners.reshape(-1, 3).astype(np.float32).astype(float)
    triangles = np.arange(3 * count).reshape(-1, 3)
    assert count_pairs((vertices, triangles)) == count_by_solving(vertices, triangles) > 20  # measured 141


tiny_and_huge = pytest.mark.parametrize("scale", [2.0**-9, 2.0**9])
"""A power of two changes no digit: what small volumes would leave unseen is found as in mm."""


@tiny_and_huge
def test_the_unit_of_length_changes_no_pair_of_two_spheres(scale):
    vertices, triangles = samples.join(samples.sphere(rounds=1), samples.sphere((11, 4, -3), radius=10.0, rounds=1))
    in_mm = count_pairs((vertices.astype(np.float32), triangles))
    assert count_pairs((scale * vertices.astype(np.float32), triangles)) == in_mm > 0


@tiny_and_huge
def test_an_edge_that_ends_above_the_face_meets_nothing_in_any_unit_of_length(scale):
    """The second triangle passes the plane of the first, but beside it."""
    first, second = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0.25, 0.25, 2], [0.25, 0.25, 0.5], [5, 5, -1]]
    assert count_pairs((scale * np.array(first + second), [[0, 1, 2], [3, 4, 5]])) == 0


def test_the_bound_of_rounding_is_at_least_the_proven_one_and_at_most_4_times_as_large():
    half_step = 2.0**-53
    proven = (7.0 + 56.0 * half_step) * half_step  # of a volume of three differences (Shewchuk 1997, orient3d)
    assert proven <= intersections._ROUNDING <= 2.0**-50


THROUGH_THE_FACE = [(1, 1, -1), (1, 1.5, 3)]
BESIDE_THE_FACE = [(-1, 1, -1), (-1, 1, 3)]


def test_an_edge_through_the_face_cuts_a_triangle_without_a_common_corner():
    vertices = np.array([*FLAT, *THROUGH_THE_FACE, (0.5, 0.5, 3.0)])
    assert count_pairs((vertices, [[0, 1, 2], [5, 3, 4]])) == 1


@pytest.mark.parametrize("first", [[0, 1, 2], [1, 2, 0]])
@pytest.mark.parametrize("second", [[0, 3, 4], [3, 4, 0], [4, 0, 3]])
def test_the_edge_opposite_to_a_common_corner_cuts_whatever_the_order_of_corners(first, second):
    vertices = np.array([*FLAT, *THROUGH_THE_FACE])
    assert count_pairs((vertices, [first, second])) == 1


def test_triangles_with_a_common_corner_whose_opposite_edge_passes_beside_do_not_cut():
    vertices = np.array([*FLAT, *BESIDE_THE_FACE])
    assert count_pairs((vertices, [[0, 1, 2], [0, 3, 4]])) == 0


SECOND_IN_PLANE = {
    "neighbour beyond a common edge": ([0, 1, 6], 0),
    "folded onto the first": ([0, 1, 4], 1),
    "folded onto the first and beyond": ([0, 1, 3], 1),
    "common corner, beside it": ([0, 7, 8], 0),
    "common corner, over it": ([0, 3, 5], 1),
    "neighbour beyond another edge": ([0, 2, 7], 0),
    "folded over another edge": ([0, 2, 5], 1),
    "no common corner, over it": ([4, 3, 5], 1),
    "no common corner, beside it": ([6, 7, 8], 0),
}


@pytest.mark.parametrize("slope", [(0, 0), (2, -1)], ids=["level", "sloping"])
@pytest.mark.parametrize(("second", "pairs"), SECOND_IN_PLANE.values(), ids=SECOND_IN_PLANE)
def test_triangles_in_one_plane_are_counted_where_they_overlap(second, pairs, slope):
    x_y = np.array([[0, 0], [4, 0], [0, 4], [3, 3], [1, 1], [2, 5], [2, -3], [-3, -1], [-1, -3]], float)
    vertices = np.column_stack([x_y, 7.25 + x_y @ slope])
    assert count_pairs((vertices, [[0, 1, 2], second])) == pairs
    assert count_pairs((vertices, [second, [0, 1, 2]])) == pairs


@pytest.mark.parametrize(
    ("corner", "pairs"), [((0, 0, 0), 0), ((1, 1, 0), 1)], ids=["at a corner of the first", "within its face"]
)
def test_a_corner_at_the_place_of_another_counts_as_common_and_one_in_the_face_as_a_touch(corner, pairs):
    vertices = np.array([*FLAT, corner, [1, -3, 2], [-2, 1, 5]], float)
    assert count_pairs((vertices, [[0, 1, 2], [3, 4, 5]])) == pairs


@pytest.mark.parametrize("kind", daily(3, ["whole", "plane", "turned", "float64"]))
@pytest.mark.parametrize("seed", daily(1, range(2)))
def test_as_many_pairs_touch_fold_and_overlap_as_in_exact_fractions(kind, seed):
    """Triangles over few places: most pairs have common corners, touch, or lie in one plane."""
    random = np.random.default_rng(seed)
    places = np.unique(random.integers(0, 4, (24, 3)), axis=0).astype(float)
    if kind == "plane":
        places[:, 2] = 0.0
        places = np.unique(places, axis=0)
    elif kind == "turned":
        places = (places @ [[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.1, 0.0, 1.0]]).astype(np.float32).astype(float)
    elif kind == "float64":
        places = 1e3 * places + 1.0 / 3.0
    triangles = np.array([random.choice(len(places), 3, replace=False) for _ in range(30)], np.uint32)
    pairs = len(find_self_intersections(places, triangles))
    assert pairs == count_exactly(places, triangles) > 50  # measured 53 (turned) to 281 (plane)


@pytest.fixture
def two_boxes_that_cut_each_other():
    """Vertices and 24 triangles."""
    vertices, triangles = samples.join(samples.box(), samples.box((0.4, 0.5, 0.6)))
    return vertices, np.asarray(triangles, np.uint32)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_triangles_with_a_corner_that_is_not_finite_are_left_out(two_boxes_that_cut_each_other, value):
    vertices, triangles = two_boxes_that_cut_each_other
    all_pairs = find_self_intersections(vertices, triangles)
    corner_of_a_pair = triangles[all_pairs[0, 0], 0]
    vertices[corner_of_a_pair, 1] = value

    pairs = find_self_intersections(vertices, triangles)

    is_finite = np.isfinite(vertices[triangles]).all(axis=(1, 2))
    expected = all_pairs[is_finite[all_pairs].all(axis=1)]
    assert 0 < len(expected) < len(all_pairs)
    assert as_sets(pairs) == as_sets(expected)


def test_a_mesh_without_finite_vertices_has_no_pairs():
    assert len(find_self_intersections(np.full((3, 3), np.nan), np.array([[0, 1, 2]], np.uint32))) == 0


@pytest.mark.parametrize(
    ("vertices", "triangles"),
    [(np.zeros((3, 3)), [[0, 1, 2]]), (np.ones((1, 3)), [[0, 0, 0]] * 3)],
    ids=["three vertices at one place", "one vertex thrice"],
)
def test_triangles_that_are_points_cut_nothing(vertices, triangles):
    assert count_pairs((vertices, triangles)) == 0


@pytest.mark.parametrize(
    "direction", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.5, 1.0, -2.0)], ids=["point", "x", "oblique"]
)
def test_no_pairs_are_looked_at_of_thousands_of_triangles_without_area_at_one_place(direction):
    """2,000 boxes that overlap are 2 million pairs: 31 pieces of 65,536, each of which is told."""
    steps_told = []
    corners = np.array([0.0, 1.0, 3.0])[:, None] * np.array(direction)
    triangles = np.arange(6000, dtype=np.uint32).reshape(-1, 3)
    steps = Steps(lambda *step: steps_told.append(step), "crossings", len(triangles))
    assert len(find_self_intersections(np.tile(corners, (2000, 1)), triangles, steps=steps)) == 0
    assert [done for _, done, _ in steps_told] == [0, len(triangles)]


def row_of_triangles(axis: int) -> tuple[np.ndarray, np.ndarray]:
    """40 triangles along an axis, each in a box 2 mm long, one every 4.5 mm; coarse cells are 2 mm long, too."""
    face = np.roll([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.5]], axis, axis=1)
    step = np.roll([4.5, 0.0, 0.0], axis)
    vertices = (face + np.arange(40)[:, None, None] * step).reshape(-1, 3)
    return vertices, np.arange(120, dtype=np.uint32).reshape(-1, 3)


def list_beside(vertices: np.ndarray, triangles: np.ndarray, changed: int) -> list[int]:
    """Numbers of triangles beside one that has changed, with itself."""
    return np.flatnonzero(find_beside(vertices, triangles, np.arange(len(triangles)) == changed)).tolist()


@pytest.mark.parametrize("changed", [0, 20, 39], ids=["first", "middle", "last"])
@pytest.mark.parametrize("axis", range(3))
def test_triangles_2_mm_from_a_changed_one_do_not_lie_beside_it(axis, changed):
    assert list_beside(*row_of_triangles(axis), changed) == [changed]


@pytest.mark.parametrize("axis", range(3))
def test_a_triangle_that_reaches_the_cell_of_a_changed_one_lies_beside_it(axis):
    """The 20th triangle is in cells 45 and 46, from 90 to 92 mm; the 19th ends at 87.5 and then at 90 mm."""
    vertices, triangles = row_of_triangles(axis)
    farthest_corner_of_19 = triangles[19, 1]
    vertices[farthest_corner_of_19] += np.roll([2.5, 0.0, 0.0], axis)
    assert list_beside(vertices, triangles, 20) == [19, 20]


@pytest.mark.parametrize("changed", [False, True], ids=["none", "all"])
def test_none_or_all_triangles_lie_beside_where_none_or_all_have_changed(changed):
    assert (find_beside(*row_of_triangles(axis=0), np.full(40, changed)) == changed).all()


def test_a_speck_beside_a_changed_one_is_found_as_cells_do_not_get_as_small_as_specks():
    """The 10 mm of a mesh of few triangles have at most 4096 = 16**3 cells, which grow from a speck's size by 1.25."""
    smallest_cell = 10.0 / (16 - 1)  # mm; the last of 16 cells begins where the mesh ends
    largest_cell = 1.25 * smallest_cell
    speck = np.array([[0.0, 0.0, 0.0], [1e-6, 0.0, 0.0], [0.0, 1e-6, 1e-6]])
    places = [(0.0, 0.0, 0.0), (0.99 * smallest_cell, 0.0, 0.0), (1.01 * largest_cell, 0.0, 0.0), (10.0, 10.0, 10.0)]
    vertices = np.concatenate([speck + place for place in places])
    triangles = np.arange(12, dtype=np.uint32).reshape(-1, 3)
    assert list_beside(vertices, triangles, 0) == [0, 1]


@pytest.fixture(scope="module")
def triangles_of_which_every_30th_has_changed():
    """600 random triangles of some 6 mm in 100 mm, which have changed, and the pairs with a changed one."""
    rng = np.random.default_rng(4)
    count = 600
    centres = rng.uniform(-40.0, 60.0, (count, 3))
    vertices = (centres[:, None] + rng.normal(0.0, 6.0, (count, 3, 3))).reshape(-1, 3)
    triangles = np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)
    changed = np.arange(count) % 30 == 7
    pairs = find_self_intersections(vertices, triangles)
    pairs = pairs[changed[pairs].any(axis=1)]
    assert len(pairs) > 5  # measured 11
    return vertices, triangles, changed, pairs


def test_triangles_that_touch_a_changed_one_lie_beside_it_and_most_others_do_not(
    triangles_of_which_every_30th_has_changed,
):
    vertices, triangles, changed, pairs = triangles_of_which_every_30th_has_changed
    beside = find_beside(vertices, triangles, changed)
    assert beside[changed].all()
    assert beside[pairs].all()
    assert beside.sum() < 400  # of 600; measured 225


def test_pairs_with_a_changed_triangle_are_those_of_a_search_through_all(triangles_of_which_every_30th_has_changed):
    vertices, triangles, changed, pairs = triangles_of_which_every_30th_has_changed
    assert as_sets(find_changed_intersections(vertices, triangles, changed)) == as_sets(pairs)


def test_pairs_with_a_changed_triangle_are_found_among_the_triangles_beside_alone(
    triangles_of_which_every_30th_has_changed,
):
    vertices, triangles, changed, pairs = triangles_of_which_every_30th_has_changed
    rows = np.flatnonzero(find_beside(vertices, triangles, changed))
    among_them = find_self_intersections(vertices, triangles[rows], changed[rows])
    assert as_sets(rows[among_them]) == as_sets(pairs)


@pytest.mark.parametrize("changed", [range(24), range(2), [0], []], ids=["all", "two of 24", "one of 24", "none"])
def test_pairs_with_a_changed_triangle_of_two_boxes_are_those_of_all_pairs_that_have_one(
    two_boxes_that_cut_each_other, changed
):
    vertices, triangles = two_boxes_that_cut_each_other
    has_changed = np.isin(np.arange(24), changed)
    pairs = find_self_intersections(vertices, triangles)
    expected = pairs[has_changed[pairs].any(axis=1)]
    assert as_sets(find_changed_intersections(vertices, triangles, has_changed)) == as_sets(expected)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("shift", "pairs_looked_at"), [(1.25, [0]), (0.75, [1])], ids=["boxes apart", "boxes that overlap"]
)
def test_of_triangles_in_one_cell_only_pairs_whose_boxes_overlap_are_looked_at(
    axis, shift, pairs_looked_at, monkeypatch
):
    """A triangle in a box of 1 mm and the same shifted: both lie in a cell of the grid, which is 1.5 mm long."""
    looked_at = []

    def find_no_pair(self, points, one, other, common):
        looked_at.append(len(one))
        return one[:0], other[:0]

    monkeypatch.setattr(intersections._Planes, "not_apart", find_no_pair)
    face = np.array([[0.0, 0, 0], [1, 0.5, 0.25], [0.5, 1, 1]])
    count_pairs((np.concatenate([face, face + shift * np.eye(3)[axis]]), [[0, 1, 2], [3, 4, 5]]))
    assert looked_at == pairs_looked_at
