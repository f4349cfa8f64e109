"""Pictures as points and planes in a scene, and layers of picture and scene put together by their depths."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.picture import merge_layers
from clrecon.rendering.views.camera import Camera

WIDTH, HEIGHT = 14, 9
CAMERAS = [
    Camera((10.0, -400.0, 870.0), (12.0, -30.0, 850.0), (0.2, 0, 1), parallel_scale=60.0),
    Camera((10.0, -400.0, 870.0), (12.0, -30.0, 850.0), (0.2, 0, 1), view_angle=25.0),
]
INFINITE = np.float32(np.nan)


def picture(camera: Camera | None, opacity: int = 255) -> Rendering:
    random = np.random.default_rng(4)
    image = random.integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)
    image[..., 3] = opacity
    depth = random.uniform(300.0, 500.0, (HEIGHT, WIDTH)).astype(np.float32)
    depth[2:4, 5:9] = np.nan
    image[2:4, 5:9] = 0
    values = np.where(np.isnan(depth), np.nan, random.normal(200.0, 50.0, depth.shape)).astype(np.float32)
    return Rendering(image, depth, depth + np.float32(7.0), camera, values=values)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("expected", [False, True])
def test_points_lie_on_the_rays_of_their_pixels(camera, expected):
    pytest.importorskip("pyvista")
    made = picture(camera)
    cloud = made.to_pyvista(expected=expected)
    assert cloud.n_points == WIDTH * HEIGHT - 8
    pixels, depths = camera.project(np.asarray(cloud.points, dtype=np.float64), made.size)
    hit = np.isfinite(made.depth)
    rows, columns = np.nonzero(hit)
    assert np.abs(pixels - np.column_stack([columns, rows]) - 0.5).max() <= tolerances.FLOAT32_POINT_PIXEL
    truth = made.expected_depth if expected else made.depth
    assert np.abs(depths - truth[hit]).max() <= tolerances.FLOAT32_POINT_MM
    assert np.array_equal(cloud.point_data["RGBA"], made.image[hit])
    assert np.array_equal(cloud.point_data["depth"], truth[hit])
    assert np.array_equal(cloud.point_data["HU"], made.values[hit])
    assert (cloud.field_data["SPACE"][0], cloud.field_data["UNIT"][0]) == ("LPS", "mm")


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("distance", [None, 123.0])
def test_cells_of_the_plane_are_the_pixels(camera, distance):
    pytest.importorskip("pyvista")
    made = picture(camera)
    plane = made.to_pyvista("plane", distance=distance)
    centres = np.asarray(plane.cell_centers().points, dtype=np.float64)
    pixels, depths = camera.project(centres, made.size)
    rows, columns = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    assert np.abs(pixels - np.column_stack([columns, rows]) - 0.5).max() <= tolerances.FLOAT32_POINT_PIXEL
    along = (centres - camera.position) @ camera.basis().forward
    assert along == pytest.approx(camera.distance if distance is None else distance, abs=tolerances.FLOAT32_POINT_MM)
    assert (depths >= along - tolerances.FLOAT32_POINT_MM).all()
    assert np.array_equal(plane.cell_data["RGBA"], made.image.reshape(-1, 4))
    assert np.array_equal(plane.cell_data["HU"], made.values.ravel(), equal_nan=True)


def test_what_has_no_place_in_space_is_refused():
    with pytest.raises(UsageError, match="no projection"):
        picture(None).to_pyvista()
    with pytest.raises(UsageError, match="points or plane, not as 'mesh'"):
        picture(CAMERAS[0]).to_pyvista("mesh")
    with pytest.raises(UsageError, match="distance above 0 mm, not at -3"):
        picture(CAMERAS[0]).to_pyvista("plane", distance=-3.0)
    with pytest.raises(UsageError, match="distance is for form='plane'"):
        picture(CAMERAS[0]).to_pyvista(distance=3.0)


def one_pixel(color, depth) -> Rendering:
    """A picture of one pixel whose expected depth is 2 mm behind its first hit."""
    first = np.full((1, 1), depth, np.float32)
    return Rendering(np.array([[color]], np.uint8), first, first + np.float32(2.0), CAMERAS[0])


RED, GREEN, CLEAR = (200, 0, 0, 255), (0, 100, 0, 255), (0, 0, 0, 0)
HALF_RED = (200, 0, 0, 127)
LAYERS = {
    "scene behind an opaque picture": (RED, 50.0, GREEN, 60.0, RED, 50.0, 52.0),
    "scene before it": (RED, 50.0, GREEN, 40.0, GREEN, 40.0, 40.0),
    "no scene": (HALF_RED, 50.0, CLEAR, INFINITE, HALF_RED, 50.0, 52.0),
    "no picture": (CLEAR, INFINITE, GREEN, 60.0, GREEN, 60.0, 60.0),
    "neither": (CLEAR, INFINITE, CLEAR, INFINITE, CLEAR, np.nan, np.nan),
    "a trace of the picture without a depth": ((200, 0, 0, 1), INFINITE, GREEN, 60.0, GREEN, 60.0, 60.0),
    "a depth without a colour is nothing": (RED, 50.0, (9, 9, 9, 0), 40.0, RED, 50.0, 52.0),
    "half of the scene shines through": (
        HALF_RED, 50.0, GREEN, 60.0, (100, 50, 0, 255), 50.0, (127 * 52 + 128 * 60) / 255,
    ),
    "between first hit and expected depth": (HALF_RED, 50.0, GREEN, 51.0, GREEN, 50.0, 51.0),
}  # fmt: skip


@pytest.mark.parametrize("name", LAYERS)
def test_the_nearer_layer_covers_the_other(name):
    color, depth, scene_color, scene_depth, merged, first, expected = LAYERS[name]
    made = merge_layers(one_pixel(color, depth), np.array([[scene_color]], np.uint8), np.array([[scene_depth]]))
    assert made.image[0, 0] == pytest.approx(merged, abs=1)
    assert made.depth[0, 0] == pytest.approx(first, nan_ok=True)
    assert made.expected_depth[0, 0] == pytest.approx(expected, nan_ok=True)
    assert made.values is None and made.camera is CAMERAS[0]


def test_pictures_that_hide_the_scene_and_other_sizes_are_refused():
    colors, depth = np.zeros((1, 1, 4), np.uint8), np.full((1, 1), np.nan)
    with refused(UsageError, "transparent", "background"):
        merge_layers(one_pixel((255, 255, 255, 255), np.nan), colors, depth)
    with refused(UsageError, 14, 9):
        merge_layers(picture(CAMERAS[0]), colors, depth)
