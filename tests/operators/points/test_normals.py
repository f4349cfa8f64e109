"""Normals equal their twin, point out of bone, and say where they are in doubt."""

from __future__ import annotations

import numpy as np
import pytest
from point_shapes import cube, plane, sphere
from tolerances import GRADIENT_SHARE, TWIN_AXIS_DEGREES, TWIN_AXIS_NEAR_DOUBLE_DEGREES
from uneven_volume import uneven
from variants import VOXEL_TYPES, daily

import clrecon
from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.geometry import Volume
from clrecon.opencl import Stopwatch
from clrecon.operators.points import normals
from clrecon.operators.points.normals import estimate_normals
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.points import PointCloud
from clrecon.proof.points.clusters import find_gradients as gradients_twin
from clrecon.proof.points.neighbours import find_neighbours, orient_by_gradients, orient_from, principal_axes


def degrees_between(a, b):
    return np.degrees(np.arcsin(np.clip(np.linalg.norm(np.cross(a, b), axis=1), 0.0, 1.0)))


@pytest.mark.parametrize("shape", [plane, sphere, cube])
@pytest.mark.parametrize("noisy", [True, False])
def test_axes_equal_their_twin(device, shape, noisy):
    truth = shape()
    points = truth.points if noisy else truth.clean
    step = estimate_normals(PointCloud(points), 12, device=device)
    axes, eigenvalues = principal_axes(points, find_neighbours(points, 12)[0])
    away = degrees_between(step.cloud.normals, axes)
    apart = (eigenvalues[:, 1] - eigenvalues[:, 0]) / eigenvalues[:, 2]
    assert np.median(away) < TWIN_AXIS_DEGREES
    assert away[apart > 1e-3].max() < TWIN_AXIS_NEAR_DOUBLE_DEGREES
    assert np.allclose(np.linalg.norm(step.cloud.normals, axis=1), 1.0, atol=1e-6)
    assert step.facts["oriented_by"] is None
    assert "either direction" in step.warnings[0]


@pytest.mark.every_device
@pytest.mark.parametrize("n", [3, 7, 8, 9, 15, 16, 17])
def test_normals_equal_their_twin_at_every_size_of_the_last_vector(device, n):
    points = np.random.default_rng(n).normal(size=(n, 3)).astype(np.float32)
    found = estimate_normals(PointCloud(points), 3, device=device).cloud.normals
    axes, _ = principal_axes(points, find_neighbours(points, 3)[0])
    assert degrees_between(found, axes).max() < TWIN_AXIS_NEAR_DOUBLE_DEGREES


def test_a_viewpoint_within_turns_normals_outward(device):
    truth = sphere()
    step = estimate_normals(PointCloud(truth.points), viewpoint=(1.0, 2.0, -1.0), device=device)
    axes, _ = principal_axes(truth.points, find_neighbours(truth.points, 16)[0])
    expected = orient_from(axes, truth.points, np.array([1.0, 2.0, -1.0]))
    assert np.mean((step.cloud.normals * expected).sum(axis=1) > 0.0) > 0.9999
    assert (step.cloud.normals * truth.normals).sum(axis=1).min() > 0.0
    assert step.facts["oriented_by"] == "viewpoint"
    assert step.warnings == ()


def ball(dtype="int16", affine=None, shape=(40, 40, 40), radius=14.0, steepness=100.0):
    """A ball of 1 mm voxels: HU fall by `steepness` a mm from 0 at the surface."""
    affine = np.eye(4) if affine is None else affine
    volume = Volume(np.zeros(shape, dtype), affine)
    index = np.stack(np.meshgrid(*[np.arange(size) for size in shape[::-1]], indexing="ij"), -1).reshape(-1, 3)
    middle = volume.ijk_to_lps(np.array([shape[::-1]]) / 2.0)[0]
    away = np.linalg.norm(volume.ijk_to_lps(index) - middle, axis=1)
    values = (steepness * (radius - away)).reshape(shape[::-1]).transpose(2, 1, 0)
    info = np.iinfo(dtype) if np.dtype(dtype).kind != "f" else None
    values = values if info is None else np.clip(np.rint(values), info.min, info.max)
    return Volume(values.astype(dtype), affine), middle


OBLIQUE = np.array([[0.7, 0.1, 0.3, -40], [-0.1, 0.8, 0.2, 25], [0.05, 0.1, 1.3, -300], [0, 0, 0, 1.0]])


