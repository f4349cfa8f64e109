"""Walls of bone read from their profiles: the twin, walls whose place and thickness are known, slabs, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr
from surface_volumes import MIDDLE, hollow_ball

from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume
from clrecon.opencl import Stopwatch
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface import cortex
from clrecon.operators.surface.cortex import CortexConstants, ProfileSampler, ProfileScale, StackFrame, WallFits
from clrecon.operators.surface.cortex_constants import MOST_WALLS
from clrecon.operators.surface.cortex_fit import (
    _STATES,
    BADLY_FITTED,
    FITTED,
    METAL,
    NO_ROOM,
    NOT_BONE,
    fit_walls,
    judge_walls,
    standard_errors,
)
from clrecon.operators.surface.cortex_mesh import measure_bone_walls
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.proof.checking import OBLIQUE, stack
from clrecon.proof.surface.surface_checks import CORTEX_CHECKS


def fit_surface(volume: Volume, device, level=200.0, constants=None, **options):
    """The surface at a level, and the walls fitted at its vertices."""
    mesh = extract_isosurface(volume, level, device=device)
    with DeviceVolume(volume, device=device) as resident:
        fit = fit_walls(resident, mesh.vertices, mesh.normals, stopwatch=Stopwatch(), constants=constants, **options)
    return mesh, fit


OUTER_RADIUS = 13.0  # of `hollow_ball`, mm


def outer_places(mesh, fit, radius=OUTER_RADIUS):
    """Distances of the fitted outer surface from its radius, mm, and the rows of its vertices."""
    places = mesh.vertices + fit.shift_mm[:, None] * mesh.normals
    far = np.linalg.norm(places - MIDDLE, axis=1)
    rows = np.flatnonzero((np.linalg.norm(mesh.vertices - MIDDLE, axis=1) > radius - 0.6) & (fit.states == FITTED))
    return far[rows] - radius, rows


@pytest.mark.every_device
@pytest.mark.parametrize("check", CORTEX_CHECKS, ids=lambda check: check.name)
def test_profiles_and_walls_equal_the_twin(device, check):
    assert check.run(device)


@pytest.fixture(params=[(1.0, 1.0, 1.0), (0.7, 0.7, 1.5)], ids=str)
def shell_spacing(request):
    return request.param


@pytest.fixture(params=[1.0, 2.0, 4.0], ids=lambda mm: f"{mm:g} mm")
def fitted_shell(request, shell_spacing, device):
    """The thickness of a shell, its surface at 200 HU, and its walls, fitted with the constants of a thick one."""
    _, of_thick = fit_surface(hollow_ball(thickness=4.0, spacing=shell_spacing), device)
    volume = hollow_ball(thickness=request.param, spacing=shell_spacing)
    return request.param, *fit_surface(volume, device, constants=of_thick.constants)


def test_fitted_shell_is_nearer_to_bone_than_the_level(fitted_shell):
    _, mesh, fit = fitted_shell
    away, rows = outer_places(mesh, fit)
    away_of_level = np.linalg.norm(mesh.vertices[rows] - MIDDLE, axis=1) - OUTER_RADIUS
    assert len(rows) > 1000  # of 3500 to 4700 vertices
    assert np.abs(away_of_level).mean() > 0.4  # mm; measured 0.73 to 0.78
    assert np.abs(away).mean() < 0.12  # mm; measured 0.02 to 0.05


def test_fat_2_mm_outside_of_bone_moves_its_surface_by_less_than_a_seventh_of_a_voxel(device):
    volume = hollow_ball(thickness=1.0)
    away = np.linalg.norm(np.moveaxis(np.indices(volume.voxels.shape)[::-1], 0, -1) - MIDDLE, axis=-1)
    fat = 150.0 * ndtr((away - OUTER_RADIUS - 2.0) / 0.7)
    constants = constants_with_blurs(within_mm=0.8, across_mm=0.8)
    mesh, fit = fit_surface(volume.with_voxels(np.rint(volume.voxels - fat).astype(np.int16)), device, 200.0, constants)
    # mm; measured 0.110, and 0.194 where samples outside count as much as those inside
    assert outer_places(mesh, fit)[0].mean() < 0.143


def test_the_dark_line_of_an_edge_enhancing_kernel_beside_bone_ends_no_wall(device):
    voxels = hollow_ball(thickness=2.0, blur=0.5).voxels.astype(np.float32)
    sharp = np.rint(2.0 * voxels - gaussian_filter(voxels, 1.0)).astype(np.int16)
    _, fit = fit_surface(Volume(sharp, np.eye(4)), device)
    assert fit.counts()["no room"] == 0  # 392 where a rise of 100 HU is another wall


def test_fitted_shell_has_its_thickness_to_a_third_of_a_voxel(fitted_shell):
    thickness, mesh, fit = fitted_shell
    _, rows = outer_places(mesh, fit)
    assert np.median(fit.thickness_mm[rows]) == pytest.approx(thickness, abs=0.35)  # mm; measured 0.06


def test_bone_without_marrow_is_as_thick_as_its_profiles_are_deep(device):
    """Nothing in the profiles of a solid ball shows where its cortex ends: the fit alone said 0.1 to 5 mm."""
    _, fit = fit_surface(hollow_ball(thickness=OUTER_RADIUS), device)
    deep_mm = 3.5  # at voxels of 1 mm
    assert (fit.thickness_mm[fit.states == FITTED] >= deep_mm).mean() > 0.95  # measured 0.998; 0.23 by the fit alone


def test_errors_of_a_fitted_shell_hold_nine_tenths_of_its_distances_from_the_truth(fitted_shell):
    """A standard error of 1.96 would hold 95 % of a normal distribution."""
    _, mesh, fit = fitted_shell
    away, rows = outer_places(mesh, fit)
    assert (np.abs(away) < 1.96 * fit.error_mm[rows]).mean() > 0.9  # measured 1


def test_a_fitted_edge_between_voxels_is_as_far_from_the_truth_as_one_at_them(device):
    """A blur of 0.4 mm in voxels of 1 mm; interpolation half way between these adds 0.25 mm2, at them nothing."""
    places = 8.0 + np.linspace(0.0, 1.0, 9)
    errors = []
    for place in places:
        i = np.arange(20.0)
        values = 50.0 + 950.0 * ndtr((place - i) / 0.4)
        volume = Volume(np.broadcast_to(np.rint(values).astype(np.int16), (6, 6, 20)).copy(), np.eye(4))
        with DeviceVolume(volume, device=device) as resident:
            sampler = ProfileSampler(resident, Stopwatch())
            profiles = sampler.take(sampler.values(np.array([[place + 0.5, 2.0, 2.0]]), np.array([[1.0, 0.0, 0.0]])))
            errors.append(0.5 + float(profiles.fit(np.hypot(0.4, 0.41), 0.6, 1000.0, 10.0).shift_mm[0]))
    assert np.abs(errors).max() < 0.06  # mm; measured 0.04, and 0.12 with the mean blur of interpolation at each place


@pytest.mark.parametrize("blur", [0.3, 0.15], ids=lambda mm: f"blur {mm} mm")
def test_errors_in_voxels_coarse_beside_the_blur_hold_the_distances_from_the_truth(device, blur):
    """In voxels of 1 mm interpolation between them blurs by more than the scan does."""
    mesh, fit = fit_surface(hollow_ball(thickness=3.0, blur=blur), device)
    away, rows = outer_places(mesh, fit)
    assert (np.abs(away) < 1.96 * fit.error_mm[rows]).mean() > 0.95  # measured 1; 0.82 by the spread alone


def test_cubic_values_between_slices_find_walls_nearer_to_the_truth_than_linear_ones(device):
    """Slices of 3 mm, each the mean of three, and walls of 2 mm that are looked for from 0.4 mm outside."""
    thin = hollow_ball(thickness=2.0).voxels[:36]
    thick = Volume(np.rint(thin.reshape(12, 3, *thin.shape[1:]).mean(axis=1)).astype(np.int16), np.diag([1, 1, 3.0, 1]))
    _, fit_of_thick = fit_surface(thick, device)
    directions = np.random.default_rng(5).normal(size=(800, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = MIDDLE - [0.0, 0.0, 1.0] + (OUTER_RADIUS + 0.4) * directions  # the first mean: slices at 0 to 2 mm
    with DeviceVolume(thick, device=device) as resident:
        known = {"stopwatch": Stopwatch(), "constants": fit_of_thick.constants}
        linear, cubic = (
            fit_walls(resident, points, directions, **known, cubic=cubic).shift_mm for cubic in (False, True)
        )
    assert np.abs(cubic + 0.4).mean() < 0.93 * np.abs(linear + 0.4).mean()  # measured 0.136 and 0.157 mm


def test_walls_across_thick_slices_have_larger_errors_than_walls_along_them(device):
    """Slices of 2 mm, a blur of 0.5 mm."""
    mesh, fit = fit_surface(hollow_ball(thickness=3.0, blur=0.5, spacing=(1.0, 1.0, 2.0)), device)
    _, rows = outer_places(mesh, fit)
    along_axis = np.abs(mesh.normals[rows, 2])
    across, within = (np.median(fit.error_mm[rows][chosen]) for chosen in (along_axis > 0.9, along_axis < 0.3))
    assert across > 2.5 * within  # measured 3.3; 1.6 by the spread alone


def test_voxels_lie_as_far_apart_along_a_normal_as_their_axes_and_gaps_say():
    """Voxels of 0.7 x 0.9 x 2 mm; between two of the slices the gap is twice as large, so its square is 4."""
    volume = hollow_ball(spacing=(0.7, 0.9, 2.0))
    diagonal = np.sqrt(0.5) * np.array([1.0, 1.0, 0.0])
    steps = StackFrame(volume).steps_along(np.stack([*np.eye(3), -np.eye(3)[2], diagonal]), np.array([1, 1, 1, 4, 1]))
    # Half the square of each axis' step, squared and added.
    np.testing.assert_allclose(steps, [0.7, 0.9, 2.0, 4.0, (0.7**4 / 4 + 0.9**4 / 4) ** 0.25], rtol=1e-6)  # float32


def test_constants_are_the_blur_and_density_of_the_scan(device):
    _, fit = fit_surface(hollow_ball(thickness=4.0, blur=0.8, cortex=1000.0), device)
    constants = fit.constants
    blur_mm = np.hypot(0.8, 0.37)  # interpolation between voxels of 1 mm blurs further: measured 0.88
    assert constants.blur_mm == pytest.approx(blur_mm, abs=0.08)  # measured 0.03 more
    assert constants.blur_across_mm == pytest.approx(blur_mm, abs=0.08)  # measured 0.03 more
    assert constants.cortex_hu == pytest.approx(1000.0, rel=0.04)  # measured 1009


def test_constants_are_taken_from_the_most_walls_allowed_and_many_thick_ones(device):
    _, fit = fit_surface(hollow_ball(thickness=4.0, blur=0.8), device)
    assert fit.constants.places == MOST_WALLS
    assert fit.constants.thick > 100  # measured 500


def noisy(volume: Volume, hu: float, seed: int) -> Volume:
    noise = np.random.default_rng(seed).normal(0.0, hu, volume.voxels.shape)
    return volume.with_voxels(np.rint(volume.voxels + noise).astype(np.int16))


def two_walls(thin: float, thick: float, thin_share: float, **shell: float) -> Volume:
    """A shell of 1000 HU, a share of which, from its lower pole on, is thin."""
    height = np.arange(40)[:, None, None] - MIDDLE[2]
    return hollow_ball(thickness=np.where(height < OUTER_RADIUS * (2.0 * thin_share - 1.0), thin, thick), **shell)


def solid_cylinder(radius: float) -> Volume:
    """Bone of 1000 HU without marrow, tilted against the slices and longer than the volume."""
    k, j, i = np.indices((44, 44, 44))
    inside = ndtr((radius - np.hypot(i - 21.7, 0.9 * j + 0.43 * k - 28.0)) / 0.7)
    return Volume(np.rint(50.0 + 950.0 * inside).astype(np.int16), np.eye(4))


# Without what each of them needs 1,232, 1,365, 853 and 1,405 HU were found.
HARD_SCANS = {
    "solid bone": noisy(solid_cylinder(11.0), 20.0, seed=2),  # measured 1,012
    "few thick walls": noisy(two_walls(2.2, 4.0, 0.7, blur=1.3), 30.0, seed=1),  # 997
    "thick walls that show too little": noisy(two_walls(0.8, 2.4, 0.4, blur=1.1, inner=400.0), 10.0, seed=1),  # 960
    "thick walls that are alike": hollow_ball(thickness=2.0),  # 1,007
}


@pytest.mark.parametrize("volume", HARD_SCANS.values(), ids=HARD_SCANS)
def test_cortex_of_1000_hu_is_known_to_a_tenth(device, volume):
    assert fit_surface(volume, device)[1].constants.cortex_hu == pytest.approx(1000.0, rel=0.1)


def test_noise_makes_the_cortex_neither_denser_nor_moves_it(device):
    """Thick walls' percentile holds noise, the blur follows it, and it the blur: 15 % and 0.13 mm inwards."""
    mesh, fit = fit_surface(noisy(hollow_ball(thickness=2.6, blur=0.5), 40.0, seed=3), device, level=500.0)

    assert fit.constants.cortex_hu == pytest.approx(1000.0, rel=0.04)  # measured 1013
    assert fit.constants.blur_mm == pytest.approx(np.hypot(0.5, 0.4), abs=0.08)  # with that of the interpolation
    away, _ = outer_places(mesh, fit)
    assert abs(np.mean(away)) < 0.05  # mm; measured 0.03


