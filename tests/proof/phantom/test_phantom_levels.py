"""Spine phantoms of chosen levels: which are shown, how many slices they need, and how far they lie apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tolerances
from refusals import refused
from variants import daily, daily_rows

from clrecon.errors import UsageError
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


def planned(levels: str, **choice: object) -> list[Vertebra]:
    chosen = SpineChoice(parse_levels(levels), **choice)  # type: ignore[arg-type]
    return plan_anatomy((250.0, 250.0, 0.0), np.eye(3), 0, chosen).vertebrae


def gaps(vertebrae: list[Vertebra]) -> list[float]:
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


def test_levels_have_their_numbers_and_shortest_words() -> None:
    assert [level_number(name) for name in ("C1", "C7", "T1", "T12", "L1", "L5")] == [1, 7, 8, 19, 20, 24]
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


def test_defaults_stay_as_they_were() -> None:
    assert set(PhantomSettings().as_dict()) == {
        "kind", "size", "slices", "spacing", "tilt", "oblique", "noise", "point_spread_mm", "seed", "inside_hu",
        "outside_hu", "radius_mm", "transfer_syntax",
    }  # fmt: skip
    assert PhantomSettings().slices == 120 and PhantomSettings().spine_choice is None
    assert PhantomSettings(levels="l5").as_dict()["levels"] == "L5"


@pytest.mark.release
def test_slices_follow_the_levels_and_hold_whole_bones() -> None:
    counts = {}
    for levels in ("L4-L5", "C3-C7,T1-T2"):
        settings = PhantomSettings(**COARSE, levels=levels, noise=0.0, tilt=8.0)
        truth = make_phantom(settings)[2]["spine"]
        counts[levels] = settings.slices
        assert [level["name"] for level in truth["vertebrae"]] == list(parse_levels(levels))
        assert all(level["inside"] and level["whole"] for level in truth["vertebrae"])
        assert PhantomSettings(**settings.as_dict()) == settings
    assert 25 < counts["L4-L5"] < 35 < counts["C3-C7,T1-T2"] < 45


@pytest.mark.release
@pytest.mark.seconds
def test_a_written_label_map_has_the_levels_by_name(tmp_path: Path) -> None:
    settings = PhantomSettings(**COARSE, levels="C6-T1,L5", noise=0.0, oblique=(4.0, -3.0, 9.0))
    truth = write_phantom(tmp_path / "ct", settings)
    labels = read_labels(tmp_path / "ct" / "levels.nrrd")
    assert labels.names == {6: "C6", 7: "C7", 8: "T1", 24: "L5"}
    assert np.array_equal(labels.voxels, phantom_truth(settings).label_map())
    assert labels.affine == pytest.approx(np.array(truth["affine_ijk_to_lps_mm"]), abs=1e-9)
    volume = read_volume(tmp_path / "ct")
    for level in truth["spine"]["vertebrae"]:
        inside = labels.voxels == level["label"]
        assert np.median(volume.voxels[inside]) > 250.0
        middle = volume.lps_to_ijk([level["center_lps_mm"]])[0]
        near = np.rint(middle).astype(int)[::-1]
        assert labels.voxels[tuple(near)] == level["label"] or level["name"] == "C1"
    write_phantom(tmp_path / "ct", PhantomSettings(**COARSE, levels="L5"))  # an earlier phantom, label map and all


def test_cervical_vertebrae_have_their_own_shapes() -> None:
    by_name = {v.name: v for v in planned("C1-C7")}

    def bone(name: str, *points: tuple[float, float, float]) -> list[bool]:
        return [bool(d > 0) for d in vertebra_distance(by_name[name], *np.array(points).T)]

    # the ring of C1: arches before and behind, a foramen in the transverse process, nothing in the middle
    assert bone("C1", (0, -12, 0), (0, 26, 0), (16, 0, 0), (0, -1.5, 0), (0, 10, 0), (25, 0.8, 0), (31, 2, 0)) == [
        True, True, True, False, False, False, True,
    ]  # fmt: skip
    # the dens stands on C2 and within the ring of C1
    top = by_name["C2"].height / 2.0 + 10.0
    assert bone("C2", (0, -1, top), (0, 8, top), (4.6, by_name["C2"].depth / 2 + 33, -8)) == [True, False, True]
    for name in ("C3", "C5", "C7"):
        v = by_name[name]
        beside = v.width / 2.0 + 4.4
        assert bone(name, (beside, v.depth / 8.0, -1.0), (0, v.depth / 2 + v.canal_half_depth, 0)) == [False, False]
        assert bone(name, (beside, v.depth / 8.0 + 3.6, -1.0), (beside, v.depth / 8.0 - 3.4, -1.0)) == [True, True]
    rear = by_name["C5"].depth / 2.0 + 2.0 * by_name["C5"].canal_half_depth
    assert bone("C5", (3.4, rear + 13.0, -4.0), (0.0, rear + 13.0, -4.0), (0.0, rear + 20.0, -7.0)) == [
        True, False, False,
    ]  # fmt: skip
    rear = by_name["C7"].depth / 2.0 + 2.0 * by_name["C7"].canal_half_depth
    assert bone("C7", (0.0, rear + 22.0, -8.0)) == [True]


def test_local_bounds_of_a_vertebra_have_it_all() -> None:
    for vertebra in planned("C1-T1,L5"):
        low, high = (np.array(corner) for corner in local_bounds(vertebra))
        lattice = np.random.default_rng(3).uniform(low - 6.0, high + 6.0, (60_000, 3))
        outside = ((lattice < low) | (lattice > high)).any(axis=1)
        assert (vertebra_distance(vertebra, *lattice[outside].T) < 0.0).all(), vertebra.name


@pytest.mark.parametrize("levels", daily(1, ["C1-C3", "C7-T1", "L4-L5"]))
def test_neighbouring_vertebrae_are_more_than_2_mm_apart_without_facet_joints(levels: str) -> None:
    assert min(gaps(planned(levels))) > 2.0


@pytest.mark.release
@pytest.mark.parametrize(("levels", "gap"), daily_rows(1, [("C1-C3", 0.3), ("T6-T7", 0.0), ("L4-L5", 0.8)]))
def test_least_distance_of_neighbouring_vertebrae_is_the_gap_of_their_facet_joints(levels: str, gap: float) -> None:
    found = gaps(planned(levels, facet_gap_mm=gap, scoliosis_deg=10.0))
    assert found == pytest.approx([gap] * len(found), abs=tolerances.PHANTOM_FACET_MM)


@pytest.mark.release
def test_a_bent_spine_has_the_angles_asked_and_rigid_vertebrae() -> None:
    described = []
    for bend in ({}, {"kyphosis_deg": 20.0, "scoliosis_deg": -35.0}):
        settings = PhantomSettings(**COARSE, levels="T1-L5", **bend)
        affine = place_slices(settings).affine
        described.append(facts_of_spine(plan_spine(settings, affine)[0], affine, settings))
    plain, bent = described
    assert bent["coronal_angle_deg"] - plain["coronal_angle_deg"] == pytest.approx(-35.0)
    assert bent["sagittal_angle_deg"] - plain["sagittal_angle_deg"] == pytest.approx(20.0)
    x = np.array([level["center_lps_mm"][0] for level in bent["vertebrae"]])
    assert x[8] < min(x[0], x[-1]) - 25.0  # the middle lies to the right
    straight, turned = planned("T1-L5"), planned("T1-L5", kyphosis_deg=20.0, scoliosis_deg=-35.0)
    for one, other in zip(straight, turned, strict=True):
        assert other.axes @ other.axes.T == pytest.approx(np.eye(3), abs=1e-12)
        assert (one.width, one.depth, one.height, one.room) == (other.width, other.depth, other.height, other.room)
    assert min(gaps(turned[5:8])) > 1.5


def test_a_bent_spine_stays_in_the_middle_and_no_level_goes_back() -> None:
    straight, bent = (
        planned("T1-L5", centred=False),
        planned("T1-L5", centred=False, kyphosis_deg=30.0, scoliosis_deg=35.0),
    )
    moved = np.array([other.center for other in bent]) - np.array([one.center for one in straight])
    assert moved[:, 0].max() == pytest.approx(-moved[:, 0].min()) and moved[:, 0].max() > 5.0
    assert moved[:, 1].max() == pytest.approx(0.0, abs=1e-9) and moved[:, 1].min() < -5.0
