"""Masks dilated, eroded, opened and closed by balls in mm equal distances in mm, to the voxel."""

from __future__ import annotations

import math

import numpy as np
import pytest
from refusals import refused
from scipy import ndimage
from surface_volumes import MIRRORED, OBLIQUE
from uneven_volume import uneven
from variants import daily

import clrecon
from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.operators.masks.shapes import ball_of, whole_ball_of
from clrecon.proof.volumes import volume_twins as twin

FINE = np.diag((0.7, 0.6, 1.4, 1.0))
TILTED = np.array([[0.6, 0.0, 0.9, -20.0], [0.0, 0.6, 0.7, 5.0], [0.0, 0.0, 2.0, 100.0], [0, 0, 0, 1.0]])
"""Slices are shifted sideways along both axes: rows of a ball are not centred."""


def random_mask(shape: tuple[int, int, int], *, density: float, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < density


def volume_of(shape: tuple[int, int, int], affine: np.ndarray | None) -> Volume:
    """Voxels of 0 at the places of an affine; without one, slices that are unevenly spaced."""
    voxels = np.zeros(shape, np.int16)
    return uneven(voxels) if affine is None else Volume(voxels, affine)


def assert_changes_equal_twin(device, volume: Volume, chosen: np.ndarray, *, mm: float, by_slice: bool = False) -> None:
    """Dilated, eroded, opened and closed by a ball of `mm`, the mask `chosen` is that of the twin, and itself stays."""
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    eroded = twin.erode(volume, chosen, mm, by_slice=by_slice)
    for made, expected in (
        (mask.dilate(mm, by_slice=by_slice), twin.dilate(volume, chosen, mm, by_slice=by_slice)),
        (mask.erode(mm, by_slice=by_slice), eroded),
        (mask.open(mm, by_slice=by_slice), twin.dilate(volume, eroded, mm, by_slice=by_slice)),
        (mask.close(mm, by_slice=by_slice), twin.close(volume, chosen, mm, by_slice=by_slice)),
    ):
        np.testing.assert_array_equal(made.to_numpy(), expected)
        assert made.count == expected.sum()  # bits beyond the rows stay 0
    np.testing.assert_array_equal(mask.to_numpy(), chosen)


FRAMES = {"fine": FINE, "oblique": OBLIQUE, "mirrored": MIRRORED, "tilted": TILTED, "uneven": None}


@pytest.mark.parametrize("affine", FRAMES.values(), ids=FRAMES.keys())
@pytest.mark.parametrize(("mm", "density"), [(0.3, 0.5), (1.0, 0.03), (1.0, 0.9), (2.3, 0.01), (3.9, 0.997)])
def test_random_masks_dilated_eroded_opened_and_closed_equal_the_twin(device, affine, mm, density):
    chosen = random_mask((6, 9, 41), density=density)
    assert_changes_equal_twin(device, volume_of(chosen.shape, affine), chosen, mm=mm)


@pytest.mark.every_device
@pytest.mark.parametrize("ni", [1, 31, 32, 33, 512, 513, 2049])
@pytest.mark.parametrize("affine", daily(1, [FINE, TILTED]), ids=["fine", "tilted"])
def test_opening_and_closing_of_rows_around_whole_words_equal_the_twin(device, ni, affine):
    chosen = random_mask((3, 4, ni), density=0.97)
    assert_changes_equal_twin(device, volume_of(chosen.shape, affine), chosen, mm=1.5)


@pytest.mark.parametrize("shape", [(1, 9, 41), (1, 1, 41), (9, 1, 41), (7, 9, 1)])
def test_opening_and_closing_of_flat_volumes_equal_the_twin(device, shape):
    assert_changes_equal_twin(device, volume_of(shape, OBLIQUE), random_mask(shape, density=0.8), mm=1.5)


@pytest.mark.parametrize("affine", [FINE, TILTED, None], ids=["fine", "tilted", "uneven"])
def test_opening_and_closing_slice_by_slice_equal_the_twin(device, affine):
    chosen = random_mask((6, 9, 41), density=0.9)
    assert_changes_equal_twin(device, volume_of(chosen.shape, affine), chosen, mm=1.5, by_slice=True)


@pytest.mark.parametrize("share", [0.0, 1.0], ids=["empty", "full"])
@pytest.mark.parametrize("affine", [FINE, TILTED, None], ids=["fine", "tilted", "uneven"])
def test_empty_and_full_masks_dilated_eroded_opened_and_closed_equal_the_twin(device, affine, share):
    chosen = np.full((6, 9, 41), share == 1.0)
    assert_changes_equal_twin(device, volume_of(chosen.shape, affine), chosen, mm=2.0)


@pytest.mark.parametrize("share", [0.0, 1.0], ids=["empty", "full"])
def test_empty_and_full_masks_stay_when_closed(device, share):
    chosen = np.full((5, 9, 41), share == 1.0)
    mask = clrecon.Mask.from_array(volume_of(chosen.shape, FINE), chosen, device=device)
    assert mask.close(2.0).share == share


@pytest.fixture(params=FRAMES)
def random_40_percent(request, device):
    """A mask of random voxels in one of `FRAMES`, whose voxels are 0.5 mm and more."""
    chosen = random_mask((6, 9, 41), density=0.4)
    return clrecon.Mask.from_array(volume_of(chosen.shape, FRAMES[request.param]), chosen, device=device)


@pytest.mark.parametrize("change", ["dilate", "erode", "open", "close"])
def test_a_radius_below_a_voxel_changes_nothing(random_40_percent, change):
    changed = getattr(random_40_percent, change)(0.2)  # mm
    np.testing.assert_array_equal(changed.to_numpy(), random_40_percent.to_numpy())


@pytest.mark.parametrize(("change", "share"), [("dilate", 1.0), ("erode", 0.0), ("open", 0.0), ("close", 1.0)])
def test_a_radius_that_holds_the_volume_leaves_all_or_nothing(random_40_percent, change, share):
    assert getattr(random_40_percent, change)(80.0).share == share  # mm, of a volume of some 30 mm


@pytest.mark.parametrize("inverted", [False, True])
def test_opening_and_closing_of_long_rows_by_wide_balls_equal_the_twin(device, inverted):
    """A ball of 146 columns, wider than the 32 of a word, on a row of 700, which is worked on in two pieces."""
    volume = volume_of((1, 3, 700), np.diag((0.1, 5.0, 5.0, 1.0)))
    chosen = np.zeros((1, 3, 700), bool)
    chosen[0, 1, [40, 350, 351, 699]] = True
    assert_changes_equal_twin(device, volume, ~chosen if inverted else chosen, mm=7.3)


LIMIT = 1 + 1e-6
"""Distances up to the radius times this are within."""


@pytest.mark.parametrize("shape", [(20, 33, 40), (9, 64, 65)])
@pytest.mark.parametrize("mm", [0.6, 1.4, 3.0, 4.2, 6.1])
def test_dilated_masks_hold_the_voxels_within_the_distance_of_scipy(device, shape, mm):
    chosen = random_mask(shape, density=0.002, seed=9)
    away = ndimage.distance_transform_edt(~chosen, sampling=(1.4, 0.6, 0.7))  # mm along k, j, i of FINE
    mask = clrecon.Mask.from_array(volume_of(shape, FINE), chosen, device=device)
    np.testing.assert_array_equal(mask.dilate(mm).to_numpy(), away <= mm * LIMIT)


@pytest.mark.parametrize("shape", [(20, 33, 40), (9, 64, 65)])
@pytest.mark.parametrize("mm", [0.6, 1.4, 3.0, 4.2, 6.1])
def test_eroded_masks_hold_the_voxels_deeper_than_the_distance_of_scipy(device, shape, mm):
    chosen = ~random_mask(shape, density=0.002, seed=9)
    outside_is_empty = np.pad(chosen, 1)
    deep = ndimage.distance_transform_edt(outside_is_empty, sampling=(1.4, 0.6, 0.7))[1:-1, 1:-1, 1:-1]
    mask = clrecon.Mask.from_array(volume_of(shape, FINE), chosen, device=device)
    np.testing.assert_array_equal(mask.erode(mm).to_numpy(), deep > mm * LIMIT)


@pytest.fixture
def blobs(device):
    """A mask of smooth blobs, about half of the volume."""
    chosen = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(14, 40, 70)), 1.5) > 0.05
    return clrecon.Mask.from_array(volume_of(chosen.shape, FINE), chosen, device=device)