@pytest.mark.parametrize("name", ["shift_mm", "thickness_mm", "error_mm"])
def test_lengths_of_a_fit_scale_with_the_voxels(device, name):
    voxels = hollow_ball(thickness=3.0).voxels
    (_, large), (_, small) = (fit_surface(Volume(voxels, np.diag([mm, mm, mm, 1.0])), device) for mm in (1.0, 0.02))
    of_large, of_small = (getattr(fit, name)[fit.states == FITTED].mean() for fit in (large, small))
    assert of_small / 0.02 == pytest.approx(of_large, rel=0.03, abs=0.01)  # measured 0.019, and 0.005 mm


def test_blur_of_a_fit_scales_with_the_voxels(device):
    voxels = hollow_ball(thickness=3.0).voxels
    (_, large), (_, small) = (fit_surface(Volume(voxels, np.diag([mm, mm, mm, 1.0])), device) for mm in (1.0, 0.02))
    assert small.constants.blur_mm / 0.02 == pytest.approx(large.constants.blur_mm, rel=0.05)  # measured 0.019


@pytest.mark.parametrize(
    ("uneven", "few", "cubic"),
    [(False, False, False), (True, False, False), (False, True, False), (False, False, True)],
    ids=["even", "uneven", "few places at a time", "cubic"],
)
def test_cortex_fitted_in_slabs_is_that_of_the_whole(device, uneven, few, cubic):
    volume = stack(hollow_ball(thickness=2.0).voxels, OBLIQUE, uneven=uneven)
    mesh, whole = fit_surface(volume, device, cubic=cubic)
    assert mesh.vertex_count > 4 * cortex.SMALLEST_PIECE  # few places at a time are several pieces; measured 3538
    places = cortex.SMALLEST_PIECE if few else cortex.stride_of(mesh.vertex_count)
    place_bytes = 4 * (cortex.ROWS + cortex.RESULTS) + 32  # what each profile takes on the device
    memory = volume.voxels.nbytes // 2 + place_bytes * places

    with DeviceVolume(volume, device=device, memory=memory) as resident:
        sampler = ProfileSampler(resident, Stopwatch(), cubic=cubic)
        assert len(list(sampler.pieces(mesh.vertices, mesh.normals, np.arange(mesh.vertex_count)))) > 1
        slabs = fit_walls(
            resident, mesh.vertices, mesh.normals, stopwatch=Stopwatch(), constants=whole.constants, cubic=cubic
        )

    for name in ("states", "shift_mm", "thickness_mm", "error_mm", "room_mm"):
        assert np.array_equal(getattr(slabs, name), getattr(whole, name), equal_nan=True), name


