"""The lowest values along rays: of the body alone, of a region, or of all of a scan."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.rendering.pictures.styles import Projection

SPACING = (2.0, 2.0, 3.0)
AIR, TISSUE, GAS = -1000, 40, -900
RADIUS_MM, GAS_RADIUS_MM = 60.0, 16.0


@pytest.fixture(scope="module")
def trunk() -> Volume:
    """A trunk in air, with a ball of gas, on a plate, in 30 slices of 160 x 160 mm."""
    k, j, i = np.mgrid[:30, :80, :80].astype(float)
    voxels = np.where(np.hypot((j - 35.0) * 2.0, (i - 40.0) * 2.0) <= RADIUS_MM, TISSUE, AIR)
    ball = ((k - 15) * 3.0) ** 2 + ((j - 35) * 2.0) ** 2 + ((i - 40) * 2.0) ** 2 <= GAS_RADIUS_MM**2
    voxels[ball] = GAS
    voxels[:, 70:72, 10:70] = 300
    return Volume(voxels.astype(np.int16), np.diag([*SPACING, 1.0]))


@pytest.fixture(scope="module")
def lowest_in_trunk(trunk: Volume, device: object) -> clrecon.Rendering:
    """The lowest values along rays through the trunk, from the front."""
    return clrecon.render(trunk, "minip", view="anterior", size=(60, 60), device=device)


def test_lowest_values_are_those_of_gas_and_tissue_without_the_air_around(lowest_in_trunk: clrecon.Rendering) -> None:
    rows_of_the_trunk = slice(25, 35)
    assert np.nanmin(lowest_in_trunk.values) == GAS
    assert np.nanmax(lowest_in_trunk.values[rows_of_the_trunk]) == pytest.approx(TISSUE)


def test_gas_covers_the_disc_of_its_ball(lowest_in_trunk: clrecon.Rendering) -> None:
    pixels = np.count_nonzero(lowest_in_trunk.values < (GAS + TISSUE) / 2)
    disc_mm2 = np.pi * GAS_RADIUS_MM**2
    assert pixels * lowest_in_trunk.pixel_mm**2 == pytest.approx(disc_mm2, rel=0.2)  # pixels of some 3 mm


def test_trunk_is_counted_without_its_skin(lowest_in_trunk: clrecon.Rendering) -> None:
    middle_row = lowest_in_trunk.values[30]
    width = np.count_nonzero(np.isfinite(middle_row)) * lowest_in_trunk.pixel_mm
    skin_mm = 2 * RADIUS_MM - width
    assert 3.0 < skin_mm <= 16.0  # of both sides; measured 13.4


def test_pixels_beside_the_body_are_black_and_have_no_depth(lowest_in_trunk: clrecon.Rendering) -> None:
    beside = ~np.isfinite(lowest_in_trunk.values)
    assert beside.any()
    assert (lowest_in_trunk.image[beside] == (0, 0, 0, 255)).all()
    assert np.isnan(lowest_in_trunk.depth[beside]).all()


def test_voxels_that_are_left_out_are_reported_with_their_share(lowest_in_trunk: clrecon.Rendering) -> None:
    """A disc of 60 mm in a square of 160 mm leaves 56 %."""
    left_out = lowest_in_trunk.report["left_out"]
    assert left_out["body"]
    assert left_out["share"] == pytest.approx(left_out["voxels"] / (30 * 80 * 80), abs=1e-4)  # four decimals
    # The skin is left out too; measured 0.06 more.
    assert left_out["share"] == pytest.approx(1 - np.pi * RADIUS_MM**2 / 160.0**2, abs=0.1)


def test_lowest_values_are_those_of_air_where_it_is_kept(trunk: Volume, device: object) -> None:
    kept = clrecon.render(trunk, Projection("minip", keep_air=True), size=(40, 40), device=device)
    assert np.nanmax(kept.values) == AIR
    assert "left_out" not in kept.report


def test_keeping_air_is_refused_for_the_highest_values() -> None:
    with refused(UsageError, "keep_air", "mode"):
        Projection("mip", keep_air=True)


def test_one_renderer_shows_lowest_values_twice_and_then_the_highest(trunk: Volume, device: object) -> None:
    with clrecon.VolumeRenderer(trunk, device=device) as renderer:
        low, again = (renderer.render("minip", view="left", size=(96, 96)) for _ in range(2))
        high = renderer.render("mip", view="left", size=(96, 96))
    assert np.array_equal(low.values, again.values, equal_nan=True)
    assert np.nanmin(low.values) == pytest.approx(GAS, abs=1)  # HU: rounding of float32; measured 0
    assert np.nanmax(high.values) == pytest.approx(300, abs=1)  # the plate


def test_lowest_values_leave_the_volume_as_it_is(trunk: Volume, device: object) -> None:
    before = trunk.voxels.copy()
    clrecon.render(trunk, "minip", view="left", size=(40, 40), device=device)
    assert np.array_equal(trunk.voxels, before)
    assert "left_out" not in trunk.report


def test_a_scan_without_a_body_is_counted_as_a_whole_with_a_warning(device: object) -> None:
    voxels = np.full((8, 20, 20), -800, np.int16)
    voxels[:, 10, 10] = -990
    picture = clrecon.render(Volume(voxels, np.eye(4)), "minip", size=(20, 20), device=device)
    # HU: rays pass beside the middle of the line; measured 2.
    assert np.nanmin(picture.values) == pytest.approx(-990, abs=10)
    assert np.nanmax(picture.values) == pytest.approx(-800, abs=1)  # HU; measured 0
    assert picture.report["left_out"]["voxels"] == 0
    assert any("no body was found" in text for text in picture.report["warnings"])
