"""The mean spacing of clouds."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances

from clrecon.points.spacing import count_cells, find_cell_numbers, mean_spacing


def lattice(*counts: int, step: float) -> np.ndarray:
    axes = np.meshgrid(*(step * np.arange(count) for count in counts), indexing="ij")
    return np.stack(axes, axis=-1).reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize("counts", [(90, 80, 1), (1, 200, 300)], ids=["across z", "across x"])
def test_the_spacing_of_a_flat_lattice_is_its_step(counts: tuple[int, int, int]) -> None:
    assert mean_spacing(lattice(*counts, step=0.7)) == pytest.approx(0.7, rel=tolerances.MEAN_SPACING)


def test_the_spacing_of_a_solid_lattice_is_less_than_its_step() -> None:
    """It is that of the surface that as many points would cover."""
    step = 0.7
    assert 0.7 * step < mean_spacing(lattice(30, 40, 30, step=step)) < step  # measured 0.84 of it


BALL_POINTS = 40_000
BALL_SPACING = np.sqrt(4.0 * np.pi * 20.0**2 / BALL_POINTS)
"""The side of the square that a point has of a sphere of 20 mm."""


@pytest.fixture(scope="module")
def ball() -> np.ndarray:
    """Random points on a sphere of 20 mm."""
    directions = np.random.default_rng(1).normal(size=(BALL_POINTS, 3))
    return 20.0 * directions / np.linalg.norm(directions, axis=1)[:, None]


def test_the_spacing_on_a_sphere_is_the_root_of_the_area_of_a_point(ball: np.ndarray) -> None:
    assert mean_spacing(ball.astype(np.float32)) == pytest.approx(BALL_SPACING, rel=tolerances.MEAN_SPACING)


def test_the_spacing_far_from_the_origin_is_the_same(ball: np.ndarray) -> None:
    assert mean_spacing(ball + 1e5) == pytest.approx(BALL_SPACING, rel=tolerances.MEAN_SPACING)


def test_a_point_2_m_away_changes_the_spacing_by_less_than_a_factor_of_two(ball: np.ndarray) -> None:
    with_outlier = np.concatenate([ball, [(2000.0, 2000.0, 2000.0)]])
    assert 0.5 * BALL_SPACING < mean_spacing(with_outlier) < 2.0 * BALL_SPACING  # measured 0.85 of it


@pytest.mark.parametrize(
    "points", [np.empty((0, 3)), np.ones((1, 3)), np.ones((9, 3))], ids=["none", "one", "nine at one place"]
)
def test_points_without_extent_have_a_spacing_of_zero(points: np.ndarray) -> None:
    assert mean_spacing(points) == 0.0


@pytest.mark.parametrize(
    ("points", "least", "most"),
    [
        (np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]), 0.1, 1.0),
        (np.array([(0.0, 0.0, 0.0), (1e6, 1e6, 1e6)]), 1e-9, 1e6),
        (lattice(1000, 1, 1, step=1.0), 0.5, 4.0),
    ],
    ids=["two points 1 mm apart", "two points 1.7 km apart", "a line of points 1 mm apart"],
)
def test_the_spacing_of_points_on_a_line_is_of_the_order_of_their_distance(
    points: np.ndarray, least: float, most: float
) -> None:
    assert least < mean_spacing(points) <= most


POINTS_FROM_THE_LOWEST = np.array([(1.0, 2.0, 3.0), (0.0, 0.0, 0.0), (0.5, 1.2, 1.0)])


@pytest.mark.parametrize(("edge", "cells"), [(1.0, (2, 3, 4)), (2.0, (1, 2, 2))])
def test_cells_along_each_axis_are_counted_from_the_lowest_coordinates(
    edge: float, cells: tuple[int, int, int]
) -> None:
    assert count_cells(POINTS_FROM_THE_LOWEST + (10.0, 20.0, 30.0), edge) == cells


def test_cells_are_numbered_along_x_then_y_then_z() -> None:
    """Of 2 x 3 x 4 cells: the points lie in (1, 2, 3), (0, 0, 0) and (0, 1, 1)."""
    numbers = find_cell_numbers(POINTS_FROM_THE_LOWEST + (10.0, 20.0, 30.0), 1.0)
    assert numbers.tolist() == [1 + 2 * (2 + 3 * 3), 0, 0 + 2 * (1 + 3 * 1)]
