"""Damaged series: each header element that can lie about places, and what becomes of it."""

from __future__ import annotations

import numpy as np
import pytest
from damaged_series import LETTERS, LOCATION, PLACES, STACK, list_damages, make_patient
from dicom_series import Plan, write_series
from house import ROOT

from clrecon import read_volume
from clrecon.errors import RefusedInputError

PAGE = ROOT / "docs" / "certificate.md"
IJK = np.array([(0, 0, 0), (2, 3, 5), (9, 7, 6), (15, 15, 11)])


def damage(folder, values, body=None):
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


@pytest.mark.parametrize("name", PLACES)
def test_damaged_places_are_refused_warned_of_or_harmless_as_listed(tmp_path, name):
    row = PLACES[name]
    hu = make_patient() if row.body else STACK.hu()
    plan = damage(tmp_path, row.values, hu if row.body else None)
    if row.result == "refused":
        with pytest.raises(RefusedInputError) as caught:
            read_volume(tmp_path)
        assert row.words in str(caught.value)
        return
    volume = read_volume(tmp_path)
    assert {gate["name"] for gate in volume.report["gates"] if gate["ok"] is False} == row.gates
    warnings = volume.report["warnings"]
    told = row.words and row.result != "silent"
    assert any(row.words in text for text in warnings) if told else warnings == []
    same = np.array_equal(volume.voxels, hu)
    places = volume.ijk_to_lps(IJK)
    assert (same and bool(np.abs(places - plan.truth(IJK)).max() < 1e-6)) is (row.result == "exact")


def test_sound_series_with_all_elements_has_no_warning(tmp_path):
    body = make_patient()
    plan = damage(tmp_path, {**LOCATION, **LETTERS, "ReconstructionDiameter": 50.4}, body)
    report = read_volume(tmp_path).report
    gates = {gate["name"]: gate["ok"] for gate in report["gates"]}
    assert plan.shape == body.shape and report["warnings"] == []
    assert gates["stated_places"] is True and gates["shown_places"] is True


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
def test_odd_slice_locations_and_diameters_give_no_warning(tmp_path, values):
    """Numbers in place of locations, any order, rounded, missing; pictures cut out, circles about a square."""
    damage(tmp_path, values)
    assert read_volume(tmp_path).report["warnings"] == []


def test_page_lists_the_damaged_places():
    text = PAGE.read_text(encoding="utf-8")
    assert "\n".join(list_damages()) in text
