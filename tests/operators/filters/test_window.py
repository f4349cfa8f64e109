"""Windows of filters: taps counted by hand, distances in mm, and what a cap leaves."""

from __future__ import annotations

import numpy as np
import pytest
from surface_volumes import OBLIQUE
from uneven_volume import uneven

from clrecon.geometry import Volume
from clrecon.operators.filters.settings import LARGEST_REACH, choose_window
from clrecon.proof.volumes.volume_twins import spatial_weights

pytestmark = pytest.mark.unit


def cube(spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Volume:
    return Volume(np.zeros((8, 8, 8), np.int16), np.diag((*spacing, 1.0)))


@pytest.mark.parametrize(("diameter", "taps"), [(3, 5), (5, 13), (7, 29), (9, 49)])
def test_window_holds_the_disc_of_opencv(diameter, taps):
    """OpenCV's window of diameter d holds the pixels within d // 2 steps."""
    window = choose_window(cube(), sigma_mm=5.0, dimensions=2, most_taps=taps)
    steps = np.arange(-(diameter // 2), diameter // 2 + 1)
    disc = {(i, j, 0) for i in steps for j in steps if i * i + j * j <= (diameter // 2) ** 2}
    assert {tuple(offset) for offset in window.offsets.tolist()} == disc
    assert window.taps == taps
    assert window.reach == (diameter // 2, diameter // 2, 0)


@pytest.mark.parametrize(
    ("spacing", "sigma", "reach"),
    [((1, 1, 1), 0.8, (2, 2, 2)), ((0.7, 0.7, 1.4), 0.56, (2, 2, 1)), ((0.5, 1, 2), 0.4, (2, 1, 1))],
)
def test_window_holds_the_box_of_itk(spacing, sigma, reach):
    """ITK's radius is ceil(2.5 sigma / step) along each axis."""
    window = choose_window(cube(spacing), sigma_mm=sigma, dimensions=3, most_taps=4096)
    assert window.reach == reach
    assert window.taps == window.whole_taps == np.prod(2 * np.array(reach) + 1)
    assert window.share == 1.0


def test_a_cap_of_taps_leaves_the_whole_rings_within_it():
    """Of 7 x 7 x 7 taps 123 lie within three steps; the next ring would pass the cap of 125."""
    window = choose_window(cube(), sigma_mm=1.0, dimensions=3, most_taps=125)
    within_three = sum(i * i + j * j + k * k <= 9 for i in range(-3, 4) for j in range(-3, 4) for k in range(-3, 4))
    assert (window.taps, window.whole_taps) == (within_three, 7**3)
    assert (window.offsets**2).sum(axis=1).max() == 3**2
    assert 0.95 < window.share < 1.0  # measured 0.977: the corners have 2 % of the weight


@pytest.mark.parametrize(("cap", "taps"), [(6, 1), (7, 7)], ids=["less than the first ring", "the first ring"])
def test_a_cap_below_the_first_ring_leaves_the_voxel_alone(cap, taps):
    assert choose_window(cube(), sigma_mm=1.0, dimensions=3, most_taps=cap).taps == taps


def test_window_of_a_large_sigma_ends_at_the_largest_reach():
    sigma_mm = 100.0
    window = choose_window(cube(), sigma_mm, dimensions=2, most_taps=4096)
    assert max(window.reach) == LARGEST_REACH
    side = 2 * LARGEST_REACH + 1
    assert window.share == pytest.approx(side**2 / (2 * np.pi * sigma_mm**2), rel=0.01)  # of a nearly flat Gaussian
    assert len(window.rows()) == side


@pytest.mark.parametrize("volume", [Volume(np.zeros((6, 5, 4)), OBLIQUE), uneven()], ids=["oblique", "uneven"])
def test_weights_of_taps_are_those_of_their_distances_in_mm_for_each_uneven_slice(volume):
    window = choose_window(volume, sigma_mm=0.9, dimensions=3, most_taps=90)
    expected = spatial_weights(volume, window.offsets, 0.9)
    # Float64.
    np.testing.assert_allclose(np.broadcast_to(np.exp2(window.exponents), expected.shape), expected, rtol=1e-9)
    assert len(window.exponents) == (volume.shape_ijk[2] if volume.uneven else 1)


def test_window_of_a_sheared_volume_holds_the_nearest_voxels_in_mm():
    """Slices are shifted by two columns: the nearest voxel of the next slice has the index two columns before."""
    affine = np.diag((1.0, 1.0, 1.0, 1.0))
    affine[0, 2] = 2.0
    window = choose_window(Volume(np.zeros((4, 4, 4)), affine), sigma_mm=1.0, dimensions=3, most_taps=7)
    assert {tuple(offset) for offset in window.offsets.tolist()} >= {(0, 0, 0), (1, 0, 0), (-2, 0, 1), (2, 0, -1)}


def test_rows_of_a_window_list_its_taps():
    window = choose_window(cube(spacing=(0.5, 1, 2)), sigma_mm=1.2, dimensions=3, most_taps=60)
    listed = [(first + n, j, k) for j, k, first, count in window.rows().tolist() for n in range(count)]
    assert listed == [tuple(offset) for offset in window.offsets.tolist()]
