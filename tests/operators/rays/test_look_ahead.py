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


def look(device, shape, distances, way: MainWay):
    """What the kernel says of a volume without anything in it, with these distances in place of its own."""
    resident, stopwatch = DeviceVolume(Volume(np.zeros(shape, np.int16), np.eye(4)), device=device), Stopwatch()
    slab = next(ray_slabs(resident, shape[0], np.inf, stopwatch))
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
def test_ways_are_what_is_counted(device, axis, is_parallel):
    rng = np.random.default_rng([axis, is_parallel])
    for ahead in (1, -1):
        shape = tuple(int(n) for n in rng.integers(2, 34, 3))
        bricks = tuple(max(1, -(-(n - 1) // 4)) for n in shape)
        distances = np.where(rng.random(bricks) < 0.1, 0, rng.integers(1, FARTHEST + 1, bricks)).astype(np.uint8)
        if is_parallel:
            way = MainWay(axis, ahead, np.array([0.01, -0.5, 0.7, 0.0], np.float32), 0.02)
        else:
            way = MainWay(axis, ahead, np.append(rng.uniform(-3.0, 10.0, 3), 1.0).astype(np.float32), 0.5)
        ways = look(device, shape, distances, way)
        assert np.array_equal(ways & FARTHEST, distances)
        assert np.array_equal(ways >> 4, count_ahead(distances, way))


@pytest.mark.oclgrind
@pytest.mark.parametrize("shape", [(2, 2, 2), (5, 9, 70), (23, 6, 7), (9, 83, 2), (30, 31, 33)])
def test_distances_are_those_of_a_chessboard(device, shape):
    """SciPy's distance transform to the bricks that hold a bright voxel, cut off at the farthest."""
    rng = np.random.default_rng(shape)
    voxels = np.zeros(shape, np.int16)
    for _ in range(3):
        voxels[tuple(rng.integers(0, shape))] = 1000
    resident, stopwatch = DeviceVolume(Volume(voxels, np.eye(4)), device=device), Stopwatch()
    slab = next(ray_slabs(resident, shape[0], np.inf, stopwatch))
    counts = slab.bricks[::-1]
    bright = np.zeros(counts, bool)
    for brick in np.ndindex(counts):  # cells of a brick end at the voxels that the next one begins with
        bright[brick] = (voxels[tuple(slice(4 * n, 4 * n + 5) for n in brick)] > 500).any()
    with stopwatch.running(device):
        leaps = find_leaps(resident, slab, "key", np.arange(100) > 50, 0.0, 0.1)
        found = download(device, np.empty(counts, np.uint8), leaps.distances_d)
    truth = ndimage.distance_transform_cdt(~bright, "chessboard")
    assert np.array_equal(found, np.minimum(truth, FARTHEST))
    low, high = leaps.box
    for axis in range(3):
        where = 4 * np.flatnonzero(bright.any(axis=tuple(n for n in range(3) if n != 2 - axis)))
        assert (low[axis], high[axis]) == (where[0] - 0.5, where[-1] + 4.5)


def test_the_main_way_is_that_of_the_ray_in_the_middle(device):
    volume = Volume(np.zeros((20, 40, 30), np.int16), np.diag([1.0, -2.0, 3.0, 1.0]))
    resident = DeviceVolume(volume, device=device)
    slab = next(ray_slabs(resident, 20, np.inf, Stopwatch()))
    assert slab.brick_cells == (4, 4, 2)
    from_the_front = Camera((15.0, -400.0, 30.0), (15.0, 0.0, 30.0), (0.0, 0.0, 1.0), parallel_scale=50.0)
    way = MainWay.of(resident, slab, from_the_front)
    assert (way.axis, way.ahead, way.eye.tolist(), way.aside) == (1, -1, [0.0, -1.0, 0.0, 0.0], 0.02)
    near = Camera((15.0, -400.0, 30.0), (15.0, 0.0, 30.0), (0.0, 0.0, 1.0), view_angle=30.0)
    way = MainWay.of(resident, slab, near)
    assert (way.axis, way.ahead, way.eye.tolist()) == (1, -1, [3.75, 50.0, 5.0, 1.0])
    assert way.aside == pytest.approx(0.02 * 40.0)  # 200 voxels away, of which 40 are the volume's
    inside = Camera((15.0, -40.0, 30.0), (15.0, -40.0, 90.0), (0.0, 1.0, 0.0), view_angle=90.0)
    way = MainWay.of(resident, slab, inside)
    assert (way.axis, way.ahead, way.aside) == (2, 1, 0.5)
