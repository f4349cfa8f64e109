"""Traits of a vertebra in a made scan along its canal: exact figures."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import tolerances

from clrecon.spine.discs import AHEAD_MM, ASIDE_MM, Bound, Course, Looks
from clrecon.spine.regions import CONFIDENT, WEIGHTS, Piece, Traits, _walls, beside_share, judge, weigh

PLACES = 60
WHOLE = Piece(
    upper=Bound(at=10, tilt=0, depth_hu=40.0), lower=Bound(at=50, tilt=0, depth_hu=20.0), begin=10, end=50,
    volume_ml=2.4, largest_share=0.775, doubtful_share=0.375, rim_share=0.75, arch_ml=0.0276,
)  # fmt: skip
"""Most of its traits lie half way between bad and good."""


def bodies_as_seen(depths: dict[int, float] | None = None) -> Looks:
    """A body from 10 to 30 mm before the canal and 15 mm to each side; planes as dark as `depths` says at places."""
    depth = np.full((PLACES, 3), np.nan, np.float32)
    for place, value in (depths or {}).items():
        depth[place, 1] = value
    flat = np.zeros((PLACES, 3), np.float32)
    return Looks(flat, flat, depth, *(np.full(PLACES, mm) for mm in (20.0, 30.0, 15.0)))


def scan_along_the_canal() -> np.ndarray:
    """Marrow of 70 HU within a wall of 300 HU; the middle of the piece are the places 20 to 39."""
    radius = np.hypot((AHEAD_MM[:, None] - 20.0) / 10.0, ASIDE_MM / 15.0)
    page = np.where(radius < 0.85, 70.0, np.where(radius < 1.15, 300.0, 0.0))
    scan = np.repeat(page[None], PLACES, axis=0).astype(np.float32)
    scan[34:40] = 70.0  # no wall in 6 of 20
    core = slice(15, 26), slice(34, 51)  # within 5 and 8 mm of the middle
    scan[20][core] = -61.0  # 1 of 20 is dark
    scan[21][core] = -60.0  # not dark
    tube = slice(0, 4), slice(39, 46)
    for first, last, hu in ((10, 14, 251.0), (14, 17, -151.0), (17, 18, 250.0), (18, 19, -150.0)):
        scan[first:last, tube[0], tube[1]] = hu  # 7 of 40 are filled
    return scan


def judge_piece(piece: Piece, gaps: tuple[float, ...], depths: dict[int, float] | None) -> Traits:
    """Judge a piece in the scan above; discs are usually 100 HU dark, and 50 HU at its lower end."""
    nothing = np.zeros((PLACES, 3))
    known = np.zeros(PLACES, bool)
    known[10:35] = known[50:] = True  # 25 of 40
    course = Course(canal=nothing, down=nothing, ahead=nothing, aside=nothing, known=known, reaches=(False, False))
    usual = np.full(PLACES, 100.0)
    usual[50:] = 50.0
    return judge(piece, gaps, scan_along_the_canal(), bodies_as_seen(depths), course, usual)


def traits_of(
    piece: Piece, *, gaps: tuple[float, ...] = (), depths: dict[int, float] | None = None
) -> dict[str, float]:
    """The traits of a piece from 0 to 1, by the heights of its neighbours and the darkness of planes at places."""
    return {name: value for name, (value, _) in judge_piece(piece, gaps, depths).items()}


USUAL_GAPS_MM = (10.0, 28.0, 99.0)
"""Distances between neighbouring discs, of which the middle one counts; WHOLE is 40 mm high."""

TRAITS_OF_WHOLE = {
    "upper disc": 40.0 / 80.0,  # HU darker than bone
    "lower disc": 20.0 / 60.0,
    "inside": 2.0 * (1.0 - 36.0 / 50.0),  # a plane within it 36 HU darker than bone
    "wall": (0.7 - 0.6) / (0.95 - 0.6),  # of its directions: 14 of 20
    "marrow": (70.0 - 40.0) / (80.0 - 40.0),  # HU
    "dark": 0.5,  # 5 % of the middle
    "canal": 0.5,  # 7 of 40 filled
    "line": (25 / 40 - 0.4) / (0.75 - 0.4),  # of its height the canal was seen
    "height": (1.6 - 40 / 28) / (1.6 - 1.25),  # times the usual one
    "volume": 0.5,  # 2.4 ml
    "border": 0.5,  # 37.5 % may be a neighbour's
    "arch": 0.5,  # 0.0276 ml of a spinous process
    "rim": 0.25,  # 75 % of its voxels in the surface
    "one part": 0.5,  # 77.5 % hang together
}


@pytest.mark.parametrize("trait", TRAITS_OF_WHOLE)
def test_a_whole_vertebra_has_each_trait_as_far_as_its_figure_lies_between_bad_and_good(trait: str) -> None:
    traits = traits_of(WHOLE, gaps=USUAL_GAPS_MM, depths={20: 36.0})
    assert traits.keys() == TRAITS_OF_WHOLE.keys()
    assert traits[trait] == pytest.approx(TRAITS_OF_WHOLE[trait], rel=tolerances.FLOAT32_SHARE)


@pytest.mark.parametrize(
    ("changes", "gaps", "trait", "value"),
    [
        ({}, (56.0,), "height", (1.6 - 56 / 40) / (1.6 - 1.25)),
        ({}, (40.0, 48.0), "height", 1.0),
        ({"volume_ml": 90.0}, (), "volume", (100 - 90) / (100 - 80)),
        ({"volume_ml": 0.8, "upper": None}, (), "volume", (0.8 - 0.6) / (1.0 - 0.6)),
        ({"volume_ml": 90.0, "lower": None}, (), "volume", (100 - 90) / (100 - 80)),
        ({"upper": Bound(10, 0, depth_hu=80.0), "lower": Bound(50, 0, depth_hu=90.0)}, (), "inside", 1.0),
    ],
    ids=[
        "lower than usual by 28 %",
        "between the usual heights",
        "too large",
        "half a vertebra without an upper end",
        "too large without a lower end",
        "dark plane lighter than half of its discs",
    ],
)
def test_height_volume_and_inside_of_a_vertebra_follow_neighbours_ends_and_discs(
    changes: dict[str, Any], gaps: tuple[float, ...], trait: str, value: float
) -> None:
    """The plane within it is 36 HU darker than bone, of 50 HU by its discs, or 80 HU.

    Bad and good are 1.6 and 1.25 times the usual height, and 0.6 and 1 times the least volume (3 ml, of a part 1 ml)
    or 1.25 and 1 times the largest (80 ml).
    """
    traits = traits_of(replace(WHOLE, **changes), gaps=gaps, depths={20: 36.0})
    assert traits[trait] == pytest.approx(value, rel=tolerances.FLOAT32_SHARE)


def test_each_trait_of_a_vertebra_is_described_with_its_figure() -> None:
    """The figures stand beside `TRAITS_OF_WHOLE`."""
    assert [text for _, text in judge_piece(WHOLE, gaps=USUAL_GAPS_MM, depths={20: 36.0}).values()] == [
        "the disc at its upper end is 40 HU darker than bone",
        "the disc at its lower end is 20 HU darker than bone",
        "36 HU darker plane within it: there may be another disc",
        "its body has a wall in 70 % of the directions",
        "the middle of its body has 70 HU",
        "5 % of the middle of its body is fat or air",
        "18 % of its canal is filled with bone or air",
        "its canal was seen on 62 % of its height",
        "its height is 40 mm, and 28 mm is usual beside it",
        "its volume is 2.4 ml, not 3 to 80",
        "38 % of it may be a neighbour's: their joints are closed",
        "it has only 0.0 ml of a spinous process",
        "75 % of its voxels lie in its surface: the slices are thick for its size",
        "78 % of it hang together",
    ]


def ring(wall: float, beyond: float) -> np.ndarray:
    """A page with 0 HU within a wall 40 mm deep and 60 mm wide, and a value beyond it."""
    radius = np.hypot((AHEAD_MM[:, None] - 20.0) / 20.0, ASIDE_MM / 30.0)
    return np.where(radius < 0.95, 0.0, np.where(radius < 1.05, wall, beyond))


WALLS = pytest.mark.parametrize(
    ("wall", "beyond", "share"),
    [(300.0, 240.0, 1.0), (300.0, 241.0, 0.0), (130.0, 70.0, 1.0), (129.0, 0.0, 0.0)],
    ids=["60 HU denser", "59 HU denser", "130 HU", "129 HU"],
)
BODY_OF_40_MM = replace(bodies_as_seen(), front_mm=np.full(PLACES, 40.0), side_mm=np.full(PLACES, 30.0))


@WALLS
def test_a_wall_has_130_hu_and_is_60_hu_denser_than_what_lies_beyond(wall: float, beyond: float, share: float) -> None:
    page = ring(wall, beyond)
    assert _walls(np.repeat(page[None], PLACES, axis=0), BODY_OF_40_MM, WHOLE) == share


@WALLS
def test_a_wall_in_front_alone_lies_in_12_of_18_directions(wall: float, beyond: float, share: float) -> None:
    page = ring(wall, beyond)
    page[:20] = 70.0  # behind the middle; directions are -130, -115 ... 125 degrees from the front
    walls = _walls(np.repeat(page[None], PLACES, axis=0), BODY_OF_40_MM, WHOLE)
    assert walls == pytest.approx(share * 12 / 18)


def test_a_part_of_a_vertebra_without_a_lower_end_is_not_judged_by_lower_disc_height_and_arch() -> None:
    usual_height_mm = (28.0,)
    whole, part = traits_of(WHOLE, gaps=usual_height_mm), traits_of(replace(WHOLE, lower=None), gaps=usual_height_mm)
    assert set(whole) - set(part) == {"lower disc", "height", "arch"}


def test_a_vertebra_without_neighbours_is_not_judged_by_its_height() -> None:
    assert "height" not in traits_of(WHOLE, gaps=())


@pytest.mark.parametrize(
    ("end", "depths", "darkest"),
    [
        (50, {19: 999.0, 20: 40.0, 39: 30.0, 40: 999.0}, 40.0),
        (50, {19: 999.0, 20: 30.0, 39: 40.0, 40: 999.0}, 40.0),
        (30, {16: 999.0, 17: 40.0, 22: 30.0, 23: 999.0}, 40.0),
        (30, {16: 999.0, 17: 30.0, 22: 40.0, 23: 999.0}, 40.0),
        (30, {16: 999.0, 23: 999.0}, 0.0),
    ],
    ids=["40 mm, first", "40 mm, last", "20 mm, first", "20 mm, last", "20 mm, none"],
)
def test_another_disc_is_looked_for_a_quarter_of_the_height_and_at_least_7_mm_from_both_ends(
    end: int, depths: dict[int, float], darkest: float
) -> None:
    """Places are 1 mm apart, and the vertebra begins at 10; planes nearer to its ends are darker by 999 HU."""
    traits = traits_of(replace(WHOLE, end=end), depths=depths)
    expected = min(1.0, 2.0 * (1.0 - darkest / 50.0))  # as in `TRAITS_OF_WHOLE`
    assert traits["inside"] == pytest.approx(expected, rel=tolerances.FLOAT32_SHARE)


GOOD = {name: (1.0, name) for name in ("arch", "volume", "height", "line")}
"""Traits that leave nothing to doubt."""


def test_a_vertebra_with_good_traits_alone_has_a_confidence_of_1_and_no_doubts() -> None:
    assert weigh(GOOD) == (1.0, [])


def test_each_trait_takes_its_weight_times_what_it_lacks_from_the_logarithm_of_confidence() -> None:
    traits = {**GOOD, "arch": (0.0, "no arch"), "line": (0.39, "no line"), "height": (0.65, "low")}
    confidence, _ = weigh(traits)
    lost = 1.0 * WEIGHTS["arch"] + (1 - 0.39) * WEIGHTS["line"] + (1 - 0.65) * WEIGHTS["height"]
    assert confidence == pytest.approx(math.exp(-lost))


@pytest.mark.parametrize(("trait", "weight"), [("arch", 0.45), ("line", 0.15), ("height", 0.25)])
def test_traits_have_their_weights(trait: str, weight: float) -> None:
    assert WEIGHTS[trait] == weight


def test_a_vertebra_that_lacks_every_trait_has_a_confidence_of_a_40th() -> None:
    nothing = {name: (0.0, name) for name in WEIGHTS}
    confidence, _ = weigh(nothing)
    assert confidence == pytest.approx(math.exp(-3.67))  # the sum of all weights


def test_traits_that_take_a_fifth_of_what_the_worst_takes_are_named_as_doubts() -> None:
    """The arch takes 0.45, of which a fifth is 0.09; the line takes 0.0915 and the height 0.0875."""
    _, doubts = weigh({**GOOD, "arch": (0.0, "no arch"), "line": (0.39, "no line"), "height": (0.65, "low")})
    assert doubts == ["no arch", "no line"]


def test_a_confident_vertebra_has_no_doubts() -> None:
    confidence, doubts = weigh({**GOOD, "arch": (0.0, "no arch"), "line": (0.8, "no line")})
    assert confidence == pytest.approx(math.exp(-0.45 - 0.2 * 0.15))
    assert confidence > CONFIDENT
    assert doubts == []


MIDDLE_OF_THE_LOWER = slice(34, 44)
"""Places in the middle of a vertebra from 29 to 49."""

LOWER = replace(WHOLE, begin=29, end=49)


@pytest.fixture
def bone_beside_the_lower() -> tuple[np.ndarray, Looks]:
    """100 HU beside the middle of the lower vertebra, on both sides, and 0 HU elsewhere in it.

    The body 20 mm above is 12 mm wide on each side.  Bone is looked for 7 mm beside its wall, within 4 mm, and 6 to
    20 mm before the canal.
    """
    looks, scan = bodies_as_seen(), np.full((PLACES, len(AHEAD_MM), len(ASIDE_MM)), np.nan, np.float32)
    looks.side_mm[:10] = 12.0
    scan[MIDDLE_OF_THE_LOWER] = 0.0
    midline = 42
    for first in (midline + 12 + 7 - 4, midline - 12 - 7 - 4):
        scan[MIDDLE_OF_THE_LOWER, 6:21, first : first + 9] = 100.0
    return scan, looks


def test_bone_everywhere_beside_a_body_has_a_share_of_1(bone_beside_the_lower: tuple[np.ndarray, Looks]) -> None:
    assert beside_share(*bone_beside_the_lower, LOWER, level=100.0) == 1.0


def test_one_of_15_rows_without_bone_beside_a_body_is_missing_in_its_share(
    bone_beside_the_lower: tuple[np.ndarray, Looks],
) -> None:
    scan, looks = bone_beside_the_lower
    scan[MIDDLE_OF_THE_LOWER, 6] = 0.0
    assert beside_share(scan, looks, LOWER, level=100.0) == pytest.approx(14 / 15)


def test_two_of_10_places_below_the_level_beside_a_body_are_missing_in_its_share(
    bone_beside_the_lower: tuple[np.ndarray, Looks],
) -> None:
    scan, looks = bone_beside_the_lower
    scan[34:36] -= 1.0
    assert beside_share(scan, looks, LOWER, level=100.0) == pytest.approx(0.8)


def test_nothing_above_the_level_or_nothing_known_beside_a_body_has_a_share_of_0(
    bone_beside_the_lower: tuple[np.ndarray, Looks],
) -> None:
    scan, looks = bone_beside_the_lower
    assert beside_share(scan, looks, LOWER, level=101.0) == 0.0
    assert beside_share(np.full_like(scan, np.nan), looks, LOWER, level=100.0) == 0.0