@pytest.fixture(scope="module")
def surface_with_vessel_and_metal(device):
    """A shell of bone, a vessel with contrast medium from end to end, and a block of metal; their surface and fit."""
    volume = hollow_ball(thickness=2.0)
    voxels = volume.voxels.copy()
    k, j, i = np.indices(voxels.shape)
    vessel = 50.0 + 270.0 * ndtr((3.0 - np.hypot(i - 4.0, j - 4.0)) / 0.7)
    voxels = np.maximum(voxels, np.rint(vessel).astype(np.int16))
    voxels[(np.abs(i - 35) < 2) & (np.abs(j - 35) < 2) & (np.abs(k - 20) < 4)] = 3000
    return fit_surface(volume.with_voxels(voxels), device)


def test_vertices_at_the_ends_of_the_scan_have_no_room(surface_with_vessel_and_metal):
    mesh, fit = surface_with_vessel_and_metal
    z = mesh.vertices[:, 2]
    at_end = (z < 0.0) | (z > 39.0)  # the last of 40 slices is at 39 mm
    assert set(fit.states[at_end].tolist()) == {NO_ROOM}


def test_vertices_on_a_vessel_are_no_bone(surface_with_vessel_and_metal):
    mesh, fit = surface_with_vessel_and_metal
    x, y, z = mesh.vertices.T
    on_vessel = (np.hypot(x - 4, y - 4) < 4) & (z > 3) & (z < 36)
    assert (fit.states[on_vessel] == NOT_BONE).mean() > 0.95  # measured 1


