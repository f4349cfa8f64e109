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
TISSUE_HU = -300  # foam and blanket have some -900 HU, the table 350
HARD_HU = 250  # bone and tables, not soft tissue


def add_margin(patient):
    """A patient with the two voxels around it, 3 mm, that are never removed."""
    near = patient.copy()
    for _ in range(2):
        near[1:] |= near[:-1].copy()
        near[:-1] |= near[1:].copy()
        near[:, 1:] |= near[:, :-1].copy()
        near[:, :-1] |= near[:, 1:].copy()
    return near


with_and_without_lungs = pytest.mark.parametrize("lungs", [False, True], ids=["no lungs", "lungs"])
gap_below_the_back = pytest.mark.parametrize("gap_mm", [1.0, 6.0, 25.0])


@pytest.fixture
def patient_on_a_table(gap_mm, lungs):
    """The scan, the mask of the patient in its slices, and that of the table."""
    hu, patient = make_patient(lungs=lungs)
    table = add_table(hu, patient, gap=gap_mm)
    return as_volume(hu), patient, table


@with_and_without_lungs
@gap_below_the_back
def test_the_patient_stays_to_the_bit_where_a_table_is_removed(patient_on_a_table):
    volume, patient, _ = patient_on_a_table
    cleaned = remove_table(volume)
    assert np.array_equal(cleaned.voxels[:, patient], volume.voxels[:, patient])


@with_and_without_lungs
@gap_below_the_back
def test_the_table_is_removed_outside_of_the_margin_around_the_patient(patient_on_a_table):
    volume, patient, table = patient_on_a_table
    outside = ~add_margin(patient)
    assert (table & outside).any()
    assert not (remove_table(volume).voxels[:, outside] >= TISSUE_HU).any()


@with_and_without_lungs
@gap_below_the_back
def test_removing_a_table_leaves_the_given_scan_as_it_is(patient_on_a_table):
    volume, _, _ = patient_on_a_table
    before = volume.voxels.copy()
    remove_table(volume)
    assert np.array_equal(volume.voxels, before)


@with_and_without_lungs
@pytest.mark.parametrize("gap_mm", [25.0])
def test_a_table_farther_away_than_the_margin_is_removed_as_a_whole(patient_on_a_table):
    volume, _, table = patient_on_a_table
    assert (volume.voxels[:, table] >= TISSUE_HU).all()
    assert not (remove_table(volume).voxels[:, table] >= TISSUE_HU).any()


@with_and_without_lungs
@gap_below_the_back
def test_all_voxels_outside_of_the_body_become_the_reported_air_and_are_counted(patient_on_a_table):
    volume, _, _ = patient_on_a_table
    cleaned = remove_table(volume)
    facts = cleaned.report["remove_table"]
    body, step = find_body(volume)
    assert step == (1, 1, 1)
    assert (cleaned.voxels[~body] == facts["air_hu"]).all()
    assert facts["voxels_removed"] == np.count_nonzero(~body)
    assert facts["dense_voxels_removed"] == np.count_nonzero(volume.voxels[~body] >= TISSUE_HU)


def test_the_surface_of_bone_is_that_of_the_same_patient_without_a_table():
    from clrecon.proof.surface.extract import extract_isosurface

    hu, patient = make_patient(arms=False)
    without_table = as_volume(hu)
    add_table(hu, patient, gap=12.0)
    vertices, normals, triangles = extract_isosurface(remove_table(as_volume(hu)), HARD_HU)
    expected = extract_isosurface(without_table, HARD_HU)
    assert len(vertices) > 1000  # not two empty surfaces: 1,032 were measured
    np.testing.assert_array_equal(vertices, expected[0])
    np.testing.assert_array_equal(normals, expected[1])
    np.testing.assert_array_equal(triangles, expected[2])


def test_a_chest_that_the_circle_of_reconstruction_cuts_keeps_its_wall():
    """The lungs lie open at the border of the circle, ribs hang on walls of 14 mm, and padding lies outside."""
    hu, patient = make_patient(lungs=True, arms=False)
    add_table(hu, patient)
    outside = np.hypot(X, Y) > 98.0  # mm: the body is 240 mm wide
    hu[:, outside] = -1000.0
    volume = as_volume(hu)
    inside = patient & ~outside
    assert np.array_equal(remove_table(volume).voxels[:, inside], volume.voxels[:, inside])


def test_nothing_is_removed_from_a_scan_that_shows_nothing_outside_of_the_body():
    hu, _ = make_patient(lungs=True, arms=False)
    within_the_trunk = as_volume(hu[:, 57:105, 60:140])  # below the bubble of gas
    cleaned = remove_table(within_the_trunk)
    assert np.array_equal(cleaned.voxels, within_the_trunk.voxels)
    assert cleaned.report["remove_table"]["removed_share"] == 0.0


@pytest.fixture
def uneven_scan():
    """A patient on a table in float32 and slices 1 to 4 mm apart, with entries in its report."""
    hu, patient = make_patient()
    add_table(hu, patient)
    heights = np.cumsum(np.linspace(1.0, 4.0, SHAPE[0]))
    positions = AFFINE[:3, 3] + heights[:, None] * np.array([0.0, 0.0, 1.0])
    return Volume(hu.astype(np.float32), AFFINE, {"warnings": ["one"], "tilt_deg": 3.0}, positions)


