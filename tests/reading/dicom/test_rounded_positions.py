"""Positions written with few digits: rounding is told from a missing slice by the digits and by a stated distance."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan, set_raw, write_series
from refusals import refused
from variants import daily, daily_rows

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume

SLICES = 60


def write_rounded(folder, step, digits, stated=None, keyword="SliceThickness", **plan):
    """Even steps along z, written with `digits` decimals; `stated` is the distance that the headers state."""

    def change(ds, k):
        ds.InstanceNumber = k + 1
        ds.SliceThickness = 5
        setattr(ds, keyword, step if stated is None else stated)
        set_raw("ImagePositionPatient", "\\".join(f"{float(v):.{digits}f}" for v in ds.ImagePositionPatient))(ds, k)

    shape = (SLICES, 4, 4)
    return write_series(folder, Plan(shape=shape, gap=step, origin=(-1.0, -1.0, 3.0), **plan), change)


@pytest.mark.parametrize(
    ("step", "digits", "keyword"),
    daily_rows(
        2,
        [
            (0.0105, 2, "SliceThickness"),
            (0.0105, 2, "SpacingBetweenSlices"),
            (0.333, 1, "SliceThickness"),
            (1.5, 0, "SliceThickness"),
        ],
    ),
)
def test_rounded_even_steps_are_one_even_stack(tmp_path, step, digits, keyword):
    write_rounded(tmp_path, step, digits, keyword=keyword)
    report = read_volume(tmp_path).report
    unit = 10.0**-digits
    assert not report["uneven"] and report["slices_missing"] == 0
    assert report["spacing_mm"][2] == pytest.approx(step, abs=unit / SLICES)
    assert report["gap_mm"]["median"] == pytest.approx(step, abs=unit / SLICES)
    assert report["grid_tolerance_mm"] == pytest.approx(unit)
    (said,) = report["warnings"]
    decimals = f"{digits} decimal{'s' * (digits != 1)}"
    assert said.startswith(
        f"positions are written with {decimals}, too few for slices that are {step:g} mm apart by {keyword}: "
        "all of them are even steps, rounded; placed by even steps of "
    )
    failed = [gate["name"] for gate in report["gates"] if gate["ok"] is False]
    assert failed == []


@pytest.mark.parametrize("lost", daily(3, [1, 2, 20, 30, 57, 58]))
def test_a_missing_slice_is_no_rounding(tmp_path, lost):
    write_rounded(tmp_path, 0.0105, 2, leave_out=(lost,))
    with refused(RefusedInputError, "slice", "missing"):
        read_volume(tmp_path)


@pytest.mark.parametrize("lost", daily(1, [1, 30, 58]))
def test_whole_millimetres_hide_no_missing_slice(tmp_path, lost):
    """Steps that are a multiple of the unit are not changed by rounding."""
    write_rounded(tmp_path, 1.0, 0, leave_out=(lost,))
    with refused(RefusedInputError, "slice", "missing", 1):
        read_volume(tmp_path)


@pytest.mark.parametrize(("stated", "digits"), daily_rows(1, [(5, 2), (0.02, 2), (0.0105, 3)]))
def test_another_thickness_or_more_digits_explain_nothing(tmp_path, stated, digits):
    write_rounded(tmp_path, 0.0105, digits, stated=stated, leave_out=() if digits == 2 else (30,))
    with refused(RefusedInputError, "slice", "missing"):
        read_volume(tmp_path)


def test_a_slice_off_its_even_place_is_no_rounding(tmp_path):
    write_rounded(tmp_path, 1.5, 1, offsets={20: 0.3})
    report = list_series(tmp_path).certificate
    assert report["uneven"] and not any("decimal" in text for text in report["warnings"])


def test_zeros_that_were_left_out_count_as_digits(tmp_path):
    def change(ds, k):
        ds.SliceThickness = 0.0105
        ds.ImagePositionPatient = [-1, -1, round(3 + 0.0105 * k, 2)]  # 3, 3.01, ... 3.1

    write_series(tmp_path, Plan(shape=(SLICES, 4, 4)), change)
    report = read_volume(tmp_path).report
    assert not report["uneven"] and report["spacing_mm"][2] == pytest.approx(0.0105, abs=1e-4)
    assert report["warnings"][0].startswith("positions are written with 2 decimals")


def test_places_that_fall_together_name_the_digits(tmp_path):
    write_rounded(tmp_path, 0.6, 0)
    with refused(RefusedInputError, "decimals", "digits", 0, 0.6):
        read_volume(tmp_path)


def test_exponents_of_positions_count_as_decimals(tmp_path):
    def change(ds, k):
        ds.SliceThickness = 0.0105
        set_raw("ImagePositionPatient", f"-1\\-1\\{3.0 + 0.0105 * k:.2e}")(ds, k)

    write_series(tmp_path, Plan(shape=(SLICES, 4, 4)), change)
    assert read_volume(tmp_path).report["warnings"][0].startswith("positions are written with 2 decimals")
    assert np.isfinite(read_volume(tmp_path).affine).all()
