"""Self-intersections: bodies that cut each other, against all pairs tried one by one."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import sample_meshes as samples
from variants import daily

from clrecon.mesh import Mesh, intersections
from clrecon.mesh.intersections import find_beside, find_changed_intersections, find_self_intersections

pytestmark = pytest.mark.unit


def count(arrays: samples.Arrays) -> int:
    mesh = Mesh(*arrays)
    return len(find_self_intersections(mesh.vertices, mesh.triangles))


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


def test_good_surfaces_have_none():
    assert count(samples.torus(60, 30)) == 0
    assert count(samples.sphere((300, -500, 20), 10, 4)) == 0
    assert count(([], [])) == 0


def test_triangles_that_touch_count_as_intersecting():
    flat, upright = [[0, 0, 0], [4, 0, 0], [0, 4, 0]], [[1, 1, -1], [1, 1, 3], [2, 1, 3]]
    assert count((np.array(flat + upright, float), [[0, 1, 2], [3, 4, 5]])) == 1
    above = np.array(flat + upright, float)
    above[3:, 2] += 1.0
    assert count((above, [[0, 1, 2], [3, 4, 5]])) == 1  # a corner touches the face
    above[3:, 2] += 2.0**-20
    assert count((above, [[0, 1, 2], [3, 4, 5]])) == 0
    assert count((np.array(flat + flat, float), [[0, 1, 2], [3, 4, 5]])) == 0  # the same: counted as such elsewhere


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("shift", daily(1, [(3.1, 0.2, 0.3), (11.0, 4.0, -3.0), (19.5, 0.1, 0.2), (21.0, 0.0, 0.0)]))
def test_spheres_that_cut_each_other_have_the_pairs_of_solving(shift):
    vertices, triangles = samples.join(samples.sphere(rounds=2), samples.sphere(shift, 10.0, 1))
    vertices = vertices.astype(np.float32).astype(float)
    assert count((vertices, triangles)) == count_by_solving(vertices, triangles)
    assert (count((vertices, triangles)) > 0) == (shift[0] < 20)


def test_random_triangles_intersect_as_solving_says():
    rng = np.random.default_rng(9)
    corners = rng.uniform(0, 10, (60, 1, 3)) + rng.normal(size=(60, 3, 3)) * rng.choice([0.3, 1.0, 4.0], (60, 1, 1))
    vertices = corners.reshape(-1, 3).astype(np.float32).astype(float)
    triangles = np.arange(180).reshape(-1, 3)
    assert count((vertices, triangles)) == count_by_solving(vertices, triangles) > 20


@pytest.mark.parametrize("scale", [2.0**-9, 2.0**9])
def test_the_unit_of_length_changes_no_pair(scale):
    """A power of two changes no digit: what small volumes would leave unseen is found as in mm."""
    vertices, triangles = samples.join(samples.sphere(rounds=1), samples.sphere((11, 4, -3), 10.0, 1))
    assert count((scale * vertices.astype(np.float32), triangles)) == count((vertices, triangles)) > 0
    # An edge that ends just above the face, in a triangle that passes its plane elsewhere.
    beside = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.25, 0.25, 2], [0.25, 0.25, 0.5], [5, 5, -1]])
    assert count((scale * beside, [[0, 1, 2], [3, 4, 5]])) == 0


def test_the_bound_of_rounding_is_not_below_the_proven_one():
    half_step = 2.0**-53
    assert (7.0 + 56.0 * half_step) * half_step <= intersections._ROUNDING <= 2.0**-50  # of a volume; of an area 3 + 16


def test_triangles_with_a_common_corner_cut_each_other_by_the_edges_opposite_to_it():
    """The edge from vertex 3 to 4 passes through the inside of the first triangle, and then beside it."""
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, -1], [1, 1.5, 3], [0.5, 0.5, 3.0]])
    assert count((vertices, [[0, 1, 2], [5, 3, 4]])) == 1
    for corners in ([0, 3, 4], [3, 4, 0], [4, 0, 3]):
        assert count((vertices, [[0, 1, 2], corners])) == count((vertices, [[1, 2, 0], corners])) == 1
    vertices[3:5] = (-1, 1, -1), (-1, 1, 3)
    assert count((vertices, [[0, 1, 2], [0, 3, 4]])) == 0


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("second", "expected"),
    [
        ([0, 1, 6], 0),  # the neighbour beyond a common edge
        ([0, 1, 4], 1),  # folded onto the first: inside of it
        ([0, 1, 3], 1),  # and partly outside
        ([0, 7, 8], 0),  # beside it at a corner
        ([0, 3, 5], 1),  # a common corner and an overlap
        ([0, 2, 7], 0),
        ([0, 2, 5], 1),
        ([4, 3, 5], 1),  # no common corner
        ([6, 7, 8], 0),
    ],
)
def test_triangles_in_one_plane_are_counted_where_they_overlap(second, expected, turned):
    vertices = np.array([[0, 0], [4, 0], [0, 4], [3, 3], [1, 1], [2, 5], [2, -3], [-3, -1], [-1, -3]], float)
    vertices = np.column_stack([vertices, vertices @ [2, -1] if turned else np.full(9, 7.25)])
    assert count((vertices, [[0, 1, 2], second])) == count((vertices, [second, [0, 1, 2]])) == expected


def test_corners_at_one_place_count_as_the_same():
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 0], [1, -3, 2], [-2, 1, 5]], float)
    assert count((vertices, [[0, 1, 2], [3, 4, 5]])) == 0
    vertices[3] = (1, 1, 0)  # within the face
    assert count((vertices, [[0, 1, 2], [3, 4, 5]])) == 1


@pytest.mark.parametrize("kind", daily(3, ["whole", "plane", "turned", "float64"]))
@pytest.mark.parametrize("seed", daily(1, range(2)))
def test_pairs_that_touch_fold_and_overlap_are_counted_exactly(kind, seed):
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
    found = len(find_self_intersections(places, triangles))
    assert found == count_exactly(places, triangles) > 50


def test_triangles_with_a_corner_that_is_not_finite_are_left_out():
    vertices, triangles = samples.join(samples.box(), samples.box((0.4, 0.5, 0.6)))
    triangles = np.asarray(triangles, np.uint32)
    every = find_self_intersections(vertices, triangles)
    for value in (np.nan, np.inf):
        spoilt = vertices.copy()
        spoilt[triangles[every[0, 0], 0], 1] = value
        sound = np.isfinite(spoilt[triangles]).all(axis=(1, 2))
        expected = every[sound[every].all(axis=1)]
        found = find_self_intersections(spoilt, triangles)
        assert sorted(map(sorted, found.tolist())) == sorted(map(sorted, expected.tolist()))
        assert 0 < len(expected) < len(every)
    assert len(find_self_intersections(np.full((3, 3), np.nan), np.array([[0, 1, 2]], np.uint32))) == 0


def test_triangles_that_are_points_cut_nothing():
    assert count((np.zeros((3, 3)), [[0, 1, 2]])) == 0
    assert count((np.ones((1, 3)), [[0, 0, 0]] * 3)) == 0


@pytest.mark.parametrize("axis", range(3))
def test_only_triangles_that_can_touch_a_changed_one_lie_beside_it(axis):
    """Triangles in a row, in boxes of 2 with steps of 4.5, and cells as long as the changed one: 2."""
    face = np.roll([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.5]], axis, axis=1)
    along = np.roll([4.5, 0.0, 0.0], axis)
    vertices = (face + np.arange(40)[:, None, None] * along).reshape(-1, 3)
    triangles = np.arange(120, dtype=np.uint32).reshape(-1, 3)
    # The 20th reaches from 90 to 92, cells 45 and 46; its neighbours from 85.5 to 87.5, cells 42 and 43, and from 94.5
    # on, cell 47.  From 90 on the one before meets cell 45.
    changed = np.arange(40) == 20
    assert np.flatnonzero(find_beside(vertices, triangles, changed)).tolist() == [20]
    longer = vertices.copy()
    longer[58] += np.roll([2.5, 0.0, 0.0], axis)
    assert np.flatnonzero(find_beside(longer, triangles, changed)).tolist() == [19, 20]
    for number in (0, 39):
        assert np.flatnonzero(find_beside(vertices, triangles, np.arange(40) == number)).tolist() == [number]
    assert not find_beside(vertices, triangles, np.zeros(40, bool)).any()
    assert find_beside(vertices, triangles, np.ones(40, bool)).all()


def test_cells_are_enlarged_where_there_would_be_too_many():
    """A speck that has changed, far from another: 1/64 of 10 mm is as fine as 4096 cells of a cube can be."""
    face = np.array([[0.0, 0.0, 0.0], [1e-6, 0.0, 0.0], [0.0, 1e-6, 1e-6]])
    vertices = np.concatenate([face, face + [0.05, 0.0, 0.0], face + [2.0, 2.0, 0.0], face + 10.0])
    triangles = np.arange(12, dtype=np.uint32).reshape(-1, 3)
    beside = find_beside(vertices, triangles, np.arange(4) == 0)
    assert beside.tolist() == [True, True, False, False]


def test_triangles_that_touch_a_changed_one_lie_beside_it():
    rng = np.random.default_rng(4)
    vertices = rng.uniform(-40.0, 60.0, (600, 3))
    vertices = (vertices[:, None] + rng.normal(0.0, 6.0, (600, 3, 3))).reshape(-1, 3)
    triangles = np.arange(1800, dtype=np.uint32).reshape(-1, 3)
    changed = np.arange(600) % 30 == 7
    pairs = find_self_intersections(vertices, triangles)
    touched = pairs[changed[pairs].any(axis=1)]
    beside = find_beside(vertices, triangles, changed)
    assert len(touched) > 5 and beside[touched].all() and beside[changed].all() and 20 < beside.sum() < 400
    numbers = np.flatnonzero(beside)
    found = numbers[find_self_intersections(vertices, triangles[beside], changed[beside])]
    assert sorted(map(sorted, found.tolist())) == sorted(map(sorted, touched.tolist()))
    found = find_changed_intersections(vertices, triangles, changed)
    assert sorted(map(sorted, found.tolist())) == sorted(map(sorted, touched.tolist()))


def test_search_for_crossings_elsewhere_is_asked_where_many_have_changed():
    vertices, triangles = samples.join(samples.box(), samples.box((0.4, 0.5, 0.6)))
    triangles = np.asarray(triangles, np.uint32)
    asked: list[object] = []

    def elsewhere(*arguments):
        asked.append(arguments[2])
        return find_self_intersections(*arguments)

    every = find_self_intersections(vertices, triangles)
    assert len(every) > 3
    for changed in (np.ones(24, bool), np.arange(24) < 2, np.arange(24) == every[0, 0]):
        found = find_changed_intersections(vertices, triangles, changed, elsewhere)
        assert sorted(map(sorted, found.tolist())) == sorted(map(sorted, every[changed[every].any(axis=1)].tolist()))
    assert asked[0] is None and len(asked) == 2  # one of 24 is less than one of twenty
    assert find_changed_intersections(vertices, triangles, np.zeros(24, bool), elsewhere).shape == (0, 2)
    assert len(asked) == 2


@pytest.mark.parametrize("axis", range(3))
def test_pairs_whose_boxes_are_apart_are_left_out(axis, monkeypatch):
    """Both triangles share a cell of the grid, which is 1.5 of their boxes long."""
    seen = []
    monkeypatch.setattr(
        intersections._Planes,
        "not_apart",
        lambda self, points, one, other, common: seen.append(len(one)) or (one[:0], other[:0]),
    )
    face = np.array([[0.0, 0, 0], [1, 0.5, 0.25], [0.5, 1, 1]])
    for shift, pairs in ((1.25, [0]), (0.75, [0, 1])):
        both = np.concatenate([face, face + shift * np.eye(3)[axis]])
        assert count((both, [[0, 1, 2], [3, 4, 5]])) == 0
        assert seen == pairs
