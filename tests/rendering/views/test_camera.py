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
    """A volume of so many voxels along x, y and z around `CENTRE`."""
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = CENTRE - 0.5 * (np.array(size) - 1) * spacing
    return Volume(np.zeros(size[::-1], np.int16), affine)


def sheared() -> Volume:
    """A volume whose slices are shifted against each other."""
    affine = np.array([[0.6, 0.2, 0.1, -30.0], [-0.2, 0.8, 0.9, 20.0], [0.1, 0.0, -2.0, 5.0], [0, 0, 0, 1]])
    return Volume(np.zeros((17, 30, 25), np.int16), affine)


def uneven() -> Volume:
    """Four slices of 13 x 21 voxels of 1 mm, the third of which lies 30 mm behind the others."""
    positions = np.array([[0.0, 0, 0], [0, 0, 1.25], [0, 30, 2.4], [0, 0, 30.0]]) + CENTRE
    affine = np.eye(4)
    affine[:3, 2] = (positions[-1] - positions[0]) / 3
    affine[:3, 3] = positions[0]
    return Volume(np.zeros((4, 21, 13), np.int16), affine, slice_positions=positions)


of_each_projection = pytest.mark.parametrize("perspective", [None, 40.0], ids=["parallel", "perspective"])


@of_each_projection
@pytest.mark.parametrize("view", DIRECTIONS)
def test_each_view_has_the_sides_of_the_patient_where_a_radiologist_expects_them(view, perspective):
    camera = Camera.fit(box(), view, view_angle=perspective, size=SIZE)

    pixels, depths = camera.project(list(MARKS.values()), SIZE)

    names = list(MARKS)
    rightmost, topmost, nearest = pixels[:, 0].argmax(), pixels[:, 1].argmin(), depths.argmin()
    assert (names[rightmost], names[topmost]) == RIGHT_AND_TOP[view]
    assert names[nearest] == view


@of_each_projection
@pytest.mark.parametrize("view", DIRECTIONS)
def test_sides_of_the_patient_lie_on_the_middle_lines_of_each_view(view, perspective):
    right, top = RIGHT_AND_TOP[view]
    camera = Camera.fit(box(), view, view_angle=perspective, size=SIZE)

    pixels, _ = camera.project([MARKS[right], MARKS[top]], SIZE)

    assert pixels[0, 1] == pytest.approx(SIZE[1] / 2)
    assert pixels[1, 0] == pytest.approx(SIZE[0] / 2)


@pytest.mark.parametrize(
    ("angles", "name"),
    [((0, 0), "anterior"), ((90, 0), "left"), ((180, 0), "posterior"), ((-90, 0), "right"), ([270, 0], "right")]
    + [((0.0, 90.0), "superior"), ((0, -90), "inferior"), (" Anterior ", "anterior")],
    ids=str,
)
def test_angles_of_a_side_are_the_view_that_it_names(angles, name):
    assert Camera.fit(box(), angles) == Camera.fit(box(), name)


def test_azimuth_goes_to_the_left_and_elevation_to_the_head():
    camera = Camera.fit(box(), (30, 20))
    towards = np.subtract(camera.position, camera.focal_point) / camera.distance
    cosine = np.cos(np.radians(20.0))
    assert towards == pytest.approx([0.5 * cosine, -np.sqrt(0.75) * cosine, np.sin(np.radians(20.0))])
    assert camera.up == (0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("text", "view"), [pytest.param("left", "left", id="name"), pytest.param("25,-10.5", (25.0, -10.5), id="angles")]
)
def test_view_of_an_option_is_read_and_said_again(text, view):
    read = read_view(text)

    assert read == view
    assert say_view(read) == text


def test_option_of_three_angles_is_refused():
    with refused(UsageError, "'1,2,3'", "AZIMUTH,ELEVATION"):
        read_view("1,2,3")


@pytest.mark.parametrize(
    ("angles", "top"),
    [pytest.param((90, 90), "left", id="over the head"), pytest.param((180, -90), "posterior", id="under the feet")],
)
def test_side_of_the_azimuth_is_at_the_top_of_a_view_along_the_body(angles, top):
    assert Camera.fit(box(), angles).up == DIRECTIONS[top]


