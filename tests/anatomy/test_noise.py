"""The noise of scans: known noise is found in even tissue and beside edges; where there is none to measure, words."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from tolerances import NOISE_SHARE

from clrecon.anatomy.noise import measure_noise
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.proof.phantom import PhantomSettings, make_phantom

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("noise_hu", [3.0, 12.0, 40.0])
def test_noise_of_even_tissue_is_measured(noise_hu):
    """Tissue that rises evenly from 50 to 110 HU."""
    voxels = np.random.default_rng(1).normal(50.0, noise_hu, (6, 120, 120)) + 0.5 * np.arange(120)
    measured = measure_noise(Volume(np.rint(voxels).astype(np.int16), np.eye(4)))
    assert measured.hu == pytest.approx(noise_hu, rel=NOISE_SHARE)


def test_noise_is_measured_in_all_blocks_of_6_by_6_voxels_of_all_slices_of_a_short_scan_of_even_tissue():
    voxels = np.random.default_rng(1).normal(50.0, 12.0, (6, 120, 120))  # within -150 to 250 HU by 16 deviations
    measured = measure_noise(Volume(voxels, np.eye(4)))
    assert measured.slices == 6
    assert measured.blocks == 6 * (120 // 6) ** 2


def test_noise_is_measured_beside_edges_and_air():
    """Stripes of fat and muscle, air around: three quarters of the blocks hold an edge or air."""
    stripes = np.where(np.arange(240) // 20 % 2, 60.0, -90.0) * np.ones((5, 240, 1))
    voxels = stripes + np.random.default_rng(2).normal(0.0, 15.0, stripes.shape)
    voxels[:, :60] = -1000.0
    voxels[:, -60:] = 400.0
    assert measure_noise(Volume(voxels, np.eye(4))).hu == pytest.approx(15.0, rel=2 * NOISE_SHARE)


@pytest.mark.parametrize("noise_hu", [8.0, 25.0])
def test_noise_of_a_spine_phantom_is_measured(noise_hu):
    settings = PhantomSettings(
        kind="spine", size=(128, 128), slices=12, spacing=(1.4, 1.4, 2.0), noise=noise_hu, point_spread_mm=0.0
    )
    voxels, affine, _ = make_phantom(settings)
    assert measure_noise(Volume(voxels, affine)).hu == pytest.approx(noise_hu, rel=2 * NOISE_SHARE)


def test_noise_of_a_scan_without_soft_tissue_is_refused():
    air = Volume(np.full((3, 60, 60), -1000, np.int16), np.eye(4))
    with refused(UsageError, 0, 6, 3):  # blocks, voxels a side of a block, slices
        measure_noise(air)
