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


def noise(shape: tuple[int, int, int], density: float, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < density


def volume_of(shape: tuple[int, int, int], affine: np.ndarray | None) -> Volume:
    voxels = np.zeros(shape, np.int16)
    return uneven(voxels) if affine is None else Volume(voxels, affine)


def check_all(device, volume: Volume, chosen: np.ndarray, mm: float, by_slice: bool = False) -> None:
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    for made, expected in (
        (mask.dilate(mm, by_slice=by_slice), twin.dilate(volume, chosen, mm, by_slice=by_slice)),
        (mask.erode(mm, by_slice=by_slice), twin.erode(volume, chosen, mm, by_slice=by_slice)),
        (
            mask.open(mm, by_slice=by_slice),
            twin.dilate(volume, twin.erode(volume, chosen, mm, by_slice=by_slice), mm, by_slice=by_slice),
        ),
        (mask.close(mm, by_slice=by_slice), twin.close(volume, chosen, mm, by_slice=by_slice)),
    ):
        np.testing.assert_array_equal(made.to_numpy(), expected)
        assert made.count == expected.sum()  # bits beyond the rows stay 0
    np.testing.assert_array_equal(mask.to_numpy(), chosen)


FRAMES = {"fine": FINE, "oblique": OBLIQUE, "mirrored": MIRRORED, "tilted": TILTED, "uneven": None}


@pytest.mark.parametrize("affine", FRAMES.values(), ids=FRAMES.keys())
@pytest.mark.parametrize(("mm", "density"), [(0.3, 0.5), (1.0, 0.03), (1.0, 0.9), (2.3, 0.01), (3.9, 0.997)])
def test_noise_equals_the_twin(device, affine, mm, density):
    chosen = noise((6, 9, 41), density)
    check_all(device, volume_of(chosen.shape, affine), chosen, mm)


@pytest.mark.every_device
@pytest.mark.parametrize("ni", [1, 31, 32, 33, 512, 513, 2049])
@pytest.mark.parametrize("affine", daily(1, [FINE, TILTED]), ids=["fine", "tilted"])
def test_opening_and_closing_of_rows_of_every_length_equal_the_twin(device, ni, affine):
    chosen = noise((3, 4, ni), 0.97)
    check_all(device, volume_of(chosen.shape, affine), chosen, 1.5)


@pytest.mark.parametrize("shape", [(1, 9, 41), (1, 1, 41), (9, 1, 41), (7, 9, 1)])
def test_opening_and_closing_of_flat_volumes_equal_the_twin(device, shape):
    check_all(device, volume_of(shape, OBLIQUE), noise(shape, 0.8), 1.5)


@pytest.mark.parametrize("affine", [FINE, TILTED, None], ids=["fine", "tilted", "uneven"])
def test_opening_and_closing_slice_by_slice_equal_the_twin(device, affine):
    chosen = noise((6, 9, 41), 0.9)
    check_all(device, volume_of(chosen.shape, affine), chosen, 1.5, by_slice=True)


@pytest.mark.parametrize("density", [0.0, 1.0])
def test_empty_and_full_masks_stay_when_opened_and_closed(device, density):
    chosen = noise((5, 9, 41), density)
    for affine in (FINE, TILTED, None):
        check_all(device, volume_of((6, 9, 41), affine), noise((6, 9, 41), density), 2.0)
    mask = clrecon.Mask.from_array(volume_of(chosen.shape, FINE), chosen, device=device)
    assert mask.close(2.0).share == density


@pytest.mark.parametrize("affine", FRAMES.values(), ids=FRAMES.keys())
def test_a_radius_below_a_voxel_changes_nothing_but_one_that_holds_the_volume_all(device, affine):
    chosen = noise((6, 9, 41), 0.4)
    mask = clrecon.Mask.from_array(volume_of(chosen.shape, affine), chosen, device=device)
    for same in (mask.dilate(0.2), mask.erode(0.2), mask.open(0.2), mask.close(0.2)):
        np.testing.assert_array_equal(same.to_numpy(), chosen)
    assert (mask.dilate(80.0).share, mask.erode(80.0).count, mask.open(80.0).count) == (1.0, 0, 0)
    assert mask.close(80.0).share == 1.0


def test_opening_and_closing_of_long_rows_by_wide_balls_equal_the_twin(device):
    """A row of two pieces, and a ball that is wider than a word: its rows are split."""
    volume = volume_of((1, 3, 700), np.diag((0.1, 5.0, 5.0, 1.0)))
    chosen = np.zeros((1, 3, 700), bool)
    chosen[0, 1, [40, 350, 351, 699]] = True
    check_all(device, volume, chosen, 7.3)
    check_all(device, volume, ~chosen, 7.3)


@pytest.mark.parametrize("shape", [(20, 33, 40), (9, 64, 65)])
def test_balls_are_those_of_a_distance_transform(device, shape):
    chosen = noise(shape, 0.002, seed=9)
    volume = volume_of(shape, FINE)
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    for mm in (0.6, 1.4, 3.0, 4.2, 6.1):
        away = ndimage.distance_transform_edt(~chosen, sampling=(1.4, 0.6, 0.7))
        np.testing.assert_array_equal(mask.dilate(mm).to_numpy(), away <= mm * (1 + 1e-6))
        deep = ndimage.distance_transform_edt(np.pad(~chosen, 1), sampling=(1.4, 0.6, 0.7))[1:-1, 1:-1, 1:-1]
        np.testing.assert_array_equal((~mask).erode(mm).to_numpy(), deep > mm * (1 + 1e-6))


def test_opening_shrinks_and_closing_grows(device):
    """Opening and closing are idempotent; the one keeps a part, the other holds all."""
    chosen = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(14, 40, 70)), 1.5) > 0.05
    mask = clrecon.Mask.from_array(volume_of(chosen.shape, FINE), chosen, device=device)
    opened, closed = mask.open(1.5), mask.close(1.5)
    assert 0 < opened.count < mask.count < closed.count < chosen.size
    assert ((opened - mask).count, (mask - closed).count) == (0, 0)
    assert ((opened.open(1.5) ^ opened).count, (closed.close(1.5) ^ closed).count) == (0, 0)
    assert opened.name == "(an array) opened by 1.5 mm"


