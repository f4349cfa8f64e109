"""The contact sheet of presets: what its tiles show, and how they lie."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.rendering import PRESETS, Rendering
from clrecon.rendering.pictures.modes import make_style

pytestmark = pytest.mark.opencl

SPACING_MM = (1.5, 1.5, 2.0)


def block_of_bone() -> Volume:
    """A block of 700 HU of 30 x 24 x 44 mm, in the middle of 54 x 48 x 60 mm of muscle of 60 HU within air."""
    voxels = np.full((34, 40, 44), -1000, np.int16)
    voxels[2:32, 4:36, 4:40] = 60
    voxels[6:28, 12:28, 12:32] = 700
    return Volume(voxels, np.diag([*SPACING_MM, 1.0]))


def find_tile(sheet: Rendering, preset: str) -> np.ndarray:
    """The pixels of a preset without the margin at the edges on which names and letters are written."""
    tile = next(tile for tile in sheet.report["tiles"] if tile["preset"] == preset)
    width, height = sheet.report["tile_size"]
    whole = sheet.image[tile["top"] : tile["top"] + height, tile["left"] : tile["left"] + width]
    return without_margin(whole)


def without_margin(image: np.ndarray) -> np.ndarray:
    return image[28:-28, 28:-28]  # text of up to 18 pixels, 3 pixels from the edge, with an outline


@pytest.mark.parametrize("view_angle", [None, 30.0], ids=["parallel", "perspective"])
def test_tile_of_each_preset_is_the_picture_with_this_preset(device: Any, view_angle: float | None) -> None:
    volume = block_of_bone()
    camera = clrecon.Camera.fit(volume, "left", view_angle=view_angle, size=(1000, 800))

    sheet = clrecon.render(volume, "presets", camera=camera, size=(1000, 800), device=device)

    width, height = sheet.report["tile_size"]
    if view_angle is None:
        half_height_mm = 0.5 * height * sheet.report["pixel_mm"]
        camera = clrecon.Camera(camera.position, camera.focal_point, camera.up, parallel_scale=half_height_mm)
    assert [tile["preset"] for tile in sheet.report["tiles"]] == list(PRESETS)
    for preset in PRESETS:
        alone = clrecon.render(volume, make_style(preset=preset), camera=camera, size=(width, height), device=device)
        assert find_tile(sheet, preset).tobytes() == without_margin(alone.image).tobytes(), preset


def test_zoom_of_two_shows_half_as_many_mm_in_the_tiles_of_a_sheet(device: Any) -> None:
    once, twice = (
        clrecon.render(block_of_bone(), "presets", zoom=zoom, size=(500, 400), device=device) for zoom in (1.0, 2.0)
    )

    assert twice.report["tile_size"] == once.report["tile_size"]
    assert twice.pixel_mm == pytest.approx(0.5 * once.pixel_mm)


def test_tiles_of_presets_do_not_overlap_and_lie_within_the_sheet(device: Any) -> None:
    sheet = clrecon.render(block_of_bone(), preset="all", size=(500, 400), device=device)

    width, height = sheet.report["tile_size"]
    covered = np.zeros((400, 500), int)
    for tile in sheet.report["tiles"]:
        covered[tile["top"] : tile["top"] + height, tile["left"] : tile["left"] + width] += 1
    assert covered.max() == 1
    assert covered.sum() == len(PRESETS) * width * height


@pytest.mark.parametrize(
    ("mode", "preset"), [("mip", "all"), ("presets", "bone")], ids=["all_presets_in_a_mode", "one_preset_on_the_sheet"]
)
def test_sheet_of_presets_beside_another_choice_is_refused(mode: str, preset: str) -> None:
    with refused(UsageError, "presets", mode):
        make_style(mode, preset)
