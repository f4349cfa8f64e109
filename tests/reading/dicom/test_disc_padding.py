"""Cone beams: one value outside of a round field of view, and grey values on a scale of their own."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan
from value_series import SHAPE, make_body, make_jaw, make_layers, radius_from, write_values

from clrecon import choose_iso_value, read_volume
from clrecon.reading.common.padding import fill_disc_padding


def read(folder, hu):
    return read_volume(write_values(folder, hu, Plan(shape=SHAPE, intercept=0)))


@pytest.mark.parametrize(
    ("slope", "offset"), [(1, 200), (1, 400), (1, 600), (1, 800), (0.6, 400)], ids=lambda number: f"{number:g}"
)
@pytest.mark.parametrize("padding", [None, 0.0, 300.0])
@pytest.mark.parametrize("noise", [15.0, 40.0])
def test_offset_grey_values_fail_the_gate_with_and_without_padding(tmp_path, slope, offset, padding, noise):
    volume = read(tmp_path, make_jaw(slope, offset, padding, noise))
    failed = {gate["name"]: gate["text"] for gate in volume.report["gates"] if gate["ok"] is False}
    assert set(failed) == {"hu_scale"}
    assert (volume.report["padding_share"] > 0.2) == (padding is not None)


@pytest.mark.parametrize("value", [0.0, 300.0, -500.0])
def test_one_value_outside_of_a_disc_is_padding(tmp_path, value):
    hu = make_jaw(1, 0, value)
    volume = read(tmp_path, hu)
    outside = radius_from() > 46
    share = outside.mean()
    assert volume.report["padding_share"] == pytest.approx(share, abs=0.001)
    assert volume.report["padding_hu"] == pytest.approx(-1000, abs=5)
    assert np.array_equal(volume.voxels[:, ~outside], hu[:, ~outside])
    assert (volume.voxels[:, outside] == volume.report["padding_hu"]).all()
    assert volume.report["warnings"] == [
        f"{100 * share:.3g} % of the voxels, all outside of a round field of view, are at {value:g} HU: padding that"
        f" the files do not declare, {volume.report['padding_hu']:g} HU is taken for it"
    ]
    assert all(gate["ok"] is not False for gate in volume.report["gates"])


@pytest.mark.parametrize(
    "hu",
    [
        make_body(),
        make_layers(0, (30, 900), noise=12),
        np.where(radius_from() > 30, 0.0, 700.0) * np.ones(SHAPE),
        np.where(np.abs(np.mgrid[:96, :96] - 47.5).max(0) > 40, 0.0, make_body()),
        np.where(radius_from() > 46, -2000.0, make_body()),
        np.where(radius_from() > 46, -1000.0, make_body()),
    ],
    ids=["no disc", "bone in water", "no noise", "square", "below air", "air"],
)
def test_scans_without_a_filled_disc_have_no_padding(hu):
    voxels = hu.astype(np.int16)
    assert fill_disc_padding(voxels) is None and np.array_equal(voxels, hu)


@pytest.mark.parametrize(("slope", "offset"), [(1, 200), (1, 400), (1, 800), (0.6, 400), (1, 324)])
@pytest.mark.parametrize("padding", [None, 0.0])
def test_auto_finds_the_level_of_bone_on_any_scale(tmp_path, slope, offset, padding):
    """The level is where a scan in HU has it, on the scale of the scan."""
    true = choose_iso_value(read(tmp_path / "hu", make_jaw(1, 0, None, 15.0)))
    volume = read(tmp_path / "own", make_jaw(slope, offset, padding, 15.0))
    found = choose_iso_value(volume)
    assert found.iso_value == pytest.approx(slope * true.iso_value + offset, abs=25 * slope)
    assert found.bone_hu == pytest.approx(slope * true.bone_hu + offset, abs=40 * slope)
    assert found.tissue_hu == pytest.approx(slope * true.tissue_hu + offset, abs=25 * slope)
    rescale = volume.report["rescale"]
    assert (rescale["air"], rescale["soft_tissue"]) == pytest.approx(
        (offset - 1000 * slope, offset + 50 * slope), abs=15
    )
    assert "on the scan's own scale, with air near" in found.reason and "own scale" not in true.reason
