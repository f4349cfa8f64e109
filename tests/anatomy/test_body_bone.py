"""Bone stays when the table goes: specimens, limbs, metal, prone, two bodies; and the gate where it does not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from odd_bodies import BODIES, OddBodies, OddBody
from refusals import refused
from variants import daily

from clrecon.anatomy.body import mask_field_of_view, remove_table
from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume
from clrecon.proof.phantom import MATERIALS, PhantomSettings, label_materials, make_phantom

SPECIMENS = {"skull", "skull-prone", "bones"}
TISSUE_HU, DENSE_HU = -300, 300  # air and foam lie below the one, bone and tables above the other


def gate_of(volume: Volume, name: str) -> dict[str, Any]:
    return next(gate for gate in volume.report["gates"] if gate["name"] == name)


def share_kept(before: Volume, after: Volume, mask: np.ndarray) -> float:
    """The share of the voxels of a mask whose HU stayed."""
    return float((before.voxels == after.voxels)[mask].mean())


BONES = [name for name in BODIES if name not in ("empty", "water")]

RIMS_IN_THE_TABLE = 0.1
"""Share of dry bone above 0 HU that blurs into the table on which it lies; measured up to 0.074."""

SURFACE_OF_THE_TABLE = 0.35
"""Share of the table that touches the body or its margin and stays; measured up to 0.19, here and in foam 0.3."""


@pytest.fixture(scope="module", params=daily(2, BONES))
def cleaned_body(odd: OddBodies, request: pytest.FixtureRequest) -> tuple[str, OddBody, Volume]:
    """The name of a body with bone, the body on its table, and what `remove_table` made of it."""
    return request.param, odd[request.param], remove_table(odd[request.param].volume)


def test_bone_stays_where_a_table_is_removed(cleaned_body: tuple[str, OddBody, Volume]) -> None:
    _, body, cleaned = cleaned_body
    assert share_kept(body.volume, cleaned, body.dense) == 1.0
    less_dense = body.of("bone", "metal", "contrast") & (body.volume.voxels > 0)
    assert share_kept(body.volume, cleaned, less_dense) > 1.0 - RIMS_IN_THE_TABLE


def test_the_table_is_removed_but_for_what_touches_the_body(cleaned_body: tuple[str, OddBody, Volume]) -> None:
    _, body, cleaned = cleaned_body
    table = body.of("table") & (body.volume.voxels > TISSUE_HU)
    assert share_kept(body.volume, cleaned, table) < SURFACE_OF_THE_TABLE


def test_bodies_without_soft_tissue_are_reported_as_specimens(cleaned_body: tuple[str, OddBody, Volume]) -> None:
    name, _, cleaned = cleaned_body
    assert cleaned.report["remove_table"]["specimen"] == (name in SPECIMENS)


def test_report_of_a_removed_table_counts_all_bone_and_says_that_it_stays(
    cleaned_body: tuple[str, OddBody, Volume],
) -> None:
    _, body, cleaned = cleaned_body
    facts = cleaned.report["remove_table"]
    assert facts["bone_kept"] == 1.0
    # Voxels of the table above 300 HU that touch bone count with it: measured up to 79 of 3,004.
    assert facts["bone_voxels"] >= np.count_nonzero(body.dense)


def test_the_gate_on_kept_bone_has_the_share_of_the_report_and_its_bound(
    cleaned_body: tuple[str, OddBody, Volume],
) -> None:
    _, _, cleaned = cleaned_body
    gate = gate_of(cleaned, "bone_kept")
    assert (gate["ok"], gate["bound"]) == (True, 0.98)
    assert gate["measured"] == pytest.approx(cleaned.report["remove_table"]["bone_kept"], abs=1e-6)  # six digits


def test_a_trough_of_foam_that_fits_closely_is_removed_and_not_taken_for_a_lung() -> None:
    """The back presses on the trough: a quarter of the wall of its foam of -930 HU is thick, as of a lung."""
    settings = PhantomSettings(kind="pelvis", size=(184, 177), slices=40, spacing=(2.1, 2.1, 2.1), table="curved")
    voxels, affine, _ = make_phantom(settings)
    volume, table = Volume(voxels, affine), label_materials(settings) == MATERIALS.index("table")
    cleaned = remove_table(volume)
    assert share_kept(volume, cleaned, table & (voxels > TISSUE_HU)) < SURFACE_OF_THE_TABLE
    assert share_kept(volume, cleaned, (voxels > DENSE_HU) & ~table) == 1.0


def test_a_block_of_micro_ct_with_large_cells_stays_whole() -> None:
    """Cells of 64 voxels a side: counts of 16 bits would wrap to 0, and half of the block would become air."""
    voxels = np.full((192, 192, 192), -1000, np.int16)
    voxels[:, :, 64:] = 1200
    cleaned = remove_table(Volume(voxels, np.diag((1 / 32, 1 / 32, 1 / 32, 1.0))))
    facts = cleaned.report["remove_table"]
    assert np.array_equal(cleaned.voxels > DENSE_HU, voxels > DENSE_HU)
    assert (facts["bone_voxels"], facts["bone_voxels_removed"], facts["bone_kept"]) == (128 * 192 * 192, 0, 1.0)


@pytest.mark.parametrize(
    ("rails", "words"),
    [(True, r"[\d,]+ voxels above 300 HU, all of tables"), (False, "no voxel")],
    ids=["rails", "none"],
)
def test_a_scan_of_a_table_alone_is_refused_as_it_has_no_bone(odd: OddBodies, rails: bool, words: str) -> None:
    voxels = np.array(odd["empty"].volume.voxels)
    if not rails:
        voxels[voxels > 700] = -1000  # HU: of the table, its rails alone are as dense
    with pytest.raises(RefusedInputError, match=rf"no body found.*there is no bone \({words}"):
        remove_table(Volume(voxels, odd["empty"].volume.affine))


def test_water_stays_and_its_gate_on_bone_is_not_judged(odd: OddBodies) -> None:
    body = odd["water"]
    cleaned = remove_table(body.volume)
    assert share_kept(body.volume, cleaned, body.of("water")) == 1.0
    assert cleaned.report["remove_table"]["bone_kept"] is None
    assert gate_of(cleaned, "bone_kept")["ok"] is None


def make_bone_less_dense(voxels: np.ndarray, dense: np.ndarray, table: np.ndarray) -> None:
    voxels[dense] = np.minimum(0.45 * voxels[dense], 690)


def add_noise(voxels: np.ndarray, dense: np.ndarray, table: np.ndarray) -> None:
    voxels += np.rint(np.random.default_rng(5).normal(0, 110, voxels.shape)).astype(np.int16)


def make_table_of_aluminium(voxels: np.ndarray, dense: np.ndarray, table: np.ndarray) -> None:
    voxels[table & (voxels.mean(axis=0) > -100)] = 1700


@pytest.mark.parametrize("change", [make_bone_less_dense, add_noise, make_table_of_aluminium])
def test_a_dry_skull_stays_and_its_table_goes_with_soft_bone_noise_or_aluminium(
    odd: OddBodies, change: Callable[..., None]
) -> None:
    body = odd["skull-prone"]
    voxels, table = np.array(body.volume.voxels), body.of("table")
    change(voxels, body.dense, table)
    volume = Volume(voxels, body.volume.affine)
    cleaned = remove_table(volume)
    assert share_kept(volume, cleaned, (voxels > DENSE_HU) & body.dense) == 1.0
    plates = table & (voxels > -100)  # HU; between them is foam of -930 HU
    assert share_kept(volume, cleaned, plates) < SURFACE_OF_THE_TABLE


def test_a_slab_of_a_skull_of_30_mm_is_kept_although_it_is_straight_from_end_to_end(odd: OddBodies) -> None:
    body, slab = odd["skull-prone"], slice(24, 32)  # slices of some 3.5 mm
    volume = Volume(np.array(body.volume.voxels[slab]), body.volume.affine)
    cleaned = remove_table(volume)
    assert share_kept(volume, cleaned, (volume.voxels > DENSE_HU) & body.dense[slab]) == 1.0


def dry_shafts() -> tuple[Volume, np.ndarray]:
    """Three dry shafts along z through all slices, on a flat table with rails; HU and the mask of the shafts."""
    y, x = np.mgrid[:84, :84] * 2.0 - 83.0
    hu, bone = np.full((40, 84, 84), -1000.0), np.zeros((40, 84, 84), dtype=bool)
    for number, layer in enumerate(hu):
        layer[((y > 34) & (y < 37)) | ((y > 56) & (y < 59))] = 250
        layer[(abs(abs(x) - 70) < 4) & (abs(y - 66) < 4)] = 1800
        for middle, radius, wall in ((-30.0, 14.0, 5.0), (6.0, 8.0, 3.0), (40.0, 11.0, 3.0)):
            from_axis = np.hypot(x - middle - 3 * np.sin(number / 15), y - 34 + radius)
            cavity = radius - wall - 1.5 * np.sin(number / 6)
            layer[from_axis < radius] = 1400
            layer[from_axis < cavity] = -700
            bone[number] |= from_axis < radius
    hu += np.random.default_rng(3).normal(0, 12, hu.shape)
    affine = np.diag((2.0, 2.0, 3.0, 1.0))
    return Volume(np.rint(hu).astype(np.int16), affine), bone & (hu > DENSE_HU)


def test_straight_dry_shafts_that_touch_a_table_stay_and_are_counted_as_bone() -> None:
    volume, bone = dry_shafts()
    cleaned = remove_table(volume)
    assert share_kept(volume, cleaned, bone) == 1.0
    counted = cleaned.report["remove_table"]["bone_voxels"]
    assert counted == pytest.approx(np.count_nonzero(bone), rel=0.05)  # measured 0.976


def test_rails_of_a_table_under_dry_shafts_are_removed() -> None:
    volume, _ = dry_shafts()
    rows_of_rails = np.s_[:, 73:77]  # y of 63 to 69 mm
    assert (volume.voxels[rows_of_rails] > DENSE_HU).any()  # HU: dense as bone
    assert not (remove_table(volume).voxels[rows_of_rails] > DENSE_HU).any()


def beside(odd: OddBodies, *names: str) -> tuple[Volume, np.ndarray]:
    """Two bodies in one scan, side by side."""
    bodies = [odd[name] for name in names]
    voxels = np.concatenate([body.volume.voxels for body in bodies], axis=2)
    return Volume(voxels, bodies[0].volume.affine), np.concatenate([body.dense for body in bodies], axis=2)


@pytest.mark.release
def test_a_dry_skull_beside_a_patient_stays_as_a_second_body_and_its_share_is_reported(odd: OddBodies) -> None:
    volume, dense = beside(odd, "skull", "limb")
    cleaned = remove_table(volume)
    facts = cleaned.report["remove_table"]
    kept = share_kept(volume, cleaned, dense)
    assert kept > 0.98  # the bound of the gate; loose teeth go
    assert facts["bone_kept"] == pytest.approx(kept, abs=0.01)  # bone is counted to a cell of some 2 mm
    assert not facts["specimen"]


@pytest.fixture(scope="module")
def dry_bones_beside_a_leg(odd: OddBodies) -> tuple[Volume, np.ndarray]:
    """Some of them too small for a body: nothing tells them from equipment."""
    return beside(odd, "bones", "limb")


def test_removing_a_table_with_more_than_2_percent_of_the_bone_is_refused(
    dry_bones_beside_a_leg: tuple[Volume, np.ndarray],
) -> None:
    volume, _ = dry_bones_beside_a_leg
    with refused(RefusedInputError, "bone_kept", "voxels"):
        remove_table(volume)


def test_allowed_loss_of_bone_fails_its_gate_with_the_share_that_stayed(
    dry_bones_beside_a_leg: tuple[Volume, np.ndarray],
) -> None:
    volume, dense = dry_bones_beside_a_leg
    cleaned = remove_table(volume, allow_bone_loss=True)
    gate, facts = gate_of(cleaned, "bone_kept"), cleaned.report["remove_table"]
    assert gate["ok"] is False
    assert gate["measured"] == pytest.approx(share_kept(volume, cleaned, dense), abs=0.05)  # of cells of some 2 mm
    assert facts["bone_voxels_removed"] == round(facts["bone_voxels"] * (1.0 - gate["measured"]))


@pytest.fixture
def pelvis_with_a_range(odd: OddBodies) -> Volume:
    """A report with the range of all values and a share of padding."""
    body = odd["pelvis"].volume
    hu_range = [float(body.voxels.min()), float(body.voxels.max())]
    return Volume(body.voxels, body.affine, {"warnings": [], "hu_range": hu_range, "padding_share": 0.1})


def test_report_of_a_circle_has_the_range_of_the_voxels_that_are_left(pelvis_with_a_range: Volume) -> None:
    cut = mask_field_of_view(pelvis_with_a_range, radius_mm=60.0)
    assert cut.report["hu_range"] == [cut.voxels.min(), cut.voxels.max()]
    assert cut.report["hu_range"] != pelvis_with_a_range.report["hu_range"]


def test_report_of_a_removed_table_has_the_range_of_the_voxels_that_are_left(pelvis_with_a_range: Volume) -> None:
    cleaned = remove_table(pelvis_with_a_range)
    assert cleaned.report["hu_range"] == [cleaned.voxels.min(), cleaned.voxels.max()]


def test_a_circle_leaves_other_entries_and_the_report_of_the_given_volume(pelvis_with_a_range: Volume) -> None:
    before = dict(pelvis_with_a_range.report)
    assert mask_field_of_view(pelvis_with_a_range, radius_mm=60.0).report["padding_share"] == 0.1
    assert pelvis_with_a_range.report == before


@pytest.mark.parametrize("name", ["pair", "limb", "head"])
def test_a_chosen_circle_reports_the_bone_that_it_cuts_and_has_no_gate(odd: OddBodies, name: str) -> None:
    body = odd[name]
    masked = mask_field_of_view(body.volume, radius_mm=45.0)
    facts = masked.report["field_of_view"]
    cut = np.count_nonzero(body.dense & (masked.voxels != body.volume.voxels))
    assert cut > 1500  # enough voxels to judge shares: measured 3,701 and more
    # Pieces of the table are not counted as bone, and bone is counted to a cell of some 2 mm.
    assert facts["bone_voxels_removed"] == pytest.approx(cut, rel=0.05)
    assert facts["bone_kept"] == pytest.approx(1.0 - cut / np.count_nonzero(body.dense), abs=0.02)
    assert "gates" not in masked.report


def test_the_circle_of_the_scan_passes_its_gate_where_it_cuts_no_bone(odd: OddBodies) -> None:
    masked = mask_field_of_view(odd["head"].volume)
    assert gate_of(masked, "bone_in_circle")["ok"] is True
    assert masked.report["field_of_view"]["bone_voxels_removed"] == 0


def test_the_circle_of_the_scan_fails_its_gate_where_it_cuts_more_than_2_percent_of_the_bone(odd: OddBodies) -> None:
    limb = odd["limb"].volume
    in_a_corner = Volume(np.roll(limb.voxels, (-45, 25), axis=(1, 2)), limb.affine)
    masked = mask_field_of_view(in_a_corner)
    assert gate_of(masked, "bone_in_circle")["ok"] is False
    assert masked.report["field_of_view"]["bone_kept"] < 0.98  # measured 0: all of the limb lies in the corner
