"""Thickness of walls where it is known."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh.compare.distances import WallFigures, cast_walls

pytestmark = pytest.mark.unit

FAR = np.array([-150.25, 1071.5, -846.0])


def shell(outer: float, inner: float) -> samples.Arrays:
    out, within = samples.sphere(FAR, outer, 5), samples.sphere(FAR, inner, 5)
    return samples.join(out, (within[0], within[1][:, ::-1]))


def test_a_slab_is_as_thick_as_it_is():
    vertices, triangles = samples.box(FAR, (40.0, 30.0, 2.5))
    points, normals, thickness = cast_walls(vertices, triangles.astype(np.uint32), 3000)
    sides = np.array([[40.0 * 30, 2.5], [40 * 2.5, 30.0], [30 * 2.5, 40.0]])
    for area, length in sides:
        share = np.mean(np.abs(thickness - length) < 1e-9 * 1e6)
        assert share == pytest.approx(area / sides[:, 0].sum(), abs=0.01)
    np.testing.assert_allclose(((points - FAR - (20.0, 15.0, 1.25)) * normals).sum(axis=1), 0.5 * thickness, atol=1e-9)
    np.testing.assert_array_equal(thickness, cast_walls(vertices, triangles.astype(np.uint32), 3000)[2])


def test_wall_of_a_shell_has_its_thickness():
    vertices, triangles = shell(20.0, 18.8)
    thickness = cast_walls(vertices, triangles.astype(np.uint32), 4000)[2]
    found = WallFigures.of(thickness, 1.0)
    assert found["median_mm"] == pytest.approx(1.2, abs=0.03)
    assert found["p5_mm"] == pytest.approx(1.2, abs=0.05)
    assert (found["thin_share"], found["thin_mm"], found["samples"]) == (0.0, 1.0, 4000)
    assert found["not_measured"] < 40
    assert WallFigures.of(thickness, 1.5)["thin_share"] > 0.99


def test_an_open_sheet_has_no_wall():
    vertices = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])
    found = WallFigures.of(cast_walls(vertices, np.array([[0, 1, 2]], np.uint32), 50)[2], 1.0)
    assert (found["min_mm"], found["thin_share"], found["not_measured"]) == (None, None, 50)


def test_figures_of_known_thicknesses_are_their_percentiles():
    """From 0 to 100 mm in steps of 1 mm: each percentile is its own number."""
    lengths = np.append(np.arange(101.0), [np.nan, np.nan])
    found = WallFigures.of(lengths, 25.0)
    assert (found["min_mm"], found["p5_mm"], found["median_mm"]) == (0.0, 5.0, 50.0)
    assert (found["thin_share"], found["samples"], found["not_measured"]) == (25 / 101, 103, 2)
