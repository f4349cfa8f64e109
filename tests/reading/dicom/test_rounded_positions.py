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


def write_rounded(folder, *, step, digits, stated=None, keyword="SliceThickness", **plan):
    """Even steps along z in mm, written with `digits` decimals; the headers state the distance `stated`, or `step`."""

    def change(ds, k):
        ds.InstanceNumber = k + 1
        ds.SliceThickness = 5
        setattr(ds, keyword, step if stated is None else stated)
        set_raw("ImagePositionPatient", "\\".join(f"{float(v):.{digits}f}" for v in ds.ImagePositionPatient))(ds, k)

    shape = (SLICES, 4, 4)
    return write_series(folder, Plan(shape=shape, gap=step, origin=(-1.0, -1.0, 3.0), **plan), change)


ROUNDED_STEPS = pytest.mark.parametrize(
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


@ROUNDED_STEPS
def test_even_steps_rounded_to_few_digits_are_read_as_one_even_stack(tmp_path, step, digits, keyword):
    write_rounded(tmp_path, step=step, digits=digits, keyword=keyword)
    report = read_volume(tmp_path).report
    last_digit_mm = 10.0**-digits
    assert (report["uneven"], report["slices_missing"]) == (False, 0)
    assert report["spacing_mm"][2] == pytest.approx(step, abs=last_digit_mm / SLICES)
    assert report["gap_mm"]["median"] == pytest.approx(step, abs=last_digit_mm / SLICES)
    assert report["grid_tolerance_mm"] == pytest.approx(last_digit_mm)
    assert [gate["name"] for gate in report["gates"] if gate["ok"] is False] == []


@ROUNDED_STEPS
def test_even_steps_rounded_to_few_digits_are_warned_of_with_the_stated_distance(tmp_path, step, digits, keyword):
    write_rounded(tmp_path, step=step, digits=digits, keyword=keyword)
    (warning,) = read_volume(tmp_path).report["warnings"]
    decimals = f"{digits} decimal{'s' * (digits != 1)}"
    assert warning.startswith(
        f"positions are written with {decimals}, too few for slices that are {step:g} mm apart by {keyword}: "
        "all of them are even steps, rounded; placed by even steps of "
    )


@pytest.mark.parametrize("lost", daily(3, [1, 2, 20, 30, 57, 58]))
def test_missing_slice_among_rounded_positions_is_refused(tmp_path, lost):
    write_rounded(tmp_path, step=0.0105, digits=2, leave_out=(lost,))
    with refused(RefusedInputError, "slice", "missing"):
        read_volume(tmp_path)


@pytest.mark.parametrize("lost", daily(1, [1, 30, 58]))
def test_missing_slice_among_positions_in_whole_millimetres_is_refused(tmp_path, lost):
    """Steps that are a multiple of the unit are not changed by rounding."""
    write_rounded(tmp_path, step=1.0, digits=0, leave_out=(lost,))
    with refused(RefusedInputError, "slice", "missing", 1):  # slice
        read_volume(tmp_path)


@pytest.mark.parametrize("stated", daily(1, [5, 0.02]), ids=str)
def test_rounded_positions_whose_headers_state_another_distance_are_refused(tmp_path, stated):
    write_rounded(tmp_path, step=0.0105, digits=2, stated=stated)
    with refused(RefusedInputError, "slice", "missing"):
        read_volume(tmp_path)


def test_missing_slice_among_positions_with_enough_digits_is_refused(tmp_path):
    write_rounded(tmp_path, step=0.0105, digits=3, leave_out=(30,))
    with refused(RefusedInputError, "slice", "missing"):
        read_volume(tmp_path)


def test_slice_further_off_its_even_place_than_rounding_makes_the_stack_uneven(tmp_path):
    write_rounded(tmp_path, step=1.5, digits=1, offsets={20: 0.3})
    report = list_series(tmp_path).certificate
    assert report["uneven"]
    assert not any("decimal" in warning for warning in report["warnings"])


def test_decimals_of_positions_are_the_most_that_any_of_them_has(tmp_path):
    """Where zeros at the end are left out: 3, 3.01, ... 3.1."""

    def change(ds, k):
        ds.SliceThickness = 0.0105
        ds.ImagePositionPatient = [-1, -1, round(3 + 0.0105 * k, 2)]

    write_series(tmp_path, Plan(shape=(SLICES, 4, 4)), change)
    report = read_volume(tmp_path).report
    assert not report["uneven"]
    last_digit_mm = 0.01
    assert report["spacing_mm"][2] == pytest.approx(0.0105, abs=last_digit_mm / SLICES)
    assert report["warnings"][0].startswith("positions are written with 2 decimals")


def test_slices_that_rounding_puts_at_one_place_are_refused_with_the_digits(tmp_path):
    write_rounded(tmp_path, step=0.6, digits=0)
    with refused(RefusedInputError, "decimals", "digits", 0, 0.6):  # decimals, and mm between slices
        read_volume(tmp_path)


def test_decimals_of_positions_with_an_exponent_are_counted(tmp_path):
    def change(ds, k):
        ds.SliceThickness = 0.0105
        set_raw("ImagePositionPatient", f"-1\\-1\\{3.0 + 0.0105 * k:.2e}")(ds, k)  # as 3.01e+00

    write_series(tmp_path, Plan(shape=(SLICES, 4, 4)), change)
    volume = read_volume(tmp_path)
    assert volume.report["warnings"][0].startswith("positions are written with 2 decimals")
    assert np.isfinite(volume.affine).all()