def test_vertices_on_metal_are_told_as_metal(surface_with_vessel_and_metal):
    mesh, fit = surface_with_vessel_and_metal
    x, y, _ = mesh.vertices.T
    on_the_block = (x > 32) & (y > 32)  # from 33 mm on; the shell, 13 mm about (19.5, 19), ends before this corner
    assert set(fit.states[on_the_block].tolist()) == {METAL}


def test_counts_of_the_states_of_a_fit_add_up_to_its_vertices(surface_with_vessel_and_metal):
    mesh, fit = surface_with_vessel_and_metal
    assert sum(fit.counts().values()) == mesh.vertex_count


def constants_with_blurs(*, within_mm: float, across_mm: float) -> CortexConstants:
    """Of a scan whose cortex has 1000 HU, to 50 HU."""
    blurs = {"blur_mm": within_mm, "blur_across_mm": across_mm, "blur_error_mm": 0.02, "blur_across_error_mm": 0.05}
    noise = {"noise_hu": 10.0, "residual_hu": 20.0}
    return CortexConstants(**blurs, **noise, cortex_hu=1000.0, cortex_error_hu=50.0, places=500, thick=100)


@pytest.mark.parametrize(
    ("cortex_hu", "state", "factor"),
    [
        (1000.0, "fitted", 1.0),
        (1140.0, "fitted", 1.0),
        (1450.0, "fitted", 3.0),
        (710.0, "fitted", 29.0 / 15.0),
        (690.0, "badly fitted", 31.0 / 15.0),
    ],
)
def test_walls_unlike_the_cortex_of_the_scan_have_errors_larger_by_a_factor_and_are_badly_fitted_below_70_percent(
    cortex_hu, state, factor
):
    """The cortex of the scan has 1000 HU: what a wall differs by is divided by 150 HU where that is above 1."""
    constants = constants_with_blurs(within_mm=0.7, across_mm=0.7)

    def wall_of(hu: float) -> WallFits:
        plateaus = {"outer_hu": 50.0, "cortex_hu": hu, "inner_hu": 250.0, "peak_hu": 900.0}
        lengths = {"shift_mm": 0.0, "thickness_mm": 2.0, "room_mm": 2.5}
        fit = {**plateaus, **lengths, "residual_hu": 5.0, "shift_variance": 1e-6}
        return WallFits(**{name: np.array([value], np.float32) for name, value in fit.items()})

    wall, usual = wall_of(cortex_hu), wall_of(1000.0)
    (found_state,) = judge_walls(wall, constants, ProfileScale.of(hollow_ball()), np.zeros(1, bool))
    assert _STATES[found_state] == state
    # Float32.
    np.testing.assert_allclose(standard_errors(wall, constants), factor * standard_errors(usual, constants), rtol=1e-5)


