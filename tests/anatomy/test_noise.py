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


@pytest.mark.parametrize("noise", [3.0, 12.0, 40.0])
def test_noise_of_even_tissue_is_measured_as_made(noise):
    voxels = np.random.default_rng(1).normal(50.0, noise, (6, 120, 120)) + 0.5 * np.arange(120)
    found = measure_noise(Volume(np.rint(voxels).astype(np.int16), np.eye(4)))
    assert found.hu == pytest.approx(noise, rel=NOISE_SHARE)
    assert found.slices == 6 and found.blocks <= 2400


def test_noise_leaves_out_edges_and_air():
    """Stripes of fat and muscle, air around: three quarters of the blocks hold an edge or air."""
    voxels = np.where(np.arange(240) // 20 % 2, 60.0, -90.0) * np.ones((5, 240, 1))
    voxels = voxels + np.random.default_rng(2).normal(0.0, 15.0, voxels.shape)
    voxels[:, :60], voxels[:, -60:] = -1000.0, 400.0
    assert measure_noise(Volume(voxels, np.eye(4))).hu == pytest.approx(15.0, rel=2 * NOISE_SHARE)


@pytest.mark.parametrize("noise", [8.0, 25.0])
def test_noise_of_a_phantom_is_measured_as_made(noise):
    size, spacing = (128, 128), (1.4, 1.4, 2.0)
    settings = PhantomSettings(kind="spine", size=size, slices=12, spacing=spacing, noise=noise, point_spread_mm=0.0)
    voxels, affine, _ = make_phantom(settings)
    assert measure_noise(Volume(voxels, affine)).hu == pytest.approx(noise, rel=2 * NOISE_SHARE)


def test_no_soft_tissue_is_told():
    with refused(UsageError, 0, 6, 3):
        measure_noise(Volume(np.full((3, 60, 60), -1000, np.int16), np.eye(4)))
