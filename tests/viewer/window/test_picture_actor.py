"""A picture as an actor of VTK is covered, and covers, as in space: compared with `merge_scene`."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from drawn_balls import CAMERAS, CENTRE, RADIUS, ball, need_off_screen

from clrecon.rendering import Rendering
from clrecon.viewer import merge_scene
from clrecon.viewer.window.picture_actor import PictureActor

pyvista = pytest.importorskip("pyvista")

SIZE = (241, 180)
"""A width that is not divisible by three, nor by two."""


@pytest.fixture(scope="module", autouse=True)
def can_draw():
    need_off_screen()


@pytest.fixture
def plotter():
    made = pyvista.Plotter(off_screen=True, window_size=SIZE)
    made.set_background("black")
    made.render_window.SetMultiSamples(0)
    made.camera_set = True  # else the first drawing looks at the whole scene
    yield made
    made.close()


def striped(camera) -> Rendering:
    made = ball(camera, SIZE)
    made.image[..., 1] = np.arange(SIZE[1], dtype=np.uint8)[:, None]
    made.image[..., 2] = np.arange(SIZE[0], dtype=np.uint8)
    made.image[np.isnan(made.depth)] = 0
    return made


def seen(plotter) -> np.ndarray:
    plotter.render()
    return np.array(plotter.screenshot(return_img=True))[..., :3].astype(int)


def expected(plotter, picture) -> np.ndarray:
    return merge_scene(plotter, picture).with_background("black").image[..., :3].astype(int)


def differing_share(one: np.ndarray, other: np.ndarray) -> float:
    return float((np.abs(one - other).max(axis=2) > tolerances.PICTURE_ACTOR_LEVELS).mean())


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("forward", [-30.0, 0.0, 14.0, 30.0])
def test_a_mesh_and_the_picture_cover_each_other_as_in_the_merged_scene(plotter, camera, forward):
    right, _, towards = camera.basis()
    center = CENTRE + 9.0 * right + forward * towards
    mesh = pyvista.Sphere(radius=RADIUS, center=center, theta_resolution=90, phi_resolution=90)
    plotter.add_mesh(mesh, color=(0, 200, 0), lighting=False)
    wanted = expected(plotter, striped(camera))
    PictureActor(plotter.renderer).show(striped(camera), smooth=False)
    share = differing_share(seen(plotter), wanted)
    assert share <= tolerances.PICTURE_ACTOR_OPAQUE_SHARE
    assert (wanted[..., 1] > 150).any() and (wanted[..., 0] > 200).any()  # both are seen


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("forward", [-50.0, 0.0, 50.0])
def test_a_translucent_mesh_and_the_picture_mix_as_in_the_merged_scene(plotter, camera, forward):
    _, up, towards = camera.basis()
    sheet = pyvista.Plane(
        center=CENTRE + forward * towards, direction=towards + 0.4 * up, i_size=70.0, j_size=70.0
    ).triangulate()  # fmt: skip
    plotter.add_mesh(sheet, color=(0, 200, 0), opacity=0.4, lighting=False)
    wanted = expected(plotter, striped(camera))
    PictureActor(plotter.renderer).show(striped(camera), smooth=False)
    plotter.enable_depth_peeling(4)
    assert differing_share(seen(plotter), wanted) <= tolerances.PICTURE_ACTOR_TRANSLUCENT_SHARE


def test_a_coarse_picture_fills_the_window_and_gets_no_dark_rim(plotter):
    camera = CAMERAS[0]
    coarse = ball(camera, (SIZE[0] // 4, SIZE[1] // 4), color=(240, 240, 240))
    plotter.set_background("white")
    PictureActor(plotter.renderer).show(coarse)
    found = seen(plotter)
    assert (
        found.min() >= 230
    )  # between white and the ball's colour: transparent pixels are black, and count for nothing
    fine = ball(camera, SIZE)
    covered = np.abs(found - 240).max(axis=2) < 8
    assert (covered != np.isfinite(fine.depth)).mean() < 0.03


def test_the_next_picture_takes_the_place_of_the_first_and_hiding_shows_none(plotter):
    actor = PictureActor(plotter.renderer)
    actor.show(striped(CAMERAS[0]), smooth=False)
    seen(plotter)
    second = ball(CAMERAS[1], SIZE, CENTRE + 15.0, color=(10, 20, 250))
    actor.show(second, smooth=False)
    assert np.abs(seen(plotter) - second.with_background("black").image[..., :3]).max() <= 1
    actor.hide()
    assert seen(plotter).max() == 0


def test_where_a_picture_has_no_depth_it_lies_behind_all_and_is_seen(plotter):
    camera = CAMERAS[0]
    image = np.full((SIZE[1], SIZE[0], 4), 200, np.uint8)
    image[..., 3] = 255
    nothing = np.full(SIZE[::-1], np.nan, np.float32)
    plotter.add_mesh(pyvista.Sphere(radius=RADIUS, center=CENTRE), color=(0, 200, 0), lighting=False)
    PictureActor(plotter.renderer).show(Rendering(image, nothing, nothing, camera))
    found = seen(plotter)
    of_ball = np.isfinite(ball(camera, SIZE, radius=0.95 * RADIUS).depth)
    assert (found[of_ball] == (0, 200, 0)).all() and (found[0, 0] == 200).all()