@pytest.mark.parametrize(("noise_hu", "error_mm", "state"), [(300.0, 1.6, "fitted"), (700.0, 6.9, "badly fitted")])
def test_walls_with_standard_errors_above_2_5_mm_are_badly_fitted(device, noise_hu, error_mm, state):
    noisy = constants_with_blurs(within_mm=0.8, across_mm=0.8).changed(noise_hu=noise_hu)
    _, fit = fit_surface(hollow_ball(thickness=1.0), device, constants=noisy)
    assert np.median(fit.error_mm) == pytest.approx(error_mm, rel=0.1)
    assert (fit.states == _STATES.index(state)).mean() > 0.9  # the walls of the cavity have no room, or are none


THICK_SLICES = hollow_ball(thickness=1.0, spacing=(1.0, 1.0, 4.0))
CONSTANTS_OF_THICK_SLICES = constants_with_blurs(within_mm=0.7, across_mm=2.0)


def test_thick_slices_hide_thin_walls_that_lie_across_them(device):
    mesh, fit = fit_surface(THICK_SLICES, device, constants=CONSTANTS_OF_THICK_SLICES)
    assert np.count_nonzero(fit.hidden) > 20  # measured 88
    assert np.abs(mesh.normals[fit.hidden, 2]).min() > 0.2  # walls along the slices' axis have 0
    assert {_STATES[state] for state in fit.states[fit.hidden]} == {"badly fitted"}


