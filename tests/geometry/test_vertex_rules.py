"""Rules of vertices: each equation by itself, and what the rules are worth on a sphere."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry.vertices import (
    GOLDEN,
    check_vertex_rule,
    cubic_value,
    golden_fraction,
    linear_fraction,
    normal_on_edge,
    point_on_edge,
    search_fraction,
)


def test_the_golden_section_divides_as_the_whole() -> None:
    assert GOLDEN == pytest.approx((np.sqrt(5.0) - 1.0) / 2.0, abs=5e-8)
    assert GOLDEN**2 + GOLDEN == pytest.approx(1.0, abs=2e-7)
    assert (golden_fraction(np.array([3.0, -7.0])) == GOLDEN).all()


@pytest.mark.parametrize(
    ("axis", "expected"), [(0, (4.618034, 5.0, 6.0)), (1, (4.0, 5.618034, 6.0)), (2, (4.0, 5.0, 6.618034))]
)
def test_points_are_those_of_equations_6_to_8(axis: int, expected: tuple[float, float, float]) -> None:
    assert point_on_edge((4.0, 5.0, 6.0), axis, GOLDEN) == pytest.approx(expected, abs=1e-7)
    assert point_on_edge([(0, 0, 0), (1, 1, 1)], axis, np.array([0.25, 0.5]))[:, axis].tolist() == [0.25, 1.5]


def test_normals_are_those_of_equations_9_to_11() -> None:
    here = np.array([[1.0, 2.0, 3.0]])
    there = np.array([[2.0, 0.0, 3.5]])  # the corner at x + 1 of eq. 9, y + 1 of eq. 10, z + 1 of eq. 11
    assert normal_on_edge(here, there, [GOLDEN])[0] == pytest.approx((1.618034, 0.763932, 3.309017), abs=1e-6)
    assert normal_on_edge(here, there, [0.0])[0].tolist() == [1.0, 2.0, 3.0]
    assert normal_on_edge(here, there, [1.0])[0].tolist() == [2.0, 0.0, 3.5]


def test_linear_fraction_is_that_of_the_crossing() -> None:
    assert linear_fraction([0.0, 10.0], [4.0, -10.0], 3.0).tolist() == [0.75, 0.35]


def test_the_cubic_goes_through_its_values_and_is_exact_for_parabolas() -> None:
    t = np.linspace(0.0, 1.0, 11)

    def parabola(x: float | np.ndarray) -> np.ndarray:
        return np.asarray(2.0 - 3.0 * x + 0.5 * x**2)

    found = cubic_value(parabola(-1.0), parabola(0.0), parabola(1.0), parabola(2.0), t)
    assert found == pytest.approx(parabola(t), abs=1e-12)


def test_the_search_finds_the_crossing_of_the_cubic() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.uniform(-5, 5, 500), rng.uniform(-5, 5, 500)
    first, last = rng.uniform(-4, 0, 500), rng.uniform(0.1, 4, 500)
    turned = rng.random(500) < 0.5
    first, last = np.where(turned, last, first), np.where(turned, first, last)
    t = search_fraction(before, first, last, after, 0.05)
    assert ((t > 0.0) & (t < 1.0)).all()
    steepest = 20.0  # of these cubics; the last part of an edge is 1e-5 of it
    assert np.abs(cubic_value(before, first, last, after, t) - 0.05).max() < steepest * 1e-5
    straight = search_fraction(-1.0, np.zeros(3), np.ones(3), 2.0, np.array([0.1, 0.5, 0.9]))
    assert straight == pytest.approx([0.1, 0.5, 0.9], abs=1e-5)


def _sphere_error(fraction: str) -> float:
    """Root mean square distance of vertices from a ball of 10 voxels, blurred as partial volume and a scanner do."""
    from scipy.ndimage import gaussian_filter

    fine = (np.indices((96, 96, 96)).reshape(3, -1) - 47.5) / 4.0
    ball = (np.linalg.norm(fine, axis=0) < 10.0).reshape(96, 96, 96).astype(float)
    field = gaussian_filter(ball, 4 * 0.5).reshape(24, 4, 24, 4, 24, 4).mean(axis=(1, 3, 5))
    before, value, after, last = field[:, :, 1:-2], field[:, :, 1:-2], field[:, :, 2:-1], field[:, :, 3:]
    before = field[:, :, :-3]
    crossed = (value >= 0.5) != (after >= 0.5)
    four = [part[crossed] for part in (before, value, after, last)]
    t = {
        "linear": lambda: linear_fraction(four[1], four[2], 0.5),
        "golden": lambda: golden_fraction(four[1]),
        "golden-search": lambda: search_fraction(four[0], four[1], four[2], four[3], 0.5),
    }[fraction]()
    k, j, i = (np.argwhere(crossed) + (0, 0, 1)).T
    away = np.linalg.norm(np.stack([k - 11.5, j - 11.5, i + t - 11.5]), axis=0) - 10.0
    return float(np.sqrt((away**2).mean()))


ACCURACY_VOXEL = 0.1
"""Bar for a rule that follows the values: half of what the golden constant misses; linear has 0.03 here."""

SEARCH_VOXEL = 0.03
"""Difference of the rules that follow the values."""


def test_the_golden_constant_fails_the_bar_that_both_other_rules_pass() -> None:
    error = {rule: _sphere_error(rule) for rule in ("linear", "golden", "golden-search")}
    assert error["linear"] < ACCURACY_VOXEL and error["golden-search"] < ACCURACY_VOXEL
    assert error["golden"] > 2.0 * ACCURACY_VOXEL
    assert abs(error["linear"] - error["golden-search"]) < SEARCH_VOXEL


def test_unknown_rules_and_those_of_the_trilinear_field_are_refused() -> None:
    check_vertex_rule("golden")
    with refused(UsageError, "vertex_rule", "midpoint"):
        check_vertex_rule("midpoint")
    with refused(UsageError, "golden-search", "trilinear"):
        check_vertex_rule("golden-search", "trilinear")