def test_rows_of_a_ball_are_those_within_its_radius():
    volume = Volume(np.zeros((9, 9, 9), np.int8), np.eye(4))
    ball = ball_of(volume, 2.0)
    assert sorted(map(tuple, ball.rows[:, :2])) == sorted(
        (j, k) for j in range(-2, 3) for k in range(-2, 3) if j * j + k * k <= 4
    )
    assert set(ball.tables.ravel().tolist()) == {0, 13}
    one = Volume(np.zeros((1, 1, 1), np.int8), np.eye(4))
    assert (len(ball_of(one, 2.0).rows), len(whole_ball_of(one, 2.0).rows)) == (1, 13)


@pytest.mark.parametrize("mm", [0.0, -1.0, math.nan, math.inf, "3", None, True])
def test_radii_that_are_none_are_refused(device, mm):
    mask = clrecon.Mask.from_array(volume_of((3, 4, 33), FINE), noise((3, 4, 33), 0.5), device=device)
    for change in (mask.dilate, mask.erode, mask.open, mask.close):
        with refused(UsageError, 0.0, "radius"):
            change(mm)


def test_work_of_hours_and_more_memory_than_allowed_are_refused(device):
    tall = Volume(np.zeros((200, 1000, 33), np.int8), np.diag((1.0, 0.01, 0.01, 1.0)))
    mask = clrecon.Mask.from_band(tall, (0, 1), device=device, memory=20_000_000)
    with refused(UsageError, "radius", 100000000000.0):
        mask.dilate(10.0)
    with refused(DeviceError, "masks", 2):
        clrecon.Mask(tall, mask.bits.mask_d, "", device=mask.device, memory=3_000_000).dilate(0.02)
