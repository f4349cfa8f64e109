"""Normals equal their twin, point out of bone, and say where they are in doubt."""

from __future__ import annotations

import numpy as np
import pytest
from point_shapes import cube, plane, sphere
from refusals import refused
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
from clrecon.points.cloud import PointCloud
from clrecon.proof.points.clusters import find_gradients as gradients_twin
from clrecon.proof.points.neighbours import find_neighbours, orient_by_gradients, orient_from, principal_axes


def axes_by_twin(points, *, k):
    """Principal axes of the k nearest points of each, and their eigenvalues, both (n, 3)."""
    indices, _ = find_neighbours(points, k)
    return principal_axes(points, indices)


def degrees_between(a, b):
    return np.degrees(np.arcsin(np.clip(np.linalg.norm(np.cross(a, b), axis=1), 0.0, 1.0)))


@pytest.mark.parametrize("shape", [plane, sphere, cube])
@pytest.mark.parametrize("noisy", [True, False])
def test_normals_without_orientation_are_the_principal_axes_of_the_twin(device, shape, noisy):
    points = shape().points if noisy else shape().clean
    normals_found = estimate_normals(PointCloud(points), k=12, device=device).cloud.normals
    axes, eigenvalues = axes_by_twin(points, k=12)
    away = degrees_between(normals_found, axes)
    assert np.median(away) < TWIN_AXIS_DEGREES
    gap_of_smaller_eigenvalues = (eigenvalues[:, 1] - eigenvalues[:, 0]) / eigenvalues[:, 2]
    # where the two are nearly equal, any axis in their plane is right
    assert away[gap_of_smaller_eigenvalues > 1e-3].max() < TWIN_AXIS_NEAR_DOUBLE_DEGREES
    assert np.allclose(np.linalg.norm(normals_found, axis=1), 1.0, atol=1e-6)  # float32


def test_normals_without_orientation_are_warned_of(device):
    step = estimate_normals(PointCloud(sphere().points), device=device)
    assert step.facts["oriented_by"] is None
    assert "either direction" in step.warnings[0]


@pytest.mark.every_device
@pytest.mark.parametrize("n", [3, 7, 8, 9, 15, 16, 17])
def test_normals_of_clouds_around_multiples_of_eight_points_equal_their_twin(device, n):
    """The kernel works on vectors of eight points."""
    points = np.random.default_rng(n).normal(size=(n, 3)).astype(np.float32)
    found = estimate_normals(PointCloud(points), k=3, device=device).cloud.normals
    axes, _ = axes_by_twin(points, k=3)
    assert degrees_between(found, axes).max() < TWIN_AXIS_NEAR_DOUBLE_DEGREES


INNER_VIEWPOINT = (1.0, 2.0, -1.0)  # within `sphere()`, which has 20 mm around the origin


def test_normals_point_away_from_a_viewpoint_within_a_sphere(device):
    truth = sphere()
    step = estimate_normals(PointCloud(truth.points), viewpoint=INNER_VIEWPOINT, device=device)
    assert (step.cloud.normals * truth.normals).sum(axis=1).min() > 0.0
    assert step.facts["oriented_by"] == "viewpoint"
    assert step.warnings == ()


def test_normals_are_turned_by_a_viewpoint_as_by_the_twin(device):
    points = sphere().points
    found = estimate_normals(PointCloud(points), k=16, viewpoint=INNER_VIEWPOINT, device=device).cloud.normals
    axes, _ = axes_by_twin(points, k=16)
    expected = orient_from(axes, points, np.array(INNER_VIEWPOINT))
    assert np.mean((found * expected).sum(axis=1) > 0.0) > 0.9999  # others lie square to the line of sight


RADIUS_MM, SLICES = 14.0, 40


def ball(*, dtype="int16", affine=None, shape=(SLICES, 40, 40), radius=RADIUS_MM, steepness=100.0):
    """A ball whose HU fall by `steepness` a mm from 0 at its surface, and its middle in mm; voxels of 1 mm."""
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
    volume, middle = ball(dtype=dtype, affine=affine, shape=(22, 24, 20), radius=8.0, steepness=9.0)
    points = middle + np.random.default_rng(3).uniform(-14.0, 14.0, (800, 3))  # some beyond the border
    resident = DeviceVolume(volume, device=device)
    found = normals.find_gradients(resident, points, stopwatch=Stopwatch())
    expected = gradients_twin(volume, points, resident.values.lowest)
    assert np.abs(found - expected).max() < GRADIENT_SHARE * np.abs(expected).max()


