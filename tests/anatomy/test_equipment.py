"""Bars, rails and metal beside a patient are no bone; bones of thin limbs and dry bones are no bars."""

from __future__ import annotations

import numpy as np
import pytest
from beside_bodies import METAL_HU, PLASTIC_HU, RAIL_HU, X, Y, Z, as_scan, box, make_legs
from variants import daily

from clrecon.anatomy.body import remove_table
from clrecon.anatomy.dense_pieces import _is_bar, _measure_sections
from clrecon.errors import RefusedInputError

CLIP = box((0, 70, 20), (8, 8, 12))

EQUIPMENT = {
    "a rail off the table, and a clip": (box((165, 40, 0), (4, 4, 60), 0.04), CLIP),
    "a thick rail, and a clip": (box((165, 40, 0), (6, 6, 80), 0.04), CLIP),
    "a rail beside the skin with a clip on it": (box((140, 10, 0), (4, 4, 70)), box((135, 10, 40), (6, 6, 8))),
    "a bar of 24 ml across within the table": (box((75, 97, 0), (100, 5, 6)), CLIP),
    "a bar across under a leg": (box((75, 76, 0), (80, 8, 8)), CLIP),
}


@pytest.mark.parametrize("name", daily(2, EQUIPMENT))
def test_hard_equipment_is_removed_and_is_no_bone(name):
    hu, bone = make_legs()
    bar, metal = EQUIPMENT[name]
    bar, metal = bar & (hu < -100), metal & (hu < -100)
    hu[bar], hu[metal] = RAIL_HU, METAL_HU
    scan = as_scan(hu)
    cleaned = remove_table(scan)
    facts = cleaned.report["remove_table"]
    assert (cleaned.voxels == scan.voxels)[bone].all()
    assert facts["bone_voxels"] == np.count_nonzero(bone) and facts["bone_kept"] == 1.0
    assert facts["bone_removed"] == facts["kept_without_bone"] == []
    beside = "skin" in name  # the margin of 3 mm around the skin stays as it is
    assert (cleaned.voxels > 600)[bar | metal].mean() < (0.2 if beside else 1e-9)


def test_bone_that_is_removed_is_named_with_its_ml_and_its_place():
    """Two bent dry bones: as straight as no bar, and too small for a second body."""
    hu, bone = make_legs()
    for place, x in ((40.0, 165.0), (-60.0, -165.0)):
        bent = np.hypot(X - x - 0.004 * (Z - place) ** 2, Y - 10) < 6 - 0.04 * abs(Z - place)
        hu[bent & (abs(Z - place) < 60)] = 900
    with pytest.raises(RefusedInputError) as caught:
        remove_table(as_scan(hu))
    message = str(caught.value)
    assert "would be removed with it (bone_kept 0.9" in message and "at least 0.98 is needed)" in message
    assert "ml around (16" in message and "ml around (-16" in message and "mm LPS; leave the table in" in message
    removed = remove_table(as_scan(hu), allow_bone_loss=True).report["remove_table"]["bone_removed"]
    assert len(removed) == 2
    for piece in removed:
        side = 1 if piece["at_mm"][0] > 0 else -1
        assert piece["at_mm"] == pytest.approx([165 * side + 3, 10, 40 if side > 0 else -60], abs=4)
        assert piece["ml"] == pytest.approx(piece["voxels"] * 0.025)


def test_the_straight_bone_of_a_thin_limb_stays():
    """A child's arm of 18 mm with a solid straight bone of 8 mm: soft tissue around it tells it from a bar."""
    hu, bone = make_legs()
    arm = np.hypot(X - 170 - 0.08 * Z, Y)
    hu[arm < 9], hu[arm < 4] = 50, 1200
    cleaned = remove_table(as_scan(hu), allow_bone_loss=True)
    facts = cleaned.report["remove_table"]
    thin = np.count_nonzero(arm < 4)
    assert facts["bone_voxels"] == np.count_nonzero(bone) + thin


def test_paddles_as_thick_as_a_limb_stay_and_are_named():
    hu, _ = make_legs()
    for side in (-1, 1):
        hu[box((185 * side, -40, 0), (14, 40, 30))] = PLASTIC_HU
    cleaned = remove_table(as_scan(hu))
    assert [piece["at_mm"] for piece in cleaned.report["remove_table"]["kept_without_bone"]] == [
        pytest.approx([185 * side, -40, 0], abs=2.0) for side in (-1, 1)
    ]


def test_a_dry_shaft_beside_a_patient_is_no_bar():
    """Straight over 250 mm, but hollow and thicker in the middle of its length."""
    hu, bone = make_legs()
    way = np.hypot(X - 170 - 0.08 * Z, Y - 30)
    shaft = (way < 12 - 0.00008 * Z**2) & (way >= 7)
    hu[shaft] = 1300
    cleaned = remove_table(as_scan(hu))
    assert cleaned.report["remove_table"]["bone_voxels"] >= np.count_nonzero(bone) + 0.95 * np.count_nonzero(shaft)
    assert (cleaned.voxels > 600)[shaft].all()


@pytest.mark.parametrize(
    ("cells", "found"),
    [((34, 2, 2), False), ((35, 2, 2), True), ((36, 12, 12), False), ((38, 12, 12), True), ((7, 41, 4), True)],
)
def test_a_bar_is_50_mm_long_and_three_times_its_thickness(cells, found):
    """Between the first and the last middle of cells of 1.5 mm; a bar across has slices of 3 mm."""
    size_mm = (3.0 if cells[0] == 7 else 1.5, 1.5, 1.5)
    assert _is_bar(np.ones(cells, bool), np.full(cells, 500, np.float32), size_mm) == found


def test_sections_of_an_even_bar_have_the_same_weight():
    """40 cells of 1.5 mm, less half a cell at both ends: four sections of 57 / 4 mm, of 9.5 cells."""
    along, across = 1.5 * np.arange(40.0), np.tile([0.5, -2.0], (40, 1))
    middles, sums = _measure_sections(along, across, np.full(40, 3.0), 1.5)
    np.testing.assert_allclose(sums, 3.0 * 9.5, rtol=1e-12)
    np.testing.assert_allclose(middles, across[:4], rtol=1e-12)
