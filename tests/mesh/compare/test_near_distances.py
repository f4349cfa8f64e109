"""Upper bounds of distances, and work in pieces and threads."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances

from clrecon.mesh.compare.distances import FaceFrames, NearDistance, triangle_distances
from clrecon.system import pieces

pytestmark = pytest.mark.unit


def bounds_and_distances(height: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Upper bounds (with slack) and exact distances of 4000 points from a triangle each, and the slack.

    The triangles have one side of some 1 mm, and a third corner about `height` mm beside it, up to 300 mm from the
    origin of float32 coordinates; the points lie some 0.7 mm from their first corner.
    """
    rng = np.random.default_rng(8)
    count = 4000
    first = rng.uniform(-300.0, 300.0, (count, 3))
    side = rng.normal(size=(count, 3))
    corners = np.stack([first, first + side, first + 0.7 * side + height * rng.normal(size=(count, 3))], axis=1)
    points = first + rng.normal(scale=0.7, size=(count, 3))
    frames = FaceFrames(corners.reshape(-1, 3), np.arange(3 * count, dtype=np.uint32).reshape(-1, 3))
    squares = frames.squares(points.T.astype(np.float32), np.arange(count)).astype(float)
    exact = triangle_distances(points.T, *corners.transpose(1, 2, 0))
    return np.sqrt(squares) + frames.slack, exact, frames.slack


@pytest.mark.parametrize("height", [1.0, 1e-3, 1e-6, 0.0], ids=["even", "thin", "slivers", "without area"])
def test_an_upper_bound_is_never_less_than_the_distance(height):
    bounds, exact, _ = bounds_and_distances(height)
    assert (bounds >= exact).all()


def test_slack_of_bounds_is_below_a_thousandth_of_a_millimetre_300_mm_from_the_origin():
    """float32 has steps of 3e-5 mm there; measured 5e-4."""
    _, _, slack = bounds_and_distances(1.0)
    assert slack < 1e-3


def test_bounds_of_points_over_the_face_are_the_distance():
    """Of a third of the points; the others lie beside their small triangle, where a bound may be larger."""
    bounds, exact, slack = bounds_and_distances(1.0)
    assert (bounds - exact <= 2.0 * slack).mean() > 0.3


def test_bounds_over_the_centres_of_a_sphere_are_the_distance():
    vertices, triangles = samples.sphere(radius=10.0, rounds=3)
    over_the_centres = 1.05 * vertices[triangles].mean(axis=1)
    frames = FaceFrames(vertices, triangles.astype(np.uint32))
    squares = frames.squares(over_the_centres.T.astype(np.float32), np.arange(len(triangles)))
    exact = triangle_distances(over_the_centres.T, *vertices[triangles].transpose(1, 2, 0))
    np.testing.assert_allclose(np.sqrt(squares), exact, atol=frames.slack)


LIMIT_MM = 0.5


@pytest.fixture(scope="module")
def points_near_vertices():
    """30,000 points, several pieces of work, each near a vertex of a torus.


    Triangles of the torus; for each point its vertex, its distance and triangle by the limit, its exact distance.
    """
    vertices, triangles = samples.torus(40, 24)
    near = NearDistance(vertices, triangles.astype(np.uint32))
    rng = np.random.default_rng(3)
    numbers = rng.integers(0, len(vertices), 30_000)
    points = vertices[numbers] + rng.normal(scale=0.6, size=(len(numbers), 3))
    distances, rows = near.find_surely_within(points, numbers, LIMIT_MM)
    exact, _ = near.find_around(points, numbers[:, None])
    return triangles, numbers, distances, rows, exact


def test_the_same_points_lie_surely_within_the_limit_as_exactly(points_near_vertices):
    _, _, distances, _, exact = points_near_vertices
    assert 0 < (exact <= LIMIT_MM).sum() < len(exact)
    np.testing.assert_array_equal(distances <= LIMIT_MM, exact <= LIMIT_MM)


def test_distances_beyond_the_limit_are_exact_and_within_it_upper_bounds(points_near_vertices):
    _, _, distances, _, exact = points_near_vertices
    beyond = distances > LIMIT_MM
    np.testing.assert_array_equal(distances[beyond], exact[beyond])
    assert (distances >= exact - tolerances.FLOAT64_PLACE_MM).all()


def test_the_triangle_of_each_point_is_one_around_its_vertex(points_near_vertices):
    triangles, numbers, _, rows, _ = points_near_vertices
    assert (triangles[rows] == numbers[:, None]).any(axis=1).all()


def test_a_point_near_an_unused_vertex_has_no_bound_and_no_triangle():
    vertices, triangles = samples.box()
    unused = len(vertices)
    near = NearDistance(np.concatenate([vertices, [[5.0, 5.0, 5.0]]]), triangles.astype(np.uint32))
    bounds, rows = near.find_upper_bounds(np.zeros((2, 3)), np.array([unused, 0]))
    assert (bounds[0], rows[0]) == (np.inf, -1)
    assert np.isfinite(bounds[1])


with_one_and_three_threads = pytest.mark.parametrize("threads", [1, 3])


@with_one_and_three_threads
@pytest.mark.parametrize("count", [1000, 0])
def test_work_in_threads_covers_each_row_once(monkeypatch, threads, count):
    monkeypatch.setattr(pieces, "count_readers", lambda *_: threads)
    calls_of_row = np.zeros(1000, dtype=int)

    def count_call(rows: slice) -> None:
        calls_of_row[rows] += 1

    pieces.in_threads(count_call, count, 64)
    assert (calls_of_row[:count] == 1).all()
    assert (calls_of_row[count:] == 0).all()


@with_one_and_three_threads
def test_an_error_in_one_piece_is_raised_by_the_whole(monkeypatch, threads):
    monkeypatch.setattr(pieces, "count_readers", lambda *_: threads)

    def fail_late(rows: slice) -> None:
        if rows.start > 500:
            raise ValueError("this piece")

    with pytest.raises(ValueError, match="this piece"):
        pieces.in_threads(fail_late, 1000, 64)
