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


@pytest.mark.parametrize(
    ("change", "shift", "words"),
    [
        (set_values(RescaleIntercept=None), 1024, "no RescaleIntercept: slope 1, intercept 0 taken: maybe not HU"),
        (set_values(RescaleSlope=None), 0, "no RescaleSlope: slope 1, intercept -1024 taken: maybe not HU"),
    ],
    ids=["intercept", "slope"],
)
def test_half_a_rescale_is_doubtful(tmp_path, change, shift, words):
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
def test_coding_of_its_own_makes_a_slice_doubtful(tmp_path, keyword, value, usual):
    write_series(tmp_path, change=set_values(2, **{keyword: value}))
    told = read_volume(tmp_path).report["warnings"]
    words = f"{keyword} is not {usual} as in the other slices: the HU may be wrong (1 of 7 slices, at -397.50 mm)"
    assert told == [words]
    assert words in list_series(tmp_path).series[0].warnings


@pytest.mark.parametrize("usual", [None, -2000])
@pytest.mark.parametrize("value", [None, 24, -2000])
def test_padding_of_its_own_makes_a_slice_doubtful(tmp_path, usual, value):
    def change(ds, k):
        own = value if k == 2 else usual
        if own is not None:
            ds.PixelPaddingValue = own

    write_series(tmp_path, change=change)
    words = (
        "PixelPaddingValue is not as in the other slices: measured voxels may count as padding, or padding as HU"
        " (1 of 7 slices, at -397.50 mm)"
    )
    assert read_volume(tmp_path).report["warnings"] == ([words] if value != usual else [])


def test_slices_that_each_have_their_own_rescale_are_not_doubtful(tmp_path):
    write_series(tmp_path, change=lambda ds, k: set_values(RescaleIntercept=-1024 - k)(ds, k))
    assert read_volume(tmp_path).report["warnings"] == []


@pytest.mark.parametrize("ending", ["", ".1", ".2", ".3", ".4"])
def test_a_secondary_capture_with_a_position_is_refused(tmp_path, ending):
    sop_class = SecondaryCaptureImageStorage + ending
    write_series(tmp_path, change=set_values(SOPClassUID=sop_class))
    with refused(RefusedInputError, "slice000.dcm", sop_class):
        read_volume(tmp_path)
    reason = f"slice000.dcm: secondary capture (SOP class {sop_class}): its pixels are a picture, not measured HU"
    assert list_series(tmp_path).series[0].problems[0] == reason
    plan = write_series(tmp_path, Plan(series=2, shape=(3, 5, 6), name="ct{}".format))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.parametrize(
    ("image_type", "word"),
    [
        ("DERIVED\\SECONDARY\\MPR", "MPR"),
        ("DERIVED\\PRIMARY\\AXIAL\\CT_SOM5 MIP", "MIP"),
        ("derived\\SECONDARY\\PROJECTION IMAGE", "PROJECTION"),
        ("DERIVED\\SECONDARY\\REFORMATTED\\AVERAGE", "REFORMATTED"),
        ("DERIVED\\SECONDARY\\AXIAL", None),
        ("ORIGINAL\\PRIMARY\\AXIAL\\MPR", None),
    ],
)
def test_derived_images_are_told(tmp_path, image_type, word):
    plan = write_series(tmp_path, change=set_raw("ImageType", image_type))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    said = f"derived images (ImageType has DERIVED and {word}): maybe not measured HU (all slices)"
    assert volume.report["warnings"] == ([said] if word else [])


def test_slices_of_two_patients_are_refused_without_their_ids(tmp_path):
    write_series(tmp_path, change=set_values(only=4, PatientID="OTHERSECRET"))
    with refused(RefusedInputError, "PatientID", "slice004.dcm"):
        read_volume(tmp_path)
    listing = list_series(tmp_path)
    assert "PatientID differs within the series" in listing.series[0].problems[0]
    assert "SECRET" not in json.dumps([entry.as_dict() for entry in listing.series])


@pytest.mark.parametrize("patient", ["", " SECRETID "], ids=["missing", "with spaces"])
def test_the_same_patient_written_otherwise_is_one(tmp_path, patient):
    plan = write_series(tmp_path, change=set_raw("PatientID", patient, only=4))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.parametrize(("count", "top", "told"), [(3, 3071, True), (1, 3071, False), (3, 3072, False)])
def test_saturated_metal_is_told(tmp_path, count, top, told):
    def saturate(ds, k):
        stored = np.frombuffer(ds.PixelData, np.int16).copy()
        stored[:count] = top + 1024
        ds.PixelData = stored.tobytes()

    write_series(tmp_path, change=saturate)
    report = read_volume(tmp_path).report
    assert report["hu_range"][1] == top
    said = "21 voxels are at 3071 HU, the ceiling of 12 bits: metal is saturated, its surface displaced"
    assert report["warnings"] == ([said] if told else [])


@pytest.mark.parametrize("modality", ["ct", " Ct "])
def test_modality_in_other_letters_is_ct(tmp_path, modality):
    plan = write_series(tmp_path, change=set_raw("Modality", modality))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["series"]["modality"] == "CT"


def test_free_text_where_terms_belong_is_not_repeated(tmp_path):
    """People's names are found in any field; refusals are for the terminal, warnings go into reports."""
    name = "DOE^JOHN"
    plan = write_series(tmp_path, change=set_raw("SliceThickness", name))
    write_series(tmp_path, Plan(series=2, name="other{}".format), set_raw("Modality", name))
    write_series(tmp_path, Plan(series=3, name="more{}".format, shape=(3, 5, 6)), set_raw("RescaleType", name))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    thickness, *_ = volume.report["warnings"]
    assert thickness == (
        "SliceThickness (0018,0050) is no finite number; ignored, it plays no part in the geometry (all slices)"
    )
    assert "other" in (list_series(tmp_path).series[1].modality or "")
    for number in (1, 3):
        assert "DOE" not in json.dumps(read_volume(tmp_path, series=number).report)
    assert "DOE" not in json.dumps([entry.as_dict() for entry in list_series(tmp_path).series])
