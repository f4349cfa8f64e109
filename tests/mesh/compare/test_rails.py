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
    """A scan of slices 0 to `last`, 2 mm apart."""
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


BARS = {  # what differs from a bar of 8 x 8 mm: is it straight, and is it a rail
    "8 x 8 mm": ({}, True, True),
    "10 mm thin, blurred by a voxel": ({"size": (10.99, 60.0)}, True, True),
    "beyond 10 mm and a voxel": ({"size": (60.0, 11.01)}, True, False),
    "from the second slice to the last but one": ({"ends": (1.0, 39.0)}, True, True),
    "begins later": ({"ends": (1.5, 40.0)}, False, False),
    "ends earlier": ({"ends": (0.0, 38.5)}, False, False),
    "shifts by less than 1 mm": ({"shift_mm": 0.99}, True, True),
    "shifts by more than 1 mm": ({"shift_mm": 1.01}, False, False),
    "grows by less than 1 mm": ({"grow_mm": 0.99}, True, True),
    "shrinks by more than 1 mm": ({"grow_mm": -1.01}, False, False),
    "the third of eight sections is missing": ({"leave_out": (10.5, 15.25)}, False, False),
    "most of the third section is missing": ({"leave_out": (11.0, 15.25)}, True, True),
}


@pytest.mark.parametrize(("difference", "straight", "rail"), BARS.values(), ids=BARS)
def test_a_bar_is_a_rail_where_it_is_thin_and_straight_from_end_to_end(difference, straight, rail):
    volume = make_volume()
    points = make_bar(volume, **difference)
    assert is_straight(points, volume) == straight
    assert is_rail(volume, points) == rail


@pytest.mark.parametrize(("last", "rail"), [(30, True), (29, False)], ids=["60 mm", "58 mm"])
def test_a_scan_shorter_than_60_mm_shows_no_rail(last, rail):
    volume = make_volume(last=last)
    points = make_bar(volume)
    assert is_straight(points, volume) == rail
    assert is_rail(volume, points) == rail


@pytest.mark.parametrize(("shift_mm", "rail"), [(1.99, True), (2.01, False)])
def test_sides_of_a_rail_may_move_by_half_a_voxel(shift_mm, rail):
    volume = make_volume(pixel_mm=4.0)
    assert is_rail(volume, make_bar(volume, shift_mm=shift_mm)) == rail


@pytest.mark.parametrize(("pixel_mm", "straight"), [((4.0, 1.0), True), ((1.0, 4.0), False)], ids=["x", "y"])
def test_half_a_voxel_is_that_of_the_side_that_moves(pixel_mm, straight):
    """The bar shifts along x by 1.9 mm: less than half a voxel where those are 4 mm long along x."""
    volume = Volume(np.zeros((LAST + 1, 4, 4), np.int16), np.diag((*pixel_mm, 2.0, 1.0)))
    assert is_straight(make_bar(volume, shift_mm=1.9), volume) == straight


def test_only_chosen_components_that_are_thin_and_straight_are_rails():
    """A thick bar, a rail, a crooked bar, a rail that is not chosen, and points of no component, in any order."""
    volume = make_volume()
    bars = [make_bar(volume, **difference) for difference in ({"size": (30.0, 30.0)}, {}, {"shift_mm": 5.0}, {}, {})]
    labels = np.repeat([0, 1, 2, 3, -1], [len(bar) for bar in bars])
    chosen = np.array([True, True, True, False])
    order = np.random.default_rng(0).permutation(len(labels))
    mesh = Mesh(np.concatenate(bars)[order].astype(np.float32), np.zeros((0, 3), np.uint32))
    assert find_rails(mesh, volume, labels[order], chosen).tolist() == [False, True, False, False]


@pytest.mark.parametrize(("k", "counts"), [(0.5, False), (1.0, True), (LAST - 1.0, True), (LAST - 0.5, False)])
def test_slices_count_from_the_second_to_the_last_but_one(k, counts):
    """All points at k stand out by 5 mm; the faces that close a surface at the border of the scan do not count."""
    volume = make_volume()
    points = make_bar(volume)
    points[np.isclose(volume.lps_to_ijk(points)[:, 2], k), 0] += 5.0
    assert is_straight(points, volume) == (not counts)


@pytest.mark.parametrize(("share", "straight"), [(0.015, True), (0.03, False)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_two_hundredths_of_the_points_may_stand_out_on_either_side(share, side, straight):
    """Points on a line along the slices, 1000 in each, of which a share stands out by 20 voxels in the upper half."""
    volume = make_volume()
    k = np.repeat(np.arange(LAST + 1.0), 1000)
    points = np.column_stack([np.full_like(k, 30.0), np.full_like(k, 40.0), k])
    stand_out = (k >= LAST / 2) & (np.arange(len(k)) % 1000 < 1000 * share)
    points[stand_out, 0] += side * 20.0
    assert is_straight(volume.ijk_to_lps(points), volume) == straight