@pytest.mark.parametrize(
    ("view", "up", "expected"),
    [
        pytest.param("superior", "posterior", (0.0, 1.0, 0.0), id="name"),
        pytest.param("anterior", (1, 0, 0), (1.0, 0.0, 0.0), id="direction"),
    ],
)
def test_top_of_a_view_is_the_side_that_is_chosen(view, up, expected):
    assert Camera.fit(box(), view, up=up).basis().up == pytest.approx(expected)


def test_right_of_a_view_turns_with_the_top_that_is_chosen():
    assert Camera.fit(box(), "superior", up="posterior").basis().right == pytest.approx([1.0, 0.0, 0.0])


def in_picture(camera: Camera, volume: Volume, size) -> np.ndarray:
    """Which corners of a volume are within a picture, to a millionth of a pixel."""
    pixels, _ = camera.project(box_corners(volume), size)
    return np.asarray(((pixels >= -1e-6) & (pixels <= np.array(size) + 1e-6)).all(axis=1))


def some_views() -> list:
    """The named views and five others."""
    rng = np.random.default_rng(3)
    return [*DIRECTIONS, *zip(rng.uniform(-180, 180, 5), rng.uniform(-90, 90, 5), strict=True)]


def of_volumes_in_pictures(test):
    """Run a test of volumes of every kind, in parallel and perspective, in pictures of every shape."""
    test = pytest.mark.parametrize("make", [box, sheared, uneven])(test)
    test = pytest.mark.parametrize("perspective", daily(1, [50.0, None]))(test)
    return pytest.mark.parametrize("size", daily(1, [(400, 300), (300, 400), (512, 512)]))(test)


@of_volumes_in_pictures
def test_whole_volume_is_in_the_picture_of_any_view(make, perspective, size):
    volume = make()

    cameras = {view: Camera.fit(volume, view, view_angle=perspective, size=size) for view in some_views()}

    assert [view for view, camera in cameras.items() if not in_picture(camera, volume, size).all()] == []


@of_volumes_in_pictures
def test_whole_volume_stays_in_the_picture_of_a_camera_for_turning(make, perspective, size):
    volume = make()

    cameras = {
        (view, turn): Camera.fit(volume, view, view_angle=perspective, size=size, turning=True).orbit(turn)
        for view in some_views()
        for turn in (0.0, 47.0, 133.0, 271.0)
    }

    assert [turned for turned, camera in cameras.items() if not in_picture(camera, volume, size).all()] == []


MARGIN = 1.02  # a fitted picture shows this many times what it has to
LEAST_OF_PERSPECTIVE = 0.80  # measured 0.92 and more
"""Perspective pictures are fitted about the middle, which lies nearer to one side of what is seen."""


@pytest.mark.parametrize(
    ("perspective", "least"),
    [pytest.param(None, 1 / MARGIN - 1e-9, id="parallel"), pytest.param(50.0, LEAST_OF_PERSPECTIVE, id="perspective")],
)
@pytest.mark.parametrize("view", ["anterior", "left", "superior", (35, 20)])
@pytest.mark.parametrize("size", [(400, 300), (300, 400)], ids=["landscape", "portrait"])
def test_fitted_volume_fills_the_picture_but_for_a_margin(perspective, least, view, size):
    volume = box()

    camera = Camera.fit(volume, view, view_angle=perspective, size=size)

    pixels, _ = camera.project(box_corners(volume), size)
    filled = np.ptp(pixels, axis=0) / size
    assert least <= filled.max() <= 1.0


def test_corners_of_a_volume_are_half_a_voxel_out():
    size, spacing = np.array([40, 50, 60]), np.array([0.7, 0.5, 2.5])

    corners = box_corners(box(size, spacing))

    half = 0.5 * size * spacing
    assert corners.min(axis=0) == pytest.approx(CENTRE - half)
    assert corners.max(axis=0) == pytest.approx(CENTRE + half)


def test_fitted_camera_looks_at_the_middle_of_the_volume():
    assert Camera.fit(box()).focal_point == pytest.approx(tuple(CENTRE))


def test_corners_of_an_uneven_stack_reach_around_the_slices_that_stick_out():
    corners = box_corners(uneven())

    half_below, half_above = 1.25 / 2, (30.0 - 2.4) / 2  # half the way to the next slice
    assert corners[:, 1].max() == pytest.approx(CENTRE[1] + 30.0 + 20.5)  # the third slice, of 21 rows
    assert corners[:, 2].min() == pytest.approx(CENTRE[2] - half_below)
    assert corners[:, 2].max() == pytest.approx(CENTRE[2] + 30.0 + half_above)


