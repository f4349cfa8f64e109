"""Centre lines: arc lengths, frames that do not twist, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.rendering.views.centre_line import Curve, rotation_minimising_normals
from clrecon.rendering.views.reformation import straightened_sheet, stretched_length, stretched_sheet

RADIUS, TURN_DEG = 80.0, 120.0


def arc_points(degrees, count):
    """So many points of a circle of `RADIUS` across x, from y to z."""
    angle = np.radians(np.linspace(0.0, degrees, count))
    return np.stack([0.0 * angle, RADIUS * np.cos(angle), RADIUS * np.sin(angle)], axis=1)


HELIX_RADIUS, HELIX_PITCH = 20.0, 30.0  # mm


def helix(t):
    """Points of a helix along z at the angles `t` in radians."""
    return np.stack([HELIX_RADIUS * np.cos(t), HELIX_RADIUS * np.sin(t), HELIX_PITCH * t / (2.0 * np.pi)], axis=1)


@pytest.fixture(scope="module")
def third_of_a_circle() -> Curve:
    """A curve through points 14 mm apart on a third of a circle."""
    return Curve(arc_points(TURN_DEG, count=13))


def test_curve_of_a_circle_is_as_long_as_its_arc(third_of_a_circle):
    assert third_of_a_circle.length == pytest.approx(RADIUS * np.radians(TURN_DEG), rel=tolerances.ARC_LENGTH)


def test_places_on_a_circle_turn_by_their_arc_length(third_of_a_circle):
    places = third_of_a_circle.at(np.linspace(0.0, third_of_a_circle.length, 200))

    angles = np.degrees(np.arctan2(places[:, 2], places[:, 1]))
    assert np.abs(angles - np.linspace(0.0, TURN_DEG, 200)).max() <= TURN_DEG * tolerances.ARC_LENGTH


def test_smallest_radius_of_a_circle_is_its_radius(third_of_a_circle):
    assert third_of_a_circle.smallest_radius() == pytest.approx(RADIUS, rel=tolerances.SPLINE_CURVATURE)


def test_curve_begins_and_ends_at_its_end_points(third_of_a_circle):
    ends = third_of_a_circle.at([0.0, third_of_a_circle.length])

    assert ends == pytest.approx(arc_points(TURN_DEG, count=13)[[0, -1]])


@pytest.fixture(scope="module")
def clicked_helix() -> Curve:
    """A curve through unevenly clicked points of a helix."""
    random = np.random.default_rng(2)
    return Curve(helix(np.sort(random.uniform(0.0, 6.0, 14))))


def test_equal_steps_of_arc_length_are_as_long_as_the_chords_of_a_fine_polyline(clicked_helix):
    steps, chords_a_step = 56, 200

    fine = clicked_helix.at(np.linspace(0.0, clicked_helix.length, steps * chords_a_step + 1))

    lengths = np.linalg.norm(np.diff(fine, axis=0), axis=1).reshape(steps, chords_a_step).sum(axis=1)
    assert np.abs(lengths - clicked_helix.length / steps).max() <= tolerances.ARC_STEP_MM


def test_tangents_are_unit_vectors(clicked_helix):
    tangents = clicked_helix.tangents(np.linspace(0.0, clicked_helix.length, 57))

    assert np.linalg.norm(tangents, axis=1) == pytest.approx(np.ones(57))


def test_two_points_are_a_straight_line():
    curve = Curve([(0, 0, 0), (3, 4, 0)])

    assert curve.length == pytest.approx(5.0)  # the hypotenuse of 3 and 4
    assert curve.at([2.5])[0] == pytest.approx((1.5, 2.0, 0.0))
    assert curve.smallest_radius() == np.inf


def test_repeated_points_count_once():
    curve = Curve([(0, 0, 0), (0, 0, 0), (3, 4, 0), (3, 4, 0)])

    assert np.array_equal(curve.points, [(0, 0, 0), (3, 4, 0)])


def test_frames_of_a_helix_turn_back_by_its_torsion():
    """The frame without twist turns against the Frenet frame by the torsion: analytic for a helix."""
    radius, rise = HELIX_RADIUS, HELIX_PITCH / (2.0 * np.pi)
    t = np.linspace(0.0, 4.0 * np.pi, 2000)
    speed = np.hypot(radius, rise)
    tangents = np.stack([-radius * np.sin(t), radius * np.cos(t), rise + 0.0 * t], axis=1) / speed
    inward = np.stack([-np.cos(t), -np.sin(t), 0.0 * t], axis=1)

    normals = rotation_minimising_normals(helix(t), tangents, inward[0])

    binormals = np.cross(tangents, inward)
    turned = np.unwrap(np.arctan2((normals * binormals).sum(axis=1), (normals * inward).sum(axis=1)))
    assert np.abs(turned + rise / speed * t).max() <= tolerances.FRAME_RADIANS
    assert np.abs((normals * tangents).sum(axis=1)).max() <= tolerances.FRAME_RADIANS  # still across the helix


def last_normal(count: int) -> np.ndarray:
    """The last normal in so many steps along a curve whose bend and torsion change."""
    t = np.linspace(0.0, 2.0, count)
    places = np.stack([t, t**2, 0.7 * t**3], axis=1)
    tangents = np.stack([np.ones_like(t), 2.0 * t, 2.1 * t**2], axis=1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return rotation_minimising_normals(places, tangents, (0.0, 1.0, 0.0))[-1]


def test_half_the_step_of_frames_leaves_a_sixteenth_of_their_error():
    truth = last_normal(5000)

    errors = np.array([np.linalg.norm(last_normal(count) - truth) for count in (21, 41, 81)])

    assert errors[:-1] / errors[1:] == pytest.approx([2.0**4] * 2, rel=0.25)  # the orders 3 and 5 are 8 and 32


def test_normals_across_a_plane_curve_stay_across_it():
    curve = Curve(arc_points(150.0, count=20))
    arc = np.linspace(0.0, curve.length, 300)

    normals = rotation_minimising_normals(curve.at(arc), curve.tangents(arc), (1.0, 0.0, 0.0))

    assert np.abs(normals - (1.0, 0.0, 0.0)).max() <= tolerances.FRAME_RADIANS


TURN = rotation((25.0, -40.0, 10.0))
HELIX = Curve(helix(np.linspace(0.0, 3.0, 9)) @ TURN.T)
PIXEL = HELIX.length / 100  # mm: a hundred rows show the whole helix
of_each_angle = pytest.mark.parametrize("angle", [0.0, 90.0, -35.0])


def straightened(angle: float):
    """The turned helix made straight in 41 columns and 100 rows, seen across its own x axis."""
    return straightened_sheet(HELIX, across=TURN[:, 0], size=(41, 100), pixel=PIXEL, angle=angle)


@of_each_angle
def test_straightened_rows_lie_across_the_curve(angle):
    made = straightened(angle)

    tangents = HELIX.tangents(made.arc)
    assert np.abs((made.sheet.steps * tangents).sum(axis=1)).max() <= PIXEL * tolerances.FRAME_RADIANS
    assert np.abs((made.sheet.normals * tangents).sum(axis=1)).max() <= tolerances.FRAME_RADIANS


@of_each_angle
def test_straightened_rows_have_steps_of_a_pixel_about_the_curve(angle):
    made = straightened(angle)

    assert np.linalg.norm(made.sheet.steps, axis=1) == pytest.approx(np.full(100, PIXEL))
    assert made.sheet.points()[:, 20] == pytest.approx(HELIX.at(made.arc))  # the middle of 41 columns


@of_each_angle
def test_straightened_axes_run_right_down_and_into_the_picture(angle):
    made = straightened(angle)
    down = np.diff(made.sheet.points()[:, 20], axis=0)  # the middle of 41 columns

    axes = np.stack([made.sheet.steps[:-1], down, made.sheet.normals[:-1]], axis=1)
    assert np.linalg.det(axes).min() > 0.0


@of_each_angle
def test_straightened_rows_turned_back_by_their_angle_point_to_the_right_on_the_mean(angle):
    made = straightened(angle)

    back = np.cos(np.radians(angle)) * made.sheet.steps - np.sin(np.radians(angle)) * PIXEL * made.sheet.normals
    sines = (np.cross(back / PIXEL, TURN[:, 0]) * HELIX.tangents(made.arc)).sum(axis=1)
    assert abs(sines.mean()) < 5e-4  # of 1 for a right angle; measured 2e-4


ALONG = np.array([0.0, 0.0, 1.0])
ROUND = Curve(helix(np.linspace(0.0, 1.5, 12)))  # 1.5 radians
ROUND_LENGTH = HELIX_RADIUS * 1.5  # mm, of the helix's circle
STRETCHED_PIXEL = ROUND_LENGTH / 400


@pytest.fixture(scope="module")
def unrolled():
    """The unrolled cylinder of the helix, in 101 columns and 400 rows."""
    return stretched_sheet(ROUND, across=ALONG, size=(101, 400), pixel=STRETCHED_PIXEL)


def test_stretched_length_is_that_across_the_axis():
    assert stretched_length(ROUND, ALONG) == pytest.approx(ROUND_LENGTH, rel=tolerances.ARC_LENGTH)


def test_stretched_axes_run_right_down_and_into_the_picture(unrolled):
    down = np.diff(unrolled.sheet.points()[:, 50], axis=0)  # the middle of 101 columns

    axes = np.stack([unrolled.sheet.steps[:-1], down, unrolled.sheet.normals[:-1]], axis=1)
    assert np.linalg.det(axes).min() > 0.0


def test_stretched_sheets_keep_lengths_down_and_aslant(unrolled):
    points = unrolled.sheet.points()

    down = np.linalg.norm(points[1:] - points[:-1], axis=-1)
    aslant = np.linalg.norm(points[1:, 1:] - points[:-1, :-1], axis=-1)
    assert down == pytest.approx(np.full(down.shape, STRETCHED_PIXEL), rel=tolerances.ISOMETRY)
    assert aslant == pytest.approx(np.full(aslant.shape, np.sqrt(2.0) * STRETCHED_PIXEL), rel=tolerances.ISOMETRY)


def test_stretched_sheets_draw_the_centre_line_as_long_as_it_is(unrolled):
    drawn = np.stack([unrolled.columns, np.arange(400.0)], axis=1) * STRETCHED_PIXEL

    way = np.linalg.norm(np.diff(drawn, axis=0), axis=1)
    assert way == pytest.approx(np.diff(unrolled.arc), rel=tolerances.ISOMETRY)


of_each_sheet = pytest.mark.parametrize("make", [straightened_sheet, stretched_sheet])


@of_each_sheet
def test_rows_beyond_the_ends_have_no_arc_length(make):
    curve = Curve([(0, 0, 0), (0, 0, 10)])

    made = make(curve, across=np.array([1.0, 0.0, 0.0]), size=(5, 20), pixel=1.0)

    beyond = [np.nan] * 5  # ten of the twenty rows of 1 mm are on the line of 10 mm
    assert made.arc == pytest.approx([*beyond, *(np.arange(10) + 0.5), *beyond], nan_ok=True)


@pytest.mark.parametrize(
    ("points", "says"),
    [
        pytest.param([(1, 2, 3)], "at least two", id="one point"),
        pytest.param([(1, 2, 3)] * 4, "at least two", id="one point four times"),
        pytest.param([(1, 2)], r"\(n, 3\)", id="two coordinates"),
        pytest.param("abc", "array of points", id="text"),
        pytest.param([(0, 0, 0), (1, np.nan, 2)], "point 1", id="not a number"),
        pytest.param([(0, 0, 0), (1, 1, 2), (1e9, 0, 0)], "point 2", id="a kilometre away"),
    ],
)
def test_points_that_make_no_centre_line_are_refused(points, says):
    with pytest.raises(UsageError, match=says):
        Curve(points)


@of_each_sheet
def test_view_along_the_whole_centre_line_is_refused(make):
    along = Curve([(0, 0, 0), (0, 0, 10)])

    with refused(UsageError, "another", "view"):
        make(along, across=np.array([0.0, 0.0, 1.0]), size=(5, 5), pixel=1.0)


def test_points_within_half_a_voxel_of_the_volume_are_accepted():
    volume = Volume(np.zeros((10, 10, 10), np.int16), np.eye(4))

    assert Curve([(0, 0, 0), (9.5, 9.5, 9.5)]).check_within(volume) is None


def test_points_outside_of_the_volume_are_named():
    volume = Volume(np.zeros((10, 10, 10), np.int16), np.eye(4))

    with refused(UsageError, "LPS", 1, 3, 2):  # one of three points, which is point 2
        Curve([(0, 0, 0), (1, 1, 1), (5, 12, 9)]).check_within(volume)
