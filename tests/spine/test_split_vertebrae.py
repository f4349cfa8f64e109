"""Vertebrae of phantoms are found one by one; low confidence is said."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from refusals import refused
from variants import daily_rows

import clrecon
from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.proof.phantom import PhantomSettings, make_phantom, phantom_truth
from clrecon.proof.phantom.spine import label_levels
from clrecon.spine.discs import ASIDE_MM, CORE_ASIDE_MM, WALL_MARGIN_MM, Course, Looks, _highest
from clrecon.spine.regions import CONFIDENT, cut_part
from clrecon.spine.split import _describe_refusal

COARSE: dict[str, Any] = {"size": (112, 112), "spacing": (2.0, 2.0, 2.5)}
LEAST_RIGHT = 0.95


@cache
def phantom(levels: str, **choice: Any) -> tuple[Volume, np.ndarray, dict[int, str]]:
    """The scan, the true number of each voxel, and the names of the numbers."""
    settings = PhantomSettings(levels=levels, facet_gap_mm=0.0, **COARSE, **choice)
    voxels, affine, _ = make_phantom(settings)
    volume, truth = Volume(voxels, affine), phantom_truth(settings)
    numbers = np.zeros(volume.voxels.shape, np.uint8)
    near = np.argwhere(volume.voxels > 100)
    numbers[tuple(near.T)] = truth.label(volume.ijk_to_lps(near[:, ::-1]))
    return volume, numbers, {n: name for n, name in truth.names.items() if (numbers == n).any()}


@cache
def split(levels: str, **choice: Any) -> clrecon.VertebraSplit:
    return clrecon.split_vertebrae(phantom(levels, **choice)[0], keep_unsure=True)


def shares(labels: np.ndarray, truth: np.ndarray, names: dict[int, str]) -> dict[str, tuple[int, float]]:
    """For each level the number that most of its voxels have, and the share of them that have it."""
    found = {}
    for number, name in names.items():
        own = np.bincount(labels[truth == number])
        best = int(own[1:].argmax()) + 1 if len(own) > 1 else 0
        found[name] = best, float(own[best] / own.sum())
    return found


CASES = [("T12-L3", {}), ("L1-L4", {"tilt": 12.0, "oblique": (5.0, -8.0, 4.0)}), ("T9-T12", {"scoliosis_deg": 20.0})]


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize(("levels", "choice"), daily_rows(1, CASES), ids=["straight", "tilted", "scoliosis"])
def test_all_levels_with_touching_facets_are_told_apart(levels: str, choice: dict[str, Any]) -> None:
    _, truth, names = phantom(levels, **choice)
    result = split(levels, **choice)
    found = shares(result.labels.voxels, truth, names)
    assert [number for number, _ in found.values()] == [1, 2, 3, 4]
    assert min(share for _, share in found.values()) >= LEAST_RIGHT, found
    assert [one.is_confident for one in result.vertebrae] == [True] * 4
    assert [one.name for one in result.vertebrae] == ["vertebra_1", "vertebra_2", "vertebra_3", "vertebra_4"]
    assert result.labels.names == {one.number: one.name for one in result.vertebrae}
    assert len(result.discs_mm) == 3 and result.low_confidence == []


def test_discs_lie_between_the_true_centres_and_normals_point_down() -> None:
    settings = PhantomSettings(levels="T12-L3", facet_gap_mm=0.0, **COARSE)
    _, _, truth = make_phantom(settings)
    centres = np.array([level["center_lps_mm"] for level in truth["spine"]["vertebrae"] if "label" in level])
    result = split("T12-L3")
    middles = 0.5 * (centres[1:] + centres[:-1])
    assert np.abs(result.discs_mm[:, 2] - middles[:, 2]).max() < 4.0
    assert np.allclose(np.linalg.norm(result.disc_normals, axis=1), 1.0)
    assert (result.disc_normals[:, 2] < -0.8).all()
    heights = [one.centre_mm[2] for one in result.vertebrae]
    assert np.abs(np.array(heights) - centres[:, 2]).max() < 6.0


@pytest.mark.release
@pytest.mark.seconds
def test_a_named_point_names_all_and_numbers_them_as_verse_does() -> None:
    volume, truth, _ = phantom("T12-L3")
    point = volume.ijk_to_lps(np.argwhere(truth == 20)[:, ::-1]).mean(axis=0)  # L1; its middle may be in the canal
    centre = split("T12-L3").vertebrae[1].centre_mm
    named = clrecon.split_vertebrae(volume, name_at=(centre, "l1"))
    assert named.labels.names == {19: "T12", 20: "L1", 21: "L2", 22: "L3"}
    assert [one.name for one in named.vertebrae] == ["T12", "L1", "L2", "L3"]
    assert clrecon.split_vertebrae(volume, name_at=(point, "L1")).labels.names == named.labels.names
    same = np.array([0, 19, 20, 21, 22])[split("T12-L3").labels.voxels]
    assert np.array_equal(named.labels.voxels, same)


@pytest.mark.release
def test_the_level_of_the_uppermost_vertebra_names_all() -> None:
    named = clrecon.split_vertebrae(phantom("T12-L3")[0], first="t12")
    assert named.labels.names == {19: "T12", 20: "L1", 21: "L2", 22: "L3"}
    assert [one.name for one in named.vertebrae] == ["T12", "L1", "L2", "L3"]


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ({"name_at": ((0.0, -100.0, 5000.0), "L1")}, "no vertebra at"),
        ({"name_at": ((0.0, -100.0, -400.0), "L9")}, "no vertebra 'L9'"),
        ({"name_at": ("seed", "C1")}, "^1 vertebrae were found above C1, and there are only 0 levels above C1"),
        ({"name_at": ("seed", "L5")}, "^3 vertebrae were found from L5 .*, and there are only 2 levels from L5 to L6"),
        ({"first": "L4"}, "^4 vertebrae were found from L4 .*, and there are only 3 levels from L4 to L6"),
        ({"first": "S1"}, "no vertebra 'S1': they are C1 to C7"),
        ({"first": "T12", "name_at": ((0.0, -150.0, -400.0), "L1")}, "^first and name_at both name levels"),
        ({"level": float("nan")}, "number of HU"),
        ({"seeds": [(0.0, -150.0, -400.0)]}, "at least two"),
        ({"seeds": [(0.0, -150.0, -400.0), (3.0, -150.0, -400.0)]}, "same height"),
    ],
)
def test_impossible_parameters_are_refused(choice: dict[str, Any], words: str) -> None:
    if choice.get("name_at", ("",))[0] == "seed":
        choice = {"name_at": (split("T12-L3").vertebrae[1].centre_mm, choice["name_at"][1])}
    with pytest.raises(UsageError, match=words):
        clrecon.split_vertebrae(phantom("T12-L3")[0], **choice)


@pytest.mark.seconds
def test_seeds_are_the_vertebrae_and_need_no_canal(monkeypatch: pytest.MonkeyPatch) -> None:
    volume, truth, names = phantom("T12-L3")
    seeds = [one.centre_mm for one in split("T12-L3").vertebrae]

    def refuse(*_: object, **__: object) -> None:
        raise RefusedInputError("no spine was found: give points of the centre line")

    for canal_is_found in (True, False):
        if not canal_is_found:
            monkeypatch.setattr("clrecon.spine.split.find_spine_line", refuse)
            with refused(RefusedInputError, "vertebrae"):
                clrecon.split_vertebrae(volume)
        seeded = clrecon.split_vertebrae(volume, seeds=seeds[::-1], keep_unsure=True)
        found = shares(seeded.labels.voxels, truth, names)
        assert [number for number, _ in found.values()] == [1, 2, 3, 4]
        assert min(share for _, share in found.values()) >= (LEAST_RIGHT if canal_is_found else 0.9), found


@pytest.mark.release
def test_a_disc_that_bone_fills_lowers_the_confidence_of_the_vertebrae_beside_it() -> None:
    """Its place follows from its neighbours: the vertebrae stay right, but less is to be expected of them."""
    volume, truth, names = phantom("T12-L3")
    disc = split("T12-L3").discs_mm[1]
    k, j, i = np.indices(volume.voxels.shape)
    places = volume.ijk_to_lps(np.stack([i, j, k], axis=-1).reshape(-1, 3)).reshape(*k.shape, 3) - disc
    filled = (np.abs(places[..., 2]) < 9.0) & (np.hypot(places[..., 0], places[..., 1]) < 24.0)
    voxels = np.where(filled, 200 + 10 * ((i + j + k) % 3), volume.voxels)
    result = clrecon.split_vertebrae(Volume(voxels, volume.affine))
    before = [one.confidence for one in split("T12-L3").vertebrae]
    lost = np.array(before) - [one.confidence for one in result.vertebrae]
    assert (lost[1:3] > 0.03).all() and np.abs(lost[[0, 3]]).max() < 0.02, lost
    assert min(share for _, share in shares(result.labels.voxels, truth, names).values()) >= LEAST_RIGHT


@pytest.mark.release
@pytest.mark.seconds
def test_vertebrae_of_low_confidence_are_kept_only_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disc that is not seen makes one vertebra of two, of twice the height, with a disc within it."""
    from clrecon.spine import split as module

    choose = module.choose_discs

    def miss_one(looks: Any) -> Any:
        bounds, usual = choose(looks)
        return [*bounds[:2], *bounds[3:]], usual

    monkeypatch.setattr(module, "choose_discs", miss_one)
    volume, truth, _ = phantom("C3-T2")
    result = clrecon.split_vertebrae(volume, keep_unsure=True)
    low = [one for one in result.vertebrae if not one.is_confident]
    assert len(low) == 1 and low[0].confidence < CONFIDENT and low[0].height_mm > 22.0
    assert any("usual beside it" in doubt for doubt in low[0].doubts)
    held = np.bincount(truth[result.labels.voxels == low[0].number], minlength=8)[1:]
    assert (held > 0.3 * held.max()).sum() == 2  # two vertebrae
    kept = clrecon.split_vertebrae(volume)
    assert set(kept.labels.numbers) == set(result.labels.numbers) - {low[0].number}