of_a_zoomed_camera = pytest.mark.parametrize("perspective", [None, 35.0], ids=["parallel", "perspective"])


def zoomed(perspective: float | None) -> Camera:
    """A camera of a sheared volume, seen aslant and 1.7 times as large as it fits into 7 x 5 pixels."""
    return Camera.fit(sheared(), (40, -25), view_angle=perspective, size=(7, 5)).zoomed(1.7)


@of_a_zoomed_camera
def test_points_on_rays_project_to_their_pixels_and_depths(perspective):
    camera = zoomed(perspective)
    origins, directions = camera.rays((7, 5))
    depth = np.random.default_rng(1).uniform(0.1, 300.0, (5, 7))

    pixels, depths = camera.project((origins + depth[..., None] * directions).reshape(-1, 3), (7, 5))

    y, x = np.mgrid[:5, :7] + 0.5
    assert np.abs(pixels - np.column_stack([x.ravel(), y.ravel()])).max() <= tolerances.FLOAT64_PLACE_MM
    assert np.abs(depths - depth.ravel()).max() <= tolerances.FLOAT64_PLACE_MM


@of_a_zoomed_camera
def test_every_pixel_has_a_ray_of_unit_direction(perspective):
    origins, directions = zoomed(perspective).rays((7, 5))

    assert origins.shape == directions.shape == (5, 7, 3)
    assert np.linalg.norm(directions, axis=2) == pytest.approx(1.0)


FROM_THE_FRONT = {"position": (0, -100, 0), "focal_point": (0, 0, 0), "up": (0, 0, 1)}


def test_parallel_rays_start_at_their_pixels_and_run_forward():
    camera = Camera(**{**FROM_THE_FRONT, "up": (0, 0, 2)}, parallel_scale=10.0)

    origins, directions = camera.rays(size=(4, 2))

    # Two rows over 2 x 10 mm: pixels of 10 mm, whose centres are 5 and 15 mm from the middle.
    assert origins[0, 0] == pytest.approx([-15.0, -100.0, 5.0])
    assert origins[1, 3] == pytest.approx([15.0, -100.0, -5.0])
    assert directions[1, 2] == pytest.approx([0.0, 1.0, 0.0])


def test_pixels_of_a_parallel_camera_share_twice_its_scale():
    camera = Camera(**FROM_THE_FRONT, parallel_scale=10.0)

    assert camera.pixel_mm(size=(4, 2)) == 2 * 10.0 / 2  # in two rows


def test_perspective_rays_start_at_the_camera_and_run_through_their_pixels():
    camera = Camera(**FROM_THE_FRONT, view_angle=90.0)

    origins, directions = camera.rays(size=(4, 2))

    # At 90 degrees the two rows are as tall as twice the distance: pixels of 1 at a distance of 1.
    assert origins[1, 2] == pytest.approx([0.0, -100.0, 0.0])
    assert directions[0, 3] == pytest.approx(np.array([1.5, 1.0, 0.5]) / np.sqrt(3.5))


def test_pixels_of_a_perspective_camera_are_those_at_its_focal_point():
    camera = Camera(**FROM_THE_FRONT, view_angle=90.0)

    assert camera.pixel_mm(size=(4, 2)) == pytest.approx(2 * 100.0 / 2)  # as tall as twice the distance, in two rows


def test_points_beside_and_behind_a_perspective_camera_are_nowhere():
    camera = Camera(**FROM_THE_FRONT, view_angle=90.0)

    pixels, depths = camera.project([[0, -101, 0], [5, -100, 0], [0, -99, 0]], (4, 4))

    assert np.isnan(pixels).all(axis=1).tolist() == [True, True, False]
    assert np.isnan(depths).tolist() == [True, True, False]


def test_points_behind_a_parallel_camera_have_depths_below_zero():
    camera = Camera(**FROM_THE_FRONT, parallel_scale=10.0)

    _, depths = camera.project([[0, -101, 0]], (4, 4))

    assert depths == pytest.approx([-1.0])


ORBITS = [(30, 0), (-120, 40), (360, 0), (45, 90), (10, -90)]


