"""Scenes: each body shows its materials where the truth says, lies on its table, and can be written and read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
from refusals import refused
from variants import daily, daily_rows

from clrecon.errors import UsageError
from clrecon.geometry import apply_affine
from clrecon.labels import read_labels
from clrecon.proof.phantom import KINDS, MATERIALS, PhantomSettings, label_materials, make_phantom, write_phantom
from clrecon.proof.phantom.scene_plans import PLANS
from clrecon.proof.phantom.scenes import TABLES
from clrecon.proof.phantom.settings import TABLE_NAMES

SCENES = {name: kind for name, kind in KINDS.items() if kind.is_scene}
CLEAN = {"noise": 0.0, "point_spread_mm": 0.0}


def settings_of(kind: str, **given: object) -> PhantomSettings:
    """A coarse phantom: steps of three times those of the kind, of two lengths in the slice."""
    di, dj, dk = (3.0 * step for step in KINDS[kind].spacing)
    size = {"size": (86, 80), "slices": 34, "spacing": (1.07 * dj, di, dk)}
    return PhantomSettings(kind=kind, **{**size, **given})  # type: ignore[arg-type]


def test_plans_and_couches_are_those_of_the_settings() -> None:
    assert set(PLANS) == set(SCENES)
    assert tuple(TABLES) == TABLE_NAMES


@pytest.mark.parametrize("kind", daily(3, SCENES))
def test_parts_of_the_truth_count_the_voxels_of_their_labels(kind: str) -> None:
    settings = settings_of(kind, **CLEAN)
    voxels, affine, truth = make_phantom(settings)
    labels = label_materials(settings)
    assert labels.shape == voxels.shape
    voxel_ml = abs(np.linalg.det(affine[:3, :3])) / 1000.0
    assert set(truth["parts"]) == {MATERIALS[label] for label in np.unique(labels)}
    for part in truth["parts"].values():
        mask = labels == part["label"]
        assert part["voxels"] == np.count_nonzero(mask)
        assert part["volume_ml"] == pytest.approx(part["voxels"] * voxel_ml, abs=1e-3)
        assert part["voxels_above_300_hu"] == np.count_nonzero(voxels[mask] > 300)
    expected = {"air", "table"} if kind == "empty" else {"air", "water"} if kind == "water" else {"air", "bone"}
    assert expected <= set(truth["parts"])
    scanner = KINDS[kind].scanner
    cupping = 5.0 * (scanner.cupping_hu > 0.0)
    assert np.median(voxels[labels == 0]) == pytest.approx(scanner.to_values(-1000.0), abs=cupping)


def test_metal_has_the_largest_value_of_12_bits() -> None:
    settings = settings_of("pelvis", **CLEAN)
    values = make_phantom(settings)[0][label_materials(settings) == MATERIALS.index("metal")]
    assert np.median(values) == values.max() == 3071


def test_a_dry_skull_has_no_soft_tissue_and_a_head_has_it() -> None:
    dry, whole = (make_phantom(settings_of(kind))[2]["parts"] for kind in ("skull", "head"))
    assert "tissue" not in dry and whole["tissue"]["volume_ml"] > 1500.0
    assert dry["bone"]["voxels"] == whole["bone"]["voxels"]


@pytest.mark.release
@pytest.mark.seconds
def test_contrast_is_larger_and_brighter_than_the_marrow_of_the_spine() -> None:
    settings = settings_of("contrast", **CLEAN)
    voxels, _, truth = make_phantom(settings)
    contrast = voxels[label_materials(settings) == MATERIALS.index("contrast")]
    assert 250 <= np.median(contrast) <= 450
    parts = truth["parts"]
    assert parts["contrast"]["voxels_above_300_hu"] > parts["bone"]["voxels_above_300_hu"]


@pytest.mark.parametrize("table", ["flat", "curved", "headrest"])
@pytest.mark.parametrize("prone", daily(1, [False, True]))
def test_couch_lies_below_the_body_and_lower_with_a_gap(table: str, prone: bool) -> None:
    places = []
    for gap in (0.0, 12.0):
        settings = settings_of("skull", table=table, table_gap_mm=gap, prone=prone)
        labels = label_materials(settings)
        rows = {name: np.flatnonzero((labels == MATERIALS.index(name)).any(axis=(0, 2))) for name in ("bone", "table")}
        assert rows["table"].max() > rows["bone"].max()  # rows run downwards, prone too
        places.append(np.median(rows["table"]))
    assert places[1] > places[0]


def test_prone_turns_the_image_and_not_the_patient(tmp_path: Path) -> None:
    made = [make_phantom(settings_of("head", prone=prone, table="flat", **CLEAN)) for prone in (False, True)]
    assert np.sign(np.diag(made[1][1])[:3]).tolist() == [-1.0, -1.0, 1.0]
    points = np.random.default_rng(2).uniform((-60.0, -60.0, -40.0), (60.0, 60.0, 40.0), (3000, 3))
    points += (-3.5, -142.25, -418.75)
    values = []
    for voxels, affine, _ in made:
        i, j, k = np.rint(apply_affine(np.linalg.inv(affine), points)).astype(int).T
        values.append(voxels[k, j, i].astype(float))
    assert np.corrcoef(values)[0, 1] > 0.9
    write_phantom(tmp_path / "ct", settings_of("limb", prone=True))
    header = pydicom.dcmread(tmp_path / "ct" / "IM0001.dcm")
    assert header.PatientPosition == "HFP"
    assert [float(value) for value in header.ImageOrientationPatient] == [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0]


@pytest.mark.parametrize(("table", "changed"), daily_rows(1, [("none", True), ("flat", True), (None, False)]))
def test_another_couch_changes_the_voxels_of_a_spine(table: str | None, changed: bool) -> None:
    size = {"size": (80, 72), "slices": 6, "spacing": (4.5, 4.0, 5.0)}
    own = make_phantom(PhantomSettings(**size))[0]
    assert np.array_equal(make_phantom(PhantomSettings(**size, table=table))[0], own) != changed


def test_a_written_scene_has_its_materials_in_place(tmp_path: Path) -> None:
    settings = settings_of("limb", tilt=9.0, oblique=(4.0, -3.0, 8.0), table="curved", table_gap_mm=5.0)
    truth = write_phantom(tmp_path / "ct", settings)
    label_map = read_labels(tmp_path / "ct" / "materials.nrrd")
    assert np.array_equal(label_map.voxels, label_materials(settings))
    assert label_map.affine == pytest.approx(np.array(truth["affine_ijk_to_lps_mm"]), abs=1e-9)
    first = (tmp_path / "ct" / "materials.nrrd").read_bytes()
    write_phantom(tmp_path / "ct", settings)  # an earlier phantom is replaced
    assert (tmp_path / "ct" / "materials.nrrd").read_bytes() == first
    assert truth["settings"]["table_gap_mm"] == 5.0 and "prone" not in truth["settings"]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"kind": "skull", "table": "soft"}, "'soft'.*none, flat, curved, headrest"),
        ({"kind": "skull", "radius_mm": 30.0}, "a skull has no radius"),
        ({"kind": "sphere", "table": "flat"}, "a sphere lies on nothing"),
        ({"kind": "torus", "prone": True}, "a torus lies on nothing"),
        ({"kind": "skull", "table_gap_mm": 5.0}, "gap of 5 mm needs a table.*flat, curved"),
        ({"kind": "skull", "table": "flat", "table_gap_mm": 900.0}, "gap.*from -100 to 500 mm, got 900"),
    ],
)
def test_couch_that_a_phantom_cannot_have_is_refused_with_the_reason(given: dict, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        PhantomSettings(**given)


def test_materials_of_a_single_shape_are_refused() -> None:
    with refused(UsageError, "scene", "sphere"):
        label_materials(PhantomSettings(kind="sphere"))
