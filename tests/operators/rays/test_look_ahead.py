"""How far the way of a picture's rays is free among bricks: the kernel against what is counted brick by brick."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import ndimage

from clrecon.geometry import Volume
from clrecon.opencl import Stopwatch, download, upload
from clrecon.operators.rays import ray_pictures
from clrecon.operators.rays.ray_pictures import MainWay
from clrecon.operators.rays.ray_slabs import FARTHEST, LeapMap, find_leaps, ray_slabs
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.rendering.views.camera import Camera


def free_ways_of_kernel(device, shape, distances, way: MainWay):
    """What the kernel says of a volume without anything in it, with these distances in place of its own."""
    resident, stopwatch = DeviceVolume(Volume(np.zeros(shape, np.int16), np.eye(4)), device=device), Stopwatch()
    (slab,) = ray_slabs(resident, slices=shape[0], entry_k=np.inf, stopwatch=stopwatch)
    with stopwatch.running(device):
        ways_d = ray_pictures.look_ahead(resident, slab, way, LeapMap(upload(device, distances), None))
        return download(device, np.empty_like(distances), ways_d)


def count_ahead(distances, way: MainWay):
    """Bricks ahead of each that are empty with those beside them, counted one by one."""
    shown, counts = distances.T == 0, distances.T.shape
    free = np.zeros(counts, int)
    for brick in np.ndindex(counts):
        columns = []
        for axis in range(3):
            offset = float(np.float32(brick[axis] + 0.5) - way.eye[axis]) if way.eye[3] else float(way.eye[axis])
            aside = brick[axis] + (0 if abs(offset) <= way.aside else int(np.sign(offset)))
            columns.append(
                {brick[axis]} if axis == way.axis else {brick[axis], int(np.clip(aside, 0, counts[axis] - 1))}
            )
        for steps in range(FARTHEST + 1):
            free[brick] = steps
            columns[way.axis] = {brick[way.axis] + way.ahead * steps}
            inside = 0 <= min(columns[way.axis]) < counts[way.axis]
            if inside and any(shown[at] for at in itertools.product(*columns)):
                break
    return free.T


@pytest.mark.oclgrind
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("is_parallel", [True, False])
@pytest.mark.parametrize("ahead", [1, -1])
def test_free_bricks_ahead_are_those_counted_one_by_one_beside_the_distances(device, axis, is_parallel, ahead):
    rng = np.random.default_rng([axis, is_parallel, ahead + 1])
    shape = tuple(int(n) for n in rng.integers(2, 34, 3))
    bricks = tuple(max(1, -(-(n - 1) // 4)) for n in shape)
    distances = np.where(rng.random(bricks) < 0.1, 0, rng.integers(1, FARTHEST + 1, bricks)).astype(np.uint8)
    if is_parallel:
        way = MainWay(axis, ahead, eye=np.array([0.01, -0.5, 0.7, 0.0], np.float32), aside=0.02)
    else:
        way = MainWay(axis, ahead, eye=np.append(rng.uniform(-3.0, 10.0, 3), 1.0).astype(np.float32), aside=0.5)

    ways = free_ways_of_kernel(device, shape, distances, way)

    assert np.array_equal(ways & FARTHEST, distances)  # the lower four bits
    assert np.array_equal(ways >> 4, count_ahead(distances, way))


def find_bright_leaps(device, voxels):
    """Distances of bricks from those with a voxel over 500 of 1000 HU, and the box of these."""
    resident, stopwatch = DeviceVolume(Volume(voxels, np.eye(4)), device=device), Stopwatch()
    (slab,) = ray_slabs(resident, slices=len(voxels), entry_k=np.inf, stopwatch=stopwatch)
    with stopwatch.running(device):
        leaps = find_leaps(resident, slab, "key", shown=np.arange(100) > 50, low=0.0, scale=100 / 1000)
        return download(device, np.empty(slab.bricks[::-1], np.uint8), leaps.distances_d), leaps.box


def bright_bricks(voxels, counts):
    """Which of so many bricks, (bk, bj, bi), hold a voxel over 500 HU."""
    bright = np.zeros(counts, bool)
    for brick in np.ndindex(counts):  # cells of a brick end at the voxels that the next one begins with
        bright[brick] = (voxels[tuple(slice(4 * n, 4 * n + 5) for n in brick)] > 500).any()
    return bright


def three_bright_voxels(shape):
    rng = np.random.default_rng(shape)
    voxels = np.zeros(shape, np.int16)
    for _ in range(3):
        voxels[tuple(rng.integers(0, shape))] = 1000
    return voxels


SHAPES = [(2, 2, 2), (5, 9, 70), (23, 6, 7), (9, 83, 2), (30, 31, 33)]


@pytest.mark.oclgrind
@pytest.mark.parametrize("shape", SHAPES)
def test_distances_to_bright_bricks_are_the_chessboard_distances_of_scipy_up_to_the_farthest(device, shape):
    voxels = three_bright_voxels(shape)
    distances, _ = find_bright_leaps(device, voxels)
    truth = ndimage.distance_transform_cdt(~bright_bricks(voxels, distances.shape), "chessboard")
    assert np.array_equal(distances, np.minimum(truth, FARTHEST))


@pytest.mark.oclgrind
@pytest.mark.parametrize("shape", SHAPES)
def test_box_of_leaps_holds_the_bright_bricks_and_half_a_voxel(device, shape):
    voxels = three_bright_voxels(shape)
    distances, (low, high) = find_bright_leaps(device, voxels)
    k, j, i = np.nonzero(bright_bricks(voxels, distances.shape))
    for axis, bricks in enumerate((i, j, k)):
        assert (low[axis], high[axis]) == (4 * bricks.min() - 0.5, 4 * (bricks.max() + 1) + 0.5)


LEAST_DRIFT = 0.02  # bricks to the side per brick ahead, below which a ray counts as straight, see `MainWay`
FRONT, MIDDLE, HEAD = (15.0, -400.0, 30.0), (15.0, 0.0, 30.0), (0.0, 0.0, 1.0)


def main_way(device, camera):
    """Of a volume of 30 x 40 x 20 voxels of 1 x 2 x 3 mm, whose rows run against y."""
    resident = DeviceVolume(Volume(np.zeros((20, 40, 30), np.int16), np.diag([1.0, -2.0, 3.0, 1.0])), device=device)
    (slab,) = ray_slabs(resident, slices=20, entry_k=np.inf, stopwatch=Stopwatch())
    assert slab.brick_cells == (4, 4, 2)
    return MainWay.of(resident, slab, camera)


def test_main_way_of_a_parallel_camera_runs_along_its_rays(device):
    way = main_way(device, Camera(FRONT, MIDDLE, HEAD, parallel_scale=50.0))
    along_rows, backwards = 1, -1
    assert (way.axis, way.ahead) == (along_rows, backwards)
    assert way.eye.tolist() == [0.0, -1.0, 0.0, 0.0]  # a direction
    assert way.aside == LEAST_DRIFT


def test_main_way_of_a_perspective_camera_runs_from_its_position_in_bricks(device):
    way = main_way(device, Camera(FRONT, MIDDLE, HEAD, view_angle=30.0))
    assert (way.axis, way.ahead) == (1, -1)
    assert way.eye.tolist() == [15 / 4, 200 / 4, 10 / 2, 1.0]  # column 15, row 200, slice 10; a place
    assert way.aside == pytest.approx(LEAST_DRIFT * 40.0)  # 200 voxels away, of which 40 are the volume's


def test_main_way_of_a_camera_within_the_volume_leaves_half_a_brick_aside(device):
    way = main_way(device, Camera((15.0, -40.0, 30.0), (15.0, -40.0, 90.0), (0.0, 1.0, 0.0), view_angle=90.0))
    along_slices, forwards = 2, 1
    assert (way.axis, way.ahead, way.aside) == (along_slices, forwards, 0.5)
