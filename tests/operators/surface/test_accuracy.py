"""Analytic truths: distance fields of a sphere, a torus, a cylinder and planes, on awkward grids."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances

from clrecon.geometry import Volume, compose_affine
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.proof.surface import extract as twin

pytestmark = pytest.mark.every_device


def rotation(*degrees: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()


def make_grid(name: str) -> np.ndarray:
    """3x3 steps in mm: isotropic, anisotropic, oblique, tilted gantry (sheared)."""
    angle = np.radians(18.5)
    steps = {
        "isotropic": np.eye(3),
        "anisotropic": np.diag((0.5, 0.7, 1.25)),
        "oblique": rotation(20, -35, 50) @ np.diag((0.5, 0.7, 1.0)),
        "tilted": np.array([[0.7, 0, 0], [0, 0.5 * np.cos(angle), 0], [0, -0.5 * np.sin(angle), 1.0]]),
    }
    return steps[name]


PLACE, CENTER = (-120.0, 340.0, -846.0), (0.31, -0.17, 0.23)
"""LPS mm of the middle of the volumes, and of the bodies from there: no voxel lies at it."""

GRIDS = ["isotropic", "anisotropic", "oblique", "tilted"]


def sample(distance, steps: np.ndarray, half_extent: float) -> Volume:
    """Volume of `distance` (mm, positive inside) around a centre that no voxel has, with odd and unequal sizes."""
    normals = np.linalg.inv(steps)  # rows: gradient of each index
    counts = [2 * int(np.ceil((half_extent + 0.5) * np.linalg.norm(row))) + 3 for row in normals]
    counts[1] += 1
    origin = np.array(PLACE) - steps @ (np.array(counts) - 1) / 2
    i_step, j_step, k_step = steps.T
    volume = Volume(np.zeros(counts[::-1], np.float32), compose_affine(i_step, j_step, k_step, origin))
    k, j, i = np.meshgrid(*(np.arange(n) for n in counts[::-1]), indexing="ij")
    points = volume.ijk_to_lps(np.stack([i, j, k], axis=-1).reshape(-1, 3)) - PLACE - CENTER
    return Volume(distance(points).reshape(volume.voxels.shape), volume.affine)


def points_around_center(mesh) -> np.ndarray:
    return mesh.vertices.astype(np.float64) - PLACE - CENTER


def largest_edge(steps: np.ndarray) -> float:
    return float(np.linalg.norm(steps, axis=0).max())


@pytest.mark.parametrize("grid", GRIDS)
def test_surface_of_the_distance_field_of_a_sphere_is_closed_and_near_it(device, grid):
    steps = make_grid(grid)
    voxel = largest_edge(steps)
    radius = 5.0 * voxel
    volume = sample(lambda p: radius - np.linalg.norm(p, axis=1), steps, radius)

    mesh = extract_isosurface(volume, 0.0, device=device)

    error = np.linalg.norm(points_around_center(mesh), axis=1) - radius
    assert np.abs(error).max() <= tolerances.SPHERE_DISTANCE_FIELD_VOXEL * voxel
    quality = mesh.quality()
    assert (quality["closed"], quality["manifold"], quality["components"], quality["genus"]) == (True, True, 1, 0)


@pytest.mark.parametrize("grid", GRIDS)
def test_surface_of_the_distance_field_of_a_sphere_has_its_volume_and_area(device, grid):
    """Chords and facets lie inside a sphere."""
    steps = make_grid(grid)
    radius = 5.0 * largest_edge(steps)
    volume = sample(lambda p: radius - np.linalg.norm(p, axis=1), steps, radius)
    quality = extract_isosurface(volume, 0.0, device=device).quality()
    exact_ml = 4 / 3 * np.pi * radius**3 / 1000
    # Chords of a voxel h sag by h^2 / 8 R = R / 200, diagonals twice as far: 1.5 to 3 % of volume; measured 1.1 to 2.4.
    assert 0.97 * exact_ml < quality["volume_ml"] < exact_ml
    assert quality["area_mm2"] == pytest.approx(4 * np.pi * radius**2, rel=0.02)  # measured 0.013


def test_error_of_a_sphere_falls_to_a_quarter_where_voxels_are_halved(device):
    radius = 8.0

    def rms_error(refine):
        volume = sample(lambda p: radius - np.linalg.norm(p, axis=1), make_grid("oblique") / refine, radius)
        vertices = points_around_center(extract_isosurface(volume, 0.0, device=device))
        return np.sqrt(np.mean((np.linalg.norm(vertices, axis=1) - radius) ** 2))

    coarse, halved, quartered = (rms_error(refine) for refine in (1, 2, 4))
    assert coarse / halved == pytest.approx(4.0, rel=0.01)  # measured 4.016
    assert halved / quartered == pytest.approx(4.0, rel=0.01)  # measured 3.999


@pytest.mark.parametrize("grid", GRIDS)
def test_closed_surface_of_a_torus_has_its_genus_area_and_volume(device, grid):
    steps = make_grid(grid) / 2.0
    major, minor = 8.0, 3.0
    turn = rotation(30, 10, -20)

    def distance(points):
        local = points @ turn
        return minor - np.hypot(np.hypot(local[:, 0], local[:, 1]) - major, local[:, 2])

    quality = extract_isosurface(sample(distance, steps, major + minor), 0.0, device=device).quality()
    assert (quality["closed"], quality["genus"]) == (True, 1)
    # voxels of up to 0.63 mm on a tube of 3 mm
    assert quality["volume_ml"] == pytest.approx(2 * np.pi**2 * major * minor**2 / 1000, rel=0.02)  # measured 0.006
    assert quality["area_mm2"] == pytest.approx(4 * np.pi**2 * major * minor, rel=0.003)  # measured 0.0014


@pytest.mark.parametrize("grid", GRIDS)
def test_closed_surface_of_a_cylinder_has_its_area_and_volume(device, grid):
    steps = make_grid(grid) / 2.0
    radius, length = 5.0, 14.0
    turn = rotation(-25, 40, 5)

    def distance(points):
        local = points @ turn
        return np.minimum(radius - np.hypot(local[:, 0], local[:, 1]), length / 2 - np.abs(local[:, 2]))

    quality = extract_isosurface(sample(distance, steps, np.hypot(radius, length / 2)), 0.0, device=device).quality()
    assert (quality["closed"], quality["genus"]) == (True, 0)
    # voxels of up to 0.63 mm, which cut the edges of the cylinder
    assert quality["volume_ml"] == pytest.approx(np.pi * radius**2 * length / 1000, rel=0.02)  # measured 0.005
    assert quality["area_mm2"] == pytest.approx(2 * np.pi * radius * (radius + length), rel=0.03)  # measured 0.013


OFFSET = 0.123  # of a plane along its normal from the centre, mm


@pytest.fixture(params=GRIDS)
def grid_steps(request):
    return make_grid(request.param)


@pytest.fixture(params=[(0, 0, 0), (37, 11, 0), (3, 88, 45)], ids=str)
def plane(request, grid_steps):
    """The normal of a plane turned by these degrees, a linear field of 1000 HU a mm that is 0 on it, and its margin.

    Vertices keep a distance from samples, by which they may lie off the plane: four units of float32.
    """
    normal = rotation(*request.param)[2]
    volume = sample(lambda p: 1000.0 * (p @ normal - OFFSET), grid_steps, 6.0)
    return normal, volume, 4.0 * tolerances.float32_unit(volume.ijk_to_lps([(0, 0, 0)]))


def test_surface_of_a_linear_field_is_a_plane_with_its_normal(device, plane):
    normal, volume, margin = plane
    mesh = extract_isosurface(volume, 0.0, device=device, closed=False)
    off = np.abs(points_around_center(mesh) @ normal - OFFSET)
    assert off.max() <= margin + tolerances.float32_unit(mesh.vertices)
    assert np.abs(mesh.normals @ -normal - 1.0).max() < 1e-5  # towards lower values; float32


def test_surface_of_the_twin_of_a_linear_field_is_a_plane_with_its_normal(plane):
    normal, volume, margin = plane
    vertices, normals, _ = twin.extract_isosurface(volume, 0.0, closed=False)
    off = np.abs((vertices - PLACE - CENTER) @ normal - OFFSET)
    assert off.max() <= margin
    assert np.abs(normals @ -normal - 1.0).max() < 1e-12  # float64; measured 1e-15


def test_vertices_of_a_partial_volume_sphere_are_right_to_a_fraction_of_a_voxel(device):
    """Each voxel of 1 mm has the mean of 6 x 6 x 6 samples: -1000 HU outside of the sphere, 1000 inside."""
    radius, center = 6.4, np.array(CENTER)
    n, fine = 19, 6
    axis = (np.arange(n * fine) + 0.5) / fine - 0.5 - (n - 1) / 2
    z, y, x = np.meshgrid(*(axis - c for c in center[::-1]), indexing="ij")
    inside = (x * x + y * y + z * z < radius**2).reshape(n, fine, n, fine, n, fine).mean(axis=(1, 3, 5))
    voxels = np.rint(-1000 + 2000 * inside).astype(np.int16)
    volume = Volume(voxels, compose_affine((1, 0, 0), (0, 1, 0), (0, 0, 1), np.full(3, -(n - 1) / 2)))

    vertices = extract_isosurface(volume, 0, device=device).vertices

    error = np.linalg.norm(vertices - center, axis=1) - radius
    assert np.sqrt(np.mean(error**2)) <= tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL
    assert np.abs(error).max() <= tolerances.SPHERE_PARTIAL_VOLUME_MAX_VOXEL


def test_vertices_at_a_golden_section_of_each_edge_fail_the_bar_of_a_partial_volume_sphere():
    """As a paper has it: at a constant 0.618 of an edge they are no better than a binary mask."""
    radius = 6.4
    axis = np.arange(-9.0, 10.0)
    z, y, x = np.meshgrid(*(axis - c for c in CENTER[::-1]), indexing="ij")
    inside = np.sqrt(x * x + y * y + z * z) < radius
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    crossed = np.argwhere(inside[:, :, :-1] != inside[:, :, 1:])
    vertices = crossed[:, ::-1] - 9.0 - CENTER + (golden, 0.0, 0.0)
    error = np.linalg.norm(vertices, axis=1) - radius
    assert np.sqrt(np.mean(error**2)) > 3 * tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL  # measured 4.6