SLOPE = np.array([3.0, -2.0, 1.5])  # HU a mm along x, y and z


def linear_field_in_uneven_slices(sign):
    """HU that rise by `SLOPE` with the place of each voxel; slices follow the normal, or run against it by -1."""
    empty = uneven(sign=sign)
    nk, nj, ni = empty.voxels.shape
    index = np.stack(np.meshgrid(np.arange(ni), np.arange(nj), np.arange(nk), indexing="ij"), -1)
    values = empty.ijk_to_lps(index.reshape(-1, 3)) @ SLOPE
    return uneven(values.reshape(ni, nj, nk).transpose(2, 1, 0).astype(np.float32), sign=sign)


def points_within(volume):
    """Random points at least half a voxel from the borders, mm."""
    last = np.array(volume.shape_ijk) - 1
    return volume.ijk_to_lps(np.random.default_rng(1).uniform((0.6, 0.6, 0.6), last - 0.6, (200, 3)))


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["along the normal", "against it"])
def test_gradients_of_a_linear_field_in_uneven_slices_are_its_slope(device, sign):
    volume = linear_field_in_uneven_slices(sign)
    resident = DeviceVolume(volume, device=device)
    found = normals.find_gradients(resident, points_within(volume), stopwatch=Stopwatch())
    assert np.abs(found - SLOPE).max() < GRADIENT_SHARE * np.abs(SLOPE).max()


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["along the normal", "against it"])
def test_gradients_of_the_twin_of_a_linear_field_in_uneven_slices_are_its_slope(sign):
    volume = linear_field_in_uneven_slices(sign)
    air = -1024.0  # beyond the volume
    found = gradients_twin(volume, points_within(volume), air)
    assert np.abs(found - SLOPE).max() < GRADIENT_SHARE * np.abs(SLOPE).max()


def test_gradients_found_in_slabs_are_those_of_the_whole_volume(device):
    volume, middle = ball()
    points = middle + np.random.default_rng(4).uniform(-25.0, 25.0, (1000, 3))
    whole = normals.find_gradients(DeviceVolume(volume, device=device), points, stopwatch=Stopwatch())

    told = []
    memory = 24 * len(points) + 9 * volume.voxels[0].nbytes  # points and gradients, and 9 of 40 slices
    parts = normals.find_gradients(
        DeviceVolume(volume, device=device, memory=memory), points, stopwatch=Stopwatch(),
        progress=lambda *step: told.append(step),
    )  # fmt: skip

    assert np.array_equal(parts, whole)
    assert len(told) >= 7  # 40 slices, 6 at a time: of 9, one below and two above are neighbours
    assert told[-1] == ("gradients", SLICES, SLICES)


@pytest.mark.parametrize("affine", [np.eye(4), OBLIQUE], ids=["straight", "oblique"])
def test_normals_of_points_on_a_ball_of_bone_point_outward_as_those_of_its_mesh(device, affine):
    volume, middle = ball(affine=affine)
    mesh = clrecon.extract_isosurface(volume, 0.5, device=device)
    step = estimate_normals(PointCloud(mesh.vertices), volume=volume, device=device)

    outward = mesh.vertices - middle
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    assert (step.cloud.normals * outward).sum(axis=1).min() > 0.95  # within 18 degrees
    assert (step.cloud.normals * mesh.normals).sum(axis=1).min() > 0.9  # within 26 degrees; measured 0.94
    assert step.facts["oriented_by"] == "gradient"


def test_no_normal_of_points_on_a_ball_of_bone_is_doubtful(device):
    volume, _ = ball()
    mesh = clrecon.extract_isosurface(volume, 0.5, device=device)
    step = estimate_normals(PointCloud(mesh.vertices), volume=volume, device=device)
    assert (step.facts["doubtful"], step.facts["unoriented"], step.facts["without_plane"]) == (0, 0, 0)
    assert step.warnings == ()
    assert len(step.cloud) == len(mesh.vertices)


WALL_AT = 12.0  # mm along x


@pytest.fixture(scope="module")
def points_of_a_thin_wall():
    """A wall of one voxel, and 15 points on each of its faces, which are 1.2 mm apart: nearest neighbours."""
    voxels = np.full((24, 24, 24), -50, np.int16)
    voxels[:, :, 12] = 300
    faces = np.repeat([WALL_AT - 0.6, WALL_AT + 0.6], 15)
    points = np.c_[faces, np.full(30, 12.0), 8.0 + 0.25 * np.arange(30) % 4]
    return Volume(voxels, np.eye(4)), points + np.random.default_rng(2).normal(0, 0.01, (30, 3))


