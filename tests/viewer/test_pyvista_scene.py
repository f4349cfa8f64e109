"""Meshes and pictures in one PyVista scene, drawn off screen by whatever OpenGL there is."""

from __future__ import annotations

import drawn_balls
import numpy as np
import pytest
import tolerances
from drawn_balls import CAMERAS, CENTRE, RADIUS, need_off_screen
from variants import daily

from clrecon.errors import UsageError
from clrecon.rendering import Rendering
from clrecon.rendering.views.camera import Camera
from clrecon.viewer import add_rendering, merge_scene

pyvista = pytest.importorskip("pyvista")

SIZE = (120, 90)


@pytest.fixture(scope="module", autouse=True)
def can_draw():
    need_off_screen()


@pytest.fixture
def plotter():
    made = pyvista.Plotter(off_screen=True, window_size=SIZE)
    yield made
    made.close()


def ball(camera: Camera, center=CENTRE, radius=RADIUS, color=(250, 40, 10)) -> Rendering:
    return drawn_balls.ball(camera, SIZE, center, radius, color)


@pytest.mark.seconds
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("form", daily(1, ["points", "plane"]))
def test_seen_by_its_own_camera_a_picture_in_a_scene_is_the_picture(plotter, camera, form):
    made = ball(camera)
    made.image[..., 1] = np.arange(SIZE[1], dtype=np.uint8)[:, None]
    made.image[..., 2] = np.arange(SIZE[0], dtype=np.uint8)
    plotter.set_background("black")
    add_rendering(plotter, made, form)
    seen = np.array(plotter.screenshot(return_img=True))[..., :3].astype(int)
    shown = made.image[..., 3:] / 255 * made.image[..., :3]
    assert np.abs(seen - shown).max() <= tolerances.DRAWN_PICTURE_LEVELS
    assert Camera.from_pyvista(plotter).position == camera.position


def test_a_camera_can_stay_where_it_is(plotter):
    plotter.camera = CAMERAS[1].orbit(30.0).to_pyvista()
    add_rendering(plotter, ball(CAMERAS[1]), move_camera=False)
    assert Camera.from_pyvista(plotter).position == CAMERAS[1].orbit(30.0).position


def test_from_the_side_points_still_lie_on_the_ball(plotter):
    camera = CAMERAS[0]
    actor = add_rendering(plotter, ball(camera))
    points = np.asarray(actor.mapper.dataset.points)
    assert np.linalg.norm(points - CENTRE, axis=1) == pytest.approx(RADIUS, abs=tolerances.FLOAT32_POINT_MM)


@pytest.mark.parametrize("camera", daily(1, CAMERAS))
def test_a_mesh_and_a_picture_cover_each_other_as_in_space(plotter, camera):
    right, _, forward = camera.basis()
    places = {  # of a green ball of a mesh beside the red one of the picture
        "before": CENTRE - 30.0 * forward + 8.0 * right,
        "behind": CENTRE + 30.0 * forward + 8.0 * right,
        "within": CENTRE + 14.0 * right,
    }
    for place, center in places.items():
        plotter.clear()
        mesh = pyvista.Sphere(radius=RADIUS, center=center, theta_resolution=120, phi_resolution=120)
        plotter.add_mesh(mesh, color=(0, 200, 0), lighting=False)
        made = merge_scene(plotter, ball(camera))
        other = ball(camera, center, color=(0, 200, 0))
        red, green = (np.nan_to_num(each.depth, nan=np.inf) for each in (ball(camera), other))
        seen_red, seen_green = made.image[..., 0] > 200, made.image[..., 1] > 150
        differs = (seen_red != ((red < green) & np.isfinite(red))) | (seen_green != (green < red))
        assert differs.mean() <= tolerances.DRAWN_OUTLINE_SHARE, place
        both = np.isfinite(np.minimum(red, green)) & ~differs & (made.image[..., 3] == 255)
        assert np.abs(made.depth - np.minimum(red, green))[both].max() <= tolerances.DRAWN_DEPTH_MM, place


@pytest.mark.parametrize("background", ["black", "white", "steelblue"])
def test_a_translucent_mesh_keeps_its_colour_on_any_background(plotter, background):
    plotter.set_background(background)
    before = CENTRE - 50.0 * CAMERAS[0].basis().forward
    sheet = pyvista.Plane(center=before, direction=CAMERAS[0].basis().forward, i_size=500.0, j_size=500.0)
    plotter.add_mesh(sheet, color=(0, 200, 0), opacity=0.4, lighting=False)
    made = merge_scene(plotter, ball(CAMERAS[0]))
    red = np.isfinite(ball(CAMERAS[0]).depth)
    assert np.abs(made.image[~red] - np.array([0.0, 200.0, 0.0, 102.0])).max() <= tolerances.DRAWN_BLEND_LEVELS
    both = 0.4 * np.array([0.0, 200.0, 0.0]) + 0.6 * np.array([250.0, 40.0, 10.0])
    assert np.abs(made.image[red] - np.array([*both, 255.0])).max() <= tolerances.DRAWN_BLEND_LEVELS
    assert plotter.background_color == pyvista.Color(background)


def test_what_cannot_be_merged_is_refused(plotter):
    plotter.add_mesh(pyvista.Sphere())
    with pytest.raises(UsageError, match="no projection"):
        merge_scene(plotter, Rendering(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)), camera=None))
    two = pyvista.Plotter(off_screen=True, window_size=SIZE, shape=(1, 2))
    with pytest.raises(UsageError, match="several views"):
        merge_scene(two, ball(CAMERAS[0]))
    two.close()
    plotter.window_size = (100, 90)
    with pytest.raises(UsageError, match="100 x 90 pixels, the picture 120 x 90"):
        merge_scene(plotter, ball(CAMERAS[0]))
    empty = ball(CAMERAS[0], CENTRE + 1000.0)
    with pytest.raises(UsageError, match="hits nothing"):
        add_rendering(plotter, empty)