def test_slices_that_blur_no_more_than_their_pixels_hide_no_wall(device):
    sharp_across = CONSTANTS_OF_THICK_SLICES.changed(blur_across_mm=0.8)
    _, fit = fit_surface(THICK_SLICES, device, constants=sharp_across)
    assert not fit.hidden.any()


@pytest.mark.parametrize("thickness", [0.8, 1.0, 1.5])
def test_errors_of_thin_walls_alone_hold_95_percent_of_the_distances_from_the_truth(device, thickness):
    """Walls of up to twice the blur of 0.7 mm; 1000 HU lie in the range of what describes them as well."""
    mesh, fit = fit_surface(hollow_ball(thickness=thickness), device)
    away, rows = outer_places(mesh, fit)
    assert np.mean(np.abs(away) < 1.96 * fit.error_mm[rows]) > 0.95
    assert fit.constants.denser[2] > 1000.0


def test_thick_walls_have_no_denser_constants(device):
    assert fit_surface(hollow_ball(thickness=3.0), device)[1].constants.denser is None


def plate(thickness: float) -> Volume:
    """A plate of 24 x 24 mm and 1000 HU, tilted by 30 degrees against the slices, blurred by 0.6 of its 1 mm voxels."""
    k, j, i = (index - 17.0 for index in np.indices((35, 35, 35)))
    along, across = 0.866 * j - 0.5 * k, 0.5 * j + 0.866 * k
    inside = np.ones(i.shape)
    for place, half in ((i, 12.0), (along, 12.0), (across, thickness / 2.0)):
        inside *= ndtr((place + half) / 0.6) - ndtr((place - half) / 0.6)
    noise = np.random.default_rng(2).normal(0.0, 10.0, i.shape)
    return Volume(np.rint(50.0 + 950.0 * inside + noise).astype(np.int16), np.eye(4))


