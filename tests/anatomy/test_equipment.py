"""Bars, rails and metal beside a patient are no bone; bones of thin limbs and dry bones are no bars."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from beside_bodies import METAL_HU, PLASTIC_HU, RAIL_HU, X, Y, Z, as_scan, box, make_legs
from variants import daily

from clrecon.anatomy.body import remove_table
from clrecon.anatomy.dense_pieces import _is_bar, _measure_sections
from clrecon.errors import RefusedInputError

CLIP = box((0, 70, 20), half=(8, 8, 12))

EQUIPMENT = {  # boxes about a centre (x, y, z), mm, with half of their edges; rails slant along the legs
    "a rail off the table, and a clip": (box((165, 40, 0), half=(4, 4, 60), slant=0.04), CLIP),
    "a thick rail, and a clip": (box((165, 40, 0), half=(6, 6, 80), slant=0.04), CLIP),
    "a rail beside the skin with a clip on it": (
        box((140, 10, 0), half=(4, 4, 70)),
        box((135, 10, 40), half=(6, 6, 8)),
    ),
    "a bar of 24 ml across within the table": (box((75, 97, 0), half=(100, 5, 6)), CLIP),
    "a bar across under a leg": (box((75, 76, 0), half=(80, 8, 8)), CLIP),
}


@pytest.fixture(scope="module", params=daily(2, EQUIPMENT))
def legs_beside_equipment(request):
    """Name of the equipment, the scan, masks of the bones and of bar and metal, and the scan without its table."""
    hu, bone = make_legs()
    bar, metal = (part & (hu < -100) for part in EQUIPMENT[request.param])
    hu[bar] = RAIL_HU
    hu[metal] = METAL_HU
    scan = as_scan(hu)
    return request.param, scan, bone, bar | metal, remove_table(scan)


def test_bones_stay_beside_hard_equipment_and_alone_count_as_bone(legs_beside_equipment):
    _, scan, bone, _, cleaned = legs_beside_equipment
    facts = cleaned.report["remove_table"]
    assert (cleaned.voxels == scan.voxels)[bone].all()
    assert (facts["bone_voxels"], facts["bone_kept"]) == (np.count_nonzero(bone), 1.0)
    assert (facts["bone_removed"], facts["kept_without_bone"]) == ([], [])


def test_hard_equipment_is_removed_but_for_what_lies_in_the_margin_of_the_skin(legs_beside_equipment):
    name, _, _, equipment, cleaned = legs_beside_equipment
    share_left = (cleaned.voxels > 600)[equipment].mean()
    if "skin" in name:
        assert share_left < 0.2  # the margin of 3 mm around the skin stays: measured 0.16
    else:
        assert share_left == 0.0


PLACES_OF_DRY_BONES = [(168.0, 10.0, 40.0), (-162.0, 10.0, -60.0)]


@pytest.fixture(scope="module")
def legs_beside_dry_bones():
    """Two bent dry bones, as straight as no bar and too small for a second body; their middles are as above."""
    hu, _ = make_legs()
    for z, x in ((40.0, 165.0), (-60.0, -165.0)):
        from_axis = np.hypot(X - x - 0.004 * (Z - z) ** 2, Y - 10)
        hu[(from_axis < 6 - 0.04 * abs(Z - z)) & (abs(Z - z) < 60)] = 900
    return as_scan(hu)


def test_removing_dry_bones_with_the_table_is_refused_with_their_share_millilitres_and_places(legs_beside_dry_bones):
    with pytest.raises(RefusedInputError) as caught:
        remove_table(legs_beside_dry_bones)
    message = str(caught.value)
    assert "would be removed with it (bone_kept 0.9" in message
    assert "at least 0.98 is needed)" in message
    assert "ml around (16" in message
    assert "ml around (-16" in message
    assert "mm LPS; leave the table in" in message


def test_report_lists_each_bone_that_was_removed_with_its_place_and_millilitres(legs_beside_dry_bones):
    removed = remove_table(legs_beside_dry_bones, allow_bone_loss=True).report["remove_table"]["bone_removed"]
    right_to_left = sorted(removed, key=lambda piece: -piece["at_mm"][0])
    voxel_ml = 2.5 * 2.5 * 4.0 / 1000.0
    for piece, place in zip(right_to_left, PLACES_OF_DRY_BONES, strict=True):
        assert piece["at_mm"] == pytest.approx(place, abs=4)  # a slice
        assert piece["ml"] == pytest.approx(piece["voxels"] * voxel_ml)


def test_the_straight_bone_of_a_thin_limb_counts_as_bone_and_stays():
    """A child's arm of 18 mm with a solid straight bone of 8 mm: soft tissue around it tells it from a bar."""
    hu, bone = make_legs()
    from_axis = np.hypot(X - 170 - 0.08 * Z, Y)
    hu[from_axis < 9] = 50
    hu[from_axis < 4] = 1200
    scan = as_scan(hu)
    cleaned = remove_table(scan, allow_bone_loss=True)
    assert (cleaned.voxels == scan.voxels)[from_axis < 4].all()
    assert cleaned.report["remove_table"]["bone_voxels"] == np.count_nonzero(bone) + np.count_nonzero(from_axis < 4)


