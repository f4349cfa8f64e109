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

RADIUS = 80.0


def arc_points(degrees, count, radius=RADIUS):
    angle = np.radians(np.linspace(0.0, degrees, count))
    return np.stack([0.0 * angle, radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def helix(t, radius=20.0, pitch=30.0):
    return np.stack([radius * np.cos(t), radius * np.sin(t), pitch * t / (2.0 * np.pi)], axis=1)


def test_a_circle_is_as_long_as_it_is():
    points = arc_points(120.0, 13)  # 14 mm apart
    curve = Curve(points)
    truth = RADIUS * np.radians(120.0)
    assert curve.length == pytest.approx(truth, rel=tolerances.ARC_LENGTH)
    arc = np.linspace(0.0, curve.length, 200)
    angles = np.degrees(np.arctan2(curve.at(arc)[:, 2], curve.at(arc)[:, 1]))
    assert np.abs(angles - np.linspace(0.0, 120.0, 200)).max() <= 120.0 * tolerances.ARC_LENGTH
    assert curve.smallest_radius() == pytest.approx(RADIUS, rel=tolerances.SPLINE_CURVATURE)
    assert curve.at([0.0, curve.length]) == pytest.approx(points[[0, -1]])


def test_places_by_arc_length_lie_as_far_apart_as_they_should():
    """Unevenly clicked points: equal steps of arc length, measured by chords of a fine polyline."""
    random = np.random.default_rng(2)
    points = helix(np.sort(random.uniform(0.0, 6.0, 14)))
    curve = Curve(points)
    arc = np.linspace(0.0, curve.length, 57)
    fine = curve.at(np.linspace(0.0, curve.length, 56 * 200 + 1))
    chords = np.linalg.norm(np.diff(fine, axis=0), axis=1).reshape(56, 200).sum(axis=1)
    assert np.abs(chords - arc[1]).max() <= tolerances.ARC_STEP_MM
    assert np.linalg.norm(curve.tangents(arc), axis=1) == pytest.approx(np.ones(57))


def test_two_points_are_a_straight_line_and_repeated_ones_count_once():
    curve = Curve([(0, 0, 0), (0, 0, 0), (3, 4, 0), (3, 4, 0)])
    assert curve.length == pytest.approx(5.0) and len(curve.points) == 2
    assert curve.at([2.5])[0] == pytest.approx((1.5, 2.0, 0.0))
    assert curve.smallest_radius() == np.inf


def test_frames_of_a_helix_turn_back_by_its_torsion():
    """The frame without twist turns against the Frenet frame by the torsion: analytic for a helix."""
    radius, pitch = 20.0, 30.0
    t = np.linspace(0.0, 4.0 * np.pi, 2000)
    rise = pitch / (2.0 * np.pi)
    speed = np.hypot(radius, rise)
    tangents = np.stack([-radius * np.sin(t), radius * np.cos(t), rise + 0.0 * t], axis=1) / speed
    inward = np.stack([-np.cos(t), -np.sin(t), 0.0 * t], axis=1)
    normals = rotation_minimising_normals(helix(t), tangents, inward[0])
    binormals = np.cross(tangents, inward)
    turned = np.unwrap(np.arctan2((normals * binormals).sum(axis=1), (normals * inward).sum(axis=1)))
    assert np.abs(turned + rise / speed * t).max() <= tolerances.FRAME_RADIANS
    assert np.abs((normals * tangents).sum(axis=1)).max() < 1e-12


def test_frames_are_of_fourth_order():
    """Half the step leaves a sixteenth of the error, on a curve whose bend and torsion change."""

    def last_normal(count):
        t = np.linspace(0.0, 2.0, count)
        places = np.stack([t, t**2, 0.7 * t**3], axis=1)
        tangents = np.stack([np.ones_like(t), 2.0 * t, 2.1 * t**2], axis=1)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        return rotation_minimising_normals(places, tangents, (0.0, 1.0, 0.0))[-1]

    truth = last_normal(5000)
    errors = [np.linalg.norm(last_normal(count) - truth) for count in (21, 41, 81)]
    assert 12.0 < errors[0] / errors[1] < 20.0 and 12.0 < errors[1] / errors[2] < 20.0


def test_frames_of_a_plane_curve_stay_in_it_or_across_it():
    curve = Curve(arc_points(150.0, 20))
    arc = np.linspace(0.0, curve.length, 300)
    normals = rotation_minimising_normals(curve.at(arc), curve.tangents(arc), (1.0, 0.0, 0.0))
    assert np.abs(normals - (1.0, 0.0, 0.0)).max() < 1e-9


@pytest.mark.parametrize("angle", [0.0, 90.0, -35.0])
def test_straightened_rows_lie_across_the_curve(angle):
    turn = rotation((25.0, -40.0, 10.0))
    curve = Curve(helix(np.linspace(0.0, 3.0, 9)) @ turn.T)
    made = straightened_sheet(curve, turn[:, 0], (41, 100), curve.length / 100, angle)
    sheet = made.sheet
    tangents = curve.tangents(made.arc)
    assert np.abs((sheet.steps * tangents).sum(axis=1)).max() < 1e-9
    assert np.abs((sheet.normals * tangents).sum(axis=1)).max() < 1e-9
    assert np.linalg.norm(sheet.steps, axis=1) == pytest.approx(np.full(100, curve.length / 100))
    assert sheet.points()[:, 20] == pytest.approx(curve.at(made.arc))
    assert np.linalg.det(np.stack([sheet.steps, tangents, sheet.normals], axis=1)).min() > 0.0  # right, down, into it
    right, depth = sheet.steps, sheet.normals
    wanted = np.cos(np.radians(angle)) * right - np.sin(np.radians(angle)) * curve.length / 100 * depth
    sides = np.cross(wanted, turn[:, 0])
    assert abs((sides * tangents).sum(axis=1).mean()) < 1e-3 * curve.length  # on the mean to neither side


def test_stretched_sheets_are_isometric():
    """The metric of an unrolled cylinder: steps along rows, across them and aslant are as long as in the picture."""
    curve = Curve(helix(np.linspace(0.0, 1.5, 12)))
    across = np.array([0.0, 0.0, 1.0])
    length = stretched_length(curve, across)
    assert length == pytest.approx(20.0 * 1.5, rel=tolerances.ARC_LENGTH)  # of the helix's circle
    pixel = length / 400
    made = stretched_sheet(curve, across, (101, 400), pixel)
    points = made.sheet.points()
    axes = np.stack([made.sheet.steps[:-1], np.diff(points[:, 50], axis=0), made.sheet.normals[:-1]], axis=1)
    assert np.linalg.det(axes).min() > 0.0  # right, down, into it
    down = np.linalg.norm(points[1:] - points[:-1], axis=-1)
    aslant = np.linalg.norm(points[1:, 1:] - points[:-1, :-1], axis=-1)
    assert np.abs(down / pixel - 1.0).max() <= tolerances.ISOMETRY
    assert np.abs(aslant / (pixel * np.sqrt(2.0)) - 1.0).max() <= tolerances.ISOMETRY
    drawn = np.stack([made.columns, np.arange(400.0)], axis=1) * pixel
    way = np.linalg.norm(np.diff(drawn, axis=0), axis=1)
    assert way == pytest.approx(np.diff(made.arc), rel=tolerances.ISOMETRY)  # the centre line is as long as it is


def test_rows_beyond_the_ends_have_no_arc_length():
    curve = Curve([(0, 0, 0), (0, 0, 10)])
    for make in (straightened_sheet, stretched_sheet):
        made = make(curve, np.array([1.0, 0.0, 0.0]), (5, 20), 1.0)
        assert np.isnan(made.arc).tolist() == [True] * 5 + [False] * 10 + [True] * 5
        assert made.arc[5:15] == pytest.approx(np.arange(10) + 0.5)


def test_what_is_no_centre_line_is_refused():
    for points, says in [
        ([(1, 2, 3)], "at least two"),
        ([(1, 2, 3)] * 4, "at least two"),
        ([(1, 2)], r"\(n, 3\)"),
        ("abc", "array of points"),
        ([(0, 0, 0), (1, np.nan, 2)], "point 1"),
        ([(0, 0, 0), (1, 1, 2), (1e9, 0, 0)], "point 2"),
    ]:
        with pytest.raises(UsageError, match=says):
            Curve(points)
    along = Curve([(0, 0, 0), (0, 0, 10)])
    for make in (straightened_sheet, stretched_sheet):
        with pytest.raises(UsageError, match="another view"):
            make(along, np.array([0.0, 0.0, 1.0]), (5, 5), 1.0)


def test_points_outside_of_the_volume_are_named():
    volume = Volume(np.zeros((10, 10, 10), np.int16), np.eye(4))
    Curve([(0, 0, 0), (9.5, 9.5, 9.5)]).check_within(volume)
    with refused(UsageError, "LPS", 1, 3, 2):
        Curve([(0, 0, 0), (1, 1, 1), (5, 12, 9)]).check_within(volume)
