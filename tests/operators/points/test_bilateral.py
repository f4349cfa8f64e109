"""The filter of points equals its twin, and says how far it moved them."""

from __future__ import annotations

import numpy as np
import pytest
from point_shapes import cube, plane, sphere
from tolerances import FILTER_TRUTH_SHARE, FILTERED_PLANE_MM, TWIN_FILTER_MM
from variants import daily_rows

from clrecon.errors import UsageError
from clrecon.operators.points.denoising import denoise_points
from clrecon.points import PointCloud
from clrecon.points.spacing import VARIATION_OF_FEATURES, distance_ratios, find_features, ratio_threshold
from clrecon.proof.points import clusters as grid_twin
from clrecon.proof.points import neighbours as twin
from clrecon.proof.points.neighbours import find_neighbours, mean_distances, principal_axes


def run_twin(points, k=16, factor=2.0, features=None):
    indices, distances = find_neighbours(points, k)
    axes, eigenvalues = principal_axes(points, indices)
    scales = twin.filter_scales(points, axes, indices, factor)
    factors = twin.bilateral_factors(points, axes, indices, *scales)
    if features is not None:
        edge = np.float32(2.0 * np.median(scales[0]))
        made = grid_twin.make_grid(points, edge)
        cells = np.empty(len(points), np.int64)
        counts = np.diff(made.starts.astype(np.int64))
        cells[made.order] = np.repeat(np.arange(len(counts)), counts)
        if features == "paper":
            ratios = distance_ratios(mean_distances(distances), distances[:, 1], cells)
            kept = find_features(ratios, ratio_threshold(ratios))
        else:
            kept = eigenvalues[:, 0] / eigenvalues.sum(axis=1) > VARIATION_OF_FEATURES
        factors = np.where(kept, factors, twin.cell_factors(points, axes, cells, *scales))
    return points.astype(np.float64) - factors[:, None] * axes


@pytest.mark.parametrize(("shape", "k", "factor"), daily_rows(1, [
    (plane, 16, 2.0), (sphere, 5, 1.5), (cube, 16, 1.0), pytest.param(cube, 32, 1.0, marks=pytest.mark.release),
]))  # fmt: skip
def test_filtered_points_equal_their_twin(device, shape, k, factor):
    points = shape().points
    step = denoise_points(PointCloud(points), k, factor, device=device)
    away = np.abs(step.cloud.points - run_twin(points, k, factor)).max(axis=1)
    _, eigenvalues = principal_axes(points, find_neighbours(points, k)[0])
    clear = (eigenvalues[:, 1] - eigenvalues[:, 0]) / eigenvalues[:, 2] > 0.03  # else the axis is any of a plane
    assert clear.mean() > 0.97
    assert away[clear].max() < TWIN_FILTER_MM


@pytest.mark.parametrize("features", ["paper", "variation"])
def test_points_that_are_no_features_take_their_whole_cell(device, features):
    points = cube(12.0).points
    step = denoise_points(PointCloud(points), features=features, device=device)
    expected = run_twin(points, features=features)
    away = np.abs(step.cloud.points - expected).max(axis=1)
    assert np.mean(away > TWIN_FILTER_MM) < 0.002  # ratios that float32 puts on the other side of D0
    assert 0 < step.facts["feature_points"] < len(points)
    assert np.abs(expected - run_twin(points)).max() > 0.05


def test_paper_mode_is_factor_one_with_its_features(device):
    points = sphere(8.0).points
    paper = denoise_points(PointCloud(points), paper=True, device=device)
    same = denoise_points(PointCloud(points), range_factor=1.0, features="paper", device=device)
    assert np.array_equal(paper.cloud.points, same.cloud.points)
    assert (paper.facts["range_factor"], paper.facts["features"]) == (1.0, "paper")


@pytest.mark.every_device
@pytest.mark.parametrize(("shape", "region", "expected"), [
    (cube, "edges", 0.150),
    pytest.param(plane, "inner", 0.076, marks=pytest.mark.first_device),
    pytest.param(sphere, "everywhere", 0.080, marks=pytest.mark.first_device),
])  # fmt: skip
def test_the_device_reaches_the_truths(device, shape, region, expected):
    truth = shape()
    step = denoise_points(PointCloud(truth.points), device=device)
    assert truth.rms(step.cloud.points, region) == pytest.approx(expected, rel=FILTER_TRUTH_SHARE)


