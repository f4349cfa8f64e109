"""Modes that show values against analysis and numpy: asked of the numpy twin and of every device."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from raycast_scenes import (
    PLACE,
    STEPS,
    DeviceCaster,
    ball,
    ball_chords,
    casters,
    centre_of,
    distances_from,
    even_volume,
    look,
    uneven_volume,
    ways_through,
)

import clrecon
from clrecon.geometry import Volume
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "cast" in metafunc.fixturenames:
        metafunc.parametrize("cast", casters(pytest.mark.release))


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("steps", STEPS)
def test_mean_tells_the_chords_of_a_ball(cast, steps, perspective):
    radius, ramp, size = 18.0, 4.0 * np.linalg.norm(STEPS[steps], axis=0).max(), (32, 24)
    inside, outside = 1000.0, -500.0
    volume = even_volume(ball(radius, ramp, inside=inside, outside=outside), steps, extent=46.0)
    for towards in ((0.0, 1.0, 0.0), (0.3, 1.0, 0.2), (1.0, 0.4, -2.0)):
        camera = look(volume, towards, half_height=18.0, perspective=perspective)
        passing, _ = distances_from(centre_of(volume), camera, size)
        mean = cast(volume, "mean", camera=camera, size=size).values
        chords = (mean - outside) / (inside - outside) * ways_through(volume, camera, size)
        well_inside = passing < 0.7 * radius
        assert well_inside.sum() > 50  # pixels; measured 88 and 216
        truth = ball_chords(radius, ramp, passing[well_inside])
        assert np.abs(chords[well_inside] / truth - 1.0).max() <= tolerances.RAY_CHORD


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("steps", STEPS)
def test_mean_tells_the_chords_of_a_box(cast, steps, perspective):
    """A block of voxels: where a ray keeps off its edges, the integral is the way between faces half a voxel out."""
    size, low, high = (40, 30), np.array([6, 8, 4]), np.array([21, 25, 15])
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = STEPS[steps], PLACE
    inside, outside = 800, -200
    voxels = np.full((20, 34, 28), outside, np.int16)
    voxels[low[2] : high[2] + 1, low[1] : high[1] + 1, low[0] : high[0] + 1] = inside
    volume = Volume(voxels, affine)
    for along in ((0.0, 1.0, 0.0), (0.2, 1.0, 0.1), (1.0, 0.2, -0.1)):
        camera = look(volume, STEPS[steps] @ along, half_height=6.0, perspective=perspective)
        mean = cast(volume, "mean", camera=camera, size=size).values
        chords = (mean - outside) / (inside - outside) * ways_through(volume, camera, size)
        clear = rays_off_edges(volume, camera, size, low, high)
        assert clear.sum() > 30  # pixels; measured 139 on
        ways = ways_through(volume, camera, size, first=low, last=high)
        assert np.abs(chords[clear] / ways[clear] - 1.0).max() <= tolerances.RAY_CHORD


def rays_off_edges(volume: Volume, camera: Camera, size, low, high) -> np.ndarray:
    """Rays that cross two opposite faces of a block of voxels at least 1.6 index steps from its edges, (h, w)."""
    origins, directions = camera.rays(size)
    inverse = np.linalg.inv(volume.affine)
    start = origins @ inverse[:3, :3].T + inverse[:3, 3]
    rate = directions @ inverse[:3, :3].T
    clear = np.zeros(start.shape[:2], bool)
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        both = np.abs(rate[..., axis]) > 1e-3
        for face in (low[axis] - 1.5, high[axis] + 1.5):
            with np.errstate(divide="ignore", invalid="ignore"):
                at = start + ((face - start[..., axis]) / rate[..., axis])[..., None] * rate
                both &= ((at > low + 1.6) & (at < high - 1.6))[..., others].all(axis=-1)
        clear |= both
    return clear


WATER_VIEWS = [(0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.3, 1.0, 0.2), (1.0, 0.4, -2.0)]
PADDING_HU = -3024.0
FINE_GAPS = (1.0,) * 18 + (0.4,) * 10 + (0.9,) * 20


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("steps", [*STEPS, "uneven"])
def test_a_radiograph_tells_the_water_in_a_ball(cast, steps, perspective):
    """1.5 times as dense as water, in air: what lies beside the ball, within the volume or not, adds nothing."""
    radius, size, air, density = 14.0, (32, 24), -1000.0, 1.5
    spacing = 1.5 if steps == "uneven" else float(np.linalg.norm(STEPS[steps], axis=0).max())  # at least each step
    ramp = 4.0 * spacing
    field = ball(radius, ramp, inside=1000.0 * (density - 1.0), outside=air)
    volume = uneven_volume(field, gaps=FINE_GAPS) if steps == "uneven" else even_volume(field, steps, extent=46.0)
    for towards in WATER_VIEWS:
        camera = look(volume, towards, half_height=22.0, perspective=perspective)
        passing, _ = distances_from(centre_of(volume), camera, size)
        water = cast(volume, "drr", camera=camera, size=size).values
        assert not water[passing > radius + 0.5 * ramp + 2.0 * spacing].any()
        well_inside = passing < 0.7 * radius
        assert well_inside.sum() > 50  # pixels; measured 88 and 216
        truth = density * ball_chords(radius, ramp, passing[well_inside])
        assert np.abs(water[well_inside] / truth - 1.0).max() <= tolerances.RAY_CHORD


def test_a_radiograph_is_transparent_where_there_is_no_water_at_all(device):
    """A hundredth of water over 20 mm is 0.2 mm of it: little, but not nothing."""
    volume = even_volume(ball(radius=8.0, ramp=2.0, inside=-990.0, outside=-1000.0), "even", extent=20.0)
    size = (24, 24)
    camera = look(volume, (0.0, 1.0, 0.0), half_height=14.0)
    found = DeviceCaster(device)(volume, mode="drr", camera=camera, size=size)
    passing, _ = distances_from(centre_of(volume), camera, size)
    assert 0.0 < found.values[passing < 4.0].max() < 1.0  # measured 0.16
    assert (found.image[passing < 4.0][:, 3] == 255).all()
    assert (found.image[passing > 11.0][:, 3] == 0).all()


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("steps", STEPS)
def test_a_radiograph_tells_the_water_in_a_block_beside_padding(cast, steps, perspective):
    """A block of water turned every way: its chords, whether it lies in air or in values that stand for nothing."""
    size, low, high = (40, 30), np.array([6, 8, 4]), np.array([21, 25, 15])
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = STEPS[steps], PLACE
    voxels = np.full((20, 34, 28), PADDING_HU, np.int16)
    voxels[:, ::2] = -1000
    voxels[low[2] : high[2] + 1, low[1] : high[1] + 1, low[0] : high[0] + 1] = 0
    volume = Volume(voxels, affine)
    for along in ((0.0, 1.0, 0.0), (0.2, 1.0, 0.1), (1.0, 0.2, -0.1), (0.3, 0.2, 1.0)):
        camera = look(volume, STEPS[steps] @ along, half_height=6.0, perspective=perspective)
        water = cast(volume, "drr", camera=camera, size=size).values
        ways = ways_through(volume, camera, size, first=low, last=high)
        clear = rays_off_edges(volume, camera, size, low, high)
        assert clear.sum() > 30  # pixels; measured 139 on
        assert np.abs(water[clear] / ways[clear] - 1.0).max() <= tolerances.RAY_CHORD
        beside = ways_through(volume, camera, size, first=low - 1.0, last=high + 1.0) == 0.0
        assert not water[beside].any()


@pytest.fixture
def water_at_45_degrees():
    """A block of water of 40 mm seen along its diagonal, and mm of water along each of 110 rays; which miss edges.

    Pictures of it have 20 rows, all alike.
    """
    voxels = np.full((24, 48, 48), -1000, np.int16)
    voxels[4:20, 4:44, 4:44] = 0
    volume = Volume(voxels, np.eye(4))
    columns, half_height, rows = 110, 6.0, 20
    camera = look(volume, (1.0, 1.0, 0.0), half_height=half_height, up=(0.0, 0.0, 1.0))
    across = (np.arange(columns) - 0.5 * (columns - 1)) * 2 * half_height / rows
    way = np.maximum(40.0 * np.sqrt(2.0) - 2.0 * np.abs(across), 0.0)
    off_edges = (np.abs(np.abs(across) - 20.0 * np.sqrt(2.0)) > 1.0) & (np.abs(across) > 1.0)
    return volume, {"camera": camera, "size": (columns, rows)}, way, off_edges


def test_the_box_of_a_volume_does_not_show_in_a_radiograph(cast, water_at_45_degrees):
    """A mean lights up where the box is short, a sum follows the way through the water."""
    volume, settings, way, off_edges = water_at_45_degrees
    middle_row = 10
    water = cast(volume, "drr", **settings).values[middle_row]
    assert np.abs(water - way)[off_edges].max() <= tolerances.RAY_CHORD * way.max()


def test_a_radiograph_of_half_a_block_tells_half_its_water(cast, water_at_45_degrees):
    volume, settings, way, off_edges = water_at_45_degrees
    clip = Clip.plane(centre_of(volume), (1.0, 1.0, 0.0))
    middle_row = 10
    water = cast(volume, "drr", **settings, clip=clip).values[middle_row]
    assert np.abs(water - 0.5 * way)[off_edges].max() <= tolerances.RAY_CHORD * way.max()


AXIS_VIEWS = [
    ((0, 1, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, 1)),
    ((1, 0, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, 0, 1)),
    ((0, 0, 1), (0, -1, 0)),
    ((0, 0, -1), (0, -1, 0)),
]


@pytest.mark.parametrize("ray_step", [None, 0.37])
@pytest.mark.parametrize(("mode", "extreme"), [("mip", np.max), ("minip", np.min)])
@pytest.mark.parametrize(("towards", "up"), AXIS_VIEWS)
def test_extremes_along_axes_are_those_of_numpy(cast, mode, extreme, towards, up, ray_step):
    """Spacing 0.5, 1.5, 2.5 mm and pixels of 0.5 mm: every voxel centre is a pixel's centre."""
    spacing, pixel = np.array([0.5, 1.5, 2.5]), 0.5
    voxels = np.random.default_rng(5).integers(-1000, 2000, (5, 6, 7)).astype(np.int16)
    volume = Volume(voxels, np.diag([*spacing, 1.0]))
    right = np.cross(towards, up)
    across, along = (int(np.abs(axis).argmax()) for axis in (right, up))
    size = tuple(int(round(volume.shape_ijk[axis] * spacing[axis] / pixel)) for axis in (across, along))

    shot = cast(
        volume, mode, camera=look(volume, towards, half_height=0.25 * size[1], up=up), size=size, ray_step=ray_step
    )

    # Pixels at the centres of voxels, which are k, j, i: turned and mirrored to rows downward, columns to the right.
    pixels_a_voxel = (spacing / pixel).astype(int)
    row, column = pixels_a_voxel[along], pixels_a_voxel[across]
    found = shot.values[row // 2 :: row, column // 2 :: column]
    expected = extreme(voxels, axis=2 - int(np.abs(towards).argmax()))
    if across > along:
        expected = expected.T
    expected = expected[:: -int(np.array(up)[along]), :: int(right[across])]
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= tolerances.RAY_AXIS_HU


@pytest.fixture(params=["anisotropic", "mirrored", "sheared"])
def random_values(request, cast):
    """Random HU on a grid; highest, mean and lowest values along rays, and mm of each ray through the volume."""
    rng = np.random.default_rng(6)
    volume = even_volume(lambda p: rng.integers(-1000, 2000, len(p)), request.param, extent=14.0, dtype=np.int16)
    size = (48, 40)
    camera = look(volume, (0.7, 1.0, -0.4), half_height=14.0, perspective=True)
    shots = [cast(volume, mode, camera=camera, size=size) for mode in ("mip", "mean", "minip")]
    return volume, *shots, ways_through(volume, camera, size)


def test_extremes_have_values_and_depths_where_rays_meet_the_volume(random_values):
    _, high, mean, low, way = random_values
    hit = way > 0.0
    assert 100 < hit.sum() < hit.size  # measured 565 to 684 rays of 48 * 40
    assert np.array_equal(np.isfinite(mean.values), hit)
    for extreme in (high, low):
        assert np.array_equal(np.isfinite(extreme.values), hit)
        assert np.array_equal(np.isfinite(extreme.depth), hit)


def test_extremes_stay_within_the_values_of_the_volume(random_values):
    volume, high, _, low, _ = random_values
    assert np.nanmax(high.values) <= volume.voxels.max() + tolerances.RAY_AXIS_HU
    assert np.nanmin(low.values) >= volume.voxels.min() - tolerances.RAY_AXIS_HU


def test_the_mean_lies_between_the_extremes(random_values):
    _, high, mean, low, way = random_values
    long = way > 3.0  # a corner cut short may have a single sample
    assert (high.values >= mean.values - tolerances.RAY_AXIS_HU)[long].all()
    assert (low.values <= mean.values + tolerances.RAY_AXIS_HU)[long].all()
    assert np.nanmean(high.values - mean.values) > 500.0  # of random HU from -1000 to 2000


@pytest.mark.parametrize("perspective", [False, True])
def test_the_depth_of_a_highest_value_is_where_the_ray_passes_it_nearest(cast, perspective):
    """HU fall with the distance from a place beside the centre."""
    place = np.array((2.0, 1.0, -3.0))
    volume = even_volume(lambda p: -np.linalg.norm(p - place, axis=1), "oblique", extent=20.0)
    size = (24, 24)
    camera = look(volume, (0.4, 1.0, 0.3), half_height=5.0, perspective=perspective)
    shot = cast(volume, "mip", camera=camera, size=size, ray_step=0.1)
    passing, along = distances_from(centre_of(volume) + place, camera, size)
    off_tip = passing > 1.5  # nearer, the trilinear field has no sharp tip
    assert off_tip.sum() > 100  # pixels; measured 535
    assert np.abs(shot.depth - along)[off_tip].max() <= tolerances.RAY_TIP_VOXEL * max(volume.spacing)


@pytest.mark.parametrize("mode", ["mip", "minip", "mean"])
def test_thin_slabs_between_clip_planes_show_the_values_in_them(cast, mode):
    """Of 0.1 mm, thinner than a step and than a voxel, in a field of 100 HU a mm: 205 to 215 HU."""
    volume = even_volume(lambda p: 100.0 * p[:, 1], "even", extent=20.0)
    centre = centre_of(volume)
    slab = Clip.box(centre + (-99, 2.05, -99), centre + (99, 2.15, 99))
    values = cast(volume, mode, camera=look(volume, (0.0, 1.0, 0.0), half_height=6.0), size=(8, 8), clip=slab).values
    assert np.abs(values - 210.0).max() <= 5.0 + tolerances.RAY_AXIS_HU


def body_beside_a_blanket():
    """Air, a blanket of -700 HU, a body of 60 HU, and in it bone of 900 HU."""
    voxels = np.full((12, 12, 40), -1000, np.int16)
    voxels[:, :, 2:8] = -700
    voxels[:, :, 10:38] = 60
    voxels[4:8, :, 20:24] = 900
    return voxels


def window_of_mip(voxels, device):
    return clrecon.render(Volume(voxels, np.eye(4)), "mip", size=(80, 40), device=device).report["window_hu"]


def test_the_window_of_mip_runs_from_soft_tissue_to_bone_without_air_and_blanket(device):
    low, high = window_of_mip(body_beside_a_blanket(), device)
    assert -500.0 <= low <= 60.0  # measured -412
    assert 800.0 < high <= 900.0  # measured 900


def test_the_window_of_mip_of_a_scan_without_a_body_begins_at_air(device):
    low, _ = window_of_mip(np.minimum(body_beside_a_blanket(), -700), device)
    assert low < -900.0  # measured -1000
