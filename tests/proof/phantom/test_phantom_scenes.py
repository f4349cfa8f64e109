"""Scenes: each body shows its materials where the truth says, lies on its table, and can be written and read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
import tolerances
from refusals import refused
from variants import daily

from clrecon.errors import UsageError
from clrecon.geometry import apply_affine
from clrecon.labels import read_labels
from clrecon.proof.phantom import KINDS, MATERIALS, PhantomSettings, label_materials, make_phantom, write_phantom
from clrecon.proof.phantom.scene_plans import PLANS
from clrecon.proof.phantom.scenes import TABLES
from clrecon.proof.phantom.settings import CENTRE_LPS_MM, TABLE_NAMES

SCENES = {name: kind for name, kind in KINDS.items() if kind.is_scene}
CLEAN = {"noise": 0.0, "point_spread_mm": 0.0}


def coarse_settings(kind: str, **given: object) -> PhantomSettings:
    """A coarse phantom: steps of three times those of the kind, of two lengths in the slice."""
    di, dj, dk = (3.0 * step for step in KINDS[kind].spacing)
    size = {"size": (86, 80), "slices": 34, "spacing": (1.07 * dj, di, dk)}
    return PhantomSettings(kind=kind, **{**size, **given})  # type: ignore[arg-type]


def test_every_scene_of_the_settings_has_a_plan_and_no_other() -> None:
    assert set(PLANS) == set(SCENES)


def test_couches_that_are_drawn_are_those_of_the_settings() -> None:
    assert tuple(TABLES) == TABLE_NAMES


@pytest.fixture(scope="module", params=daily(3, SCENES))
def clean_scene(request: pytest.FixtureRequest) -> tuple[str, np.ndarray, np.ndarray, dict]:
    """Kind, voxels, affine and truth of a scene without noise and blur."""
    return request.param, *make_phantom(coarse_settings(request.param, **CLEAN))


def test_parts_of_the_truth_count_the_voxels_of_their_labels(
    clean_scene: tuple[str, np.ndarray, np.ndarray, dict],
) -> None:
    kind, voxels, affine, truth = clean_scene
    labels = label_materials(coarse_settings(kind, **CLEAN))
    voxel_ml = abs(np.linalg.det(affine[:3, :3])) / 1000.0
    assert set(truth["parts"]) == {MATERIALS[label] for label in np.unique(labels)}

    for part in truth["parts"].values():
        mask = labels == part["label"]
        assert part["voxels"] == np.count_nonzero(mask)
        assert part["volume_ml"] == pytest.approx(part["voxels"] * voxel_ml, abs=1e-3)  # written with three digits
        assert part["voxels_above_300_hu"] == np.count_nonzero(voxels[mask] > 300)


def test_scene_has_air_and_the_material_that_it_is_for(clean_scene: tuple[str, np.ndarray, np.ndarray, dict]) -> None:
    kind, _, _, truth = clean_scene
    assert {"air", {"empty": "table", "water": "water"}.get(kind, "bone")} <= set(truth["parts"])


def test_median_of_air_in_a_scene_is_minus_1000_hu_in_the_unit_of_its_scanner(
    clean_scene: tuple[str, np.ndarray, np.ndarray, dict],
) -> None:
    kind, voxels, _, _ = clean_scene
    air = voxels[label_materials(coarse_settings(kind, **CLEAN)) == MATERIALS.index("air")]
    scanner = KINDS[kind].scanner
    cupping = 5.0 if scanner.cupping_hu > 0.0 else 0.0  # HU by which it darkens most of the air
    assert np.median(air) == pytest.approx(scanner.to_values(-1000.0), abs=cupping)


def test_metal_has_the_largest_value_of_12_bits() -> None:
    settings = coarse_settings("pelvis", **CLEAN)
    voxels, _, _ = make_phantom(settings)
    metal = voxels[label_materials(settings) == MATERIALS.index("metal")]
    assert np.median(metal) == metal.max() == 2**12 - 1 - 1024


def test_dry_skull_is_the_bone_of_a_head_without_its_soft_tissue() -> None:
    (_, _, truth_of_skull), (_, _, truth_of_head) = (make_phantom(coarse_settings(kind)) for kind in ("skull", "head"))
    skull, head = truth_of_skull["parts"], truth_of_head["parts"]
    assert skull["bone"]["voxels"] == head["bone"]["voxels"]
    assert "tissue" not in skull
    assert head["tissue"]["volume_ml"] > 1500.0  # measured 2464


@pytest.mark.release
@pytest.mark.seconds
def test_contrast_medium_has_250_to_450_hu_and_more_voxels_above_300_hu_than_bone() -> None:
    settings = coarse_settings("contrast", **CLEAN)
    voxels, _, truth = make_phantom(settings)
    contrast = voxels[label_materials(settings) == MATERIALS.index("contrast")]
    assert 250 <= np.median(contrast) <= 450  # its plan draws vessels, heart and kidneys with 260 to 420 HU
    parts = truth["parts"]
    assert parts["contrast"]["voxels_above_300_hu"] > parts["bone"]["voxels_above_300_hu"]


def rows_of_material(settings: PhantomSettings, name: str) -> np.ndarray:
    """Rows of the image, which run downwards, in which a material is."""
    return np.flatnonzero((label_materials(settings) == MATERIALS.index(name)).any(axis=(0, 2)))


@pytest.mark.parametrize("table", ["flat", "curved", "headrest"])
@pytest.mark.parametrize("prone", daily(1, [False, True]), ids=["supine", "prone"])
def test_couch_lies_below_the_body(table: str, prone: bool) -> None:
    settings = coarse_settings("skull", table=table, prone=prone)
    assert rows_of_material(settings, "table").max() > rows_of_material(settings, "bone").max()


@pytest.mark.parametrize("table", ["flat", "curved", "headrest"])
@pytest.mark.parametrize("prone", daily(1, [False, True]), ids=["supine", "prone"])
def test_couch_lies_lower_with_a_gap(table: str, prone: bool) -> None:
    without, with_gap = (
        np.median(rows_of_material(coarse_settings("skull", table=table, table_gap_mm=gap, prone=prone), "table"))
        for gap in (0.0, 12.0)
    )
    assert with_gap > without


def test_prone_head_has_the_same_values_at_the_same_places_in_a_turned_image() -> None:
    supine, prone = (
        make_phantom(coarse_settings("head", prone=prone, table="flat", **CLEAN)) for prone in (False, True)
    )
    offsets = np.random.default_rng(2).uniform((-60.0, -60.0, -40.0), (60.0, 60.0, 40.0), (3000, 3))

    values = []
    for voxels, affine, _ in (supine, prone):
        i, j, k = np.rint(apply_affine(np.linalg.inv(affine), CENTRE_LPS_MM + offsets)).astype(int).T
        values.append(voxels[k, j, i].astype(float))

    _, affine_of_prone, _ = prone
    assert np.sign(np.diag(affine_of_prone)[:3]).tolist() == [-1.0, -1.0, 1.0]
    assert np.corrcoef(values)[0, 1] > 0.999  # measured 1


def test_header_of_a_prone_scan_has_its_position_and_rows_and_columns_turned(tmp_path: Path) -> None:
    write_phantom(tmp_path / "ct", coarse_settings("limb", prone=True))
    header = pydicom.dcmread(tmp_path / "ct" / "IM0001.dcm")
    assert header.PatientPosition == "HFP"
    assert [float(value) for value in header.ImageOrientationPatient] == [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0]


@pytest.mark.parametrize("table", daily(1, ["none", "flat"]))
def test_couch_other_than_its_own_changes_the_voxels_of_a_spine(table: str) -> None:
    size = {"size": (80, 72), "slices": 6, "spacing": (4.5, 4.0, 5.0)}
    own, other = (make_phantom(PhantomSettings(**size, **given))[0] for given in ({}, {"table": table}))
    assert not np.array_equal(other, own)


@pytest.fixture(scope="module")
def written_limb(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PhantomSettings, dict]:
    """Folder, settings and truth of a tilted and oblique limb above a couch."""
    settings = coarse_settings("limb", tilt=9.0, oblique=(4.0, -3.0, 8.0), table="curved", table_gap_mm=5.0)
    folder = tmp_path_factory.mktemp("limb") / "ct"
    return folder, settings, write_phantom(folder, settings)


def test_written_label_map_of_a_scene_has_its_materials_in_place(
    written_limb: tuple[Path, PhantomSettings, dict],
) -> None:
    folder, settings, truth = written_limb
    label_map = read_labels(folder / "materials.nrrd")
    expected_affine = np.array(truth["affine_ijk_to_lps_mm"])
    assert np.array_equal(label_map.voxels, label_materials(settings))
    assert label_map.affine == pytest.approx(expected_affine, abs=tolerances.DECIMAL_PLACE_MM)


def test_scene_is_written_over_an_earlier_one_with_the_same_bytes(
    written_limb: tuple[Path, PhantomSettings, dict],
) -> None:
    folder, settings, _ = written_limb
    first = (folder / "materials.nrrd").read_bytes()
    write_phantom(folder, settings)
    assert (folder / "materials.nrrd").read_bytes() == first


def test_truth_of_a_scene_names_the_settings_that_were_chosen_and_no_default() -> None:
    _, _, truth = make_phantom(coarse_settings("limb", table="curved", table_gap_mm=5.0))
    assert truth["settings"]["table_gap_mm"] == 5.0
    assert "prone" not in truth["settings"]


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
