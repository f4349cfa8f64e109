"""The mean spacing of clouds."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances

from clrecon.points.spacing import count_cells, find_cell_numbers, mean_spacing


def lattice(*counts: int, step: float = 0.7) -> np.ndarray:
    axes = np.meshgrid(*(step * np.arange(count) for count in counts), indexing="ij")
    return np.stack(axes, axis=-1).reshape(-1, 3).astype(np.float32)


def test_mean_spacing_of_lattices_and_balls_is_the_known_one() -> None:
    assert mean_spacing(lattice(90, 80, 1)) == pytest.approx(0.7, rel=tolerances.MEAN_SPACING)
    assert mean_spacing(lattice(1, 200, 300)) == pytest.approx(0.7, rel=tolerances.MEAN_SPACING)
    assert 0.7 * 0.7 < mean_spacing(lattice(30, 40, 30)) < 0.7
    ball = np.random.default_rng(1).normal(size=(40_000, 3))
    ball *= 20.0 / np.linalg.norm(ball, axis=1)[:, None]
    truth = np.sqrt(4.0 * np.pi * 400.0 / 40_000)
    assert mean_spacing(ball.astype(np.float32)) == pytest.approx(truth, rel=tolerances.MEAN_SPACING)
    assert mean_spacing(ball + 1e5) == pytest.approx(truth, rel=tolerances.MEAN_SPACING)
    outlier = np.concatenate([ball, [(2000.0, 2000.0, 2000.0)]])
    assert 0.5 * truth < mean_spacing(outlier) < 2.0 * truth


def test_clouds_without_extent_have_a_spacing_of_zero() -> None:
    assert mean_spacing(np.empty((0, 3))) == 0.0
    assert mean_spacing(np.ones((1, 3))) == 0.0
    assert mean_spacing(np.ones((9, 3))) == 0.0
    assert 0.1 < mean_spacing(np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])) <= 1.0
    assert 0.0 < mean_spacing(np.array([(0.0, 0.0, 0.0), (1e6, 1e6, 1e6)])) <= 1e6
    assert 0.5 < mean_spacing(lattice(1000, 1, 1, step=1.0)) < 4.0


def test_cells_of_three_points_are_those_by_hand() -> None:
    points = np.array([(11.0, 22.0, 33.0), (10.0, 20.0, 30.0), (10.5, 21.2, 31.0)])
    assert count_cells(points, 1.0) == (2, 3, 4) and count_cells(points, 2.0) == (1, 2, 2)
    assert find_cell_numbers(points, 1.0).tolist() == [1 + 2 * (2 + 3 * 3), 0, 2 * (1 + 3)]
