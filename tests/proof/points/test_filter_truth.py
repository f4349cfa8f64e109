"""The twins of the point filter reach known figures on shapes with noise, in bands of 10 %."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from point_shapes import cube, plane, sphere
from tolerances import FILTER_TRUTH_SHARE, FILTERED_PLANE_MM

from clrecon.proof.points.neighbours import denoise_points, find_neighbours, principal_axes

# rms distance of the cloud from its shape, mm: before, and after the filter
TRUTHS = [
    pytest.param(plane, "inner", (0.199, 0.130, 0.076, 0.115), id="plane"),
    pytest.param(sphere, "everywhere", (0.200, 0.131, 0.080, 0.119), id="sphere"),
    pytest.param(cube, "faces", (0.202, 0.129, 0.076, 0.115), id="faces of a cube"),
    pytest.param(cube, "edges", (0.198, 0.147, 0.150, 0.168), id="edges of a cube"),
]
"""With k 16 and factor 1, k 16 and factor 2, k 32 and factor 1: measured once with this seed."""
PRINTED_SIGN_TRUTHS = [
    pytest.param(plane, "inner", 0.273, id="plane"),
    pytest.param(sphere, "everywhere", 0.275, id="sphere"),
    pytest.param(cube, "faces", 0.277, id="faces of a cube"),
    pytest.param(cube, "edges", 0.283, id="edges of a cube"),
]
"""With k 16, factor 1 and the sign that the paper prints, which filters the other way: measured once."""
NEIGHBOURS_AND_FACTORS = ((16, 1.0), (16, 2.0), (32, 1.0))
PRINTED_SIGN = 1.0


def filter_points(points, *, k, factor, sign=-1.0):
    indices, _ = find_neighbours(points, k)
    axes, _ = principal_axes(points, indices)
    return denoise_points(points, axes, indices, factor, sign)


@functools.cache
def filtered(shape, *, k, factor, sign=-1.0):
    """The points of a shape with noise after the filter; kept, for it takes seconds."""
    return filter_points(shape().points, k=k, factor=factor, sign=sign)


@pytest.mark.release  # every day the device reaches these truths, and equals the twin
@pytest.mark.parametrize(("shape", "region", "rms_mm"), TRUTHS)
def test_noise_of_filtered_points_falls_to_its_known_rms(shape, region, rms_mm):
    truth = shape()
    before, *after = rms_mm
    assert truth.rms(truth.points, region) == pytest.approx(before, rel=FILTER_TRUTH_SHARE)
    found = [truth.rms(filtered(shape, k=k, factor=factor), region) for k, factor in NEIGHBOURS_AND_FACTORS]
    assert found == pytest.approx(after, rel=FILTER_TRUTH_SHARE)


@pytest.mark.release
@pytest.mark.parametrize(("shape", "region", "rms_mm"), PRINTED_SIGN_TRUTHS)
def test_noise_of_points_filtered_with_the_printed_sign_rises_to_its_known_rms(shape, region, rms_mm):
    found = shape().rms(filtered(shape, k=16, factor=1.0, sign=PRINTED_SIGN), region)
    assert found == pytest.approx(rms_mm, rel=FILTER_TRUTH_SHARE)


@pytest.mark.release
@pytest.mark.parametrize(("shape", "region"), [(plane, "inner"), (sphere, "everywhere"), (cube, "faces")])
def test_filter_lessens_noise_and_raises_it_with_the_printed_sign(shape, region):
    truth = shape()
    before = truth.rms(truth.points, region)
    # by TRUTHS and PRINTED_SIGN_TRUTHS 0.64 to 0.66 and 1.37 to 1.38 of what was before
    assert truth.rms(filtered(shape, k=16, factor=1.0), region) < 0.8 * before
    assert truth.rms(filtered(shape, k=16, factor=1.0, sign=PRINTED_SIGN), region) > 1.2 * before


@pytest.mark.release
def test_filtered_ball_of_20_mm_shrinks_by_some_hundredths_of_a_mm_and_more_with_a_wider_range():
    truth = sphere()
    shrunk, shrunk_by_wide = (truth.mean(filtered(sphere, k=16, factor=factor), "everywhere") for factor in (1.0, 2.0))
    assert shrunk_by_wide < shrunk
    assert -0.015 < shrunk < -0.005  # mm; measured -0.0080
    assert -0.022 < shrunk_by_wide < -0.014  # mm; measured -0.0163


def test_filtered_plane_without_noise_stays_in_place():
    clean = plane(size=20.0).clean
    assert np.abs(filter_points(clean, k=16, factor=2.0) - clean).max() < FILTERED_PLANE_MM


def test_points_in_another_order_are_filtered_to_the_same_places_in_that_order():
    points = sphere(radius=5.0).points
    order = np.random.default_rng(0).permutation(len(points))
    in_another_order = filter_points(points[order], k=16, factor=2.0)
    # sums of float64 in another order
    assert np.allclose(in_another_order, filter_points(points, k=16, factor=2.0)[order], atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    "points",
    [
        pytest.param(np.argwhere(np.ones((6, 6, 6))).astype(np.float32), id="lattice, equal distances everywhere"),
        pytest.param(
            np.repeat(np.random.default_rng(5).random((40, 3), np.float32), 7, axis=0), id="each point seven times"
        ),
    ],
)
def test_neighbours_are_the_nearest_of_all_points_and_of_equally_near_ones_the_first(points):
    k = 9
    x, y, z = np.moveaxis(points[:, None] - points[None], -1, 0)
    all_distances = np.sqrt(x * x + y * y + z * z)  # in float32 as the tree has them

    indices, distances = find_neighbours(points, k)

    by_distance_then_index = np.argsort(all_distances, axis=1, kind="stable")[:, :k]
    assert indices.tolist() == by_distance_then_index.tolist()
    assert distances.tolist() == np.take_along_axis(all_distances, by_distance_then_index, axis=1).tolist()
