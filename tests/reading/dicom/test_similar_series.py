"""Numbers of series, and the choice among those of similar size: by kind, direction and thickness."""

from __future__ import annotations

import pytest
from dicom_series import ROOT, Plan, hash_of, set_values, write_series, write_two_series
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume


@pytest.fixture
def series_of_7_and_4(tmp_path):
    """The 4 slices are the files a0 to a3."""
    return write_two_series(tmp_path)


def test_series_are_numbered_by_patient_and_study_with_unknown_patients_last(tmp_path):
    for number, patient, study in ((1, "P2", "9"), (2, "P1", "8"), (3, "P2", "9"), (4, None, None), (5, "P1", "7")):
        change = set_values(PatientID=patient or "", StudyInstanceUID=f"{ROOT}.{study}" if study else "")
        write_series(tmp_path, Plan(series=number, shape=(3, 5, 6), name=f"{number}-{{}}".format), change)
    series = list_series(tmp_path).series
    assert [one.number for one in series] == [1, 2, 3, 4, 5]
    assert [one.description for one in series] == [f"series {number}" for number in (1, 3, 2, 5, 4)]
    assert [one.patient for one in series] == [1, 1, 2, 2, None]
    assert read_volume(tmp_path, series=2).report["series"]["uid_hash"] == hash_of(3)


AXIAL, CORONAL = (0, 0, 0), (-90, 0, 0)
DERIVED = ["DERIVED", "SECONDARY", "REFORMATTED"]


def write_candidate(folder, number, *, slices, angles, thickness, image_type=None):
    """Write one of the series 1, 2, ... with these slices, their thickness in mm; ImageType may be left out."""
    plan = Plan(series=number, shape=(slices, 5, 6), angles=angles, name=f"{number}-{{}}".format)
    write_series(folder, plan, set_values(SliceThickness=thickness, ImageType=image_type))


def test_original_axial_series_is_read_before_a_derived_one_of_similar_size(tmp_path):
    write_candidate(tmp_path, 1, slices=8, angles=CORONAL, thickness=2, image_type=DERIVED)
    write_candidate(tmp_path, 2, slices=6, angles=AXIAL, thickness=2, image_type=["ORIGINAL", "PRIMARY", "AXIAL"])
    volume = read_volume(tmp_path)
    assert volume.report["series"]["number"] == 2
    assert volume.report["warnings"][-1] == (
        "1 other CT series not used: [1: CT, 8 slices];"
        " series 2 is read, original axial images before derived ones in other directions"
    )


def test_series_with_the_thinnest_slices_is_read_of_those_of_similar_size(tmp_path):
    write_candidate(tmp_path, 1, slices=8, angles=AXIAL, thickness=5)
    write_candidate(tmp_path, 2, slices=7, angles=AXIAL, thickness=1.25)
    write_candidate(tmp_path, 3, slices=3, angles=AXIAL, thickness=0.6)
    volume = read_volume(tmp_path)
    assert volume.report["series"]["number"] == 2  # and not the third, with less than half of the slices
    assert volume.report["warnings"][-1].endswith("series 2 is read, with the thinnest slices, 1.25 mm")


def test_far_larger_series_is_read_though_it_is_derived(tmp_path):
    write_candidate(tmp_path, 1, slices=9, angles=CORONAL, thickness=2, image_type=DERIVED)
    write_candidate(tmp_path, 2, slices=4, angles=AXIAL, thickness=1, image_type=["ORIGINAL", "PRIMARY"])
    # Less than half as many slices are not of similar size.
    assert read_volume(tmp_path).report["series"]["number"] == 1


def write_coronal_and_axial(folder):
    """A coronal series of 8 slices, an axial one of 6, and a derived axial one of 7."""
    write_candidate(folder, 1, slices=8, angles=CORONAL, thickness=2)
    write_candidate(folder, 2, slices=6, angles=AXIAL, thickness=2)
    write_candidate(folder, 3, slices=7, angles=AXIAL, thickness=2, image_type=DERIVED)


def test_series_of_similar_size_in_different_directions_are_refused_with_their_list(tmp_path):
    write_coronal_and_axial(tmp_path)
    numbers_and_slices = (1, 8, 2, 6)
    with refused(RefusedInputError, "CT", "coronal", "axial", *numbers_and_slices) as refusal:
        read_volume(tmp_path)
    listing = list_series(tmp_path)
    assert listing.chosen is None
    assert listing.warnings == list(refusal.value.args)


def test_series_of_similar_size_in_different_directions_is_read_by_its_number(tmp_path):
    write_coronal_and_axial(tmp_path)
    assert read_volume(tmp_path, series=1).report["warnings"] == []


def test_one_file_of_a_series_is_refused_with_the_advice_to_name_the_folder(series_of_7_and_4):
    with refused(RefusedInputError, "single", "folder"):
        read_volume(series_of_7_and_4 / "a0")


def test_folder_of_one_slice_is_refused_without_the_advice_to_name_a_folder(series_of_7_and_4):
    write_series(series_of_7_and_4 / "lone", Plan(series=9, shape=(1, 5, 6)))
    with refused(RefusedInputError, "single") as refusal:
        read_volume(series_of_7_and_4 / "lone")
    assert "folder" not in repr(refusal.value)
