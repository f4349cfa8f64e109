"""The nearest triangle to a point and the first on a line: as all triangles looked at one by one, and as VTK finds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from sample_meshes import sphere

from clrecon.mesh import triangle_tree
from clrecon.mesh.compare.distances import triangle_distances
from clrecon.mesh.triangle_tree import TriangleTree


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def random_triangles(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of all sizes, the first three without area: two equal corners, all three, three in a line."""
    rng = np.random.default_rng(6)
    sizes = np.exp(rng.normal(0.0, 1.5, (count, 1, 1)))
    corners = rng.normal(0.0, 10.0, (count, 1, 3)) + rng.normal(0.0, 1.0, (count, 3, 3)) * sizes
    corners[0, 1] = corners[0, 0]
    corners[1] = corners[1, 0]
    corners[2] = [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]
    return corners.reshape(-1, 3), np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)


def least_distance(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return for each point its distance from the nearest of all triangles, measured one by one."""
    a, b, c = vertices[triangles].transpose(1, 2, 0)
    every = [triangle_distances(np.repeat(point[:, None], len(triangles), axis=1), a, b, c) for point in points]
    return np.min(every, axis=1)


@pytest.mark.parametrize("count", [3, 7, 500])
def test_the_nearest_distance_is_the_least_to_all_triangles(rng: np.random.Generator, count: int) -> None:
    vertices, triangles = random_triangles(count)
    far_away, at_vertices = [[1e4, 0.0, 0.0]], vertices[:5]
    points = np.concatenate([rng.normal(0.0, 12.0, (200, 3)), far_away, at_vertices])
    _, _, distances = TriangleTree(vertices, triangles).nearest(points)
    expected = least_distance(vertices, triangles, points)
    np.testing.assert_allclose(distances, expected, rtol=tolerances.FLOAT64_SHARE, atol=tolerances.FLAT_TRIANGLE_MM)


@pytest.mark.parametrize("count", [3, 7, 500])
def test_the_nearest_place_lies_on_its_triangle_at_its_distance(rng: np.random.Generator, count: int) -> None:
    vertices, triangles = random_triangles(count)
    points = rng.normal(0.0, 12.0, (200, 3))
    places, rows, distances = TriangleTree(vertices, triangles).nearest(points)
    np.testing.assert_allclose(np.linalg.norm(places - points, axis=1), distances, rtol=tolerances.FLOAT64_SHARE)
    corners = vertices[triangles[rows]].transpose(1, 2, 0)
    assert triangle_distances(places.T, *corners) == pytest.approx(0.0, abs=tolerances.FLAT_TRIANGLE_MM)


@pytest.mark.parametrize("away_mm", [1.0, 30.0, 1000.0])
def test_the_nearest_distance_of_points_around_a_sphere_is_the_least_to_all_triangles(
    rng: np.random.Generator, away_mm: float
) -> None:
    vertices, triangles = sphere(radius=10.0, rounds=3)
    directions = rng.normal(size=(300, 3))
    points = (10.0 + away_mm) * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    _, _, distances = TriangleTree(vertices, triangles).nearest(points)

    expected = least_distance(vertices, triangles, points)
    np.testing.assert_allclose(distances, expected, rtol=tolerances.FLOAT64_SHARE)


def test_points_near_a_surface_are_measured_against_few_triangles(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, triangles = sphere(rounds=4)
    sizes: list[int] = []
    shares = triangle_tree.nearest_shares

    def count_shares(away: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, ...]:
        sizes.append(away.shape[1])
        return shares(away, b, c)

    monkeypatch.setattr(triangle_tree, "nearest_shares", count_shares)

    TriangleTree(vertices, triangles).nearest(1.001 * vertices[triangles].mean(axis=1))

    assert sum(sizes) <= 16 * len(triangles)  # 10.9 each; 26 where one leaf beside the curve is looked at first


def test_results_do_not_depend_on_the_pairs_that_are_looked_at_together(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    vertices, triangles = random_triangles(300)
    tree = TriangleTree(vertices, triangles)
    points = rng.normal(0.0, 1.0, (40, 3))
    ends = 100.0 * rng.normal(0.0, 1.0, (40, 3))
    places, _, _ = tree.nearest(points)
    hits = tree.first_hits(points, ends)

    monkeypatch.setattr(triangle_tree, "MOST_PAIRS", 50)  # 40 points alone have more

    places_in_pieces, _, _ = tree.nearest(points)
    np.testing.assert_array_equal(places_in_pieces, places)
    np.testing.assert_array_equal(tree.first_hits(points, ends), hits)


@pytest.fixture(scope="module")
def tree_and_locator() -> tuple[TriangleTree, Any]:
    """The same 400 triangles for us and for VTK, which misses places on triangles without area."""
    vtk = pytest.importorskip("vtkmodules.vtkCommonDataModel")
    from clrecon.exchange.vtp import make_polydata

    vertices, triangles = random_triangles(403)
    vertices, triangles = vertices.astype(np.float32), triangles[3:]  # without the three that have no area
    locator = vtk.vtkStaticCellLocator()
    locator.SetDataSet(make_polydata(vertices, triangles, None))
    locator.BuildLocator()
    return TriangleTree(vertices, triangles), locator


def hit_by_vtk(locator: Any, start: np.ndarray, end: np.ndarray) -> list[float]:
    """Where a line first meets a triangle, or NaN."""
    from vtkmodules.vtkCommonCore import reference

    hit, parameters = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    share, part, cell = reference(0.0), reference(0), reference(0)
    meets = locator.IntersectWithLine(start, end, 1e-9, share, hit, parameters, part, cell)
    return hit if meets else [np.nan] * 3


def distance_by_vtk(locator: Any, point: np.ndarray) -> float:
    from vtkmodules.vtkCommonCore import reference
    from vtkmodules.vtkCommonDataModel import vtkGenericCell

    square = reference(0.0)
    locator.FindClosestPoint(point, [0.0, 0.0, 0.0], vtkGenericCell(), reference(0), reference(0), square)
    return float(square) ** 0.5


def test_lines_first_meet_triangles_where_vtk_finds(
    rng: np.random.Generator, tree_and_locator: tuple[TriangleTree, Any]
) -> None:
    tree, locator = tree_and_locator
    starts, ends = rng.normal(0.0, 20.0, (2, 300, 3))
    theirs = np.array([hit_by_vtk(locator, start, end) for start, end in zip(starts, ends, strict=True)])
    ours = tree.first_hits(starts, ends)
    met = np.isfinite(theirs[:, 0]).sum()
    assert 100 < met < len(starts), "some lines meet a triangle, and some meet none"  # measured 252 of 300
    np.testing.assert_allclose(ours, theirs, atol=tolerances.VTK_HIT_MM)


def test_points_have_the_distance_that_vtk_finds(
    rng: np.random.Generator, tree_and_locator: tuple[TriangleTree, Any]
) -> None:
    tree, locator = tree_and_locator
    points = rng.normal(0.0, 20.0, (300, 3))
    theirs = [distance_by_vtk(locator, point) for point in points]
    _, _, ours = tree.nearest(points)
    np.testing.assert_allclose(ours, theirs, atol=tolerances.VTK_HIT_MM)


@pytest.fixture
def square_and_its_diagonal() -> tuple[TriangleTree, np.ndarray]:
    """Two triangles of a square in the plane z = 0, and points 1 mm over their common edge."""
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    along = np.linspace(0.01, 0.99, 50)
    points = np.column_stack([along, along, np.ones(50)])
    return TriangleTree(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.uint32)), points


def test_lines_through_the_common_edge_of_two_triangles_meet_it(
    square_and_its_diagonal: tuple[TriangleTree, np.ndarray],
) -> None:
    tree, points = square_and_its_diagonal
    hits = tree.first_hits(points, points * [1.0, 1.0, -1.0])
    np.testing.assert_allclose(hits, points * [1.0, 1.0, 0.0], atol=tolerances.NEAREST_MM)


def test_lines_that_point_away_from_a_surface_meet_nothing(
    square_and_its_diagonal: tuple[TriangleTree, np.ndarray],
) -> None:
    tree, points = square_and_its_diagonal
    assert np.isnan(tree.first_hits(points, points + [0.0, 0.0, 1.0])).all()
