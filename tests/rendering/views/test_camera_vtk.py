"""Cameras that go to PyVista and come back, and VTK's own projection as a second opinion on ours."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.views.camera import Camera

pyvista = pytest.importorskip("pyvista")

CAMERAS = [
    Camera((10.1, -400.3, 870.7), (12.0, -30.0, 850.0), (0, 0, 1), parallel_scale=123.4),
    Camera((10.1, -400.3, 870.7), (12.0, -30.0, 850.0), (0, 0, 1), view_angle=41.7),
    Camera((0, 0, 900.0), (0, 0, 0), (0, -1, 0), parallel_scale=0.01),
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_camera_comes_back_from_pyvista_unchanged(camera):
    made = camera.to_pyvista()
    assert isinstance(made, pyvista.Camera)
    assert Camera.from_pyvista(made) == camera
    assert made.parallel_projection == camera.is_parallel


def test_an_oblique_up_becomes_a_unit_vector():
    camera = Camera((10.1, -400.3, 870.7), (12.0, -30.0, 850.0), (2.0, 1.0, 3.0), parallel_scale=123.4)
    back = Camera.from_pyvista(camera.to_pyvista())
    assert np.linalg.norm(back.up) == pytest.approx(1.0)
    assert back.position == camera.position and back.parallel_scale == camera.parallel_scale
    assert np.abs(np.subtract(back.basis(), camera.basis())).max() <= tolerances.FLOAT64_PLACE_MM


@pytest.mark.parametrize("camera", CAMERAS)
def test_vtk_projects_points_to_the_same_pixels(camera):
    size = (400, 300)
    right, up, forward = camera.basis()
    spread = camera.distance * 0.2
    shifts = np.random.default_rng(2).uniform(-spread, spread, (30, 3))
    points = camera.focal_point + shifts @ np.array([right, up, forward])
    made = camera.to_pyvista()
    matrix = made.GetCompositeProjectionTransformMatrix(size[0] / size[1], -1, 1)
    entries = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
    mapped = np.column_stack([points, np.ones(30)]) @ entries.T
    ndc = mapped[:, :2] / mapped[:, 3:]
    pixels = (np.array([1.0, -1.0]) * ndc + 1.0) / 2.0 * size
    ours = camera.project(points, size)[0]
    assert np.abs(pixels - ours).max() <= tolerances.VTK_PIXEL * max(1.0, np.abs(ours).max())


def test_a_plotter_gives_its_camera():
    plotter = pyvista.Plotter(off_screen=True, window_size=(600, 300))
    plotter.camera = CAMERAS[1].to_pyvista()
    assert Camera.from_pyvista(plotter) == CAMERAS[1]
    plotter.camera.SetUseHorizontalViewAngle(True)
    angle = np.tan(np.radians(Camera.from_pyvista(plotter).view_angle / 2))
    assert angle == pytest.approx(np.tan(np.radians(41.7 / 2)) / 2)
    assert Camera.from_pyvista(plotter, (300, 300)).view_angle == pytest.approx(41.7)
    plotter.close()


def test_a_horizontal_angle_without_a_size_is_refused():
    made = CAMERAS[1].to_pyvista()
    made.SetUseHorizontalViewAngle(True)
    with pytest.raises(UsageError, match="say the size"):
        Camera.from_pyvista(made)


@pytest.mark.parametrize(
    "distort",
    [
        lambda camera: camera.SetWindowCenter(0.5, 0.0),
        lambda camera: camera.SetViewShear(0.1, 0.0, 1.0),
        lambda camera: camera.SetUserTransform(pyvista.Transform()),
        lambda camera: camera.SetUseOffAxisProjection(True),
    ],
)
def test_cameras_that_ours_cannot_be_are_refused(distort):
    made = CAMERAS[0].to_pyvista()
    distort(made)
    with refused(UsageError, "VTK", "camera"):
        Camera.from_pyvista(made)


def test_what_is_no_camera_is_refused():
    with refused(UsageError, "PyVista", "plotter"):
        Camera.from_pyvista({})
