"""The filter of points equals its twin, and says how far it moved them."""

from __future__ import annotations

import numpy as np
import pytest
from point_shapes import cube, plane, sphere
from tolerances import FILTER_TRUTH_SHARE, FILTERED_PLANE_MM, TWIN_FILTER_MM
from variants import daily_rows

from clrecon.errors import UsageError
from clrecon.operators.points.denoising import denoise_points
from clrecon.points.cloud import PointCloud
from clrecon.points.spacing import VARIATION_OF_FEATURES, distance_ratios, find_features, ratio_threshold
from clrecon.proof.points import clusters as grid_twin
from clrecon.proof.points import neighbours as twin
from clrecon.proof.points.neighbours import find_neighbours, mean_distances, principal_axes


def filter_by_twin(points, *, k=16, factor=2.0, features=None):
    """Return the points that `denoise_points` has to give with the same parameters, shape (n, 3)."""
    indices, distances = find_neighbours(points, k)
    axes, eigenvalues = principal_axes(points, indices)
    scales = twin.filter_scales(points, axes, indices, factor)
    factors = twin.bilateral_factors(points, axes, indices, *scales)
    if features is not None:
        edge = np.float32(2.0 * np.median(scales[0]))
        grid = grid_twin.make_grid(points, edge)
        cells = np.empty(len(points), np.int64)
        counts = np.diff(grid.starts.astype(np.int64))
        cells[grid.order] = np.repeat(np.arange(len(counts)), counts)
        if features == "paper":
            ratios = distance_ratios(mean_distances(distances), distances[:, 1], cells)
            is_feature = find_features(ratios, ratio_threshold(ratios))
        else:
            is_feature = eigenvalues[:, 0] / eigenvalues.sum(axis=1) > VARIATION_OF_FEATURES
        factors = np.where(is_feature, factors, twin.cell_factors(points, axes, cells, *scales))
    return points.astype(np.float64) - factors[:, None] * axes


@pytest.mark.parametrize(("shape", "k", "factor"), daily_rows(1, [
    (plane, 16, 2.0), (sphere, 5, 1.5), (cube, 16, 1.0), pytest.param(cube, 32, 1.0, marks=pytest.mark.release),
]))  # fmt: skip
def test_filtered_points_equal_their_twin(device, shape, k, factor):
    points = shape().points
    step = denoise_points(PointCloud(points), k=k, range_factor=factor, device=device)
    away = np.abs(step.cloud.points - filter_by_twin(points, k=k, factor=factor)).max(axis=1)

    # Where the two smaller eigenvalues are nearly equal, the normal is any direction of a plane.
    indices, _ = find_neighbours(points, k)
    _, eigenvalues = principal_axes(points, indices)
    has_normal = (eigenvalues[:, 1] - eigenvalues[:, 0]) / eigenvalues[:, 2] > 0.03
    assert has_normal.mean() > 0.97  # measured 1
    assert away[has_normal].max() < TWIN_FILTER_MM


@pytest.mark.parametrize("features", ["paper", "variation"])
def test_points_that_are_no_features_are_filtered_by_their_whole_cell_as_by_the_twin(device, features):
    points = cube(size=12.0).points
    step = denoise_points(PointCloud(points), features=features, device=device)
    expected = filter_by_twin(points, features=features)
    away = np.abs(step.cloud.points - expected).max(axis=1)
    assert np.mean(away > TWIN_FILTER_MM) < 0.002  # ratios that float32 puts on the other side of the threshold
    assert 0 < step.facts["feature_points"] < len(points)
    by_neighbours_alone = filter_by_twin(points)
    # In mm; measured 0.33.
    assert np.abs(expected - by_neighbours_alone).max() > 0.05, "the choice of features does nothing here"


def test_paper_mode_is_range_factor_one_with_the_features_of_the_paper(device):
    points = sphere(radius=8.0).points
    paper = denoise_points(PointCloud(points), paper=True, device=device)
    same = denoise_points(PointCloud(points), range_factor=1.0, features="paper", device=device)
    assert np.array_equal(paper.cloud.points, same.cloud.points)
    assert (paper.facts["range_factor"], paper.facts["features"]) == (1.0, "paper")


@pytest.mark.every_device
@pytest.mark.parametrize(("shape", "region", "measured_rms_mm"), [
    (cube, "edges", 0.150),
    pytest.param(plane, "inner", 0.076, marks=pytest.mark.first_device),
    pytest.param(sphere, "everywhere", 0.080, marks=pytest.mark.first_device),
])  # fmt: skip
def test_filtered_points_lie_nearer_to_their_shape_than_the_noise_of_0p2_mm(device, shape, region, measured_rms_mm):
    noisy = shape()
    step = denoise_points(PointCloud(noisy.points), device=device)
    assert noisy.rms(step.cloud.points, region) == pytest.approx(measured_rms_mm, rel=FILTER_TRUTH_SHARE)