@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@pytest.mark.parametrize("affine", [np.eye(4), OBLIQUE])
def test_gradients_equal_their_twin(device, dtype, affine):
    volume, middle = ball(dtype, affine, (22, 24, 20), 8.0, 9.0)
    points = middle + np.random.default_rng(3).uniform(-14.0, 14.0, (800, 3))  # some beyond the border
    resident = DeviceVolume(volume, device=device)
    found = normals.find_gradients(resident, points, stopwatch=Stopwatch())
    expected = gradients_twin(volume, points, resident.values.lowest)
    assert np.abs(found - expected).max() < GRADIENT_SHARE * np.abs(expected).max()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_gradients_of_uneven_slices_are_those_of_a_linear_field(device, sign):
    volume = uneven(sign=sign)
    slope = np.array([3.0, -2.0, 1.5])
    nk, nj, ni = volume.voxels.shape
    index = np.stack(np.meshgrid(np.arange(ni), np.arange(nj), np.arange(nk), indexing="ij"), -1)
    values = volume.ijk_to_lps(index.reshape(-1, 3)) @ slope
    voxels = values.reshape(ni, nj, nk).transpose(2, 1, 0).astype(np.float32)
    linear = uneven(voxels, sign)
    inside = np.random.default_rng(1).uniform((0.6, 0.6, 0.6), (ni - 1.6, nj - 1.6, nk - 1.6), (200, 3))
    points = linear.ijk_to_lps(inside)
    found = normals.find_gradients(DeviceVolume(linear, device=device), points, stopwatch=Stopwatch())
    assert np.abs(found - slope).max() < GRADIENT_SHARE * 3.0
    assert np.abs(gradients_twin(linear, points, -1024.0) - slope).max() < GRADIENT_SHARE * 3.0


def test_slabs_have_the_same_gradients(device):
    volume, middle = ball()
    points = middle + np.random.default_rng(4).uniform(-25.0, 25.0, (1000, 3))
    whole = normals.find_gradients(DeviceVolume(volume, device=device), points, stopwatch=Stopwatch())
    memory = 24 * len(points) + 9 * 40 * 40 * 2
    told = []
    parts = normals.find_gradients(
        DeviceVolume(volume, device=device, memory=memory), points, stopwatch=Stopwatch(),
        progress=lambda *step: told.append(step),
    )  # fmt: skip
    assert np.array_equal(parts, whole)
    assert len(told) > 4
    assert told[-1] == ("gradients", 40, 40)


@pytest.mark.parametrize("affine", [np.eye(4), OBLIQUE])
def test_normals_of_a_surface_point_out_of_bone(device, affine):
    volume, middle = ball(affine=affine)
    mesh = clrecon.extract_isosurface(volume, 0.5, device=device)
    cloud = PointCloud(mesh.vertices)
    step = estimate_normals(cloud, volume=volume, device=device)
    outward = mesh.vertices - middle
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    assert (step.cloud.normals * outward).sum(axis=1).min() > 0.95
    assert (step.cloud.normals * mesh.normals).sum(axis=1).min() > 0.9
    assert (step.facts["doubtful"], step.facts["unoriented"], step.facts["without_plane"]) == (0, 0, 0)
    assert (step.facts["oriented_by"], step.warnings) == ("gradient", ())
    assert len(step.cloud) == len(cloud)


def test_thin_sheets_take_the_gradient_and_are_counted(device):
    """Points of both faces of a wall are nearest neighbours: PCA lies across, the gradient knows the side."""
    voxels = np.full((24, 24, 24), -50, np.int16)
    voxels[:, :, 12] = 300
    volume = Volume(voxels, np.eye(4))
    rng = np.random.default_rng(2)
    faces = np.repeat([11.4, 12.6], 15)
    wall = np.c_[faces, np.full(30, 12.0), 8.0 + 0.25 * np.arange(30) % 4] + rng.normal(0, 0.01, (30, 3))
    step = estimate_normals(PointCloud(wall), 16, volume=volume, device=device)
    axes, _ = principal_axes(wall, find_neighbours(wall.astype(np.float32), 16)[0])
    slopes = gradients_twin(volume, wall, -50.0)
    expected, doubtful = orient_by_gradients(axes, slopes)
    assert step.facts["doubtful"] == doubtful.sum() > 20
    assert np.all(np.sign(step.cloud.normals[doubtful, 0]) == np.sign(faces - 12.0)[doubtful])
    assert degrees_between(step.cloud.normals[doubtful], expected[doubtful]).max() < 0.01
    assert step.warnings[0].startswith(f"{doubtful.sum()} of 30 normals (")
    assert "are doubtful and follow the HU alone: the 16 nearest points" in step.warnings[0]
    assert "(kind='surface')" in step.warnings[0]


@pytest.mark.parametrize(("gap", "warned"), [(0.5, False), (5.0, True)])
def test_many_doubtful_normals_of_a_shell_are_warned_of(device, gap, warned):
    """A cylinder along the slices' axis: ten pixels apart, the neighbours of a point lie in its own slice."""
    j, i = np.indices((60, 60))
    slice_ = np.rint(100.0 * (12.0 - 0.5 * np.hypot(i - 30, j - 30))).astype(np.int16)
    volume = Volume(np.stack([slice_] * int(30 / gap)), np.diag([0.5, 0.5, gap, 1.0]))
    shell = clrecon.extract_points(volume, 0.5, kind="shell", device=device)
    step = estimate_normals(shell, volume=volume, device=device)
    share = step.facts["doubtful"] / len(shell)
    assert (share > 0.1) == warned
    assert [f"({100.0 * share:.0f} %) are doubtful" in warning for warning in step.warnings] == [True] * warned
    thinned = clrecon.thin_points(shell, gap, device=device).cloud
    assert estimate_normals(thinned, volume=volume, device=device).facts["doubtful"] < 0.1 * len(thinned)