@pytest.mark.parametrize(("azimuth", "elevation"), ORBITS)
def test_orbit_from_the_front_leads_to_the_view_of_its_angles(azimuth, elevation):
    start = Camera.fit(box(), "anterior")

    turned = start.orbit(azimuth, elevation)

    truth = Camera.fit(box(), (azimuth, elevation))
    sign = -1.0 if elevation == 90 else 1.0  # tilted over the head from the front, the back is at the top
    assert turned.position == pytest.approx(truth.position)  # parallel cameras stand two radii away
    assert turned.basis().up == pytest.approx(sign * truth.basis().up)


@pytest.mark.parametrize(("azimuth", "elevation"), ORBITS)
def test_orbit_keeps_the_scale(azimuth, elevation):
    start = Camera.fit(box(), "anterior")

    assert start.orbit(azimuth, elevation).parallel_scale == start.parallel_scale


def test_camera_is_fitted_to_a_square_picture_unless_a_size_is_given():
    flat = box(size=(40, 50, 5))  # its width decides the scale

    assert Camera.fit(flat) == Camera.fit(flat, size=(7, 7))
    assert Camera.fit(flat) != Camera.fit(flat, size=(1025, 1024))  # nearly square


of_zoomed_projections = pytest.mark.parametrize("perspective", [None, 60.0], ids=["parallel", "perspective"])


@of_zoomed_projections
def test_zoom_magnifies_about_the_middle_of_the_picture(perspective):
    camera = Camera.fit(box(), view_angle=perspective, size=SIZE)
    wide, _ = camera.project([CENTRE + (3, 0, 4)], SIZE)

    narrow, _ = camera.zoomed(2.5).project([CENTRE + (3, 0, 4)], SIZE)

    middle = np.array(SIZE) / 2
    assert narrow[0] - middle == pytest.approx(2.5 * (wide[0] - middle))


@of_zoomed_projections
def test_zoom_of_a_fit_is_that_of_the_fitted_camera(perspective):
    camera = Camera.fit(box(), view_angle=perspective, size=SIZE)

    assert Camera.fit(box(), zoom=2.5, view_angle=perspective, size=SIZE) == camera.zoomed(2.5)


@pytest.mark.parametrize(
    "view", ["front", "", "1,2,3", "10", (1,), (0, 91), "25,10", (np.nan, 0), (np.inf, 0), 5, None, ("a", "b")]
)
def test_unknown_view_is_refused_with_how_to_say_one(view):
    with refused(UsageError, "azimuth", "elevation"):
        Camera.fit(box(), view)


IMPOSSIBLE_FITS = {
    "unknown top": ({"up": "top"}, "anterior, posterior, left"),
    "top of two numbers": ({"up": (1, 2)}, "three finite numbers"),
    "top along the view": ({"up": "posterior"}, "runs along its view"),
    "zoom 0": ({"zoom": 0}, "zoom is a positive number"),
    "zoom in words": ({"zoom": "big"}, "zoom is a positive number"),
    "view angle 180": ({"view_angle": 180}, "between 0.001 and 179"),
    "width 0": ({"size": (0, 10)}, "from 1 to 16384"),
    "height beyond the most": ({"size": (10, 1e6)}, "from 1 to 16384"),
    "width of half pixels": ({"size": (10.5, 10)}, "from 1 to 16384"),
    "size of one number": ({"size": 10}, "from 1 to 16384"),
}


@pytest.mark.parametrize(("arguments", "message"), IMPOSSIBLE_FITS.values(), ids=IMPOSSIBLE_FITS)
def test_impossible_fit_is_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        Camera.fit(box(), **arguments)


IMPOSSIBLE_CAMERAS = {
    "position at the focal point": ({"position": (0, 0, 0)}, "focal"),
    "position of no number": ({"position": (0, 0, np.nan)}, "position"),
    "top along the view": ({"up": (0, 1, 0)}, "up"),
    "top of no direction": ({"up": (0, 0, 0)}, "up"),
    "perspective and parallel": ({"view_angle": 30, "parallel_scale": 10}, "both"),
    "view angle 0": ({"view_angle": 0}, "angle"),
    "view angle in words": ({"view_angle": "wide"}, "angle"),
    "negative scale": ({"parallel_scale": -1}, "scale"),
    "infinite scale": ({"parallel_scale": np.inf}, "scale"),
}


