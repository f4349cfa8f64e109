"""Rendering presets: what must show in each shows, and what must not does not; the document names them all."""

from __future__ import annotations

import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering import DEFAULT_PRESET, PRESETS, UNSHADED, find_preset

pytestmark = pytest.mark.unit

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "transfer_functions.md"
NAMES = ["bone", "spine", "skin", "lung", "vessels", "muscle", "metal", "x-ray", "mip", "minip"]


def transmitted_share(name: str, hu: float, mm: float) -> float:
    """Share of the light that a layer of `mm` of one value lets through."""
    function = PRESETS[name].transfer_function
    return float((1 - function([hu])[0, 3]) ** (mm / function.unit_distance))


def test_presets_are_listed_in_order_and_bone_is_the_default() -> None:
    assert list(PRESETS) == NAMES
    assert find_preset(DEFAULT_PRESET).name == "bone"


@pytest.mark.parametrize("name", ["bonne", "xyz", "", None])
def test_unknown_preset_is_refused_with_those_that_there_are(name: str | None) -> None:
    with refused(UsageError, repr(name), "bone", "spine", "skin"):
        find_preset(name)


@pytest.mark.parametrize("name", NAMES)
def test_preset_has_name_description_and_source(name: str) -> None:
    preset = PRESETS[name]
    assert preset.name == preset.transfer_function.name == name
    assert preset.description
    assert preset.source


@pytest.mark.parametrize("name", NAMES)
def test_preset_has_the_light_of_its_function_which_shades_volume_rendering_alone(name: str) -> None:
    preset = PRESETS[name]
    assert preset.lighting == preset.transfer_function.lighting
    assert preset.lighting.shades == (preset.mode == "dvr")


@pytest.mark.parametrize("name", NAMES)
def test_preset_has_a_range_of_hu_of_ct_and_a_window_that_rises(name: str) -> None:
    preset = PRESETS[name]
    low, high = preset.transfer_function.range_hu
    assert -1100 < low < high < 3100  # around air and the end of 12 bits
    assert preset.window is None or preset.window[0] < preset.window[1]


def test_presets_of_projections_have_their_modes_and_windows() -> None:
    modes = {name: preset.mode for name, preset in PRESETS.items() if preset.mode != "dvr"}
    assert modes == {"x-ray": "drr", "mip": "mip", "minip": "minip"}
    assert PRESETS["mip"].window == (0, 1000)
    assert PRESETS["x-ray"].window is None and PRESETS["x-ray"].lighting == UNSHADED


@pytest.mark.parametrize(
    ("name", "hu", "mm", "low", "high"),
    [
        # Clear: less than a tenth of the light is lost.
        ("bone", 100, 300, 1, 1),
        ("spine", -1000, 500, 1, 1),
        ("spine", -100, 50, 0.9, 1),
        ("lung", -1000, 500, 1, 1),
        ("lung", 40, 300, 1, 1),
        ("vessels", 80, 300, 1, 1),
        ("muscle", -100, 300, 1, 1),
        ("skin", -800, 300, 1, 1),
        ("metal", 300, 5, 0.9, 1),
        # Faint: something of what lies behind is seen.
        ("spine", 50, 100, 0.3, 0.8),
        ("lung", -850, 100, 0.3, 0.8),
        ("metal", 1000, 10, 0.3, 0.8),
        # Solid: next to nothing comes through.
        ("bone", 400, 10, 0, 0.05),
        ("spine", 400, 10, 0, 0.05),
        ("skin", -300, 2, 0, 0.01),
        ("vessels", 300, 8, 0, 0.05),
        ("muscle", 55, 10, 0, 0.05),
        ("metal", 2800, 3, 0, 0.01),
    ],
)
def test_layer_of_a_tissue_is_as_clear_or_solid_as_its_preset_promises(
    name: str, hu: float, mm: float, low: float, high: float
) -> None:
    assert low <= transmitted_share(name, hu, mm) <= high


def test_thin_cortex_averaged_in_a_slice_of_4_mm_is_seen_in_preset_bone() -> None:
    """A slice of 4 mm averages a thin cortex with its surroundings: 150 to 200 HU."""
    assert (
        transmitted_share("bone", hu=175, mm=4) < 0.95
    )  # a twentieth of the light is what the eye sees; measured 0.89


def test_dense_bone_is_nearly_white_in_preset_bone() -> None:
    color = PRESETS["bone"].transfer_function([1000])[0, :3]
    assert min(color) > 0.8  # of 1.0, white; blue, the least, is 0.875


def test_contrast_medium_is_red_in_preset_vessels() -> None:
    red, green, blue, _ = PRESETS["vessels"].transfer_function([250])[0]
    assert red > 2 * max(green, blue)  # 0.84 beside 0.19 and 0.13


def test_opacity_of_preset_x_ray_grows_with_hu() -> None:
    opacity = PRESETS["x-ray"].transfer_function(np.arange(-1000, 1500, 10))[:, 3]
    assert opacity[0] == 0 and np.all(np.diff(opacity) > 0)


def test_page_of_transfer_functions_has_the_mode_of_each_preset_and_the_first_hu_of_volume_rendering() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w-]+)` \| (.*?) \| (\w+) \| (.*?) ?\|$", text, re.MULTILINE)
    assert [row[0] for row in rows] == NAMES
    for name, description, mode, begins in rows:
        preset = PRESETS[name]
        assert preset.description.startswith(description) and preset.mode == mode
        assert bool(begins) == (mode == "dvr")
        if begins:
            hu, *_, opacities = preset.transfer_function.points.T
            first_opaque = np.flatnonzero(opacities > 0)[0]
            assert float(begins.split()[0]) == hu[first_opaque - 1]


POINTS = {
    "bone": 0xAA76027B,
    "spine": 0x07A3E427,
    "skin": 0x73ACC3B2,
    "lung": 0x8FB2EF29,
    "vessels": 0x81DDA3D3,
    "muscle": 0x1C6EF3A8,
    "metal": 0xC2DECF6E,
    "x-ray": 0xCBDD13C3,
    "mip": 0x64184FCC,
    "minip": 0x2D0CE1AD,
}
"""Checksums of the points of each preset."""


@pytest.mark.golden
@pytest.mark.parametrize("name", NAMES)
def test_points_of_a_preset_are_those_of_earlier_versions(name: str) -> None:
    """Who changes one on purpose says so in CHANGELOG.md, and writes the new figure here."""
    points = PRESETS[name].transfer_function.points.tolist()
    assert f"{zlib.crc32(json.dumps(points).encode()):08X}" == f"{POINTS[name]:08X}"
