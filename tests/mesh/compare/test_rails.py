"""Rails of a table are thin, and the same from the first slice to the last; each bound of that from both sides."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.mesh.compare.walls import find_rails, is_straight

LAST = 40
"""The slices go from 0 to this; 2 mm from one to the next."""


def make_volume(last: int = LAST, pixel_mm: float = 1.0) -> Volume:
    affine = np.diag((pixel_mm, -pixel_mm, 2.0, 1.0))
    affine[:3, 3] = -40.0, 130.0, 700.0
    return Volume(np.zeros((last + 1, 4, 4), np.int16), affine)


def make_bar(volume: Volume, size=(8.0, 8.0), ends=None, shift_mm=0.0, grow_mm=0.0, leave_out=None) -> np.ndarray:
    """Points (n, 3), LPS mm, of a bar along the slices, `size` in mm across; it shifts or grows from its middle on."""
    last = volume.shape_ijk[2] - 1
    first, end = ends or (0.0, float(last))
    side = np.linspace(0.0, 1.0, 21)
    outline = np.concatenate([np.stack([side, end * np.ones(21)], 1)[:, ::turn] for end in (0, 1) for turn in (1, -1)])
    points = []
    for k in np.arange(first, end + 0.01, 0.5):
        if leave_out is None or not leave_out[0] <= k < leave_out[1]:
            late = k >= last / 2
            across = (
                30.0 + outline * (np.array(size) + late * np.array((0.0, grow_mm))) + late * np.array((shift_mm, 0.0))
            )
            points.append(np.column_stack([across / volume.spacing[:2], np.full(len(outline), k)]))
    return volume.ijk_to_lps(np.concatenate(points))


def is_rail(volume: Volume, points: np.ndarray) -> bool:
    mesh = Mesh(points.astype(np.float32), np.zeros((0, 3), np.uint32))
    return bool(find_rails(mesh, volume, np.zeros(len(points), np.int64), np.ones(1, bool))[0])


@pytest.mark.parametrize(
    ("bar", "straight", "thin"),
    [
        ({}, True, True),
        ({"size": (10.99, 60.0)}, True, True),  # 10 mm, and a voxel by which it is blurred
        ({"size": (60.0, 11.01)}, True, False),
        ({"ends": (1.0, 39.0)}, True, True),
        ({"ends": (1.5, 40.0)}, False, False),
        ({"ends": (0.0, 38.5)}, False, False),
        ({"shift_mm": 0.99}, True, True),
        ({"shift_mm": 1.01}, False, False),
        ({"grow_mm": 0.99}, True, True),
        ({"grow_mm": -1.01}, False, False),
        ({"leave_out": (10.5, 15.25)}, False, False),  # the third of eight sections
        ({"leave_out": (11.0, 15.25)}, True, True),
    ],
)
def test_bar_is_a_rail_within_each_bound_and_none_beyond(bar, straight, thin):
    volume = make_volume()
    points = make_bar(volume, **bar)
    assert is_straight(points, volume) == straight
    assert is_rail(volume, points) == thin


@pytest.mark.parametrize(("last", "found"), [(30, True), (29, False)])
def test_a_scan_shorter_than_60_mm_shows_no_rail(last, found):
    volume = make_volume(last)
    assert is_rail(volume, make_bar(volume)) == is_straight(make_bar(volume), volume) == found


@pytest.mark.parametrize(("shift_mm", "found"), [(1.99, True), (2.01, False)])
def test_sides_may_move_by_half_a_voxel(shift_mm, found):
    volume = make_volume(pixel_mm=4.0)
    assert is_rail(volume, make_bar(volume, shift_mm=shift_mm)) == found


@pytest.mark.parametrize(("pixel_mm", "found"), [((4.0, 1.0), True), ((1.0, 4.0), False)])
def test_half_a_voxel_is_that_of_the_side_that_moves(pixel_mm, found):
    volume = Volume(np.zeros((LAST + 1, 4, 4), np.int16), np.diag((*pixel_mm, 2.0, 1.0)))
    assert is_straight(make_bar(volume, shift_mm=1.9), volume) == found


def test_components_are_told_apart_and_only_the_chosen_are_looked_at():
    volume = make_volume()
    bars = [make_bar(volume, **bar) for bar in ({"size": (30.0, 30.0)}, {}, {"shift_mm": 5.0}, {}, {})]
    labels = np.repeat([0, 1, 2, 3, -1], [len(bar) for bar in bars])
    order = np.random.default_rng(0).permutation(len(labels))
    mesh = Mesh(np.concatenate(bars)[order].astype(np.float32), np.zeros((0, 3), np.uint32))
    chosen = np.array([True, True, True, False])
    assert find_rails(mesh, volume, labels[order], chosen).tolist() == [False, True, False, False]


@pytest.mark.parametrize("k", [0.5, 1.0, LAST - 1.0, LAST - 0.5])
def test_slices_count_from_the_second_to_the_last_but_one(k):
    """The faces that close a surface at the border of the scan lie beyond them."""
    volume = make_volume()
    points = make_bar(volume)
    points[np.abs(volume.lps_to_ijk(points)[:, 2] - k) < 1e-6, 0] += 5.0
    assert is_straight(points, volume) == (k in (0.5, LAST - 0.5))


@pytest.mark.parametrize(("share", "straight"), [(0.015, True), (0.03, False)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_two_hundredths_of_the_points_may_stand_out_on_either_side(share, side, straight):
    volume = make_volume()
    k = np.repeat(np.arange(LAST + 1.0), 1000)
    points = np.column_stack([np.full_like(k, 30.0), np.full_like(k, 40.0), k])
    points[(k >= LAST / 2) & (np.arange(len(k)) % 1000 < 1000 * share), 0] += side * 20.0
    assert is_straight(volume.ijk_to_lps(points), volume) == straight
