"""What the voxels themselves say: shifted, saturated, padded without a word, or constant."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pydicom.data
import pytest
from dicom_series import Plan, set_values, write_series
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.reading import read_volume
from clrecon.reading.common.plausibility import examine_voxels
from clrecon.reading.dicom.pixels.voxels import read_voxels
from clrecon.reading.dicom.series.scan import scan_path
from clrecon.reading.dicom.series.series import group_series

SHAPE = (6, 48, 48)


def make_scan(seed=2, noise=12.0, lungs=False):
    """HU of a body of fat, muscle and bone in air."""
    y, x = np.mgrid[: SHAPE[1], : SHAPE[2]]
    radius = np.hypot(x - 23.5, y - 23.5)
    hu = np.full(SHAPE, -1000.0)
    for limit, value in ((19, -100), (16, 45), (6, 250), (4, 700)):
        hu[:, radius < limit] = value
    if lungs:
        hu[:, (abs(x - 23.5) > 7) & (radius < 14)] = -820
    return np.maximum(np.rint(hu + np.random.default_rng(seed).normal(0, noise, SHAPE)), -1024)


def write_hu(folder, hu, plan=None, **values):
    """Write HU as they come out of the plan's slope and intercept; `values` then say otherwise."""
    plan = plan or Plan(shape=hu.shape)

    def change(ds, k):
        ds.PixelData = np.rint((hu[k] - plan.intercept) / plan.slope).astype(np.int16).tobytes()
        set_values(**values)(ds, k)

    write_series(folder, plan, change)
    return folder


def read_warnings(folder):
    return read_volume(folder).report["warnings"]


# --- shifted ---
@pytest.mark.parametrize("lungs", [False, True])
@pytest.mark.parametrize("intercept", [-1024, -1000])
def test_scan_with_its_intercept_has_no_warning(tmp_path, intercept, lungs):
    assert read_warnings(write_hu(tmp_path, make_scan(lungs=lungs), RescaleIntercept=intercept)) == []


@pytest.mark.parametrize("lungs", [False, True])
@pytest.mark.parametrize(
    ("intercept", "words"),
    [
        (0, r"air lies near 24 HU and soft tissue near 10\d\d HU, .* the rescale intercept seems to be missing"),
        (-2048, r"air lies near -2024 HU and soft tissue near -9\d\d HU, .* seems to have been applied twice"),
    ],
    ids=["missing", "doubled"],
)
def test_intercept_that_is_missing_or_doubled_is_warned_of(tmp_path, intercept, words, lungs):
    (warning,) = read_warnings(write_hu(tmp_path, make_scan(lungs=lungs), RescaleIntercept=intercept))
    assert re.match(words, warning)


def test_missing_intercept_is_warned_of_beside_declared_padding(tmp_path):
    """Declared padding goes to -1024 where no air is beside it, and says nothing of the scan."""
    hu = make_scan()
    plan = Plan(shape=SHAPE)

    def change(ds, k):
        stored = (hu[k] + 1024).astype(np.int16)
        stored[:6] = -2000
        ds.PixelData = stored.tobytes()
        ds.add_new("PixelPaddingValue", "SS", -2000)
        ds.RescaleIntercept = 0

    write_series(tmp_path, plan, change)
    volume = read_volume(tmp_path)
    assert volume.report["padding_hu"] == -1024
    assert "seems to be missing" in volume.report["warnings"][0]


def make_specimen():
    """Dry bone in air: no soft tissue."""
    return np.where(make_scan() > -500, make_scan() + 900.0, make_scan())


def make_cut_of_a_spine():
    """Bone in tissue: partial volume lies between tissue and dense bone."""
    hu = np.where(make_scan() > 100, 1060.0, 40.0)
    hu[:, 10:30, 10:30] = np.random.default_rng(5).uniform(40, 1060, (SHAPE[0], 20, 20))
    return hu


@pytest.mark.parametrize(
    "hu",
    [
        pytest.param(np.maximum(make_scan(), -150), id="only tissue"),
        pytest.param(make_cut_of_a_spine(), id="bone in tissue"),
        pytest.param(make_specimen(), id="dry bone"),
        pytest.param(np.full(SHAPE, -850.0) + np.random.default_rng(1).normal(0, 40, SHAPE), id="lung alone"),
        pytest.param(np.maximum(make_scan(noise=60), -1024), id="air clipped at -1024"),
        pytest.param(make_scan(noise=60) - 40 * (make_scan() < -900), id="loud air"),
        pytest.param(np.where(make_scan() > -500, 0.0, -1000.0), id="water in air"),
    ],
)
def test_scan_that_is_merely_unusual_has_no_warning(tmp_path, hu):
    noisy = np.rint(hu + np.random.default_rng(4).normal(0, 8, SHAPE))
    assert read_warnings(write_hu(tmp_path, noisy)) == []


