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
    volume = even_volume(ball(radius, ramp, 1000.0, -500.0), steps, 46.0)
    for towards in ((0.0, 1.0, 0.0), (0.3, 1.0, 0.2), (1.0, 0.4, -2.0)):
        camera = look(volume, towards, 18.0, perspective=perspective)
        passing, _ = distances_from(centre_of(volume), camera, size)
        mean = cast(volume, "mean", camera=camera, size=size).values
        chords = (mean + 500.0) / 1500.0 * ways_through(volume, camera, size)
        well_inside = passing < 0.7 * radius
        assert well_inside.sum() > 50
        truth = ball_chords(radius, ramp, passing[well_inside])
        assert np.abs(chords[well_inside] / truth - 1.0).max() <= tolerances.RAY_CHORD


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("steps", STEPS)
def test_mean_tells_the_chords_of_a_box(cast, steps, perspective):
    """A block of voxels: where a ray keeps off its edges, the integral is the way between faces half a voxel out."""
    size, low, high = (40, 30), np.array([6, 8, 4]), np.array([21, 25, 15])
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = STEPS[steps], PLACE
    voxels = np.full((20, 34, 28), -200, np.int16)
    voxels[low[2] : high[2] + 1, low[1] : high[1] + 1, low[0] : high[0] + 1] = 800
    volume = Volume(voxels, affine)
    for along in ((0.0, 1.0, 0.0), (0.2, 1.0, 0.1), (1.0, 0.2, -0.1)):
        camera = look(volume, STEPS[steps] @ along, 6.0, perspective=perspective)
        mean = cast(volume, "mean", camera=camera, size=size).values
        chords = (mean + 200.0) / 1000.0 * ways_through(volume, camera, size)
        clear = rays_off_edges(volume, camera, size, low, high)
        assert clear.sum() > 30
        ways = ways_through(volume, camera, size, low, high)
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
    radius, size = 14.0, (32, 24)
    spacing = 1.5 if steps == "uneven" else float(np.linalg.norm(STEPS[steps], axis=0).max())
    ramp, field = 4.0 * spacing, ball(radius, 4.0 * spacing, 500.0, -1000.0)
    volume = uneven_volume(field, gaps=FINE_GAPS) if steps == "uneven" else even_volume(field, steps, 46.0)
    for towards in WATER_VIEWS:
        camera = look(volume, towards, 22.0, perspective=perspective)
        passing, _ = distances_from(centre_of(volume), camera, size)
        water = cast(volume, "drr", camera=camera, size=size).values
        assert not water[passing > radius + 0.5 * ramp + 2.0 * spacing].any()
        well_inside = passing < 0.7 * radius
        assert well_inside.sum() > 50
        truth = 1.5 * ball_chords(radius, ramp, passing[well_inside])
        assert np.abs(water[well_inside] / truth - 1.0).max() <= tolerances.RAY_CHORD


def test_a_radiograph_is_transparent_where_there_is_no_water_at_all(device):
    """A hundredth of water over 20 mm is 0.2 mm of it: little, but not nothing."""
    volume = even_volume(ball(8.0, 2.0, -990.0, -1000.0), "even", 20.0)
    size = (24, 24)
    camera = look(volume, (0.0, 1.0, 0.0), 14.0)
    found = DeviceCaster(device)(volume, mode="drr", camera=camera, size=size)
    passing, _ = distances_from(centre_of(volume), camera, size)
    assert 0.0 < found.values[passing < 4.0].max() < 1.0
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
        camera = look(volume, STEPS[steps] @ along, 6.0, perspective=perspective)
        water = cast(volume, "drr", camera=camera, size=size).values
        ways = ways_through(volume, camera, size, low, high)
        clear = rays_off_edges(volume, camera, size, low, high)
        assert clear.sum() > 30
        assert np.abs(water[clear] / ways[clear] - 1.0).max() <= tolerances.RAY_CHORD
        beside = ways_through(volume, camera, size, low - 1.0, high + 1.0) == 0.0
        assert not water[beside].any()


def test_the_box_of_a_volume_does_not_show_in_a_radiograph(cast):
    """A slab of water at 45 degrees: a mean lights up where the box is short, a sum follows the way through it."""
    voxels = np.full((24, 48, 48), -1000, np.int16)
    voxels[4:20, 4:44, 4:44] = 0
    volume = Volume(voxels, np.eye(4))
    camera, size = look(volume, (1.0, 1.0, 0.0), 6.0, up=(0.0, 0.0, 1.0)), (110, 20)
    water = cast(volume, "drr", camera=camera, size=size).values[10]
    across = (np.arange(size[0]) - 54.5) * 0.6
    way = np.maximum(40.0 * np.sqrt(2.0) - 2.0 * np.abs(across), 0.0)
    off_corners = np.abs(np.abs(across) - 20.0 * np.sqrt(2.0)) > 1.0
    off_corners &= np.abs(across) > 1.0
    assert np.abs(water - way)[off_corners].max() <= tolerances.RAY_CHORD * way.max()
    clip = Clip.plane(centre_of(volume), (1.0, 1.0, 0.0))
    half = cast(volume, "drr", camera=camera, size=size, clip=clip).values[10]
    assert np.abs(half - 0.5 * way)[off_corners].max() <= tolerances.RAY_CHORD * way.max()


