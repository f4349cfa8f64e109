"""The twins of the point filter reach known figures on shapes with noise, in bands of 10 %."""

from __future__ import annotations

import numpy as np
import pytest
from point_shapes import cube, plane, sphere
from tolerances import FILTER_TRUTH_SHARE, FILTERED_PLANE_MM

from clrecon.proof.points.neighbours import denoise_points, find_neighbours, principal_axes

# shape, region, figure, before, k 16 factor 1, k 16 factor 2, k 32 factor 1, k 16 factor 1 with the printed sign
TRUTHS = [
    (plane, "inner", "rms", (0.199, 0.130, 0.076, 0.115, 0.273)),
    (sphere, "everywhere", "rms", (0.200, 0.131, 0.080, 0.119, 0.275)),
    (cube, "faces", "rms", (0.202, 0.129, 0.076, 0.115, 0.277)),
    (cube, "edges", "rms", (0.198, 0.147, 0.150, 0.168, 0.283)),
]
RUNS = ((16, 1.0, -1.0), (16, 2.0, -1.0), (32, 1.0, -1.0), (16, 1.0, 1.0))


def run_filter(points, k, factor, sign=-1.0):
    indices, _ = find_neighbours(points, k)
    axes, _ = principal_axes(points, indices)
    return denoise_points(points, axes, indices, factor, sign)


@pytest.fixture(scope="module")
def filtered():
    made = {}

    def get(shape, k, factor, sign):
        key = (shape, k, factor, sign)
        if key not in made:
            made[key] = run_filter(shape().points, k, factor, sign)
        return made[key]

    return get


@pytest.mark.release  # every day the device reaches these truths, and equals the twin
@pytest.mark.parametrize(("shape", "region", "figure", "expected"), TRUTHS)
def test_noise_falls_as_known(shape, region, figure, expected, filtered):
    truth = shape()
    assert truth.rms(truth.points, region) == pytest.approx(expected[0], rel=FILTER_TRUTH_SHARE)
    for run, wanted in zip(RUNS, expected[1:], strict=True):
        assert truth.rms(filtered(shape, *run), region) == pytest.approx(wanted, rel=FILTER_TRUTH_SHARE), run


@pytest.mark.release
def test_the_sign_that_is_printed_makes_noise_worse(filtered):
    for shape, region in ((plane, "inner"), (sphere, "everywhere"), (cube, "faces")):
        truth = shape()
        before = truth.rms(truth.points, region)
        assert truth.rms(filtered(shape, 16, 1.0, 1.0), region) > 1.2 * before
        assert truth.rms(filtered(shape, 16, 1.0, -1.0), region) < 0.8 * before


@pytest.mark.release
def test_a_ball_shrinks_a_little_more_with_a_wider_range(filtered):
    truth = sphere()
    once, wide = (truth.mean(filtered(sphere, 16, factor, -1.0), "everywhere") for factor in (1.0, 2.0))
    assert -0.015 < once < -0.005
    assert -0.022 < wide < -0.014


def test_a_plane_without_noise_stays():
    clean = plane(20.0).clean
    assert np.abs(run_filter(clean, 16, 2.0) - clean).max() < FILTERED_PLANE_MM


def test_permuted_points_give_permuted_results():
    points = sphere(5.0).points
    order = np.random.default_rng(0).permutation(len(points))
    assert np.allclose(run_filter(points[order], 16, 2.0), run_filter(points, 16, 2.0)[order], atol=1e-9, rtol=0)


def test_the_tree_of_the_twin_gives_what_comparing_all_pairs_gives():
    rng = np.random.default_rng(5)
    lattice = np.argwhere(np.ones((6, 6, 6))).astype(np.float32)  # ties everywhere
    for points in (lattice, np.repeat(rng.random((40, 3), np.float32), 7, axis=0)):
        away = points[:, None] - points[None]
        squares = away[..., 0] * away[..., 0] + away[..., 1] * away[..., 1] + away[..., 2] * away[..., 2]
        keys = [sorted((d, j) for j, d in enumerate(row)) for row in np.sqrt(squares)]
        indices, distances = find_neighbours(points, 9)
        assert indices.tolist() == [[j for _, j in row[:9]] for row in keys]
        assert distances.tolist() == [[d for d, _ in row[:9]] for row in keys]
