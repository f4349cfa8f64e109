"""Holes that are filled and components that grow from points equal the twin, scipy and fill-voids."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from refusals import refused
from scipy import ndimage
from surface_volumes import OBLIQUE
from uneven_volume import uneven
from variants import daily

import clrecon
from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.proof.volumes import volume_twins as twin


def random_mask(shape: tuple[int, int, int], *, density: float) -> np.ndarray:
    return np.random.default_rng(3).random(shape) < density


def mask_of(device, chosen: np.ndarray) -> clrecon.Mask:
    return clrecon.Mask.from_array(Volume(np.zeros(chosen.shape, np.int16), OBLIQUE), chosen, device=device)


@pytest.mark.parametrize("density", [0.0, 0.3, 0.6, 0.8, 1.0])
@pytest.mark.parametrize("shape", [(7, 12, 40), (1, 12, 40), (7, 1, 40), (7, 12, 1), (1, 1, 1)])
def test_filled_holes_of_random_masks_equal_the_twin_and_scipy(device, shape, density):
    chosen = random_mask(shape, density=density)
    filled = mask_of(device, chosen).fill_holes().to_numpy()
    np.testing.assert_array_equal(filled, twin.fill_holes(chosen))
    np.testing.assert_array_equal(filled, ndimage.binary_fill_holes(chosen))


@pytest.mark.parametrize("density", [0.0, 0.3, 0.6, 0.8, 1.0])
@pytest.mark.parametrize("shape", [(7, 12, 40), (1, 12, 40), (7, 1, 40), (7, 12, 1), (1, 1, 1)])
def test_holes_filled_slice_by_slice_equal_the_twin_and_scipy(device, shape, density):
    chosen = random_mask(shape, density=density)
    filled = mask_of(device, chosen).fill_holes(by_slice=True).to_numpy()
    np.testing.assert_array_equal(filled, twin.fill_holes(chosen, by_slice=True))
    np.testing.assert_array_equal(filled, np.stack([ndimage.binary_fill_holes(layer) for layer in chosen]))


def test_filling_holes_leaves_the_mask_itself(device):
    chosen = random_mask((7, 12, 40), density=0.8)
    mask = mask_of(device, chosen)
    assert mask.fill_holes().count > mask.count
    np.testing.assert_array_equal(mask.to_numpy(), chosen)


@pytest.mark.every_device
@pytest.mark.parametrize("columns", daily(4, [31, 32, 33, 512, 513, 2049]))
def test_filled_holes_of_rows_around_whole_words_equal_scipy(device, columns):
    chosen = random_mask((4, 9, columns), density=0.62)
    np.testing.assert_array_equal(mask_of(device, chosen).fill_holes().to_numpy(), ndimage.binary_fill_holes(chosen))


@pytest.mark.every_device
@pytest.mark.parametrize("columns", daily(4, [31, 32, 33, 512, 513, 2049]))
def test_growth_in_rows_around_whole_words_equals_the_twin(device, columns):
    chosen = random_mask((4, 9, columns), density=0.62)
    mask = mask_of(device, chosen)
    seeds = np.argwhere(chosen)[[0, -1]]  # k, j, i
    grown = mask.grow(mask.scan.ijk_to_lps(seeds[:, ::-1]))
    np.testing.assert_array_equal(grown.to_numpy(), twin.grow(chosen, seeds))


CHESS_BOARD = np.indices((9, 20, 70)).sum(axis=0) % 2 == 0
"""Half of all voxels are a run each, none has a neighbour by a face."""


def test_holes_of_a_chess_board_are_filled_except_at_its_border(device):
    inner = np.zeros_like(CHESS_BOARD)
    inner[1:-1, 1:-1, 1:-1] = True
    np.testing.assert_array_equal(mask_of(device, CHESS_BOARD).fill_holes().to_numpy(), CHESS_BOARD | inner)


def test_seeds_on_a_chess_board_grow_to_themselves_alone(device):
    mask = mask_of(device, CHESS_BOARD)
    two_seeds = [[2, 4, 2], [5, 2, 3]]  # i, j, k, whose sums are even: both are chosen
    grown = mask.grow(mask.scan.ijk_to_lps(two_seeds))
    assert np.argwhere(grown.to_numpy())[:, ::-1].tolist() == two_seeds


@pytest.mark.parametrize("density", [0.4, 0.7])
def test_filled_holes_of_random_masks_equal_the_package_fill_voids(device, density):
    fill_voids = pytest.importorskip("fill_voids")
    chosen = random_mask((20, 33, 65), density=density)
    expected = fill_voids.fill(np.asfortranarray(chosen)).astype(bool)
    np.testing.assert_array_equal(mask_of(device, chosen).fill_holes().to_numpy(), expected)


def shell_and_distance() -> tuple[np.ndarray, np.ndarray]:
    """A shell between 7 and 9 voxels from the middle, and the distance of each voxel from there."""
    k, j, i = np.indices((21, 21, 41)) - np.array([10, 10, 20])[:, None, None, None]
    away = np.sqrt(k**2 + j**2 + i**2)
    return (away < 9) & (away > 7), away


def test_a_closed_shell_is_filled(device):
    shell, away = shell_and_distance()
    np.testing.assert_array_equal(mask_of(device, shell).fill_holes().to_numpy(), away < 9)


def test_a_shell_with_a_hole_through_its_wall_is_filled_slice_by_slice_alone(device):
    shell, _ = shell_and_distance()
    shell[10, 10, :20] = False
    pierced = mask_of(device, shell)
    assert pierced.fill_holes().count == pierced.count
    assert pierced.fill_holes(by_slice=True).count > pierced.count


@pytest.mark.parametrize("density", [0.25, 0.33, 0.5])
def test_growth_from_points_gives_the_components_of_scipy_that_hold_them(device, density):
    chosen = random_mask((9, 20, 70), density=density)
    labels, _ = ndimage.label(chosen)
    seeds = np.argwhere(chosen)[[0, 40, -1]]  # k, j, i
    mask = mask_of(device, chosen)
    grown = mask.grow(mask.scan.ijk_to_lps(seeds[:, ::-1]))
    np.testing.assert_array_equal(grown.to_numpy(), np.isin(labels, labels[tuple(seeds.T)]))
    assert grown.name == "(an array) grown from 3 points"


def test_growth_from_points_beside_voxels_of_an_uneven_stack_equals_the_twin(device):
    volume = uneven(random_mask((6, 9, 40), density=0.4).astype(np.int16))
    chosen = volume.voxels > 0
    seeds = np.argwhere(chosen)[[3, -5]]  # k, j, i
    beside = volume.ijk_to_lps(seeds[:, ::-1]) + 0.05  # mm: the nearest voxels are the same
    grown = clrecon.Mask.from_band(volume, (1, 1), device=device).grow(beside)
    np.testing.assert_array_equal(grown.to_numpy(), twin.grow(chosen, seeds))


@pytest.fixture
def one_voxel(device):
    """A mask of the voxel at (10, 4, 1) mm."""
    voxels = np.zeros((3, 9, 40), np.int16)
    voxels[1, 4, 10] = 1
    return clrecon.Mask.from_band(Volume(voxels, np.eye(4)), (1, 1), device=device)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([[7, 4, 1]], r"\(7.0, 4.0, 1.0\) mm lies in a voxel that is not chosen: .*\(1 to 1 HU\) is 3.0 mm away"),
        ([[10, 4, 1], [10, 4, 90]], r"\(10.0, 4.0, 90.0\) mm lies outside of the volume: .* is 89.0 mm away"),
        ([[0, 0, np.nan]], "needs points that are numbers"),
        (np.zeros((0, 3)), "needs points that are numbers, these are 0 points"),
        ([1, 2], "points have shape"),
    ],
    ids=["not chosen", "outside", "nan", "no point", "two numbers"],
)
def test_points_that_nothing_grows_from_are_refused(one_voxel, points, words):
    with pytest.raises(UsageError, match=words):
        one_voxel.grow(points)


def test_growth_in_an_empty_mask_is_refused(one_voxel):
    with refused(UsageError, "voxel", "grow"):
        (one_voxel - one_voxel).grow([[10, 4, 1]])


def test_filling_holes_without_room_on_the_device_is_refused(one_voxel):
    small = clrecon.Mask(one_voxel.scan, one_voxel.bits.mask_d, "", device=one_voxel.device, memory=900)
    with refused(DeviceError, "masks", "rows", 900):
        small.fill_holes()


POINT = (1.0, 1.0, 1.0)
CUBE = Volume(np.arange(27, dtype=np.int16).reshape(3, 3, 3), np.eye(4))


def test_volume_takes_one_point_for_an_array_of_one():
    assert [CUBE.sample(POINT)] == CUBE.sample([POINT]).tolist()
    assert CUBE.lps_to_ijk(POINT).tolist() == [1, 1, 1]


def test_cloud_is_made_of_one_point():
    assert len(clrecon.PointCloud(POINT)) == 1


def test_mask_grows_from_one_point_and_lies_in_a_ball_around_it(device):
    mask = clrecon.Mask.from_band(CUBE, (0, None), device=device)
    assert mask.grow(POINT).count == CUBE.voxels.size
    assert clrecon.Mask.from_tube(CUBE, POINT, 9.0, device=device).count == CUBE.voxels.size  # a ball of 9 mm


def test_mesh_takes_one_point_for_an_array_of_one():
    box = clrecon.Mesh(*samples.box())
    (part,) = box.split(seeds=POINT)
    assert part.vertices.tolist() == box.vertices.tolist()
    points, distances, rows = box.closest_points(POINT)
    assert (points.shape, distances.shape, rows.shape) == ((1, 3), (1,), (1,))
    assert box.ray(POINT, (0, 0, 1)).shape == (1, 3)


def test_clip_takes_one_point_for_an_array_of_one():
    contains = clrecon.Clip.box((0, 0, 0), (2, 2, 2)).contains
    assert contains(POINT)
    assert not contains((1.0, 1.0, 3.0))
    assert contains([POINT]).tolist() == [True]