AXIS_VIEWS = [
    ((0, 1, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, 1)),
    ((1, 0, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, 0, 1)),
    ((0, 0, 1), (0, -1, 0)),
    ((0, 0, -1), (0, -1, 0)),
]


@pytest.mark.parametrize(("mode", "extreme"), [("mip", np.max), ("minip", np.min)])
@pytest.mark.parametrize(("towards", "up"), AXIS_VIEWS)
def test_extremes_along_axes_are_those_of_numpy(cast, mode, extreme, towards, up):
    """Spacing 0.5, 1.5, 2.5 mm and pixels of 0.5 mm: every voxel centre is a pixel's centre."""
    spacing = np.array([0.5, 1.5, 2.5])
    voxels = np.random.default_rng(5).integers(-1000, 2000, (5, 6, 7)).astype(np.int16)
    volume = Volume(voxels, np.diag([*spacing, 1.0]))
    right = np.cross(towards, up)
    across, along = (int(np.abs(axis).argmax()) for axis in (right, up))
    size = tuple(int(round(volume.shape_ijk[axis] * spacing[axis] / 0.5)) for axis in (across, along))
    camera = look(volume, towards, 0.25 * size[1], up=up)
    for ray_step in (None, 0.37):
        shot = cast(volume, mode, camera=camera, size=size, ray_step=ray_step)
        found = shot.values[
            int(spacing[along]) :: int(spacing[along] * 2), int(spacing[across]) :: int(spacing[across] * 2)
        ]
        expected = extreme(voxels, axis=2 - int(np.abs(towards).argmax()))
        if across > along:
            expected = expected.T
        expected = expected[:, :: int(right[across])]
        expected = expected[:: -int(np.array(up)[along])]
        assert found.shape == expected.shape
        assert np.abs(found - expected).max() <= tolerances.RAY_AXIS_HU


@pytest.mark.parametrize("steps", ["anisotropic", "mirrored", "sheared"])
def test_extremes_stay_within_the_values_and_around_the_mean(cast, steps):
    rng = np.random.default_rng(6)
    volume = even_volume(lambda p: rng.integers(-1000, 2000, len(p)), steps, 14.0, np.int16)
    camera = look(volume, (0.7, 1.0, -0.4), 14.0, perspective=True)
    high, mean, low = (cast(volume, mode, camera=camera, size=(48, 40)) for mode in ("mip", "mean", "minip"))
    hit = ~np.isnan(mean.values)
    assert 100 < hit.sum() < hit.size
    assert np.array_equal(hit, ways_through(volume, camera, (48, 40)) > 0.0)
    for extreme in (high, low):
        assert np.array_equal(np.isfinite(extreme.values), hit) and np.array_equal(np.isfinite(extreme.depth), hit)
    slack = tolerances.RAY_AXIS_HU
    assert high.values[hit].max() <= volume.voxels.max() + slack
    assert low.values[hit].min() >= volume.voxels.min() - slack
    through = ways_through(volume, camera, (48, 40)) > 3.0  # a corner cut short may have a single sample
    assert (high.values >= mean.values - slack)[through].all() and (low.values <= mean.values + slack)[through].all()
    assert np.nanmean(high.values - mean.values) > 500.0


def test_the_depth_of_an_extreme_is_where_it_is(cast):
    volume = even_volume(lambda p: -np.linalg.norm(p - (2.0, 1.0, -3.0), axis=1), "oblique", 20.0)
    size = (24, 24)
    for perspective in (False, True):
        camera = look(volume, (0.4, 1.0, 0.3), 5.0, perspective=perspective)
        shot = cast(volume, "mip", camera=camera, size=size, ray_step=0.1)
        passing, along = distances_from(centre_of(volume) + (2.0, 1.0, -3.0), camera, size)
        near = passing > 1.5  # nearer, the trilinear field has no sharp tip
        assert near.sum() > 100
        assert np.abs(shot.depth - along)[near].max() <= tolerances.RAY_TIP_VOXEL * max(volume.spacing)


def test_thin_slabs_between_clip_planes_show_what_is_in_them(cast):
    """Thinner than a step and than a voxel: mip, mean and dvr have their samples in it all the same."""
    volume = even_volume(lambda p: 100.0 * p[:, 1], "even", 20.0)
    centre = centre_of(volume)
    slab = Clip.box(centre + (-99, 2.05, -99), centre + (99, 2.15, 99))
    camera = look(volume, (0.0, 1.0, 0.0), 6.0)
    for mode in ("mip", "minip", "mean"):
        values = cast(volume, mode, camera=camera, size=(8, 8), clip=slab).values
        assert np.abs(values - 210.0).max() <= 5.0 + tolerances.RAY_AXIS_HU


def test_the_window_of_mip_is_that_of_the_body(device):
    """Air and a blanket beside it do not count; without a body all rays do."""
    voxels = np.full((12, 12, 40), -1000, np.int16)
    voxels[:, :, 2:8] = -700
    voxels[:, :, 10:38] = 60
    voxels[4:8, :, 20:24] = 900
    picture = clrecon.render(Volume(voxels, np.eye(4)), "mip", size=(80, 40), device=device)
    low, high = picture.report["window_hu"]
    assert -500.0 <= low <= 60.0
    assert 800.0 < high <= 900.0
    air = clrecon.render(Volume(np.minimum(voxels, -700), np.eye(4)), "mip", size=(80, 40), device=device)
    assert air.report["window_hu"][0] < -900.0
