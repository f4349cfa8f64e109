"""Table and field of view: what is not the patient becomes air, what is the patient stays to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from body_volumes import AFFINE, SHAPE, X, Y, add_table, as_volume, make_patient
from refusals import refused

import clrecon
from clrecon.anatomy.body import find_body, mask_field_of_view, remove_table
from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import AIR_HU, Volume

SPACING = (2.0, 1.8, 2.5)


def widen_by_six(patient):
    """The margin around a patient, in whole cells of two voxels."""
    near = patient.copy()
    for _ in range(6):
        near[1:] |= near[:-1].copy()
        near[:-1] |= near[1:].copy()
        near[:, 1:] |= near[:, :-1].copy()
        near[:, :-1] |= near[:, 1:].copy()
    return near


@pytest.mark.parametrize("lungs", [False, True])
@pytest.mark.parametrize("gap", [1.0, 6.0, 25.0])
def test_the_table_goes_and_the_patient_stays_to_the_bit(gap, lungs):
    hu, patient = make_patient(lungs)
    table = add_table(hu, patient, gap)
    volume = as_volume(hu)
    before = volume.voxels.copy()
    cleaned = remove_table(volume)
    near = widen_by_six(patient)
    assert np.array_equal(volume.voxels, before)  # the input is not touched
    assert np.array_equal(cleaned.voxels[:, patient], before[:, patient])
    assert (table & ~near).any() and not (cleaned.voxels[:, ~near] >= -300).any()


@pytest.mark.parametrize("lungs", [False, True])
def test_a_table_farther_away_than_the_margin_goes_as_a_whole(lungs):
    hu, patient = make_patient(lungs)
    table = add_table(hu, patient, 25.0)
    assert not (remove_table(as_volume(hu)).voxels[:, table] >= -300).any()


@pytest.mark.parametrize("lungs", [False, True])
@pytest.mark.parametrize("gap", [1.0, 6.0, 25.0])
def test_report_of_a_removed_table_counts_what_lies_outside_of_the_body(gap, lungs):
    hu, patient = make_patient(lungs)
    add_table(hu, patient, gap)
    volume = as_volume(hu)
    cleaned = remove_table(volume)
    facts = cleaned.report["remove_table"]
    body, step = find_body(volume)
    assert step == (1, 1, 1)
    assert facts["voxels_removed"] == np.count_nonzero(~body)
    assert (cleaned.voxels[~body] == facts["air_hu"]).all()
    assert facts["dense_voxels_removed"] > 1000


def test_bone_surface_within_the_body_is_the_same_surface():
    from clrecon.proof.surface.extract import extract_isosurface

    hu, patient = make_patient(arms=False)
    plain = as_volume(hu)
    add_table(hu, patient, 12.0)
    expected = extract_isosurface(plain, 250)
    found = extract_isosurface(remove_table(as_volume(hu)), 250)
    assert len(expected[0]) == len(found[0]) > 1000
    assert all(np.array_equal(one, other) for one, other in zip(expected, found, strict=True))


@pytest.mark.parametrize("padded", [False, True])
def test_a_chest_that_the_circle_cuts_keeps_its_wall(padded):
    """The lungs lie open at the border of the scan, and ribs hang on walls of 14 mm."""
    hu, patient = make_patient(lungs=True, arms=False)
    add_table(hu, patient, 6.0)
    outside = np.hypot(X, Y) > 98.0
    hu[:, outside] = -1000.0
    volume = as_volume(hu)
    volume.voxels[:, outside] = -1000 if padded else hu[:, outside]
    cleaned = remove_table(volume)
    inside = patient & ~outside
    assert np.array_equal(cleaned.voxels[:, inside], volume.voxels[:, inside])


def test_a_cropped_scan_has_no_outside():
    hu, _ = make_patient(lungs=True, arms=False)
    volume = as_volume(hu[:, 57:105, 60:140])  # below the bubble
    assert np.array_equal(remove_table(volume).voxels, volume.voxels)
    assert remove_table(volume).report["remove_table"]["removed_share"] == 0.0


def test_uneven_slices_types_and_report_stay():
    hu, patient = make_patient()
    add_table(hu, patient)
    positions = AFFINE[:3, 3] + np.cumsum(np.linspace(1.0, 4.0, SHAPE[0]))[:, None] * np.array([0.0, 0.0, 1.0])
    volume = Volume(hu.astype(np.float32), AFFINE, {"warnings": ["one"], "tilt_deg": 3.0}, positions)
    cleaned = remove_table(volume)
    assert cleaned.voxels.dtype == np.float32 and cleaned.uneven
    assert np.array_equal(cleaned.slice_origins(), volume.slice_origins())
    assert (cleaned.report["warnings"], cleaned.report["tilt_deg"]) == (["one"], 3.0)
    assert "remove_table" not in volume.report


def test_what_becomes_air_has_the_level_of_the_air_there():
    """No iso value shows where the mask ends, but those in the noise of the air itself."""
    hu, patient = make_patient()
    hu[hu < -900] += 12.0  # the air of this scan: -988 HU
    cleaned = remove_table(as_volume(hu))
    assert cleaned.report["remove_table"]["air_hu"] == pytest.approx(-988, abs=1)


def test_nothing_thick_is_no_body():
    hu = np.full(SHAPE, -1000.0)
    hu[:, 100:102] = 300.0
    with refused(RefusedInputError, -300, 14):
        remove_table(as_volume(hu))


# --- field of view ---
@pytest.mark.parametrize(("radius", "expected"), [(None, 153.0), (80.0, 80.0), (400.0, 400.0)])
def test_outside_of_the_circle_is_air(radius, expected):
    hu, _ = make_patient()
    volume = as_volume(hu)
    masked = mask_field_of_view(volume, radius)
    distance = np.hypot(X, Y)
    assert np.array_equal(masked.voxels[:, distance < expected - 1e-6], volume.voxels[:, distance < expected - 1e-6])
    outside = distance > expected + 1e-6
    facts = masked.report["field_of_view"]
    assert facts["radius_mm"] == expected
    assert facts["voxels_removed"] == SHAPE[0] * np.count_nonzero(outside)
    assert facts["removed_share"] == pytest.approx(outside.mean(), abs=1e-4)
    assert (masked.voxels[:, outside] == facts["air_hu"]).all()


def test_types_that_cannot_hold_air_get_their_lowest_value():
    volume = Volume(np.full((2, 9, 9), 200, np.uint8), np.eye(4))
    assert mask_field_of_view(volume, 2.0).voxels[0, 0, 0] == 0
    assert mask_field_of_view(Volume(np.full((2, 9, 9), 200, np.int16), np.eye(4)), 2.0).voxels[0, 0, 0] == AIR_HU


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan, 0.1])
def test_circles_without_a_voxel_are_refused(radius):
    volume = Volume(np.zeros((2, 10, 10), np.int16), np.eye(4))
    with refused(UsageError, "field", "view"):
        mask_field_of_view(volume, radius)


# --- real scans ---
@pytest.mark.parametrize(("folder", "table_voxels"), [("lumbar_4p25mm", 40_000), ("thoracic_0p8mm", 2_000)])
def test_real_tables_go_and_real_bone_stays(real_data, folder, table_voxels):
    """What is as dense as bone may only go below the back, and at the raised rims of the table beside it."""
    volume = clrecon.read_volume(real_data / folder)
    cleaned = clrecon.remove_table(volume)
    gone = (cleaned.voxels != volume.voxels) & (volume.voxels >= 250)
    assert np.count_nonzero(gone) > table_voxels
    _, rows, columns = np.nonzero(gone)
    assert ((rows >= 390) | (abs(columns - 255.5) > 190)).all()
    below = cleaned.voxels[:, 430:]
    assert np.count_nonzero(below >= 250) == 0
