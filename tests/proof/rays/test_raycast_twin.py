"""The numpy twin of the raycaster, piece by piece against scipy, analysis and sums written out."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from raycast_scenes import STEPS, centre_of, even_volume, look, uneven_volume
from scipy.ndimage import map_coordinates

from clrecon.geometry.iso_rule import slice_normal_matrices
from clrecon.proof.rays.render import (
    TABLE_NODES,
    box_of,
    cast_rays,
    find_interval,
    hash_pixels,
    jitter_pixels,
    look_up,
    sample_field,
    shade,
    smooth_field,
    voxel_gradients,
)
from clrecon.rendering import UNSHADED, Lighting, TransferFunction
from clrecon.rendering.pictures.styles import Projection, VolumeLook
from clrecon.rendering.views.clip import Clip

SLOPE = np.array([3.0, -2.0, 5.0])


@pytest.mark.parametrize("shape", [(5, 6, 7), (1, 4, 3), (1, 1, 1), (2, 1, 5)])
def test_field_between_and_beyond_voxels_is_the_linear_interpolation_of_scipy(shape):
    rng = np.random.default_rng(3)
    voxels = rng.integers(-1000, 2000, shape).astype(np.int16)
    ijk = rng.uniform(-1.5, np.array(shape[::-1]) + 0.5, (500, 3))
    expected = map_coordinates(voxels.astype(np.float64), ijk.T[::-1], order=1, mode="nearest")
    assert np.abs(sample_field(voxels, ijk) - expected).max() <= tolerances.TRILINEAR * 1000  # of some 1000 HU


@pytest.mark.parametrize("shape", [(5, 6, 7), (1, 4, 3), (1, 1, 1), (2, 1, 5)])
def test_field_at_a_voxel_is_its_value_exactly(shape):
    voxels = np.random.default_rng(3).integers(-1000, 2000, shape).astype(np.int16)
    all_ijk = np.argwhere(np.ones(shape, bool))[:, ::-1].astype(float)
    assert np.array_equal(sample_field(voxels, all_ijk), voxels.ravel())


def linear_volume(steps):
    field = lambda p: p @ SLOPE  # noqa: E731
    volume = (
        uneven_volume(field, shape=(9, 8), gaps=(1.0, 0.4, 1.9, 1.0))
        if steps == "uneven"
        else even_volume(field, steps, extent=9.0)
    )
    return volume.with_voxels(volume.voxels.astype(np.float32))


@pytest.mark.parametrize("steps", [*STEPS, "uneven"])
def test_gradient_of_a_linear_field_is_its_slope_within_the_volume(steps):
    volume = linear_volume(steps)
    gradients = voxel_gradients(volume.voxels, slice_normal_matrices(volume, 0))
    inner = gradients[1:-1, 1:-1, 1:-1]
    assert np.abs(inner - SLOPE).max() <= 5e-6  # HU per mm: float32 values of some 50 HU; measured 2e-6


@pytest.mark.parametrize("steps", [*STEPS, "uneven"])
def test_gradient_of_a_volume_of_one_column_is_finite(steps):
    volume = linear_volume(steps)
    gradients = voxel_gradients(volume.voxels[:, :, :1], slice_normal_matrices(volume, 0))
    assert np.isfinite(gradients).all()


def test_gradients_at_the_border_are_half_the_difference_to_the_inside():
    voxels = np.array([[[1.0, 4.0, 9.0]]])
    gradients = voxel_gradients(voxels, np.eye(3)[None])
    assert gradients[0, 0, :, 0].tolist() == [(4 - 1) / 2, (9 - 1) / 2, (9 - 4) / 2]
    assert not gradients[..., 1:].any()


def draw_rays(volume):
    """Origins and unit directions of 200 rays from near the centre of a volume."""
    rng = np.random.default_rng(4)
    origins = centre_of(volume) + rng.uniform(-10.0, 10.0, (200, 3))
    directions = rng.normal(size=(200, 3))
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def compare_intervals(volume):
    """Samples along rays that lie among the voxels, and those within the interval of their ray."""
    origins, directions = draw_rays(volume)
    t_in, t_out, _ = find_interval(origins, directions, box_of(volume))
    t = np.linspace(-60.0, 60.0, 1001)
    points = origins[:, None] + t[:, None] * directions[:, None]
    ijk = volume.lps_to_ijk(points.reshape(-1, 3)).reshape(*points.shape)
    among_voxels = np.asarray(((ijk >= -0.5) & (ijk <= np.array(volume.shape_ijk) - 0.5)).all(axis=-1))
    assert 0.01 < among_voxels.mean()  # some rays pass through
    assert among_voxels.any(axis=1).mean() < 0.9  # and some beside
    return among_voxels, (t >= t_in[:, None]) & (t <= t_out[:, None])


@pytest.mark.parametrize("steps", STEPS)
def test_interval_of_a_ray_reaches_half_a_voxel_beyond_the_outermost_voxels(steps):
    among_voxels, in_interval = compare_intervals(even_volume(lambda p: p[:, 0], steps, extent=12.0))
    assert np.array_equal(in_interval, among_voxels)


def test_interval_of_a_ray_through_uneven_slices_is_that_of_the_smallest_box_around_them():
    among_voxels, in_interval = compare_intervals(uneven_volume(lambda p: p[:, 0], shape=(20, 18), noise=0.0))
    assert in_interval[among_voxels].all()
    assert among_voxels.sum() > 0.3 * in_interval.sum()  # slices that lean fill about half of their box; measured 0.46


@pytest.fixture(scope="module")
def clipped_rays():
    """Enters, exits and planes of rays to, from and beside the kept quarter y > 0, z > 0 of a volume of 12.6 mm."""
    volume = even_volume(lambda p: p[:, 0], "even", extent=12.0)  # 14 voxels of 0.9 mm
    centre = centre_of(volume)
    clip = Clip.plane(centre, (0, 0, 1.0)) & Clip.plane(centre, (0, 1.0, 0))
    origins = centre + np.array([(0.0, -50.0, 3.0), (0.0, 50.0, 3.0), (0.0, -50.0, -3.0)])
    directions = np.array([(0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)])
    return find_interval(origins, directions, box_of(volume), clip)


def test_ray_that_enters_through_a_clip_plane_has_its_number_and_another_ray_minus_1(clipped_rays):
    _, _, entered_by = clipped_rays
    second_plane, face_of_the_volume = 1, -1
    assert entered_by[:2].tolist() == [second_plane, face_of_the_volume]


def test_ray_enters_a_clipped_volume_at_the_plane_or_at_its_face(clipped_rays):
    t_in, _, _ = clipped_rays
    to_the_plane = 50.0  # mm, through the centre of the volume
    to_the_face = 50.0 - 14 * 0.9 / 2  # half of 14 voxels of 0.9 mm in front of it
    assert t_in[:2] == pytest.approx([to_the_plane, to_the_face], abs=1e-9)


def test_ray_beside_the_kept_part_of_a_clipped_volume_has_an_empty_interval(clipped_rays):
    t_in, t_out, _ = clipped_rays
    assert t_out[2] < t_in[2]


def test_values_of_a_transfer_function_are_those_of_the_nearest_node_of_its_table():
    ramp = TransferFunction([(-1000, 0, 0.5, 1, 0.0), (3000, 1, 0.5, 0, 0.8)])
    last = TABLE_NODES - 1
    width = 4000 / last  # between two nodes, HU
    hu = np.array([-2000.0, -1000.0, -1000 + 0.4 * width, -1000 + 1.7 * width, 3000 - 0.6 * width, 3000.0, 9000.0])
    nodes = look_up(ramp, hu)[:, 3] / 0.8 * last
    assert nodes == pytest.approx([0.0, 0.0, 0.0, 2.0, last - 1.0, last, last], abs=2e-4)  # float32; measured 6e-5


@pytest.mark.parametrize(
    ("hu", "opacity"),
    [
        pytest.param(-1000.0, 0.0, id="below the first step"),
        pytest.param(301.0, 0.7, id="just above the first step"),
        pytest.param(399.0, 0.7, id="just below the last step"),
        pytest.param(5000.0, 0.1, id="above the last step"),
    ],
)
def test_opacity_of_a_transfer_function_of_steps_is_that_of_the_side_of_the_step(hu, opacity):
    white = (1, 1, 1)
    steps = TransferFunction([(300, *white, 0.0), (300, *white, 0.7), (400, *white, 0.7), (400, *white, 0.1)])
    assert look_up(steps, np.array([hu]))[0, 3] == pytest.approx(opacity)


@pytest.mark.parametrize("direction", [None, (0.3, -2.0, 1.0)])
def test_shade_of_a_colour_is_that_of_the_phong_formula_towards_the_viewer(direction):
    ambient, diffuse, specular, power = 0.1, 0.6, 0.3, 9.0
    lighting = Lighting(ambient=ambient, diffuse=diffuse, specular=specular, specular_power=power, direction=direction)
    rng = np.random.default_rng(8)
    gradients, directions = rng.normal(size=(2, 20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    gradients[3] = 0.0  # nothing to be lit from a side
    colours = rng.uniform(size=(20, 3))
    shaded = shade(colours, gradients, directions, lighting)
    for n in range(20):
        if n == 3:
            assert np.allclose(shaded[n], colours[n] * (ambient + diffuse))
            continue
        normal = gradients[n] / np.linalg.norm(gradients[n])
        light = -directions[n] if direction is None else np.array(direction) / np.linalg.norm(direction)
        half_way = (light - directions[n]) / np.linalg.norm(light - directions[n])
        normal = normal if normal @ directions[n] < 0.0 else -normal
        lit = normal @ light > 0.0
        assert direction is not None or lit
        shine = specular * lit * abs(normal @ half_way) ** power
        expected = colours[n] * (ambient + diffuse * lit * (normal @ light)) + shine
        assert np.allclose(shaded[n], np.minimum(expected, 1.0))


def test_colour_opacity_and_depths_of_a_ray_are_the_sums_over_its_samples_written_out():
    """Compositing, opacity over a part of a step, gradient opacity, shading and both depths, along a single ray."""
    rng = np.random.default_rng(9)
    volume = even_volume(lambda p: rng.uniform(-200.0, 900.0, len(p)), "oblique", extent=11.0)
    gradient_nodes, gradient_opacities, unit_mm = [50.0, 600.0], [0.2, 1.0], 1.3
    function = TransferFunction(
        [(-100, 0.2, 0.4, 0.9, 0.0), (300, 1, 0.6, 0.3, 0.1), (800, 1, 1, 1, 0.5)],
        unit_distance=unit_mm,
        gradient_opacity=list(zip(gradient_nodes, gradient_opacities, strict=True)),
    )
    lighting, step = Lighting(direction=(0.2, -1.0, 0.4)), 0.37
    camera = look(volume, (0.4, 1.0, 0.2), half_height=4.0, perspective=True)
    row, column = 1, 2

    picture = cast_rays(volume, VolumeLook(function, lighting=lighting, ray_step=step), camera, (3, 3))

    origin, direction = (rays[row, column] for rays in camera.rays((3, 3)))
    (t_in,), (t_out,), _ = find_interval(origin[None], direction[None], box_of(volume))
    matrices = slice_normal_matrices(volume, 0)
    gradients = voxel_gradients(volume.voxels, matrices)
    lit_gradients = voxel_gradients(smooth_field(volume, None), matrices)
    colour, opacity, weighted, depth, start = np.zeros(3), 0.0, 0.0, np.nan, t_in
    while start < t_out and opacity < 0.99:  # where a ray ends
        length = min(step, t_out - start)
        t = start + 0.5 * length
        ijk = volume.lps_to_ijk([origin + t * direction])
        slope = sample_field(gradients, ijk)
        *rgb, alpha = look_up(function, sample_field(volume.voxels, ijk))[0]
        alpha *= np.interp(np.linalg.norm(slope), gradient_nodes, gradient_opacities)
        alpha = 1.0 - (1.0 - alpha) ** (length / unit_mm)
        weight = (1.0 - opacity) * alpha
        colour = (
            colour + weight * shade(np.array([rgb]), sample_field(lit_gradients, ijk), direction[None], lighting)[0]
        )
        opacity += weight
        weighted += weight * t
        depth = t if np.isnan(depth) and opacity > 1 / 255 else depth
        start += step
    assert 0.3 < opacity < 0.99  # the ray sees bodies and does not end in one; measured 0.61
    assert np.allclose(picture.rgba[row, column], [*colour, opacity])
    assert np.isclose(picture.depth[row, column], depth)
    assert np.isclose(picture.expected_depth[row, column], weighted / opacity)


def test_ray_shows_nothing_behind_the_sample_that_makes_it_opaque():
    volume = even_volume(lambda p: np.where(p[:, 1] < 0.0, 100.0, 900.0), "even", extent=30.0)
    red, green = (1, 0, 0), (0, 1, 0)  # red fog in front of an opaque green wall
    wall = TransferFunction([(0, *red, 0.4), (400, *red, 0.4), (400, *green, 1), (1000, *green, 1)])

    picture = cast_rays(
        volume, VolumeLook(wall, lighting=UNSHADED, ray_step=0.5), look(volume, (0, 1, 0), half_height=5.0), (4, 4)
    )

    assert (picture.rgba[..., 3] >= 0.99).all()  # where a ray ends
    assert (picture.rgba[..., 3] < 1.0).all()  # the wall would make it 1
    assert not picture.rgba[..., 1].any()


def test_default_step_of_a_ray_is_half_the_smallest_spacing():
    smallest_spacing = np.linalg.norm(STEPS["anisotropic"], axis=0).min()  # 0.45 mm
    volume = even_volume(lambda p: 50.0 * p[:, 1], "anisotropic", extent=12.0)
    camera = look(volume, (0.3, 1.0, 0.2), half_height=5.0)
    default, given = (
        cast_rays(volume, Projection("mean", ray_step=step), camera, (6, 6)).values
        for step in (None, smallest_spacing / 2)
    )
    assert np.array_equal(default, given)


def test_hash_of_a_pixel_is_lowbias32_of_its_column_and_the_hash_of_its_row():
    def lowbias32(bits):  # in whole numbers without end
        bits = (bits ^ bits >> 16) * 0x7FEB352D % 2**32
        bits = (bits ^ bits >> 15) * 0x846CA68B % 2**32
        return bits ^ bits >> 16

    pixels = [(0, 0), (1, 7), (1023, 4095), (65535, 3)]
    x, y = np.array(pixels).T
    expected = [lowbias32((a + lowbias32((b + 0x9E3779B9) % 2**32)) % 2**32) for a, b in pixels]
    assert hash_pixels(x, y).tolist() == expected


def test_jitter_is_spread_evenly_from_0_to_1_in_float32():
    jitter = jitter_pixels(width=256, height=256)
    # the lowest of 65,536 even numbers lies near 1.5e-5, the highest as far below 1
    assert 0.0 <= jitter.min() < 1e-3
    assert 0.999 < jitter.max() < 1.0
    four_standard_errors = 4.0 / np.sqrt(12.0) / 256.0  # of the mean of 256 x 256 even numbers
    assert abs(jitter.mean() - 0.5) < four_standard_errors
    assert np.array_equal(jitter.astype(np.float32), jitter)


@pytest.mark.parametrize("shift", [(0, 1), (1, 0), (1, 1), (0, 2), (16, 0)])
def test_jitter_of_a_pixel_is_uncorrelated_with_that_of_a_neighbour(shift):
    centred = jitter_pixels(width=256, height=256) - 0.5
    four_standard_errors = 4.0 / 12.0 / 256.0  # of the mean product
    assert abs((centred * np.roll(centred, shift, (0, 1))).mean()) < four_standard_errors


def test_jitter_of_a_pixel_does_not_depend_on_the_size_of_the_picture():
    assert np.array_equal(jitter_pixels(width=256, height=256)[:50, :60], jitter_pixels(width=60, height=50))


def test_jitter_lies_within_each_segment_the_last_one_too():
    """Thin fog on a ramp along the ray, all samples at part u of their segments: the sum is known."""
    volume = even_volume(lambda p: p[:, 1], "even", extent=20.0)
    camera = look(volume, (0.0, 1.0, 0.0), half_height=4.0)
    thin = TransferFunction([(-12, 1, 1, 1, 0.0), (12, 1, 1, 1, 0.001)])
    step, part = 1.7, jitter_pixels(width=8, height=8)
    opacity = cast_rays(volume, VolumeLook(thin, jitter=True, ray_step=step), camera, (8, 8)).rgba[..., 3]
    voxel_mm = 0.9  # of an even volume
    depth, inner = voxel_mm * volume.shape_ijk[1], 0.5 * voxel_mm * (volume.shape_ijk[1] - 1)
    starts = np.arange(0.0, depth, step)
    lengths = np.minimum(step, depth - starts)
    places = np.clip(starts + part[..., None] * lengths - 0.5 * depth, -inner, inner)
    node = np.floor((places + 12.0) / 24.0 * (TABLE_NODES - 1) + 0.5) / (TABLE_NODES - 1)
    through = ((1.0 - 0.001 * node) ** lengths).prod(axis=-1)
    assert np.abs(opacity - (1.0 - through)).max() < 1e-9  # the table is float32: measured 2e-10
