"""Figures that no scanner writes: told with the figure, and a gate fails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from dicom_series import Plan, set_values, write_series
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume

PLAN = Plan(shape=(7, 5, 6), pixel_spacing=(0.7, 0.5), gap=1.25, intercept=-1024)
"""Its stored values run from 900 to 900 + 40 * 6 + 29 = 1169, those of slice 0 to those of slice 6."""


def warnings_and_failed_gates(folder):
    """Warnings, and names of the gates that fail."""
    report = read_volume(folder).report
    return report["warnings"], [gate["name"] for gate in report["gates"] if gate["ok"] is False]


# --- spacing and thickness ---
@pytest.mark.parametrize(
    ("plan", "gate", "words"),
    [
        (Plan(pixel_spacing=(0.003, 0.003)), "plausible_spacing", "(pixels of 0.003 mm): 1, none allowed"),
        (Plan(pixel_spacing=(12.0, 11.0)), "plausible_spacing", "(pixels of 11 mm, pixels of 12 mm): 2"),
        (Plan(gap=1000.0), "gap_thickness", "(1000 mm at a thickness of 5 mm): 200, at most 1.95"),
        (Plan(gap=10.0), "gap_thickness", "(10 mm at a thickness of 5 mm): 2, at most 1.95"),
    ],
    ids=["too small", "too large", "a metre", "every second one lost"],
)
def test_implausible_spacing_fails_its_gate_with_a_warning(tmp_path, plan, gate, words):
    """Pixels of 0.005 to 10 mm are plausible."""
    write_series(tmp_path, plan, set_values(SliceThickness=5))
    warnings, failed = warnings_and_failed_gates(tmp_path)
    assert gate in failed
    assert any(words in warning for warning in warnings), warnings


@pytest.mark.parametrize(
    "plan", [Plan(pixel_spacing=(0.006, 0.006), gap=0.006), Plan(gap=9.7)], ids=["micro-CT", "1.94 times the thickness"]
)
def test_unusual_but_plausible_spacing_passes_its_gates(tmp_path, plan):
    """Above 0.005 mm, and below 1.95 times the thickness."""
    write_series(tmp_path, plan, set_values(SliceThickness=5))
    _, failed = warnings_and_failed_gates(tmp_path)
    assert not {"plausible_spacing", "gap_thickness"} & set(failed)


def test_implausible_spacing_and_slope_fail_their_gates_in_a_listing_that_reads_no_pixels(tmp_path):
    write_series(tmp_path, Plan(pixel_spacing=(0.003, 0.003)), set_values(RescaleSlope=-1))
    certificate = list_series(tmp_path).certificate
    failed = {gate["name"] for gate in certificate["gates"] if gate["ok"] is False}
    assert failed == {"plausible_spacing", "plausible_hu"}
    assert any("(RescaleSlope -1): 1, none allowed" in text for text in certificate["warnings"])


def test_gaps_of_10_pixels_without_a_stated_thickness_are_warned_of(tmp_path):
    plan = Plan(pixel_spacing=(0.7, 0.7), gap=7.0)
    # Numbers that are not one after the other would fail a gate without a thickness.
    write_series(tmp_path, plan, set_values(SliceThickness=None, InstanceNumber=None))
    warnings, failed = warnings_and_failed_gates(tmp_path)
    assert [text for text in warnings if "times the width" in text] == [
        "slices lie 7 mm apart, 10 times the width of a pixel, and no SliceThickness says whether the tissue"
        " between them was measured"
    ]
    assert failed == []


@pytest.mark.parametrize(("gap", "thickness"), [(6.9, None), (7.0, 5.0)])
def test_narrower_gaps_or_those_with_a_stated_thickness_are_not_warned_of(tmp_path, gap, thickness):
    write_series(tmp_path, Plan(pixel_spacing=(0.7, 0.7), gap=gap), set_values(SliceThickness=thickness))
    warnings, _ = warnings_and_failed_gates(tmp_path)
    assert not any("times the width" in text for text in warnings)


def test_gap_is_compared_with_the_thickness_of_the_slices_beside_it(tmp_path):
    write_series(tmp_path, Plan(gap=5.0), lambda ds, k: setattr(ds, "SliceThickness", 4 if k < 5 else 1))
    (gate,) = (gate for gate in read_volume(tmp_path).report["gates"] if gate["name"] == "gap_thickness")
    assert (gate["measured"], gate["ok"]) == (5.0, False)


@pytest.mark.parametrize("slope", [1e6, 1e-6])
def test_rescale_slope_within_a_millionth_and_a_million_is_read(tmp_path, slope):
    write_series(tmp_path, Plan(), set_values(RescaleSlope=slope))
    assert read_volume(tmp_path).report["rescale"]["slope"] == [slope, slope]


@pytest.mark.parametrize("slope", [1.000001e6, 0.999999e-6])
def test_rescale_slope_beyond_a_millionth_or_a_million_is_refused(tmp_path, slope):
    write_series(tmp_path, Plan(), set_values(RescaleSlope=slope))
    with refused(RefusedInputError, "RescaleSlope"):
        read_volume(tmp_path)


# --- HU ---
@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"RescaleSlope": -1}, "RescaleSlope -1"),
        ({"RescaleSlope": 100000}, "RescaleSlope 100000; lowest voxel 8.9999e+07 HU, expected -10000 to 1000; d"),
        ({"RescaleIntercept": 100000}, "RescaleIntercept 100000; lowest voxel 100900 HU, expected -10000 to 1000; d"),
        ({"RescaleIntercept": -15000}, "lowest voxel -14100 HU, expected -10000 to 1000; densest voxel -13831 HU"),
    ],
    ids=["negative slope", "large slope", "large intercept", "low intercept"],
)
def test_rescale_that_gives_implausible_hu_fails_its_gate_with_a_warning(tmp_path, values, words):
    write_series(tmp_path, PLAN, set_values(**values))
    warnings, failed = warnings_and_failed_gates(tmp_path)
    assert "plausible_hu" in failed
    assert any(words in warning for warning in warnings), warnings


@pytest.mark.parametrize("values", [{"RescaleSlope": 0.5}, {"RescaleSlope": 8, "RescaleIntercept": -8192}], ids=str)
def test_rescale_that_gives_plausible_hu_passes_its_gate(tmp_path, values):
    write_series(tmp_path, PLAN, set_values(**values))
    _, failed = warnings_and_failed_gates(tmp_path)
    assert "plausible_hu" not in failed


def test_one_slice_with_a_negative_slope_fails_the_gate_of_hu_with_a_warning(tmp_path):
    write_series(tmp_path, change=set_values(only=3, RescaleSlope=-1))
    warnings, failed = warnings_and_failed_gates(tmp_path)
    assert "plausible_hu" in failed
    assert any("RescaleSlope -1" in warning for warning in warnings)


# --- bits above HighBit ---
def set_stored(values, **elements):
    """A change of the stored values of slice k, shape (5, 6), to `values(stored, k)`."""

    def change(ds, k):
        ds.PixelData = values(np.frombuffer(ds.PixelData, "i2").reshape(5, 6).astype(int), k).astype("<u2").tobytes()
        set_values(**elements)(ds, k)

    return change


def put(value, *, count, only=3):
    """`value` in place of the first values of a slice."""

    def change(stored, k):
        if k == only:
            stored.flat[:count] = value
        return stored

    return change


def twelve_bits(*, signed):
    return replace(PLAN, bits_stored=12, signed=signed)


def test_values_beyond_the_stored_bits_fail_their_gate_with_a_warning(tmp_path):
    write_series(tmp_path, twelve_bits(signed=False), set_stored(put(4200, count=29)))
    warnings, failed = warnings_and_failed_gates(tmp_path)
    assert failed == ["stored_bits"]
    assert warnings == [
        "values beyond the 12 stored bits (bits above HighBit 11, neither sign nor overlay) in 1 of the slices, cut "
        "off, so that their HU wrap around (stored 4200 is read as 104): 29, none allowed"
    ]  # 4200 - 4096


def test_large_values_beside_extended_signs_fail_the_gate_of_stored_bits(tmp_path):
    """3000 has the highest of 12 bits set: where others are negative to bit 15 it is no negative number."""

    def put_both(stored, k):
        stored.flat[:4] = -1000
        stored.flat[4:7] = 3000
        return stored

    write_series(tmp_path, twelve_bits(signed=True), set_stored(put_both))
    warnings, failed = warnings_and_failed_gates(tmp_path)
    assert failed == ["stored_bits"]
    assert "(stored 3000 is read as -1096): 21, none allowed" in warnings[0]  # 3 in each of 7 slices


@pytest.mark.parametrize(
    ("plan", "change"),
    [
        (twelve_bits(signed=True), set_stored(put(-1000, count=9))),
        (twelve_bits(signed=True), set_stored(put(-1000 & 0x0FFF, count=9))),
        (twelve_bits(signed=True), set_stored(put(-3000 & 0xFFFF, count=9), PixelPaddingValue=-3000)),
        (twelve_bits(signed=False), set_stored(put(63536, count=9), PixelPaddingValue=63536)),
        (twelve_bits(signed=False), set_stored(put(4095, count=5))),
        (twelve_bits(signed=False), set_stored(lambda s, k: (s << 4) | 0x9, HighBit=15)),
    ],
    ids=["sign", "sign of 12 bits alone", "padding", "padding without sign", "ceiling", "high bits"],
)
def test_signs_and_padding_above_the_stored_bits_pass_their_gate(tmp_path, plan, change):
    write_series(tmp_path, plan, change)
    _, failed = warnings_and_failed_gates(tmp_path)
    assert "stored_bits" not in failed


def write_with_overlays(folder, *, signed, declared):
    """Twelve bits with overlays in bits 12 and 14 of some pixels, which the header may declare."""

    def mark(stored, k):
        return (stored - 1000 * signed & 0x0FFF) | 0x5000 * (np.arange(30).reshape(5, 6) % 7 == 0)

    def change(ds, k):
        set_stored(mark)(ds, k)
        for group, bit in ((0x6000, 12), (0x6002, 14)) if declared else ():
            ds.add_new((group, 0x0100), "US", 16)
            ds.add_new((group, 0x0102), "US", bit)

    return write_series(folder, twelve_bits(signed=signed), change)


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("declared", [False, True])
def test_bits_of_overlays_fail_the_gate_of_stored_bits_unless_they_are_declared(tmp_path, signed, declared):
    write_with_overlays(tmp_path, signed=signed, declared=declared)
    _, failed = warnings_and_failed_gates(tmp_path)
    assert ("stored_bits" in failed) is not declared


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("declared", [False, True])
def test_bits_of_overlays_do_not_change_the_hu(tmp_path, signed, declared):
    plan = write_with_overlays(tmp_path, signed=signed, declared=declared)
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu() - 1000 * signed)


@pytest.mark.release
@pytest.mark.parametrize(
    "folder", ["lumbar_4p25mm", "thoracic_0p8mm", "head_tilt_gaps", "thoracolumbar_labels/ct_2mm_jpeg2000"]
)
def test_real_scan_passes_the_gates_of_plausible_figures(real_data, folder):
    report = read_volume(real_data / folder).report
    names = {"plausible_spacing", "gap_thickness", "plausible_hu", "stored_bits"}
    assert {gate["name"]: gate["ok"] for gate in report["gates"] if gate["name"] in names} == dict.fromkeys(names, True)
