"""Figures of iso values: the page and a printed line have what was measured, and the measure knows planes and a leg."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.cli.mesh import WHAT_BONE_COSTS
from clrecon.geometry import Volume
from clrecon.mesh import Mesh

import level_peers  # isort: skip
import level_phantoms  # isort: skip
import marked_tables  # isort: skip
import measure_corridors  # isort: skip
import measure_levels  # isort: skip
import measure_prints  # isort: skip
import measure_reconstructions  # isort: skip

PAGE = measure_levels.PAGE.read_text(encoding="utf-8")
FIGURES = json.loads((measure_levels.FIGURES / "phantoms.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", list(measure_levels.tables()))
def test_page_of_iso_values_has_the_table_of_the_recorded_figures(name: str) -> None:
    assert marked_tables.find_table(PAGE, name) == measure_levels.tables()[name]


MEASURED = (measure_reconstructions, measure_corridors, measure_prints)


@pytest.mark.parametrize("measure", MEASURED, ids=lambda module: module.TABLE)
def test_page_has_the_table_that_was_measured(measure: Any) -> None:
    figures = json.loads(measure.FIGURES.read_text(encoding="utf-8"))
    assert marked_tables.find_table(measure.PAGE.read_text(encoding="utf-8"), measure.TABLE) == measure.make_table(
        figures
    )


BIASES = [one["preset"]["bias_mm"] for one in FIGURES if one["group"] not in level_phantoms.NOT_IN_TISSUE]
"""How far the default iso value lies outside the bone, for the phantoms with soft tissue."""


def test_printed_line_on_the_default_iso_value_has_its_least_and_largest_measured_error() -> None:
    assert re.findall(r"\d\.\d", WHAT_BONE_COSTS) == [f"{min(BIASES):.1f}", f"{max(BIASES):.1f}"]


def test_page_of_iso_values_has_the_least_and_largest_measured_error_of_the_default() -> None:
    assert f"{min(BIASES):.2f} to {max(BIASES):.2f} mm outside the bone" in " ".join(PAGE.split())


def test_recorded_figures_are_of_the_phantoms_of_the_script() -> None:
    assert [one["name"] for one in FIGURES] == [phantom.name for phantom in level_phantoms.PHANTOMS]


@pytest.fixture
def two_profiles() -> Any:
    """HU along the normals of a plane: a ramp of 200 HU a mm through 500 HU, and a wall of 1 mm with 300 HU."""
    way_mm = level_phantoms.Profiles(np.empty((0, 0), np.float32)).way_mm
    ramp = np.clip(500.0 - 200.0 * way_mm, 0.0, 1000.0)
    wall = np.where(np.abs(way_mm) < 0.5, 300.0, 0.0)
    return level_phantoms.Profiles(np.stack((ramp, wall)).astype(np.float32))


@pytest.mark.parametrize(
    ("iso_value", "ramp_mm", "wall_mm"),
    [
        pytest.param(500.0, 0.0, np.nan, id="half way up the ramp, above the wall"),
        pytest.param(200.0, (500.0 - 200.0) / 200.0, 0.48, id="300 HU below, and in the last step of the wall"),
    ],
)
def test_error_of_a_profile_is_where_it_crosses_the_iso_value(
    two_profiles: Any, iso_value: float, ramp_mm: float, wall_mm: float
) -> None:
    step_mm = 0.04
    np.testing.assert_allclose(two_profiles.errors(iso_value), [ramp_mm, wall_mm], atol=step_mm)


def test_share_of_profiles_that_never_reach_the_iso_value_is_lost(two_profiles: Any) -> None:
    measured = measure_levels.measure_errors(two_profiles, level=500.0)  # above the wall, one of two
    assert (measured["lost_share"], measured["close_share"]) == (0.5, 0.5)


@pytest.fixture(scope="module")
def leg_profiles() -> Any:
    """HU along the normals of the bone of a synthetic leg, which is half way to soft tissue at 725 HU."""
    leg = level_phantoms.Phantom(
        "leg", level_phantoms.BODIES, {"kind": "limb", "size": (96, 96), "slices": 24, "spacing": (1.4, 1.4, 2.0)}
    )
    profiles = level_phantoms.sample_profiles(leg, level_phantoms.draw_phantom(leg))
    assert len(profiles.values) > 500
    return profiles


def test_surface_of_a_leg_half_way_to_soft_tissue_is_that_of_its_bone(leg_profiles: Any) -> None:
    measured = measure_levels.measure_errors(leg_profiles, level=725.0)
    assert abs(measured["bias_mm"]) < 0.06  # measured 0.03, of voxels of 1.4 mm
    assert measured["lost_share"] < 0.01  # measured 0


def test_surface_of_a_leg_at_a_low_iso_value_lies_outside_its_bone(leg_profiles: Any) -> None:
    assert measure_levels.measure_errors(leg_profiles, level=200.0)["bias_mm"] > 0.5  # measured 0.95


def test_mesh_is_met_where_it_crosses_the_true_normals_in_their_direction() -> None:
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


def test_vertices_go_to_half_the_height_of_their_own_profiles() -> None:
    edge = np.array([1000, 1000, 1000, 1000, 1000, 700, 200, 0, 0, 0, 0, 0], np.int16)  # half of 1000 HU: x = 5.4
    wall = np.array([0, 0, 0, 0, 300, 600, 300, 0, 0, 0, 0, 0], np.int16)  # half of 600 HU: x = 6
    volume = Volume(np.stack([[edge, edge], [wall, wall]]), np.eye(4))
    vertices = np.array([[6.5, 0.0, 0.0], [6.3, 0.0, 1.0], [6.5, 1.0, 0.0]], np.float32)
    surface = Mesh(vertices, np.array([[0, 1, 2]], np.uint32), np.tile(np.float32([1.0, 0.0, 0.0]), (3, 1)))
    moved = level_peers.move_to_half_heights(surface, volume)
    np.testing.assert_allclose(moved, [[5.4, 0.0, 0.0], [6.0, 0.0, 1.0], [5.4, 1.0, 0.0]], atol=1e-4)


def test_surfaces_of_two_reconstructions_are_compared_where_both_are_met() -> None:
    def places(*met: float) -> measure_reconstructions.Places:
        surfaces = dict.fromkeys(measure_reconstructions.RULES, np.array(met))
        return measure_reconstructions.Places(surfaces, stated=np.full(4, 0.1), is_within=np.ones(4, bool))

    one, other = places(0.0, 0.1, np.nan, 0.5), places(0.1, 0.1, 0.2, 0.1)  # 0.1, 0 and 0.4 mm apart, and one lost
    measured = measure_reconstructions.compare(one, other)["fitted"]
    assert measured["median_mm"] == 0.1
    assert measured["lost_share"] == 1 / 4
    # 1.96 times the error of a difference, 0.1 times the root of 2, is 0.28 mm.
    assert measured["within_196_errors"] == pytest.approx(2 / 3, abs=1e-4)


MARKED = "a\n<!-- x: made by me -->\nold\n<!-- end of x -->\nb"


def test_table_is_put_between_its_markers_in_place_of_the_old_one() -> None:
    assert marked_tables.find_table(MARKED, "x") == "old"
    assert marked_tables.put_table(MARKED, "x", "new") == MARKED.replace("old", "new")


def test_table_without_its_markers_is_refused() -> None:
    with refused(ValueError, 0, "tables", "'y'"):  # none has that mark
        marked_tables.put_table(MARKED, "y", "new")
