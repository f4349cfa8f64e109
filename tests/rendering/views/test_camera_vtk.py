"""Cameras that go to PyVista and come back, and VTK's own projection as a second opinion on ours."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.views.camera import Camera

pyvista = pytest.importorskip("pyvista")

PLACE = {"position": (10.1, -400.3, 870.7), "focal_point": (12.0, -30.0, 850.0)}
PARALLEL = Camera(**PLACE, up=(0, 0, 1), parallel_scale=123.4)
PERSPECTIVE = Camera(**PLACE, up=(0, 0, 1), view_angle=41.7)
MINUTE_SCALE = Camera(position=(0, 0, 900.0), focal_point=(0, 0, 0), up=(0, -1, 0), parallel_scale=0.01)

of_each_camera = pytest.mark.parametrize(
    "camera", [PARALLEL, PERSPECTIVE, MINUTE_SCALE], ids=["parallel", "perspective", "minute scale"]
)


@of_each_camera
def test_camera_comes_back_from_pyvista_unchanged(camera):
    assert Camera.from_pyvista(camera.to_pyvista()) == camera


@of_each_camera
def test_camera_of_pyvista_has_the_projection_of_ours(camera):
    made = camera.to_pyvista()

    assert isinstance(made, pyvista.Camera)
    assert made.parallel_projection == camera.is_parallel


def test_camera_with_an_oblique_top_comes_back_with_the_upright_unit_vector_of_the_same_picture():
    camera = Camera(**PLACE, up=(2.0, 1.0, 3.0), parallel_scale=123.4)

    back = Camera.from_pyvista(camera.to_pyvista())

    assert np.linalg.norm(back.up) == pytest.approx(1.0)
    assert np.abs(np.subtract(back.basis(), camera.basis())).max() <= tolerances.FLOAT64_PLACE_MM


@of_each_camera
def test_vtk_projects_points_to_the_same_pixels(camera):
    size = (400, 300)
    spread = camera.distance * 0.2
    shifts = np.random.default_rng(2).uniform(-spread, spread, (30, 3))
    points = camera.focal_point + shifts @ np.array(camera.basis())

    ours = camera.project(points, size)[0]

    matrix = camera.to_pyvista().GetCompositeProjectionTransformMatrix(size[0] / size[1], -1, 1)
    entries = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
    mapped = np.column_stack([points, np.ones(30)]) @ entries.T
    theirs = (np.array([1.0, -1.0]) * mapped[:, :2] / mapped[:, 3:] + 1.0) / 2.0 * size
    assert np.abs(theirs - ours).max() <= tolerances.VTK_PIXEL * max(1.0, np.abs(ours).max())


@pytest.fixture
def plotter():
    """A plotter of 600 x 300 pixels with the perspective camera."""
    made = pyvista.Plotter(off_screen=True, window_size=(600, 300))
    made.camera = PERSPECTIVE.to_pyvista()
    yield made
    made.close()


def test_plotter_gives_its_camera(plotter):
    assert Camera.from_pyvista(plotter) == PERSPECTIVE


def test_horizontal_angle_of_a_plotter_becomes_the_vertical_one_of_its_window(plotter):
    plotter.camera.SetUseHorizontalViewAngle(True)

    camera = Camera.from_pyvista(plotter)

    half_height = np.tan(np.radians(camera.view_angle / 2))
    assert half_height == pytest.approx(np.tan(np.radians(PERSPECTIVE.view_angle / 2)) * 300 / 600)


def test_horizontal_angle_of_a_square_picture_is_the_vertical_one(plotter):
    plotter.camera.SetUseHorizontalViewAngle(True)

    assert Camera.from_pyvista(plotter, size=(300, 300)).view_angle == pytest.approx(PERSPECTIVE.view_angle)


def test_horizontal_angle_without_a_size_is_refused():
    made = PERSPECTIVE.to_pyvista()
    made.SetUseHorizontalViewAngle(True)

    with refused(UsageError, "size"):
        Camera.from_pyvista(made)


DISTORTED = {
    "a centre beside the middle": lambda camera: camera.SetWindowCenter(0.5, 0.0),
    "a sheared view": lambda camera: camera.SetViewShear(0.1, 0.0, 1.0),
    "a transformation": lambda camera: camera.SetUserTransform(pyvista.Transform()),
    "a projection off its axis": lambda camera: camera.SetUseOffAxisProjection(True),
}


@pytest.mark.parametrize("distort", DISTORTED.values(), ids=DISTORTED)
def test_camera_of_vtk_that_ours_cannot_be_is_refused(distort):
    made = PARALLEL.to_pyvista()
    distort(made)

    with refused(UsageError, "VTK", "camera"):
        Camera.from_pyvista(made)


def test_object_that_is_no_camera_is_refused():
    with refused(UsageError, "PyVista", "plotter"):
        Camera.from_pyvista({})