def test_dry_bone_with_padding_that_is_not_declared_is_warned_of_for_its_padding_alone(tmp_path):
    hu = make_specimen()
    hu[:, :8] = -2000
    (warning,) = read_warnings(write_hu(tmp_path, hu))
    assert "padding that the files do not declare" in warning


# --- silent padding ---
@pytest.mark.parametrize("value", [-1200, -2000, -3024])
def test_padding_that_is_not_declared_is_warned_of_and_kept(tmp_path, value):
    hu = make_scan()
    hu[:, :12] = value  # of 48 rows
    volume = read_volume(write_hu(tmp_path, hu))
    assert volume.report["warnings"][0].startswith(f"25 % of the voxels are at {value} HU, below air: padding that")
    assert volume.report["padding_hu"] is None
    assert np.array_equal(volume.voxels, hu)


def test_share_of_padding_in_a_warning_is_that_of_all_voxels(tmp_path):
    """Rows and slices that a sample leaves out count as well."""
    shape = (40, 200, 160)
    hu = np.random.default_rng(7).integers(-1010, -990, shape).astype(float)
    hu[:, 40:160, 30:130] = np.random.default_rng(8).integers(20, 60, (40, 120, 100))
    hu[: 8 + 3, :33] = -1500
    hu[20:, :, :29] = -1500
    (warning,) = read_warnings(write_hu(tmp_path, hu))
    assert warning.startswith(f"{100.0 * (hu == -1500).mean():.3g} % of the voxels are at -1500 HU")


def test_noise_far_below_air_is_not_taken_for_padding(tmp_path):
    hu = np.where(make_scan() < -900, np.random.default_rng(3).normal(-1000, 90, SHAPE).round(), make_scan())
    assert hu.min() < -1200  # HU: as padding it is warned of; measured -1302
    assert read_warnings(write_hu(tmp_path, hu)) == []


# --- saturated ---
@pytest.mark.parametrize(
    "plan",
    [
        Plan(shape=SHAPE, intercept=0),
        Plan(shape=SHAPE, intercept=-1000),
        Plan(shape=SHAPE, intercept=-8192, bits_stored=14, signed=False),
    ],
    ids=["signed HU", "another intercept", "14 bits"],
)
def test_metal_at_3071_hu_is_warned_of_as_saturated_however_it_is_stored(tmp_path, plan):
    hu = make_scan()
    hu[:, 23:25, 23:25] = 3071  # 6 slices of 2 x 2 voxels
    assert read_warnings(write_hu(tmp_path, hu, plan)) == [
        "24 voxels are at 3071 HU, the ceiling of 12 bits: metal is saturated, its surface displaced"
    ]


def write_scan_with_24_voxels_at(folder, top, *, bits, signed):
    hu = np.clip(make_scan(), -1024, top - 1)
    hu[:, 23:25, 23:25] = top
    return write_hu(folder, hu, Plan(shape=SHAPE, bits_stored=bits, signed=signed))


@pytest.mark.parametrize(
    ("bits", "signed", "top", "words"),
    [
        (16, True, 3071, "ceiling of 12 bits: metal is saturated"),
        (16, True, 31743, "ceiling of 16 bits: metal is saturated"),
        (12, False, 3071, "ceiling of 12 bits: metal is saturated"),
        (12, True, 1023, "ceiling of 12 bits: metal or dense bone is cut off"),
        (14, False, 15359, "ceiling of 14 bits: metal is saturated"),
    ],
)
def test_voxels_at_the_largest_value_of_the_stored_bits_are_warned_of(tmp_path, bits, signed, top, words):
    (warning,) = read_warnings(write_scan_with_24_voxels_at(tmp_path, top, bits=bits, signed=signed))
    assert warning.startswith(f"24 voxels are at {top} HU, the ")
    assert words in warning


@pytest.mark.parametrize(("bits", "signed", "top"), [(16, True, 3000), (14, False, 3072)])
def test_voxels_at_another_value_are_not_warned_of_as_saturated(tmp_path, bits, signed, top):
    assert read_warnings(write_scan_with_24_voxels_at(tmp_path, top, bits=bits, signed=signed)) == []


