"""The active cell nearest to a point: the same as by a look at all of them, however the volume lies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from surface_volumes import MIRRORED, OBLIQUE, smooth_volume
from uneven_volume import uneven

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.opencl import Stopwatch
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.growing import find_cell_near
from clrecon.operators.surface.marching_cubes import classify
from clrecon.operators.surface.seeds import SEED_REACH_MM
from clrecon.operators.surface.slabs import SampleGrid, Slab
from clrecon.proof.surface.growing import find_active

SHEARED = np.array([[0.7, 0.0, 0.4, -80.0], [0.0, 0.8, 0.5, 3.0], [0.0, 0.1, 2.0, 40.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("affine", [OBLIQUE, MIRRORED, SHEARED, None], ids=["oblique", "mirrored", "sheared", "uneven"])
def test_nearest_cell_is_the_nearest_of_all(affine: Any, closed: bool, device: Any) -> None:
    made = smooth_volume((19, 30, 90))
    volume = uneven(made.voxels[4:10]) if affine is None else Volume(made.voxels, affine)
    rule = choose_iso_rule(volume, 300, closed=closed)
    grid, watch = SampleGrid(volume, rule), Stopwatch()
    with watch.running(device), DeviceVolume(volume, device=device) as resident:
        level = (volume.voxels.dtype.type(rule.lowest_inside),)
        classified = classify(device, Slab(grid, 0, grid.shape[2]), resident.whole(watch), level)
    cells = np.argwhere(find_active(np.pad(volume.voxels >= 300, rule.border)))
    centres = volume.ijk_to_lps(cells[:, ::-1] + 0.5 - rule.border)
    random = np.random.default_rng(4)
    points = volume.ijk_to_lps(random.uniform(0, np.array(volume.shape_ijk) - 1, (40, 3)))
    found = 0
    for point in points:
        away = np.linalg.norm(centres - point, axis=1)
        if away.min() > SEED_REACH_MM:
            with pytest.raises(UsageError, match="a seed lies within 10 mm of it"):
                find_cell_near(device, grid, classified, point)
            continue
        found += 1
        at = find_cell_near(device, grid, classified, point)
        assert np.linalg.norm(volume.ijk_to_lps(np.array([at[::-1]]) + 0.5 - rule.border) - point) == pytest.approx(
            away.min(), abs=1e-6
        )
    assert found > 10
