"""Meshes and pictures in one PyVista scene, drawn off screen by whatever OpenGL there is."""

from __future__ import annotations

import drawn_balls
import numpy as np
import pytest
import tolerances
from drawn_balls import CAMERAS, CENTRE, RADIUS, need_off_screen
from refusals import refused
from variants import daily

from clrecon.errors import UsageError
from clrecon.rendering import Rendering
from clrecon.rendering.views.camera import Camera
from clrecon.viewer import add_rendering, merge_scene

pyvista = pytest.importorskip("pyvista")

SIZE = (120, 90)
RED, GREEN = (250, 40, 10), (0, 200, 0)


@pytest.fixture(scope="module", autouse=True)
def can_draw():
    """Skip where nothing can be drawn off screen."""
    need_off_screen()


@pytest.fixture
def plotter():
    """An empty scene of `SIZE`, off screen."""
    made = pyvista.Plotter(off_screen=True, window_size=SIZE)
    yield made
    made.close()


def ball(camera: Camera, *, center=CENTRE, color=RED) -> Rendering:
    """The picture of a ball of `RADIUS` mm."""
    return drawn_balls.ball(camera, SIZE, center=center, radius=RADIUS, color=color)


@pytest.mark.seconds
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("form", daily(1, ["points", "plane"]))
def test_picture_in_a_scene_is_itself_seen_by_its_own_camera(plotter, camera, form):
    made = ball(camera)
    made.image[..., 1] = np.arange(SIZE[1], dtype=np.uint8)[:, None]
    made.image[..., 2] = np.arange(SIZE[0], dtype=np.uint8)
    plotter.set_background("black")
    add_rendering(plotter, made, form)
    seen = np.array(plotter.screenshot(return_img=True))[..., :3].astype(int)
    shown = made.image[..., 3:] / 255 * made.image[..., :3]
    assert np.abs(seen - shown).max() <= tolerances.DRAWN_PICTURE_LEVELS
    assert Camera.from_pyvista(plotter).position == camera.position


def test_picture_added_to_a_scene_leaves_the_camera_where_it_is_on_request(plotter):
    plotter.camera = CAMERAS[1].orbit(30.0).to_pyvista()
    add_rendering(plotter, ball(CAMERAS[1]), move_camera=False)
    assert Camera.from_pyvista(plotter).position == CAMERAS[1].orbit(30.0).position


def test_points_of_a_picture_in_a_scene_lie_on_the_ball_that_it_shows(plotter):
    camera = CAMERAS[0]
    actor = add_rendering(plotter, ball(camera))
    points = np.asarray(actor.mapper.dataset.points)
    assert np.linalg.norm(points - CENTRE, axis=1) == pytest.approx(RADIUS, abs=tolerances.FLOAT32_POINT_MM)


RIGHT, _, FORWARD = CAMERAS[0].basis()


@pytest.mark.parametrize(
    "center",
    [CENTRE - 30.0 * FORWARD + 8.0 * RIGHT, CENTRE + 30.0 * FORWARD + 8.0 * RIGHT, CENTRE + 14.0 * RIGHT],
    ids=["before", "behind", "within"],
)
def test_green_ball_of_a_mesh_and_red_one_of_a_picture_cover_each_other_as_in_space(plotter, center):
    mesh = pyvista.Sphere(radius=RADIUS, center=center, theta_resolution=120, phi_resolution=120)
    plotter.add_mesh(mesh, color=GREEN, lighting=False)
    red_ball, green_ball = ball(CAMERAS[0]), ball(CAMERAS[0], center=center, color=GREEN)

    merged = merge_scene(plotter, red_ball)

    red, green = (np.nan_to_num(picture.depth, nan=np.inf) for picture in (red_ball, green_ball))
    is_red, is_green = merged.image[..., 0] > 200, merged.image[..., 1] > 150  # of 250 and 200
    differs = (is_red != ((red < green) & np.isfinite(red))) | (is_green != (green < red))
    assert differs.mean() <= tolerances.DRAWN_OUTLINE_SHARE
    hit = np.isfinite(np.minimum(red, green)) & ~differs & (merged.image[..., 3] == 255)
    assert np.abs(merged.depth - np.minimum(red, green))[hit].max() <= tolerances.DRAWN_DEPTH_MM


@pytest.mark.parametrize("background", ["black", "white", "steelblue"])
def test_translucent_mesh_before_a_picture_keeps_its_colour_on_any_background(plotter, background):
    plotter.set_background(background)
    before = CENTRE - 50.0 * CAMERAS[0].basis().forward
    sheet = pyvista.Plane(center=before, direction=CAMERAS[0].basis().forward, i_size=500.0, j_size=500.0)
    opacity = 0.4
    plotter.add_mesh(sheet, color=GREEN, opacity=opacity, lighting=False)
    picture = ball(CAMERAS[0], color=RED)
    made = merge_scene(plotter, picture)
    on_ball = np.isfinite(picture.depth)
    assert np.abs(made.image[~on_ball] - np.array([*GREEN, 255.0 * opacity])).max() <= tolerances.DRAWN_BLEND_LEVELS
    both = opacity * np.array(GREEN) + (1.0 - opacity) * np.array(RED)
    assert np.abs(made.image[on_ball] - np.array([*both, 255.0])).max() <= tolerances.DRAWN_BLEND_LEVELS
    assert plotter.background_color == pyvista.Color(background)


def test_picture_without_a_projection_is_not_merged(plotter):
    without_camera = Rendering(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)), camera=None)
    with refused(UsageError, "projection"):
        merge_scene(plotter, without_camera)


def test_picture_is_not_merged_into_a_scene_of_several_views():
    two = pyvista.Plotter(off_screen=True, window_size=SIZE, shape=(1, 2))
    with refused(UsageError, "several", "views"):
        merge_scene(two, ball(CAMERAS[0]))
    two.close()


def test_picture_is_not_merged_into_a_scene_of_another_size(plotter):
    plotter.window_size = (100, 90)
    with refused(UsageError, 100, 90, 120):
        merge_scene(plotter, ball(CAMERAS[0]))


def test_empty_picture_is_not_added_to_a_scene(plotter):
    with refused(UsageError, "hits", "nothing"):
        add_rendering(plotter, ball(CAMERAS[0], center=CENTRE + 1000.0))
