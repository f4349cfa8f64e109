"""Walls of bone read from their profiles: the twin, walls whose place and thickness are known, slabs, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from scipy.special import ndtr
from surface_volumes import MIDDLE, hollow_ball

from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume
from clrecon.opencl import Stopwatch
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface import cortex
from clrecon.operators.surface.cortex import CortexConstants, ProfileSampler, ProfileScale, WallFits
from clrecon.operators.surface.cortex_constants import MOST_WALLS
from clrecon.operators.surface.cortex_mesh import (
    _STATES,
    FITTED,
    METAL,
    NO_ROOM,
    NOT_BONE,
    fit_walls,
    judge_walls,
    standard_errors,
)
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.proof.checking import OBLIQUE, stack
from clrecon.proof.surface.surface_checks import CORTEX_CHECKS


def fit_surface(volume: Volume, device, level=200.0, constants=None):
    mesh = extract_isosurface(volume, level, device=device)
    with DeviceVolume(volume, device=device) as resident:
        return mesh, fit_walls(resident, mesh.vertices, mesh.normals, stopwatch=Stopwatch(), constants=constants)


def outer_places(mesh, fit, radius):
    """Distances of the fitted outer surface from its radius, mm, and the rows of its vertices."""
    places = mesh.vertices + fit.shift_mm[:, None] * mesh.normals
    far = np.linalg.norm(places - MIDDLE, axis=1)
    rows = np.flatnonzero((np.linalg.norm(mesh.vertices - MIDDLE, axis=1) > radius - 0.6) & (fit.states == FITTED))
    return far[rows] - radius, rows


@pytest.mark.every_device
@pytest.mark.parametrize("check", CORTEX_CHECKS, ids=lambda check: check.name)
def test_profiles_and_walls_are_those_of_the_twin(device, check):
    assert check.run(device)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.7, 0.7, 1.5)])
@pytest.mark.parametrize("thickness", [1.0, 2.0, 4.0])
def test_fitted_shell_is_nearer_to_the_truth(device, thickness, spacing):
    _, of_thick = fit_surface(hollow_ball(thickness=4.0, spacing=spacing), device)
    volume = hollow_ball(thickness=thickness, spacing=spacing)
    mesh, fit = fit_surface(volume, device, constants=of_thick.constants)
    away, rows = outer_places(mesh, fit, 13.0)
    level = np.linalg.norm(mesh.vertices[rows] - MIDDLE, axis=1) - 13.0
    assert len(rows) > 1000
    assert np.abs(level).mean() > 0.4  # what a level costs
    assert np.abs(away).mean() < 0.12
    assert abs(np.median(fit.thickness_mm[rows]) - thickness) < 0.35
    assert (np.abs(away) < 1.96 * fit.error_mm[rows]).mean() > 0.9


def test_constants_are_those_of_the_scan(device):
    _, fit = fit_surface(hollow_ball(thickness=4.0, blur=0.8), device)
    found = fit.constants
    # Interpolation between voxels of 1 mm blurs further: by about 0.4 mm, in squares.
    assert found.blur_mm == pytest.approx(0.88, abs=0.08) and found.blur_across_mm == pytest.approx(0.88, abs=0.08)
    assert found.cortex_hu == pytest.approx(1000.0, rel=0.04)
    assert found.places == MOST_WALLS and found.thick > 100


def test_noise_makes_no_cortex_denser(device):
    """Thick walls' percentile holds noise, the blur follows it, and it the blur: 15 % and 0.13 mm inwards."""
    quiet = hollow_ball(thickness=2.6, blur=0.5)
    noise = np.random.default_rng(3).normal(0.0, 40.0, quiet.voxels.shape)
    mesh, fit = fit_surface(quiet.with_voxels(np.rint(quiet.voxels + noise).astype(np.int16)), device, level=500.0)
    assert fit.constants.cortex_hu == pytest.approx(1000.0, rel=0.04)
    assert fit.constants.blur_mm == pytest.approx(0.64, abs=0.08)  # with that of the interpolation
    assert abs(np.mean(outer_places(mesh, fit, 13.0)[0])) < 0.05