def test_an_opened_mask_is_a_part_of_the_mask_and_a_closed_one_holds_it(blobs):
    opened, closed = blobs.open(1.5), blobs.close(1.5)
    assert 0 < opened.count < blobs.count < closed.count < np.prod(blobs.scan.shape)
    assert (opened - blobs).count == 0
    assert (blobs - closed).count == 0


@pytest.mark.parametrize("change", ["open", "close"])
def test_opening_and_closing_twice_is_opening_and_closing_once(blobs, change):
    once = getattr(blobs, change)(1.5)
    np.testing.assert_array_equal(getattr(once, change)(1.5).to_numpy(), once.to_numpy())


def test_an_opened_mask_is_named_with_the_radius(blobs):
    assert blobs.open(1.5).name == "(an array) opened by 1.5 mm"


def rows_within(radius: int) -> list[tuple[int, int]]:
    """Offsets (j, k) of the rows that a ball meets, in voxels of 1 mm."""
    steps = range(-radius, radius + 1)
    return sorted((j, k) for j in steps for k in steps if j * j + k * k <= radius * radius)


def test_rows_of_a_ball_are_those_within_its_radius():
    volume = Volume(np.zeros((9, 9, 9), np.int8), np.eye(4))
    ball = ball_of(volume, 2.0)
    assert sorted(map(tuple, ball.rows[:, :2])) == rows_within(2)
    assert set(ball.tables.ravel().tolist()) == {0, len(rows_within(2))}  # where the rows begin and end


