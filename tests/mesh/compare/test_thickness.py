"""Thickness of walls where it is known."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances

from clrecon.mesh.compare.distances import WallFigures, cast_walls

pytestmark = pytest.mark.unit

FAR = np.array([-150.25, 1071.5, -846.0])
SLAB_MM = np.array([40.0, 30.0, 2.5])


@pytest.fixture(scope="module")
def slab():
    """Vertices and triangles of a box of 40 x 30 x 2.5 mm."""
    vertices, triangles = samples.box(FAR, size=SLAB_MM)
    return vertices, triangles.astype(np.uint32)


@pytest.mark.parametrize(
    ("length_mm", "area_mm2"), [(2.5, 40 * 30), (30.0, 40 * 2.5), (40.0, 30 * 2.5)], ids=["thin", "short", "long"]
)
def test_a_slab_is_as_thick_as_its_sides_are_apart_over_their_share_of_the_area(slab, length_mm, area_mm2):
    vertices, triangles = slab
    _, _, thickness = cast_walls(vertices, triangles, samples=3000)
    share = np.mean(np.abs(thickness - length_mm) < tolerances.FLOAT64_PLACE_MM)
    half_of_the_area_mm2 = 40 * 30 + 40 * 2.5 + 30 * 2.5
    assert share == pytest.approx(area_mm2 / half_of_the_area_mm2, abs=1 / 3000)  # a sample


def test_samples_of_a_slab_lie_half_their_thickness_from_its_centre_along_their_outward_normal(slab):
    vertices, triangles = slab
    points, normals, thickness = cast_walls(vertices, triangles, samples=3000)
    along_normal = ((points - (FAR + SLAB_MM / 2)) * normals).sum(axis=1)
    np.testing.assert_allclose(along_normal, thickness / 2, atol=tolerances.FLOAT64_PLACE_MM)


def test_wall_thickness_is_the_same_each_time(slab):
    vertices, triangles = slab
    (_, _, first), (_, _, second) = (cast_walls(vertices, triangles, samples=3000) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.fixture(scope="module")
def thickness_of_a_shell():
    """4000 samples of a sphere of 20 mm with a cavity of 18.8 mm, whose wall has 1.2 mm."""
    outer, (inner, inner_faces) = (samples.sphere(FAR, radius=radius, rounds=5) for radius in (20.0, 18.8))
    vertices, triangles = samples.join(outer, (inner, inner_faces[:, ::-1]))
    _, _, thickness = cast_walls(vertices, triangles.astype(np.uint32), samples=4000)
    return thickness


def test_the_wall_of_a_shell_has_its_thickness(thickness_of_a_shell):
    walls = WallFigures.of(thickness_of_a_shell, thin_mm=1.0)
    assert walls["median_mm"] == pytest.approx(20.0 - 18.8, abs=tolerances.SHELL_WALL_MM)
    assert walls["p5_mm"] == pytest.approx(20.0 - 18.8, abs=tolerances.SHELL_WALL_MM)


def test_nearly_every_sample_of_a_closed_shell_is_measured(thickness_of_a_shell):
    walls = WallFigures.of(thickness_of_a_shell, thin_mm=1.0)
    assert walls["samples"] == 4000
    assert walls["not_measured"] < 0.01 * 4000  # rays through edges


@pytest.mark.parametrize(("thin_mm", "share"), [(1.0, 0.0), (1.5, 1.0)])
def test_a_wall_of_1_2_mm_is_thin_below_1_5_mm_and_not_below_1_mm(thickness_of_a_shell, thin_mm, share):
    walls = WallFigures.of(thickness_of_a_shell, thin_mm=thin_mm)
    assert (walls["thin_mm"], walls["thin_share"]) == (thin_mm, share)


def test_an_open_sheet_has_no_wall():
    vertices = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])
    _, _, thickness = cast_walls(vertices, np.array([[0, 1, 2]], np.uint32), samples=50)
    walls = WallFigures.of(thickness, thin_mm=1.0)
    assert (walls["min_mm"], walls["thin_share"], walls["not_measured"]) == (None, None, 50)


THICKNESS_0_TO_100_MM = np.append(np.arange(101.0), [np.nan, np.nan])
"""In steps of 1 mm, each percentile its own number, and two samples that are not measured."""


def test_figures_of_known_thicknesses_are_their_percentiles():
    walls = WallFigures.of(THICKNESS_0_TO_100_MM, thin_mm=25.0)
    assert (walls["min_mm"], walls["p5_mm"], walls["median_mm"]) == (0.0, 5.0, 50.0)


def test_the_share_of_thin_walls_is_that_of_measured_samples_below_the_limit():
    assert WallFigures.of(THICKNESS_0_TO_100_MM, thin_mm=25.0)["thin_share"] == 25 / 101  # 0 to 24 mm


def test_samples_that_are_not_measured_are_counted():
    walls = WallFigures.of(THICKNESS_0_TO_100_MM, thin_mm=25.0)
    assert (walls["samples"], walls["not_measured"]) == (103, 2)
