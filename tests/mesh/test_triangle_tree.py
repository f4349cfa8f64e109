"""The nearest triangle to a point and the first on a line: as all triangles looked at one by one, and as VTK finds."""

from __future__ import annotations

import numpy as np
import pytest
from sample_meshes import sphere

from clrecon.mesh import triangle_tree
from clrecon.mesh.compare.distances import triangle_distances
from clrecon.mesh.triangle_tree import TriangleTree

RANDOM = np.random.default_rng(5)


def soup(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of all sizes, some without area: two equal corners, all three, three in a line."""
    corners = RANDOM.normal(0.0, 10.0, (count, 1, 3)) + RANDOM.normal(0.0, 1.0, (count, 3, 3)) * np.exp(
        RANDOM.normal(0.0, 1.5, (count, 1, 1))
    )
    corners[0, 1] = corners[0, 0]
    corners[1] = corners[1, 0]
    corners[2] = [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]
    return corners.reshape(-1, 3), np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)


def least_distance(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    a, b, c = vertices[triangles].transpose(1, 2, 0)
    every = [triangle_distances(np.repeat(point[:, None], len(triangles), axis=1), a, b, c) for point in points]
    return np.min(every, axis=1)


@pytest.mark.parametrize("count", [3, 7, 500])
def test_the_nearest_place_is_that_of_all_triangles(count: int) -> None:
    vertices, triangles = soup(count)
    points = np.concatenate([RANDOM.normal(0.0, 12.0, (200, 3)), [[1e4, 0.0, 0.0]], vertices[:5]])
    places, rows, distances = TriangleTree(vertices, triangles).nearest(points)
    np.testing.assert_allclose(distances, least_distance(vertices, triangles, points), rtol=1e-12, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(places - points, axis=1), distances, rtol=1e-12)
    for place, row in zip(places, rows, strict=True):
        assert least_distance(vertices, triangles[row : row + 1], place[None]) == pytest.approx(0.0, abs=1e-6), row


@pytest.mark.parametrize("away_mm", [1.0, 30.0, 1000.0])
def test_the_nearest_place_of_far_points_is_that_of_all_triangles(away_mm: float) -> None:
    vertices, triangles = sphere(radius=10.0, rounds=3)
    directions = RANDOM.normal(size=(300, 3))
    points = (10.0 + away_mm) * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    distances = TriangleTree(vertices, triangles).nearest(points)[2]

    np.testing.assert_allclose(distances, least_distance(vertices, triangles, points), rtol=1e-12)


def test_pieces_with_too_many_pairs_part(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, triangles = soup(300)
    points = RANDOM.normal(0.0, 1.0, (40, 3))
    tree = TriangleTree(vertices, triangles)
    ends = 100.0 * RANDOM.normal(0.0, 1.0, (40, 3))
    whole = tree.nearest(points), tree.first_hits(points, ends)
    monkeypatch.setattr(triangle_tree, "MOST_PAIRS", 50)
    np.testing.assert_array_equal(tree.nearest(points)[0], whole[0][0])
    np.testing.assert_array_equal(tree.first_hits(points, ends), whole[1])


def test_lines_and_points_find_what_vtk_finds() -> None:
    vtk = pytest.importorskip("vtkmodules.vtkCommonDataModel")
    from vtkmodules.vtkCommonCore import reference

    from clrecon.exchange.vtp import make_polydata

    vertices, triangles = soup(400)
    vertices = vertices.astype(np.float32)
    locator = vtk.vtkStaticCellLocator()
    polydata = make_polydata(vertices, triangles, None)
    locator.SetDataSet(polydata)
    locator.BuildLocator()
    starts, ends = RANDOM.normal(0.0, 20.0, (2, 300, 3))
    found = TriangleTree(vertices, triangles).first_hits(starts, ends)
    hit, nearest, square = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], reference(0.0)
    met = 0
    for start, end, place in zip(starts, ends, found, strict=True):
        meets = locator.IntersectWithLine(start, end, 1e-9, reference(0.0), hit, [0.0] * 3, reference(0), reference(0))
        assert bool(meets) == bool(np.isfinite(place).all()), (start, end)
        if meets:
            np.testing.assert_allclose(place, hit, atol=1e-6)
            met += 1
    assert 100 < met < 300, "lines that meet and lines that miss"
    for point, distance in zip(starts, TriangleTree(vertices, triangles).nearest(starts)[2], strict=True):
        locator.FindClosestPoint(point, nearest, vtk.vtkGenericCell(), reference(0), reference(0), square)
        assert distance == pytest.approx(np.sqrt(square.get()), abs=1e-6)


def test_a_line_between_two_triangles_meets_one() -> None:
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    tree = TriangleTree(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.uint32))
    share = np.linspace(0.01, 0.99, 50)
    starts = np.column_stack([share, share, np.full(50, 1.0)])
    found = tree.first_hits(starts, starts * [1.0, 1.0, -1.0])
    np.testing.assert_allclose(found, np.column_stack([share, share, np.zeros(50)]), atol=1e-12)
    assert np.isnan(tree.first_hits(starts, starts + [0.0, 0.0, 1.0])).all(), "lines that point away"