@pytest.fixture(scope="module")
def filtered_sphere(device):
    """A sphere of 8 mm with HU and normals, and what the filter makes of it."""
    points = sphere(radius=8.0).points
    cloud = PointCloud(points, hu=np.arange(len(points)), normals=points)
    return cloud, denoise_points(cloud, device=device)


def test_moves_of_filtered_points_are_reported(filtered_sphere):
    cloud, step = filtered_sphere
    moves = np.linalg.norm(step.cloud.points.astype(np.float64) - cloud.points, axis=1)
    assert step.facts["rms_move_mm"] == pytest.approx(np.sqrt((moves**2).mean()), rel=1e-6)  # measured 2e-9
    assert step.facts["largest_move_mm"] == pytest.approx(moves.max(), rel=1e-6)  # float32; measured 1e-8


def test_filtered_points_keep_their_hu_and_lose_their_normals(filtered_sphere):
    cloud, step = filtered_sphere
    assert np.array_equal(step.cloud.hu, cloud.hu)
    assert step.cloud.normals is None


def test_no_point_is_removed_by_the_filter(filtered_sphere):
    cloud, step = filtered_sphere
    assert not step.removed.any()
    assert len(step.cloud) == len(cloud)


def test_three_passes_of_range_factor_one_leave_as_little_noise_as_one_of_two(device):
    noisy = plane()
    thrice = denoise_points(PointCloud(noisy.points), range_factor=1.0, iterations=3, device=device)
    measured_rms_mm = 0.075  # and 0.076 by one pass of factor 2, the default
    assert noisy.rms(thrice.cloud.points, "inner") == pytest.approx(measured_rms_mm, rel=FILTER_TRUTH_SHARE)
    assert thrice.facts["iterations"] == 3


def test_points_of_a_tilted_plane_without_noise_stay(device):
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    step = denoise_points(PointCloud(plane(size=20.0).clean @ turn.astype(np.float32)), device=device)
    assert step.facts["largest_move_mm"] < FILTERED_PLANE_MM


@pytest.mark.parametrize("features", [None, "paper", "variation"])
def test_equal_points_and_points_of_a_line_stay(device, features):
    equal, line = np.zeros((40, 3)), np.outer(np.arange(40.0), [1, 1, 0])
    points = np.r_[equal, line].astype(np.float32)
    step = denoise_points(PointCloud(points), k=8, features=features, device=device)
    assert np.array_equal(step.cloud.points, points)


def test_shifted_cloud_is_filtered_alike_except_for_rounding(device):
    shift = 1e5
    points = np.round(sphere(radius=8.0).points.astype(np.float64), 3)
    near = denoise_points(PointCloud(points), device=device).cloud.points
    far = denoise_points(PointCloud(points + shift), device=device).cloud.points
    assert far.dtype == np.float64
    assert np.abs(far - shift - near).max() < 2e-6  # float32 relative to the cloud's middle; measured 8e-7


def test_permuted_points_give_permuted_results(device):
    points = sphere(radius=8.0).points
    order = np.random.default_rng(0).permutation(len(points))
    straight = denoise_points(PointCloud(points), device=device).cloud.points
    permuted = denoise_points(PointCloud(points[order]), device=device).cloud.points
    assert np.array_equal(permuted, straight[order])


def test_a_cloud_of_several_parts_is_filtered_as_its_twin(device):
    """A kernel takes a part of a large cloud at a time; devices without long work-items take larger parts."""
    points = sphere(radius=48.0 if device.has_long_items else 190.0).points
    step = denoise_points(PointCloud(points), k=8, device=device)
    away = np.abs(step.cloud.points - filter_by_twin(points, k=8))
    assert np.quantile(away, 0.999) < TWIN_FILTER_MM  # others have two nearly equal eigenvalues


@pytest.mark.oclgrind
def test_points_of_a_small_cloud_are_moved_less_than_a_millimetre(device):
    points = sphere(radius=3.0).points
    step = denoise_points(PointCloud(points), k=6, features="variation", device=device)
    assert 0.01 < step.facts["rms_move_mm"] < 1.0  # noise of 0.2 mm


@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_few_points_are_filtered_with_a_warning(device, n):
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
def test_wrong_parameters_of_the_filter_of_points_are_refused(device, wrong, words):
    with pytest.raises(UsageError, match=words):
        denoise_points(PointCloud(np.eye(3)), device=device, **wrong)