def test_paddles_of_plastic_as_thick_as_a_limb_are_reported_with_their_place_as_kept_without_bone():
    hu, _ = make_legs()
    for side in (-1, 1):
        hu[box((185 * side, -40, 0), half=(14, 40, 30))] = PLASTIC_HU
    kept = remove_table(as_scan(hu)).report["remove_table"]["kept_without_bone"]
    right, left = (piece["at_mm"] for piece in kept)
    assert right == pytest.approx([-185, -40, 0], abs=2.0)  # less than a voxel
    assert left == pytest.approx([185, -40, 0], abs=2.0)


def test_a_dry_shaft_beside_a_patient_stays_and_counts_as_bone():
    """Straight over 250 mm, but hollow and thicker in the middle of its length: no bar."""
    hu, bone = make_legs()
    from_axis = np.hypot(X - 170 - 0.08 * Z, Y - 30)
    shaft = (from_axis < 12 - 0.00008 * Z**2) & (from_axis >= 7)
    hu[shaft] = 1300
    cleaned = remove_table(as_scan(hu))
    assert (cleaned.voxels > 600)[shaft].all()
    assert cleaned.report["remove_table"]["bone_voxels"] >= np.count_nonzero(bone) + np.count_nonzero(shaft)


@pytest.mark.parametrize(
    ("cells", "slice_mm", "is_bar"),
    [
        ((34, 2, 2), 1.5, False),
        ((35, 2, 2), 1.5, True),
        ((36, 12, 12), 1.5, False),
        ((38, 12, 12), 1.5, True),
        ((7, 41, 4), 3.0, True),
    ],
    ids=["49.5 mm long", "51 mm long", "2.9 times its thickness", "3.1 times its thickness", "across the slices"],
)
def test_a_bar_is_50_mm_long_and_three_times_its_thickness(cells, slice_mm, is_bar):
    """Its length is that between the first and the last middle of cells, of 1.5 mm within slices."""
    hu = np.full(cells, 500, np.float32)
    assert _is_bar(np.ones(cells, bool), hu, size_mm=(slice_mm, 1.5, 1.5)) == is_bar


def test_four_sections_of_an_even_bar_have_the_same_weight_and_middle():
    """40 cells of 1.5 mm with a weight of 3, less a whole one at both ends: four sections of 57 / 4 mm, 9.5 cells."""
    along, across = 1.5 * np.arange(40.0), np.tile([0.5, -2.0], (40, 1))
    middles, weights = _measure_sections(along, across, weights=np.full(40, 3.0), cell_mm=1.5)
    np.testing.assert_allclose(weights, 3.0 * 9.5, rtol=tolerances.FLOAT64_SHARE)
    np.testing.assert_allclose(middles, across[:4], rtol=tolerances.FLOAT64_SHARE)
