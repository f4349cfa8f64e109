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


@pytest.fixture(scope="module")
def trunk() -> Volume:
    """A trunk of 60 mm radius in air, with a ball of gas of 16 mm radius, on a plate."""
    k, j, i = np.mgrid[:30, :80, :80].astype(float)
    voxels = np.where(np.hypot((j - 35.0) * 2.0, (i - 40.0) * 2.0) <= 60.0, TISSUE, AIR)
    ball = ((k - 15) * 3.0) ** 2 + ((j - 35) * 2.0) ** 2 + ((i - 40) * 2.0) ** 2 <= 16.0**2
    voxels[ball] = GAS
    voxels[:, 70:72, 10:70] = 300
    return Volume(voxels.astype(np.int16), np.diag([*SPACING, 1.0]))


def test_a_minimum_is_that_of_the_body(trunk: Volume, device: object) -> None:
    picture = clrecon.render(trunk, "minip", view="anterior", size=(60, 60), device=device)
    values, mm = picture.values, picture.pixel_mm
    there = np.isfinite(values)
    assert np.nanmin(values) == GAS and np.isclose(np.nanmax(values[25:35]), TISSUE)
    assert np.isclose((values < (GAS + TISSUE) / 2).sum() * mm**2, np.pi * 16.0**2, rtol=0.2)
    width = there[30].sum() * mm
    assert 104.0 <= width <= 120.0  # the trunk without its skin
    assert (picture.image[~there] == (0, 0, 0, 255)).all() and np.isnan(picture.depth[~there]).all()
    said = picture.report["left_out"]
    assert said["body"] and 0.4 < said["share"] < 0.65 and said["share"] == round(said["voxels"] / 192000, 4)


def test_all_of_the_scan_is_counted_where_that_is_asked_for(trunk: Volume, device: object) -> None:
    kept = clrecon.render(trunk, Projection("minip", keep_air=True), size=(40, 40), device=device)
    assert np.nanmax(kept.values) == AIR and "left_out" not in kept.report
    with refused(UsageError, "keep_air", "mode"):
        Projection("mip", keep_air=True)


def test_one_renderer_shows_both_and_the_volume_stays_as_it_is(trunk: Volume, device: object) -> None:
    before = trunk.voxels.copy()
    with clrecon.VolumeRenderer(trunk, device=device) as renderer:
        low, again = (renderer.render("minip", view="left", size=(96, 96)) for _ in range(2))
        high = renderer.render("mip", view="left", size=(96, 96))
    assert np.array_equal(low.values, again.values, equal_nan=True)
    assert np.nanmin(low.values) < GAS + 1 and np.isclose(np.nanmax(high.values), 300, atol=1)
    assert np.array_equal(trunk.voxels, before) and "left_out" not in trunk.report


def test_a_scan_without_a_body_is_counted_as_a_whole_and_says_so(device: object) -> None:
    voxels = np.full((8, 20, 20), -800, np.int16)
    voxels[:, 10, 10] = -990
    picture = clrecon.render(Volume(voxels, np.eye(4)), "minip", size=(20, 20), device=device)
    assert (
        np.nanmin(picture.values) < -980
        and np.nanmax(picture.values) > -810
        and picture.report["left_out"]["voxels"] == 0
    )
    assert [text for text in picture.report["warnings"] if "no body was found" in text]
