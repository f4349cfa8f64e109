"""The slices of a solid volume that are made again where meshes are measured."""

from __future__ import annotations

import numpy as np
import pytest
from sample_meshes import ball

from clrecon.geometry import Volume
from clrecon.jobs.mesh.make import BESIDE_SLICES, _remember_filled
from clrecon.mesh import Mesh


@pytest.mark.parametrize("middle_mm", [3.0, 90.0, 147.0], ids=["lowest", "middle", "highest"])
def test_slices_about_a_mesh_are_those_of_the_solid_volume_and_no_more_than_needed(middle_mm: float) -> None:
    slices, spacing_mm, radius_mm = 100, 1.5, 2.0
    random = np.random.default_rng(4)
    noise = random.integers(-100, 100, (slices, 16, 21)).astype(np.int16)
    scan = Volume(noise, np.diag([1.0, 1.0, spacing_mm, 1.0]))
    solid = scan.with_voxels(np.where(random.random(noise.shape) < 0.3, np.int16(500), noise))
    solid.report = {"solid": {"filled_hu": 500.0}}
    vertices, triangles = ball(radius_mm, rings=10)
    mesh = Mesh(vertices + (10.0, 8.0, middle_mm), triangles)

    part = _remember_filled(scan, solid)([mesh])

    first = round(part.ijk_to_lps([[0.0, 0.0, 0.0]])[0, 2] / spacing_mm)
    count = len(part.voxels)
    low, high = (middle_mm - radius_mm) / spacing_mm, (middle_mm + radius_mm) / spacing_mm  # slices of the mesh
    assert first <= max(low - BESIDE_SLICES, 0)
    assert first + count > min(high + BESIDE_SLICES - 1, slices - 1)
    assert count <= high - low + 2 * BESIDE_SLICES + 1  # and a slice that the mesh meets in part
    np.testing.assert_array_equal(part.voxels, solid.voxels[first : first + count])
    assert scan.report is solid.report


def test_slices_of_a_volume_that_was_not_filled_are_the_scan_itself() -> None:
    scan = Volume(np.zeros((3, 3, 3), np.int16), np.eye(4))
    assert _remember_filled(scan, scan)([]) is scan
