"""Figures of iso values: the page and the printed line say what was measured, and the measure knows a sphere."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from refusals import refused

from clrecon.cli.mesh import WHAT_BONE_COSTS

import level_phantoms  # isort: skip
import marked_tables  # isort: skip
import measure_levels  # isort: skip

PAGE = measure_levels.PAGE.read_text(encoding="utf-8")
FIGURES = json.loads((measure_levels.FIGURES / "phantoms.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", list(measure_levels.tables()))
def test_the_page_has_the_figures(name: str) -> None:
    assert marked_tables.find_table(PAGE, name) == measure_levels.tables()[name]


def test_the_printed_line_says_what_the_default_costs_in_soft_tissue() -> None:
    biases = [one["preset"]["bias_mm"] for one in FIGURES if one["group"] not in level_phantoms.NOT_IN_TISSUE]
    low, high = re.findall(r"\d\.\d", WHAT_BONE_COSTS)
    assert (f"{min(biases):.1f}", f"{max(biases):.1f}") == (low, high)
    assert f"{min(biases):.2f} to {max(biases):.2f} mm outside the bone" in PAGE


def test_figures_are_of_the_phantoms_that_are_there() -> None:
    assert [one["name"] for one in FIGURES] == [phantom.name for phantom in level_phantoms.PHANTOMS]


def test_profiles_across_a_plane_have_known_errors() -> None:
    way = level_phantoms.Profiles(np.empty((0, 0), np.float32)).way_mm
    ramp = np.clip(500.0 - 200.0 * way, 0.0, 1000.0)  # half way at 0, 200 HU a mm
    step = np.where(np.abs(way) < 0.5, 300.0, 0.0)  # a thin wall that never reaches 400
    profiles = level_phantoms.Profiles(np.stack((ramp, step)).astype(np.float32))
    np.testing.assert_allclose(profiles.errors(500.0), [0.0, np.nan], atol=1e-4)
    np.testing.assert_allclose(profiles.errors(200.0), [1.5, 0.48], atol=0.04)
    measured = measure_levels.measure_errors(profiles, 500.0)
    assert (measured["lost_share"], measured["close_share"]) == (0.5, 0.5)


def test_profiles_of_a_leg_are_level_with_its_bone() -> None:
    leg = level_phantoms.Phantom(
        "leg", level_phantoms.BODIES, {"kind": "limb", "size": (96, 96), "slices": 24, "spacing": (1.4, 1.4, 2.0)}
    )
    volume = level_phantoms.draw_phantom(leg)
    profiles = level_phantoms.sample_profiles(leg, volume)
    measured = measure_levels.measure_errors(profiles, 725.0)
    assert len(profiles.values) > 500 and abs(measured["bias_mm"]) < 0.15 and measured["lost_share"] < 0.05
    assert measure_levels.measure_errors(profiles, 200.0)["bias_mm"] > 0.5


def test_a_mesh_is_met_where_it_crosses_the_true_normals() -> None:
    corners = np.array(
        [[0.0, 0.0, 0.4], [9.0, 0.0, 0.4], [0.0, 9.0, 0.4], [0.0, 0.0, -1.0], [9.0, 0.0, -1.0], [0.0, 9.0, -1.0]]
    )
    triangles = np.array([[0, 1, 2], [3, 4, 5], [3, 5, 4]], np.uint32)  # two face up, the last one down
    points = np.array([[1.0, 1.0, 0.0], [1.0, 2.0, -1.1], [8.0, 8.0, 0.0]])
    profiles = level_phantoms.Profiles(
        np.empty((3, 0), np.float32), points=points, normals=np.tile([0.0, 0.0, 1.0], (3, 1))
    )
    errors, rows = level_phantoms.find_on_mesh(profiles, corners, triangles)
    np.testing.assert_allclose(errors, [0.4, 0.1, np.nan], atol=1e-6)
    assert rows.tolist() == [0, 1, -1]


def test_tables_need_their_markers() -> None:
    text = "a\n<!-- x: made by me -->\nold\n<!-- end of x -->\nb"
    assert marked_tables.find_table(marked_tables.put_table(text, "x", "new"), "x") == "new"
    with refused(ValueError, 0, "tables"):
        marked_tables.put_table(text, "y", "new")