@pytest.mark.seconds
@pytest.mark.parametrize(
    ("levels", "choice", "least"),
    daily_rows(
        1,
        [
            ("C1-T1", {"size": (140, 140), "spacing": (1.6, 1.6, 2.0)}, 0.7),
            ("C3-T2", {"size": (140, 140), "spacing": (1.6, 1.6, 2.5), "tilt": 15.0}, 0.7),
            ("T1-T12", {"size": (150, 150), "spacing": (2.4, 2.4, 2.4)}, 0.7),
            ("C1-L5", {"size": (150, 150), "spacing": (2.4, 2.4, 2.5)}, 0.65),
        ],
    ),
    ids=["neck", "tilted neck", "chest with ribs", "whole spine"],
)
def test_all_levels_are_found_and_confidence_is_near_the_overlap_with_the_truth(
    levels: str, choice: dict[str, Any], least: float
) -> None:
    """From C3 or C4 on each level is there, once and in order; between C1 and C2 there is no disc."""
    settings = PhantomSettings(levels=levels, facet_gap_mm=0.3, **choice)
    voxels, affine, _ = make_phantom(settings)
    truth = label_levels(settings, affine)
    result = clrecon.split_vertebrae(Volume(voxels, affine), keep_unsure=True)
    numbers, dice = [], []
    for one in result.vertebrae:
        ours = result.labels.voxels == one.number
        numbers.append(int(np.bincount(truth[ours], minlength=30)[1:].argmax()) + 1)
        theirs = truth == numbers[-1]
        dice.append(float(2 * (ours & theirs).sum() / (ours.sum() + theirs.sum())))
    assert numbers == list(range(numbers[0], int(truth.max()) + 1))
    assert numbers[0] <= max(int(truth[truth > 0].min()), 4)
    off = np.abs([one.confidence for one in result.vertebrae] - np.array(dice))
    assert min(dice) >= least and off.mean() <= 0.08 and off.max() <= 0.2, (dice, off)


