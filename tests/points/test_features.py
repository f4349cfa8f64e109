"""Paper B's ratio of distances on known clouds, and what it does not see."""

from __future__ import annotations

import numpy as np
import pytest
from point_shapes import cube, plane, sphere
from scipy.stats import rankdata

from clrecon.points.spacing import D0_OF_MEDIAN, VARIATION_OF_FEATURES, distance_ratios, find_features, ratio_threshold
from clrecon.proof.points.neighbours import find_neighbours, mean_distances, principal_axes


def ratios_of(points, k=16):
    """D_i over cells of twice the median distance to the kth neighbour."""
    _, distances = find_neighbours(points, k)
    edge = 2.0 * np.median(distances[:, -1])
    steps = np.floor((points - points.min(axis=0) + 1e-3 * edge) / edge).astype(np.int64)
    cells = np.unique(steps, axis=0, return_inverse=True)[1].ravel()
    return distance_ratios(mean_distances(distances), distances[:, 1], cells)


def area_under_curve(scores, wanted):
    """Chance that a wanted point has a higher score than another one; 0.5 is blind."""
    ranks, count = rankdata(scores), wanted.sum()
    return (ranks[wanted].sum() - count * (count + 1) / 2) / (count * (len(scores) - count))


def test_distance_ratios_of_a_small_cloud_are_those_by_hand():
    means, nearest = np.array([2.0, 3.0, 1.0, 8.0]), np.array([1.0, 2.0, 0.5, 4.0])
    ratios = distance_ratios(means, nearest, np.array([0, 0, 2, 2]))
    assert ratios.tolist() == [2.0 / 1.5, 3.0 / 1.5, 1.0 / 2.25, 8.0 / 2.25]
    assert ratio_threshold(ratios) == pytest.approx(D0_OF_MEDIAN * np.median(ratios))


def test_point_at_the_threshold_is_no_feature():
    assert find_features(np.array([1.0, 2.0, 2.0000001]), 2.0).tolist() == [False, False, True]


def test_cells_of_equal_points_have_no_spacing():
    ratios = distance_ratios(np.array([1.0, 0.0]), np.zeros(2), np.zeros(2, int))
    assert ratios.tolist() == [np.inf, 0.0]


@pytest.mark.parametrize("shape", [plane, sphere, cube])
def test_the_median_is_the_same_whatever_the_shape(shape):
    truth = shape()
    assert 2.4 < np.median(ratios_of(truth.points)) < 3.1
    assert 2.4 < np.median(ratios_of(truth.clean)) < 3.1


def test_distance_ratio_misses_edges_and_the_variation_finds_them():
    truth = cube()
    edges = truth.regions["edges"]
    assert 0.35 < area_under_curve(ratios_of(truth.points), edges) < 0.5
    for points, least in ((truth.points, 0.88), (truth.clean, 0.98)):
        _, eigenvalues = principal_axes(points, find_neighbours(points, 16)[0])
        variation = eigenvalues[:, 0] / eigenvalues.sum(axis=1)
        assert area_under_curve(variation, edges) > least
    assert np.mean(variation[edges] > VARIATION_OF_FEATURES) > 0.4
    assert np.mean(variation[truth.regions["faces"]] > VARIATION_OF_FEATURES) == 0.0
