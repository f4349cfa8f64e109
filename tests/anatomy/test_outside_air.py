"""Air round the patient is left out of what lies below an iso value; lungs, airways and bowel gas stay."""

from __future__ import annotations

import numpy as np
import pytest
from body_volumes import AFFINE, SHAPE, add_table, as_volume, ellipse, make_patient
from refusals import refused

from clrecon.anatomy.surroundings import leave_outside_air
from clrecon.errors import NoSurfaceError, RefusedInputError
from clrecon.geometry import Volume

ML = abs(np.linalg.det(AFFINE[:3, :3])) / 1000.0


def cavities(lungs: bool) -> np.ndarray:
    """What `make_patient` has below -400 HU within the body: a bubble of gas and lungs."""
    mask = ellipse(15, -63, 18, 10)
    for side in (-1, 1):
        mask |= lungs & ellipse(side * 58, -10, 46, 52)
    return np.broadcast_to(mask, SHAPE)


@pytest.mark.parametrize("table", [False, True])
@pytest.mark.parametrize("lungs", [False, True])
def test_cavities_stay_to_the_voxel_and_all_air_outside_goes(lungs, table):
    hu, patient = make_patient(lungs)
    if table:
        add_table(hu, patient)
    volume = as_volume(hu)
    changed = leave_outside_air(volume, [-400.0])
    below = changed.voxels < -400
    expected = cavities(lungs) & (volume.voxels < -400)
    spine = np.broadcast_to(ellipse(0, 35, 14, 14), SHAPE)
    assert np.array_equal(below[~spine], expected[~spine])
    assert np.array_equal(changed.voxels[below], volume.voxels[below])
    facts = changed.report["outside_air"]
    assert facts["kept_ml"] == pytest.approx(below.sum() * ML, abs=1e-3)
    assert facts["left_out_ml"] == pytest.approx(((volume.voxels < -400) & ~below).sum() * ML, abs=1e-3)
    assert facts["opening_mm2"] == 0.0
    assert facts["filled_hu"] == 224.0
    assert "outside_air" not in volume.report


def test_an_airway_that_is_open_to_the_outside_is_cut_and_said():
    """A tube 10 mm wide from the front of the body to a cavity within."""
    hu, _ = make_patient(arms=False)
    air = np.random.default_rng(2).normal(-1000, 8, SHAPE)  # air without noise is padding
    tube = np.zeros(SHAPE, dtype=bool)
    tube[5:9] = (abs(X_MM) < 5) & (Y_MM < 0)
    tube |= ellipse(0, 0, 30, 12)
    volume = as_volume(np.where(tube, air, hu))
    changed = leave_outside_air(volume, [-400.0])
    below = changed.voxels < -400
    assert below[:, ellipse(0, 0, 29, 11)].mean() > 0.99
    assert below[6, 60, 100]  # in the middle of the tube
    assert not below[6, :15].any()  # before its mouth
    section = 4 * 2.5 * 5 * 2.0  # slices and columns of the tube
    assert 0.5 * section <= changed.report["outside_air"]["opening_mm2"] <= 4.0 * section


def test_lungs_that_the_field_of_view_cuts_stay():
    hu, _ = make_patient(lungs=True, arms=False)
    circle = X_MM**2 + Y_MM**2 > 95.0**2
    hu[:, circle] = -1000.0  # padding: one value
    changed = leave_outside_air(as_volume(hu), [-400.0])
    below = changed.voxels < -400
    assert not below[:, circle].any()
    assert below[cavities(True) & ~circle].mean() > 0.99


def test_levels_above_air_leave_fat_alone():
    hu, patient = make_patient()
    hu[:, patient & ~ellipse(0, -10, 112, 67)] = -100.0
    volume = as_volume(hu)
    below = leave_outside_air(volume, [-400.0, -50.0]).voxels < -50
    fat = (volume.voxels < -50) & (volume.voxels > -200)
    assert below[fat].all()


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_scans_without_body_or_without_cavity_are_refused(dtype):
    air = np.random.default_rng(0).normal(-1000, 8, SHAPE)
    with refused(RefusedInputError, "keep_outside=True", "body"):
        leave_outside_air(Volume(air.astype(dtype), AFFINE), [-400.0])
    air[:, ellipse(0, 0, 100, 60)] = 40.0
    with refused(NoSurfaceError, -400, "body"):
        leave_outside_air(Volume(air.astype(dtype), AFFINE), [-400.0])


Y_MM, X_MM = np.meshgrid((np.arange(170) - 84.5) * 1.8, (np.arange(200) - 99.5) * 2.0, indexing="ij")