@pytest.mark.release
def test_a_kyphotic_upper_chest_is_never_wrong_without_a_word() -> None:
    _, truth, names = phantom("C7-T6", kyphosis_deg=60.0)
    result = split("C7-T6", kyphosis_deg=60.0)
    for one in result.vertebrae:
        own = np.bincount(truth[result.labels.voxels == one.number], minlength=30)
        true = int(own[1:].argmax()) + 1
        right = own[true] / max((truth == true).sum(), 1)
        assert right >= 0.8 or not one.is_confident, (one, names.get(true), right)
    assert any(one.is_confident for one in result.vertebrae)


def test_one_vertebra_between_its_two_ends_is_found() -> None:
    volume, truth, names = phantom("L3")
    found = shares(clrecon.split_vertebrae(volume).labels.voxels, truth, names)
    assert found["L3"][1] > 0.7


def test_a_scan_without_a_vertebra_says_what_was_left_out() -> None:
    assert _describe_refusal([], []) == "no vertebra was found: nothing lies between two discs"
    assert _describe_refusal([], ["a", "b"]) == "no vertebra was found: a; b"


@pytest.mark.seconds
def test_a_spine_with_a_gap_is_refused() -> None:
    with pytest.raises(RefusedInputError, match="no spine|disc|none of the"):
        clrecon.split_vertebrae(phantom("C1,L5")[0])


@pytest.mark.parametrize("kind", ["head", "limb", "empty", "water"])
def test_bodies_that_are_no_spine_are_refused(kind: str) -> None:
    settings = PhantomSettings(kind=kind, size=(64, 64), slices=48, spacing=(3.6, 3.6, 3.6))
    voxels, affine, _ = make_phantom(settings)
    with refused(RefusedInputError, "vertebrae"):
        clrecon.split_vertebrae(Volume(voxels, affine))


