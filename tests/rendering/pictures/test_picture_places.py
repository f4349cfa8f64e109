"""Pictures as arrays, and the places that their pixels show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.errors import UsageError


@pytest.fixture(scope="module")
def shot(device):
    k, j, i = np.indices((24, 24, 24))
    ball = 200.0 - 20.0 * np.sqrt((k - 11.5) ** 2 + (j - 11.5) ** 2 + (i - 11.5) ** 2)
    volume = clrecon.Volume(ball.astype(np.float32), np.eye(4))
    return clrecon.render(volume, mode="surface", iso_value=40.0, view=(30.0, 20.0), size=(60, 50), device=device)


def test_pixels_of_a_ball_lie_on_it(shot):
    points = shot.world_points()
    assert points.shape == (50, 60, 3)
    hit = np.isfinite(shot.depth)
    assert hit.sum() > 300 and np.isnan(points[~hit]).all()
    assert np.linalg.norm(points[hit] - 11.5, axis=1) == pytest.approx(8.0, abs=0.05)
    np.testing.assert_allclose(points[hit], shot.to_pyvista().points, atol=1e-4)


def test_a_picture_is_an_array(shot):
    assert np.asarray(shot) is shot.image or np.shares_memory(np.asarray(shot), shot.image)
    assert np.asarray(shot, dtype=float).max() == shot.image.max()
    assert not np.shares_memory(np.array(shot, copy=True), shot.image)


@pytest.mark.parametrize(
    ("plane", "middle", "ways"),
    [("axial", (3.5, 2.5), (1, 1)), ("coronal", (3.5, 1.5), (1, -1)), ((30, 20), (0, 0), (1, -1))],
)
def test_edges_of_a_plane_are_mm_of_the_axes_that_it_runs_along(device, plane, middle, ways):
    volume = clrecon.Volume(np.zeros((4, 6, 8), np.int16), np.eye(4))
    cut = clrecon.cut_slice(volume, plane, (20, 10), pixel_mm=0.5, device=device)
    (across, down), (right, below) = middle, ways
    assert cut.extent == pytest.approx((across - 5 * right, across + 5 * right, down + 2.5 * below, down - 2.5 * below))


def test_a_perspective_picture_has_no_edges_in_mm(shot):
    with refused(UsageError, "axes", "mm"):
        _ = replace(shot, camera=replace(shot.camera, parallel_scale=None, view_angle=30.0)).extent


def test_a_cut_has_no_places_of_depth(device):
    volume = clrecon.Volume(np.zeros((8, 8, 8), np.int16), np.eye(4))
    line = [(1.0, 3.0, 1.0), (3.0, 4.0, 4.0), (5.0, 3.0, 6.5)]
    made = clrecon.reformat_curve(volume, line, device=device)
    with refused(UsageError, "camera", "None"):
        made.world_points()
