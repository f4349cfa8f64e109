"""Holes that are filled and components that grow from points equal the twin, scipy and fill-voids."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from scipy import ndimage
from surface_volumes import OBLIQUE
from uneven_volume import uneven
from variants import daily

import clrecon
from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.proof.volumes import volume_twins as twin


def noise(shape: tuple[int, int, int], density: float, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < density


def mask_of(device, chosen: np.ndarray) -> clrecon.Mask:
    return clrecon.Mask.from_array(Volume(np.zeros(chosen.shape, np.int16), OBLIQUE), chosen, device=device)


@pytest.mark.parametrize("density", [0.0, 0.3, 0.6, 0.8, 1.0])
@pytest.mark.parametrize("shape", [(7, 12, 40), (1, 12, 40), (7, 1, 40), (7, 12, 1), (1, 1, 1)])
def test_holes_of_noise_equal_the_twin_and_scipy(device, shape, density):
    chosen = noise(shape, density)
    mask = mask_of(device, chosen)
    filled = mask.fill_holes().to_numpy()
    np.testing.assert_array_equal(filled, twin.fill_holes(chosen))
    np.testing.assert_array_equal(filled, ndimage.binary_fill_holes(chosen))
    flat = np.stack([ndimage.binary_fill_holes(layer) for layer in chosen])
    np.testing.assert_array_equal(twin.fill_holes(chosen, by_slice=True), flat)
    np.testing.assert_array_equal(mask.fill_holes(by_slice=True).to_numpy(), flat)
    np.testing.assert_array_equal(mask.to_numpy(), chosen)


@pytest.mark.every_device
@pytest.mark.parametrize("ni", daily(4, [31, 32, 33, 512, 513, 2049]))
def test_holes_and_growth_of_rows_of_every_length_equal_scipy_and_the_twin(device, ni):
    chosen = noise((4, 9, ni), 0.62)
    mask = mask_of(device, chosen)
    np.testing.assert_array_equal(mask.fill_holes().to_numpy(), ndimage.binary_fill_holes(chosen))
    start = np.argwhere(chosen)[[0, -1]]
    np.testing.assert_array_equal(mask.grow(mask.scan.ijk_to_lps(start[:, ::-1])).to_numpy(), twin.grow(chosen, start))


def test_holes_of_a_chess_board_are_filled_and_nothing_grows(device):
    """A chess board: half of all voxels is a run, none has a neighbour by a face."""
    chosen = np.indices((9, 20, 70)).sum(axis=0) % 2 == 0
    mask = mask_of(device, chosen)
    inner = np.zeros_like(chosen)
    inner[1:-1, 1:-1, 1:-1] = True
    np.testing.assert_array_equal(mask.fill_holes().to_numpy(), chosen | inner)
    assert mask.grow(mask.scan.ijk_to_lps([[2, 2, 2], [5, 4, 3]])).count == 2


def test_holes_equal_fill_voids(device):
    fill_voids = pytest.importorskip("fill_voids")
    for density in (0.4, 0.7):
        chosen = noise((20, 33, 65), density)
        expected = fill_voids.fill(np.asfortranarray(chosen)).astype(bool)
        np.testing.assert_array_equal(mask_of(device, chosen).fill_holes().to_numpy(), expected)


def test_a_shell_is_filled_and_an_open_one_is_not(device):
    k, j, i = np.indices((21, 21, 41)) - np.array([10, 10, 20])[:, None, None, None]
    away = np.sqrt(k**2 + j**2 + i**2)
    shell = (away < 9) & (away > 7)
    mask = mask_of(device, shell)
    np.testing.assert_array_equal(mask.fill_holes().to_numpy(), away < 9)
    shell[10, 10, :20] = False
    opened = mask_of(device, shell)
    assert opened.fill_holes().count == shell.sum()
    assert opened.fill_holes(by_slice=True).count > shell.sum()


@pytest.mark.parametrize("density", [0.25, 0.33, 0.5])
def test_components_equal_those_of_scipy(device, density):
    chosen = noise((9, 20, 70), density)
    labels, _ = ndimage.label(chosen)
    seeds = np.argwhere(chosen)[[0, 40, -1]]
    mask = mask_of(device, chosen)
    grown = mask.grow(mask.scan.ijk_to_lps(seeds[:, ::-1]))
    np.testing.assert_array_equal(grown.to_numpy(), np.isin(labels, labels[tuple(seeds.T)]))
    assert (grown - mask).count == 0
    assert grown.name == "(an array) grown from 3 points"


def test_growth_from_points_of_an_uneven_stack_equals_the_twin(device):
    volume = uneven(noise((6, 9, 40), 0.4).astype(np.int16))
    chosen = volume.voxels > 0
    seeds = np.argwhere(chosen)[[3, -5]]
    grown = clrecon.Mask.from_band(volume, (1, 1), device=device).grow(volume.ijk_to_lps(seeds[:, ::-1]) + 0.05)
    np.testing.assert_array_equal(grown.to_numpy(), twin.grow(chosen, seeds))


def test_points_that_nothing_grows_from_are_refused(device):
    chosen = np.zeros((3, 9, 40), bool)
    chosen[1, 4, 10] = True
    volume = Volume(chosen.astype(np.int16), np.eye(4))
    mask = clrecon.Mask.from_band(volume, (1, 1), device=device)
    for points, words in (
        (
            [[7, 4, 1]],
            r"\(7.0, 4.0, 1.0\) mm lies in a voxel that is not chosen: .*chosen \(1 to 1 HU\) is 3.0 mm away",
        ),
        ([[10, 4, 1], [10, 4, 90]], r"\(10.0, 4.0, 90.0\) mm lies outside of the volume: .* is 89.0 mm away"),
        ([[0, 0, np.nan]], "needs points that are numbers"),
        (np.zeros((0, 3)), "needs points that are numbers, these are 0 points"),
        ([1, 2], "points have shape"),
    ):
        with pytest.raises(UsageError, match=words):
            mask.grow(points)
    with pytest.raises(UsageError, match="no voxel is chosen .*nothing can grow"):
        (mask - mask).grow([[10, 4, 1]])
    small = clrecon.Mask(volume, mask.bits.mask_d, "", device=mask.device, memory=900)
    with pytest.raises(DeviceError, match="are allowed"):
        small.fill_holes()


def test_one_point_is_as_good_as_an_array_of_one(device):
    point, box = (1.0, 1.0, 1.0), clrecon.Mesh(*samples.box())
    volume = Volume(np.arange(27, dtype=np.int16).reshape(3, 3, 3), np.eye(4))
    mask = clrecon.Mask.from_band(volume, (0, None), device=device)
    assert volume.sample(point) == volume.sample([point])[0] and volume.lps_to_ijk(point).tolist() == [1, 1, 1]
    assert len(clrecon.PointCloud(point)) == 1 and mask.grow(point).count == 27
    assert mask.count == clrecon.Mask.from_tube(volume, point, 9.0, device=device).count
    assert [part.vertices.tolist() for part in box.split(seeds=point)] == [box.vertices.tolist()]
    assert box.closest_points(point)[1].shape == box.ray(point, (0, 0, 1))[:, 0].shape == (1,)
    kept = clrecon.Clip.box((0, 0, 0), (2, 2, 2)).contains
    assert kept(point) and not kept((1.0, 1.0, 3.0)) and kept([point]).tolist() == [True]
