"""Pictures as arrays, and the places that their pixels show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.errors import UsageError

CENTRE_MM, RADIUS_MM = 11.5, 8.0


@pytest.fixture(scope="module")
def ball_picture(device):
    """A picture of a ball of 8 mm in voxels of 1 mm: its HU fall by 20 a mm, the iso value lies at its radius."""
    k, j, i = np.indices((24, 24, 24)) - CENTRE_MM
    volume = clrecon.Volume((200.0 - 20.0 * np.sqrt(k**2 + j**2 + i**2)).astype(np.float32), np.eye(4))
    level = 200.0 - 20.0 * RADIUS_MM
    return clrecon.render(volume, mode="surface", iso_value=level, view=(30.0, 20.0), size=(60, 50), device=device)


def test_places_of_the_pixels_of_a_ball_lie_on_it(ball_picture):
    places = ball_picture.world_points()

    assert places.shape == (50, 60, 3)
    hit = np.isfinite(ball_picture.depth)
    assert hit.sum() > 300  # measured 424, as many pixels as a disc of the radius has
    assert np.linalg.norm(places[hit] - CENTRE_MM, axis=1) == pytest.approx(RADIUS_MM, abs=0.05)  # h^2 / 8 R is 0.02
    assert np.isnan(places[~hit]).all()


def test_places_of_pixels_are_the_points_of_the_picture_in_pyvista(ball_picture):
    hit = np.isfinite(ball_picture.depth)
    points = ball_picture.to_pyvista().points
    np.testing.assert_allclose(ball_picture.world_points()[hit], points, atol=1e-4)  # mm in float32


def test_picture_is_taken_for_an_array_of_its_image_without_a_copy(ball_picture):
    assert np.shares_memory(np.asarray(ball_picture), ball_picture.image)
    assert np.array_equal(np.asarray(ball_picture), ball_picture.image)


def test_picture_is_copied_into_an_array_of_another_type_or_on_request(ball_picture):
    assert np.array_equal(np.asarray(ball_picture, dtype=float), ball_picture.image)
    assert not np.shares_memory(np.array(ball_picture, copy=True), ball_picture.image)


@pytest.mark.parametrize(
    ("plane", "edges"),  # left, right, bottom, top
    [
        pytest.param("axial", (3.5 - 5, 3.5 + 5, 2.5 + 2.5, 2.5 - 2.5), id="along x, and down along y"),
        pytest.param("coronal", (3.5 - 5, 3.5 + 5, 1.5 - 2.5, 1.5 + 2.5), id="along x, and up along z"),
        pytest.param((30, 20), (-5, 5, -2.5, 2.5), id="oblique, from its middle"),
    ],
)
def test_edges_of_a_plane_are_mm_of_the_axes_that_it_runs_along(device, plane, edges):
    volume = clrecon.Volume(np.zeros((4, 6, 8), np.int16), np.eye(4))  # its middle: x 3.5, y 2.5, z 1.5 mm
    cut = clrecon.cut_slice(volume, plane, size=(20, 10), pixel_mm=0.5, device=device)  # 10 mm wide, 5 mm high
    assert cut.extent == pytest.approx(edges)


def test_edges_in_mm_of_a_perspective_picture_are_refused(ball_picture):
    with refused(UsageError, "axes", "mm"):
        _ = replace(ball_picture, camera=replace(ball_picture.camera, parallel_scale=None, view_angle=30.0)).extent


def test_places_of_a_picture_along_a_curve_are_refused(device):
    volume = clrecon.Volume(np.zeros((8, 8, 8), np.int16), np.eye(4))
    line = [(1.0, 3.0, 1.0), (3.0, 4.0, 4.0), (5.0, 3.0, 6.5)]
    made = clrecon.reformat_curve(volume, line, device=device)
    with refused(UsageError, "camera", "None"):
        made.world_points()
