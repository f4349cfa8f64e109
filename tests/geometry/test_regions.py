"""Connected components against those of scipy; how wide a space is: balls, ends of the volume, discs in them."""

from __future__ import annotations

import numpy as np
import pytest
from variants import daily

from clrecon.geometry.regions import (
    CORNERS,
    FACES,
    IN_SLICE,
    Regions,
    find_holes,
    find_open_places,
    holds_ball,
    measure_width,
)

FREE = ((False, False),) * 3
"""Of none of the six ends of a scan: the body ends there."""
ONE_MM = (1.0, 1.0, 1.0)


def ball(radius: float, steps: tuple[float, float, float]) -> np.ndarray:
    sizes = [2 * int(radius / step) + 1 for step in steps]
    axes = np.indices(sizes)
    centre = [(size - 1) / 2 for size in sizes]
    squares = [((axis - c) * step) ** 2 for axis, c, step in zip(axes, centre, steps, strict=True)]
    return np.asarray(sum(squares) <= radius**2)


@pytest.mark.parametrize("steps", [(1.0, 1.0, 1.0), (0.5, 0.4, 0.4), (4.0, 0.9, 0.9), (2.0, 3.0, 1.0)])
@pytest.mark.parametrize("radius_mm", [12.0, 20.0])
def test_the_width_of_a_ball_is_its_radius(radius_mm, steps):
    block_mm = max(2.0, *steps)  # in which the width is measured; measured up to 1.24 mm too little
    assert measure_width(ball(radius_mm, steps), FREE, steps) == pytest.approx(radius_mm, abs=block_mm)


def ball_beside_voxels(radius: float, steps: tuple[float, float, float], shift: np.ndarray) -> np.ndarray:
    """A ball whose middle lies `shift`, in mm, from a voxel."""
    reach = [int(radius / step) + 2 for step in steps]
    axes = [(np.arange(-n, n + 1) * step - s).reshape([-1 if a == b else 1 for b in range(3)])
            for a, (n, step, s) in enumerate(zip(reach, steps, shift, strict=True))]  # fmt: skip
    inside = np.asarray(sum(axis**2 for axis in axes) <= radius**2)
    where = tuple(slice(at.min(), at.max() + 1) for at in np.nonzero(inside))
    return inside[where]


in_voxels_of = pytest.mark.parametrize(
    "steps", daily(2, [(1.0, 1.0, 1.0), (1.3, 1.3, 1.3), (1.4, 0.7, 0.7), (5.0, 1.0, 1.0)])
)
LIMIT_MM = 35.0