def test_doubtful_normals_of_a_thin_wall_follow_the_gradient(device, points_of_a_thin_wall):
    """Principal axes lie across the wall, the gradient knows the side."""
    volume, points = points_of_a_thin_wall
    step = estimate_normals(PointCloud(points), k=16, volume=volume, device=device)

    indices, _ = find_neighbours(points.astype(np.float32), k=16)
    axes, _ = principal_axes(points, indices)
    expected, doubtful = orient_by_gradients(axes, gradients_twin(volume, points, -50.0))
    assert step.facts["doubtful"] == doubtful.sum() > 20  # measured 30
    found = step.cloud.normals[doubtful]
    assert np.all(np.sign(found[:, 0]) == np.sign(points[doubtful, 0] - WALL_AT))
    assert degrees_between(found, expected[doubtful]).max() < 0.01  # float32


def test_doubtful_normals_of_a_thin_wall_are_warned_of(device, points_of_a_thin_wall):
    volume, points = points_of_a_thin_wall
    step = estimate_normals(PointCloud(points), k=16, volume=volume, device=device)
    (warning,) = step.warnings
    assert warning.startswith(f"{step.facts['doubtful']} of 30 normals (")
    assert "are doubtful and follow the HU alone: the 16 nearest points" in warning
    assert "(kind='surface')" in warning


def shell_of_a_cylinder(device, slice_gap):
    """A cylinder of 12 mm along the slices' axis in pixels of 0.5 mm, and the points of its shell."""
    j, i = np.indices((60, 60))
    slice_ = np.rint(100.0 * (12.0 - 0.5 * np.hypot(i - 30, j - 30))).astype(np.int16)
    volume = Volume(np.stack([slice_] * int(30 / slice_gap)), np.diag([0.5, 0.5, slice_gap, 1.0]))
    return volume, clrecon.extract_points(volume, 0.5, kind="shell", device=device)


@pytest.mark.parametrize(("slice_gap", "warned"), [(0.5, False), (5.0, True)])
def test_doubtful_normals_are_warned_of_where_slices_lie_ten_pixels_apart(device, slice_gap, warned):
    """The neighbours of a point then lie in its own slice."""
    volume, shell = shell_of_a_cylinder(device, slice_gap)
    step = estimate_normals(shell, volume=volume, device=device)
    share = step.facts["doubtful"] / len(shell)
    assert (share > 0.1) == warned  # the share from which on there is a warning; measured none, and 0.129
    assert [f"({100.0 * share:.0f} %) are doubtful" in warning for warning in step.warnings] == [True] * warned


def test_few_normals_are_doubtful_after_thinning_to_the_slice_gap(device):
    volume, shell = shell_of_a_cylinder(device, slice_gap=5.0)
    thinned = clrecon.thin_points(shell, 5.0, device=device).cloud
    # Measured none: the nearest points lie in other slices too.
    assert estimate_normals(thinned, volume=volume, device=device).facts["doubtful"] < 0.1 * len(thinned)


def test_points_beyond_the_volume_are_unoriented_and_warned_of(device):
    volume, middle = ball()
    on_ball, beyond = middle + RADIUS_MM * sphere(radius=1.0).normals, middle + 500.0 + plane(size=4.0).clean
    points = np.r_[on_ball, beyond]
    step = estimate_normals(PointCloud(points), volume=volume, device=device)
    assert step.facts["unoriented"] == len(beyond)
    assert f"{len(beyond)} of {len(points)} normals have either direction" in step.warnings[0]


def test_points_in_a_line_or_at_one_place_have_no_normal_and_are_warned_of(device):
    line, one_place = np.outer(np.arange(20.0), [1.0, 2.0, -1.0]), np.zeros((30, 3))
    step = estimate_normals(PointCloud(np.r_[line, one_place]), k=5, viewpoint=(9, 9, 9), device=device)
    assert not step.cloud.normals.any()
    assert step.facts["without_plane"] == len(line) + len(one_place)
    assert "in a line or at one place" in step.warnings[0]


