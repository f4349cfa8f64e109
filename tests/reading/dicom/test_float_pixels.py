"""Float and Double Float Pixel Data, and row 32 of the fault list: volumes that hold no image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from dicom_series import Plan, set_values, write_series
from pydicom.uid import DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian
from refusals import refused
from stored_pixels import set_pixels

from clrecon.errors import RefusedInputError
from clrecon.reading import read_volume

SEVEN_SLICES = Plan(shape=(7, 5, 6))
"""Its stored values run from 900 on, by 1 a pixel and by 40 a slice."""


def set_floats(make, width=32, **values):
    """A change that puts Float (or Double Float) Pixel Data in place of Pixel Data: -1024 HU up in steps of 0.5."""

    def change(ds, k):
        array = (np.frombuffer(ds.PixelData, np.int16).astype(f"f{width // 8}") * 0.5 - 1474).reshape(5, 6)
        del ds.PixelData, ds.BitsStored, ds.HighBit, ds.PixelRepresentation, ds.RescaleSlope, ds.RescaleIntercept
        ds.BitsAllocated = width
        keyword = "FloatPixelData" if width == 32 else "DoubleFloatPixelData"
        setattr(ds, keyword, np.ascontiguousarray(make(array, k)).tobytes())
        set_values(**values)(ds, k)

    return change


def keep(array, k):
    return array


@pytest.mark.parametrize("width", [32, 64])
@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian, DeflatedExplicitVRLittleEndian])
def test_float_pixels_are_read_as_hu_in_float32(tmp_path, width, syntax):
    plan = write_series(tmp_path, Plan(syntax=syntax), set_floats(keep, width=width))
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.float32
    assert np.array_equal(volume.voxels, (plan.hu() + 1024) * 0.5 - 1474)
    assert volume.report["hu_range"] == [-1024, volume.voxels.max()]


@pytest.mark.parametrize("width", [32, 64])
@pytest.mark.parametrize(
    ("value", "limit"), [(-3000.5, None), (-3000.5, -2990), (np.nan, None)], ids=["value", "range", "NaN"]
)
def test_declared_float_padding_is_read_as_air(tmp_path, width, value, limit):
    def pad(array, k):
        array[0, :3] = value
        if limit is not None:
            array[0, 1] = -2995
        return array

    prefix = "" if width == 32 else "Double"
    values = {f"{prefix}FloatPixelPaddingValue": value}
    if limit is not None:
        values[f"{prefix}FloatPixelPaddingRangeLimit"] = limit
    plan = write_series(tmp_path, SEVEN_SLICES, set_floats(pad, width=width, **values))

    volume = read_volume(tmp_path)

    air_hu = volume.report["padding_hu"]
    assert -1024 <= air_hu <= -900  # from the lowest HU of the scan to the highest of air; -961 was measured
    expected = (plan.hu() + 1024) * 0.5 - 1474
    expected[:, 0, :3] = air_hu
    assert np.array_equal(volume.voxels, expected)
    assert volume.report["padding_share"] == pytest.approx(3 / (5 * 6))


@pytest.mark.fault_row(32)
@pytest.mark.parametrize(
    ("value", "facts"),
    [
        (np.nan, ("NaN", 1, "infinite", 0, 30)),
        (-np.inf, ("NaN", 0, "infinite", 1, 30)),
        (3e38, ((900 + 3 * 40) * 0.5 - 1474, 3e38)),  # the lowest and the highest value of the slice
    ],
    ids=["NaN", "infinite", "huge"],
)
def test_slice_with_a_nan_infinite_or_huge_voxel_is_refused_by_its_name_and_values(tmp_path, value, facts):
    def spoil(array, k):
        if k == 3:
            array[2, 4] = value
        return array

    write_series(tmp_path, SEVEN_SLICES, set_floats(spoil))
    with refused(RefusedInputError, "slice003", "Float", "Pixel", "Data", *facts):
        read_volume(tmp_path)


@pytest.mark.fault_row(32)
def test_volume_of_nan_is_refused(tmp_path):
    write_series(tmp_path, SEVEN_SLICES, set_floats(lambda array, k: array * np.nan))
    with refused(RefusedInputError, "NaN", 5 * 6, 0):
        read_volume(tmp_path)


@pytest.mark.fault_row(32)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_pixels(lambda array, k: array * 0 + 7), f"voxels are {7 - 1024} HU: the volume is constant"),
        (set_pixels(lambda array, k: array * 0 - 2000, PixelPaddingValue=-2000), "voxels are padding"),
        (set_floats(lambda array, k: array * 0 + 3.5), "voxels are 3.5 HU"),
    ],
)
def test_volume_of_one_value_or_of_padding_alone_is_refused(tmp_path, change, words):
    write_series(tmp_path, replace(SEVEN_SLICES, intercept=-1024), change)
    with pytest.raises(RefusedInputError, match=f"all {7 * 5 * 6} {words}"):
        read_volume(tmp_path)


@pytest.mark.parametrize(
    ("values", "facts"),
    [
        ({"RescaleSlope": 2}, ("RescaleSlope", 2.0)),
        ({"RescaleIntercept": -1024}, ("RescaleIntercept", -1024.0)),
        ({"BitsAllocated": 16}, ("BitsAllocated", 16, 32)),
        ({"Rows": 6}, ("truncated", 6 * 6 * 4, 5 * 6 * 4)),
    ],
)
def test_float_pixels_with_a_rescale_or_another_size_are_refused(tmp_path, values, facts):
    write_series(tmp_path, SEVEN_SLICES, set_floats(keep, **values))
    with refused(RefusedInputError, "slice000.dcm", *facts):
        read_volume(tmp_path)