def test_rows_of_a_ball_beyond_the_volume_are_left_out_unless_the_whole_ball_is_asked_for():
    one_voxel = Volume(np.zeros((1, 1, 1), np.int8), np.eye(4))
    assert len(ball_of(one_voxel, 2.0).rows) == 1
    assert len(whole_ball_of(one_voxel, 2.0).rows) == len(rows_within(2))


@pytest.mark.parametrize("change", ["dilate", "erode", "open", "close"])
@pytest.mark.parametrize("mm", [0.0, -1.0, math.nan, math.inf, "3", None, True])
def test_radii_that_are_no_positive_number_are_refused(device, mm, change):
    mask = clrecon.Mask.from_array(volume_of((3, 4, 33), FINE), random_mask((3, 4, 33), density=0.5), device=device)
    with refused(UsageError, 0.0, "radius"):
        getattr(mask, change)(mm)


TALL = Volume(np.zeros((200, 1000, 33), np.int8), np.diag((1.0, 0.01, 0.01, 1.0)))


def test_a_radius_of_a_thousand_voxels_is_refused(device):
    """In voxels of 1 x 0.01 x 0.01 mm: hours of work."""
    mask = clrecon.Mask.from_band(TALL, (0, 1), device=device)
    most_visits = 1e11  # of rows of the volume, that are allowed
    with refused(UsageError, "radius", most_visits):
        mask.dilate(10.0)


def test_a_dilation_without_room_for_two_masks_is_refused(device):
    mask = clrecon.Mask.from_band(TALL, (0, 1), device=device)
    one_mask = 200 * 1000 * 2 * 4  # bytes of two words a row
    with refused(DeviceError, "masks", 2):
        clrecon.Mask(TALL, mask.bits.mask_d, "", device=mask.device, memory=2 * one_mask - 200_000).dilate(0.02)