def points_on_lines(seed):
    """Twenty-four lines, 300 mm apart, of 80 points each: at even and at random steps in turn."""
    rng = np.random.default_rng(seed)
    directions = np.r_[rng.normal(size=(20, 3)), np.eye(3), [[1.0, 1.0, 0.0]]]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    steps = np.arange(80.0)[None, :, None] + np.stack((np.zeros((80, 1)), rng.uniform(0.0, 0.4, (80, 1))))
    return np.concatenate(
        [300.0 * np.array([line, 0, 0]) + steps[line % 2] * way for line, way in enumerate(directions)]
    )


@pytest.mark.every_device
@pytest.mark.parametrize("k", daily(2, [3, 5, 16, 64]))
def test_points_on_lines_of_24_directions_have_no_normal(device, k):
    points = points_on_lines(k)
    step = estimate_normals(PointCloud(points), k=k, device=device)
    assert not step.cloud.normals.any()
    assert step.facts["without_plane"] == len(points)


@pytest.mark.parametrize("k", daily(2, [3, 5, 16, 64]))
def test_points_on_lines_of_24_directions_have_no_principal_axis_of_the_twin(k):
    points = points_on_lines(k)
    axes, _ = axes_by_twin(points, k=k)
    assert not axes.any()


@pytest.mark.parametrize("width", [0.02, 0.3])
def test_points_of_a_narrow_strip_have_its_normal(device, width):
    """Ten neighbours along 1 mm of a strip that is a fiftieth as wide, or a third."""
    along, across = np.arange(200.0), width * np.tile((0.0, 1.0), 100)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    points = np.column_stack((0.1 * along, across, np.zeros(200))) @ turn.T
    step = estimate_normals(PointCloud(points), k=10, device=device)
    assert step.facts["without_plane"] == 0
    assert np.abs(step.cloud.normals @ turn[:, 2]).min() > 0.999  # within 2.6 degrees


def test_normals_of_a_cloud_of_two_parts_equal_their_twin_and_point_outward(device):
    """A kernel takes a part of a large cloud at a time; devices without long work-items take larger parts."""
    truth = sphere(radius=48.0 if device.has_long_items else 190.0)
    step = estimate_normals(PointCloud(truth.points), k=8, viewpoint=(0, 0, 0), device=device)
    axes, _ = axes_by_twin(truth.points, k=8)
    assert np.median(degrees_between(step.cloud.normals, axes)) < TWIN_AXIS_DEGREES
    assert ((step.cloud.normals * truth.points).sum(axis=1) > 0.0).all()


@pytest.mark.oclgrind
def test_normals_of_a_few_points_on_a_ball_of_bone_point_outward(device):
    volume, middle = ball(shape=(12, 12, 12), radius=4.0)
    outward = sphere(radius=2.0).normals
    step = estimate_normals(PointCloud(middle + 4.0 * outward), k=6, volume=volume, device=device)
    assert (step.cloud.normals * outward).sum(axis=1).min() > 0.3  # six neighbours lie some 3 mm apart


def test_normals_of_a_shifted_cloud_are_the_same_except_for_rounding(device):
    shift = 1e5
    points = np.round(sphere(radius=6.0).points.astype(np.float64), 3)
    near = estimate_normals(PointCloud(points), viewpoint=(0, 0, 0), device=device).cloud
    far = estimate_normals(PointCloud(points + shift), viewpoint=(shift, shift, shift), device=device).cloud
    assert np.median(degrees_between(near.normals, far.normals)) < 0.01  # float32 relative to the cloud's middle
    assert (near.normals * far.normals).sum(axis=1).min() > 0.0


VOLUME = Volume(np.zeros((12, 12, 12), np.int16), np.eye(4))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"volume": VOLUME, "viewpoint": (0, 0, 0)}, "not both"),
        ({"viewpoint": (0, np.nan, 0)}, "three numbers in LPS mm"),
        ({"k": 2}, "from 3 to 128"),
    ],
    ids=["volume and viewpoint", "viewpoint of nan", "two neighbours"],
)
def test_wrong_parameters_of_normals_are_refused(device, wrong, words):
    with pytest.raises(UsageError, match=words):
        estimate_normals(PointCloud(np.eye(3)), device=device, **wrong)


def test_normals_of_an_empty_cloud_are_refused(device):
    with refused(UsageError, "cloud", "empty"):
        estimate_normals(PointCloud(np.zeros((0, 3))), device=device)


def test_too_little_memory_for_normals_is_refused(device):
    with refused(DeviceMemoryError, "neighbours", 3, "points"):
        estimate_normals(PointCloud(np.eye(3)), device=device, memory=20)
