"""Numbers of series, and the choice among those of similar size: by kind, direction and thickness."""

from __future__ import annotations

import pytest
from dicom_series import ROOT, Plan, hash_of, set_values, write_series, write_two_series
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume


@pytest.fixture
def two_series(tmp_path):
    return write_two_series(tmp_path)


def test_series_are_numbered_by_patient_and_study_with_unknown_patients_last(tmp_path):
    for number, patient, study in ((1, "P2", "9"), (2, "P1", "8"), (3, "P2", "9"), (4, None, None), (5, "P1", "7")):
        change = set_values(PatientID=patient or "", StudyInstanceUID=f"{ROOT}.{study}" if study else "")
        write_series(tmp_path, Plan(series=number, shape=(3, 5, 6), name=f"{number}-{{}}".format), change)
    series = list_series(tmp_path).series
    assert [one.number for one in series] == [1, 2, 3, 4, 5]
    assert [one.description for one in series] == [f"series {number}" for number in (1, 3, 2, 5, 4)]
    assert [one.patient for one in series] == [1, 1, 2, 2, None]
    assert read_volume(tmp_path, 2).report["series"]["uid_hash"] == hash_of(3)


AXIAL, CORONAL = (0, 0, 0), (-90, 0, 0)
DERIVED = ["DERIVED", "SECONDARY", "REFORMATTED"]


def write_candidates(folder, *candidates):
    """Write series 1, 2, ... of slices, angles, thickness and ImageType."""
    for number, (slices, angles, thickness, image_type) in enumerate(candidates, start=1):
        plan = Plan(series=number, shape=(slices, 5, 6), angles=angles, name=f"{number}-{{}}".format)
        write_series(folder, plan, set_values(SliceThickness=thickness, ImageType=image_type))


def test_original_axial_series_is_read_before_a_derived_one_of_similar_size(tmp_path):
    write_candidates(tmp_path, (8, CORONAL, 2, DERIVED), (6, AXIAL, 2, ["ORIGINAL", "PRIMARY", "AXIAL"]))
    volume = read_volume(tmp_path)
    assert volume.report["series"]["number"] == 2
    assert volume.report["warnings"][-1] == (
        "1 other CT series not used: [1: CT, 8 slices];"
        " series 2 is read, original axial images before derived ones in other directions"
    )


def test_series_with_the_thinnest_slices_is_read_of_those_of_similar_size(tmp_path):
    write_candidates(tmp_path, (8, AXIAL, 5, None), (7, AXIAL, 1.25, None), (3, AXIAL, 0.6, None))
    volume = read_volume(tmp_path)
    assert volume.report["series"]["number"] == 2  # and not the third, with less than half of the slices
    assert volume.report["warnings"][-1].endswith("series 2 is read, with the thinnest slices, 1.25 mm")


def test_far_larger_series_is_read_though_it_is_derived(tmp_path):
    write_candidates(tmp_path, (9, CORONAL, 2, DERIVED), (4, AXIAL, 1, ["ORIGINAL", "PRIMARY"]))
    assert read_volume(tmp_path).report["series"]["number"] == 1


def test_series_of_similar_size_in_different_directions_are_refused_with_their_list(tmp_path):
    write_candidates(tmp_path, (8, CORONAL, 2, None), (6, AXIAL, 2, None), (7, AXIAL, 2, DERIVED))
    with refused(RefusedInputError, "CT", 1, 8, "coronal", 2, 6, "axial") as refusal:
        read_volume(tmp_path)
    listing = list_series(tmp_path)
    assert listing.chosen is None
    assert listing.warnings == list(refusal.value.args)


def test_series_of_similar_size_in_different_directions_is_read_by_its_number(tmp_path):
    write_candidates(tmp_path, (8, CORONAL, 2, None), (6, AXIAL, 2, None), (7, AXIAL, 2, DERIVED))
    assert read_volume(tmp_path, 1).report["warnings"] == []


def test_one_file_of_a_series_is_refused_with_the_advice_to_name_the_folder(two_series):
    with refused(RefusedInputError, "slice", "names"):
        read_volume(two_series / "a0")


def test_folder_of_one_slice_is_refused_without_the_advice_to_name_a_folder(two_series):
    write_series(two_series / "lone", Plan(series=9, shape=(1, 5, 6)))
    with refused(RefusedInputError, "slice") as refusal:
        read_volume(two_series / "lone")
    assert "folder" not in repr(refusal.value)
