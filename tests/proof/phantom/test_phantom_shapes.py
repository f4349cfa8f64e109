"""Analytic bodies: distances against brute force, area and volume against other formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import tolerances
from variants import daily

from clrecon.errors import UsageError
from clrecon.proof.phantom.shapes import Box, Cylinder, Sphere, Torus

AXIS = np.array((0.36, -0.48, 0.8))
CENTRE = np.array((3.0, -14.0, 25.0))
ACROSS = np.array((0.8, 0.6, 0.0))
THIRD = np.cross(AXIS, ACROSS)

SPHERE = Sphere(CENTRE, radius=9.0)
TORUS = Torus(CENTRE, 2.0 * AXIS, major=11.0, minor=4.0)
CYLINDER = Cylinder(CENTRE, -3.0 * AXIS, radius=6.0, length=17.0)
BOX = Box(CENTRE, AXIS, thickness=5.0, width=12.0, height=16.0, edge=ACROSS + 0.5 * AXIS)
BODIES = [SPHERE, TORUS, CYLINDER, BOX]
IDS = ["sphere", "torus", "cylinder", "box"]


def place_points(u, v, w) -> np.ndarray:
    """Points from coordinates along the two directions across the axis and the axis itself."""
    u, v, w = np.broadcast_arrays(u, v, w)
    return CENTRE + u.ravel()[:, None] * ACROSS + v.ravel()[:, None] * THIRD + w.ravel()[:, None] * AXIS


def surface_points(body) -> np.ndarray:
    """Points all over the surface of a body."""
    turn = np.linspace(0.0, 2.0 * np.pi, 361)[:-1]
    if isinstance(body, Sphere):
        polar = np.linspace(0.0, np.pi, 181)[:, None]
        return place_points(
            *(9.0 * f for f in (np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)))
        )
    if isinstance(body, Torus):
        tube = turn[::3, None]
        ring = 11.0 + 4.0 * np.cos(tube)
        return place_points(ring * np.cos(turn), ring * np.sin(turn), 4.0 * np.sin(tube))
    if isinstance(body, Cylinder):
        wall = place_points(6.0 * np.cos(turn), 6.0 * np.sin(turn), np.linspace(-8.5, 8.5, 120)[:, None])
        radius = np.linspace(0.0, 6.0, 60)[:, None]
        caps = [place_points(radius * np.cos(turn), radius * np.sin(turn), height) for height in (-8.5, 8.5)]
        return np.vstack((wall, *caps))
    faces = []
    half = np.array((6.0, 8.0, 2.5))
    for axis in range(3):
        a, b = (other for other in range(3) if other != axis)
        grid = np.meshgrid(np.linspace(-half[a], half[a], 101), np.linspace(-half[b], half[b], 101))
        for sign in (-1.0, 1.0):
            coordinates = [np.zeros_like(grid[0])] * 3
            coordinates[axis] = np.full_like(grid[0], sign * half[axis])
            coordinates[a], coordinates[b] = grid
            faces.append(place_points(*coordinates))
    return np.vstack(faces)


def is_inside(body, points: np.ndarray) -> np.ndarray:
    offset = points - CENTRE
    u, v, w = offset @ ACROSS, offset @ THIRD, offset @ AXIS
    if isinstance(body, Sphere):
        return u**2 + v**2 + w**2 < 81.0
    if isinstance(body, Torus):
        return (np.sqrt(u**2 + v**2) - 11.0) ** 2 + w**2 < 16.0
    if isinstance(body, Cylinder):
        return (u**2 + v**2 < 36.0) & (np.abs(w) < 8.5)
    return (np.abs(u) < 6.0) & (np.abs(v) < 8.0) & (np.abs(w) < 2.5)


@pytest.mark.parametrize("body", daily(1, BODIES), ids=IDS)
def test_signed_distance_of_a_body_is_that_of_the_nearest_point_of_its_surface(body) -> None:
    points = CENTRE + np.random.default_rng(3).uniform(-14.0, 14.0, (500, 3))

    distance = np.abs(body.signed_distance(points))

    surface = surface_points(body)
    nearest_sample = np.array([np.sqrt(((surface - point) ** 2).sum(axis=1).min()) for point in points])
    # samples of a surface are never nearer than the surface, and little farther where a point is away from it
    assert (nearest_sample - distance).min() > -1e-9
    away = distance > 1.0
    assert (nearest_sample - distance)[away].max() < tolerances.PHANTOM_DISTANCE_MM


@pytest.mark.parametrize("body", BODIES, ids=IDS)
def test_signed_distance_of_a_body_is_positive_exactly_inside(body) -> None:
    points = CENTRE + np.random.default_rng(3).uniform(-14.0, 14.0, (500, 3))
    inside = is_inside(body, points)
    assert 15 < inside.sum() < 480  # of 500: there are points on both sides; measured 20 to 70
    assert np.array_equal(body.signed_distance(points) > 0.0, inside)


@pytest.mark.parametrize("body", BODIES, ids=IDS)
def test_volume_and_area_of_a_body_are_those_counted_from_random_points(body) -> None:
    low, high = body.bounds_mm
    points = np.random.default_rng(4).uniform(low, high, (400_000, 3))
    box_mm3 = float(np.prod(high - low))

    distance = body.signed_distance(points)

    volume_mm3 = (distance >= 0.0).mean() * box_mm3
    area_mm2 = (np.abs(distance) < 0.2).mean() * box_mm3 / (2 * 0.2)  # a shell of 0.2 mm on both sides
    assert volume_mm3 / 1000.0 == pytest.approx(body.volume_ml, rel=0.01)  # chance of 400,000 points
    assert area_mm2 == pytest.approx(body.area_mm2, rel=0.03)  # a tenth of the points; edges are rounded


@pytest.mark.parametrize("body", BODIES, ids=IDS)
def test_bounds_of_a_body_are_those_of_its_surface(body) -> None:
    surface, (low, high) = surface_points(body), body.bounds_mm
    assert surface.min(axis=0) == pytest.approx(
        low, abs=0.003
    )  # mm; of samples a degree apart on 12 mm; measured 0.0012
    assert surface.max(axis=0) == pytest.approx(high, abs=0.003)


def test_description_of_a_torus_has_its_radii_unit_axis_and_volume() -> None:
    described = TORUS.describe()  # made with an axis of length 2
    assert (described["major_radius_mm"], described["minor_radius_mm"]) == (11.0, 4.0)
    assert described["axis_lps"] == pytest.approx(AXIS.tolist())
    assert described["volume_ml"] == pytest.approx(2.0 * math.pi**2 * 11.0 * 4.0**2 / 1000.0)


def test_description_of_a_box_has_its_thickness_and_its_edge_across_the_axis() -> None:
    described = BOX.describe()  # made with an edge that leans to the axis
    assert described["thickness_mm"] == 5.0
    assert described["edge_lps"] == pytest.approx(ACROSS.tolist())


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Sphere((0, 0, 0), radius=0.0), "radius"),
        (lambda: Sphere((0, 0), radius=1.0), "three finite numbers"),
        (lambda: Torus((0, 0, 0), (0, 0, 0), major=3.0, minor=1.0), "zero vector"),
        (lambda: Torus((0, 0, 0), (0, 0, 1), major=3.0, minor=3.0), "minor 3 and major 3"),
        (lambda: Cylinder((0, 0, 0), (0, 0, 1), radius=3.0, length=math.nan), "length"),
        (lambda: Box((0, 0, 0), (0, 0, 1), thickness=1.0, width=1.0, height=1.0, edge=(0, 0, 2)), "parallel"),
        (lambda: SPHERE.signed_distance(np.zeros((3, 2))), r"\(3, 2\)"),
    ],
)
def test_body_with_a_wrong_argument_is_refused_with_the_reason(make, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        make()
