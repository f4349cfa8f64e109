"""Damaged series: each header element that can lie about places, and what becomes of it."""

from __future__ import annotations

import numpy as np
import pytest
from damaged_series import PLACES, STACK, list_damages
from dicom_series import write_series
from house import ROOT

from clrecon import read_volume
from clrecon.errors import RefusedInputError

PAGE = ROOT / "docs" / "certificate.md"
IJK = np.array([(0, 0, 0), (2, 3, 5), (9, 7, 6), (15, 15, 11)])


def damage(folder, values):
    def change(ds, k):
        for keyword, value in values.items():
            value = value(k) if callable(value) else value
            if value is not None:
                setattr(ds, keyword, value)
            elif keyword in ds:
                delattr(ds, keyword)

    write_series(folder, STACK, change)
    return folder


@pytest.mark.parametrize("name", PLACES)
def test_what_becomes_of_a_damage(tmp_path, name):
    row = PLACES[name]
    damage(tmp_path, row.values)
    if row.result == "refused":
        with pytest.raises(RefusedInputError) as caught:
            read_volume(tmp_path)
        assert row.words in str(caught.value)
        return
    volume = read_volume(tmp_path)
    assert {gate["name"] for gate in volume.report["gates"] if gate["ok"] is False} == row.gates
    warnings = volume.report["warnings"]
    assert any(row.words in text for text in warnings) if row.words else warnings == []
    same = np.array_equal(volume.voxels, STACK.hu())
    places = volume.ijk_to_lps(IJK)
    assert (same and bool(np.abs(places - STACK.truth(IJK)).max() < 1e-6)) is (row.result == "exact")


def test_the_page_has_the_table():
    text = PAGE.read_text(encoding="utf-8")
    assert "\n".join(list_damages()) in text