def test_a_fit_scales_with_the_voxels(device):
    large = hollow_ball(thickness=3.0)
    fits = [fit_surface(Volume(large.voxels, np.diag([mm, mm, mm, 1.0])), device)[1] for mm in (1.0, 0.02)]
    for name in ("shift_mm", "thickness_mm", "error_mm"):
        one, small = (getattr(fit, name)[fit.states == FITTED].mean() for fit in fits)
        assert small / 0.02 == pytest.approx(one, rel=0.03, abs=0.01), name
    assert fits[1].constants.blur_mm / 0.02 == pytest.approx(fits[0].constants.blur_mm, rel=0.05)


@pytest.mark.parametrize(
    ("uneven", "few"), [(False, False), (True, False), (False, True)], ids=["even", "uneven", "few places at a time"]
)
def test_cortex_fitted_in_slabs_is_that_of_the_whole(device, uneven, few):
    even = hollow_ball(thickness=2.0)
    volume = stack(even.voxels, OBLIQUE, uneven=uneven)
    mesh, whole = fit_surface(volume, device)
    places = 140 * cortex.SMALLEST_PIECE if few else 140 * cortex.stride_of(mesh.vertex_count)
    limit = volume.voxels.nbytes // 2 + places
    assert mesh.vertex_count > 4 * cortex.SMALLEST_PIECE
    with DeviceVolume(volume, device=device, memory=limit) as resident:
        sampler = ProfileSampler(resident, Stopwatch())
        assert len(list(sampler.pieces(mesh.vertices, mesh.normals))) > 1
        slabs = fit_walls(resident, mesh.vertices, mesh.normals, stopwatch=Stopwatch(), constants=whole.constants)
    for name in ("states", "shift_mm", "thickness_mm", "error_mm", "room_mm"):
        assert np.array_equal(getattr(slabs, name), getattr(whole, name), equal_nan=True), name


def test_vertices_on_vessels_metal_and_ends_are_told_as_no_wall(device):
    volume = hollow_ball(thickness=2.0)
    voxels = volume.voxels.copy()
    k, j, i = np.indices(voxels.shape)
    vessel = 50.0 + 270.0 * ndtr((3.0 - np.hypot(i - 4.0, j - 4.0)) / 0.7)  # contrast medium, from end to end
    voxels = np.maximum(voxels, np.rint(vessel).astype(np.int16))
    voxels[(np.abs(i - 35) < 2) & (np.abs(j - 35) < 2) & (np.abs(k - 20) < 4)] = 3000
    mesh, fit = fit_surface(volume.with_voxels(voxels), device)
    x, y, z = mesh.vertices.T
    at_end = (z < 0.0) | (z > voxels.shape[0] - 1)
    beside = (np.hypot(x - 4, y - 4) < 4) & (z > 3) & (z < 36)
    near_metal = (x > 32) & (y > 32)
    assert set(fit.states[at_end].tolist()) == {NO_ROOM}
    assert (fit.states[beside] == NOT_BONE).mean() > 0.95
    assert set(fit.states[near_metal].tolist()) == {METAL}
    assert sum(fit.counts().values()) == mesh.vertex_count


@pytest.mark.parametrize("cortex_hu, state, factor", [(1000.0, "fitted", 1.0), (1140.0, "fitted", 1.0),
                                                      (1450.0, "fitted", 3.0), (710.0, "fitted", 29.0 / 15.0),
                                                      (690.0, "badly fitted", 31.0 / 15.0)])  # fmt: skip
def test_walls_unlike_the_cortex_of_the_scan_have_larger_errors_or_follow(cortex_hu, state, factor):
    constants = CortexConstants(0.7, 0.7, 1000.0, 0.02, 0.02, 50.0, 10.0, 20.0, 500, 100)
    scale = ProfileScale.of(hollow_ball())
    rows = (0.0, 2.0, 50.0, cortex_hu, 250.0, 5.0, 1e-6, 900.0, 2.5)
    walls = WallFits(*(np.array([value], np.float32) for value in rows))
    usual = WallFits(*(np.array([value], np.float32) for value in (*rows[:3], 1000.0, *rows[4:])))
    assert _STATES[judge_walls(walls, constants, scale, np.zeros(1, bool))[0]] == state
    error, of_usual = (standard_errors(fits, constants) for fits in (walls, usual))
    np.testing.assert_allclose(error, factor * of_usual, rtol=1e-5)


