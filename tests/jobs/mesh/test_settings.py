"""Settings and presets: what is refused, and what an iso value is when nothing is said."""

from __future__ import annotations

import math

import pytest

from clrecon.errors import UsageError
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.presets import DEFAULT_PRESET, PRESETS, find_iso_preset


def test_default_settings_are_of_bone_at_200_hu_closed_in_lps_on_any_device() -> None:
    settings = MeshSettings()
    assert (settings.levels, settings.preset_used) == ((200.0,), "bone")
    assert (settings.space, settings.closed, settings.device) == ("lps", True, None)


def test_given_iso_value_replaces_the_default_preset() -> None:
    settings = MeshSettings(iso_value=-0.0)
    assert (settings.levels, settings.preset_used) == ((0.0,), None)


def test_several_iso_values_keep_their_order() -> None:
    assert MeshSettings(iso_value=[350, 200.5]).levels == (350, 200.5)


@pytest.mark.parametrize(
    ("settings", "selects"),
    [
        ({}, False),
        ({"split": True}, True),
        ({"seeds": [(1, 2, 3)]}, True),
        ({"keep_largest": 1, "min_volume_ml": 1.0}, True),
    ],
)
def test_components_are_told_apart_only_where_a_setting_needs_them(settings: dict, selects: bool) -> None:
    assert MeshSettings(**settings).selects is selects


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_preset_has_a_whole_number_of_hu_in_the_range_of_ct(name: str) -> None:
    iso_value = find_iso_preset(name).iso_value

    assert MeshSettings(preset=name).levels == (iso_value,)
    assert iso_value == int(iso_value)
    air_hu, highest_of_12_bits_hu = -1000, 3071
    assert air_hu < iso_value < highest_of_12_bits_hu


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_preset_has_its_name_a_description_and_a_source(name: str) -> None:
    preset = find_iso_preset(name)

    assert preset.name == name
    assert preset.description
    assert preset.source


def test_default_preset_is_low_enough_for_thin_cortex() -> None:
    # Thin vertebral cortex in slices of 4 mm needs 150 to 200 HU.
    assert 150 <= PRESETS[DEFAULT_PRESET].iso_value <= 200


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"iso_value": 3.0, "preset": "bone"}, "not both"),
        ({"iso_value": math.nan}, "finite"),
        ({"iso_value": -math.inf}, "finite"),
        ({"preset": "Bon"}, "unknown preset 'Bon'"),
        ({"seeds": [(1.0, 2.0)]}, "point of three numbers"),
        ({"seeds": [(1.0, 2.0, math.inf)]}, "point of three numbers"),
        ({"space": "world"}, "unknown space 'world'"),
        ({"topology": "manifold"}, "no topology 'manifold'"),
        ({"topology": "trilinear", "labels": LabelChoice("map.nii")}, "leave it out with labels"),
        ({"keep_largest": 0}, "1 or more, not 0"),
        ({"min_volume_ml": 0.0}, "above 0 ml"),
        ({"min_volume_ml": math.nan}, "above 0 ml"),
        ({"iso_value": (200.0, math.nan)}, "finite"),
        ({"iso_value": (200.0, 350.0, 200)}, "200 HU is given twice"),
        ({"iso_value": (0.0, -0.0)}, "given twice"),
        ({"iso_value": ()}, "at least one"),
        ({"iso_value": (200.0, 350.0), "preset": "bone"}, "not both"),
    ],
)
def test_impossible_settings_of_a_mesh_are_refused(settings: dict, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        MeshSettings(**settings)
