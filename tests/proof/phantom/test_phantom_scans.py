"""Scans of kinds of their own: values, artefacts and headers of their scanners, and bone where the truth has it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest

from clrecon.geometry import apply_affine
from clrecon.proof.phantom import KINDS, MATERIALS, PhantomSettings, label_materials, make_phantom, write_phantom
from clrecon.proof.phantom.sampling import add_cupping, add_streaks, outside_disc
from clrecon.proof.phantom.scene_plans import plan_scene
from clrecon.proof.phantom.scenes import bone_depth
from clrecon.proof.phantom.series import place_slices

SCANS = ("jaw", "longbone", "hand", "hip", "mouse")
CLEAN = {"noise": 0.0, "point_spread_mm": 0.0}
BONE = MATERIALS.index("bone")


def coarse_settings(kind: str, **given: object) -> PhantomSettings:
    """The same field of view with steps three times as long."""
    made = KINDS[kind]
    size = (made.size[0] // 3, made.size[1] // 3)
    spacing = tuple(3.0 * step for step in made.spacing)
    return PhantomSettings(kind=kind, size=size, slices=made.slices // 3, spacing=spacing, **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", SCANS)
def test_scan_has_the_size_of_its_kind_of_one_to_five_million_voxels(kind: str) -> None:
    settings = PhantomSettings(kind=kind)
    assert (settings.size, settings.slices) == (KINDS[kind].size, KINDS[kind].slices)
    assert 1e6 < np.prod(settings.shape_kji) < 5e6


@pytest.mark.parametrize("kind", SCANS)
def test_voxels_labelled_bone_are_those_whose_places_lie_in_the_parts_of_bone(kind: str) -> None:
    settings = coarse_settings(kind)

    labels = label_materials(settings)

    kji = np.argwhere(np.ones(labels.shape, bool))  # all voxels
    places = apply_affine(place_slices(settings).affine, kji[:, ::-1].astype(np.float64))
    depth_mm = bone_depth(plan_scene(settings), places, "bone")
    sure = np.abs(depth_mm) > 1e-3 * max(settings.spacing)  # parts round places in frames of their own
    assert np.array_equal((depth_mm >= 0.0)[sure], (labels.ravel() == BONE)[sure])


@pytest.fixture(scope="module", params=SCANS)
def clean_scan(request: pytest.FixtureRequest) -> tuple[str, np.ndarray, np.ndarray, dict]:
    """Kind, voxels, affine and truth of a coarse scan without noise and blur."""
    return request.param, *make_phantom(coarse_settings(request.param, **CLEAN))


def test_half_maximum_and_iso_value_of_a_scan_are_half_way_in_the_unit_of_its_scanner(
    clean_scan: tuple[str, np.ndarray, np.ndarray, dict],
) -> None:
    kind, _, _, truth = clean_scan
    bone, tissue = KINDS[kind].bone_and_tissue_hu
    half_way = KINDS[kind].scanner.to_values((bone + tissue) / 2.0)
    assert truth["unit"] == KINDS[kind].scanner.unit
    assert truth["half_maximum_hu"] == truth["iso_value_hu"] == half_way


def test_median_of_air_is_that_of_the_scanner(clean_scan: tuple[str, np.ndarray, np.ndarray, dict]) -> None:
    kind, voxels, affine, _ = clean_scan
    scanner = KINDS[kind].scanner
    air = label_materials(coarse_settings(kind, **CLEAN)) == MATERIALS.index("air")
    if scanner.padding is not None:
        air &= ~outside_disc(voxels.shape[1:], affine)

    lowest = scanner.to_values(-1024.0)  # of 12 bits
    tolerance = 60.0 if scanner.cupping_hu else 20.0  # HU; cupping darkens air within the disc too
    assert np.median(voxels[air]) == pytest.approx(max(scanner.to_values(-1000.0), lowest), abs=tolerance)


def test_scan_of_a_scanner_that_pads_has_its_padding_outside_of_the_disc_alone(
    clean_scan: tuple[str, np.ndarray, np.ndarray, dict],
) -> None:
    kind, voxels, affine, _ = clean_scan
    padding = KINDS[kind].scanner.padding
    outside = outside_disc(voxels.shape[1:], affine) & (padding is not None)
    assert (voxels[:, outside] == padding).all()
    corners = 1.0 - np.pi / 4.0 * 0.985**2  # of a square: the disc has 0.985 of its width, as sampling.py draws it
    assert outside.mean() == pytest.approx(0.0 if padding is None else corners, abs=0.005)  # pixels at the rim


def test_volume_of_bone_in_the_truth_is_its_number_of_voxels_times_their_size(
    clean_scan: tuple[str, np.ndarray, np.ndarray, dict],
) -> None:
    kind, _, _, truth = clean_scan
    bone = truth["parts"]["bone"]
    voxel_mm3 = np.prod(coarse_settings(kind).spacing)
    assert bone["volume_mm3"] == pytest.approx(bone["voxels"] * voxel_mm3, rel=1e-4)  # written with few digits


@pytest.mark.parametrize(("rows_up", "columns_right"), [(0, 0), (10, 0), (20, 0), (0, 10)])
def test_cupping_falls_with_the_square_of_the_distance_from_the_centre(rows_up: int, columns_right: int) -> None:
    field = np.zeros((2, 41, 61), np.float32)  # its centre: row 20, column 30

    add_cupping(field, np.diag((0.5, 0.5, 1.0, 1.0)), cupping_hu=100.0)

    share_of_radius = max(rows_up, columns_right) / 20.5  # half the shorter side
    found = field[:, 20 - rows_up, 30 + columns_right]
    assert found == pytest.approx(-100.0 * (1.0 - share_of_radius**2), abs=1e-3)  # HU in float32


def test_cupping_changes_nothing_outside_of_the_disc_of_the_field() -> None:
    field = np.zeros((2, 41, 61), np.float32)  # the disc reaches from column 9.5 to 50.5
    add_cupping(field, np.diag((0.5, 0.5, 1.0, 1.0)), cupping_hu=100.0)
    assert (field[:, :, :9] == 0.0).all()


METAL_HU = 8000.0


def mark_two_pieces_of_metal() -> np.ndarray:
    """Metal in the middle one of three slices: two squares of 6 pixels side by side."""
    metal = np.zeros((3, 64, 64), bool)
    metal[1, 29:35, 12:18] = metal[1, 29:35, 46:52] = True
    return metal


def draw_streaks(metal: np.ndarray) -> np.ndarray:
    """Streaks of the metal alone, HU."""
    field = np.zeros(metal.shape, np.float32)
    add_streaks(field, metal, METAL_HU, np.eye(4), strength=1.0, seed=4)
    return field


def test_streaks_stay_in_slices_with_metal() -> None:
    streaks = draw_streaks(mark_two_pieces_of_metal())
    assert not streaks[[0, 2]].any()
    assert streaks[1].any()


def test_streaks_of_one_seed_are_the_same() -> None:
    metal = mark_two_pieces_of_metal()
    assert np.array_equal(draw_streaks(metal), draw_streaks(metal))


def test_streaks_join_two_pieces_of_metal_by_a_dark_band() -> None:
    streaks = draw_streaks(mark_two_pieces_of_metal())[1]
    columns_between = slice(26, 38)
    in_line = streaks[29:35, columns_between].mean()  # the rows of both pieces
    above = streaks[10:16, columns_between].mean()
    dark_hu = -20.0  # measured: -27 HU in line, and 1 HU above
    assert in_line < dark_hu < above


def test_streaks_beside_metal_of_8000_hu_stay_below_3000_hu() -> None:
    metal = mark_two_pieces_of_metal()
    assert (
        np.abs(draw_streaks(metal)[1, ~metal[1]]).max() < 3000.0
    )  # voxels from there on count as metal; 90 was measured


def test_header_of_a_scan_of_a_long_bone_names_mg_per_ml_55_kv_and_its_pixels(tmp_path: Path) -> None:
    settings = PhantomSettings(kind="longbone", size=(40, 40), slices=4, spacing=(0.1, 0.1, 0.1))
    write_phantom(tmp_path / "ct", settings)
    header = pydicom.dcmread(tmp_path / "ct" / "IM0001.dcm")
    assert (header.RescaleType, header.KVP, header.PixelSpacing) == ("MGML", 55, [0.1, 0.1])