def test_thick_slices_hide_thin_walls_across_them_alone(device):
    volume = hollow_ball(thickness=1.0, spacing=(1.0, 1.0, 4.0))
    constants = CortexConstants(0.7, 2.0, 1000.0, 0.02, 0.05, 50.0, 10.0, 20.0, 500, 100)
    mesh, fit = fit_surface(volume, device, constants=constants)
    assert fit.hidden.sum() > 20 and np.abs(mesh.normals[fit.hidden, 2]).min() > 0.2
    assert set(fit.states[fit.hidden].tolist()) == {_STATES.index("badly fitted")}
    same = fit_surface(volume, device, constants=constants.changed(blur_across_mm=0.8))[1]
    assert not same.hidden.any()


def test_thin_walls_alone_do_not_show_their_density(device):
    mesh, fit = fit_surface(hollow_ball(thickness=0.8), device)
    away, _ = outer_places(mesh, fit, 13.0)
    assert fit.constants.cortex_hu < 800.0
    assert 0.1 < np.mean(away) < 0.35  # the walls are taken for thicker, less dense ones


def test_the_shell_of_a_table_says_nothing_of_bone(device):
    """Sheets of 250 HU between air rise by more than bone does, and have more vertices."""
    voxels = hollow_ball(thickness=3.0).voxels.copy()
    for beside in (slice(0, 5), slice(-5, None)):
        voxels[:, :, beside] = -900
        voxels[:, beside] = -900
    voxels[:, :, (2, -3)] = 250
    voxels[:, (2, -3)] = 250
    constants = fit_surface(Volume(voxels, np.eye(4)), device)[1].constants
    assert constants.cortex_hu == pytest.approx(1000.0, rel=0.05) and constants.thick > 300
    assert constants.blur_mm == pytest.approx(0.8, abs=0.1)


def test_bones_of_different_density_have_constants_each(device):
    volumes = [hollow_ball(thickness=4.0, cortex=cortex) for cortex in (1400.0, 900.0)]
    volume = Volume(np.concatenate([one.voxels for one in volumes]), np.eye(4))
    mesh = extract_isosurface(volume, 200.0, device=device)
    second = (mesh.vertices[:, 2] > len(volumes[0].voxels)).astype(np.int64)
    with DeviceVolume(volume, device=device) as resident:
        one, each = (
            fit_walls(resident, mesh.vertices, mesh.normals, stopwatch=Stopwatch(), components=components)
            for components in (None, second)
        )
    assert one.own_cortex_hu == () and each.own_cortex_hu[-1] == pytest.approx(900.0, rel=0.05)
    middle = MIDDLE + [0.0, 0.0, len(volumes[0].voxels)]
    away = [
        np.linalg.norm(mesh.vertices + fit.shift_mm[:, None] * mesh.normals - middle, axis=1) - 13.0
        for fit in (one, each)
    ]
    outer = (second == 1) & (np.linalg.norm(mesh.vertices - middle, axis=1) > 12.5)
    assert np.abs(away[1][outer]).mean() < 0.06 < np.abs(away[0][outer]).mean()


def test_a_scan_without_bone_has_no_cortex(device):
    volume = hollow_ball(cortex=260.0, inner=260.0)
    with refused(NoSurfaceError, "walls", "bone"):
        fit_surface(volume, device, 150.0)


@pytest.mark.oclgrind
def test_profiles_find_the_wall_at_a_few_points(device):
    volume = hollow_ball()
    points = MIDDLE + 13.5 * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    with DeviceVolume(volume, device=device) as resident:
        sampler = ProfileSampler(resident, Stopwatch())
        walls = sampler.take(sampler.values(points, (points - MIDDLE) / 13.5)).fit(0.75, 0.75, 1000.0, 10.0)
    assert np.abs(walls.shift_mm + 0.5).max() < 0.15
