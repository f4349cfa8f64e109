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


def ball(radius: float, steps: tuple[float, float, float]) -> np.ndarray:
    sizes = [2 * int(radius / step) + 1 for step in steps]
    axes = np.indices(sizes)
    centre = [(size - 1) / 2 for size in sizes]
    squares = [((axis - c) * step) ** 2 for axis, c, step in zip(axes, centre, steps, strict=True)]
    return np.asarray(sum(squares) <= radius**2)


@pytest.mark.parametrize("steps", [(1.0, 1.0, 1.0), (0.5, 0.4, 0.4), (4.0, 0.9, 0.9), (2.0, 3.0, 1.0)])
@pytest.mark.parametrize("radius", [12.0, 20.0])
def test_a_ball_has_its_radius(radius, steps):
    assert measure_width(ball(radius, steps), FREE, steps) == pytest.approx(radius, abs=max(2.5, steps[0]))


def ball_beside_voxels(radius: float, steps: tuple[float, float, float], shift: np.ndarray) -> np.ndarray:
    """A ball whose middle lies `shift`, in mm, from a voxel."""
    reach = [int(radius / step) + 2 for step in steps]
    axes = [(np.arange(-n, n + 1) * step - s).reshape([-1 if a == b else 1 for b in range(3)])
            for a, (n, step, s) in enumerate(zip(reach, steps, shift, strict=True))]  # fmt: skip
    inside = np.asarray(sum(axis**2 for axis in axes) <= radius**2)
    where = tuple(slice(at.min(), at.max() + 1) for at in np.nonzero(inside))
    return inside[where]


@pytest.mark.parametrize("steps", daily(2, [(1.0, 1.0, 1.0), (1.3, 1.3, 1.3), (1.4, 0.7, 0.7), (5.0, 1.0, 1.0)]))
def test_a_ball_of_the_limit_fits_wherever_its_middle_lies_and_a_smaller_one_does_not(steps):
    random = np.random.default_rng(7)
    for _ in range(3):
        shift = random.uniform(-0.5, 0.5, 3) * steps
        for radius in (35.0, 35.4, 36.0, 37.0):
            assert holds_ball(ball_beside_voxels(radius, steps, shift), FREE, steps, 35.0)
        smaller = 35.0 - 1.25 * max(steps)
        assert not holds_ball(ball_beside_voxels(smaller, steps, shift), FREE, steps, 35.0)


def test_a_body_goes_on_beyond_the_ends_of_the_volume_and_a_disc_there_counts():
    whole = ball(20.0, (1.0, 1.0, 1.0))
    half = whole[20:]
    assert measure_width(half, FREE, (1.0,) * 3) == pytest.approx(10.0, abs=2.0)
    cut = ((True, False), (False, False), (False, False))
    assert measure_width(half, cut, (1.0,) * 3) == pytest.approx(20.0, abs=2.0)
    assert measure_width(whole[:10], ((False, True), *FREE[1:]), (1.0,) * 3) == pytest.approx(17.3, abs=2.0)
    slab = np.ones((3, 30, 30), bool)
    through = ((True, True), (False, False), (False, False))
    assert measure_width(slab, through, (1.0,) * 3) == pytest.approx(15.0, abs=2.0)
    assert measure_width(slab, ((True, True),) * 3, (1.0,) * 3) == np.inf


def test_places_of_an_end_are_open_outside_of_rings():
    face = np.zeros((5, 6), int)
    face[1:4, 1:5] = 1
    face[2, 2:4] = 0
    expected = face == 0
    expected[2, 2:4] = False
    np.testing.assert_array_equal(find_open_places(face), expected)


CONNECTIONS = {
    "slice": (IN_SLICE, [np.zeros((3, 3)), [[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.zeros((3, 3))]),
    "faces": (FACES, None),
    "corners": (CORNERS, np.ones((3, 3, 3))),
}


@pytest.mark.parametrize("connection", CONNECTIONS)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.6, 0.95, 1.0])
@pytest.mark.parametrize("shape", [(5, 13, 17), (4, 9, 64), (1, 1, 9), (3, 7, 1), (1, 1, 1)])
def test_components_are_numbered_and_measured_as_those_of_scipy(shape, share, connection):
    ndimage = pytest.importorskip("scipy.ndimage")
    random = np.random.default_rng(7)
    mask, other = random.random(shape) < share, random.random(shape) < 0.5
    values = random.integers(0, 60_000, shape).astype(np.uint16) * (random.random(shape) < 0.2)
    touching, structure = CONNECTIONS[connection]
    labels, count = ndimage.label(mask, structure)
    regions = Regions(mask, touching)
    painted = sum(number * regions.cells_of(np.arange(count + 1) == number) for number in range(1, count + 1))
    assert regions.count == count
    np.testing.assert_array_equal(np.broadcast_to(painted, shape), labels)
    for sums, weights in ((regions.sizes, mask), (regions.sum_of(other), other), (regions.sum_of(values), values)):
        inside = np.where(labels > 0, weights, 0).ravel()
        np.testing.assert_array_equal(sums, np.bincount(labels.ravel(), inside, count + 1))
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        assert [slice(first, last + 1) for first, last in regions.boxes[number]] == list(box)
        np.testing.assert_array_equal(regions.crop(number)[1], labels[box] == number)


def test_a_bar_that_joins_many_fingers_makes_one_component_of_them():
    """The worst order for joining pairs one by one: all ends come before what connects them."""
    mask = np.zeros((1, 40, 2001), dtype=bool)
    mask[0, :, ::2] = True
    mask[0, -1] = True
    assert Regions(mask, FACES).count == 1


def test_holes_are_those_of_each_slice():
    from scipy.ndimage import binary_fill_holes

    mask = np.random.default_rng(3).random((9, 30, 33)) < 0.55
    mask[:, :4] = mask[:, :, -3:] = False
    mask[4] = False
    expected = np.stack([binary_fill_holes(layer) for layer in mask]) & ~mask
    assert expected.any()
    np.testing.assert_array_equal(find_holes(mask), expected)
