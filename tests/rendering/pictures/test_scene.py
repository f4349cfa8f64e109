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
PLACE = {"position": (10.0, -400.0, 870.0), "focal_point": (12.0, -30.0, 850.0), "up": (0.2, 0, 1)}
CAMERAS = [Camera(**PLACE, parallel_scale=60.0), Camera(**PLACE, view_angle=25.0)]
of_each_camera = pytest.mark.parametrize("camera", CAMERAS, ids=["parallel", "perspective"])
INFINITE = np.float32(np.nan)  # the depth of a pixel that hits nothing


def make_picture(camera: Camera | None) -> Rendering:
    """Random colours, depths and HU, eight of whose pixels hit nothing."""
    random = np.random.default_rng(4)
    image = random.integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)
    image[..., 3] = 255
    depth = random.uniform(300.0, 500.0, (HEIGHT, WIDTH)).astype(np.float32)
    depth[2:4, 5:9] = np.nan
    image[2:4, 5:9] = 0
    values = np.where(np.isnan(depth), np.nan, random.normal(200.0, 50.0, depth.shape)).astype(np.float32)
    return Rendering(image, depth, depth + np.float32(7.0), camera, values=values)


def pixel_centres() -> np.ndarray:
    """Column and row of the centre of every pixel, row after row."""
    rows, columns = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    return np.column_stack([columns, rows]) + 0.5


@of_each_camera
@pytest.mark.parametrize("expected", [False, True], ids=["first hit", "expected depth"])
def test_points_lie_on_the_rays_of_the_pixels_that_hit_at_their_depths(camera, expected):
    pytest.importorskip("pyvista")
    made = make_picture(camera)

    cloud = made.to_pyvista(expected=expected)

    hit = np.isfinite(made.depth)
    pixels, depths = camera.project(np.asarray(cloud.points, dtype=np.float64), made.size)
    truth = made.expected_depth if expected else made.depth
    assert np.abs(pixels - pixel_centres()[hit.ravel()]).max() <= tolerances.FLOAT32_POINT_PIXEL
    assert np.abs(depths - truth[hit]).max() <= tolerances.FLOAT32_POINT_MM


@pytest.mark.parametrize("expected", [False, True], ids=["first hit", "expected depth"])
def test_points_carry_the_colours_depths_and_hu_of_their_pixels(expected):
    pytest.importorskip("pyvista")
    made = make_picture(CAMERAS[0])

    cloud = made.to_pyvista(expected=expected)

    hit = np.isfinite(made.depth)
    truth = made.expected_depth if expected else made.depth
    assert np.array_equal(cloud.point_data["RGBA"], made.image[hit])
    assert np.array_equal(cloud.point_data["depth"], truth[hit])
    assert np.array_equal(cloud.point_data["HU"], made.values[hit])


def test_points_say_their_space_and_unit():
    pytest.importorskip("pyvista")

    cloud = make_picture(CAMERAS[0]).to_pyvista()

    assert (cloud.field_data["SPACE"][0], cloud.field_data["UNIT"][0]) == ("LPS", "mm")


@of_each_camera
@pytest.mark.parametrize("distance", [None, 123.0], ids=["at the focal point", "at 123 mm"])
def test_cells_of_the_plane_lie_on_the_rays_of_the_pixels_at_the_distance_asked_for(camera, distance):
    pytest.importorskip("pyvista")
    made = make_picture(camera)

    plane = made.to_pyvista("plane", distance=distance)

    centres = np.asarray(plane.cell_centers().points, dtype=np.float64)
    pixels, _ = camera.project(centres, made.size)
    along = (centres - camera.position) @ camera.basis().forward
    assert np.abs(pixels - pixel_centres()).max() <= tolerances.FLOAT32_POINT_PIXEL
    assert along == pytest.approx(camera.distance if distance is None else distance, abs=tolerances.FLOAT32_POINT_MM)


def test_cells_of_the_plane_carry_the_colours_and_hu_of_the_pixels():
    pytest.importorskip("pyvista")
    made = make_picture(CAMERAS[0])

    plane = made.to_pyvista("plane")

    assert np.array_equal(plane.cell_data["RGBA"], made.image.reshape(-1, 4))
    assert np.array_equal(plane.cell_data["HU"], made.values.ravel(), equal_nan=True)


@pytest.mark.parametrize(
    ("camera", "asked", "says"),
    [
        pytest.param(None, {}, ["projection"], id="a picture without a camera"),
        pytest.param(CAMERAS[0], {"form": "mesh"}, ["points", "plane", "mesh"], id="an unknown form"),
        pytest.param(CAMERAS[0], {"form": "plane", "distance": -3.0}, ["distance", -3], id="a plane behind the camera"),
        pytest.param(CAMERAS[0], {"distance": 3.0}, ["distance", "plane"], id="points at a distance"),
    ],
)
def test_picture_that_has_no_place_in_space_is_refused(camera, asked, says):
    made = make_picture(camera)

    with refused(UsageError, *says):
        made.to_pyvista(**asked)


def one_pixel(*, color, depth) -> Rendering:
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


@pytest.mark.parametrize(
    ("color", "depth", "scene_color", "scene_depth", "merged", "first", "expected"), LAYERS.values(), ids=LAYERS
)
def test_nearer_layer_covers_the_other_as_far_as_it_is_opaque(
    color, depth, scene_color, scene_depth, merged, first, expected
):
    picture = one_pixel(color=color, depth=depth)
    made = merge_layers(picture, np.array([[scene_color]], np.uint8), np.array([[scene_depth]]))

    assert made.image[0, 0] == pytest.approx(merged, abs=1)  # one grey level of rounding
    assert made.depth[0, 0] == pytest.approx(first, nan_ok=True)
    assert made.expected_depth[0, 0] == pytest.approx(expected, nan_ok=True)


def test_merged_picture_keeps_the_camera_and_loses_its_values():
    made = merge_layers(make_picture(CAMERAS[0]), np.zeros((HEIGHT, WIDTH, 4), np.uint8), np.ones((HEIGHT, WIDTH)))

    assert made.values is None
    assert made.camera is CAMERAS[0]


def test_opaque_picture_without_depth_is_refused_as_a_layer():
    colors, depth = np.zeros((1, 1, 4), np.uint8), np.full((1, 1), np.nan)

    with refused(UsageError, "transparent", "background"):
        merge_layers(one_pixel(color=(255, 255, 255, 255), depth=np.nan), colors, depth)


def test_scene_of_another_size_is_refused_as_a_layer():
    colors, depth = np.zeros((1, 1, 4), np.uint8), np.full((1, 1), np.nan)

    with refused(UsageError, WIDTH, HEIGHT):
        merge_layers(make_picture(CAMERAS[0]), colors, depth)
