"""Files made to be read wrongly: each is read right, or refused with its reason."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from dicom_series import Plan, make_dataset, save_dataset, write_series
from pydicom.uid import ImplicitVRLittleEndian
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.reading import read_volume

PLAN = {"shape": (3, 3, 4), "name": "{}".format}  # files 0, 1 and 2


@pytest.mark.parametrize("depth", [300, 5000])
def test_deeply_nested_sequences_are_refused(tmp_path, depth):
    write_series(tmp_path, Plan(**PLAN))
    whole = (tmp_path / "1").read_bytes()
    start = whole.index(b"\x08\x00\x60\x00CS")  # before Modality
    opening = struct.pack("<HH2sHL", 0x0008, 0x0051, b"SQ", 0, 0xFFFFFFFF) + struct.pack(
        "<HHL", 0xFFFE, 0xE000, 0xFFFFFFFF
    )
    closing = struct.pack("<HHLHHL", 0xFFFE, 0xE00D, 0, 0xFFFE, 0xE0DD, 0)
    (tmp_path / "1").write_bytes(whole[:start] + opening * depth + closing * depth + whole[start:])
    for name in ("0", "2"):
        (tmp_path / name).unlink()
    file_name = "1"
    with refused(RefusedInputError, file_name, "sequences"):
        read_volume(tmp_path)


def test_implicit_elements_under_an_explicit_syntax_are_read_with_a_warning(tmp_path):
    plan = Plan(**PLAN)
    for k in range(3):
        ds = make_dataset(Plan(syntax=ImplicitVRLittleEndian, **PLAN), k)
        save_dataset(ds, tmp_path / f"{k}")
        data = (tmp_path / f"{k}").read_bytes()
        old = b"1.2.840.10008.1.2\0"
        assert data.count(b"\x12\0" + old) == 1
        changed = data.replace(b"\x12\0" + old, b"\x14\0" + b"1.2.840.10008.1.2.1\0")
        (tmp_path / f"{k}").write_bytes(changed)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert "parsed as found" in volume.report["warnings"][0]


def test_dicom_whose_preamble_starts_a_program_is_read(tmp_path):
    plan = write_series(tmp_path, Plan(**PLAN))
    for file in tmp_path.iterdir():
        data = file.read_bytes()
        file.write_bytes(b"MZ" + b"\x90" * 126 + data[128:])
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


def test_slices_of_an_unknown_transfer_syntax_are_refused_by_its_uid(tmp_path):
    plan = Plan(**PLAN)
    for k in range(3):
        ds = make_dataset(plan, k)
        save_dataset(ds, tmp_path / f"{k}")
        data = (tmp_path / f"{k}").read_bytes()
        (tmp_path / f"{k}").write_bytes(data.replace(b"1.2.840.10008.1.2.1\0", b"1.2.840.113619.5.9\0\0"))
    with refused(RefusedInputError, "1.2.840.113619.5.9"):
        read_volume(tmp_path)
