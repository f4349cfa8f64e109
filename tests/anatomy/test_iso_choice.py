"""The iso value half way between bone and tissue: balls and spines of known truth, what must not move it, refusals."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import tracemalloc
from unittest import mock

import numpy as np
import pytest
import tolerances
from refusals import refused
from scipy.ndimage import gaussian_filter

import clrecon
from clrecon.anatomy import materials
from clrecon.anatomy.iso_choice import choose_iso_value, half_iso_value
from clrecon.anatomy.materials import lies_in_air
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.proof.phantom import PhantomSettings, make_phantom

SPINE = {"size": (192, 192), "slices": 40, "spacing": (1.0, 1.0, 1.25)}


def as_volume(field: np.ndarray) -> Volume:
    return Volume(np.rint(field).astype(np.int16) if field.dtype.kind == "f" else field, np.eye(4))


def make_ball(bone: float, tissue: float, blur: float = 0.8, noise: float = 0.0, radius: float = 10.0) -> np.ndarray:
    """A ball in tissue with partial volume and blur; the level at its rim is the mean of both."""
    kji = np.indices((44, 44, 44)).reshape(3, -1).T
    distance = np.linalg.norm(kji - (21.7, 21.4, 22.1), axis=1).reshape(44, 44, 44) - radius
    field = tissue + (bone - tissue) * gaussian_filter(np.clip(0.5 - distance, 0.0, 1.0), blur)
    return field + noise * np.random.default_rng(3).standard_normal(field.shape)


@pytest.fixture(scope="module")
def spine() -> np.ndarray:
    return make_phantom(PhantomSettings(kind="spine", **SPINE))[0]


@pytest.fixture(scope="module")
def spine_level(spine) -> float:
    return choose_iso_value(as_volume(spine)).iso_value


@pytest.fixture(scope="module")
def comparison(project_root):
    path = project_root / "scripts" / "proof" / "compare_iso_values.py"
    specification = importlib.util.spec_from_file_location("compare_iso_values", path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


# --- truth ---
@pytest.mark.parametrize("noise", [0.0, 50.0])
@pytest.mark.parametrize("blur", [0.0, 0.8, 1.5])
@pytest.mark.parametrize(("bone", "tissue"), [(1040.0, 40.0), (1500.0, -80.0), (640.0, 60.0)])
def test_a_blurred_ball_is_cut_at_half_its_step(bone, tissue, blur, noise) -> None:
    step = bone - tissue
    chosen = choose_iso_value(as_volume(make_ball(bone, tissue, blur, noise * step / 1000.0)))
    assert abs(chosen.iso_value - (bone + tissue) / 2.0) <= tolerances.HALF_WAY_STEP_SHARE * step
    assert (chosen.method, chosen.background) == ("auto", "soft tissue")
    assert abs(chosen.iso_value - (chosen.bone_hu + chosen.tissue_hu) / 2.0) <= 0.5 + 0.05  # both kept to 0.1 HU
    assert f"bone {chosen.bone_hu:.0f} HU" in chosen.reason


def test_faint_homogeneous_bone_is_not_taken_for_contrast_medium() -> None:
    chosen = choose_iso_value(as_volume(make_ball(400.0, 40.0, 0.8, 15.0, radius=16.0)))
    assert abs(chosen.iso_value - 220.0) <= tolerances.HALF_WAY_STEP_SHARE * 360.0
    assert chosen.contrast_medium_share == 0.0


def test_a_specimen_in_air_is_cut_half_way_to_air() -> None:
    volume = as_volume(make_ball(1000.0, -1000.0, 0.8, 30.0))
    chosen = choose_iso_value(volume)
    assert lies_in_air(volume) and abs(chosen.iso_value) <= tolerances.HALF_WAY_STEP_SHARE * 2000.0
    assert chosen.background == "air" and "between air" in chosen.reason


@pytest.mark.parametrize(
    ("mode", "noise", "around"),
    [
        (40, 20.0, ("soft tissue", 140, -210.0, 80.0)),
        (40, 60.0, ("soft tissue", 280, -210.0, 160.0)),
        (-1000, 20.0, ("air", 150, -np.inf, -950.0)),
        (-1000, 60.0, ("air", 150, -np.inf, -880.0)),
    ],
)
def test_background_has_the_mode_and_noise_of_its_peak_and_a_range_around_it(mode, noise, around) -> None:
    hu = np.arange(materials.LOWEST_HU, materials.HIGHEST_HU + 1)
    found = materials.find_background(1e5 * np.exp(-0.5 * ((hu - mode) / noise) ** 2))
    assert found.mode == pytest.approx(mode, abs=1.0) and found.noise == pytest.approx(noise, abs=1.0)
    name, *figures = around
    assert found.name == name
    assert [found.seed, found.lowest, found.highest] == pytest.approx(figures, abs=4.0)


@pytest.mark.release
@pytest.mark.seconds
def test_the_spine_is_cut_where_its_surface_is_nearest(comparison) -> None:
    volume, distance = comparison.make_spine(SPINE, {})
    error = comparison.SpineError(volume, distance)
    best = min(error(level) for level in range(250, 651, 50))
    assert error(choose_iso_value(volume).iso_value) <= best + 0.05  # mm, a twentieth of a voxel
    assert error(comparison.by_otsu(volume)) > best + 0.2  # the measure tells a bad level from a good one


def test_spread_noise_and_steepness_are_those_of_a_ball_of_known_blur() -> None:
    clean, noisy = (choose_iso_value(as_volume(make_ball(1040.0, 40.0, 0.8, noise))) for noise in (0.0, 50.0))
    assert clean.spread_hu < 5.0 < noisy.spread_hu < 50.0
    assert clean.noise_hu < 10.0 and noisy.noise_hu == pytest.approx(50.0, rel=0.1)
    # erf(1 / (2 sqrt 2 s)), with the box of partial volume in s: the steepest step of a blurred edge
    sigma = math.sqrt(0.8**2 + 1.0 / 12.0)
    steepest = 1000.0 * math.erf(0.5 / (math.sqrt(2.0) * sigma))
    assert math.cos(math.radians(54.8)) * steepest < clean.steepness_hu_per_voxel < steepest  # along rows and columns
    assert clean.faint_share < 0.1 and clean.background_mode_hu == 40.0  # the caps, touched in passing
    assert 0.5 < clean.edges / (4.0 * math.pi * 10.0**2) < 1.0  # about the area, less what faces up or down


def test_faint_bone_is_counted() -> None:
    """A plate a fifth of a voxel thick beside a ball: it stays below the level and makes its share of the edges."""
    field = make_ball(1040.0, 40.0)
    field[:, 12:32, 4] = 240.0
    chosen = choose_iso_value(as_volume(field))
    plate = 2 * 44 * 20
    assert chosen.iso_value > 500.0
    assert chosen.faint_share == pytest.approx(plate / chosen.edges, abs=0.05)


# --- what must not move it ---
@pytest.mark.release
@pytest.mark.parametrize("shift", [-40, -13, 0, 27, 60])
@pytest.mark.parametrize("scale", [0.8, 1.0, 1.25])
def test_iso_value_follows_shift_and_scale_of_the_values(shift: int, scale: float) -> None:
    field = make_ball(1040.0, 40.0, 0.8, 20.0)
    expected = choose_iso_value(as_volume(field)).iso_value * scale + shift
    found = choose_iso_value(as_volume(field * scale + shift)).iso_value
    assert abs(found - expected) <= tolerances.HALF_WAY_SHIFT_HU


def circle(shape: tuple[int, ...], j: float, i: float, radius: float) -> np.ndarray:
    rows, columns = np.ogrid[: shape[1], : shape[2]]
    return (rows - j) ** 2 + (columns - i) ** 2 < radius**2


def add_air(spine: np.ndarray) -> np.ndarray:
    return np.pad(spine, ((0, 0), (60, 60), (60, 60)), constant_values=-1000)


def add_padding(spine: np.ndarray) -> np.ndarray:
    return np.where(circle(spine.shape, 95.5, 95.5, 95.0), spine, np.int16(-3024))


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
    screws = circle(spine.shape, 96, 70, 3.0) | circle(spine.shape, 96, 120, 3.0)
    return np.where(screws, np.int16(3071), spine)


@pytest.mark.parametrize("change", [add_air, add_padding, add_table, add_clothes, add_metal])
def test_iso_value_of_a_spine_stays_whatever_surrounds_the_body(spine, spine_level, change) -> None:
    changed = change(spine)
    assert changed.size > spine.size or not np.array_equal(changed, spine)
    assert abs(choose_iso_value(as_volume(changed)).iso_value - spine_level) <= tolerances.HALF_WAY_SHIFT_HU


def test_iso_value_is_the_same_with_lone_bright_voxels() -> None:
    field = make_ball(1040.0, 40.0)
    field[:, 2:42:4, 1:6:2] = 300.0  # clear of the border, which is continued
    assert choose_iso_value(as_volume(field)) == choose_iso_value(as_volume(make_ball(1040.0, 40.0)))


def test_iso_value_of_a_spine_stays_beside_contrast_medium(spine_level) -> None:
    from clrecon.proof.phantom import build
    from clrecon.proof.phantom import spine as tissue

    with mock.patch.object(build, "BLOOD_HU", 300.0), mock.patch.object(tissue, "KIDNEY_HU", 180.0):
        voxels = make_phantom(PhantomSettings(kind="spine", **SPINE))[0]
    chosen = choose_iso_value(as_volume(voxels))
    assert chosen.contrast_medium_share > 0.1
    assert abs(chosen.iso_value - spine_level) <= tolerances.HALF_WAY_CONTRAST_MEDIUM_HU


@pytest.mark.parametrize("dtype", ["int16", "int32", "float32"])
def test_iso_value_is_the_same_for_every_voxel_type(dtype) -> None:
    field = np.rint(make_ball(1040.0, 40.0, 0.8, 20.0)).astype(np.int16)
    expected = choose_iso_value(as_volume(field))
    assert choose_iso_value(Volume(field.astype(dtype), np.eye(4))) == expected


def test_unsigned_bytes_are_compared_without_wrapping() -> None:
    field = np.clip(np.rint(make_ball(240.0, 40.0)), 0, 255).astype(np.uint8)
    assert abs(choose_iso_value(Volume(field, np.eye(4))).iso_value - 140.0) <= 3.0


# --- sampling ---
def test_slices_are_sampled_evenly_and_the_same_each_time(spine, spine_level) -> None:
    long = as_volume(np.tile(spine, (12, 1, 1)))
    first, second = (choose_iso_value(long) for _ in range(2))
    assert first == second
    assert (first.slices, first.slice_step) == (160, 3)
    assert abs(first.iso_value - spine_level) <= tolerances.HALF_WAY_STRIDE_HU


def test_a_mapped_volume_is_looked_at_slice_by_slice(tmp_path) -> None:
    ball = np.rint(make_ball(1040.0, 40.0)).astype(np.int16)
    mapped = np.memmap(tmp_path / "voxels", dtype=np.int16, mode="w+", shape=(800, 192, 192))
    mapped[:] = 40
    mapped[200:244, 60:104, 60:104] = ball
    volume = Volume(mapped, np.eye(4))
    assert np.shares_memory(volume.voxels, mapped)
    tracemalloc.start()
    chosen = choose_iso_value(volume)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert abs(chosen.iso_value - 540.0) <= tolerances.HALF_WAY_STEP_SHARE * 1000.0
    assert (chosen.slices, chosen.slice_step) == (200, 4)
    assert peak < mapped.nbytes / 20


def test_padding_filled_with_air_does_not_hide_the_noise_of_air() -> None:
    field = np.pad(make_ball(1040.0, -1000.0), ((0, 0), (20, 20), (20, 20)), constant_values=-1000.0)
    field += np.random.default_rng(3).normal(0, 60, field.shape)
    inside = circle(field.shape, (field.shape[1] - 1) / 2, (field.shape[2] - 1) / 2, field.shape[1] / 2)
    unfilled, filled = as_volume(np.where(inside, field, -3024.0)), as_volume(np.where(inside, field, -1000.0))
    filled.report.update(padding_hu=-1000.0, padding_share=float(1.0 - inside.mean()))
    expected = choose_iso_value(unfilled)
    assert expected.background == "air" and expected.noise_hu == pytest.approx(60, abs=6)
    assert choose_iso_value(filled) == expected
    filled.report["padding_hu"] = None
    assert choose_iso_value(filled).noise_hu < 20
    for share, left in ((0.04, 6.0), (0.1, 0.0), (0.2, 0.0)):
        counts = np.full(3000, 10.0)
        materials.leave_padding(counts, 100, {"padding_hu": materials.LOWEST_HU + 7, "padding_share": share})
        assert counts[7] == left and counts.sum() == 29_990 + left


# --- what is refused ---
def make_water_phantom() -> np.ndarray:
    tube = np.where(circle((1, 96, 96), 48, 48, 36), 0.0, -1000.0)
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
    "metal in water": (np.minimum(make_ball(8000.0, 40.0, 0.8, 20.0), 3071.0), "no bone found"),
    "raw air": (np.full((8, 32, 32), 24.0) + np.arange(32), "no two materials|0 edges of bone"),
}


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_what_has_no_two_materials_is_refused(name) -> None:
    field, words = REFUSED[name]
    with pytest.raises(NoSurfaceError, match=words) as caught:
        choose_iso_value(as_volume(field))
    assert "iso_value=N" in str(caught.value) and "\n" not in str(caught.value)
    assert not lies_in_air(as_volume(field))


def add_cut_air(field: np.ndarray, rows: int = 30, noise: float = 90.0) -> np.ndarray:
    """Add noisy air that the scale of the file cuts off: a spike at the lowest value."""
    air = -450.0 + noise * np.random.default_rng(2).standard_normal((len(field), rows, field.shape[2]))
    return np.maximum(np.concatenate([field, air], axis=1), -410.0)


RAW = {
    "noise beside cut air": (add_cut_air(make_ball(1040.0, 0.0, 0.8, 90.0)), 0.0, 1040.0),
    "beside three times as much air": (add_cut_air(make_ball(1040.0, 0.0, 0.8, 30.0), 140, 30.0), 0.0, 1040.0),
    "beside 23 times as much air": (add_cut_air(make_ball(1040.0, 0.0, 0.8, 30.0), 1000, 30.0), 0.0, 1040.0),
    "CT without its intercept": (make_ball(1040.0, 40.0) + 1024.0, 1064.0, 2064.0),
    "16 bits of micro-CT": (make_ball(30_000.0, 9000.0, 0.8, 400.0), 9000.0, 30_000.0),
    "8 bits": (make_ball(200.0, 30.0, 0.8, 3.0), 30.0, 200.0),
    "a share": (make_ball(0.9, 0.2, 0.8, 0.01), 0.2, 0.9),
    "a casting in air": (make_ball(1.6, 0.0, 0.8, 0.01), 0.0, 1.6),
}


@pytest.mark.parametrize("name", RAW)
def test_two_materials_are_found_on_any_scale(name) -> None:
    field, tissue, bone = RAW[name]
    volume = Volume(field.astype(np.float32), np.diag((0.5, 0.5, 0.5, 1.0)))
    volume.report["gates"] = [{"name": "hu_known", "ok": False}]
    chosen = choose_iso_value(volume)
    step = bone - tissue
    assert abs(chosen.iso_value - (bone + tissue) / 2.0) <= tolerances.HALF_WAY_STEP_SHARE * step
    assert chosen.bone_hu == pytest.approx(bone, abs=0.06 * step)
    assert "on the scan's own scale, with two materials near" in chosen.reason
    place = np.linalg.norm(np.array(chosen.seen_at_lps_mm) - np.array((22.1, 21.4, 21.7)) / 2.0)
    assert place == pytest.approx(5.0, abs=1.2)
    assert f"{chosen.seen_at_lps_mm[0]:.4g}" in chosen.reason


def test_values_that_are_known_to_be_hu_keep_their_scale() -> None:
    volume = as_volume(make_ball(2040.0, 1040.0))
    volume.report["gates"] = [{"name": "hu_known", "ok": True}]
    with refused(NoSurfaceError, "materials"):
        choose_iso_value(volume)


def test_slices_with_metal_are_left_out() -> None:
    """Streaks of 300 HU in the slices of a rod of metal; without it all slices count."""
    plain = np.tile(make_ball(1040.0, 40.0)[None, 22], (40, 1, 1))
    field = plain.copy()
    field[:20, 2:6, 2:40] = 340.0
    field[:20, ::6] += 300.0
    field[:20, 40:43, 30:40] = 3071.0
    found, expected = choose_iso_value(as_volume(field)), choose_iso_value(as_volume(plain))
    assert (found.iso_value, found.slices, expected.slices) == (expected.iso_value, 17, 40)
    assert "23 slices with metal left out" in found.reason and "metal" not in expected.reason
    field[:38, 40:43, 30:40] = 3071.0  # too few without
    assert choose_iso_value(as_volume(field)).slices == 40


def test_nan_is_refused() -> None:
    field = make_ball(1040.0, 40.0).astype(np.float32)
    field[5, 5, 5] = np.nan
    with refused(NoSurfaceError, "NaN", 5):
        choose_iso_value(Volume(field, np.eye(4)))


def test_infinities_count_as_metal_and_padding() -> None:
    field = make_ball(1040.0, 40.0).astype(np.float32)
    expected = choose_iso_value(Volume(field, np.eye(4))).iso_value
    field[5, 5, 5:7], field[6, 6, 6:8] = np.inf, -np.inf
    assert choose_iso_value(Volume(field, np.eye(4))).iso_value == expected


# --- given materials ---
@pytest.mark.parametrize(("bone", "tissue", "level"), [(1200, 40, 620.0), (0.5, -1000.5, -500.0), (101, 100, 100.5)])
def test_iso_value_of_given_materials_lies_half_way(bone, tissue, level) -> None:
    chosen = half_iso_value(bone, tissue)
    assert (chosen.iso_value, chosen.bone_hu, chosen.tissue_hu, chosen.method) == (level, bone, tissue, "half")
    assert chosen.reason == f"half way between tissue {tissue:g} and bone {bone:g} HU, as given"


@pytest.mark.parametrize(
    ("bone", "tissue", "words"),
    [(40, 1200, (40, 1200, "HU")), (40, 40, ("above",)), (math.nan, 1, ("finite",)), (1, -math.inf, ("finite",))],
)
def test_impossible_materials_are_refused(bone, tissue, words) -> None:
    with refused(UsageError, *words):
        half_iso_value(bone, tissue)


def test_iso_choice_cannot_be_changed_and_its_dict_has_all_fields() -> None:
    chosen, name = clrecon.choose_iso_value(as_volume(make_ball(1040.0, 40.0))), "iso_value"
    with pytest.raises(dataclasses.FrozenInstanceError, match=name):
        setattr(chosen, name, 1.0)
    assert chosen.as_dict() == {field.name: getattr(chosen, field.name) for field in dataclasses.fields(chosen)}
    assert set(chosen.as_dict()) - set(chosen.measurements()) == {"iso_value", "reason"}


# --- real CT ---
@pytest.mark.parametrize("folder", ["lumbar_4p25mm", "thoracic_0p8mm", "thoracolumbar_labels/ct_2mm_jpeg2000"])
def test_real_ct_gives_levels_between_tissue_and_dense_bone(real_data, folder) -> None:
    chosen = choose_iso_value(clrecon.read_volume(real_data / folder))
    assert 150.0 < chosen.iso_value < 450.0
    assert -60.0 < chosen.tissue_hu < 60.0 and chosen.edges > 5000