def test_points_beyond_the_volume_are_unoriented_and_said(device):
    volume, middle = ball()
    points = np.r_[middle + 14.0 * sphere(1.0).normals, middle + 500.0 + plane(4.0).clean]
    step = estimate_normals(PointCloud(points), volume=volume, device=device)
    assert step.facts["unoriented"] == len(plane(4.0).clean)
    assert f"{len(plane(4.0).clean)} of {len(points)} normals have either direction" in step.warnings[0]


def test_points_in_a_line_have_no_normal(device):
    line = np.outer(np.arange(20.0), [1.0, 2.0, -1.0])
    step = estimate_normals(PointCloud(np.r_[line, np.zeros((30, 3))]), 5, viewpoint=(9, 9, 9), device=device)
    assert step.facts["without_plane"] == 50
    assert not step.cloud.normals.any()
    assert "in a line or at one place" in step.warnings[0]


@pytest.mark.every_device
@pytest.mark.parametrize("k", daily(2, [3, 5, 16, 64]))
def test_points_on_lines_of_any_direction_have_no_normal(device, k):
    """The smallest eigenvalue of a line is a double one."""
    rng = np.random.default_rng(k)
    directions = np.r_[rng.normal(size=(20, 3)), np.eye(3), [[1.0, 1.0, 0.0]]]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    steps = np.arange(80.0)[None, :, None] + np.stack((np.zeros((80, 1)), rng.uniform(0.0, 0.4, (80, 1))))
    lines = [300.0 * np.array([line, 0, 0]) + steps[line % 2] * way for line, way in enumerate(directions)]
    points = np.concatenate(lines)
    step = estimate_normals(PointCloud(points), k, device=device)
    assert not step.cloud.normals.any()
    assert step.facts["without_plane"] == len(points)
    axes, _ = principal_axes(points, find_neighbours(points, k)[0])
    assert not axes.any()


@pytest.mark.parametrize("width", [0.02, 0.3])
def test_points_of_a_narrow_strip_have_its_normal(device, width):
    """A fiftieth as wide as the neighbours are long."""
    along, across = np.arange(200.0), width * np.tile((0.0, 1.0), 100)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    points = np.column_stack((0.1 * along, across, np.zeros(200))) @ turn.T
    step = estimate_normals(PointCloud(points), 10, device=device)
    assert step.facts["without_plane"] == 0
    assert np.abs(step.cloud.normals @ turn[:, 2]).min() > 0.999


def test_normals_of_a_cloud_of_several_parts_point_outward(device):
    truth = sphere(48.0 if device.has_long_items else 190.0)
    step = estimate_normals(PointCloud(truth.points), 8, viewpoint=(0, 0, 0), device=device)
    axes, _ = principal_axes(truth.points, find_neighbours(truth.points, 8)[0])
    assert np.median(degrees_between(step.cloud.normals, axes)) < TWIN_AXIS_DEGREES
    assert ((step.cloud.normals * truth.points).sum(axis=1) > 0.0).all()


@pytest.mark.oclgrind
def test_normals_of_a_small_cloud_look_outward_by_its_volume(device):
    volume, middle = ball(shape=(12, 12, 12), radius=4.0)
    points = middle + 4.0 * sphere(2.0).normals
    step = estimate_normals(PointCloud(points), 6, volume=volume, device=device)
    assert (step.cloud.normals * sphere(2.0).normals).sum(axis=1).min() > 0.3


def test_a_shift_changes_nothing_but_rounding(device):
    points = np.round(sphere(6.0).points.astype(np.float64), 3)
    near = estimate_normals(PointCloud(points), viewpoint=(0, 0, 0), device=device).cloud
    far = estimate_normals(PointCloud(points + 1e5), viewpoint=(1e5, 1e5, 1e5), device=device).cloud
    assert np.median(degrees_between(near.normals, far.normals)) < 0.01
    assert (near.normals * far.normals).sum(axis=1).min() > 0.0


def test_wrong_parameters_are_refused(device):
    cloud = PointCloud(np.eye(3))
    with pytest.raises(UsageError, match="not both"):
        estimate_normals(cloud, volume=ball()[0], viewpoint=(0, 0, 0), device=device)
    with pytest.raises(UsageError, match="three numbers in LPS mm"):
        estimate_normals(cloud, viewpoint=(0, np.nan, 0), device=device)
    with pytest.raises(UsageError, match="from 3 to 128"):
        estimate_normals(cloud, 2, device=device)
    with pytest.raises(UsageError, match="the cloud is empty"):
        estimate_normals(PointCloud(np.zeros((0, 3))), device=device)
    with pytest.raises(DeviceMemoryError, match="neighbours of 3 points"):
        estimate_normals(cloud, device=device, memory=20)
