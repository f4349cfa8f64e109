"""Cone beams: one value outside of a round field of view, and grey values on a scale of their own."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from dicom_series import Plan
from value_series import SHAPE, make_body, make_jaw, make_layers, radius_from, write_values

from clrecon import choose_iso_value, read_volume
from clrecon.reading.common.padding import fill_disc_padding


def read_signed(folder, hu):
    """A volume of HU that were stored as they are."""
    return read_volume(write_values(folder, hu, Plan(shape=SHAPE, intercept=0)))


@pytest.mark.parametrize(
    ("slope", "offset"), [(1, 200), (1, 400), (1, 600), (1, 800), (0.6, 400)], ids=lambda number: f"{number:g}"
)
@pytest.mark.parametrize("padding", [None, 0.0, 300.0])
@pytest.mark.parametrize("noise", [15.0, 40.0])
def test_cone_beam_on_another_scale_fails_that_gate_alone_with_and_without_padding(
    tmp_path, slope, offset, padding, noise
):
    report = read_signed(tmp_path, make_jaw(slope=slope, offset=offset, padding=padding, noise=noise)).report
    assert {gate["name"] for gate in report["gates"] if gate["ok"] is False} == {"hu_scale"}
    assert (report["padding_share"] > 0.2) == (padding is not None)  # around a circle of 46 pixels in a square of 96


OUTSIDE_OF_DISC = radius_from() > 46


@pytest.mark.parametrize("value", [0.0, 300.0, -500.0])
def test_one_value_outside_of_a_disc_is_replaced_by_the_hu_of_air(tmp_path, value):
    hu = make_jaw(slope=1, offset=0, padding=value)
    volume = read_signed(tmp_path, hu)
    assert volume.report["padding_hu"] == pytest.approx(-1000, abs=tolerances.DISC_AIR_HU)
    assert (volume.voxels[:, OUTSIDE_OF_DISC] == volume.report["padding_hu"]).all()
    assert np.array_equal(volume.voxels[:, ~OUTSIDE_OF_DISC], hu[:, ~OUTSIDE_OF_DISC])


@pytest.mark.parametrize("value", [0.0, 300.0, -500.0])
def test_one_value_outside_of_a_disc_is_warned_of_with_its_share(tmp_path, value):
    report = read_signed(tmp_path, make_jaw(slope=1, offset=0, padding=value)).report
    share = OUTSIDE_OF_DISC.mean()
    assert report["padding_share"] == pytest.approx(share, abs=tolerances.DISC_SHARE)
    assert report["warnings"] == [
        f"{100 * share:.3g} % of the voxels, all outside of a round field of view, are at {value:g} HU: padding that"
        f" the files do not declare, {report['padding_hu']:g} HU is taken for it"
    ]
    assert all(gate["ok"] is not False for gate in report["gates"])


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
def test_scan_without_a_disc_whose_outside_is_above_air_is_left_as_it_is(hu):
    voxels = hu.astype(np.int16)
    assert fill_disc_padding(voxels) is None
    assert np.array_equal(voxels, hu)


@pytest.fixture(params=[(1, 200), (1, 400), (1, 800), (0.6, 400), (1, 324)], ids=str)
def jaw_on_own_scale(request, tmp_path):
    """Slope and offset of a jaw on its own scale, its volume, and the iso value of the same jaw in HU."""
    slope, offset = request.param
    in_hu = choose_iso_value(read_signed(tmp_path / "hu", make_jaw(slope=1, offset=0, padding=None, noise=15.0)))
    own = read_signed(tmp_path / "own", make_jaw(slope=slope, offset=offset, padding=0.0, noise=15.0))
    return slope, offset, own, in_hu


def test_iso_value_of_a_scan_on_its_own_scale_is_that_in_hu_on_that_scale(jaw_on_own_scale):
    slope, offset, volume, in_hu = jaw_on_own_scale
    chosen = choose_iso_value(volume)
    for name, bound in (
        ("iso_value", tolerances.OWN_SCALE_HU),
        ("bone_hu", tolerances.OWN_SCALE_BONE_HU),
        ("tissue_hu", tolerances.OWN_SCALE_HU),
    ):
        assert getattr(chosen, name) == pytest.approx(slope * getattr(in_hu, name) + offset, abs=bound * slope)


@pytest.mark.parametrize(("slope", "offset"), [(1, 200), (1, 400), (1, 800), (0.6, 400), (1, 324)])
def test_iso_value_of_a_scan_on_its_own_scale_without_padding_is_that_in_hu_on_that_scale(tmp_path, slope, offset):
    in_hu = choose_iso_value(read_signed(tmp_path / "hu", make_jaw(slope=1, offset=0, padding=None, noise=15.0)))
    own = read_signed(tmp_path / "own", make_jaw(slope=slope, offset=offset, padding=None, noise=15.0))
    chosen = choose_iso_value(own)
    expected = slope * in_hu.iso_value + offset
    assert chosen.iso_value == pytest.approx(expected, abs=tolerances.OWN_SCALE_HU * slope)


def test_reason_of_an_iso_value_says_that_the_scan_has_a_scale_of_its_own(jaw_on_own_scale):
    _, _, volume, in_hu = jaw_on_own_scale
    assert "on the scan's own scale, with air near" in choose_iso_value(volume).reason
    assert "own scale" not in in_hu.reason


def test_report_of_a_scan_on_its_own_scale_has_the_values_of_air_and_soft_tissue(jaw_on_own_scale):
    slope, offset, volume, _ = jaw_on_own_scale
    rescale = volume.report["rescale"]
    assert rescale["air"] == pytest.approx(offset - 1000 * slope, abs=tolerances.OWN_SCALE_PEAK)
    assert rescale["soft_tissue"] == pytest.approx(offset + 50 * slope, abs=tolerances.OWN_SCALE_PEAK)
