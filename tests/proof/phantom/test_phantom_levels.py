"""Spine phantoms of chosen levels: which are shown, how many slices they need, and how far they lie apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tolerances
from refusals import refused
from variants import daily, daily_rows

from clrecon.errors import UsageError
from clrecon.geometry import apply_affine
from clrecon.labels import read_labels
from clrecon.proof.phantom import PhantomSettings, make_phantom, phantom_truth, write_phantom
from clrecon.proof.phantom.build import facts_of_spine
from clrecon.proof.phantom.series import place_slices
from clrecon.proof.phantom.spine import plan_spine
from clrecon.proof.phantom.spine_parts import LEVELS, SpineChoice, Vertebra, format_levels, level_number, parse_levels
from clrecon.proof.phantom.spine_plan import plan_anatomy
from clrecon.proof.phantom.truth import BoneSurface
from clrecon.proof.phantom.vertebra import local_bounds, vertebra_distance
from clrecon.reading import read_volume

COARSE = {"size": (64, 60), "spacing": (3.4, 3.2, 3.0)}
OLDER_SETTINGS = {
    "kind", "size", "slices", "spacing", "tilt", "oblique", "noise", "point_spread_mm", "seed", "inside_hu",
    "outside_hu", "radius_mm", "transfer_syntax",
}  # fmt: skip
"""What truth files named before a spine had levels, bends and couches."""


def plan_vertebrae(levels: str, **choice: object) -> list[Vertebra]:
    """Vertebrae of a spine in the middle of a field of 500 mm."""
    chosen = SpineChoice(parse_levels(levels), **choice)  # type: ignore[arg-type]
    return plan_anatomy(field_of_view_mm=(250.0, 250.0, 0.0), steps_mm=np.eye(3), seed=0, choice=chosen).vertebrae


def distances_of_neighbours(vertebrae: list[Vertebra]) -> list[float]:
    """Least distance of each vertebra from the one above, mm."""
    covers = [BoneSurface([v]) for v in vertebrae]
    return [float(upper.distance(lower._tree.data).min()) for upper, lower in zip(covers, covers[1:], strict=False)]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("L4-L5", ("L4", "L5")),
        ("c7", ("C7",)),
        (" T1 - T3 , C6-C7", ("C6", "C7", "T1", "T2", "T3")),
        ("L1,L3", ("L1", "L3")),
        ("C1-L5", LEVELS),
    ],
)
def test_levels_are_read_in_any_order_and_written_again(text: str, names: tuple[str, ...]) -> None:
    assert parse_levels(text) == names
    assert parse_levels(format_levels(names)) == names


def test_levels_are_numbered_from_1_at_c1_to_24_at_l5() -> None:
    assert [level_number(name) for name in ("C1", "C7", "T1", "T12", "L1", "L5")] == [1, 7, 8, 19, 20, 24]


def test_levels_that_follow_each_other_are_written_as_a_range() -> None:
    assert format_levels(("C7", "T1", "L1", "L4", "L5")) == "C7-T1,L1,L4-L5"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("L5-L1", "'L5-L1' runs upwards; name the upper level first: L1-L5"),
        ("C8", "'C8' is no level; there are C1 to C7"),
        ("L1-L2-L3", "a range has two ends"),
        ("L1,,L2", "'' is no level"),
        ("T12-L2,L1", "name L1 more than once"),
        ("", "levels are a text like"),
        ("L\u0661", "levels are a text like"),
    ],
)
def test_text_that_names_no_levels_is_refused_with_the_reason(text: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        PhantomSettings(levels=text)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"levels": "L1-L5", "slices": 40}, "do not fit into 40 slices of 3 mm: their bodies need 6[0-9] slices"),
        ({"levels": "L1-L5", "size": (16, 60)}, "need .* mm of columns, there are 51 mm"),
        ({"levels": "C1-L5", "spacing": (3.4, 3.2, 0.05)}, "need 1[0-9]{4} slices of 0.05 mm: at most 9999"),
        ({"facet_gap_mm": -0.1}, "gap of the facet joints must be a number from 0 to 1.5 mm, got -0.1"),
        ({"scoliosis_deg": 90.0}, "scoliosis must be a number from -60 to 60 degrees, got 90"),
        ({"kyphosis_deg": float("nan")}, "kyphosis.*got nan"),
        ({"kind": "sphere", "levels": "L1"}, "a sphere has no levels: they are for the spine"),
        ({"kind": "skull", "scoliosis_deg": 3.0}, "a skull has no scoliosis: it is for the spine"),
    ],
)
def test_settings_of_a_spine_that_cannot_be_drawn_are_refused_with_their_numbers(given: dict, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        PhantomSettings(**{**COARSE, **given})


def test_levels_that_do_not_fit_into_the_slices_are_refused_and_no_file_written(tmp_path: Path) -> None:
    with refused(UsageError, "C1-L5", 20):
        write_phantom(tmp_path / "ct", PhantomSettings(levels="C1-L5", slices=20))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("slices", "gap", "levels"), [(54, 2.5, "T12-L3"), (149, 1.4, "C1-C7,T1-T5"), (559, 1.0, "T1-L5")]
)
def test_sets_of_four_twelve_and_seventeen_levels_fit_into_usual_stacks(slices: int, gap: float, levels: str) -> None:
    settings = PhantomSettings(size=(512, 512), slices=slices, spacing=(0.7, 0.7, gap), levels=levels)
    assert settings.slices == slices


def test_settings_without_choices_for_a_spine_are_described_as_before_there_were_any() -> None:
    settings = PhantomSettings()
    assert settings.spine_choice is None
    assert set(settings.as_dict()) == OLDER_SETTINGS


def test_chosen_levels_are_described_in_capitals() -> None:
    assert PhantomSettings(levels="l5").as_dict()["levels"] == "L5"


@pytest.mark.release
@pytest.mark.parametrize("levels", ["L4-L5", "C3-C7,T1-T2"])
def test_vertebrae_of_the_chosen_levels_lie_whole_within_the_slices(levels: str) -> None:
    settings = PhantomSettings(**COARSE, levels=levels, noise=0.0, tilt=8.0)

    _, _, truth = make_phantom(settings)
    vertebrae = truth["spine"]["vertebrae"]

    assert [vertebra["name"] for vertebra in vertebrae] == list(parse_levels(levels))
    assert all(vertebra["inside"] and vertebra["whole"] for vertebra in vertebrae)


@pytest.mark.parametrize(
    ("levels", "fewest", "most"),
    [("L4-L5", 26, 34), ("C3-C7,T1-T2", 36, 44)],  # 80 to 100 mm of two lumbar levels, 110 to 130 mm of seven smaller
    ids=["two lumbar levels", "seven levels of the neck"],
)
def test_number_of_slices_follows_from_the_levels(levels: str, fewest: int, most: int) -> None:
    assert fewest <= PhantomSettings(**COARSE, levels=levels).slices <= most


def test_settings_made_from_a_description_of_settings_equal_them() -> None:
    settings = PhantomSettings(**COARSE, levels="L4-L5", noise=0.0, tilt=8.0)
    assert PhantomSettings(**settings.as_dict()) == settings


@pytest.fixture(scope="module")
def oblique_spine(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PhantomSettings, dict]:
    """Folder, settings and truth of a written spine of four levels."""
    settings = PhantomSettings(**COARSE, levels="C6-T1,L5", noise=0.0, oblique=(4.0, -3.0, 9.0))
    folder = tmp_path_factory.mktemp("oblique-spine") / "ct"
    return folder, settings, write_phantom(folder, settings)


@pytest.mark.release
@pytest.mark.seconds
def test_written_label_map_is_that_of_the_truth_with_the_names_of_its_levels(
    oblique_spine: tuple[Path, PhantomSettings, dict],
) -> None:
    folder, settings, truth = oblique_spine

    labels = read_labels(folder / "levels.nrrd")

    assert labels.names == {6: "C6", 7: "C7", 8: "T1", 24: "L5"}
    assert np.array_equal(labels.voxels, phantom_truth(settings).label_map())
    expected_affine = np.array(truth["affine_ijk_to_lps_mm"])
    assert labels.affine == pytest.approx(expected_affine, abs=tolerances.DECIMAL_PLACE_MM)


@pytest.mark.release
def test_written_label_of_a_vertebra_covers_voxels_of_bone(oblique_spine: tuple[Path, PhantomSettings, dict]) -> None:
    folder, _, truth = oblique_spine
    voxels, labels = read_volume(folder).voxels, read_labels(folder / "levels.nrrd").voxels

    medians = [np.median(voxels[labels == level["label"]]) for level in truth["spine"]["vertebrae"]]

    assert len(medians) == 4
    assert min(medians) > 250.0  # HU; measured 299; muscle has 54


@pytest.mark.release
def test_written_label_of_a_vertebra_is_at_the_centre_of_its_body(
    oblique_spine: tuple[Path, PhantomSettings, dict],
) -> None:
    folder, _, truth = oblique_spine  # all levels but C1, a ring, have a body at their centre
    labels = read_labels(folder / "levels.nrrd")
    vertebrae = truth["spine"]["vertebrae"]
    lps_to_ijk = np.linalg.inv(labels.affine)

    centres_ijk = apply_affine(lps_to_ijk, [vertebra["center_lps_mm"] for vertebra in vertebrae])
    i, j, k = np.rint(centres_ijk).astype(int).T

    assert labels.voxels[k, j, i].tolist() == [vertebra["label"] for vertebra in vertebrae]


@pytest.mark.release
def test_phantom_is_written_over_an_earlier_one_with_its_label_map(tmp_path: Path) -> None:
    write_phantom(tmp_path / "ct", PhantomSettings(**COARSE, levels="L4"))

    write_phantom(tmp_path / "ct", PhantomSettings(**COARSE, levels="L5"))

    assert read_labels(tmp_path / "ct" / "levels.nrrd").names == {24: "L5"}


@pytest.fixture(scope="module")
def neck() -> dict[str, Vertebra]:
    """The vertebrae from C1 to C7 by their names."""
    return {vertebra.name: vertebra for vertebra in plan_vertebrae("C1-C7")}


def is_bone(vertebra: Vertebra, x: float, y: float, z: float) -> bool:
    """Whether a point is bone: mm to the left, backwards and upwards from the middle of the body."""
    return bool(vertebra_distance(vertebra, *np.array([[x, y, z]]).T)[0] > 0.0)


def canal_end(vertebra: Vertebra) -> float:
    """How far behind the middle of its body the canal of a vertebra ends, mm."""
    return vertebra.depth / 2.0 + 2.0 * vertebra.canal_half_depth


@pytest.mark.parametrize(
    ("point_mm", "bone"),
    [
        pytest.param((0, -12, 0), True, id="front arch"),
        pytest.param((0, 26, 0), True, id="rear arch"),
        pytest.param((16, 0, 0), True, id="lateral mass"),
        pytest.param((0, -1.5, 0), False, id="place of the dens"),
        pytest.param((0, 10, 0), False, id="canal"),
        pytest.param((25, 0.8, 0), False, id="foramen of the transverse process"),
        pytest.param((31, 2, 0), True, id="tip of the transverse process"),
    ],
)
def test_c1_is_a_ring_without_a_body_and_with_foramina(
    neck: dict[str, Vertebra], point_mm: tuple[float, float, float], bone: bool
) -> None:
    assert is_bone(neck["C1"], *point_mm) == bone


def test_dens_stands_on_c2_in_front_of_its_canal(neck: dict[str, Vertebra]) -> None:
    above_the_body = neck["C2"].height / 2.0 + 10.0
    assert is_bone(neck["C2"], 0, -1, above_the_body)
    assert not is_bone(neck["C2"], 0, 8, above_the_body)


@pytest.mark.parametrize(("name", "radius_mm"), [("C3", 2.5), ("C5", 2.5), ("C7", 1.7)])
def test_transverse_process_of_a_cervical_vertebra_surrounds_its_foramen(
    neck: dict[str, Vertebra], name: str, radius_mm: float
) -> None:
    """A hole of this radius, and 0.2 mm more to the sides; its place is that of the plan in vertebra.py."""
    vertebra = neck[name]
    middle_x, middle_y = vertebra.width / 2.0 + 4.4, vertebra.depth / 8.0
    for angle in np.radians(range(0, 360, 30)):
        to_the_side, backwards = np.cos(angle), np.sin(angle)
        within, beyond = radius_mm - 0.1, radius_mm + 0.5
        assert not is_bone(vertebra, middle_x + within * to_the_side, middle_y + within * backwards, -1.0)
        assert is_bone(vertebra, middle_x + beyond * to_the_side, middle_y + beyond * backwards, -1.0)


@pytest.mark.parametrize("name", ["C3", "C5", "C7"])
def test_canal_of_a_cervical_vertebra_is_free_of_bone(neck: dict[str, Vertebra], name: str) -> None:
    vertebra = neck[name]
    assert not is_bone(vertebra, 0, vertebra.depth / 2 + vertebra.canal_half_depth, 0)


def test_spinous_process_of_c2_ends_in_a_tip_on_either_side_of_the_middle(neck: dict[str, Vertebra]) -> None:
    at_the_tips, lower_at_the_tips = neck["C2"].depth / 2.0 + 33.0, -8.0
    assert is_bone(neck["C2"], 4.6, at_the_tips, lower_at_the_tips)
    assert is_bone(neck["C2"], -4.6, at_the_tips, lower_at_the_tips)


def test_spinous_process_of_c5_is_split_at_its_end(neck: dict[str, Vertebra]) -> None:
    near_the_end = canal_end(neck["C5"]) + 13.0
    assert is_bone(neck["C5"], 3.4, near_the_end, -4.0)
    assert not is_bone(neck["C5"], 0.0, near_the_end, -4.0)


def test_spinous_process_of_c7_is_longer_than_that_of_c5(neck: dict[str, Vertebra]) -> None:
    assert is_bone(neck["C7"], 0.0, canal_end(neck["C7"]) + 22.0, -8.0)
    assert not is_bone(neck["C5"], 0.0, canal_end(neck["C5"]) + 20.0, -7.0)


@pytest.mark.parametrize("number", range(9), ids=[*LEVELS[:8], "L5"])
def test_no_bone_of_a_vertebra_lies_outside_of_its_local_bounds(number: int) -> None:
    vertebra = plan_vertebrae("C1-T1,L5")[number]
    low, high = (np.array(corner) for corner in local_bounds(vertebra))
    points = np.random.default_rng(3).uniform(low - 6.0, high + 6.0, (60_000, 3))

    outside = points[((points < low) | (points > high)).any(axis=1)]

    assert len(outside) > 10_000  # of 60,000; 19,301 were measured for L5, more for others
    assert (vertebra_distance(vertebra, *outside.T) < 0.0).all()


@pytest.mark.parametrize("levels", daily(1, ["C1-C3", "C7-T1", "L4-L5"]))
def test_neighbouring_vertebrae_are_more_than_2_mm_apart_without_facet_joints(levels: str) -> None:
    assert min(distances_of_neighbours(plan_vertebrae(levels))) > 2.0  # mm; measured 2.3 to 2.9


@pytest.mark.release
@pytest.mark.parametrize(("levels", "gap"), daily_rows(1, [("C1-C3", 0.3), ("T6-T7", 0.0), ("L4-L5", 0.8)]))
def test_least_distance_of_neighbouring_vertebrae_is_the_gap_of_their_facet_joints(levels: str, gap: float) -> None:
    found = distances_of_neighbours(plan_vertebrae(levels, facet_gap_mm=gap, scoliosis_deg=10.0))
    assert found == pytest.approx([gap] * len(found), abs=tolerances.PHANTOM_FACET_MM)


def facts_of_thoracolumbar_spine(**bend: float) -> dict:
    """What the truth says of the spine from T1 to L5."""
    settings = PhantomSettings(**COARSE, levels="T1-L5", **bend)  # type: ignore[arg-type]
    affine = place_slices(settings).affine
    return facts_of_spine(plan_spine(settings, affine)[0], affine, settings)


@pytest.mark.release
def test_kyphosis_and_scoliosis_add_to_the_angles_of_a_spine_as_many_degrees_as_asked() -> None:
    plain = facts_of_thoracolumbar_spine()
    bent = facts_of_thoracolumbar_spine(kyphosis_deg=20.0, scoliosis_deg=-35.0)
    assert bent["coronal_angle_deg"] - plain["coronal_angle_deg"] == pytest.approx(-35.0)
    assert bent["sagittal_angle_deg"] - plain["sagittal_angle_deg"] == pytest.approx(20.0)


@pytest.mark.release
def test_negative_scoliosis_bends_the_middle_of_a_spine_to_the_right() -> None:
    bent = facts_of_thoracolumbar_spine(scoliosis_deg=-35.0)
    x = [level["center_lps_mm"][0] for level in bent["vertebrae"]]  # grows to the left
    middle = len(x) // 2
    assert x[middle] < min(x[0], x[-1]) - 25.0  # mm; 27.2 and 43.7 were measured


@pytest.mark.release
def test_vertebrae_of_a_bent_spine_keep_their_sizes_and_orthonormal_axes() -> None:
    straight, bent = plan_vertebrae("T1-L5"), plan_vertebrae("T1-L5", kyphosis_deg=20.0, scoliosis_deg=-35.0)
    sizes, bent_sizes = ([(v.width, v.depth, v.height, v.room) for v in spine] for spine in (straight, bent))
    assert bent_sizes == sizes
    axes = np.array([vertebra.axes for vertebra in bent])
    assert axes @ axes.transpose(0, 2, 1) == pytest.approx(np.broadcast_to(np.eye(3), axes.shape), abs=1e-12)  # float64


@pytest.mark.release
def test_vertebrae_at_the_apex_of_a_bent_spine_do_not_touch() -> None:
    bent = plan_vertebrae("T1-L5", kyphosis_deg=20.0, scoliosis_deg=-35.0)
    assert min(distances_of_neighbours(bent[5:8])) > 1.5  # T6 to T8, where it bends most; mm; measured 3.3


@pytest.fixture(scope="module")
def moves_of_bent_spine() -> np.ndarray:
    """Where kyphosis and scoliosis move the vertebrae from T1 to L5, LPS mm."""
    straight = plan_vertebrae("T1-L5", centred=False)
    bent = plan_vertebrae("T1-L5", centred=False, kyphosis_deg=30.0, scoliosis_deg=35.0)
    return np.array([other.center for other in bent]) - np.array([one.center for one in straight])


def test_scoliosis_moves_vertebrae_as_far_to_the_left_as_to_the_right(moves_of_bent_spine: np.ndarray) -> None:
    x = moves_of_bent_spine[:, 0]
    assert x.max() > 5.0  # mm; 21.4 was measured
    assert x.max() == pytest.approx(-x.min())


def test_kyphosis_moves_vertebrae_forwards_and_none_backwards(moves_of_bent_spine: np.ndarray) -> None:
    backwards_mm = moves_of_bent_spine[:, 1]
    assert backwards_mm.min() < -20.0  # measured -36.7: 30 degrees over some 430 mm
    assert backwards_mm.max() == pytest.approx(0.0, abs=tolerances.DECIMAL_PLACE_MM)
