"""Meshes and cells against surfaces that are known as signed distances."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from refusals import refused
from sample_meshes import SHEARED

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.proof.compare.mesh_cells import find_mesh_cells, measure_cells
from clrecon.proof.compare.mesh_truth import find_cut_cells, measure_truth
from clrecon.proof.phantom import PhantomSettings, phantom_truth

pytestmark = pytest.mark.unit

CENTRE = np.array([-3.5, -142.25, -418.75])
RADIUS = 10.0


class Ball:
    """A ball, and how many points were asked."""

    def __init__(self, centre=CENTRE, radius=RADIUS):
        self.centre, self.radius, self.asked = np.asarray(centre), radius, 0

    def signed_distance(self, points_mm):
        self.asked += len(points_mm)
        return np.linalg.norm(points_mm - self.centre, axis=1) - self.radius


class Ring:
    """A torus about the z axis."""

    def signed_distance(self, points_mm):
        x, y, z = np.asarray(points_mm).T
        return np.hypot(np.hypot(x, y) - 20.0, z) - 6.0


def ball(radius=RADIUS, shift=(0.0, 0.0, 0.0), rounds=5) -> Mesh:
    """A mesh of the ball around `CENTRE`, or of one beside it."""
    return Mesh(*samples.sphere(centre=CENTRE + shift, radius=radius, rounds=rounds))


@pytest.mark.parametrize("more", [0.3, -0.4])
def test_larger_or_smaller_ball_has_its_difference_as_bias_and_no_scatter(more):
    found = measure_truth(ball(radius=RADIUS + more), Ball())
    assert found.bias_mm == pytest.approx(more, abs=tolerances.BALL_SAGITTA_MM)
    assert found.scatter_mm < tolerances.BALL_SAGITTA_MM
    assert found.p95_mm == pytest.approx(abs(more), abs=tolerances.BALL_SAGITTA_MM)
    assert found.max_mm == pytest.approx(abs(more), abs=tolerances.BALL_SAGITTA_MM)
    assert found.outer_share == 1.0
    assert found.normals_p95_deg < 2.0  # facets of 0.6 mm on a ball of 10 mm turn by 1.1 degrees to their rim


def test_shifted_ball_has_no_bias_and_the_scatter_of_its_shift():
    # s cos(theta) has the mean 0 and the standard deviation s / sqrt(3) on a ball
    found = measure_truth(ball(shift=(0.3, 0.0, 0.0)), Ball())
    assert found.bias_mm == pytest.approx(0.0, abs=tolerances.BALL_SAGITTA_MM)
    assert found.scatter_mm == pytest.approx(0.3 / np.sqrt(3.0), abs=tolerances.BALL_SAGITTA_MM)
    assert found.max_mm == pytest.approx(0.3, abs=tolerances.BALL_SAGITTA_MM)


def test_torus_with_a_thicker_tube_has_that_bias_and_no_scatter():
    found = measure_truth(Mesh(*samples.torus(rings=300, sides=120, major=20.0, minor=6.25)), Ring())
    assert found.bias_mm == pytest.approx(0.25, abs=tolerances.BALL_SAGITTA_MM)
    assert found.scatter_mm < tolerances.BALL_SAGITTA_MM


def test_wall_of_a_cavity_is_not_measured_as_outer_surface():
    outer, inner = ball(radius=RADIUS + 0.2), ball(radius=RADIUS - 0.8)
    vertices, triangles = samples.join((outer.vertices, outer.triangles), (inner.vertices, inner.triangles[:, ::-1]))
    found = measure_truth(Mesh(vertices, triangles), Ball())
    assert found.bias_mm == pytest.approx(0.2, abs=tolerances.BALL_SAGITTA_MM)
    assert found.outer_share == pytest.approx(10.2**2 / (10.2**2 + 9.2**2), abs=1e-3)  # areas


def test_mesh_beyond_the_reach_of_its_truth_is_left_out():
    one, other = ball(), ball(radius=3.0, shift=(40.0, 0.0, 0.0), rounds=3)
    both = Mesh(*samples.join((one.vertices, one.triangles), (other.vertices, other.triangles)))
    found = measure_truth(both, Ball())
    assert found.max_mm < tolerances.BALL_SAGITTA_MM
    assert found.outer_share == pytest.approx(RADIUS**2 / (RADIUS**2 + 3.0**2), abs=2e-3)  # areas
    assert found.reach_mm == 1.5  # where no grid is given


def test_mesh_that_is_wholly_beyond_the_reach_of_its_truth_is_refused():
    with refused(NoSurfaceError, 1.5, "surface"):
        measure_truth(ball(radius=3.0, shift=(40.0, 0.0, 0.0), rounds=3), Ball())


def test_mesh_whose_faces_look_inwards_is_refused():
    mesh = ball()
    with refused(NoSurfaceError, 1.5):
        measure_truth(Mesh(mesh.vertices, mesh.triangles[:, ::-1]), Ball())


def test_flat_cut_at_the_border_of_the_scan_is_left_out_of_the_measures():
    grid = Volume(np.zeros((21, 41, 41), np.int16), np.diag([1.0, 1.0, 2.0, 1.0]))
    truth = Ball((20.0, 20.0, 4.0), radius=10.0)
    vertices, triangles = samples.sphere(centre=(20.0, 20.0, 4.0), radius=10.2, rounds=5)
    cut = Mesh(np.maximum(vertices, [-99.0, -99.0, 0.0]), triangles)  # what lies below the grid is pressed flat
    found = measure_truth(cut, truth, grid=grid)
    assert found.bias_mm == pytest.approx(0.2, abs=tolerances.BALL_SAGITTA_MM)
    assert found.scatter_mm < tolerances.BALL_SAGITTA_MM
    assert found.reach_mm == 2.0  # of the longest step
    assert measure_truth(cut, truth).scatter_mm > 10 * found.scatter_mm  # measured 0.29 and 0.0017 mm


def test_truth_without_a_distance_is_refused_by_its_type():
    with refused(UsageError, "dict", "distance"):
        measure_truth(ball(), {})
    with refused(UsageError, "dict", "distance"):
        find_cut_cells({}, Volume(np.zeros((3, 3, 3), np.int16), np.eye(4)))


def test_measure_of_no_samples_is_refused():
    with refused(UsageError, 1, "sample"):
        measure_truth(ball(), Ball(), samples=0)


@pytest.mark.parametrize("reach_mm", [0.0, -1.0, np.nan, np.inf])
def test_reach_that_is_not_positive_and_finite_is_refused(reach_mm):
    with refused(UsageError, 0, "reach"):
        measure_truth(ball(), Ball(), reach_mm=reach_mm)


def test_empty_mesh_is_refused_where_it_is_compared_with_a_truth():
    with refused(NoSurfaceError, "surface"):
        measure_truth(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.uint32)), Ball())


@pytest.mark.parametrize("affine", [np.eye(4), SHEARED], ids=["even", "sheared"])
def test_cells_cut_by_a_truth_are_those_of_a_search_of_all_their_points_with_a_tenth_of_them(affine):
    grid = Volume(np.zeros((19, 33, 40), np.int16), affine)
    truth = Ball(centre=grid.ijk_to_lps([[24.0, 18.0, 8.0]])[0], radius=7.5)
    low = np.array(list(itertools.product(range(-1, 40), range(-1, 33), range(-1, 19))))
    points = low[:, None] + 0.5 * np.array(list(itertools.product(range(3), repeat=3)))
    within = truth.signed_distance(grid.ijk_to_lps(points.reshape(-1, 3))).reshape(len(low), 27) < 0.0
    all_asked, truth.asked = truth.asked, 0
    found = find_cut_cells(truth, grid)
    assert set(map(tuple, found.ijk.tolist())) == set(
        map(tuple, low[within.any(axis=1) & ~within.all(axis=1)].tolist())
    )
    assert truth.asked < all_asked / 10
    assert found.name == "truth"


@pytest.mark.parametrize("kind", ["sphere", "torus"])
def test_cells_cut_by_the_surface_of_a_phantom_lie_within_half_their_diagonal_of_it(kind):
    truth = phantom_truth(PhantomSettings(kind=kind, size=(64, 64), slices=48, oblique=(20.0, 10.0, 5.0)))
    grid = Volume(np.zeros((48, 64, 64), np.int16), truth.affine)
    cut = find_cut_cells(truth, grid)
    half = 0.5 * np.linalg.norm(grid.spacing)
    assert len(cut) > 500  # measured 5870 and 6328
    assert np.abs(truth.signed_distance(grid.ijk_to_lps(cut.ijk + 0.5))).max() <= half


def test_cells_of_a_fine_mesh_of_a_ball_are_those_cut_by_the_ball():
    grid = Volume(np.zeros((33, 33, 33), np.int16), np.eye(4))
    truth = Ball((16.2, 15.9, 16.4), radius=RADIUS)
    mesh = Mesh(*samples.sphere(centre=(16.2, 15.9, 16.4), radius=RADIUS, rounds=6))
    found = measure_cells(mesh, find_cut_cells(truth, grid), grid)
    assert found.reference == "truth"
    assert found.recall > 0.99  # corners between the 27 points of a cell
    assert found.precision > 0.99  # measured 0.9989
    assert measure_cells(mesh, find_mesh_cells(mesh, grid, name="t-mc"), grid).dice == 1.0


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("at", [-0.5, 4.5, 5.5])
def test_wall_beside_the_outermost_voxels_cuts_the_cells_of_the_border(axis, at):
    class Wall:
        def signed_distance(self, points_mm):
            return np.asarray(points_mm)[:, axis] - at

    found = find_cut_cells(Wall(), Volume(np.zeros((6, 6, 6), np.int16), np.eye(4))).ijk
    assert set(found[:, axis].tolist()) == {int(np.floor(at))}
    assert len(found) == 7 * 7  # of 6 voxels and a border
