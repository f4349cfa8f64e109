"""The slices of a solid volume that are made again where meshes are measured."""

from __future__ import annotations

import numpy as np
import pytest
from sample_meshes import ball

from clrecon.geometry import Volume
from clrecon.jobs.mesh.make import BESIDE_SLICES, _remember_filled
from clrecon.mesh import Mesh


@pytest.mark.parametrize("middle", [(10.0, 8.0, 3.0), (10.0, 8.0, 90.0), (10.0, 8.0, 147.0)])
def test_slices_around_a_mesh_are_those_of_the_solid_volume(middle: tuple[float, float, float]) -> None:
    random = np.random.default_rng(4)
    scan = Volume(random.integers(-100, 100, (100, 16, 21)).astype(np.int16), np.diag([1.0, 1.0, 1.5, 1.0]))
    solid = scan.with_voxels(np.where(random.random(scan.voxels.shape) < 0.3, np.int16(500), scan.voxels))
    solid.report = {"solid": {"filled_hu": 500.0}}
    mesh = Mesh(ball(2.0, 10)[0] + middle, ball(2.0, 10)[1])
    part = _remember_filled(scan, solid)([mesh])
    first = round(part.ijk_to_lps([[0.0, 0.0, 0.0]])[0, 2] / 1.5)
    low, high = (end[2] / 1.5 for end in mesh.bounds)
    assert first <= max(low - BESIDE_SLICES, 0) and first + len(part.voxels) > min(high + BESIDE_SLICES - 1, 99)
    assert len(part.voxels) < 40, "not the whole volume"
    np.testing.assert_array_equal(part.voxels, solid.voxels[first : first + len(part.voxels)])
    assert scan.report is solid.report


def test_a_volume_that_was_not_filled_is_the_scan() -> None:
    scan = Volume(np.zeros((3, 3, 3), np.int16), np.eye(4))
    assert _remember_filled(scan, scan)([]) is scan
