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


def coarse(kind: str, **given: object) -> PhantomSettings:
    """The same field of view with steps three times as long."""
    made = KINDS[kind]
    size = (made.size[0] // 3, made.size[1] // 3)
    spacing = tuple(3.0 * step for step in made.spacing)
    return PhantomSettings(kind=kind, size=size, slices=made.slices // 3, spacing=spacing, **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", SCANS)
def test_sizes_are_those_of_the_kind_and_bone_lies_where_its_parts_do(kind: str) -> None:
    default = PhantomSettings(kind=kind)
    assert (default.size, default.slices) == (KINDS[kind].size, KINDS[kind].slices)
    assert 1e6 < np.prod(default.shape_kji) < 5e6
    settings = coarse(kind)
    labels = label_materials(settings)
    kji = np.argwhere(labels >= 0)
    points = apply_affine(place_slices(settings).affine, kji[:, ::-1].astype(np.float64))
    depth = bone_depth(plan_scene(settings), points, "bone")
    ijk_mm = max(settings.spacing)
    sure = np.abs(depth) > 1e-3 * ijk_mm  # parts round places in frames of their own
    assert np.array_equal((depth >= 0.0)[sure], (labels.ravel() == BONE)[sure])


@pytest.mark.parametrize("kind", SCANS)
def test_values_are_those_of_the_scanner(kind: str) -> None:
    settings = coarse(kind, **CLEAN)
    voxels, affine, truth = make_phantom(settings)
    scanner, labels = KINDS[kind].scanner, label_materials(settings)
    bone, tissue = KINDS[kind].bone_and_tissue_hu
    half = scanner.to_values((bone + tissue) / 2.0)
    assert (truth["unit"], truth["half_maximum_hu"], truth["iso_value_hu"]) == (scanner.unit, half, half)
    inside = ~outside_disc(voxels.shape[1:], affine) if scanner.padding is not None else np.ones(voxels.shape[1:], bool)
    assert np.median(voxels[:, inside][labels[:, inside] == 0]) == pytest.approx(
        max(scanner.to_values(-1000.0), scanner.to_values(-1024.0)), abs=60.0 if scanner.cupping_hu else 20.0
    )
    if scanner.padding is not None:
        assert (voxels[:, ~inside] == scanner.padding).all() and 0.2 < (~inside).mean() < 0.26
    part = truth["parts"]["bone"]
    assert part["volume_mm3"] == pytest.approx(part["voxels"] * np.prod(settings.spacing), rel=1e-4)


def test_cupping_is_deepest_at_the_centre_and_falls_with_the_square_of_the_radius() -> None:
    field = np.zeros((2, 41, 61), np.float32)
    add_cupping(field, np.diag((0.5, 0.5, 1.0, 1.0)), 100.0)
    assert field[1, 20, 30] == -100.0 and field[0, 0, 30] == pytest.approx(-100.0 * (1 - (20 / 20.5) ** 2), abs=1e-3)
    assert field[0, 20, 30 + 10] == pytest.approx(-100.0 * (1 - (10 / 20.5) ** 2), abs=1e-3)
    assert (field[:, :, :9] == 0.0).all()


def test_streaks_stay_in_slices_with_metal_and_a_dark_band_joins_two_pieces() -> None:
    metal = np.zeros((3, 64, 64), bool)
    metal[1, 29:35, 12:18] = metal[1, 29:35, 46:52] = True
    fields = [np.zeros(metal.shape, np.float32) for _ in range(2)]
    for field in fields:
        add_streaks(field, metal, 8000.0, np.eye(4), 1.0, seed=4)
    assert np.array_equal(*fields) and not fields[0][[0, 2]].any()
    between, across = fields[0][1, 29:35, 26:38].mean(), fields[0][1, 10:16, 26:38].mean()
    assert between < -20.0 < across
    assert np.abs(fields[0][1, ~metal[1]]).max() < 3000.0


def test_headers_name_unit_and_voltage(tmp_path: Path) -> None:
    settings = PhantomSettings(kind="longbone", size=(40, 40), slices=4, spacing=(0.1, 0.1, 0.1))
    write_phantom(tmp_path / "ct", settings)
    header = pydicom.dcmread(tmp_path / "ct" / "IM0001.dcm")
    assert (header.RescaleType, header.KVP, header.PixelSpacing) == ("MGML", 55, [0.1, 0.1])