def test_scan_whose_values_go_on_beyond_3071_hu_is_not_warned_of_as_saturated(tmp_path):
    hu = make_scan()
    hu[:, 20:28, 20:28] = 3040 + np.arange(SHAPE[0] * 64).reshape(-1, 8, 8) % 64  # six voxels at each value
    hu[:, 20:28, 20] = 3072  # and 48 beside
    assert read_warnings(write_hu(tmp_path, hu)) == []


def test_metal_at_3071_hu_with_a_few_values_above_is_warned_of_with_both_counts(tmp_path):
    hu = make_scan()
    hu[:, 18:26, 18:26] = np.random.default_rng(6).integers(2600, 3071, (SHAPE[0], 8, 8))
    hu[1:5, 20:24, 20:28] = 3071  # 4 x 4 x 8 voxels
    hu[5, 20, 18:22] = hu[0, 20:25, 18:23] = 3500  # 4 and 5 x 5 voxels
    (warning,) = read_warnings(write_hu(tmp_path, hu))
    assert warning.split(":")[0] == (
        "128 voxels are at 3071 HU, the ceiling of 12 bits and 29 are above it, at most at 3500 HU"
    )


def test_saturated_voxels_of_slices_with_another_intercept_are_warned_of_apart(tmp_path):
    plan = Plan(shape=SHAPE, bits_stored=12, signed=False)

    def change(ds, k):
        stored = (make_scan()[k] + 1024).astype(np.int16)
        stored[20:24, 20:24] = 4095  # 16 voxels in each of 6 slices
        ds.PixelData = stored.tobytes()
        ds.RescaleIntercept = -1024 + 100 * (k == 2)

    write_series(tmp_path, plan, change)
    about_intercept, *about_ceilings = read_warnings(tmp_path)
    assert about_intercept.startswith("RescaleIntercept is not -1024 as in the other slices")
    assert [warning.split(",")[0] for warning in about_ceilings] == [
        "80 voxels are at 3071 HU",
        "16 voxels are at 3171 HU",
    ]


# --- constant ---
def test_volume_of_one_value_is_refused(tmp_path):
    with refused(RefusedInputError, 6 * 48 * 48, 40):
        read_volume(write_hu(tmp_path, np.full(SHAPE, 40.0)))


def test_volume_of_declared_padding_alone_is_refused(tmp_path):
    stored_padding = 0  # -1024 HU
    folder = write_hu(tmp_path, np.full(SHAPE, -1024.0), PixelPaddingValue=stored_padding)
    with refused(RefusedInputError, 6 * 48 * 48, "voxels"):
        read_volume(folder)


def test_volume_of_two_values_has_no_warning(tmp_path):
    hu = np.full(SHAPE, 40.0)
    hu[3, 5, 7] = 41
    assert read_warnings(write_hu(tmp_path, hu)) == []


# --- no false alarms ---
@pytest.mark.parametrize(("shape", "is_warned_of"), [((3, 9, 37), False), ((4, 10, 25), True)], ids=["999", "1000"])
def test_padding_is_warned_of_in_volumes_from_1000_voxels_on(tmp_path, shape, is_warned_of):
    """Of fewer voxels no share is stated."""
    hu = np.where(np.arange(np.prod(shape)).reshape(shape) % 3 == 0, -2000.0, 40.0)
    assert any("at -2000 HU" in warning for warning in read_warnings(write_hu(tmp_path, hu))) is is_warned_of


def test_ct_of_another_scanner_has_no_warning_of_its_voxels():
    assert warnings_of_voxels(Path(pydicom.data.get_testdata_file("CT_small.dcm", download=False))) == []


def test_padding_that_a_scanner_does_not_declare_is_warned_of():
    (warning,) = warnings_of_voxels(Path(pydicom.data.get_testdata_file("J2K_pixelrep_mismatch.dcm", download=False)))
    assert warning.startswith("21.5 % of the voxels are at -2000 HU")


@pytest.mark.release
@pytest.mark.parametrize(
    "folder", ["lumbar_4p25mm", "thoracic_0p8mm", "head_tilt_gaps", "thoracolumbar_labels/ct_2mm_jpeg2000"]
)
def test_real_scan_has_no_warning_of_its_voxels(real_data, folder):
    assert warnings_of_voxels(real_data / folder) == []


def warnings_of_voxels(path):
    """Warnings of the voxels of the CT series at a path, whatever its geometry."""
    series = next(one for one in group_series(scan_path(path)) if one.stack is not None and one.kind != "other")
    voxels, facts = read_voxels(series.stack.slices)
    findings = examine_voxels(voxels, facts, series.stack.slices, known=True)
    return findings.warnings + [gate.text for gate in findings.gates if gate.ok is False]
