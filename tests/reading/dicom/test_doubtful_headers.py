"""Headers that make a series doubtful: a warning where it can be read, a refusal where it cannot."""

from __future__ import annotations

import json

import numpy as np
import pytest
from dicom_series import Plan, set_raw, set_values, write_series
from pydicom.uid import SecondaryCaptureImageStorage
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume

SEVEN_SLICES = Plan(shape=(7, 5, 6), gap=1.25)
AT_SLICE_2 = f"(1 of 7 slices, at {SEVEN_SLICES.position(2)[2]:.2f} mm)"


@pytest.mark.parametrize(
    ("change", "shift", "words"),
    [
        (set_values(RescaleIntercept=None), 1024, "no RescaleIntercept: slope 1, intercept 0 taken: maybe not HU"),
        (set_values(RescaleSlope=None), 0, "no RescaleSlope: slope 1, intercept -1024 taken: maybe not HU"),
    ],
    ids=["intercept", "slope"],
)
def test_series_without_slope_or_intercept_is_read_with_a_warning(tmp_path, change, shift, words):
    plan = write_series(tmp_path, change=change)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu() + shift)
    assert volume.report["warnings"] == [f"{words} (all slices)"]


@pytest.mark.parametrize(
    ("keyword", "value", "usual"),
    [
        ("RescaleIntercept", -24, "-1024"),
        ("RescaleSlope", 2, "1"),
        ("BitsStored", 12, "16"),
        ("PixelRepresentation", 0, "1"),
    ],
)
def test_slice_whose_pixels_are_coded_unlike_those_of_the_others_is_warned_of(tmp_path, keyword, value, usual):
    write_series(tmp_path, SEVEN_SLICES, set_values(only=2, **{keyword: value}))
    words = f"{keyword} is not {usual} as in the other slices: the HU may be wrong {AT_SLICE_2}"
    assert read_volume(tmp_path).report["warnings"] == [words]
    assert words in list_series(tmp_path).series[0].warnings


@pytest.mark.parametrize("usual", [None, -2000])
@pytest.mark.parametrize("value", [None, 24, -2000])
def test_slice_whose_declared_padding_is_not_that_of_the_others_is_warned_of(tmp_path, usual, value):
    def change(ds, k):
        padding = value if k == 2 else usual
        if padding is not None:
            ds.PixelPaddingValue = padding

    write_series(tmp_path, SEVEN_SLICES, change)
    words = (
        "PixelPaddingValue is not as in the other slices: measured voxels may count as padding, or padding as HU"
        f" {AT_SLICE_2}"
    )
    assert read_volume(tmp_path).report["warnings"] == ([words] if value != usual else [])


def test_slices_that_each_have_another_intercept_are_not_warned_of(tmp_path):
    write_series(tmp_path, change=lambda ds, k: set_values(RescaleIntercept=-1024 - k)(ds, k))
    assert read_volume(tmp_path).report["warnings"] == []


SECONDARY_CAPTURES = pytest.mark.parametrize("ending", ["", ".1", ".2", ".3", ".4"])


@SECONDARY_CAPTURES
def test_secondary_capture_with_a_position_is_refused(tmp_path, ending):
    sop_class = SecondaryCaptureImageStorage + ending
    write_series(tmp_path, change=set_values(SOPClassUID=sop_class))
    with refused(RefusedInputError, "slice000.dcm", sop_class):
        read_volume(tmp_path)
    reason = f"slice000.dcm: secondary capture (SOP class {sop_class}): its pixels are a picture, not measured HU"
    assert list_series(tmp_path).series[0].problems[0] == reason


@SECONDARY_CAPTURES
def test_series_of_ct_beside_secondary_captures_is_read(tmp_path, ending):
    write_series(tmp_path, change=set_values(SOPClassUID=SecondaryCaptureImageStorage + ending))
    plan = write_series(tmp_path, Plan(series=2, shape=(3, 5, 6), name="ct{}".format))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.parametrize(
    ("image_type", "word"),
    [
        ("DERIVED\\SECONDARY\\MPR", "MPR"),
        ("DERIVED\\PRIMARY\\AXIAL\\CT_SOM5 MIP", "MIP"),
        ("derived\\SECONDARY\\PROJECTION IMAGE", "PROJECTION"),
        ("DERIVED\\SECONDARY\\REFORMATTED\\AVERAGE", "REFORMATTED"),
    ],
)
def test_derived_images_are_kept_with_a_warning(tmp_path, image_type, word):
    plan = write_series(tmp_path, change=set_raw("ImageType", image_type))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == [
        f"derived images (ImageType has DERIVED and {word}): maybe not measured HU (all slices)"
    ]


