"""Upper bounds of distances, and work in pieces and threads."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh.compare.distances import FaceFrames, NearDistance, triangle_distances
from clrecon.system import pieces

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("thin", [1.0, 1e-3, 1e-6, 0.0])
def test_an_upper_bound_is_never_less_than_the_distance(thin):
    """Also of slivers and of triangles without area, 300 mm from the origin of float32 coordinates."""
    rng = np.random.default_rng(8)
    count = 4000
    a = rng.uniform(-300.0, 300.0, (count, 3))
    along = rng.normal(size=(count, 3))
    corners = np.stack([a, a + along, a + 0.7 * along + thin * rng.normal(size=(count, 3))], axis=1)
    points = a + rng.normal(scale=0.7, size=(count, 3))
    frames = FaceFrames(corners.reshape(-1, 3), np.arange(3 * count, dtype=np.uint32).reshape(-1, 3))
    found = np.sqrt(frames.squares(points.T.astype(np.float32), np.arange(count)).astype(float)) + frames.slack
    exact = triangle_distances(points.T, *corners.transpose(1, 2, 0))
    assert (found >= exact).all()
    assert frames.slack < 1e-3
    if thin == 1.0:  # most feet lie beside such small triangles; over a face the bound is the distance
        assert (found - exact <= 2.0 * frames.slack).mean() > 0.2


def test_bound_over_a_face_is_the_distance():
    vertices, triangles = samples.sphere(radius=10.0, rounds=3)
    centres = vertices[triangles].mean(axis=1)
    frames = FaceFrames(vertices, triangles.astype(np.uint32))
    out = centres * 1.05
    square = frames.squares(out.T.astype(np.float32), np.arange(len(triangles)))
    exact = triangle_distances(out.T, *vertices[triangles].transpose(1, 2, 0))
    np.testing.assert_allclose(np.sqrt(square), exact, atol=frames.slack)


def test_points_surely_within_are_within_and_the_rest_are_exact():
    vertices, triangles = samples.torus(40, 24)
    near = NearDistance(vertices, triangles.astype(np.uint32))
    rng = np.random.default_rng(3)
    at = rng.integers(0, len(vertices), 30_000)  # several pieces, so threads
    points = vertices[at] + rng.normal(scale=0.6, size=(len(at), 3))
    found, rows = near.find_surely_within(points, at, 0.5)
    exact, _ = near.find_around(points, at[:, None])
    assert (found >= exact - 1e-9).all() and ((found <= 0.5) | (found == exact)).all()
    np.testing.assert_array_equal(found <= 0.5, exact <= 0.5)
    assert (triangles[rows] == at[:, None]).any(axis=1).all()
    lonely = NearDistance(np.concatenate([vertices, [[5.0, 5.0, 5.0]]]), triangles.astype(np.uint32))
    length, row = lonely.find_upper_bounds(points[:2], np.array([len(vertices), at[1]]))
    assert (length[0], row[0]) == (np.inf, -1) and np.isfinite(length[1])


@pytest.mark.parametrize("threads", [1, 3])
def test_pieces_cover_all_and_errors_come_through(monkeypatch, threads):
    monkeypatch.setattr(pieces, "count_readers", lambda *_: threads)
    seen = np.zeros(1000, dtype=int)

    def work(where: slice) -> None:
        seen[where] += 1

    pieces.in_threads(work, 1000, 64)
    assert (seen == 1).all()
    pieces.in_threads(work, 0, 64)

    def fail(where: slice) -> None:
        if where.start > 500:
            raise ValueError("this piece")

    with pytest.raises(ValueError, match="this piece"):
        pieces.in_threads(fail, 1000, 64)