def test_a_vertebra_without_an_arch_has_low_confidence() -> None:
    volume, _, _ = phantom("T12-L3")
    k, j, i = np.indices(volume.voxels.shape)
    places = volume.ijk_to_lps(np.stack([i, j, k], axis=-1).reshape(-1, 3)).reshape(*k.shape, 3)
    third = split("T12-L3").vertebrae[2]
    behind = places[..., 1] > third.centre_mm[1] + 30.0
    near = np.abs(places[..., 2] - third.centre_mm[2] + 12.0) < 24.0
    cut = np.where(behind & near & (volume.voxels > 60), 40, volume.voxels)
    result = clrecon.split_vertebrae(Volume(cut, volume.affine), keep_unsure=True)
    one = min(result.vertebrae, key=lambda found: abs(found.centre_mm[2] - third.centre_mm[2]))
    assert not one.is_confident and any("spinous" in doubt for doubt in one.doubts)


def test_uneven_slices_are_refused() -> None:
    volume, _, _ = phantom("T12-L3")
    places = volume.slice_origins()
    places[20:, 2] += 1.0
    uneven = Volume(volume.voxels, volume.affine, slice_positions=places)
    with pytest.raises(RefusedInputError, match="unevenly spaced"):
        clrecon.split_vertebrae(uneven)


def test_voxels_without_a_value_are_air_and_places_are_told_from_the_canal() -> None:
    hu = np.full((12, 60, 60), 100.0, np.float32)
    hu[5, 30, 20] = np.nan
    volume = Volume(hu, np.diag((2.0, 2.0, 1.0, 1.0)))
    down, ahead, aside = (np.tile(way, (10, 1)) for way in ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)))
    canal = np.column_stack([np.full(10, 60.0), np.full(10, 80.0), np.arange(10.0, 0.0, -1.0)])
    none, mm = np.zeros((10, 1), np.float32), np.full(10, 20.0)
    part = cut_part(
        volume,
        Course(canal, down, ahead, aside, np.ones(10, bool), (False, False)),
        Looks(none, none, none, mm, mm, mm),
    )
    at = tuple(np.array((5, 30, 20)) - part.first)
    assert part.values[at] == part.values.min() == -1024.0 and (part.values == 100.0).sum() == part.values.size - 1
    assert (part.ahead[at], part.aside[at], part.place[at]) == (20.0, -20.0, 5.0)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_side_wall_is_looked_for_from_the_core_to_behind_it(sign: int) -> None:
    values = np.tile(np.float32(ASIDE_MM), (2, 1, 1))  # each HU is its own place
    values[1, :, np.abs(ASIDE_MM) < 10.0] = np.nan
    found = _highest(values, sign, np.array([15.0, 9.0 - WALL_MARGIN_MM]))
    inner = [-CORE_ASIDE_MM, -200.0] if sign < 0 else [15.0 + WALL_MARGIN_MM, -200.0]
    assert found[:, 0].tolist() == inner


@pytest.mark.release
def test_the_order_of_the_axes_does_not_matter() -> None:
    """A volume whose slices are sagittal, as in NIfTI files."""
    volume, _, _ = phantom("T12-L3")
    turn = np.eye(4)[[2, 0, 1, 3]]  # new (i, j, k) of old (k, i, j)
    turned = Volume(volume.voxels.transpose(1, 2, 0), volume.affine @ turn.T)
    places = np.array([[3.0, 4.0, 5.0]])
    assert np.allclose(turned.ijk_to_lps(places[:, [2, 0, 1]]), volume.ijk_to_lps(places))
    labels = clrecon.split_vertebrae(turned, keep_unsure=True).labels.voxels.transpose(2, 0, 1)
    same = labels == split("T12-L3").labels.voxels
    assert same[split("T12-L3").labels.voxels > 0].mean() > 0.97


def test_the_middle_plane_shows_scan_labels_and_discs() -> None:
    plane = split("T12-L3").plane
    assert plane.sagittal.shape == plane.sagittal_labels.shape and len(plane.coronal) == len(plane.sagittal)
    assert set(np.unique(plane.coronal_labels)) == {0, 1, 2, 3, 4}
    assert len(plane.lines) >= 3 and len(plane.rows) == 4 and sorted(plane.rows) == plane.rows
    for number, row in enumerate(plane.rows, start=1):
        assert plane.coronal_labels[int(row), plane.middle_column] == number
        assert plane.sagittal_labels[int(row), plane.canal_column] == 0
        assert abs(plane.sagittal[int(row), plane.canal_column]) < 130


@pytest.mark.release
def test_given_level_is_used_and_progress_told() -> None:
    volume, _, _ = phantom("T12-L3")
    told: list[tuple[str, int, int]] = []
    dense = clrecon.split_vertebrae(volume, level=260.0, keep_unsure=True, progress=lambda *step: told.append(step))
    assert dense.level_hu == 260.0 and 120.0 <= split("T12-L3").level_hu <= 226.0
    ml = [sum(one.volume_ml for one in result.vertebrae) for result in (dense, split("T12-L3"))]
    assert ml[0] < ml[1]
    assert told[-5:] == [("vertebrae", done, 4) for done in range(5)] and told[0] == ("canal", 0, 1)
