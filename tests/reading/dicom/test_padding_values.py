"""PixelPaddingValue in the writings that are found in files."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan, set_values, write_series
from pydicom.dataelem import RawDataElement
from pydicom.tag import Tag
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.reading import read_volume


def put_padding_value(ds, vr, raw):
    """Give a data set the element PixelPaddingValue with these bytes, in explicit VR."""
    tag = Tag("PixelPaddingValue")
    ds[tag] = RawDataElement(
        tag, vr, length=len(raw), value=raw, value_tell=0, is_implicit_VR=False, is_little_endian=True
    )


@pytest.mark.parametrize(
    ("bits", "vr", "raw", "stored"),
    [
        pytest.param(16, "UL", (63536).to_bytes(4, "little"), 0xF830, id="unsigned, 32 bits"),
        pytest.param(16, "SL", (-2000).to_bytes(4, "little", signed=True), 0xF830, id="signed, 32 bits"),
        pytest.param(12, "US", (0x0830).to_bytes(2, "little"), 0xF830, id="12 bits, pixels with their sign extended"),
        pytest.param(12, "US", (0x0830).to_bytes(2, "little"), 0x0830, id="12 bits, as the pixels"),
        pytest.param(12, "US", (0xF830).to_bytes(2, "little"), 0x0830, id="sign extended, pixels without"),
        pytest.param(12, "US", (0x8000).to_bytes(2, "little"), 0x8000, id="beyond 12 bits, as the pixels"),
    ],
)
def test_padding_is_masked_in_any_width_and_sign_of_its_value(tmp_path, bits, vr, raw, stored):
    """Signed pixels, with and without the sign in the unused bits; three of them in each slice are `stored`."""

    def change(ds, k):
        array = plan.stored(k).astype(np.uint16) & ((1 << bits) - 1)
        array[0, :3] = stored
        set_values(BitsStored=bits, HighBit=bits - 1, PixelData=array.astype(np.uint16).tobytes())(ds, k)
        put_padding_value(ds, vr, raw)

    plan = Plan()
    write_series(tmp_path, plan, change)
    volume = read_volume(tmp_path)
    expected = plan.hu()
    expected[:, 0, :3] = volume.report["padding_hu"]
    assert np.array_equal(volume.voxels, expected)
    assert volume.report["padding_share"] == pytest.approx(3 / (5 * 6))


@pytest.mark.parametrize(
    ("vr", "raw"), [("DS", b"-200"), ("IS", b"-2000 "), ("US", b"\x30\xf8" * 2)], ids=["DS", "IS", "two values"]
)
def test_padding_value_that_is_no_binary_number_is_refused(tmp_path, vr, raw):
    def change(ds, k):
        put_padding_value(ds, vr, raw)

    write_series(tmp_path, change=change)
    with refused(RefusedInputError, "PixelPaddingValue", "number"):
        read_volume(tmp_path)
