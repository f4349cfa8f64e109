"""--series, --phase and --allow-gaps, as a user gives them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from dicom_series import Plan, write_series

from clrecon.cli.main import main

SHAPE = (8, 10, 11)


def block(ds, k, hu=1500):
    """A block of bone in the middle of air."""
    pixels = np.full(SHAPE[1:], 24, "i2")
    pixels[3:7, 3:8] = hu if 2 <= k <= 5 else 24
    ds.PixelData = pixels.tobytes()


def test_a_gap_is_refused_and_then_allowed(tmp_path, printed):
    write_series(tmp_path / "ct", Plan(shape=SHAPE, leave_out=(4,)), block)
    out = tmp_path / "bone.stl"
    assert main(["mesh", str(tmp_path / "ct"), "-o", str(out)]) == 4
    said = printed()
    said.assert_error(1, "--allow-gaps")
    assert not out.exists()
    report = tmp_path / "report.json"
    assert main(["mesh", str(tmp_path / "ct"), "-o", str(out), "--allow-gaps", "--report", str(report)]) == 0
    told = json.loads(report.read_text())
    assert any("1 slice missing between" in text for text in told["warnings"])
    assert told["volume"]["slices_missing"] == 1 and told["volume"]["uneven"] is True
    # As tall as it was written, the bridged gap included; beyond its ends the level lies a part of a step out.
    low, high = np.array(told["bounds_mm"])[:, 2]
    part = (476 - told["iso_level_hu"]) / (476 + 1000)
    assert high - low == pytest.approx((3 + 2 * part) * 1.25, abs=1e-3)


def test_a_phase_is_chosen(tmp_path, printed):
    for number, hu in ((1, 1500), (2, 1300)):

        def change(ds, k, number=number, hu=hu):
            block(ds, k, hu)
            ds.AcquisitionNumber = number

        write_series(tmp_path / "ct", Plan(shape=SHAPE, name=f"{number}-{{}}".format), change)
    out = tmp_path / "bone.stl"
    assert main(["mesh", str(tmp_path / "ct"), "-o", str(out)]) == 4
    printed().assert_error("--phase", 2)
    assert main(["mesh", str(tmp_path / "ct"), "-o", str(out), "--phase", "3"]) == 3
    printed().assert_error("phase", 3)
    assert main(["mesh", str(tmp_path / "ct"), "-o", str(out), "--phase", "2", "--json"]) == 0
    told = printed().report()
    assert told["volume"]["hu_range"] == [-1000, 276]
    assert told["volume"]["phase"]["number"] == 2