@in_voxels_of
@pytest.mark.parametrize("radius_mm", [LIMIT_MM, 35.4, 36.0, 37.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_ball_of_at_least_the_limit_fits_wherever_its_middle_lies(seed, radius_mm, steps):
    shift = np.random.default_rng(seed).uniform(-0.5, 0.5, 3) * steps
    assert holds_ball(ball_beside_voxels(radius_mm, steps, shift), FREE, steps, LIMIT_MM)


@in_voxels_of
@pytest.mark.parametrize("seed", range(3))
def test_a_ball_smaller_than_the_limit_by_more_than_a_voxel_does_not_hold_one_of_the_limit(seed, steps):
    shift = np.random.default_rng(seed).uniform(-0.5, 0.5, 3) * steps
    smaller_mm = LIMIT_MM - 1.25 * max(steps)
    assert not holds_ball(ball_beside_voxels(smaller_mm, steps, shift), FREE, steps, LIMIT_MM)


WITHIN_A_BLOCK_MM = 2.0  # measured up to 1.3
LOW_END_CUT, HIGH_END_CUT = ((True, False), *FREE[1:]), ((False, True), *FREE[1:])
BOTH_ENDS_CUT, ALL_ENDS_CUT = ((True, True), *FREE[1:]), ((True, True),) * 3

WIDTHS_AT_ENDS = {
    "half a ball is half as wide": (ball(20.0, ONE_MM)[20:], FREE, 10.0),
    "half a ball goes on beyond the end": (ball(20.0, ONE_MM)[20:], LOW_END_CUT, 20.0),
    "a cap has the radius of its disc at the end": (
        ball(20.0, ONE_MM)[:10], HIGH_END_CUT, np.sqrt(20.0**2 - 10.0**2),
    ),
    "a slab goes on beyond both ends": (np.ones((3, 30, 30), bool), BOTH_ENDS_CUT, 15.0),
}  # fmt: skip


@pytest.mark.parametrize(("mask", "ends", "width"), WIDTHS_AT_ENDS.values(), ids=WIDTHS_AT_ENDS)
def test_a_body_goes_on_beyond_ends_that_the_scan_cuts_and_a_disc_there_counts(mask, ends, width):
    assert measure_width(mask, ends, ONE_MM) == pytest.approx(width, abs=WITHIN_A_BLOCK_MM)


def test_a_body_that_the_scan_cuts_at_every_end_is_infinitely_wide():
    assert measure_width(np.ones((3, 30, 30), bool), ALL_ENDS_CUT, ONE_MM) == np.inf


def test_background_of_an_end_is_open_outside_of_rings_and_not_within():
    ring = np.array(
        [[0, 0, 0, 0, 0, 0], [0, 1, 1, 1, 1, 0], [0, 1, 0, 0, 1, 0], [0, 1, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0]]
    )
    expected = np.ones((5, 6), bool)
    expected[1:4, 1:5] = False
    np.testing.assert_array_equal(find_open_places(ring), expected)


CONNECTIONS = {
    "slice": (IN_SLICE, [np.zeros((3, 3)), [[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.zeros((3, 3))]),
    "faces": (FACES, None),
    "corners": (CORNERS, np.ones((3, 3, 3))),
}


@pytest.fixture
def random_regions(shape, share, connection):
    """A random mask, its regions, and their labels and number by scipy."""
    ndimage = pytest.importorskip("scipy.ndimage")
    mask = np.random.default_rng(7).random(shape) < share
    touching, structure = CONNECTIONS[connection]
    return mask, Regions(mask, touching), *ndimage.label(mask, structure)


connections = pytest.mark.parametrize("connection", CONNECTIONS)
shares = pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.6, 0.95, 1.0])
shapes = pytest.mark.parametrize("shape", [(5, 13, 17), (4, 9, 64), (1, 1, 9), (3, 7, 1), (1, 1, 1)])


@connections
@shares
@shapes
def test_components_are_numbered_as_by_scipy(random_regions):
    """Each component is chosen by a mask of all numbers, and painted with its own."""
    mask, regions, labels, count = random_regions
    numbers = range(1, count + 1)
    painted = sum(number * regions.cells_of(np.arange(count + 1) == number) for number in numbers)
    assert regions.count == count
    np.testing.assert_array_equal(np.broadcast_to(painted, mask.shape), labels)


@connections
@shares
@shapes
def test_sizes_and_sums_of_components_are_those_of_their_cells(random_regions):
    mask, regions, labels, count = random_regions
    random = np.random.default_rng(8)
    other = random.random(mask.shape) < 0.5
    values = random.integers(0, 60_000, mask.shape).astype(np.uint16) * (random.random(mask.shape) < 0.2)

    def sum_by_label(weights: np.ndarray) -> np.ndarray:
        return np.bincount(labels.ravel(), np.where(labels > 0, weights, 0).ravel(), count + 1)

    np.testing.assert_array_equal(regions.sizes, sum_by_label(mask))
    np.testing.assert_array_equal(regions.sum_of(other), sum_by_label(other))
    np.testing.assert_array_equal(regions.sum_of(values), sum_by_label(values))


@connections
@shares
@shapes
def test_boxes_and_crops_of_components_are_those_of_scipy(random_regions):
    from scipy import ndimage

    _, regions, labels, _ = random_regions
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        assert [slice(first, last + 1) for first, last in regions.boxes[number]] == list(box)
        np.testing.assert_array_equal(regions.crop(number)[1], labels[box] == number)


def test_a_bar_that_joins_many_fingers_makes_one_component_of_them():
    """The worst order for joining pairs one by one: all ends come before what connects them."""
    mask = np.zeros((1, 40, 2001), dtype=bool)
    mask[0, :, ::2] = True
    mask[0, -1] = True
    assert Regions(mask, FACES).count == 1


def test_holes_are_those_that_scipy_fills_in_each_slice_by_itself():
    from scipy.ndimage import binary_fill_holes

    mask = np.random.default_rng(3).random((9, 30, 33)) < 0.55
    mask[:, :4] = mask[:, :, -3:] = False
    mask[4] = False
    expected = np.stack([binary_fill_holes(layer) for layer in mask]) & ~mask
    assert expected.any()
    np.testing.assert_array_equal(find_holes(mask), expected)