def test_moves_of_filtered_points_are_measured(device):
    points = sphere(8.0).points
    step = denoise_points(PointCloud(points, hu=np.arange(len(points)), normals=points), device=device)
    away = np.linalg.norm(step.cloud.points.astype(np.float64) - points, axis=1)
    assert step.facts["rms_move_mm"] == pytest.approx(np.sqrt((away**2).mean()), rel=1e-4)
    assert step.facts["largest_move_mm"] == pytest.approx(away.max(), rel=1e-4)
    assert step.cloud.normals is None
    assert np.array_equal(step.cloud.hu, np.arange(len(points)))
    assert not step.removed.any()


def test_three_narrow_passes_are_as_strong_as_a_wide_one(device):
    truth = plane()
    thrice = denoise_points(PointCloud(truth.points), 16, 1.0, 3, device=device)
    assert truth.rms(thrice.cloud.points, "inner") == pytest.approx(0.075, rel=FILTER_TRUTH_SHARE)
    assert thrice.facts["iterations"] == 3


def test_a_plane_without_noise_stays(device):
    tilted = plane(20.0).clean @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0].astype(np.float32)
    step = denoise_points(PointCloud(tilted), device=device)
    assert step.facts["largest_move_mm"] < FILTERED_PLANE_MM


def test_equal_points_and_lines_stay(device):
    points = np.r_[np.zeros((40, 3)), np.outer(np.arange(40.0), [1, 1, 0])].astype(np.float32)
    for features in (None, "paper", "variation"):
        step = denoise_points(PointCloud(points), 8, features=features, device=device)
        assert np.array_equal(step.cloud.points, points)


def test_a_shift_changes_nothing_but_rounding(device):
    points = np.round(sphere(8.0).points.astype(np.float64), 3)
    near = denoise_points(PointCloud(points), device=device).cloud.points
    far = denoise_points(PointCloud(points + 1e5), device=device).cloud.points
    assert far.dtype == np.float64
    assert np.abs(far - 1e5 - near).max() < 1e-4


def test_permuted_points_give_permuted_results(device):
    points = sphere(8.0).points
    order = np.random.default_rng(0).permutation(len(points))
    straight = denoise_points(PointCloud(points), device=device).cloud.points
    permuted = denoise_points(PointCloud(points[order]), device=device).cloud.points
    assert np.array_equal(permuted, straight[order])


def test_a_cloud_of_several_parts_is_filtered_as_its_twin(device):
    points = sphere(48.0 if device.has_long_items else 190.0).points
    step = denoise_points(PointCloud(points), 8, device=device)
    assert np.quantile(np.abs(step.cloud.points - run_twin(points, 8)), 0.999) < TWIN_FILTER_MM  # but of unclear axes


@pytest.mark.oclgrind
def test_small_cloud_is_filtered_by_every_kernel(device):
    points = sphere(3.0).points
    step = denoise_points(PointCloud(points), 6, features="variation", device=device)
    assert 0.01 < step.facts["rms_move_mm"] < 1.0


def test_few_points_are_filtered_with_a_warning(device):
    for n in (1, 2, 3, 9):
        step = denoise_points(PointCloud(np.random.default_rng(n).normal(size=(n, 3))), device=device)
        assert len(step.cloud) == n
        assert f"the cloud has {n} points" in step.warnings[0]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"range_factor": 0.0}, "range_factor is a positive number, not 0"),
        ({"range_factor": float("nan")}, "range_factor is a positive number, not nan"),
        ({"range_factor": "2"}, "range_factor is a positive number, not '2'"),
        ({"iterations": 0}, "iterations are a whole number from 1 to 100, not 0"),
        ({"iterations": 1.0}, "iterations are a whole number"),
        ({"features": "edges"}, "features are told by one of paper, variation or not at all, not 'edges'"),
        ({"k": 2}, "from 3 to 128"),
        ({"memory": 0}, "memory is a whole number of bytes"),
    ],
)
def test_wrong_parameters_are_refused(device, wrong, words):
    with pytest.raises(UsageError, match=words):
        denoise_points(PointCloud(np.eye(3)), device=device, **wrong)