def test_walls_of_one_direction_have_one_blur_and_leave_the_other_unknown(device):
    """Searched for both, the blur within slices became 0.04 mm, with an error of 0.001 mm."""
    constants = fit_surface(plate(2.0), device)[1].constants
    assert constants.blur_mm == constants.blur_across_mm == pytest.approx(np.hypot(0.6, 0.4), abs=0.1)  # measured 0.76
    assert constants.blur_error_mm >= 0.4 * constants.blur_mm


def test_sheets_of_a_couch_around_a_shell_leave_the_constants_of_its_bone(device):
    """Sheets of 250 HU between air rise by more than bone does, and have more vertices."""
    voxels = hollow_ball(thickness=3.0, blur=0.7, cortex=1000.0).voxels.copy()
    for beside in (slice(0, 5), slice(-5, None)):
        voxels[:, :, beside] = -900
        voxels[:, beside] = -900
    voxels[:, :, (2, -3)] = 250
    voxels[:, (2, -3)] = 250

    _, fit = fit_surface(Volume(voxels, np.eye(4)), device)

    assert fit.constants.cortex_hu == pytest.approx(1000.0, rel=0.05)  # measured 985
    assert fit.constants.blur_mm == pytest.approx(np.hypot(0.7, 0.4), abs=0.1)  # with that of the interpolation
    assert fit.constants.thick > 300  # measured 494


def test_vessel_farther_than_15_mm_from_bone_is_not_fitted(device):
    """A vessel of 350 HU and 6 mm in a lung, from 9 mm above a shell of bone on: its edges look like thin walls."""
    shell = hollow_ball(thickness=3.0).voxels
    j, i = np.ogrid[: shell.shape[1], : shell.shape[2]]
    vessel = np.rint(-800.0 + 1150.0 * ndtr((3.0 - np.hypot(j - MIDDLE[1], i - MIDDLE[0])) / 0.7)).astype(np.int16)
    volume = Volume(np.concatenate([shell, np.broadcast_to(vessel, (60, *vessel.shape))]), np.eye(4))

    mesh, fit = fit_surface(volume, device)

    beyond_mm = mesh.vertices[:, 2] - (MIDDLE[2] + OUTER_RADIUS)
    is_wall = np.isin(fit.states, (FITTED, BADLY_FITTED))
    cell_mm = 5.0 * np.sqrt(3.0)  # the diagonal of the cells of 15 / 3 mm that near ones are looked for in
    assert not is_wall[beyond_mm > 15.0 + cell_mm].any()
    assert is_wall[(beyond_mm > 10.0) & (beyond_mm < 12.0)].mean() > 0.5


def in_air(volume: Volume) -> Volume:
    """The same with the tissue of 50 HU, and all else, lower by 1050 HU."""
    return Volume(volume.voxels - np.int16(1050), volume.affine)


FAINT_WALLS = {
    "thin and blurred": (hollow_ball(thickness=1.0, blur=1.5), 200.0, {"blur_mm": 1.55, "blur_across_mm": 1.55}),
    "of 400 HU": (hollow_ball(thickness=3.0, cortex=400.0, inner=100.0), 200.0, {"cortex_hu": 400.0}),
    "thin, in air": (in_air(hollow_ball(thickness=0.8, cortex=2050.0, inner=50.0)), -300.0, {"noise_hu": None}),
}


@pytest.mark.parametrize(("volume", "level", "known"), FAINT_WALLS.values(), ids=FAINT_WALLS)
def test_bone_without_compact_walls_is_fitted(device, volume, level, known):
    assert volume.voxels.max() < 0.45 * 1000.0  # HU; the cortex of the scan has 1000
    constants = constants_with_blurs(within_mm=0.8, across_mm=0.8).changed(**known)
    _, fit = fit_surface(volume, device, level=level, constants=constants)
    assert np.count_nonzero(fit.states == NOT_BONE) < 0.05 * len(fit.states)


