"""The series that tests read are files as pydicom writes them, though most of their bytes are remembered."""

from __future__ import annotations

from pathlib import Path

import pytest
from dicom_series import REMEMBERED, Plan, make_dataset, save_dataset
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian])
@pytest.mark.parametrize(
    "plan", [{}, {"signed": True, "pixel_spacing": (1.25, 0.3), "tilt_deg": 12.0, "series": 1234567}], ids=str
)
def test_files_of_remembered_bytes_are_those_that_pydicom_writes(syntax: str, plan: dict, tmp_path: Path) -> None:
    plan = Plan(syntax=syntax, **plan)
    for k in range(3):
        save_dataset(make_dataset(plan, k), tmp_path / "remembered.dcm")
        make_dataset(plan, k).save_as(tmp_path / "written.dcm", enforce_file_format=True)
        assert (tmp_path / "remembered.dcm").read_bytes() == (tmp_path / "written.dcm").read_bytes()
    assert len(REMEMBERED) > 20  # heads and elements; measured 51 after the first plan
