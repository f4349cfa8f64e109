"""Damaged series: each header element that can lie about places, and what becomes of it."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from damaged_series import LETTERS, LOCATION, PLACES, STACK, list_damages, make_patient
from dicom_series import Plan, write_series
from house import ROOT

from clrecon import read_volume
from clrecon.errors import RefusedInputError

PAGE = ROOT / "docs" / "certificate.md"
IJK = np.array([(0, 0, 0), (2, 3, 5), (9, 7, 6), (15, 15, 11)])


def write_damaged(folder, values, body=None):
    """A series whose elements have these values, or a function's of k; None: they are missing."""
    plan = STACK if body is None else Plan(shape=body.shape)

    def change(ds, k):
        if body is not None:
            ds.PixelData = (body[k] + 1024.0).astype("<i2").tobytes()
        for keyword, value in values.items():
            value = value(k) if callable(value) else value
            if value is not None:
                setattr(ds, keyword, value)
            elif keyword in ds:
                delattr(ds, keyword)

    write_series(folder, plan, change)
    return plan


def write_row(folder, name):
    """A damaged series of the list, its row, its plan and the HU that were written."""
    row = PLACES[name]
    hu = make_patient() if row.body else STACK.hu()
    return row, write_damaged(folder, row.values, hu if row.body else None), hu


REFUSED = [name for name, row in PLACES.items() if row.result == "refused"]
READ = [name for name, row in PLACES.items() if row.result != "refused"]


@pytest.mark.parametrize("name", REFUSED)
def test_damaged_places_that_are_listed_as_refused_are_refused_with_their_words(tmp_path, name):
    row, _, _ = write_row(tmp_path, name)
    with pytest.raises(RefusedInputError) as refusal:
        read_volume(tmp_path)
    assert row.words in str(refusal.value)


@pytest.mark.parametrize("name", READ)
def test_damaged_places_that_are_read_fail_the_listed_gates_with_the_listed_words(tmp_path, name):
    row, _, _ = write_row(tmp_path, name)
    report = read_volume(tmp_path).report
    assert {gate["name"] for gate in report["gates"] if gate["ok"] is False} == row.gates
    if row.words and row.result != "silent":
        assert any(row.words in warning for warning in report["warnings"])
    else:
        assert report["warnings"] == []


@pytest.mark.parametrize("name", READ)
def test_damaged_places_that_are_read_give_the_true_volume_only_where_listed_as_exact(tmp_path, name):
    row, plan, hu = write_row(tmp_path, name)
    volume = read_volume(tmp_path)
    is_true = np.array_equal(volume.voxels, hu)
    if is_true:
        is_true = bool(np.abs(volume.ijk_to_lps(IJK) - plan.truth(IJK)).max() < tolerances.AFFINE_MM)
    assert is_true is (row.result == "exact")


def test_sound_series_with_all_elements_of_places_passes_their_gates_without_a_warning(tmp_path):
    write_damaged(tmp_path, {**LOCATION, **LETTERS, "ReconstructionDiameter": 50.4}, make_patient())
    report = read_volume(tmp_path).report
    gates = {gate["name"]: gate["ok"] for gate in report["gates"]}
    assert report["warnings"] == []
    assert (gates["stated_places"], gates["shown_places"]) == (True, True)


@pytest.mark.parametrize(
    "values",
    [
        {"SliceLocation": lambda k: k + 1},
        {"SliceLocation": lambda k: 7 * k % 12},
        {"SliceLocation": 3},
        {"SliceLocation": lambda k: round(STACK.position(k)[2])},
        {"SliceLocation": lambda k: None if k == 5 else 3.0 * k},
        {"ReconstructionDiameter": 0, "PatientOrientation": ["LE", "V"]},
        {"ReconstructionDiameter": 500, "PatientOrientation": ["LA", "PF"]},
        {"ReconstructionDiameter": 8},
    ],
)
def test_odd_slice_locations_and_diameters_are_not_warned_of(tmp_path, values):
    """Numbers in place of locations, any order, rounded, missing; pictures cut out, circles about a square."""
    write_damaged(tmp_path, values)
    assert read_volume(tmp_path).report["warnings"] == []


def test_page_of_the_certificate_lists_the_damaged_places():
    text = PAGE.read_text(encoding="utf-8")
    assert "\n".join(list_damages()) in text