@pytest.mark.parametrize("image_type", ["DERIVED\\SECONDARY\\AXIAL", "ORIGINAL\\PRIMARY\\AXIAL\\MPR"])
def test_images_that_are_derived_or_reformatted_but_not_both_are_not_warned_of(tmp_path, image_type):
    write_series(tmp_path, change=set_raw("ImageType", image_type))
    assert read_volume(tmp_path).report["warnings"] == []


def test_series_with_a_slice_of_another_patient_is_refused_by_its_name(tmp_path):
    write_series(tmp_path, change=set_values(only=4, PatientID="OTHERSECRET"))
    with refused(RefusedInputError, "PatientID", "slice004.dcm"):
        read_volume(tmp_path)


def test_listing_of_a_series_of_two_patients_says_so_without_their_ids(tmp_path):
    write_series(tmp_path, change=set_values(only=4, PatientID="OTHERSECRET"))
    listing = list_series(tmp_path)
    assert "PatientID differs within the series" in listing.series[0].problems[0]
    assert "SECRET" not in json.dumps([series.as_dict() for series in listing.series])


@pytest.mark.parametrize("patient", ["", " SECRETID "], ids=["missing", "with spaces"])
def test_slice_whose_patient_id_is_missing_or_has_spaces_is_of_the_same_patient(tmp_path, patient):
    plan = write_series(tmp_path, change=set_raw("PatientID", patient, only=4))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.parametrize(
    ("count", "top", "is_warned_of"),
    [(3, 3071, True), (1, 3071, False), (3, 3072, False)],
    ids=["three voxels a slice", "one voxel a slice", "another value"],
)
def test_metal_at_3071_hu_is_warned_of_from_a_few_voxels_on(tmp_path, count, top, is_warned_of):
    """From 10 voxels on: seven slices have 7 of them by one a slice, and 21 by three."""

    def saturate(ds, k):
        stored = np.frombuffer(ds.PixelData, np.int16).copy()
        stored[:count] = top + 1024
        ds.PixelData = stored.tobytes()

    write_series(tmp_path, SEVEN_SLICES, saturate)
    report = read_volume(tmp_path).report
    _, highest = report["hu_range"]
    assert highest == top
    warning = f"{7 * 3} voxels are at 3071 HU, the ceiling of 12 bits: metal is saturated, its surface displaced"
    assert report["warnings"] == ([warning] if is_warned_of else [])


@pytest.mark.parametrize("modality", ["ct", " Ct "])
def test_modality_in_other_letters_is_ct(tmp_path, modality):
    plan = write_series(tmp_path, change=set_raw("Modality", modality))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["series"]["modality"] == "CT"


NAME = "DOE^JOHN"
"""People's names are found in any field; refusals are for the terminal, warnings go into reports."""


def test_text_in_place_of_a_thickness_is_warned_of_and_not_repeated(tmp_path):
    plan = write_series(tmp_path, change=set_raw("SliceThickness", NAME))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"][0] == (
        "SliceThickness (0018,0050) is no finite number; ignored, it plays no part in the geometry (all slices)"
    )
    assert "DOE" not in json.dumps(volume.report)


@pytest.mark.parametrize(("keyword", "modality"), [("Modality", "other"), ("RescaleType", "CT")])
def test_text_in_place_of_a_term_is_not_repeated_in_the_listing(tmp_path, keyword, modality):
    write_series(tmp_path, change=set_raw(keyword, NAME))
    series = list_series(tmp_path).series[0]
    assert "DOE" not in json.dumps(series.as_dict())
    assert series.modality == modality


def test_text_in_place_of_a_rescale_type_is_not_repeated_in_the_report(tmp_path):
    write_series(tmp_path, change=set_raw("RescaleType", NAME))
    assert "DOE" not in json.dumps(read_volume(tmp_path).report)
