"""Modality LUTs: slope and intercept are not all that a file can say of its values."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan, set_values, write_series
from pydicom.sequence import Sequence
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
)
from value_series import make_table

from clrecon import read_volume

SAID = "Modality LUT Sequence (0028,3000), which is not applied: slope 1, intercept -1024 taken"


def measure_hu_known(path, **options):
    """How many slices fail the gate hu_known, and the warnings of Modality LUTs."""
    report = read_volume(path, **options).report
    (known,) = (gate for gate in report["gates"] if gate["name"] == "hu_known")
    return known["measured"], [text for text in report["warnings"] if SAID in text]


@pytest.mark.parametrize("undefined", [True, False])
@pytest.mark.parametrize(
    "syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian, DeflatedExplicitVRLittleEndian, ExplicitVRBigEndian]
)
def test_modality_lut_of_one_slice_fails_the_gate_of_hu_with_a_warning_in_any_encoding(tmp_path, syntax, undefined):
    def change(ds, k):
        if k != 3:
            return
        set_values(ModalityLUTSequence=make_table(undefined=undefined))(ds, k)
        if syntax == ExplicitVRBigEndian:
            table = ds.ModalityLUTSequence[0]
            table.LUTData = np.frombuffer(table.LUTData, "<u2").astype(">u2").tobytes()

    plan = Plan(syntax=syntax)
    write_series(tmp_path, plan, change)
    measured, said = measure_hu_known(tmp_path)
    assert measured == 1
    _, _, z_mm = plan.position(3)
    assert len(said) == 1 and said[0].endswith(f"(1 of {plan.shape[0]} slices, at {z_mm:.2f} mm)")


def test_modality_lut_without_items_is_not_warned_of(tmp_path):
    empty = Sequence()
    empty.is_undefined_length = True
    write_series(tmp_path, change=set_values(ModalityLUTSequence=empty))
    assert measure_hu_known(tmp_path) == (0, [])


def test_modality_lut_is_not_warned_of_where_a_rescale_is_given(tmp_path):
    write_series(tmp_path, change=set_values(ModalityLUTSequence=make_table()))
    assert measure_hu_known(tmp_path, rescale=(1, -1024)) == (0, [])