def test_type_and_positions_of_uneven_slices_stay_where_a_table_is_removed(uneven_scan):
    cleaned = remove_table(uneven_scan)
    assert cleaned.voxels.dtype == np.float32
    assert cleaned.uneven
    assert np.array_equal(cleaned.slice_origins(), uneven_scan.slice_origins())


def test_report_of_a_removed_table_keeps_other_entries_and_the_given_report_stays(uneven_scan):
    cleaned = remove_table(uneven_scan)
    assert (cleaned.report["warnings"], cleaned.report["tilt_deg"]) == (["one"], 3.0)
    assert "remove_table" in cleaned.report
    assert "remove_table" not in uneven_scan.report


def test_removed_voxels_become_the_level_of_the_air_of_the_scan():
    """With the -1000 HU of other scans, the end of the mask would be a step of 12 HU."""
    hu, _ = make_patient()
    hu[hu < -900] += 12.0  # the air of this scan: -988 HU
    assert remove_table(as_volume(hu)).report["remove_table"]["air_hu"] == pytest.approx(-988, abs=1)


def test_a_scan_without_anything_14_mm_thick_is_refused():
    hu = np.full(SHAPE, -1000.0)
    two_rows = np.s_[:, 100:102]
    hu[two_rows] = 300.0
    with refused(RefusedInputError, TISSUE_HU, 14):
        remove_table(as_volume(hu))


# --- field of view ---
HALF_OF_THE_HEIGHT_MM = SHAPE[1] * SPACING[1] / 2  # of a slice that is wider than high

circles = pytest.mark.parametrize(
    ("radius_mm", "expected_mm"),
    [(None, HALF_OF_THE_HEIGHT_MM), (80.0, 80.0), (400.0, 400.0)],
    ids=["circle of the scan", "80 mm", "beyond the slice"],
)


@circles
def test_voxels_outside_of_the_circle_become_air_and_those_inside_stay(radius_mm, expected_mm):
    hu, _ = make_patient()
    volume = as_volume(hu)
    masked = mask_field_of_view(volume, radius_mm=radius_mm)
    distance = np.hypot(X, Y)
    inside, outside = distance < expected_mm - 1e-6, distance > expected_mm + 1e-6
    assert np.array_equal(masked.voxels[:, inside], volume.voxels[:, inside])
    assert (masked.voxels[:, outside] == masked.report["field_of_view"]["air_hu"]).all()


@circles
def test_report_of_a_circle_has_its_radius_and_counts_the_voxels_outside(radius_mm, expected_mm):
    hu, _ = make_patient()
    facts = mask_field_of_view(as_volume(hu), radius_mm=radius_mm).report["field_of_view"]
    outside = np.hypot(X, Y) > expected_mm + 1e-6
    slices = SHAPE[0]
    assert facts["radius_mm"] == pytest.approx(expected_mm)
    assert facts["voxels_removed"] == slices * np.count_nonzero(outside)
    assert facts["removed_share"] == pytest.approx(outside.mean(), abs=1e-4)  # four digits are kept


@pytest.mark.parametrize(("dtype", "value"), [(np.uint8, 0), (np.int16, AIR_HU)])
def test_outside_of_the_circle_is_air_or_the_lowest_value_that_the_type_holds(dtype, value):
    volume = Volume(np.full((2, 9, 9), 200, dtype), np.eye(4))
    corner = mask_field_of_view(volume, radius_mm=2.0).voxels[0, 0, 0]
    assert corner == value


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan, 0.1])
def test_circles_without_a_voxel_are_refused(radius):
    volume = Volume(np.zeros((2, 10, 10), np.int16), np.eye(4))
    with refused(UsageError, "field", "view"):
        mask_field_of_view(volume, radius_mm=radius)


# --- real scans ---
@pytest.mark.parametrize("folder", ["lumbar_4p25mm", "thoracic_0p8mm"])
def test_of_real_scans_only_dense_voxels_below_the_back_and_at_the_rims_of_the_table_are_removed(real_data, folder):
    """The back lies above row 390, and the raised rims of the table 190 columns from the middle."""
    volume = clrecon.read_volume(real_data / folder)
    cleaned = clrecon.remove_table(volume)
    removed = (cleaned.voxels != volume.voxels) & (volume.voxels >= HARD_HU)
    _, rows, columns = np.nonzero(removed)
    assert len(rows) > 2_000  # measured 47,383 and 3,082: the table
    assert ((rows >= 390) | (abs(columns - 255.5) > 190)).all()


@pytest.mark.parametrize("folder", ["lumbar_4p25mm", "thoracic_0p8mm"])
def test_no_dense_voxel_is_left_in_the_lowest_rows_of_real_scans(real_data, folder):
    lowest_rows = np.s_[:, 430:]  # of 512, behind the back
    volume = clrecon.read_volume(real_data / folder)
    assert (volume.voxels[lowest_rows] >= HARD_HU).any()
    assert not (clrecon.remove_table(volume).voxels[lowest_rows] >= HARD_HU).any()
