"""Bone stays when the table goes: specimens, limbs, metal, prone, two bodies; and the gate where it does not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from odd_bodies import BODIES, OddBodies
from refusals import refused
from variants import daily

from clrecon.anatomy.body import mask_field_of_view, remove_table
from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume
from clrecon.proof.phantom import MATERIALS, PhantomSettings, label_materials, make_phantom

SPECIMENS = {"skull", "skull-prone", "bones"}


def gate_of(volume: Volume, name: str = "bone_kept") -> dict[str, Any]:
    return next(gate for gate in volume.report["gates"] if gate["name"] == name)


def share_kept(before: Volume, after: Volume, mask: np.ndarray) -> float:
    return float((before.voxels == after.voxels)[mask].mean())


@pytest.mark.parametrize("name", daily(2, [name for name in BODIES if name not in ("empty", "water")]))
def test_bone_stays_and_the_table_goes(odd: OddBodies, name: str) -> None:
    body = odd[name]
    cleaned = remove_table(body.volume)
    facts = cleaned.report["remove_table"]
    assert share_kept(body.volume, cleaned, body.dense) > 0.999
    less_dense = body.of("bone", "metal", "contrast") & (body.volume.voxels > 0)
    assert share_kept(body.volume, cleaned, less_dense) > 0.9  # rims of dry bone that lie in the table
    assert share_kept(body.volume, cleaned, body.of("table") & (body.volume.voxels > -300)) < 0.35
    assert facts["specimen"] == (name in SPECIMENS)
    assert facts["bone_kept"] > 0.999
    assert facts["bone_voxels"] >= 0.97 * np.count_nonzero(body.dense)
    gate = gate_of(cleaned)
    assert gate["ok"] and gate["bound"] == 0.98 and gate["measured"] == pytest.approx(facts["bone_kept"], abs=1e-6)


def test_foam_of_a_trough_that_fits_closely_is_no_lung() -> None:
    """The back presses on the trough: a quarter of the wall of its foam of -930 HU is thick, as of a lung."""
    settings = PhantomSettings("pelvis", (184, 177), slices=40, spacing=(2.1, 2.1, 2.1), table="curved")
    voxels, affine, _ = make_phantom(settings)
    volume, labels = Volume(voxels, affine), label_materials(settings)
    cleaned = remove_table(volume)
    table = labels == MATERIALS.index("table")
    assert share_kept(volume, cleaned, (voxels > 300) & ~table) == 1.0
    assert share_kept(volume, cleaned, table & (voxels > -300)) < 0.35  # all of it stayed
    assert cleaned.report["remove_table"]["bone_kept"] == 1.0


def test_a_block_of_micro_ct_is_kept_whole() -> None:
    """Cells of 64 voxels a side: their counts of dense voxels wrapped to 0, and half of the block became air."""
    voxels = np.full((192, 192, 192), -1000, np.int16)
    voxels[:, :, 64:] = 1200
    cleaned = remove_table(Volume(voxels, np.diag((1 / 32, 1 / 32, 1 / 32, 1.0))))
    facts = cleaned.report["remove_table"]
    assert np.array_equal(cleaned.voxels > 300, voxels > 300)
    assert (facts["bone_voxels"], facts["bone_voxels_removed"], facts["bone_kept"]) == (128 * 192 * 192, 0, 1.0)


def test_a_table_alone_is_no_body(odd: OddBodies) -> None:
    for name in ("empty", "empty-curved"):
        voxels = np.array(odd["empty"].volume.voxels)
        if name == "empty-curved":
            voxels[voxels > 700] = -1000  # without its rails
        with pytest.raises(
            RefusedInputError,
            match=r"no body found.*there is no bone \(([\d,]+ voxels above 300 HU, all of tables|no voxel)",
        ):
            remove_table(Volume(voxels, odd["empty"].volume.affine))


def test_water_has_no_bone_to_keep(odd: OddBodies) -> None:
    body = odd["water"]
    cleaned = remove_table(body.volume)
    facts = cleaned.report["remove_table"]
    assert share_kept(body.volume, cleaned, body.of("water")) > 0.99
    assert facts["bone_kept"] is None and not facts["specimen"]
    assert gate_of(cleaned)["ok"] is None


def soften(voxels: np.ndarray, dense: np.ndarray, table: np.ndarray) -> None:
    voxels[dense] = np.minimum(0.45 * voxels[dense], 690)


def add_noise(voxels: np.ndarray, dense: np.ndarray, table: np.ndarray) -> None:
    voxels += np.rint(np.random.default_rng(5).normal(0, 110, voxels.shape)).astype(np.int16)


def set_aluminium(voxels: np.ndarray, dense: np.ndarray, table: np.ndarray) -> None:
    voxels[table & (voxels.mean(axis=0) > -100)] = 1700


@pytest.mark.parametrize("change", [soften, add_noise, set_aluminium])
def test_a_skull_of_another_kind_is_kept_and_its_table_removed(odd: OddBodies, change: Callable[..., None]) -> None:
    body = odd["skull-prone"]
    voxels, table = np.array(body.volume.voxels), body.of("table")
    change(voxels, body.dense, table)
    volume = Volume(voxels, body.volume.affine)
    cleaned = remove_table(volume)
    assert share_kept(volume, cleaned, (voxels > 300) & body.dense) > 0.999
    assert share_kept(volume, cleaned, table & (voxels > -100)) < 0.3


def test_a_slab_of_a_skull_is_kept_although_it_is_straight(odd: OddBodies) -> None:
    body, slab = odd["skull-prone"], slice(24, 32)  # 30 mm
    volume = Volume(np.array(body.volume.voxels[slab]), body.volume.affine)
    cleaned = remove_table(volume)
    assert share_kept(volume, cleaned, (volume.voxels > 300) & body.dense[slab]) > 0.999


def dry_shafts() -> tuple[Volume, np.ndarray]:
    """Three dry shafts along z through all slices, on a flat table with rails; HU and the mask of the shafts."""
    y, x = np.mgrid[:84, :84] * 2.0 - 83.0
    hu, bone = np.full((40, 84, 84), -1000.0), np.zeros((40, 84, 84), dtype=bool)
    for number, layer in enumerate(hu):
        layer[((y > 34) & (y < 37)) | ((y > 56) & (y < 59))] = 250
        layer[(abs(abs(x) - 70) < 4) & (abs(y - 66) < 4)] = 1800
        for middle, radius, wall in ((-30.0, 14.0, 5.0), (6.0, 8.0, 3.0), (40.0, 11.0, 3.0)):
            way = np.hypot(x - middle - 3 * np.sin(number / 15), y - 34 + radius)
            cavity = radius - wall - 1.5 * np.sin(number / 6)
            layer[way < radius], layer[way < cavity] = 1400, -700
            bone[number] |= way < radius
    hu += np.random.default_rng(3).normal(0, 12, hu.shape)
    affine = np.diag((2.0, 2.0, 3.0, 1.0))
    return Volume(np.rint(hu).astype(np.int16), affine), bone & (hu > 300)


def test_straight_shafts_that_touch_a_table_are_no_rails() -> None:
    volume, bone = dry_shafts()
    cleaned = remove_table(volume)
    assert share_kept(volume, cleaned, bone) > 0.999
    assert cleaned.report["remove_table"]["bone_voxels"] == pytest.approx(np.count_nonzero(bone), rel=0.05)
    assert not (cleaned.voxels[:, 76:] > 300).any()  # the rails


def beside(odd: OddBodies, *names: str) -> tuple[Volume, np.ndarray]:
    """Two bodies in one scan, side by side."""
    bodies = [odd[name] for name in names]
    voxels = np.concatenate([body.volume.voxels for body in bodies], axis=2)
    return Volume(voxels, bodies[0].volume.affine), np.concatenate([body.dense for body in bodies], axis=2)


@pytest.mark.release
def test_a_dry_skull_beside_a_patient_is_a_second_body(odd: OddBodies) -> None:
    volume, dense = beside(odd, "skull", "limb")
    cleaned = remove_table(volume)
    facts = cleaned.report["remove_table"]
    assert not facts["specimen"]
    assert share_kept(volume, cleaned, dense) > 0.98  # loose teeth go
    assert share_kept(volume, cleaned, dense) == pytest.approx(facts["bone_kept"], abs=0.01)


def test_what_would_go_with_the_table_is_refused_with_its_figures(odd: OddBodies) -> None:
    """Dry bones beside a leg, some of them too small for a body: nothing tells them from equipment."""
    volume, dense = beside(odd, "bones", "limb")
    with refused(RefusedInputError, "bone_kept", "voxels"):
        remove_table(volume)
    cleaned = remove_table(volume, allow_bone_loss=True)
    gate, facts = gate_of(cleaned), cleaned.report["remove_table"]
    assert gate["ok"] is False and gate["measured"] < 0.98
    assert facts["bone_voxels_removed"] == round(facts["bone_voxels"] * (1.0 - gate["measured"]))
    assert share_kept(volume, cleaned, dense) == pytest.approx(gate["measured"], abs=0.05)


def test_the_range_of_values_is_that_of_the_voxels_that_are_left(odd: OddBodies) -> None:
    body = odd["pelvis"]
    given = [float(body.volume.voxels.min()), float(body.volume.voxels.max())]
    volume = Volume(body.volume.voxels, body.volume.affine, {"warnings": [], "hu_range": given, "padding_share": 0.1})
    cut = mask_field_of_view(volume, 60.0)
    assert cut.report["hu_range"] == [cut.voxels.min(), cut.voxels.max()] != given
    assert remove_table(volume).report["hu_range"][1] == 3071
    assert (volume.report["hu_range"], cut.report["padding_share"]) == (given, 0.1)


@pytest.mark.parametrize("name", ["pair", "limb", "head"])
def test_a_circle_says_what_bone_it_cuts(odd: OddBodies, name: str) -> None:
    body = odd[name]
    masked = mask_field_of_view(body.volume, 45.0)
    facts = masked.report["field_of_view"]
    lost = np.count_nonzero(body.dense & (masked.voxels != body.volume.voxels))
    assert lost > 100  # the circle cuts bone
    # pieces of the table are not hard; what is cut is counted to a cell
    assert facts["bone_voxels_removed"] == pytest.approx(lost, rel=0.05)
    assert facts["bone_kept"] == pytest.approx(1.0 - lost / np.count_nonzero(body.dense), abs=0.02)
    assert "gates" not in masked.report  # the circle was chosen


def test_a_circle_that_was_not_chosen_has_a_gate(odd: OddBodies) -> None:
    whole = mask_field_of_view(odd["head"].volume)
    assert gate_of(whole, "bone_in_circle")["ok"] and whole.report["field_of_view"]["bone_voxels_removed"] == 0
    limb = odd["limb"].volume
    moved = mask_field_of_view(Volume(np.roll(limb.voxels, (-45, 25), axis=(1, 2)), limb.affine))
    assert gate_of(moved, "bone_in_circle")["ok"] is False
    assert moved.report["field_of_view"]["bone_kept"] < 0.98
