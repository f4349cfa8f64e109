"""The iso value half way between bone and tissue: balls and spines of known truth, what must not move it, refusals."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import math
import tracemalloc
from typing import Any
from unittest import mock

import numpy as np
import pytest
import tolerances
from refusals import assert_one_line, refused
from scipy.ndimage import gaussian_filter

import clrecon
from clrecon.anatomy import materials
from clrecon.anatomy.iso_choice import METAL_SLICES, IsoChoice, choose_iso_value, half_iso_value
from clrecon.anatomy.materials import FEWEST_SLICES, SAMPLED_VOXELS, lies_in_air
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.proof.phantom import PhantomSettings, make_phantom

SPINE = {"size": (192, 192), "slices": 40, "spacing": (1.0, 1.0, 1.25)}


def as_volume(field: np.ndarray) -> Volume:
    return Volume(np.rint(field).astype(np.int16) if field.dtype.kind == "f" else field, np.eye(4))


def blurred_ball(
    bone: float, *, tissue: float, blur: float = 0.8, noise: float = 0.0, radius: float = 10.0
) -> np.ndarray:
    """A ball of bone in tissue, in HU and voxels, with partial volume; the level at its rim is the mean of both."""
    kji = np.indices((44, 44, 44)).reshape(3, -1).T
    distance = np.linalg.norm(kji - (21.7, 21.4, 22.1), axis=1).reshape(44, 44, 44) - radius
    field = tissue + (bone - tissue) * gaussian_filter(np.clip(0.5 - distance, 0.0, 1.0), blur)
    return field + noise * np.random.default_rng(3).standard_normal(field.shape)


@pytest.fixture(scope="module")
def spine() -> np.ndarray:
    """Voxels (40, 192, 192) of a spine phantom, HU."""
    return make_phantom(PhantomSettings(kind="spine", **SPINE))[0]


@pytest.fixture(scope="module")
def spine_level(spine) -> float:
    """The iso value that is chosen for `spine`."""
    return choose_iso_value(as_volume(spine)).iso_value


@pytest.fixture(scope="module")
def comparison(project_root):
    """The script compare_iso_values.py as a module."""
    path = project_root / "scripts" / "proof" / "compare_iso_values.py"
    specification = importlib.util.spec_from_file_location("compare_iso_values", path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


# --- truth ---
@pytest.mark.parametrize("noise", [0.0, 50.0], ids=["clean", "noisy"])
@pytest.mark.parametrize("blur", [0.0, 0.8, 1.5])
@pytest.mark.parametrize(("bone", "tissue"), [(1040.0, 40.0), (1500.0, -80.0), (640.0, 60.0)])
def test_iso_value_of_a_blurred_ball_lies_half_way_between_bone_and_tissue(bone, tissue, blur, noise) -> None:
    step = bone - tissue
    chosen = choose_iso_value(as_volume(blurred_ball(bone, tissue=tissue, blur=blur, noise=noise * step / 1000.0)))
    assert (chosen.method, chosen.background) == ("auto", "soft tissue")
    assert chosen.iso_value == pytest.approx((bone + tissue) / 2.0, abs=tolerances.HALF_WAY_STEP_SHARE * step)


def test_iso_value_is_the_whole_number_half_way_between_the_bone_and_tissue_that_the_reason_names() -> None:
    chosen = choose_iso_value(as_volume(blurred_ball(1040.0, tissue=40.0, noise=50.0)))
    half_way = (chosen.bone_hu + chosen.tissue_hu) / 2.0
    assert abs(chosen.iso_value - half_way) <= 0.5 + 0.05  # rounded to 1 HU; both materials are kept to 0.1 HU
    assert f"bone {chosen.bone_hu:.0f} HU" in chosen.reason


def test_faint_homogeneous_bone_is_not_taken_for_contrast_medium() -> None:
    bone, tissue = 400.0, 40.0
    chosen = choose_iso_value(as_volume(blurred_ball(bone, tissue=tissue, noise=15.0, radius=16.0)))
    tolerance = tolerances.HALF_WAY_STEP_SHARE * (bone - tissue)
    assert chosen.iso_value == pytest.approx((bone + tissue) / 2.0, abs=tolerance)
    assert chosen.contrast_medium_share == 0.0


def test_iso_value_of_a_specimen_in_air_lies_half_way_to_air() -> None:
    bone, air = 1000.0, -1000.0
    volume = as_volume(blurred_ball(bone, tissue=air, noise=30.0))
    chosen = choose_iso_value(volume)
    assert chosen.background == "air"
    assert "between air" in chosen.reason
    assert chosen.iso_value == pytest.approx(0.0, abs=tolerances.HALF_WAY_STEP_SHARE * (bone - air))


def test_a_specimen_in_air_lies_in_air() -> None:
    assert lies_in_air(as_volume(blurred_ball(1000.0, tissue=-1000.0, noise=30.0)))


BACKGROUNDS = [(40, 20.0), (40, 60.0), (-1000, 20.0), (-1000, 60.0)]
BACKGROUND_NAMES = ["soft tissue", "noisy soft tissue", "air", "noisy air"]


def histogram_of_a_peak(mode: float, noise: float) -> np.ndarray:
    hu = np.arange(materials.LOWEST_HU, materials.HIGHEST_HU + 1)
    return 1e5 * np.exp(-0.5 * ((hu - mode) / noise) ** 2)


@pytest.mark.parametrize(("mode", "noise"), BACKGROUNDS, ids=BACKGROUND_NAMES)
def test_background_has_the_mode_and_noise_of_its_peak(mode, noise) -> None:
    background = materials.find_background(histogram_of_a_peak(mode, noise))
    assert background.name == ("soft tissue" if mode == 40 else "air")
    assert background.mode == pytest.approx(mode, abs=1.0)  # values are counted by whole HU
    assert background.noise == pytest.approx(noise, abs=1.0)


@pytest.mark.parametrize(
    ("mode", "noise", "seed", "lowest", "highest"),
    [
        (40, 20.0, 40 + 100, 40 - 250, 40 + 2 * 20.0),
        (40, 60.0, 40 + 4 * 60.0, 40 - 250, 40 + 2 * 60.0),
        (-1000, 20.0, 150, -np.inf, -950.0),
        (-1000, 60.0, 150, -np.inf, -1000 + 2 * 60.0),
    ],
    ids=BACKGROUND_NAMES,
)
def test_background_reaches_two_noises_above_its_mode_and_bone_begins_at_four(
    mode, noise, seed, lowest, highest
) -> None:
    """Bone at 100 HU above soft tissue at least, and at 150 HU beside air; air reaches up to -950 HU at least."""
    background = materials.find_background(histogram_of_a_peak(mode, noise))
    found = [background.seed, background.lowest, background.highest]
    assert found == pytest.approx([seed, lowest, highest], abs=4.0)  # the noise is measured within 1 HU


@pytest.fixture(scope="module")
def spine_error(comparison):
    """A spine phantom, and a function that gives the mean distance in mm of its surface at a level from the truth."""
    volume, distance = comparison.make_spine(SPINE, {})
    return volume, comparison.SpineError(volume, distance)


@pytest.mark.release
@pytest.mark.seconds
def test_the_surface_of_a_spine_at_its_iso_value_is_nearly_as_near_to_the_truth_as_at_the_best_level(
    spine_error,
) -> None:
    volume, error = spine_error
    best = min(error(level) for level in range(250, 651, 50))
    assert error(choose_iso_value(volume).iso_value) <= best + 0.05  # mm, a twentieth of a voxel


@pytest.mark.release
@pytest.mark.seconds
def test_the_surface_of_a_spine_at_the_level_of_otsu_lies_farther_from_the_truth(spine_error, comparison) -> None:
    volume, error = spine_error
    assert error(comparison.by_otsu(volume)) > error(choose_iso_value(volume).iso_value) + 0.2  # 0.53, 0.24 mm


@pytest.fixture(scope="module")
def clean_and_noisy_ball():
    """The choices for a ball of 10 voxels, 1040 in 40 HU, blurred by 0.8 voxels: without noise and with 50 HU."""
    return [choose_iso_value(as_volume(blurred_ball(1040.0, tissue=40.0, noise=noise))) for noise in (0.0, 50.0)]


def test_spread_of_the_level_is_small_without_noise_and_less_than_the_noise(clean_and_noisy_ball) -> None:
    clean, noisy = clean_and_noisy_ball
    assert clean.spread_hu < 5.0 < noisy.spread_hu < 50.0  # the noise; measured 1.5 and 25


def test_noise_of_the_tissue_is_measured(clean_and_noisy_ball) -> None:
    clean, noisy = clean_and_noisy_ball
    assert clean.noise_hu < 10.0  # measured 4.1
    assert noisy.noise_hu == pytest.approx(50.0, rel=0.1)
    assert clean.background_mode_hu == 40.0


def test_steepness_is_at_most_that_of_an_edge_square_to_the_rows(clean_and_noisy_ball) -> None:
    """An edge blurred by s rises by erf(1 / (2 sqrt 2 s)) of its step over a voxel; partial volume adds 1/12 to s^2.

    Steepness is measured along rows and columns: it falls by the cosine, to that of the space diagonal at least.
    """
    clean, _ = clean_and_noisy_ball
    sigma = math.sqrt(0.8**2 + 1.0 / 12.0)
    steepest = 1000.0 * math.erf(0.5 / (math.sqrt(2.0) * sigma))
    assert steepest / math.sqrt(3.0) < clean.steepness_hu_per_voxel < steepest


def test_edges_of_a_ball_are_counted_by_its_area_and_hardly_any_is_faint(clean_and_noisy_ball) -> None:
    """Of 4 pi r^2 square voxels those are counted that face along rows or columns, not up or down."""
    clean, _ = clean_and_noisy_ball
    assert 0.7 < clean.edges / (4.0 * math.pi * 10.0**2) < 1.0  # measured 0.86
    assert clean.faint_share < 0.1  # measured 0.057


def test_edges_of_bone_below_the_level_are_counted_as_faint() -> None:
    """A plate a fifth of a voxel thick, 20 x 44 voxels on either side, beside a ball."""
    field = blurred_ball(1040.0, tissue=40.0)
    field[:, 12:32, 4] = 40.0 + 1000.0 / 5
    chosen = choose_iso_value(as_volume(field))
    assert chosen.iso_value > 40.0 + 1000.0 / 5  # that of the plate
    assert chosen.faint_share == pytest.approx(2 * 44 * 20 / chosen.edges, abs=0.05)  # measured 0.022 more, of the ball


# --- what must not move it ---
@pytest.mark.release
@pytest.mark.parametrize("shift", [-40, -13, 0, 27, 60])
@pytest.mark.parametrize("scale", [0.8, 1.0, 1.25])
def test_iso_value_follows_shift_and_scale_of_the_values(shift: int, scale: float) -> None:
    field = blurred_ball(1040.0, tissue=40.0, noise=20.0)
    expected = choose_iso_value(as_volume(field)).iso_value * scale + shift
    changed = choose_iso_value(as_volume(field * scale + shift))
    assert changed.iso_value == pytest.approx(expected, abs=tolerances.HALF_WAY_SHIFT_HU)


def circle(shape: tuple[int, ...], j: float, i: float, radius: float) -> np.ndarray:
    """Mask (rows, columns) of a circle about the row `j` and the column `i`."""
    rows, columns = np.ogrid[: shape[1], : shape[2]]
    return (rows - j) ** 2 + (columns - i) ** 2 < radius**2


def add_air(spine: np.ndarray) -> np.ndarray:
    return np.pad(spine, ((0, 0), (60, 60), (60, 60)), constant_values=-1000)


def add_padding(spine: np.ndarray) -> np.ndarray:
    return np.where(circle(spine.shape, 95.5, 95.5, radius=95.0), spine, np.int16(-3024))


def add_table(spine: np.ndarray) -> np.ndarray:
    table = np.full((len(spine), 40, spine.shape[2]), -1000, dtype=np.int16)
    table[:, 10:13] = 350  # a dense shell on foam
    table[:, 13:30] = -900
    table[:, 30:32] = 350
    return np.concatenate((spine, table), axis=1)


def add_clothes(spine: np.ndarray) -> np.ndarray:
    clothes = np.full((len(spine), 30, spine.shape[2]), -1000, dtype=np.int16)
    clothes[:, 5:8] = -300
    clothes[:, 6, 20:24] = 900  # a button
    return np.concatenate((clothes, spine), axis=1)


def add_metal(spine: np.ndarray) -> np.ndarray:
    screws = circle(spine.shape, 96, 70, radius=3.0) | circle(spine.shape, 96, 120, radius=3.0)
    return np.where(screws, np.int16(3071), spine)


@pytest.mark.parametrize("add_something", [add_air, add_padding, add_table, add_clothes, add_metal])
def test_iso_value_of_a_spine_stays_with_air_padding_a_table_clothes_or_screws(
    spine, spine_level, add_something
) -> None:
    chosen = choose_iso_value(as_volume(add_something(spine)))
    assert chosen.iso_value == pytest.approx(spine_level, abs=tolerances.HALF_WAY_SHIFT_HU)


def test_iso_value_does_not_change_with_lone_bright_voxels() -> None:
    field = blurred_ball(1040.0, tissue=40.0)
    with_bright_voxels = field.copy()
    with_bright_voxels[:, 2:42:4, 1:6:2] = 300.0  # clear of the border, which is continued
    assert choose_iso_value(as_volume(with_bright_voxels)) == choose_iso_value(as_volume(field))


def test_iso_value_of_a_spine_stays_beside_contrast_medium(spine_level) -> None:
    from clrecon.proof.phantom import build
    from clrecon.proof.phantom import spine as tissue

    with mock.patch.object(build, "BLOOD_HU", 300.0), mock.patch.object(tissue, "KIDNEY_HU", 180.0):
        voxels = make_phantom(PhantomSettings(kind="spine", **SPINE))[0]
    chosen = choose_iso_value(as_volume(voxels))
    assert chosen.contrast_medium_share > 0.1  # without medium it is 0
    assert chosen.iso_value == pytest.approx(spine_level, abs=tolerances.HALF_WAY_CONTRAST_MEDIUM_HU)


@pytest.mark.parametrize("dtype", ["int16", "int32", "float32"])
def test_iso_value_is_the_same_for_voxels_of_int16_int32_and_float32(dtype) -> None:
    field = np.rint(blurred_ball(1040.0, tissue=40.0, noise=20.0)).astype(np.int16)
    expected = choose_iso_value(as_volume(field))
    assert choose_iso_value(Volume(field.astype(dtype), np.eye(4))) == expected


def test_iso_value_of_unsigned_bytes_lies_half_way_though_differences_exceed_them() -> None:
    bone, tissue = 240.0, 40.0
    voxels = np.clip(np.rint(blurred_ball(bone, tissue=tissue)), 0, 255).astype(np.uint8)
    chosen = choose_iso_value(Volume(voxels, np.eye(4)))
    assert chosen.iso_value == pytest.approx((bone + tissue) / 2, abs=tolerances.HALF_WAY_SHIFT_HU)


# --- sampling ---
@pytest.fixture(scope="module")
def spine_twelve_times(spine) -> Volume:
    """480 slices."""
    return as_volume(np.tile(spine, (12, 1, 1)))


def test_iso_value_of_480_slices_is_that_of_every_third(spine_twelve_times, spine_level) -> None:
    most_slices = SAMPLED_VOXELS // (192 * 192)
    assert 2 * most_slices < 480 <= 3 * most_slices
    chosen = choose_iso_value(spine_twelve_times)
    assert (chosen.slices, chosen.slice_step) == (480 / 3, 3)
    assert chosen.iso_value == pytest.approx(spine_level, abs=tolerances.HALF_WAY_STRIDE_HU)


def test_the_same_iso_value_is_chosen_a_second_time(spine_twelve_times) -> None:
    assert choose_iso_value(spine_twelve_times) == choose_iso_value(spine_twelve_times)


def test_a_mapped_volume_is_looked_at_slice_by_slice_in_little_memory(tmp_path) -> None:
    """A ball of 1040 HU in 40 HU within 800 slices on disk, of which every fourth is looked at."""
    mapped = np.memmap(tmp_path / "voxels", dtype=np.int16, mode="w+", shape=(800, 192, 192))
    mapped[:] = 40
    mapped[200:244, 60:104, 60:104] = np.rint(blurred_ball(1040.0, tissue=40.0)).astype(np.int16)
    volume = Volume(mapped, np.eye(4))
    assert np.shares_memory(volume.voxels, mapped)
    most_slices = SAMPLED_VOXELS // (192 * 192)
    assert 3 * most_slices < 800 <= 4 * most_slices

    tracemalloc.start()
    chosen = choose_iso_value(volume)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert (chosen.slices, chosen.slice_step) == (800 / 4, 4)
    assert chosen.iso_value == pytest.approx(540.0, abs=tolerances.HALF_WAY_STEP_SHARE * 1000.0)
    assert peak < mapped.nbytes / 50  # measured a 95th


def ball_in_noisy_air(*, outside_hu: float, **report: Any) -> Volume:
    """A ball of 1040 HU in air with noise of 60 HU, and padding outside of the circle of reconstruction."""
    field = np.pad(blurred_ball(1040.0, tissue=-1000.0), ((0, 0), (20, 20), (20, 20)), constant_values=-1000.0)
    field += np.random.default_rng(3).normal(0, 60, field.shape)
    side = field.shape[1]
    inside = circle(field.shape, (side - 1) / 2, (side - 1) / 2, side / 2)
    volume = as_volume(np.where(inside, field, outside_hu))
    volume.report.update(padding_share=float(1.0 - inside.mean()), **report)
    return volume


def test_noise_of_air_is_measured_inside_of_padding() -> None:
    chosen = choose_iso_value(ball_in_noisy_air(outside_hu=-3024.0))
    assert chosen.background == "air"
    assert chosen.noise_hu == pytest.approx(60, rel=0.05)  # measured 61.5


def test_padding_that_reading_filled_with_air_does_not_hide_the_noise_of_air() -> None:
    filled = ball_in_noisy_air(outside_hu=-1000.0, padding_hu=-1000.0)
    assert choose_iso_value(filled) == choose_iso_value(ball_in_noisy_air(outside_hu=-3024.0))


def test_padding_of_air_that_the_report_does_not_name_hides_the_noise_of_air() -> None:
    """A third of all voxels are at exactly -1000 HU."""
    assert choose_iso_value(ball_in_noisy_air(outside_hu=-1000.0, padding_hu=None)).noise_hu < 20  # measured 7.5 of 60


@pytest.mark.parametrize(("share", "left"), [(0.04, 6.0), (0.1, 0.0), (0.2, 0.0)])
def test_padded_voxels_are_taken_off_the_count_of_their_value_down_to_zero(share, left) -> None:
    """Of 100 voxels in all, 10 have the value of the padding, and 4, 10 or 20 of the scan are padded."""
    counts = np.full(3000, 10.0)
    materials.leave_padding(counts, counted=100, report={"padding_hu": materials.LOWEST_HU + 7, "padding_share": share})
    expected = np.full(3000, 10.0)
    expected[7] = left
    np.testing.assert_array_equal(counts, expected)


# --- what is refused ---
def make_water_phantom() -> np.ndarray:
    tube = np.where(circle((1, 96, 96), 48, 48, radius=36), 0.0, -1000.0)
    return gaussian_filter(np.repeat(tube[None], 40, 0), 1.0) + np.random.default_rng(4).normal(0, 15, (40, 96, 96))


def make_grain() -> np.ndarray:
    grain = gaussian_filter(np.random.default_rng(5).standard_normal((40, 128, 128)), 1.2)
    return 30.0 + 60.0 * grain / grain.std()


REFUSED = {
    "constant water": (np.zeros((8, 32, 32)), "soft tissue has its mode at 0 HU.* 0 edges of bone"),
    "values of 16 bits": (np.full((8, 32, 32), 20000.0), "most voxels are at 3071 or above, so values may not be HU"),
    "constant bone": (np.full((8, 32, 32), 700.0), "no two materials.*most voxels are near 700 HU"),
    "padding": (np.full((8, 32, 32), -2000.0), "nothing but padding"),
    "white noise": (np.random.default_rng(6).normal(0, 100, (40, 128, 128)), "noise of 1?[09]\\d HU"),
    "grainy noise": (make_grain(), "no bone found.*noise of [56]\\d HU"),
    "even noise": (np.random.default_rng(8).uniform(-1000, 2000, (40, 64, 64)), "no two materials"),
    "water phantom": (make_water_phantom(), "soft tissue has its mode at -?[01] HU"),
    "metal in water": (np.minimum(blurred_ball(8000.0, tissue=40.0, noise=20.0), 3071.0), "no bone found"),
    "raw air": (np.full((8, 32, 32), 24.0) + np.arange(32), " 0 edges of bone"),
}


@pytest.mark.parametrize(("field", "words"), REFUSED.values(), ids=REFUSED)
def test_voxels_without_two_materials_are_refused_in_one_line_that_says_how_to_give_a_value(field, words) -> None:
    with pytest.raises(NoSurfaceError, match=words) as caught:
        choose_iso_value(as_volume(field))
    assert_one_line(caught.value, "iso_value=N")


@pytest.mark.parametrize(("field", "_words"), REFUSED.values(), ids=REFUSED)
def test_voxels_without_two_materials_do_not_lie_in_air(field, _words) -> None:
    assert not lies_in_air(as_volume(field))


def add_cut_air(field: np.ndarray, rows: int = 30, noise: float = 90.0) -> np.ndarray:
    """Add noisy air that the scale of the file cuts off: a spike at the lowest value."""
    air = -450.0 + noise * np.random.default_rng(2).standard_normal((len(field), rows, field.shape[2]))
    return np.maximum(np.concatenate([field, air], axis=1), -410.0)


NOISY_BALL = blurred_ball(1040.0, tissue=0.0, noise=30.0)

RAW = {  # voxels, and the values of their two materials
    "noise beside cut air": (add_cut_air(blurred_ball(1040.0, tissue=0.0, noise=90.0)), 0.0, 1040.0),
    "beside three times as much air": (add_cut_air(NOISY_BALL, rows=140, noise=30.0), 0.0, 1040.0),
    "beside 23 times as much air": (add_cut_air(NOISY_BALL, rows=1000, noise=30.0), 0.0, 1040.0),
    "CT without its intercept": (blurred_ball(1040.0, tissue=40.0) + 1024.0, 1064.0, 2064.0),
    "16 bits of micro-CT": (blurred_ball(30_000.0, tissue=9000.0, noise=400.0), 9000.0, 30_000.0),
    "8 bits": (blurred_ball(200.0, tissue=30.0, noise=3.0), 30.0, 200.0),
    "a share": (blurred_ball(0.9, tissue=0.2, noise=0.01), 0.2, 0.9),
    "a casting in air": (blurred_ball(1.6, tissue=0.0, noise=0.01), 0.0, 1.6),
}


@functools.cache
def choose_on_its_own_scale(name: str) -> IsoChoice:
    """The choice for voxels of 0.5 mm whose values are not known to be HU."""
    voxels, _, _ = RAW[name]
    volume = Volume(voxels.astype(np.float32), np.diag((0.5, 0.5, 0.5, 1.0)))
    volume.report["gates"] = [{"name": "hu_known", "ok": False}]
    return choose_iso_value(volume)


@pytest.mark.parametrize("name", RAW)
def test_iso_value_on_the_scale_of_the_scan_itself_lies_half_way_between_its_materials(name) -> None:
    _, tissue, bone = RAW[name]
    step = bone - tissue
    chosen = choose_on_its_own_scale(name)
    assert chosen.iso_value == pytest.approx((bone + tissue) / 2.0, abs=tolerances.HALF_WAY_STEP_SHARE * step)
    assert chosen.bone_hu == pytest.approx(bone, abs=2 * tolerances.HALF_WAY_STEP_SHARE * step)
    assert "on the scan's own scale, with two materials near" in chosen.reason


@pytest.mark.parametrize("name", RAW)
def test_the_reason_of_a_value_on_the_own_scale_names_a_point_of_the_surface(name) -> None:
    """The ball has a radius of 10 voxels of 0.5 mm about the voxel (22.1, 21.4, 21.7)."""
    point = choose_on_its_own_scale(name).seen_at_lps_mm
    from_centre = np.linalg.norm(np.array(point) - np.array((22.1, 21.4, 21.7)) * 0.5)
    assert from_centre == pytest.approx(10 * 0.5, abs=2 * 0.5)  # two voxels: measured up to 0.93 mm
    assert f"{point[0]:.4g}" in choose_on_its_own_scale(name).reason


def test_values_that_are_known_to_be_hu_keep_their_scale() -> None:
    volume = as_volume(blurred_ball(2040.0, tissue=1040.0))
    volume.report["gates"] = [{"name": "hu_known", "ok": True}]
    with refused(NoSurfaceError, "materials"):
        choose_iso_value(volume)


def disc_with_metal(*, slices_with_metal: int) -> Volume:
    """40 equal slices of bone; the lower 20 have streaks of 300 HU, of a rod of metal in as many slices as given."""
    voxels = np.tile(blurred_ball(1040.0, tissue=40.0)[None, 22], (40, 1, 1))
    if slices_with_metal:
        voxels[:20, 2:6, 2:40] = 340.0
        voxels[:20, ::6] += 300.0
        voxels[:slices_with_metal, 40:43, 30:40] = 3071.0
    return as_volume(voxels)


def test_slices_with_metal_and_three_beside_them_are_left_out_and_counted_in_the_reason() -> None:
    chosen = choose_iso_value(disc_with_metal(slices_with_metal=20))
    assert METAL_SLICES == 3
    assert chosen.slices == 40 - (20 + 3)
    assert "23 slices with metal left out" in chosen.reason


def test_iso_value_does_not_change_with_metal_and_its_streaks() -> None:
    without = choose_iso_value(disc_with_metal(slices_with_metal=0))
    assert "metal" not in without.reason
    assert choose_iso_value(disc_with_metal(slices_with_metal=20)).iso_value == without.iso_value


@pytest.mark.parametrize(("without_metal", "slices"), [(FEWEST_SLICES, FEWEST_SLICES), (FEWEST_SLICES - 1, 40)])
def test_all_slices_count_where_too_few_are_without_metal(without_metal: int, slices: int) -> None:
    slices_with_metal = 40 - METAL_SLICES - without_metal
    assert choose_iso_value(disc_with_metal(slices_with_metal=slices_with_metal)).slices == slices


def test_a_voxel_of_nan_is_refused_with_its_slice() -> None:
    field = blurred_ball(1040.0, tissue=40.0).astype(np.float32)
    field[5, 9, 13] = np.nan
    with refused(NoSurfaceError, "NaN", 5):
        choose_iso_value(Volume(field, np.eye(4)))


def test_iso_value_does_not_change_with_voxels_of_plus_and_minus_infinity() -> None:
    field = blurred_ball(1040.0, tissue=40.0).astype(np.float32)
    with_infinities = field.copy()
    with_infinities[5, 5, 5:7] = np.inf
    with_infinities[6, 6, 6:8] = -np.inf
    expected = choose_iso_value(Volume(field, np.eye(4))).iso_value
    assert choose_iso_value(Volume(with_infinities, np.eye(4))).iso_value == expected


# --- given materials ---
@pytest.mark.parametrize(("bone", "tissue", "level"), [(1200, 40, 620.0), (0.5, -1000.5, -500.0), (101, 100, 100.5)])
def test_iso_value_of_given_materials_lies_half_way_and_the_reason_names_both(bone, tissue, level) -> None:
    chosen = half_iso_value(bone, tissue)
    assert (chosen.iso_value, chosen.bone_hu, chosen.tissue_hu, chosen.method) == (level, bone, tissue, "half")
    assert chosen.reason == f"half way between tissue {tissue:g} and bone {bone:g} HU, as given"


@pytest.mark.parametrize(
    ("bone", "tissue", "words"),
    [(40, 1200, (40, 1200, "HU")), (40, 40, ("above",)), (math.nan, 1, ("finite",)), (1, -math.inf, ("finite",))],
    ids=["bone below tissue", "both equal", "bone of NaN", "tissue of infinity"],
)
def test_bone_that_is_not_above_tissue_or_not_finite_is_refused(bone, tissue, words) -> None:
    with refused(UsageError, *words):
        half_iso_value(bone, tissue)


def test_an_iso_choice_cannot_be_changed() -> None:
    chosen, field = half_iso_value(1200.0, 40.0), "iso_value"
    with pytest.raises(dataclasses.FrozenInstanceError, match=field):
        setattr(chosen, field, 1.0)


def test_dictionary_of_an_iso_choice_has_all_its_fields() -> None:
    chosen = clrecon.choose_iso_value(as_volume(blurred_ball(1040.0, tissue=40.0)))
    assert chosen.as_dict() == {field.name: getattr(chosen, field.name) for field in dataclasses.fields(chosen)}


def test_measurements_of_an_iso_choice_are_all_fields_but_value_and_reason() -> None:
    chosen = clrecon.choose_iso_value(as_volume(blurred_ball(1040.0, tissue=40.0)))
    assert set(chosen.as_dict()) - set(chosen.measurements()) == {"iso_value", "reason"}


# --- real CT ---
@pytest.mark.parametrize("folder", ["lumbar_4p25mm", "thoracic_0p8mm", "thoracolumbar_labels/ct_2mm_jpeg2000"])
def test_iso_value_of_real_ct_lies_between_soft_tissue_and_cortical_bone(real_data, folder) -> None:
    chosen = choose_iso_value(clrecon.read_volume(real_data / folder))
    assert -60.0 < chosen.tissue_hu < 60.0  # fat and muscle
    assert 150.0 < chosen.iso_value < 450.0  # half way to bone of 350 to 850 HU
    assert chosen.edges > 5000  # of bone: many are needed for a level