@pytest.fixture(scope="module")
def two_densities(device):
    """A shell of 1400 HU below one of 900: their surface, which vertices are of the second, and where its middle is."""
    dense, less_dense = (hollow_ball(thickness=4.0, cortex=cortex) for cortex in (1400.0, 900.0))
    volume = Volume(np.concatenate([dense.voxels, less_dense.voxels]), np.eye(4))
    height = len(dense.voxels)
    mesh = extract_isosurface(volume, 200.0, device=device)
    return volume, mesh, (mesh.vertices[:, 2] > height).astype(np.int64), MIDDLE + [0.0, 0.0, height]


def fit_components(device, volume, mesh, components):
    with DeviceVolume(volume, device=device) as resident:
        return fit_walls(resident, mesh.vertices, mesh.normals, stopwatch=Stopwatch(), components=components)


def test_the_less_dense_of_two_bones_alone_has_a_cortex_of_its_own_where_components_are_given(device, two_densities):
    """The cortex of the scan is that of the denser bone, which needs no other."""
    volume, mesh, is_second, _ = two_densities
    (own_cortex_hu,) = fit_components(device, volume, mesh, is_second).own_cortex_hu
    assert own_cortex_hu == pytest.approx(900.0, rel=0.015)  # measured 911


def test_no_bone_has_a_cortex_of_its_own_where_no_components_are_given(device, two_densities):
    volume, mesh, _, _ = two_densities
    assert fit_components(device, volume, mesh, components=None).own_cortex_hu == ()


def test_the_less_dense_of_two_bones_is_found_nearer_to_the_truth_by_its_own_cortex(device, two_densities):
    volume, mesh, is_second, middle = two_densities
    outer = (is_second == 1) & (np.linalg.norm(mesh.vertices - middle, axis=1) > OUTER_RADIUS - 0.5)

    def mean_distance(*, components):
        fit = fit_components(device, volume, mesh, components)
        places = mesh.vertices + fit.shift_mm[:, None] * mesh.normals
        return np.abs(np.linalg.norm(places[outer] - middle, axis=1) - OUTER_RADIUS).mean()

    assert mean_distance(components=is_second) < 0.06 < mean_distance(components=None)  # mm; measured 0.02 and 0.19


def test_a_scan_without_bone_is_refused(device):
    soft = hollow_ball(cortex=260.0, inner=260.0)
    with refused(NoSurfaceError, "walls", "bone"):
        fit_surface(soft, device, level=150.0)


@pytest.mark.oclgrind
def test_profiles_half_a_millimetre_outside_of_a_wall_find_it(device):
    directions = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    points = MIDDLE + (OUTER_RADIUS + 0.5) * directions
    with DeviceVolume(hollow_ball(cortex=1000.0), device=device) as resident:
        sampler = ProfileSampler(resident, Stopwatch())
        profiles = sampler.take(sampler.values(points, directions))
        blur_mm = float(np.hypot(0.7, 0.41))  # with that of the interpolation
        walls = profiles.fit(blur_mm=blur_mm, across_mm=blur_mm, cortex_hu=1000.0, noise_hu=10.0)
    assert walls.shift_mm == pytest.approx([-0.5] * 3, abs=0.06)  # measured 0.03


def test_walls_of_bone_reach_from_fit_to_fit_and_are_unknown_where_a_face_is_none(device):
    """Rays through a ball of 26 mm from 0.5 mm outside of it; one that meets nothing, and one that ends in tissue."""
    volume = hollow_ball(thickness=4.0)
    directions = np.repeat(np.eye(3), 2, axis=0) * np.tile([[1.0], [-1.0]], (3, 1))
    lengths = np.array([27.0, 27.0, 27.0, 27.0, np.nan, 0.2])
    with DeviceVolume(volume, device=device) as resident:
        _, fit = fit_surface(volume, device)
        points = MIDDLE + (OUTER_RADIUS + 0.5) * directions
        found = measure_bone_walls(points, directions, lengths, resident, fit.constants, thin_mm=1.0)
    np.testing.assert_allclose(found[:4], 2 * OUTER_RADIUS, atol=0.3)  # mm: a third of a voxel
    assert np.isnan(found[4:]).all()
