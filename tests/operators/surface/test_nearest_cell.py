"""The active cell nearest to a point: the same as by a look at all of them, however the volume lies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from surface_volumes import MIRRORED, OBLIQUE, smooth_volume
from uneven_volume import uneven

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule, choose_iso_rule
from clrecon.opencl import Stopwatch
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.growing import find_cell_near
from clrecon.operators.surface.marching_cubes import Classifier
from clrecon.operators.surface.seeds import SEED_REACH_MM
from clrecon.operators.surface.slabs import SampleGrid, Slab
from clrecon.proof.surface.growing import find_active

SHEARED = np.array([[0.7, 0.0, 0.4, -80.0], [0.0, 0.8, 0.5, 3.0], [0.0, 0.1, 2.0, 40.0], [0.0, 0.0, 0.0, 1.0]])

LEVEL_HU = 700


def volume_of_kind(kind: str) -> Volume:
    voxels = smooth_volume((19, 30, 90)).voxels
    if kind == "uneven":
        return uneven(voxels[4:10])
    return Volume(voxels, {"oblique": OBLIQUE, "mirrored": MIRRORED, "sheared": SHEARED}[kind])


def make_finder(device: Any, volume: Volume, rule: IsoRule) -> Callable[[np.ndarray], np.ndarray]:
    """Mark the voxels inside on the device; return the search for the active cell (i, j, k) nearest to a point, mm."""
    grid, watch = SampleGrid(volume, rule), Stopwatch()
    with watch.running(device), DeviceVolume(volume, device=device) as resident:
        lowest_inside = (volume.voxels.dtype.type(rule.lowest_inside),)
        marked = Classifier(device, Slab(grid, 0, grid.shape[2]), lowest_inside).mark_rest(resident.whole(watch))

    def find_cell(point: np.ndarray) -> np.ndarray:
        k, j, i = find_cell_near(device, grid, marked, point)
        return np.array([i, j, k])

    return find_cell


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("kind", ["oblique", "mirrored", "sheared", "uneven"])
def test_nearest_cell_to_a_point_is_the_nearest_of_all_within_10_mm_and_refused_beyond(
    kind: str, closed: bool, device: Any
) -> None:
    """Forty points at random, against a look at all active cells."""
    volume = volume_of_kind(kind)
    rule = choose_iso_rule(volume, LEVEL_HU, closed=closed)
    find_cell = make_finder(device, volume, rule)

    def centres_mm(cells: np.ndarray) -> np.ndarray:
        """Of cells (i, j, k) that are counted from the border, where the volume has one."""
        return volume.ijk_to_lps(cells + 0.5 - rule.border)

    inside_kji = np.pad(volume.voxels >= LEVEL_HU, rule.border)
    all_centres = centres_mm(np.argwhere(find_active(inside_kji))[:, ::-1])
    points_ijk = np.random.default_rng(4).uniform(0, np.array(volume.shape_ijk) - 1, (40, 3))

    refused_points = 0
    for point in volume.ijk_to_lps(points_ijk):
        nearest_mm = np.linalg.norm(all_centres - point, axis=1).min()
        if nearest_mm > SEED_REACH_MM:
            with pytest.raises(UsageError, match=f"a seed lies within {SEED_REACH_MM:g} mm of it"):
                find_cell(point)
            refused_points += 1
            continue
        (centre,) = centres_mm(find_cell(point)[None])
        assert np.linalg.norm(centre - point) == pytest.approx(nearest_mm, abs=1e-9)  # mm in float64; measured 1e-14
    assert 0 < refused_points < len(points_ijk)  # measured 6 to 9 of 40
