"""Cameras: anatomical sides, rays and their inverse, what fits into a picture, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from variants import daily

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.rendering.views.directions import DIRECTIONS, read_view, say_view
from clrecon.rendering.views.reformation import plane_sheet

CENTRE = np.array([12.0, -30.0, 850.0])
MARKS = {name: CENTRE + 20.0 * np.array(direction) for name, direction in DIRECTIONS.items()}
"""One point at each side of a patient, none of them symmetric to another in any picture."""

SIZE = (400, 300)

RIGHT_AND_TOP = {
    "anterior": ("left", "superior"),
    "posterior": ("right", "superior"),
    "left": ("posterior", "superior"),
    "right": ("anterior", "superior"),
    "superior": ("right", "anterior"),
    "inferior": ("left", "anterior"),  # as axial slices are shown
}


def box(size=(40, 50, 60), spacing=(0.7, 0.5, 2.5)) -> Volume:
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = CENTRE - 0.5 * (np.array(size) - 1) * spacing
    return Volume(np.zeros(size[::-1], np.int16), affine)


def sheared() -> Volume:
    affine = np.array([[0.6, 0.2, 0.1, -30.0], [-0.2, 0.8, 0.9, 20.0], [0.1, 0.0, -2.0, 5.0], [0, 0, 0, 1]])
    return Volume(np.zeros((17, 30, 25), np.int16), affine)


def uneven() -> Volume:
    positions = np.array([[0.0, 0, 0], [0, 0, 1.25], [0, 30, 2.4], [0, 0, 30.0]]) + CENTRE
    affine = np.eye(4)
    affine[:3, 2] = (positions[-1] - positions[0]) / 3
    affine[:3, 3] = positions[0]
    return Volume(np.zeros((4, 21, 13), np.int16), affine, slice_positions=positions)


@pytest.mark.parametrize("perspective", [None, 40.0])
@pytest.mark.parametrize("view", DIRECTIONS)
def test_each_view_has_the_sides_of_the_patient_where_a_radiologist_expects_them(view, perspective):
    camera = Camera.fit(box(), view, view_angle=perspective, size=SIZE)
    right, top = RIGHT_AND_TOP[view]
    names = list(MARKS)
    pixels, depths = camera.project(list(MARKS.values()), SIZE)
    place = dict(zip(names, pixels, strict=True))
    assert names[pixels[:, 0].argmax()] == right
    assert names[pixels[:, 1].argmin()] == top
    assert names[depths.argmin()] == view
    assert place[right][1] == pytest.approx(150.0) and place[top][0] == pytest.approx(200.0)


@pytest.mark.parametrize(
    ("angles", "name"),
    [((0, 0), "anterior"), ((90, 0), "left"), ((180, 0), "posterior"), ((-90, 0), "right"), ([270, 0], "right")]
    + [((0.0, 90.0), "superior"), ((0, -90), "inferior"), (" Anterior ", "anterior")],
)
def test_angles_name_the_same_views(angles, name):
    assert Camera.fit(box(), angles) == Camera.fit(box(), name)


def test_azimuth_goes_to_the_left_and_elevation_to_the_head():
    camera = Camera.fit(box(), (30, 20))
    towards = np.subtract(camera.position, camera.focal_point) / camera.distance
    cosine = np.cos(np.radians(20.0))
    assert towards == pytest.approx([0.5 * cosine, -np.sqrt(0.75) * cosine, np.sin(np.radians(20.0))])
    assert camera.up == (0.0, 0.0, 1.0)


def test_an_option_says_angles_with_a_comma_and_is_said_so():
    for text, view in (("left", "left"), ("25,-10.5", (25.0, -10.5))):
        assert read_view(text) == view and say_view(read_view(text)) == text
    with refused(UsageError, "AZIMUTH", "ELEVATION", 1, 3, 30):
        read_view("1,2,3")


def test_over_the_head_the_side_of_the_azimuth_is_at_the_top():
    assert Camera.fit(box(), (90, 90)).up == DIRECTIONS["left"]
    assert Camera.fit(box(), (180, -90)).up == DIRECTIONS["posterior"]


def test_the_top_can_be_chosen():
    camera = Camera.fit(box(), "superior", up="posterior")
    assert camera.basis().up == pytest.approx([0.0, 1.0, 0.0])
    assert camera.basis().right == pytest.approx([1.0, 0.0, 0.0])
    assert Camera.fit(box(), "anterior", up=(1, 0, 0)).basis().up == pytest.approx([1.0, 0.0, 0.0])


def in_picture(camera: Camera, volume: Volume, size) -> np.ndarray:
    pixels, _ = camera.project(box_corners(volume), size)
    return np.asarray(((pixels >= -1e-6) & (pixels <= np.array(size) + 1e-6)).all(axis=1))


@pytest.mark.parametrize("size", daily(1, [(400, 300), (300, 400), (512, 512)]))
@pytest.mark.parametrize("perspective", daily(1, [50.0, None]))
@pytest.mark.parametrize("make", [box, sheared, uneven])
def test_the_whole_volume_is_in_the_picture_of_any_view(make, perspective, size):
    volume = make()
    rng = np.random.default_rng(3)
    for view in [*DIRECTIONS, *zip(rng.uniform(-180, 180, 5), rng.uniform(-90, 90, 5), strict=True)]:
        camera = Camera.fit(volume, view, view_angle=perspective, size=size)
        assert in_picture(camera, volume, size).all()
        turning = Camera.fit(volume, view, view_angle=perspective, size=size, turning=True)
        for turn in (0.0, 47.0, 133.0, 271.0):
            assert in_picture(turning.orbit(turn), volume, size).all()


@pytest.mark.parametrize("perspective", [None, 50.0])
@pytest.mark.parametrize("view", ["anterior", "left", "superior", (35, 20)])
@pytest.mark.parametrize("size", [(400, 300), (300, 400)])
def test_a_fitted_volume_fills_the_picture_but_for_a_margin(perspective, view, size):
    volume = box()
    camera = Camera.fit(volume, view, view_angle=perspective, size=size)
    pixels, _ = camera.project(box_corners(volume), size)
    filled = np.ptp(pixels, axis=0) / size
    # Perspective pictures are fitted about the middle, which lies nearer to one side of what is seen.
    assert (0.80 if perspective else 1 / 1.02 - 1e-9) <= filled.max() <= 1.0


def test_the_corners_are_half_a_voxel_out():
    corners = box_corners(box())
    half = 0.5 * np.array([40, 50, 60]) * (0.7, 0.5, 2.5)
    assert corners.min(axis=0) == pytest.approx(CENTRE - half)
    assert corners.max(axis=0) == pytest.approx(CENTRE + half)
    assert Camera.fit(box()).focal_point == pytest.approx(tuple(CENTRE))


def test_slices_that_stick_out_of_an_uneven_stack_are_in_the_picture_too():
    corners = box_corners(uneven())
    assert corners[:, 1].max() == pytest.approx(CENTRE[1] + 30.0 + 20.5)
    assert corners[:, 2].min() == pytest.approx(CENTRE[2] - 0.625)
    assert corners[:, 2].max() == pytest.approx(CENTRE[2] + 30.0 + 13.8)


@pytest.mark.parametrize("perspective", [None, 35.0])
def test_points_on_rays_project_to_their_pixels(perspective):
    camera = Camera.fit(sheared(), (40, -25), view_angle=perspective, size=(7, 5)).zoomed(1.7)
    origins, directions = camera.rays((7, 5))
    assert origins.shape == directions.shape == (5, 7, 3)
    depth = np.random.default_rng(1).uniform(0.1, 300.0, (5, 7))
    pixels, depths = camera.project((origins + depth[..., None] * directions).reshape(-1, 3), (7, 5))
    y, x = np.mgrid[:5, :7] + 0.5
    assert np.abs(pixels - np.column_stack([x.ravel(), y.ravel()])).max() <= tolerances.FLOAT64_PLACE_MM
    assert np.abs(depths - depth.ravel()).max() <= tolerances.FLOAT64_PLACE_MM
    assert np.linalg.norm(directions, axis=2) == pytest.approx(1.0)


def test_a_parallel_ray_is_where_the_definition_says():
    camera = Camera((0, -100, 0), (0, 0, 0), (0, 0, 2), parallel_scale=10.0)
    origins, directions = camera.rays((4, 2))
    assert origins[0, 0] == pytest.approx([-15.0, -100.0, 5.0])
    assert origins[1, 3] == pytest.approx([15.0, -100.0, -5.0])
    assert directions[1, 2] == pytest.approx([0.0, 1.0, 0.0])
    assert camera.pixel_mm((4, 2)) == 10.0


def test_a_perspective_ray_is_where_the_definition_says():
    camera = Camera((0, -100, 0), (0, 0, 0), (0, 0, 1), view_angle=90.0)
    origins, directions = camera.rays((4, 2))
    assert origins[1, 2] == pytest.approx([0.0, -100.0, 0.0])
    assert directions[0, 3] == pytest.approx(np.array([1.5, 1.0, 0.5]) / np.sqrt(3.5))
    assert camera.pixel_mm((4, 2)) == pytest.approx(100.0)


def test_points_behind_a_perspective_camera_are_nowhere():
    camera = Camera((0, -100, 0), (0, 0, 0), (0, 0, 1), view_angle=90.0)
    pixels, depths = camera.project([[0, -101, 0], [5, -100, 0], [0, -99, 0]], (4, 4))
    assert np.isnan(pixels[:2]).all() and np.isnan(depths[:2]).all()
    assert depths[2] == pytest.approx(1.0)
    parallel = Camera((0, -100, 0), (0, 0, 0), (0, 0, 1), parallel_scale=10.0)
    assert parallel.project([[0, -101, 0]], (4, 4))[1] == pytest.approx([-1.0])


def test_an_orbit_counts_angles_as_views_do():
    start = Camera.fit(box(), "anterior")
    for azimuth, elevation in [(30, 0), (-120, 40), (360, 0), (45, 90), (10, -90)]:
        turned, truth = start.orbit(azimuth, elevation), Camera.fit(box(), (azimuth, elevation))
        assert turned.position == pytest.approx(truth.position)  # parallel cameras stand two radii away
        sign = -1.0 if elevation == 90 else 1.0  # tilted over the head from the front, the back is at the top
        assert turned.basis().up == pytest.approx(sign * truth.basis().up)
        assert turned.parallel_scale == start.parallel_scale


def test_a_picture_is_square_unless_asked_otherwise():
    flat = box(size=(40, 50, 5))  # its width decides the scale
    assert Camera.fit(flat) == Camera.fit(flat, size=(7, 7)) != Camera.fit(flat, size=(1025, 1024))


def test_zoom_magnifies():
    for perspective in (None, 60.0):
        camera = Camera.fit(box(), view_angle=perspective, size=SIZE)
        wide, _ = camera.project([CENTRE + (3, 0, 4)], SIZE)
        narrow, _ = camera.zoomed(2.5).project([CENTRE + (3, 0, 4)], SIZE)
        assert narrow[0] - (200, 150) == pytest.approx(2.5 * (wide[0] - (200, 150)))
        assert Camera.fit(box(), zoom=2.5, view_angle=perspective, size=SIZE) == camera.zoomed(2.5)


@pytest.mark.parametrize(
    "view", ["front", "", "1,2,3", "10", (1,), (0, 91), "25,10", (np.nan, 0), (np.inf, 0), 5, None, ("a", "b")]
)
def test_unknown_views_list_the_known_ones(view):
    with refused(UsageError, "azimuth", "elevation"):
        Camera.fit(box(), view)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"up": "top"}, "anterior, posterior, left"),
        ({"up": (1, 2)}, "three finite numbers"),
        ({"up": "posterior"}, "runs along its view"),
        ({"zoom": 0}, "zoom is a positive number"),
        ({"zoom": "big"}, "zoom is a positive number"),
        ({"view_angle": 180}, "between 0.001 and 179"),
        ({"size": (0, 10)}, "from 1 to 16384"),
        ({"size": (10, 1e6)}, "from 1 to 16384"),
        ({"size": (10.5, 10)}, "from 1 to 16384"),
        ({"size": 10}, "from 1 to 16384"),
    ],
)
def test_impossible_fits_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        Camera.fit(box(), **arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {"position": (0, 0, 0)},
        {"position": (0, 0, np.nan)},
        {"up": (0, 1, 0)},
        {"up": (0, 0, 0)},
        {"view_angle": 30, "parallel_scale": 10},
        {"view_angle": 0},
        {"view_angle": "wide"},
        {"parallel_scale": -1},
        {"parallel_scale": np.inf},
    ],
)
def test_impossible_cameras_are_refused(arguments):
    with refused(UsageError, "camera"):
        Camera(**{"position": (0, -100, 0), "focal_point": (0, 0, 0), "up": (0, 0, 1), **arguments})


def test_orbits_are_finite():
    with refused(UsageError, "camera", "nan"):
        Camera.fit(box()).orbit(np.nan)


HUGE = 10**400
"""A whole number that no float holds."""


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda camera: Camera((0, -9, 0), (0, 0, 0), (0, 0, 1), view_angle=HUGE), "view angle"),
        (lambda camera: Camera((0, -9, 0), (0, 0, 0), (0, 0, 1), parallel_scale=HUGE), "parallel scale"),
        (lambda camera: Camera((0, -HUGE, 0), (0, 0, 0), (0, 0, 1)), "position of a camera"),
        (lambda camera: camera.zoomed(HUGE), "zoom"),
        (lambda camera: camera.orbit(HUGE), "orbits by"),
        (lambda camera: camera.project([(HUGE, 0, 0)], SIZE), "points"),
        (lambda camera: Camera.fit(box(), (HUGE, 0)), "view"),
        (lambda camera: Camera.fit(box(), center=(0, 0, HUGE)), "centre"),
    ],
)
def test_a_number_too_large_for_a_float_is_refused(make, words):
    with pytest.raises(UsageError, match=words):
        make(Camera.fit(box()))


@pytest.mark.parametrize("view", [*DIRECTIONS, (30, 40)])
def test_a_parallel_camera_with_a_centre_stays_outside_of_the_volume(view):
    """Wherever in the volume the centre is, and beyond it."""
    volume = sheared()
    corners = box_corners(volume)
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle = corners[[0, 1, 2, 3, -4, -3, -2, -1]].mean(axis=0)
    radius = np.linalg.norm(corners - middle, axis=1).max()
    for center in (low, high, 3.0 * low - 2.0 * high, 3.0 * high - 2.0 * low):
        camera = Camera.fit(volume, view, center=center)
        depths = (corners - camera.position) @ camera.basis().forward
        assert depths.min() >= radius - 1e-6
        pixel, _ = camera.project([center], SIZE)
        np.testing.assert_allclose(pixel[0], (200.0, 150.0), atol=1e-6)


@pytest.mark.unit
def test_the_pixels_of_a_plane_lie_about_the_focal_point() -> None:
    camera = Camera((7.0, -50.0, 9.0), (7.0, 0.0, 9.0), (0.0, 0.0, 1.0), parallel_scale=6.0)
    sheet, own = plane_sheet(camera, (5, 3), 2.0)
    assert sheet.origins.tolist() == [[-1, 2, 13], [-1, 2, 9], [-1, 2, 5]] and sheet.width == 5
    assert sheet.steps.tolist() == [[4, 0, 0]] * 3 and sheet.normals.tolist() == [[0, 1, 0]] * 3
    assert own == Camera((7.0, -48.0, 9.0), (7.0, 2.0, 9.0), (0.0, 0.0, 1.0), parallel_scale=6.0)