@pytest.mark.parametrize(("arguments", "fact"), IMPOSSIBLE_CAMERAS.values(), ids=IMPOSSIBLE_CAMERAS)
def test_impossible_camera_is_refused(arguments, fact):
    with refused(UsageError, "camera", fact):
        Camera(**{**FROM_THE_FRONT, **arguments})


def test_orbit_of_no_number_is_refused():
    with refused(UsageError, "camera", "nan"):
        Camera.fit(box()).orbit(np.nan)


HUGE = 10**400
"""A whole number that no float holds."""


TOO_LARGE = {
    "view angle": (lambda camera: Camera(**FROM_THE_FRONT, view_angle=HUGE), "view angle"),
    "parallel scale": (lambda camera: Camera(**FROM_THE_FRONT, parallel_scale=HUGE), "parallel scale"),
    "position": (lambda camera: Camera(**{**FROM_THE_FRONT, "position": (0, -HUGE, 0)}), "position of a camera"),
    "zoom": (lambda camera: camera.zoomed(HUGE), "zoom"),
    "orbit": (lambda camera: camera.orbit(HUGE), "orbits by"),
    "point": (lambda camera: camera.project([(HUGE, 0, 0)], SIZE), "points"),
    "view": (lambda camera: Camera.fit(box(), (HUGE, 0)), "view"),
    "centre": (lambda camera: Camera.fit(box(), center=(0, 0, HUGE)), "centre"),
}


@pytest.mark.parametrize(("make", "words"), TOO_LARGE.values(), ids=TOO_LARGE)
def test_number_too_large_for_a_float_is_refused(make, words):
    with pytest.raises(UsageError, match=words):
        make(Camera.fit(box()))


CENTRES = {
    "a corner": lambda low, high: low,
    "the other corner": lambda low, high: high,
    "beyond a corner": lambda low, high: 3.0 * low - 2.0 * high,
    "beyond the other corner": lambda low, high: 3.0 * high - 2.0 * low,
}
of_each_centre = pytest.mark.parametrize("at", CENTRES.values(), ids=CENTRES)


@of_each_centre
@pytest.mark.parametrize("view", [*DIRECTIONS, (30, 40)])
def test_parallel_camera_with_a_centre_stays_a_radius_outside_of_the_volume(view, at):
    corners = box_corners(sheared())
    radius = np.linalg.norm(corners - corners.mean(axis=0), axis=1).max()

    camera = Camera.fit(sheared(), view, center=at(corners.min(axis=0), corners.max(axis=0)))

    depths = (corners - camera.position) @ camera.basis().forward
    assert depths.min() >= radius - tolerances.FLOAT64_PLACE_MM


@of_each_centre
@pytest.mark.parametrize("view", [*DIRECTIONS, (30, 40)])
def test_centre_of_a_camera_is_in_the_middle_of_the_picture(view, at):
    corners = box_corners(sheared())
    center = at(corners.min(axis=0), corners.max(axis=0))

    camera = Camera.fit(sheared(), view, center=center)

    pixels, _ = camera.project([center], SIZE)
    assert pixels[0] == pytest.approx(np.array(SIZE) / 2)


def plane_of_fifteen_pixels():
    """A plane of 5 x 3 pixels 2 mm behind the focal point of a camera that shows 12 mm: pixels of 4 mm."""
    camera = Camera(position=(7, -50, 9), focal_point=(7, 0, 9), up=(0, 0, 1), parallel_scale=6.0)
    return plane_sheet(camera, size=(5, 3), offset_mm=2.0)


@pytest.mark.unit
def test_pixels_of_a_plane_lie_about_the_focal_point() -> None:
    sheet, _ = plane_of_fifteen_pixels()

    assert sheet.width == 5
    assert sheet.origins.tolist() == [[-1, 2, 13], [-1, 2, 9], [-1, 2, 5]]
    assert sheet.steps.tolist() == [[4, 0, 0]] * 3
    assert sheet.normals.tolist() == [[0, 1, 0]] * 3


@pytest.mark.unit
def test_camera_of_a_plane_moves_with_its_offset() -> None:
    _, own = plane_of_fifteen_pixels()

    assert own == Camera(position=(7, -50 + 2, 9), focal_point=(7, 0 + 2, 9), up=(0, 0, 1), parallel_scale=6.0)
