"""Air round the patient is left out of what lies below an iso value; lungs, airways and bowel gas stay."""

from __future__ import annotations

import numpy as np
import pytest
from body_volumes import AFFINE, SHAPE, add_table, as_volume, ellipse, make_patient
from refusals import refused

from clrecon.anatomy.surroundings import leave_outside_air
from clrecon.errors import NoSurfaceError, RefusedInputError
from clrecon.geometry import AIR_HU, Volume

VOXEL_ML = abs(np.linalg.det(AFFINE[:3, :3])) / 1000.0
LEVEL_HU = -400.0


def find_cavities(lungs: bool) -> np.ndarray:
    """What `make_patient` has below -400 HU within the body: a bubble of gas and lungs."""
    mask = ellipse(15, -63, 18, 10)
    for side in (-1, 1):
        mask |= lungs & ellipse(side * 58, -10, 46, 52)
    return np.broadcast_to(mask, SHAPE)


@pytest.fixture(
    scope="module",
    params=[(lungs, table) for lungs in (False, True) for table in (False, True)],
    ids=["no lungs", "no lungs, on a table", "lungs", "lungs, on a table"],
)
def patient_in_air(request):
    """The scan, the scan without the air around the patient, and what lies below -400 HU within the patient."""
    lungs, table = request.param
    hu, patient = make_patient(lungs=lungs)
    if table:
        add_table(hu, patient)
    volume = as_volume(hu)
    return volume, leave_outside_air(volume, [LEVEL_HU]), find_cavities(lungs=lungs) & (volume.voxels < LEVEL_HU)


def test_air_below_the_level_stays_in_cavities_of_the_body_alone(patient_in_air):
    _, changed, cavities = patient_in_air
    elsewhere = ~np.broadcast_to(ellipse(0, 35, 14, 14), SHAPE)  # but in the spine, where noise decides
    assert np.array_equal((changed.voxels < LEVEL_HU)[elsewhere], cavities[elsewhere])


def test_air_in_cavities_keeps_its_values(patient_in_air):
    volume, changed, _ = patient_in_air
    below = changed.voxels < LEVEL_HU
    assert below.any()
    assert np.array_equal(changed.voxels[below], volume.voxels[below])


def test_report_has_the_millilitres_of_air_that_stay_and_of_those_left_out(patient_in_air):
    volume, changed, _ = patient_in_air
    facts = changed.report["outside_air"]
    below = changed.voxels < LEVEL_HU
    left_out = (volume.voxels < LEVEL_HU) & ~below
    assert facts["kept_ml"] == pytest.approx(below.sum() * VOXEL_ML, abs=1e-3)  # three decimals are kept
    assert facts["left_out_ml"] == pytest.approx(left_out.sum() * VOXEL_ML, abs=1e-3)


def test_report_of_a_body_without_an_open_airway_has_no_opening(patient_in_air):
    _, changed, _ = patient_in_air
    assert changed.report["outside_air"]["opening_mm2"] == 0.0


def test_air_left_out_gets_a_value_as_far_above_the_level_as_air_lies_below_and_the_given_report_stays(patient_in_air):
    volume, changed, _ = patient_in_air
    assert changed.report["outside_air"]["filled_hu"] == LEVEL_HU + (LEVEL_HU - AIR_HU)
    assert "outside_air" not in volume.report


TUBE_SLICES = slice(5, 9)
TUBE_SECTION_MM2 = 4 * 2.5 * 5 * 2.0
"""Four slices of 2.5 mm, and five columns of 2 mm."""


@pytest.fixture(scope="module")
def open_airway():
    """A scan without the air outside: a tube 10 mm wide leads from the front of the body to a cavity within."""
    hu, _ = make_patient(arms=False)
    air = np.random.default_rng(2).normal(-1000, 8, SHAPE)  # air without noise is padding
    tube = np.zeros(SHAPE, dtype=bool)
    tube[TUBE_SLICES] = (abs(X_MM) < 5) & (Y_MM < 0)
    tube |= ellipse(0, 0, 30, 12)
    return leave_outside_air(as_volume(np.where(tube, air, hu)), [LEVEL_HU])


def test_an_airway_that_is_open_to_the_outside_is_cut_at_its_mouth(open_airway):
    below = open_airway.voxels < LEVEL_HU
    cavity = np.s_[:, ellipse(0, 0, 29, 11)]
    middle_of_tube, before_its_mouth = np.s_[6, 60, 100], np.s_[6, :15]  # slice, row and column; rows of air
    assert below[cavity].all()
    assert below[middle_of_tube]
    assert not below[before_its_mouth].any()


def test_report_has_about_the_section_of_an_airway_that_was_cut(open_airway):
    opening_mm2 = open_airway.report["outside_air"]["opening_mm2"]
    assert TUBE_SECTION_MM2 <= opening_mm2 <= 1.4 * TUBE_SECTION_MM2  # a curved surface of cells: measured 1.16


def test_lungs_that_the_field_of_view_cuts_stay_and_the_padding_around_is_left_out():
    hu, _ = make_patient(lungs=True, arms=False)
    circle = X_MM**2 + Y_MM**2 > 95.0**2
    hu[:, circle] = -1000.0  # padding: one value
    below = leave_outside_air(as_volume(hu), [LEVEL_HU]).voxels < LEVEL_HU
    assert not below[:, circle].any()
    assert below[find_cavities(lungs=True) & ~circle].all()


def test_fat_stays_below_a_level_above_it():
    hu, patient = make_patient()
    inside_of_the_skin = ellipse(0, -10, 112, 67)
    hu[:, patient & ~inside_of_the_skin] = -100.0
    volume = as_volume(hu)
    changed = leave_outside_air(volume, [LEVEL_HU, -50.0])
    fat = (volume.voxels < -50) & (volume.voxels > -200)  # all of it at -100 HU
    assert fat.any()
    assert (changed.voxels < -50)[fat].all()


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_a_scan_of_air_without_a_body_is_refused(dtype):
    air = np.random.default_rng(0).normal(-1000, 8, SHAPE)
    with refused(RefusedInputError, "keep_outside=True", "body"):
        leave_outside_air(Volume(air.astype(dtype), AFFINE), [LEVEL_HU])


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_a_body_without_a_cavity_below_the_level_is_refused(dtype):
    hu = np.random.default_rng(0).normal(-1000, 8, SHAPE)
    hu[:, ellipse(0, 0, 100, 60)] = 40.0
    with refused(NoSurfaceError, -400, "body"):
        leave_outside_air(Volume(hu.astype(dtype), AFFINE), [LEVEL_HU])


Y_MM, X_MM = np.meshgrid((np.arange(170) - 84.5) * 1.8, (np.arange(200) - 99.5) * 2.0, indexing="ij")
