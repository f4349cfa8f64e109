"""--series, --phase and --allow-gaps, as a user gives them."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan, write_series

from clrecon.cli.main import main

SHAPE = (8, 10, 11)
AIR_HU, BLOCK_HU, SECOND_PHASE_HU = -1000, 476, 276


def set_block(ds, k, hu=BLOCK_HU):
    """A block of bone in the middle of air, from slice 2 to slice 5."""
    air = AIR_HU + 1024  # as stored
    pixels = np.full(SHAPE[1:], air, "i2")
    pixels[3:7, 3:8] = hu + 1024 if 2 <= k <= 5 else air
    ds.PixelData = pixels.tobytes()


@pytest.fixture
def ct_with_a_gap(tmp_path):
    """The CT of the block without its slice 4; slices are 1.25 mm apart."""
    write_series(tmp_path / "ct", Plan(shape=SHAPE, leave_out=(4,)), set_block)
    return str(tmp_path / "ct")


def test_series_with_a_missing_slice_is_refused_with_the_option_that_allows_it(ct_with_a_gap, tmp_path, printed):
    out = tmp_path / "bone.stl"

    assert main(["mesh", ct_with_a_gap, "-o", str(out)]) == 4

    printed().assert_error(1, "--allow-gaps")
    assert not out.exists()


def test_mesh_over_an_allowed_gap_is_as_tall_as_the_bone_with_a_warning(ct_with_a_gap, tmp_path, printed):
    assert main(["mesh", ct_with_a_gap, "-o", str(tmp_path / "bone.stl"), "--allow-gaps", "--json"]) == 0

    report = printed().report()
    assert (report["volume"]["slices_missing"], report["volume"]["uneven"]) == (1, True)
    assert any("1 slice missing between" in text for text in report["warnings"])
    # Three gaps from slice 2 to slice 5; beyond its ends the level lies a part of a gap out, towards air.
    part = (BLOCK_HU - report["iso_level_hu"]) / (BLOCK_HU - AIR_HU)
    low, high = np.array(report["bounds_mm"])[:, 2]
    assert high - low == pytest.approx((3 + 2 * part) * 1.25, abs=1e-3)  # float32 of 400 mm


@pytest.fixture
def ct_of_two_phases(tmp_path):
    """Two phases of the block, of different HU."""
    for number, hu in ((1, BLOCK_HU), (2, SECOND_PHASE_HU)):

        def change(ds, k, number=number, hu=hu):
            set_block(ds, k, hu)
            ds.AcquisitionNumber = number

        write_series(tmp_path / "ct", Plan(shape=SHAPE, name=f"{number}-{{}}".format), change)
    return str(tmp_path / "ct")


@pytest.mark.parametrize(
    ("options", "code", "facts"),
    [([], 4, ("--phase", 2)), (["--phase", "3"], 3, ("phase", 3))],
    ids=["none chosen", "not there"],
)
def test_series_of_two_phases_is_refused_without_one_of_them(options, code, facts, ct_of_two_phases, tmp_path, printed):
    assert main(["mesh", ct_of_two_phases, "-o", str(tmp_path / "bone.stl"), *options]) == code
    printed().assert_error(*facts)


def test_chosen_phase_of_a_series_is_read(ct_of_two_phases, tmp_path, printed):
    assert main(["mesh", ct_of_two_phases, "-o", str(tmp_path / "bone.stl"), "--phase", "2", "--json"]) == 0

    volume = printed().report()["volume"]
    assert volume["phase"]["number"] == 2
    assert volume["hu_range"] == [AIR_HU, SECOND_PHASE_HU]
